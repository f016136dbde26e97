"""The queue as its real clients use it, against a real server and its simulated machine."""

import asyncio
import contextlib
import json
import signal
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from moonraker_api import MoonrakerClient, MoonrakerListener
from tests.dialects.moonraker.live import (
    NOTIFICATION,
    QUEUE,
    Watcher,
    config,
    ids,
    machine,
    names,
    shop_idle,
    site,
    until,
    watching,
    write_files,
)
from tests.dialects.moonraker.serving import Client, Site
from tests.harness import JSON, Server
from tests.harness import toolpost as run_toolpost
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

# The library calls aiohttp in a way that aiohttp has since deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:float parameter 'receive_timeout':DeprecationWarning")

HOLD_OFF = 0.2
MACHINES = [
    machine("edm", command_time=0.02, hold_off=HOLD_OFF, automatic_transition=True),
    machine("mill", command_time=0.02),
    machine("press", command_time=0.02, automatic_transition=True, job_transition_delay=0.3),
    machine("saw", command_time=0.02, automatic_transition=True, job_transition_gcode="G4 P3"),
]
JOB = "server.job_queue"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory):
    """Several machines: edm, mill without automatic transition, press and saw with long transitions."""
    server = Server(tmp_path_factory.mktemp("clients"), config(*MACHINES))
    write_files(server.data)
    with server:
        yield server


async def emptied(where: Site) -> Site:
    """A machine with nothing in its queue, nothing running, and no pause asked for."""
    await where.http("DELETE", f"{QUEUE}/job?all=true")
    if not await shop_idle(where):
        await where.http("POST", "/cancel", b"{}", JSON)
        async with asyncio.timeout(10):
            while not await shop_idle(where):
                await asyncio.sleep(0.01)
        await asyncio.sleep(2 * HOLD_OFF)
    await where.http("POST", f"{QUEUE}/start")
    return where


async def status(where: Site) -> Any:
    return (await where.http("GET", f"{QUEUE}/status")).json["result"]


# moonraker-api, which is what Home Assistant uses.


class Listener(MoonrakerListener):
    def __init__(self) -> None:
        self.watcher = Watcher()
        self.states: list[str] = []
        self.exceptions: list[BaseException | type] = []

    async def state_changed(self, state: str) -> None:
        self.states.append(state)

    async def on_exception(self, exception: type | BaseException) -> None:
        self.exceptions.append(exception)

    async def on_notification(self, method: str, data: Any) -> None:
        if method == NOTIFICATION:
            self.watcher.events += data


@contextlib.asynccontextmanager
async def moonraker_api(where: Site, **options: Any) -> AsyncIterator[tuple[MoonrakerClient, Listener]]:
    listener = Listener()
    async with aiohttp.ClientSession() as session:
        loop = asyncio.get_running_loop()
        client = MoonrakerClient(listener, "127.0.0.1", where.port, session=session, loop=loop, **options)
        assert await client.connect()
        yield client, listener
        await client.disconnect()
        assert listener.exceptions == []


def test_moonraker_api(server: Server) -> None:
    async def run() -> None:
        where = await emptied(site(server))
        async with moonraker_api(where) as (client, listener):
            call = client.call_method
            identity = {"client_name": "test", "version": "1", "type": "bot", "url": "http://test"}
            assert (await call("server.connection.identify", **identity)).keys() == {"connection_id"}
            assert await client.get_klipper_status() == "ready"
            assert "job_queue" in (await client.get_server_info())["components"]
            assert (await client.get_host_info())["hostname"] == socket.gethostname()
            assert await call(f"{JOB}.status") == {"queued_jobs": [], "queue_state": "paused"}

            queue = await call(f"{JOB}.post_job", filenames=["a.gcode", "mid.gcode", "a.gcode", "b.gcode"])
            first, mid, again, last = ids(queue)
            assert names(await call(f"{JOB}.jump", job_id=mid)) == [
                "mid.gcode",
                "a.gcode",
                "a.gcode",
                "b.gcode",
            ]
            assert ids(await call(f"{JOB}.delete_job", job_ids=[first])) == [mid, again, last]
            assert await call(f"{JOB}.jump", job_id=first) == {
                "error": {"code": 400, "message": f"Invalid job id: {first}"}
            }
            assert (await call(f"{JOB}.start"))["queue_state"] in {"loading", "starting"}
            await until(lambda: listener.watcher.count("job_loaded") == 1)
            queue = await call(f"{JOB}.pause")
            assert (queue["queue_state"], ids(queue)) == ("paused", [again, last])
            queue = await call(f"{JOB}.start")
            assert (queue["queue_state"], ids(queue)) == ("ready", [again, last])
            await until(lambda: listener.watcher.count("job_loaded") == 3)
            assert await call(f"{JOB}.delete_job", all=True) == {"queued_jobs": [], "queue_state": "paused"}
            assert listener.watcher.brief == [
                "jobs_added paused [a.gcode mid.gcode a.gcode b.gcode]",
                "state_changed paused [mid.gcode a.gcode a.gcode b.gcode]",
                "jobs_removed paused [mid.gcode a.gcode b.gcode]",
                "state_changed loading",
                "state_changed starting",
                "job_loaded ready [a.gcode b.gcode]",
                "state_changed paused",
                "state_changed ready",
                "state_changed loading",
                "state_changed starting",
                "job_loaded ready [b.gcode]",
                "state_changed loading",
                "state_changed starting",
                "job_loaded paused []",
            ]
            keys = {"action", "updated_queue", "queue_state"}
            assert all(event.keys() == keys for event in listener.watcher.events)

    asyncio.run(run())


def test_moonraker_api_at_one_of_several_machines(server: Server) -> None:
    async def run() -> None:
        edm, mill = await emptied(site(server)), await emptied(site(server, "mill"))
        prefix = "machines/mill"
        async with moonraker_api(mill, route_prefix=prefix) as (client, listener), watching(edm) as other:
            queue = await client.call_method(f"{JOB}.post_job", filenames=["a.gcode"])
            assert names(queue) == ["a.gcode"]
            assert list(map(without_age, (await status(mill))["queued_jobs"])) == [
                without_age(job) for job in queue["queued_jobs"]
            ]
            await until(lambda: listener.watcher.events)
            assert names(await status(edm)) == []
            assert other.events == []

    asyncio.run(run())


# Mainsail and Fluidd: reorder, copies and "start this one" are a repost of the whole list.


def test_reposts_keep_what_is_known_of_the_jobs(server: Server) -> None:
    async def run() -> None:
        where = await emptied(site(server, "mill"))
        async with where.client() as mainsail, watching(where) as watcher:
            posted = await mainsail.call(f"{JOB}.post_job", filenames=["a.gcode", "b.gcode", "mid.gcode"])
            known = {job["job_id"]: job["time_added"] for job in posted["queued_jobs"]}
            a, b, mid = ids(posted)

            async def repost(*filenames: str) -> list[str]:
                queue = await mainsail.call(f"{JOB}.post_job", filenames=list(filenames), reset=True)
                assert names(queue) == list(filenames)
                for job in queue["queued_jobs"]:
                    assert known.setdefault(job["job_id"], job["time_added"]) == job["time_added"]
                return ids(queue)

            assert await repost("mid.gcode", "a.gcode", "b.gcode") == [mid, a, b]
            copies = await repost("mid.gcode", "a.gcode", "a.gcode", "a.gcode", "b.gcode")
            assert [copies[0], copies[1], copies[4]] == [mid, a, b]
            assert await repost("b.gcode", "mid.gcode", "a.gcode", "a.gcode", "a.gcode") == [
                b,
                mid,
                *copies[1:4],
            ]
            assert await repost("b.gcode", "mid.gcode", "a.gcode") == [b, mid, a]
            await until(lambda: len(watcher.events) == 5)
            assert {event["action"] for event in watcher.events} == {"jobs_added"}
            # "Start this one": it is put first, then the queue is started.
            assert await repost("a.gcode", "b.gcode", "mid.gcode") == [a, b, mid]
            await mainsail.call(f"{JOB}.start")
            await until(lambda: watcher.count("job_loaded"))
            assert ids(await status(where)) == [b, mid]
            jobs = (await where.http("POST", "/list-jobs", b"{}", JSON)).json
            assert [job["job_id"] for job in jobs["jobs"] if job["status"] == "RUNNING"] == [a]

    asyncio.run(run())


def test_no_client_removes_a_job_that_it_has_not_been_shown(server: Server) -> None:
    async def run() -> None:
        where = await emptied(site(server, "mill"))
        async with where.client() as one, where.client() as two:
            (mine,) = ids(await one.call(f"{JOB}.post_job", filenames=["a.gcode"]))
            # A client that has just come has been shown nothing ...
            async with where.client() as three:
                queue = await three.call(f"{JOB}.post_job", filenames=["b.gcode"], reset=True)
                assert names(queue) == ["b.gcode", "a.gcode"]
                assert ids(queue)[1] == mine
            # ... while one that has asked may.
            await two.call(f"{JOB}.status")
            assert names(await two.call(f"{JOB}.post_job", filenames=["b.gcode"], reset=True)) == ["b.gcode"]

        async with where.client() as one, where.client() as two:
            await one.call(f"{JOB}.post_job", filenames=["a.gcode", "b.gcode"], reset=True)
            await two.call(f"{JOB}.status")
            # Both change the list that they see, at the same moment, and neither has seen the other's change.
            await asyncio.gather(
                one.call(f"{JOB}.post_job", filenames=["mid.gcode", "a.gcode", "b.gcode"], reset=True),
                two.call(f"{JOB}.post_job", filenames=["tiny.gcode", "a.gcode", "b.gcode"], reset=True),
            )
            left = names(await status(where))
            assert sorted(left) in (
                ["a.gcode", "b.gcode", "mid.gcode", "tiny.gcode"],
                # Whoever came second had been sent the other's change before.
                ["a.gcode", "b.gcode", "mid.gcode"],
                ["a.gcode", "b.gcode", "tiny.gcode"],
            )

    asyncio.run(run())


def test_notifications_are_in_order_and_none_is_lost(server: Server) -> None:
    """Each shows the queue as it was after one change; two clients make 200 of them without waiting."""

    async def run() -> None:
        where = await emptied(site(server, "mill"))
        async with where.client() as first, where.client() as second, watching(where) as watcher:
            post = {"jsonrpc": "2.0", "method": f"{JOB}.post_job", "params": {"filenames": ["a.gcode"]}}

            async def change(client: Client, start: int) -> list[list[str]]:
                for number in range(start, start + 100):
                    await client.send(json.dumps({**post, "id": number}))
                answers = []
                while len(answers) < 100:
                    message = await client.message()
                    if "id" in message:
                        answers.append(message)
                assert [message["id"] for message in answers] == list(range(start, start + 100))
                return [ids(message["result"]) for message in answers]

            await asyncio.gather(change(first, 0), change(second, 1000))
            await until(lambda: len(watcher.events) >= 200)
            final = ids(await status(where))
            assert len(set(final)) == 200
            told = [[job["job_id"] for job in event["updated_queue"]] for event in watcher.events]
            lengths = [len(queue) for queue in told]
            assert lengths == sorted(lengths)
            assert len(told) == 200
            assert all(queue == final[: len(queue)] for queue in told)
            assert told[-1] == final
            await first.call(f"{JOB}.delete_job", all=True)
            await until(lambda: len(watcher.events) == 201)
            assert watcher.events[-1]["updated_queue"] == []

    asyncio.run(run())


def test_a_hundred_clients_and_one_that_does_not_read(server: Server) -> None:
    async def run() -> None:
        where = await emptied(site(server, "mill"))
        loop = asyncio.get_running_loop()
        stuck = socket.create_connection(("127.0.0.1", where.port))
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13"
        head = "GET /machines/mill/websocket HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade"
        stuck.sendall(f"{head}\r\nUpgrade: websocket\r\n{key}\r\n\r\n".encode())
        assert stuck.recv(12) == b"HTTP/1.1 101"
        async with contextlib.AsyncExitStack() as stack:
            watchers = [await stack.enter_async_context(watching(where)) for _ in range(99)]
            client = await stack.enter_async_context(where.client())
            await client.call(f"{JOB}.post_job", filenames=["a.gcode"] * 150)
            slowest = 0.0
            for changes in range(2, 22):
                began = loop.time()
                await client.call(f"{JOB}.jump", job_id=ids(await status(where))[-1])
                async with asyncio.timeout(5):
                    while any(len(watcher.events) < changes for watcher in watchers):
                        await asyncio.sleep(0.001)
                slowest = max(slowest, loop.time() - began)
            assert slowest < 2
            assert all(watcher.events == watchers[0].events for watcher in watchers)
            assert {watcher.count("state_changed") for watcher in watchers} == {20}
        stuck.close()

    asyncio.run(run())


# Start, pause, and what comes between two jobs.


def test_a_start_while_the_machine_holds_off_is_not_forgotten(server: Server) -> None:
    """After a cancel the core takes nothing for a moment; a start then must not wait for ever."""

    async def run() -> None:
        where = await emptied(site(server))
        async with watching(where) as watcher, where.client() as client:
            await client.call(f"{JOB}.post_job", filenames=["long.gcode", "a.gcode"])
            await client.call(f"{JOB}.start")
            await until(lambda: watcher.count("job_loaded") == 1)
            await where.http("POST", "/cancel", b"{}", JSON)
            queue = await client.call(f"{JOB}.start")
            assert (queue["queue_state"], names(queue)) == ("ready", ["a.gcode"])
            await until(lambda: watcher.count("job_loaded") == 2, 3)
            assert watcher.brief[-1] == "job_loaded paused []"

    asyncio.run(run())


@pytest.mark.parametrize("name", ["press", "saw"])
def test_a_pause_between_two_jobs_is_at_once(server: Server, name: str) -> None:
    """1.5: also during the G-code, where the original answered only after its end."""

    async def run() -> None:
        where = await emptied(site(server, name))
        async with watching(where) as watcher, where.client() as client:
            await client.call(f"{JOB}.post_job", filenames=["a.gcode", "b.gcode"])
            await client.call(f"{JOB}.start")
            await until(lambda: watcher.brief.count("state_changed loading") == 2)
            await asyncio.sleep(0.05)
            loop = asyncio.get_running_loop()
            began = loop.time()
            queue = await client.call(f"{JOB}.pause")
            assert loop.time() - began < 0.5
            assert (queue["queue_state"], names(queue)) == ("paused", ["b.gcode"])
            await until(lambda: watcher.brief[-1] == "state_changed paused")
            await asyncio.sleep(0.5)
            assert watcher.brief[-1] == "state_changed paused"
            await client.call(f"{JOB}.start")
            await until(lambda: watcher.count("job_loaded") == 2)

    asyncio.run(run())


# Who is let in.


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"additional_headers": {"Host": "evil.example"}}, 403),
        ({"origin": "https://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"additional_headers": {"X-Api-Key": "wrong"}}, 401),
    ],
)
@pytest.mark.parametrize("prefix", ["", "/machines/mill"])
def test_a_handshake_is_refused(server: Server, options: dict[str, Any], code: int, prefix: str) -> None:
    async def run() -> None:
        url = f"ws://127.0.0.1:{site(server).port}{prefix}/websocket"
        headers = options.get("additional_headers", {})
        if "Host" in headers:
            assert await handshake(site(server).port, f"{prefix}/websocket", headers["Host"]) == code
            return
        with pytest.raises(InvalidStatus) as refused:
            await connect(url, proxy=None, **options)
        assert refused.value.response.status_code == code
        if "origin" in options:
            await (await connect(url, proxy=None, origin="http://localhost:8080")).close()

    asyncio.run(run())


async def handshake(port: int, path: str, host: str) -> int:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    head = [f"GET {path} HTTP/1.1", f"Host: {host}", "Connection: Upgrade", "Upgrade: websocket"]
    head += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13", "", ""]
    writer.write("\r\n".join(head).encode())
    line = await reader.readline()
    writer.close()
    return int(line.split()[1])


def test_other_listeners_ask_for_a_key(tmp_path: Path) -> None:
    text = config(machine("edm")).replace('"127.0.0.1:0"', '["127.0.0.1:0", "0.0.0.0:0"]')
    with Server(tmp_path, text, listeners=2) as server:
        done = run_toolpost("key", "add", "phone", "--data", server.data)
        assert done.returncode == 0, done.stderr
        url = server.urls[1].replace("http://0.0.0.0", "ws://127.0.0.1") + "/websocket"

        async def run() -> None:
            with pytest.raises(InvalidStatus) as refused:
                await connect(url, proxy=None)
            assert refused.value.response.status_code == 401
            keys = {"X-Api-Key": done.stdout.strip()}
            async with connect(url, proxy=None, additional_headers=keys) as ws:
                await ws.send('{"jsonrpc":"2.0","method":"server.job_queue.status","id":1}')
                assert json.loads(await ws.recv())["result"]["queue_state"] == "paused"

        asyncio.run(run())


# Restarts.


def test_the_queue_survives_a_kill(tmp_path: Path) -> None:
    edm = machine("edm", command_time=0.05, automatic_transition=True)
    server = Server(tmp_path, config(edm, machine("mill")))
    write_files(server.data)

    async def fill() -> tuple[Any, Any]:
        edm, mill = site(server), site(server, "mill")
        async with edm.client() as client, watching(edm) as watcher, mill.client() as other:
            await client.call(f"{JOB}.post_job", filenames=["long.gcode", "a.gcode", "b.gcode", "a.gcode"])
            await client.call(f"{JOB}.start")
            await until(lambda: watcher.count("job_loaded"))
            last = ids(await status(edm))[-1]
            queue = await client.call(f"{JOB}.jump", job_id=last)
            assert (ids(queue)[0], queue["queue_state"]) == (last, "ready")
            await other.call(f"{JOB}.post_job", filenames=["b.gcode", "a.gcode"])
            return queue, await other.call(f"{JOB}.post_job", filenames=["a.gcode", "b.gcode"], reset=True)

    async def compare(edm: Any, mill: Any) -> None:
        for before, where in ((edm, site(server)), (mill, site(server, "mill"))):
            after = await status(where)
            assert after["queue_state"] == before["queue_state"]
            assert [without_age(job) for job in after["queued_jobs"]] == [
                without_age(job) for job in before["queued_jobs"]
            ]

    with server:
        edm, mill = asyncio.run(fill())
        for number in (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM):
            server.stop(number)
            server.start()
            asyncio.run(compare(edm, mill))


def without_age(job: dict[str, Any]) -> dict[str, Any]:
    assert job["time_in_queue"] >= 0
    return {key: value for key, value in job.items() if key != "time_in_queue"}


def test_a_load_that_is_killed_leaves_the_queue_paused(tmp_path: Path) -> None:
    """Nothing runs after the restart whose completion `ready` could wait for."""
    server = Server(tmp_path, config(machine("edm", automatic_transition=True, job_transition_delay=20.0)))
    write_files(server.data)

    async def fill() -> None:
        where = site(server)
        async with where.client() as client, watching(where) as watcher:
            await client.call(f"{JOB}.post_job", filenames=["a.gcode", "b.gcode"])
            await client.call(f"{JOB}.start")
            await until(lambda: watcher.brief.count("state_changed loading") == 2)

    async def look() -> None:
        queue = await status(site(server))
        assert (queue["queue_state"], names(queue)) == ("paused", ["b.gcode"])

    with server:
        asyncio.run(fill())
        server.stop(signal.SIGKILL)
        server.start()
        asyncio.run(look())


def test_a_path_that_is_not_there_is_answered_in_json(tmp_path: Path) -> None:
    """Mainsail reads the error's code from the body of a theme that is not there."""
    with Server(tmp_path, config(machine("edm"))) as server:
        for path in ("/server/files/config/.theme/default.json", "/server/nothing", "/machine/nothing"):
            answer = server.client.request("GET", path)
            assert answer.status == 404
            assert answer.json["error"]["code"] == 404
