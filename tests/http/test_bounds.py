"""No client, however slow, large or many, costs more than a bounded amount (`toolpost.http`)."""

import asyncio
import contextlib
import http.client
import socket
import threading
import time
from pathlib import Path

import pytest
from tests.harness import Client, Server, raw_connection, wait_until

from toolpost.config import Address
from toolpost.dialects.spooler.routes import MAX_QUERY_BODY, SMALL
from toolpost.http import body
from toolpost.http import server as listening
from toolpost.http.answer import send_text
from toolpost.http.body import BodyBusyError, BodyReader, BodyTooLargeError, ClientGoneError
from toolpost.http.server import BoundedProtocol, Listener

LIMIT = 2**20
CONFIG = f"""
[server]
listen = "127.0.0.1:0"
max_body_bytes = {LIMIT}
max_connections = 40
[machines.edm]
driver = "spark"
link = "sim"
"""
POST = b"POST /status HTTP/1.1\r\nHost: localhost\r\n"


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with Server(tmp_path_factory.mktemp("bounds"), CONFIG) as started:
        yield started


def read_all(connection: socket.socket) -> bytes:
    """What comes until the other end closes."""
    data = b""
    with contextlib.suppress(ConnectionError):
        while chunk := connection.recv(65536):
            data += chunk
    return data


def read_answer(connection: socket.socket) -> tuple[int, bytes]:
    """Status and body of the next answer."""
    with http.client.HTTPResponse(connection) as response:
        response.begin()
        return response.status, response.read()


def resident(pid: int) -> int:
    """Bytes of memory that a process holds."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096


# A server as it runs


@pytest.mark.parametrize(
    "head",
    [
        POST + b"X-Long: " + b"x" * 40_000 + b"\r\n\r\n",
        POST + b"".join(b"X-%d: y\r\n" % number for number in range(4000)) + b"\r\n",
        b"POST /" + b"x" * 40_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        POST + b"X-Endless: " + b"x" * 1_000_000,
    ],
    ids=["one header", "many headers", "path", "no end"],
)
def test_head_that_is_too_long_ends_the_connection(server, head):
    with raw_connection(server) as connection:
        with contextlib.suppress(ConnectionError):
            connection.sendall(head)
        assert read_all(connection)[:12] in {b"HTTP/1.1 400", b""}
    assert server.client.post("/status", {}).status == 200


def test_head_of_a_later_request_is_bounded_too(server):
    with raw_connection(server) as connection:
        connection.sendall(POST + b"Content-Length: 2\r\n\r\n{}")
        assert read_answer(connection)[0] == 200
        with contextlib.suppress(ConnectionError):
            connection.sendall(POST + b"X-Endless: " + b"x" * 100_000)
        assert read_all(connection)[:12] in {b"HTTP/1.1 400", b""}


@pytest.mark.parametrize(
    "request_",
    [
        b"\x16\x03\x01\x02\x00\x01\x00",
        b"GET / HTTP/9.9\r\n\r\n",
        POST + b"Content-Length: -1\r\n\r\n",
        POST + b"Content-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\n{}",
        POST + b"Content-Length: 2\r\nContent-Length: 3\r\n\r\n{}",
        b"POST /status HTTP/1.1\r\nHost : localhost\r\n\r\n",
        b"POST /st\x00atus HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"POST /status HTTP/1.1\r\nHost: loc\x00alhost\r\n\r\n",
        b"\r\n" * 50_000,
    ],
)
def test_what_is_no_http_is_refused(server, request_):
    """CVE-2025-48879: a broken request must not take the server with it."""
    with raw_connection(server) as connection:
        with contextlib.suppress(ConnectionError):
            connection.sendall(request_)
            connection.shutdown(socket.SHUT_WR)
        assert b" 200 " not in read_all(connection)[:20]
    assert server.client.post("/status", {}).status == 200


@pytest.mark.parametrize(
    ("endpoint", "limit"),
    [
        ("/status", SMALL),
        ("/write-line", SMALL),
        ("/query-ts", min(LIMIT, MAX_QUERY_BODY)),
        ("/add-job", LIMIT),
    ],
)
def test_body_beyond_the_limit(server, endpoint, limit):
    blank = b"{" + b" " * (limit - 2) + b"}"
    assert server.client.post(endpoint, blank).status == (200 if endpoint == "/status" else 400)
    answer = Client(server.urls[0])
    try:
        got = answer.post(endpoint, blank + b" ")
        assert (got.status, got.text) == (400, f"invalid request: the body must be at most {limit} bytes")
    finally:
        answer.close()


def test_chunked_body_beyond_the_limit(server):
    with raw_connection(server) as connection:
        connection.sendall(POST + b"Transfer-Encoding: chunked\r\n\r\n")
        with contextlib.suppress(ConnectionError):
            for _ in range(40):
                connection.sendall(b"8000\r\n" + b" " * 0x8000 + b"\r\n")
        status, text = read_answer(connection)
    assert (status, b"must be at most" in text) == (400, True)


def test_length_that_is_only_claimed_costs_nothing(server):
    before = resident(server.pid)
    with contextlib.ExitStack() as stack:
        for _ in range(20):
            connection = stack.enter_context(raw_connection(server))
            connection.sendall(POST + b"Content-Length: 9000000000000000000\r\n\r\n{")
        assert server.client.post("/status", {}).status == 200
        assert resident(server.pid) - before < 10 * 2**20


def test_many_large_bodies_at_once(server):
    """Those beyond the room for bodies are told to try again; small requests go on."""
    add_job = POST.replace(b"/status", b"/add-job")
    part = b"{" + b" " * (LIMIT - 1000)
    before = resident(server.pid)
    with contextlib.ExitStack() as stack:
        connections = [stack.enter_context(raw_connection(server)) for _ in range(20)]
        for connection in connections:
            connection.sendall(add_job + b"Content-Length: %d\r\n\r\n" % (len(part) + 1))
            with contextlib.suppress(ConnectionError):
                connection.sendall(part)
        began = time.monotonic()
        assert server.client.post("/status", {}).status == 200
        assert time.monotonic() - began < 1
        assert resident(server.pid) - before < 40 * 2**20
        for connection in connections:
            with contextlib.suppress(ConnectionError):
                connection.sendall(b"}")
        answers = [read_answer(connection) for connection in connections]
    statuses = [status for status, _ in answers]
    assert set(statuses) == {400, 500}, "the first ones have room, and are read: there are no commands"
    assert all(b"too many large requests" in text for status, text in answers if status == 500)
    assert server.client.post("/add-job", b"{" + b" " * (LIMIT - 2) + b"}").status == 400, (
        "the room is free again"
    )


def test_more_connections_than_allowed(server):
    with contextlib.ExitStack() as stack:
        connections = [stack.enter_context(raw_connection(server)) for _ in range(60)]
        for connection in connections:
            with contextlib.suppress(ConnectionError):
                connection.sendall(POST + b"Content-Length: 2\r\n\r\n{}")
        heads = []
        for connection in connections:
            with contextlib.suppress(ConnectionError):
                heads.append(connection.recv(4096)[:12])
        assert set(heads) <= {b"HTTP/1.1 200", b"HTTP/1.1 503", b""}
        assert len(heads) < 60 or b"" in heads, "those beyond the limit are not kept"
    wait_until(lambda: server.client.post("/status", {}).status == 200)


def test_client_that_goes_away_in_mid_request(server):
    for data in (POST, POST + b"Content-Length: 100\r\n\r\n{", POST + b"Content-Length: 2\r\n\r\n{}"):
        for _ in range(10):
            with raw_connection(server) as connection:
                connection.sendall(data)
    assert server.client.post("/status", {}).status == 200
    assert "ERROR" not in server.log
    assert "Traceback" not in server.log


def test_requests_of_many_clients_at_once(server):
    """Every one is answered, each with its own answer."""
    failures = []

    def client() -> None:
        one = Client(server.urls[0])
        try:
            for _ in range(50):
                answer = one.call("/query-ts", query=["a.b"], start=0, end=100, step=1)
                if len(answer["times"]) != 101:
                    failures.append(answer)
        finally:
            one.close()

    threads = [threading.Thread(target=client) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []


# The listener alone, with shorter times


@contextlib.asynccontextmanager
async def listener_on(app):
    listener = Listener(Address("127.0.0.1", 0), app, 100)
    await listener.open()
    try:
        host, port = listener.url.removeprefix("http://").split(":")
        yield host, int(port)
    finally:
        await listener.close()
        listener.release()


async def answer_ok(_scope, _receive, send):
    await send_text(send, 200, "ok")


async def seconds_until_closed(reader: asyncio.StreamReader) -> float:
    began = time.monotonic()
    async with asyncio.timeout(5):
        with contextlib.suppress(ConnectionError):
            while await reader.read(65536):
                pass
    return time.monotonic() - began


@pytest.mark.parametrize("first", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: localhost\r\nX-"])
@pytest.mark.parametrize("after_a_request", [False, True])
def test_slow_loris(monkeypatch, first, after_a_request):
    """A head that comes byte by byte, or not at all, ends the connection."""
    monkeypatch.setattr(listening, "HEAD_TIMEOUT", 0.2)

    async def run() -> None:
        async with listener_on(answer_ok) as address:
            reader, writer = await asyncio.open_connection(*address)
            if after_a_request:
                writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
                await reader.readuntil(b"ok")
            writer.write(first)

            async def drip() -> None:
                with contextlib.suppress(ConnectionError):
                    while first:
                        writer.write(b"x")
                        await writer.drain()
                        await asyncio.sleep(0.01)

            dripping = asyncio.create_task(drip())
            if first or not after_a_request:
                assert await seconds_until_closed(reader) < 2
            dripping.cancel()
            writer.close()
            await asyncio.gather(dripping, writer.wait_closed(), return_exceptions=True)

    asyncio.run(run())


def test_body_that_does_not_come_is_given_up(monkeypatch):
    monkeypatch.setattr(body, "READ_TIMEOUT", 0.1)

    async def app(_scope, receive, send):
        try:
            await BodyReader(1000, 2000).read(receive)
        except ClientGoneError as error:
            await send_text(send, 400, str(error))

    async def run() -> bytes:
        async with listener_on(app) as address:
            reader, writer = await asyncio.open_connection(*address)
            writer.write(POST + b"Content-Length: 10\r\n\r\n{")
            answer = await reader.readuntil(b"come")
            writer.close()
            await writer.wait_closed()
            return answer

    assert asyncio.run(run()).startswith(b"HTTP/1.1 400")


async def send_megabytes(_scope, _receive, send):
    await send(
        {"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % (50 * 2**20))]}
    )
    for number in range(50):
        await send({"type": "http.response.body", "body": bytes(2**20), "more_body": number < 49})


def test_client_that_never_reads_its_answer(monkeypatch):
    monkeypatch.setattr(listening, "STALL_TIMEOUT", 0.2)

    async def run() -> None:
        async with listener_on(send_megabytes) as address:
            connection = socket.create_connection(address)
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            async with asyncio.timeout(5):
                while not BoundedProtocol.unread:
                    await asyncio.sleep(0.01)
                while BoundedProtocol.unread:
                    await asyncio.sleep(0.01)
            connection.settimeout(5)
            assert len(await asyncio.to_thread(read_all, connection)) < 50 * 2**20
            connection.close()

    asyncio.run(run())


def test_clients_that_together_leave_too_much_unread(monkeypatch):
    monkeypatch.setattr(listening, "MAX_UNREAD", 3 * 2**20)

    async def run() -> None:
        async with listener_on(send_megabytes) as address:
            connections = [socket.create_connection(address) for _ in range(20)]
            for connection in connections:
                connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            await asyncio.sleep(0.5)
            assert 0 < BoundedProtocol.unread <= 3 * 2**20
            reader, writer = await asyncio.open_connection(*address)
            writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            async with asyncio.timeout(5):
                await reader.readuntil(b"200 OK")
            writer.close()
            await asyncio.gather(writer.wait_closed(), return_exceptions=True)
            for connection in connections:
                connection.close()
            async with asyncio.timeout(5):
                while BoundedProtocol.unread:
                    await asyncio.sleep(0.01)

    asyncio.run(run())


# Reading bodies


def receive_of(*messages):
    queue = list(messages)

    async def receive():
        return queue.pop(0)

    return receive


def part(data: bytes, *, more: bool = False) -> dict:
    return {"type": "http.request", "body": data, "more_body": more}


def test_body_is_put_together():
    reader = BodyReader(10, 20)
    assert asyncio.run(reader.read(receive_of(part(b"12")))) == b"12"
    parts = receive_of(part(b"12", more=True), part(b"", more=True), part(b"34"))
    assert asyncio.run(reader.read(parts)) == b"1234"
    assert asyncio.run(reader.read(receive_of({"type": "http.request"}))) == b""


@pytest.mark.parametrize(
    ("messages", "error"),
    [
        ([part(b"x" * 11)], BodyTooLargeError),
        ([part(b"x" * 6, more=True), part(b"x" * 5)], BodyTooLargeError),
        ([part(b"x", more=True), {"type": "http.disconnect"}], ClientGoneError),
        ([{"type": "http.disconnect"}], ClientGoneError),
    ],
)
def test_room_for_bodies_is_given_back(messages, error):
    reader = BodyReader(10, 10)
    for _ in range(5):
        with pytest.raises(error):
            asyncio.run(reader.read(receive_of(*messages)))
    whole = receive_of(part(b"12345", more=True), part(b"67890"))
    assert asyncio.run(reader.read(whole)) == b"1234567890"


def test_room_for_bodies_is_shared():
    async def run() -> None:
        reader = BodyReader(10, 15)
        gate = asyncio.Event()

        async def slow():
            if not gate.is_set():
                await gate.wait()
                return part(b"")
            return part(b"")

        first = iter([part(b"x" * 10, more=True)])

        async def receive():
            return next(first, None) or await slow()

        holding = asyncio.create_task(reader.read(receive))
        await asyncio.sleep(0)
        with pytest.raises(BodyBusyError):
            await reader.read(receive_of(part(b"x", more=True), part(b"x" * 6)))
        gate.set()
        assert await holding == b"x" * 10
        assert await reader.read(receive_of(part(b"x", more=True), part(b"x" * 6))) == b"x" * 7

    asyncio.run(run())
