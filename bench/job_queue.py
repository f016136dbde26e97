"""The job queue over Moonraker's API: its rate, what a change costs, and how soon the next job starts."""

import asyncio
import functools
import multiprocessing
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
from websockets.asyncio.client import ClientConnection, connect

from bench.result import Result, at_least, at_most, percentile
from bench.rig import start_server, stop_server
from toolpost.sim.options import SparkOptions
from toolpost.sim.ports import PtyPort
from toolpost.sim.spark import SparkCore

_QUEUE = "/server/job_queue"
_TRANSITION_DELAY = 0.01
_CONFIG = f"""
[server]
listen = "127.0.0.1:0"
[machines.edm]
driver = "spark"
link = "{{link}}"
[machines.edm.queue]
automatic_transition = true
job_transition_delay = {_TRANSITION_DELAY}
[machines.edm.history]
shown = 100
"""
_FILES = {
    "part.gcode": b"G0 X1\n",
    "ten.gcode": b"".join(b"G1 X%d\n" % number for number in range(10)),
}


async def measure(scale: float) -> list[Result]:
    """Measure the queue goals; `scale` shortens the runs."""
    seconds = max(1.0, 5.0 * scale)
    return [
        *await status_rates(seconds),
        *await growth(max(20, int(200 * scale))),
        *await starts(max(20, int(200 * scale))),
        *await transitions(max(20, int(100 * scale))),
        *await ten_quick_jobs(),
        *await many_clients(max(20, int(100 * scale))),
    ]


class Http:
    """A keep-alive client for the queue's calls."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    @classmethod
    async def connect(cls, url: str) -> "Http":
        host, _, port = url.removeprefix("http://").partition(":")
        return cls(*await asyncio.open_connection(host, int(port), limit=2**26))

    async def raw(self, verb: str, path: str, body: bytes = b"") -> bytes:
        """Return the body of an answer, which must be 200."""
        head = f"{verb} {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        self._writer.write(head.encode() + b"Content-Length: %d\r\n\r\n" % len(body) + body)
        answer = (await self._reader.readuntil(b"\r\n\r\n")).lower()
        length = int(answer.partition(b"content-length: ")[2].split(b"\r\n", 1)[0])
        content = await self._reader.readexactly(length)
        assert answer.startswith(b"http/1.1 200"), (answer, content[:200])
        return content

    async def queue(self, verb: str, path: str, **request: object) -> Any:  # noqa: ANN401  # JSON
        """Return the queue that a call answers with."""
        body = msgspec.json.encode(request) if request else b""
        return msgspec.json.decode(await self.raw(verb, _QUEUE + path, body))["result"]

    async def add(self, *names: str) -> Any:  # noqa: ANN401  # JSON
        return await self.queue("POST", "/job", filenames=names)

    def close(self) -> None:
        self._writer.close()


class Bench:
    """A server with files in ``gcodes``, the core that it drives, and a client."""

    def __init__(self, port: PtyPort, url: str, client: Http, log: Path) -> None:
        self._port = port
        self.url = url
        self.client = client
        self.log = log

    @property
    def core(self) -> SparkCore:
        return self._port.core

    async def emptied(self) -> None:
        """Return when nothing waits or runs."""
        await self.client.queue("DELETE", "/job?all=true")
        await self.until_idle()

    async def until_idle(self) -> None:
        async with asyncio.timeout(120):
            while True:
                status = msgspec.json.decode(await self.client.raw("POST", "/status", b"{}"))
                queue = await self.client.queue("GET", "/status")
                idle = status["device_alive"] and not status["busy"] and "running_job" not in status
                if idle and (queue["queue_state"] == "paused" or not queue["queued_jobs"]):
                    return
                await asyncio.sleep(0.005)

    @asynccontextmanager
    async def listener(self) -> AsyncIterator[ClientConnection]:
        url = self.url.replace("http", "ws", 1) + "/websocket"
        async with connect(url, compression=None, max_size=None, proxy=None) as socket:
            yield socket


@asynccontextmanager
async def serving(options: SparkOptions) -> AsyncIterator[Bench]:
    """Run a server on a new data directory against a simulated core."""
    async with AsyncExitStack() as stack:
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="toolpost-bench-")))
        gcodes = directory / "data" / "gcodes"
        gcodes.mkdir(parents=True)
        for name, content in _FILES.items():
            (gcodes / name).write_bytes(content)
        port = PtyPort(asyncio.get_running_loop(), options, link=directory / "core")
        port.start()
        stack.callback(port.close)
        config = directory / "toolpost.toml"
        config.write_text(_CONFIG.format(link=directory / "core"))
        process, url = await start_server(config, directory / "data")
        stack.push_async_callback(stop_server, process)
        client = await Http.connect(url)
        stack.callback(client.close)
        bench = Bench(port, url, client, directory / "server.log")
        await bench.until_idle()
        yield bench


async def status_rates(seconds: float) -> list[Result]:
    """Measure GET status, asked by another process."""
    async with serving(SparkOptions()) as bench:
        with multiprocessing.get_context("spawn").Pool(1) as pool:

            async def rate(connections: int) -> float:
                return await asyncio.to_thread(pool.apply, ask_status, (bench.url, connections, seconds))

            one, sixteen = await rate(1), await rate(16)
            await bench.client.add(*["part.gcode"] * 10_000)
            long = await rate(1)
    return [
        at_least("GET status, empty, 1 connection", one, "requests/s", 3 * 2037, "Moonraker: 2,037/s"),
        at_least("GET status, empty, 16 connections", sixteen, "requests/s", 3 * 1780, "Moonraker: 1,780/s"),
        at_least("GET status, 10,000 jobs, 1 connection", long, "requests/s", 260, "Moonraker: 26/s"),
    ]


def ask_status(url: str, connections: int, seconds: float) -> float:
    """Ask for the status as fast as it is answered; return the requests per second."""
    import uvloop

    return uvloop.run(_ask_status(url, connections, seconds))


async def _ask_status(url: str, connections: int, seconds: float) -> float:
    host, _, port = url.removeprefix("http://").partition(":")
    loop = asyncio.get_running_loop()
    pairs: list[Any] = [await loop.create_connection(_Asker, host, int(port)) for _ in range(connections)]
    for _, asker in pairs:
        asker.ask()
    await asyncio.sleep(0.2)
    before, began = sum(asker.answers for _, asker in pairs), time.monotonic()
    await asyncio.sleep(seconds)
    answers, elapsed = sum(asker.answers for _, asker in pairs) - before, time.monotonic() - began
    for transport, _ in pairs:
        transport.close()
    return answers / elapsed


class _Asker(asyncio.Protocol):
    """Asks again as soon as an answer is whole."""

    _REQUEST = f"GET {_QUEUE}/status HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()

    def __init__(self) -> None:
        self.answers = 0
        self._left = 0
        self._head = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def ask(self) -> None:
        self._transport.write(self._REQUEST)  # type: ignore[attr-defined]

    def data_received(self, data: bytes) -> None:
        if not self._left:
            self._head += data
            head, blank, body = self._head.partition(b"\r\n\r\n")
            if not blank:
                return
            assert head.startswith(b"HTTP/1.1 200"), head
            length = head.lower().partition(b"content-length: ")[2].split(b"\r\n", 1)[0]
            self._head = b""
            self._left = int(length) - len(body)
        else:
            self._left -= len(data)
        if not self._left:
            self.answers += 1
            self.ask()


async def growth(posts: int) -> list[Result]:
    """Measure what adding costs: one by one to a long queue, and many at once."""
    async with serving(SparkOptions()) as bench:
        client = bench.client
        await client.add(*["part.gcode"] * 2000)
        body = b'{"filenames":["part.gcode"]}'
        singles = []
        for number in range(posts):
            if number % 20 == 0:
                await bench.emptied()
                await client.add(*["part.gcode"] * 2000)
            singles.append(await _timed(functools.partial(client.raw, "POST", f"{_QUEUE}/job", body)))
        await bench.emptied()
        many = msgspec.json.encode({"filenames": ["part.gcode"] * 10_000})
        bulks = []
        unique: set[str] = set()
        twice = 0
        for _ in range(3):
            bulks.append(await _timed(functools.partial(client.raw, "POST", f"{_QUEUE}/job", many)))
            queue = await client.queue("GET", "/status")
            before = len(unique)
            unique.update(job["job_id"] for job in queue["queued_jobs"])
            twice += 10_000 - (len(unique) - before)
            await bench.emptied()
    return [
        at_most(
            f"POST one job at 2,000 queued, p50 of {posts}",
            percentile(singles, 0.5),
            "ms",
            3,
            "Moonraker: 9.2 ms, not on disk",
        ),
        at_most("POST 10,000 names at once, best of 3", min(bulks), "ms", 120, "Moonraker: 217 ms, RAM"),
        at_most("ids given twice, of 30,000", twice, "ids", 0, "Moonraker: 13 of 119"),
    ]


async def _timed(call: Callable[[], Awaitable[object]]) -> float:
    """Return how many milliseconds a call takes."""
    began = time.monotonic()
    await call()
    return (time.monotonic() - began) * 1000


async def starts(times: int) -> list[Result]:
    """Measure from the sending of POST start to the first command at the idle core."""
    waits = []
    async with serving(SparkOptions(command_time=0.0)) as bench:
        for _ in range(times):
            await bench.client.add("part.gcode")
            bench.core.mark()
            asked = time.monotonic()
            await bench.client.queue("POST", "/start")
            async with asyncio.timeout(10):
                while bench.core.first_command_at is None:
                    await asyncio.sleep(0.002)
            waits.append((bench.core.first_command_at - asked) * 1000)
            await bench.until_idle()
    return [
        at_most(
            f"POST start, idle, to first command, p50 of {times}",
            percentile(waits, 0.5),
            "ms",
            5,
            "Moonraker: 48 ms",
        )
    ]


async def transitions(jobs: int) -> list[Result]:
    """Measure from a job's last command to the first one of the next job, beyond the configured delay."""
    gaps = []
    async with serving(SparkOptions(command_time=0.002)) as bench:
        await bench.client.add(*["ten.gcode"] * jobs)
        await bench.client.queue("POST", "/start")
        for number in range(1, jobs):
            async with asyncio.timeout(10):
                while bench.core.executed < 10 * number:
                    await asyncio.sleep(0.0005)
            completed = bench.core.last_executed_at
            bench.core.mark()
            async with asyncio.timeout(10):
                while bench.core.first_command_at is None:
                    await asyncio.sleep(0.0005)
            assert completed is not None
            gaps.append((bench.core.first_command_at - completed - _TRANSITION_DELAY) * 1000)
        await bench.until_idle()
    return [
        at_most(
            f"completion to the next job's first command, p50 of {len(gaps)}, beyond the delay",
            percentile(gaps, 0.5),
            "ms",
            20,
            "Moonraker: 346 ms",
        )
    ]


async def ten_quick_jobs() -> list[Result]:
    """Run ten jobs of one command that takes no time, and count those that ran and those in the history."""
    async with serving(SparkOptions(command_time=0.0)) as bench:
        queue = await bench.client.add(*["part.gcode"] * 10)
        before = bench.core.executed
        await bench.client.queue("POST", "/start")
        await bench.until_idle()
        jobs = msgspec.json.decode(await bench.client.raw("POST", "/list-jobs", b"{}"))["jobs"]
        done = {job["job_id"] for job in jobs if job["status"] == "COMPLETED"}
        kept = sum(job["job_id"] in done for job in queue["queued_jobs"])
        ran = bench.core.executed - before
    return [
        at_least("ten jobs of no time: ran", ran, "jobs", 10, "Moonraker: 1"),
        at_least("ten jobs of no time: in the history, by their ids", kept, "jobs", 10, "Moonraker: 1"),
    ]


async def many_clients(changes: int) -> list[Result]:
    """Measure how soon a change is told: to one client, to many, and to many while one more does not read."""
    async with serving(SparkOptions()) as bench:
        async with bench.listener() as listener:
            alone = [(await _told(bench, [listener]))[1] for _ in range(changes)]
        async with AsyncExitStack() as stack:
            async with AsyncExitStack() as reading:
                listeners = [await reading.enter_async_context(bench.listener()) for _ in range(199)]
                await _told(bench, listeners, *["part.gcode"] * 100)
                without = [(await _told(bench, listeners))[0] for _ in range(20)]
                await stack.enter_async_context(_stuck(bench.url))
                crowd = [(await _told(bench, listeners))[0] for _ in range(20)]
            await bench.client.add(*["part.gcode"] * 2000)
            async with asyncio.timeout(60):
                while "unread; disconnected" not in bench.log.read_text():
                    await bench.client.add("part.gcode")
    p50 = percentile(without, 0.5)
    return [
        at_most(
            f"answer to a change, to its notification, p50 of {changes}", percentile(alone, 0.5), "ms", 5
        ),
        at_most(
            f"change to the last of 199 clients told, one more stuck, p50 of {len(crowd)}",
            percentile(crowd, 0.5),
            "ms",
            2 * p50,
            f"without it: {p50:.1f} ms",
        ),
        at_least("the one that is stuck is dropped, with a log line", 1, "client", 1),
    ]


async def _told(bench: Bench, listeners: list[ClientConnection], *names: str) -> tuple[float, float]:
    """Change the queue; return the milliseconds from request and from answer to the last one told."""
    telling = asyncio.gather(*(listener.recv() for listener in listeners))
    await asyncio.sleep(0)
    asked = time.monotonic()
    await bench.client.add(*(names or ["part.gcode"]))
    answered = time.monotonic()
    await telling
    told = time.monotonic()
    return (told - asked) * 1000, (told - answered) * 1000


@asynccontextmanager
async def _stuck(url: str) -> AsyncIterator[asyncio.StreamWriter]:
    """A WebSocket client that reads nothing."""
    host, _, port = url.removeprefix("http://").partition(":")
    reader, writer = await asyncio.open_connection(host, int(port), limit=1)
    head = ["GET /websocket HTTP/1.1", "Host: localhost", "Connection: Upgrade", "Upgrade: websocket"]
    head += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13", "", ""]
    writer.write("\r\n".join(head).encode())
    writer.transport.pause_reading()  # type: ignore[attr-defined]
    try:
        yield writer
    finally:
        writer.close()
        del reader
