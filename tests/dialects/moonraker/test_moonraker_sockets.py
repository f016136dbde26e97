"""Connections that stay: order, bounds, clients that do not read, and the Unix socket."""

import asyncio
import contextlib
import json
import socket
import time
from pathlib import Path
from typing import Any

import pytest
from tests.dialects.moonraker.serving import Client, Service, serving
from websockets.exceptions import ConnectionClosed, InvalidStatus

from toolpost.dialects.moonraker import connections as bounds
from toolpost.dialects.moonraker import session
from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.rpc import Method, Order
from toolpost.dialects.moonraker.unix import UnixListener
from toolpost.errors import StartError


class Gated:
    """Methods that end when they are let, and a note of who began and ended in which order."""

    def __init__(self) -> None:
        self.trace: list[str] = []
        self.gate = asyncio.Event()

    @property
    def methods(self) -> list[Method]:
        return [
            Method("quick", None, dict, self.quick),
            Method("turn", None, dict, self.held),
            Method("beside", None, dict, self.held, order=Order.BESIDE),
            Method("urgent", None, dict, self.quick, order=Order.URGENT),
        ]

    async def quick(self, params: dict[str, Any], _: Connection) -> object:
        self.trace.append(params["name"])
        return params["name"]

    async def held(self, params: dict[str, Any], _: Connection) -> object:
        self.trace.append(f"{params['name']} begins")
        await self.gate.wait()
        self.trace.append(f"{params['name']} ends")
        return params["name"]


async def send(client: Client, method: str, name: Any) -> None:
    request = {"jsonrpc": "2.0", "method": method, "params": {"name": name}, "id": name}
    await client.send(json.dumps(request))


async def answers(client: Client, count: int) -> list[Any]:
    return [(await client.message())["id"] for _ in range(count)]


async def until(true: Any, timeout: float = 5.0) -> None:
    deadline = time.monotonic() + timeout
    while not true():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.002)


def test_calls_of_a_connection_run_in_turn_but_for_those_that_must_not_wait() -> None:
    async def run() -> None:
        gated = Gated()
        async with serving(*gated.methods) as service, service.client() as client, service.client() as other:
            for method, name in (("turn", "a"), ("quick", "b"), ("beside", "c"), ("urgent", "stop")):
                await send(client, method, name)
            assert await answers(client, 1) == ["stop"]
            assert gated.trace == ["a begins", "c begins", "stop"]
            await send(other, "quick", "other")
            assert await answers(other, 1) == ["other"]
            gated.gate.set()
            assert set(await answers(client, 3)) == {"a", "b", "c"}
            assert gated.trace.index("a ends") < gated.trace.index("b")

    asyncio.run(run())


def test_an_urgent_call_in_a_batch_makes_it_urgent() -> None:
    async def run() -> None:
        gated = Gated()
        async with serving(*gated.methods) as service, service.client() as client:
            await send(client, "turn", "a")
            stop = {"jsonrpc": "2.0", "method": "urgent", "params": {"name": "stop"}, "id": 1}
            await client.send(json.dumps([stop]))
            assert (await client.message())[0]["result"] == "stop"
            gated.gate.set()

    asyncio.run(run())


def test_long_calls_are_bounded_but_an_emergency_stop_is_not_refused() -> None:
    async def run() -> None:
        gated = Gated()
        async with serving(*gated.methods) as service, service.client() as client:
            for number in range(session.MAX_BESIDE + 2):
                await send(client, "beside", number)
            refused = [await client.message() for _ in range(2)]
            assert [answer["error"]["code"] for answer in refused] == [429, 429]
            await send(client, "urgent", "stop")
            assert await answers(client, 1) == ["stop"]
            gated.gate.set()
            assert sorted(await answers(client, session.MAX_BESIDE)) == list(range(session.MAX_BESIDE))

    asyncio.run(run())


def test_what_waits_for_its_turn_is_bounded_and_none_of_it_is_lost() -> None:
    async def run() -> None:
        gated = Gated()
        count = 3 * session.MAX_WAITING
        async with serving(*gated.methods) as service, service.client() as client:
            await send(client, "turn", "first")
            for number in range(count):
                await send(client, "quick", number)
            await asyncio.sleep(0.05)
            gated.gate.set()
            assert await answers(client, count + 1) == ["first", *range(count)]

    asyncio.run(run())


def test_what_was_asked_for_is_done_when_the_client_has_gone() -> None:
    async def run() -> None:
        gated = Gated()
        async with serving(*gated.methods) as service:
            async with service.client() as client:
                await send(client, "turn", "a")
                await send(client, "quick", "b")
                await send(client, "beside", "c")
                await until(lambda: "c begins" in gated.trace)
            gated.gate.set()
            await until(lambda: len(service.connections) == 0)
            assert sorted(gated.trace) == ["a begins", "a ends", "b", "c begins", "c ends"]

    asyncio.run(run())


def test_notifications_come_in_order_to_all_and_before_later_answers() -> None:
    async def run() -> None:
        async with serving() as service, contextlib.AsyncExitStack() as stack:
            clients = [await stack.enter_async_context(service.client()) for _ in range(5)]
            for number in range(500):
                service.connections.notify("notify_number", number)
                if number == 250:
                    await asyncio.sleep(0)
            service.connections.notify("notify_klippy_ready")
            for client in clients:
                await client.call("server.websocket.id")
                numbers = [message["params"][0] for message in client.notifications[:-1]]
                assert numbers == list(range(500))
                assert client.notifications[-1] == {"jsonrpc": "2.0", "method": "notify_klippy_ready"}

    asyncio.run(run())


def test_one_connection_can_be_notified_alone_and_tells_its_end() -> None:
    async def run() -> None:
        ended = []
        async with serving() as service, service.client() as other:
            async with service.client() as client:
                number = (await client.call("server.websocket.id"))["websocket_id"]
                connection = next(c for c in service.connections if c.number == number)
                connection.at_close(lambda: ended.append(number))
                connection.notify("notify_status_update", {"toolhead": {}}, 1.5)
                assert (await client.message())["params"] == [{"toolhead": {}}, 1.5]
            await until(lambda: ended == [number])
            connection.notify("notify_status_update", {}, 2.5)
            await other.call("server.websocket.id")
            assert other.notifications == []

    asyncio.run(run())


def test_what_a_client_has_been_shown() -> None:
    async def run() -> None:
        async with serving() as service, service.client() as one, service.client() as other:
            for client in (one, other):
                await client.call("server.websocket.id")
            first, second = service.connections
            assert first.shown_jobs == second.shown_jobs == frozenset()
            service.queue.add(["a.gcode"])
            await one.call("server.job_queue.status")
            assert (first.shown_jobs, len(second.shown_jobs)) == ({service.queue.jobs[0]["job_id"]}, 0)
            await one.call("server.job_queue.post_job", filenames=["b.gcode"])
            await other.message()
            assert first.shown_jobs == second.shown_jobs == {job["job_id"] for job in service.queue.jobs}

    asyncio.run(run())


def test_a_client_is_not_taken_to_have_been_shown_what_waits_to_be_sent() -> None:
    async def run() -> None:
        connections = Connections()
        connection = connections.open("websocket", "someone", "peer")
        assert connection is not None
        written = []
        go = asyncio.Event()

        async def write(text: str) -> None:
            await go.wait()
            written.append((text, connection.shown_jobs))

        pump = asyncio.create_task(connection.pump(write))
        connections.notify("one", shows=frozenset("1"))
        connections.notify("two", shows=frozenset("12"))
        await asyncio.sleep(0.01)
        assert connection.shown_jobs == frozenset()
        go.set()
        await until(lambda: connection.shown_jobs == frozenset("12"))
        assert [shown for _, shown in written] == [frozenset(), frozenset("1")]
        connections.close(connection)
        await pump

    asyncio.run(run())


async def stuck_client(service: Service) -> socket.socket:
    """A client that has opened a WebSocket and never reads."""
    loop = asyncio.get_running_loop()
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.setblocking(False)
    await loop.sock_connect(sock, ("127.0.0.1", service.port))
    await loop.sock_sendall(
        sock,
        b"GET /websocket HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n",
    )
    assert b" 101 " in await loop.sock_recv(sock, 4096)
    return sock


def test_a_stuck_client_is_let_go_and_delays_none_of_two_hundred(caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        async with serving() as service, contextlib.AsyncExitStack() as stack:
            stuck = await stuck_client(service)
            clients = [await stack.enter_async_context(service.client()) for _ in range(200)]
            assert len(service.connections) == 201
            filler = "x" * 20_000
            rounds, slowest = 0, 0.0
            while len(service.connections) == 201 and rounds < 2 * bounds.MAX_MESSAGES:
                # The stuck one's share of it: enough of them that its queue is full in the end.
                for connection in service.connections:
                    if connection.number == 1:
                        for _ in range(100):
                            connection.notify("filler", filler)
                begun = time.perf_counter()
                service.connections.notify("notify_round", rounds)
                for client in clients:
                    assert (await client.message())["params"] == [rounds]
                slowest = max(slowest, time.perf_counter() - begun)
                rounds += 1
            assert len(service.connections) == 200
            assert slowest < 1.0
            # The server has cut it: there is an end, and no waiting for it to read.
            with pytest.raises(OSError):  # noqa: PT012  # either ends it
                while await asyncio.wait_for(asyncio.get_running_loop().sock_recv(stuck, 1 << 20), 5):
                    pass
                raise ConnectionResetError
            stuck.close()
            assert service.port

    asyncio.run(run())
    lines = [record.getMessage() for record in caplog.records if "disconnected" in record.getMessage()]
    assert len(lines) == 1
    assert lines[0].startswith("websocket 1 (127.0.0.1:")
    assert "unread" in lines[0]


def test_a_client_that_takes_nothing_for_too_long_is_let_go(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(bounds, "STALL_TIMEOUT", 0.05)

    async def run() -> None:
        async with serving() as service:
            stuck = await stuck_client(service)
            while len(service.connections) == 1:
                service.connections.notify("filler", "x" * 100_000)
                await asyncio.sleep(0.002)
            stuck.close()

    asyncio.run(run())
    assert "has read nothing for 0.05 s; disconnected" in caplog.text


def test_a_client_that_reads_slowly_gets_its_answers_slowly() -> None:
    """A thousand answers of 200 kB each would be 200 MB if all of them were made at once."""

    async def run() -> None:
        made = 0

        async def big(_params: dict[str, Any], _: Connection) -> object:
            nonlocal made
            made += 1
            return "x" * 200_000

        async with serving(Method("big", None, dict, big)) as service:
            stuck = await stuck_client(service)
            frame = b'{"jsonrpc":"2.0","method":"big","id":1}'
            masked = bytes([0x81, 0x80 | len(frame), 0, 0, 0, 0]) + frame
            await asyncio.get_running_loop().sock_sendall(stuck, masked * 200)
            await asyncio.sleep(0.2)
            assert 0 < made < 50
            assert len(service.connections) == 1
            stuck.close()

    asyncio.run(run())


def test_too_many_connections_are_refused(caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        async with serving(limit=2) as service, service.client() as one, service.client():
            with pytest.raises(InvalidStatus):
                async with service.client():
                    pass
            assert await one.call("server.websocket.id") == {"websocket_id": 1}

    asyncio.run(run())
    assert "refused, there are 2 connections" in caplog.text


@pytest.mark.parametrize("size", [(1 << 20) + 1, (2 << 20) + 1])
def test_a_message_that_is_too_long_ends_its_connection(size: int) -> None:
    async def run() -> None:
        async with serving() as service, service.client() as other:
            async with service.client() as client:
                with pytest.raises(ConnectionClosed) as caught:  # noqa: PT012  # whichever notices
                    await client.send(" " * size)
                    await client.message()
                assert caught.value.rcvd is not None
                assert caught.value.rcvd.code == 1009
            assert await other.call("server.websocket.id") == {"websocket_id": 1}
            await until(lambda: len(service.connections) == 1)

    asyncio.run(run())


def test_pings_are_answered_and_binary_frames_are_taken() -> None:
    async def run() -> None:
        async with serving() as service, service.client() as client:
            await asyncio.wait_for(await client.ws.ping(), 5)
            await client.send(b'{"jsonrpc":"2.0","method":"server.websocket.id","id":1}')
            assert (await client.message())["result"] == {"websocket_id": 1}
            await client.send(b"\xff")
            assert (await client.message())["error"]["code"] == -32700

    asyncio.run(run())


def test_the_server_stops_while_clients_are_there() -> None:
    async def run() -> None:
        gated = Gated()
        async with serving(*gated.methods) as service, contextlib.AsyncExitStack() as stack:
            client = await stack.enter_async_context(service.client())
            await send(client, "turn", "a")
            await until(lambda: gated.trace == ["a begins"])
            gated.gate.set()
        assert len(service.connections) == 0

    asyncio.run(run())


# The Unix socket


@contextlib.asynccontextmanager
async def unix(folder: Path, service: Service, max_message: int = 1 << 16):
    listener = UnixListener(folder / "moonraker.sock", service.methods, service.connections, max_message)
    await listener.open()
    try:
        yield folder / "moonraker.sock"
    finally:
        await listener.close()


def test_the_unix_socket(tmp_path: Path) -> None:
    async def run() -> None:
        service = Service()
        async with unix(tmp_path, service) as path:
            assert path.stat().st_mode & 0o777 == 0o600
            reader, writer = await asyncio.open_unix_connection(path)
            call = {"jsonrpc": "2.0", "method": "server.job_queue.post_job"}
            writer.write(b'{"jsonrpc":\x03')
            writer.write(json.dumps({**call, "params": {"filenames": "ümlaut.gcode"}, "id": 7}).encode())
            writer.write(b"\x03")
            messages = [json.loads((await reader.readuntil(b"\x03"))[:-1]) for _ in range(3)]
            assert messages[0]["error"]["code"] == -32700
            assert messages[1]["method"] == "notify_job_queue_changed"
            assert messages[2]["result"]["queued_jobs"][0]["filename"] == "ümlaut.gcode"
            assert [connection.actor[:5] for connection in service.connections] == ["unix:"]
            writer.write(b" " * (1 << 17))
            with contextlib.suppress(OSError):
                assert await reader.read() == b""
            writer.close()
            await until(lambda: len(service.connections) == 0)
            reader, writer = await asyncio.open_unix_connection(path)
            await until(lambda: len(service.connections) == 1)
        with contextlib.suppress(OSError):
            assert await reader.read() == b""
        writer.close()
        assert not path.exists()
        assert len(service.connections) == 0

    asyncio.run(run())


def test_a_stuck_client_of_the_unix_socket_is_let_go(tmp_path: Path) -> None:
    async def run() -> None:
        service = Service()
        async with unix(tmp_path, service) as path:
            stuck, well = socket.socket(socket.AF_UNIX), socket.socket(socket.AF_UNIX)
            for sock in (stuck, well):
                sock.connect(str(path))
            await until(lambda: len(service.connections) == 2)
            well.close()
            await until(lambda: len(service.connections) == 1)
            while len(service.connections) == 1:
                service.connections.notify("filler", "x" * 100_000)
                await asyncio.sleep(0)
            stuck.close()

    asyncio.run(run())


def test_a_unix_socket_that_is_not_to_be_had(tmp_path: Path) -> None:
    async def run() -> None:
        service = Service()
        for folder in (tmp_path / "missing", tmp_path / ("x" * 120)):
            with pytest.raises(StartError, match="cannot listen on"):
                await UnixListener(folder / "s", service.methods, service.connections).open()

    asyncio.run(run())
