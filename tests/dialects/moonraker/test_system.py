"""The computer and the configuration, as clients ask for them before they show anything."""

import asyncio
import json
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.dialects.moonraker.live import config, machine, site
from tests.harness import Server

from toolpost.config import Address, QueueConfig
from toolpost.dialects.moonraker import system
from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.host import Reading, describe_host, read_host
from toolpost.dialects.moonraker.rpc import NoParams
from toolpost.dialects.moonraker.system import NOTIFICATION, SystemMethods

QUEUE = {"automatic_transition": True, "job_transition_delay": 1.5}
NAMES = [
    "machine.system_info",
    "machine.proc_stats",
    "server.config",
    "server.webcams.list",
    "server.announcements.list",
    "server.temperature_store",
    "server.gcode_store",
]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("system")
    with Server(folder, config(machine("edm"), machine("mill", **QUEUE))) as server:
        yield server


def get(server: Server, name: str, prefix: str = "") -> Any:
    return server.client.request("GET", f"{prefix}/{name.replace('.', '/')}").json["result"]


def test_what_there_is_none_of_is_empty(server: Server) -> None:
    assert get(server, "server.webcams.list") == {"webcams": []}
    assert get(server, "server.announcements.list") == {"entries": [], "feeds": []}
    assert get(server, "server.temperature_store") == {}
    assert get(server, "server.gcode_store") == {"gcode_store": []}


@pytest.mark.parametrize("name", NAMES)
def test_each_is_answered_over_json_rpc_too_whatever_its_arguments(server: Server, name: str) -> None:
    params = {"include_monitors": True, "count": 100}
    answer = server.client.call("/server/jsonrpc", jsonrpc="2.0", method=name, params=params, id=1)
    over_http = get(server, name)
    assert answer["result"].keys() == over_http.keys()
    if name != "machine.proc_stats":
        assert answer["result"] == over_http


def test_system_info(server: Server) -> None:
    info = get(server, "machine.system_info")["system_info"]
    assert info["cpu_info"]["cpu_count"] == os.cpu_count()
    assert info["cpu_info"]["total_memory"] > 1000
    assert info["python"]["version"][:2] == [3, 11] or info["python"]["version"][0] == 3
    assert info["distribution"].keys() == {
        "name", "id", "version", "version_parts", "like", "codename", "release_info", "kernel_version",
    }  # fmt: skip
    assert info["distribution"]["version_parts"].keys() == {"major", "minor", "build_number"}
    assert info["virtualization"] == {"virt_type": "none", "virt_identifier": "none"}
    assert info["available_services"] == []
    assert info["instance_ids"] == {"moonraker": "moonraker", "klipper": "klipper"}
    for name in ("sd_info", "network", "canbus", "service_state"):
        assert info[name] == {}


def test_proc_stats(server: Server) -> None:
    stats = get(server, "machine.proc_stats")
    sample = stats["moonraker_stats"][-1]
    assert sample["memory"] > 1000
    assert sample["mem_units"] == "kB"
    assert 0 <= sample["cpu_usage"] <= 100 * (os.cpu_count() or 1) + 1
    assert stats["throttled_state"] is None
    assert stats["system_cpu_usage"].keys() >= {"cpu", "cpu0"}
    assert all(0 <= usage <= 100 for usage in stats["system_cpu_usage"].values())
    assert stats["network"]["lo"]["rx_bytes"] >= 0
    memory = stats["system_memory"]
    assert memory["used"] == memory["total"] - memory["available"] > 0
    assert stats["system_uptime"] > 0
    assert stats["websocket_connections"] == 0
    # Asking often looks at the computer no more often.
    times = [get(server, "machine.proc_stats")["moonraker_stats"][-1]["time"] for _ in range(10)]
    assert len(set(times)) <= 2


def test_config_is_that_of_the_machine_without_paths(server: Server) -> None:
    edm, mill = get(server, "server.config"), get(server, "server.config", "/machines/mill")
    assert edm["config"]["job_queue"] == {
        "load_on_startup": False,
        "automatic_transition": False,
        "job_transition_delay": 0.01,
        "job_transition_gcode": "",
    }
    assert mill["config"]["job_queue"] == {**edm["config"]["job_queue"], **QUEUE}
    assert edm["config"]["file_manager"] == {"queue_gcode_uploads": True}
    for answer in (edm, mill):
        assert answer["orig"] == answer["config"]
        assert answer["files"] == []
        assert str(server.data.parent) not in json.dumps(answer)


def test_who_is_connected_is_told_every_second(server: Server) -> None:
    async def run() -> None:
        async with site(server).client() as client:
            times = []
            async with asyncio.timeout(5):
                while len(times) < 2:
                    message = await client.message()
                    if message["method"] == NOTIFICATION:
                        [told] = message["params"]
                        times.append(told["moonraker_stats"]["time"])
            assert 0.9 < times[1] - times[0] < 1.8
            assert told["websocket_connections"] == 1
            assert told.keys() == {
                "moonraker_stats", "cpu_temp", "network", "system_cpu_usage", "system_memory",
                "websocket_connections",
            }  # fmt: skip

    asyncio.run(run())


# In the loop of the test.


class Shop:
    """What the methods need of the shop."""

    address = Address("127.0.0.1", 7125)

    def queue_config(self, machine: str) -> QueueConfig:
        assert machine == "edm"
        return QueueConfig()


def load_tasks() -> list[str]:
    return [task.get_name() for task in asyncio.all_tasks() if task.get_name() == "edm: load"]


def told(connection: Connection) -> list[Any]:
    return [json.loads(text) for text in connection._unsent]


def test_nothing_runs_while_nobody_is_connected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system, "INTERVAL", 0.01)

    async def run() -> None:
        connections = Connections()
        methods = SystemMethods(Shop(), "edm", connections)  # type: ignore[arg-type]
        methods.event(SimpleNamespace())  # type: ignore[arg-type]
        await methods.proc_stats(NoParams(), Connection("http", ""))
        assert load_tasks() == []
        for _ in range(2):
            connection = connections.open("websocket", "", "")
            assert connection is not None
            methods.event(SimpleNamespace())  # type: ignore[arg-type]
            methods.event(SimpleNamespace())  # type: ignore[arg-type]
            assert load_tasks() == ["edm: load"]
            async with asyncio.timeout(5):
                while len(told(connection)) < 3:
                    await asyncio.sleep(0.005)
            assert {message["method"] for message in told(connection)} == {NOTIFICATION}
            connections.close(connection)
            async with asyncio.timeout(5):
                while load_tasks():
                    await asyncio.sleep(0.005)
        answer: Any = await methods.proc_stats(NoParams(), Connection("http", ""))
        assert answer["websocket_connections"] == 0

    asyncio.run(run())


def test_config_has_the_address() -> None:
    methods = SystemMethods(Shop(), "edm", Connections())  # type: ignore[arg-type]
    answer: Any = asyncio.run(methods.config(NoParams(), Connection("http", "")))
    assert answer["config"]["server"] == {"host": "127.0.0.1", "port": 7125}


def test_usage_is_that_since_the_look_before() -> None:
    def reading(clock: float, used: float, busy: int, received: int, name: str = "lo") -> Reading:
        network = {name: {"rx_bytes": received, "tx_bytes": 100}}
        processors = {"cpu": (busy, int(clock * 100))}
        return Reading(1.0, clock, used, 5, processors, network, {}, 9.0, None)

    readings = [
        reading(10, 1, 50, 1000),
        reading(12, 1.5, 100, 5000),
        reading(13, 1.5, 100, 0),
        reading(13, 1.5, 100, 7, "new"),
    ]
    load = system._Load()
    seen = []
    for one in readings:
        load._take(one)
        [interface] = load.latest["network"].values()
        usage = load.latest["system_cpu_usage"]["cpu"]
        seen.append((load.samples[-1]["cpu_usage"], usage, interface["bandwidth"]))
    assert seen == [(0.0, 0.0, 0.0), (25.0, 25.0, 2000.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    assert load.uptime == 9.0


def test_a_computer_that_tells_nothing(tmp_path: Path) -> None:
    reading = read_host(tmp_path, tmp_path / "temp")
    assert (reading.rss, reading.uptime, reading.temperature) == (None, None, None)
    assert (reading.processors, reading.network, reading.memory) == ({}, {}, {})
    info = describe_host(tmp_path)["cpu_info"]
    assert (info["cpu_desc"], info["total_memory"], info["memory_units"]) == ("", None, "")


def test_what_a_small_board_tells(tmp_path: Path) -> None:
    files = {
        "cpuinfo": "processor\t: 0\nmodel name\t: ARMv7 rev 4\nHardware\t: BCM2835\nModel\t\t: Pi 3\n",
        "meminfo": "MemTotal: 945364 kB\nMemFree: 10 kB\nMemAvailable: 845364 kB\n",
        "stat": "cpu  10 1 5 80 4 0 0 0 3 0\ncpu0 10 1 5 80 4 0 0 0 3 0\nintr 1 2\n",
        "uptime": "12.50 20.0\n",
        "self/statm": "100 10 5 1 0 50 0\n",
        "net/dev": "Inter-| Receive\n face |bytes\nwlan0: 1 2 3 4 0 0 0 0 5 6 7 8 0 0 0 0\n broken: 1\n",
        "temp": "-1500\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    reading = read_host(tmp_path, tmp_path / "temp")
    assert reading.processors == {"cpu": (16, 100), "cpu0": (16, 100)}
    assert reading.memory == {"total": 945364, "available": 845364, "used": 100000}
    assert reading.network == {
        "wlan0": {
            "rx_bytes": 1, "tx_bytes": 5, "rx_packets": 2, "tx_packets": 6,
            "rx_errs": 3, "tx_errs": 7, "rx_drop": 4, "tx_drop": 8,
        }
    }  # fmt: skip
    assert (reading.uptime, reading.temperature) == (12.5, -1.5)
    assert reading.rss == 10 * os.sysconf("SC_PAGE_SIZE") // 1024
    info = describe_host(tmp_path)["cpu_info"]
    assert (info["cpu_desc"], info["hardware_desc"], info["model"]) == ("ARMv7 rev 4", "BCM2835", "Pi 3")
