"""A real server with a simulated core, and what its clients see and do."""

import asyncio
import contextlib
import itertools
import json
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from moonraker_api import MoonrakerClient, MoonrakerListener
from tests.dialects.moonraker.live import config, machine, site, until, write_files
from tests.dialects.moonraker.serving import Client, Site
from tests.harness import Port, Server

from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.printer import PrinterMethods, ScriptParams
from toolpost.dialects.moonraker.rpc import NoParams, Order
from toolpost.sim.options import SparkOptions

LONG = [f"G1 X{x}" for x in range(400)]
FILES = {"a.gcode": ["; a comment", *LONG[:60]], "long.gcode": LONG, "bad.gcode": ["?pos"]}
PRINT = {"print_stats": None, "virtual_sdcard": None, "display_status": ["progress"]}


class Bench:
    """A server with one core."""

    def __init__(self, port: Port, server: Server) -> None:
        self.port = port
        self.server = server
        self.site = site(server)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("printer")
    link = folder / "core"
    with Port(SparkOptions(command_time=0.01, hold_off=0.02), link=link) as port:
        write_files(folder / "data", FILES)
        with Server(folder, config(machine("edm", str(link)))) as server:
            yield Bench(port, server)


class Screen:
    """A client that shows the printer: what it was told, put together as clients do."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.status: dict[str, dict[str, Any]] = {}
        self.updates: list[tuple[float, dict[str, Any]]] = []
        self.told: list[tuple[str, Any]] = []
        self.states: list[str] = []
        self._answers: dict[int, asyncio.Future[Any]] = {}

    async def listen(self) -> None:
        async for text in self.client.ws:
            message = json.loads(text)
            if "id" in message:
                self._answers.pop(message["id"]).set_result(message.get("result", message.get("error")))
            elif message["method"] == "notify_status_update":
                update, eventtime = message["params"]
                self.updates.append((eventtime, update))
                self._merge(update)
            else:
                self.told.append((message["method"], message.get("params")))

    async def call(self, method: str, /, **params: Any) -> Any:
        number = len(self._answers) + int(time.monotonic_ns())
        self._answers[number] = answer = asyncio.get_running_loop().create_future()
        await self.client.send(
            json.dumps({"jsonrpc": "2.0", "method": method, "params": params, "id": number})
        )
        return await asyncio.wait_for(answer, 5)

    async def subscribe(self, objects: dict[str, Any]) -> None:
        self.status = {}
        answer = await self.call("printer.objects.subscribe", objects=objects)
        self._merge(answer["status"])

    def _merge(self, update: dict[str, Any]) -> None:
        for name, fields in update.items():
            self.status.setdefault(name, {}).update(fields)
        state = self.status.get("print_stats", {}).get("state")
        if state is not None and self.states[-1:] != [state]:
            self.states.append(state)

    async def state(self, state: str) -> None:
        await until(lambda: self.states[-1:] == [state])

    def responses(self) -> list[str]:
        return [params[0] for method, params in self.told if method == "notify_gcode_response"]


@contextlib.asynccontextmanager
async def screen(where: Site) -> AsyncIterator[Screen]:
    async with where.client() as client:
        shown = Screen(client)
        task = asyncio.create_task(shown.listen())
        try:
            yield shown
        finally:
            task.cancel()
            await asyncio.wait([task])
            if not task.cancelled():
                task.result()


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(test())


async def free(where: Site) -> None:
    """Waits until a job could start at once, and forgets the last one."""
    async with asyncio.timeout(10):
        while True:
            status = (await where.http("GET", "/printer/objects/query?idle_timeout&webhooks")).json["result"][
                "status"
            ]
            if (status["idle_timeout"]["state"], status["webhooks"]["state"]) == ("Ready", "ready"):
                break
            await asyncio.sleep(0.01)
    answer = await where.http("POST", "/printer/gcode/script?script=SDCARD_RESET_FILE")
    assert answer.json == {"result": "ok"}


def test_a_queued_job_from_standby_to_complete(bench: Bench):
    async def test() -> None:
        await free(bench.site)
        async with screen(bench.site) as shown:
            await shown.subscribe(PRINT)
            assert shown.status["print_stats"]["state"] == "standby"
            await shown.call("server.job_queue.post_job", filenames=["a.gcode"])
            await shown.call("server.job_queue.start")
            await shown.state("complete")
            assert shown.states == ["standby", "printing", "complete"]
            shares = [u["display_status"]["progress"] for _, u in shown.updates if "display_status" in u]
            assert shares == sorted(shares)
            assert shares[-1] == 1.0
            assert any(0 < share < 1 for share in shares)
            card = shown.status["virtual_sdcard"]
            assert card["file_position"] == card["file_size"] == len("\n".join([*FILES["a.gcode"], ""]))
            assert shown.status["print_stats"]["filename"] == "a.gcode"
            assert 0.3 < shown.status["print_stats"]["print_duration"] < 5
            times = [at for at, _ in shown.updates]
            assert all(b - a >= 0.24 for a, b in itertools.pairwise(times))
            assert "notify_history_changed" in [method for method, _ in shown.told]

    run(test)


def test_start_and_cancel(bench: Bench):
    async def test() -> None:
        await free(bench.site)
        async with screen(bench.site) as shown:
            await shown.subscribe(PRINT)
            assert await shown.call("printer.print.start", filename="long.gcode") == "ok"
            await shown.state("printing")
            refused = await shown.call("printer.print.start", filename="a.gcode")
            assert refused == {"code": 400, "message": "a job has not ended"}
            refused = await shown.call("printer.gcode.script", script="G1 X1")
            assert refused["code"] == 400
            assert "a job has not ended" in refused["message"]
            assert await shown.call("printer.gcode.script", script="?pos") == "ok"
            assert await shown.call("printer.print.cancel") == "ok"
            await shown.state("cancelled")
            assert shown.status["virtual_sdcard"]["is_active"] is False
            assert shown.status["print_stats"]["message"] == ""
            assert shown.status["virtual_sdcard"]["progress"] == 0.0
        assert bench.port.core.queue_length == 0

    run(test)


@pytest.mark.parametrize("call", ["printer.emergency_stop", "script"])
def test_an_emergency_stop_overtakes_everything(bench: Bench, call: str):
    async def test() -> None:
        await free(bench.site)
        async with screen(bench.site) as shown:
            await shown.subscribe(PRINT)
            await shown.call("printer.print.start", filename="long.gcode")
            await shown.state("printing")
            if call == "script":
                stopped = await shown.call("printer.gcode.script", script="G1 X1\n\x07\nm112 ; now")
            else:
                waits = [asyncio.create_task(shown.call("server.files.list")) for _ in range(20)]
                stopped = await shown.call(call)
                await asyncio.gather(*waits)
            assert stopped == "ok"
            assert bench.port.core.queue_length == 0
            await shown.state("cancelled")

    run(test)


@pytest.mark.parametrize("script", ["", "!", "G1 X1\nCANCEL_PRINT"])
def test_the_machine_is_stopped_before_anything_is_awaited(script: str):
    class Shop:
        stopped = False

        def is_stop(self, machine: str, text: str) -> bool:
            assert machine == "edm"
            return text == "!"

        async def cancel(self, machine: str, actor: str) -> None:
            self.stopped = (machine, actor) == ("edm", "me")
            await asyncio.sleep(0)

    shop: Any = Shop()
    methods = PrinterMethods(shop, "edm", Connections(), lambda: None)
    me = Connection("http", "me")
    call = methods.script(ScriptParams(script), me) if script else methods.stop(NoParams(), me)
    call.send(None)
    assert shop.stopped
    with pytest.raises(StopIteration):
        call.send(None)
    urgent = {method.name for method in methods.methods() if method.order is Order.URGENT}
    assert urgent == {"printer.emergency_stop", "printer.print.cancel", "printer.gcode.script"}


def test_what_cannot_be_started(bench: Bench):
    async def test() -> None:
        await free(bench.site)
        http = bench.site.http
        missing = await http("POST", "/printer/print/start?filename=nope.gcode")
        assert (missing.status, missing.json["error"]["message"]) == (
            400,
            "G-Code File nope.gcode does not exist",
        )
        for name in ("../a.gcode", "bad.gcode", ""):
            assert (await http("POST", f"/printer/print/start?filename={name}")).status == 400
        assert (await http("POST", "/printer/print/start")).json["error"] == {
            "code": 400,
            "message": "No data for argument: filename",
        }
        queue = (await http("GET", "/server/job_queue/status")).json["result"]
        assert queue["queued_jobs"] == []

    run(test)


def test_what_no_machine_can_does_not_exist(bench: Bench):
    async def test() -> None:
        async with bench.site.client() as client:
            for method in ("print.pause", "print.resume", "restart", "firmware_restart"):
                assert (await client.call(f"printer.{method}"))["message"] == "Method not found"
            assert await client.call("printer.gcode.help") == {}
        assert (await bench.site.http("POST", "/printer/print/pause")).status == 404

    run(test)


def test_scripts(bench: Bench):
    async def test() -> None:
        await free(bench.site)
        async with screen(bench.site) as shown:
            await shown.subscribe({"toolhead": ["position"], "gcode_move": ["gcode_position"]})
            assert await shown.call("printer.gcode.script", script="G1 X7 ; there\n\nG1 Y8") == "ok"
            await free(bench.site)
            assert await shown.call("printer.gcode.script", script="?pos") == "ok"
            await until(lambda: shown.status["toolhead"]["position"][:2] == [7, 8])
            assert shown.status["gcode_move"]["gcode_position"][:2] == [7, 8]

            before = bench.port.core.executed
            refused = await shown.call("printer.gcode.script", script="G1 X1\nG1 X\u20ac")
            assert refused["code"] == 400
            assert "must be printable ASCII" in refused["message"]
            for macro in ("SAVE_GCODE_STATE NAME=a\nG91\nG1 X10", "G1 X1\n_CLIENT_LINEAR_MOVE X=10"):
                refused = await shown.call("printer.gcode.script", script=macro)
                assert refused["code"] == 400
                assert "nothing was sent" in refused["message"]
            refused = await shown.call("printer.gcode.script", script="G1 X1\n" * 1001)
            assert refused["code"] == 400
            assert (await shown.call("printer.gcode.script"))["message"] == "No data for argument: script"
            await free(bench.site)
            assert bench.port.core.executed == before

            bench.port.say(b'error < msg:"no such axis" src:"G1 Q1" >\r\n')
            await until(lambda: "!! no such axis: G1 Q1" in shown.responses())

    run(test)


def test_two_connections_and_silence(bench: Bench):
    async def test() -> None:
        await free(bench.site)
        async with screen(bench.site) as one, screen(bench.site) as two, screen(bench.site) as none:
            await one.subscribe({"print_stats": ["total_duration"]})
            await one.subscribe({"print_stats": ["state", "filename"], "nope": None})
            await two.subscribe(dict.fromkeys((await two.call("printer.objects.list"))["objects"]))
            await none.subscribe(PRINT)
            await none.subscribe({})
            assert one.status == {"print_stats": {"state": "standby", "filename": ""}, "nope": {}}
            await asyncio.sleep(0.6)
            assert one.updates == two.updates == none.updates == []

            await two.call("printer.print.start", filename="a.gcode")
            await one.state("complete")
            await two.state("complete")
            assert [update for _, update in one.updates] == [
                {"print_stats": {"state": "printing", "filename": "a.gcode"}},
                {"print_stats": {"state": "complete"}},
            ]
            assert len(two.updates) >= 3
            assert {"sysload", "cputime", "memavail"} <= two.status["system_stats"].keys()
            assert none.updates == []
            await asyncio.sleep(0.3)
            count = len(two.updates)
            await asyncio.sleep(0.4)
            assert len(two.updates) == count

    run(test)


def test_http(bench: Bench):
    async def test() -> None:
        http = bench.site.http
        objects = (await http("GET", "/printer/objects/list")).json["result"]["objects"]
        assert {"webhooks", "print_stats", "toolhead", "configfile"} <= set(objects)
        found = (
            await http("GET", "/printer/objects/query?webhooks&print_stats=filename,state&toolhead=nope")
        ).json["result"]
        assert found["eventtime"] > 0
        assert found["status"]["webhooks"] == {"state": "ready", "state_message": "Printer is ready"}
        assert found["status"]["print_stats"].keys() == {"filename", "state"}
        assert found["status"]["toolhead"] == {"nope": None}
        body = json.dumps({"objects": {"webhooks": ["state"]}}).encode()
        found = await http("POST", "/printer/objects/query", body, {"Content-Type": "application/json"})
        assert found.json["result"]["status"] == {"webhooks": {"state": "ready"}}
        for query in ("", "?print_stats:int=5"):
            assert (await http("GET", f"/printer/objects/query{query}")).status == 400

        await free(bench.site)
        async with screen(bench.site) as shown:
            number = (await shown.call("server.websocket.id"))["websocket_id"]
            path = "/printer/objects/subscribe"
            assert (await http("POST", f"{path}?print_stats")).status == 400
            assert (await http("POST", f"{path}?connection_id=99999&print_stats")).status == 400
            answer = await http("POST", f"{path}?connection_id={number}&print_stats=state")
            assert answer.json["result"]["status"] == {"print_stats": {"state": "standby"}}
            await shown.call("printer.print.start", filename="a.gcode")
            await shown.state("complete")

    run(test)


class Listener(MoonrakerListener):
    def __init__(self) -> None:
        self.updates: list[dict[str, Any]] = []

    async def on_notification(self, method: str, data: Any) -> None:
        if method == "notify_status_update":
            self.updates.append(data[0])


@pytest.mark.filterwarnings("ignore:float parameter 'receive_timeout':DeprecationWarning")
def test_through_moonraker_api(bench: Bench):
    async def test() -> None:
        await free(bench.site)
        listener = Listener()
        async with aiohttp.ClientSession() as session:
            loop = asyncio.get_running_loop()
            client = MoonrakerClient(listener, "127.0.0.1", bench.site.port, session=session, loop=loop)
            assert await client.connect()
            assert "print_stats" in await client.get_supported_modules()
            wanted = {"objects": {"print_stats": ["state"]}}
            answer = await client.call_method("printer.objects.subscribe", **wanted)
            assert answer["status"] == {"print_stats": {"state": "standby"}}
            assert await client.call_method("printer.print.start", filename="a.gcode") == "ok"
            await until(lambda: {"print_stats": {"state": "complete"}} in listener.updates)
            await client.disconnect()

    run(test)


def test_a_pulled_cable(bench: Bench):
    async def test() -> None:
        await free(bench.site)
        async with screen(bench.site) as shown:
            await shown.subscribe({**PRINT, "webhooks": None})
            await shown.call("printer.print.start", filename="long.gcode")
            await shown.state("printing")
            bench.port.inject("unplug:0.6")
            await shown.state("error")
            assert shown.status["print_stats"]["message"]
            await until(lambda: shown.status["webhooks"]["state"] == "error")
            refused = await shown.call("printer.gcode.script", script="G1 X1")
            assert "the machine does not answer" in refused["message"]
            refused = await shown.call("printer.print.start", filename="a.gcode")
            assert refused == {"code": 400, "message": "the machine does not answer"}
            await until(lambda: shown.status["webhooks"]["state"] == "ready")
            history = await shown.call("server.history.list", limit=1)
            assert history["jobs"][0]["status"] == "klippy_disconnect"

    run(test)


def test_a_restart_in_the_middle_of_a_job(tmp_path: Path):
    write_files(tmp_path / "data", FILES)
    with Server(tmp_path, config(machine("edm", command_time=0.05))) as server:

        async def begin() -> None:
            where = site(server)
            await free(where)
            async with screen(where) as shown:
                await shown.subscribe(PRINT)
                await shown.call("printer.print.start", filename="long.gcode")
                await shown.state("printing")

        async def go_on() -> None:
            where = site(server)
            async with screen(where) as shown:
                await shown.subscribe(PRINT)
                assert shown.states == ["error"]
                assert shown.status["print_stats"]["filename"] == "long.gcode"
                assert shown.status["print_stats"]["message"] == "host-restarted"
                jobs = (await shown.call("server.history.list"))["jobs"]
                assert [(job["status"], job["end_time"]) for job in jobs] == [("in_progress", None)]
                await shown.call("printer.print.cancel")
                await shown.state("cancelled")

        run(begin)
        server.kill()
        server.start()
        run(go_on)
