"""What the server takes: memory, disk, time to start, and requests."""

import asyncio
import multiprocessing
import tempfile
import time
from pathlib import Path

from bench.result import Result, at_least, at_most
from bench.rig import rig, start_server, stop_server
from bench.stream import moves
from toolpost.core.report import Report
from toolpost.sim.options import SparkOptions
from toolpost.telemetry import Telemetry

_STATUS = (
    b"POST /status HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    b"Content-Length: 2\r\n\r\n{}"
)
_DAY = 86_400
_HEARTBEATS = 4 * _DAY


async def measure(scale: float) -> list[Result]:
    """Measure the load goals; `scale` shortens the runs."""
    return [
        *await start(),
        *await status_rate(max(1.0, 8.0 * scale)),
        *await big_job(int(1_000_000 * scale) if scale < 1 else 1_000_000),
        *idle_day(),
    ]


async def start() -> list[Result]:
    """Measure the start on an existing data directory, and the memory of an idle server."""
    times = []
    with tempfile.TemporaryDirectory(prefix="toolpost-bench-") as name:
        config = Path(name) / "toolpost.toml"
        config.write_text(
            '[server]\nlisten = "127.0.0.1:0"\n[machines.edm]\ndriver = "spark"\nlink = "sim"\n'
        )
        for _ in range(6):
            began = time.monotonic()
            process, url = await start_server(config, Path(name) / "data")
            host, _, port = url.removeprefix("http://").partition(":")
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(_STATUS)
            await reader.readuntil(b"\r\n\r\n")
            times.append(time.monotonic() - began)
            writer.close()
            await asyncio.sleep(1.5)
            status = Path(f"/proc/{process.pid}/status").read_text()
            memory = int(status.partition("VmRSS:")[2].split()[0]) / 1024
            await stop_server(process)
    return [
        at_most("start to first answer, median of 5", sorted(times[1:])[2], "s", 0.5),
        at_most("idle: resident memory", memory, "MB", 50),
    ]


async def status_rate(seconds: float) -> list[Result]:
    """Measure /status on 16 connections, asked by another process."""
    async with rig(SparkOptions()) as bench:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            rate = await asyncio.to_thread(pool.apply, ask_status, (bench.url, 16, seconds))
    return [at_least("/status on 16 connections", rate, "requests/s", 5_000)]


def ask_status(url: str, connections: int, seconds: float) -> float:
    """Ask for the status as fast as it is answered; return the requests per second."""
    import uvloop

    return uvloop.run(_ask_status(url, connections, seconds))


async def _ask_status(url: str, connections: int, seconds: float) -> float:
    host, _, port = url.removeprefix("http://").partition(":")
    loop = asyncio.get_running_loop()
    pairs = [
        await loop.create_connection(_Asker, host, int(port))  # type: ignore[arg-type]
        for _ in range(connections)
    ]
    began = time.monotonic()
    for _, asker in pairs:
        asker.ask()
    await asyncio.sleep(seconds)
    answers = sum(asker.answers for _, asker in pairs)
    elapsed = time.monotonic() - began
    for transport, _ in pairs:
        transport.close()
    return answers / elapsed


class _Asker(asyncio.Protocol):
    """Asks again as soon as an answer is whole."""

    def __init__(self) -> None:
        self.answers = 0
        self._buffer = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def ask(self) -> None:
        self._transport.write(_STATUS)  # type: ignore[attr-defined]

    def data_received(self, data: bytes) -> None:
        self._buffer += data
        if self._buffer.endswith(b"}\n"):
            assert self._buffer.startswith(b"HTTP/1.1 200"), self._buffer
            self._buffer = b""
            self.answers += 1
            self.ask()


async def big_job(count: int) -> list[Result]:
    """Stream a job of a million commands and note the most memory that the server ever had."""
    async with rig(SparkOptions(command_time=0.0)) as bench:
        await bench.run_job(moves(count))
        await bench.until_idle()
        assert bench.core.executed == count, bench.core.executed
        return [at_most(f"job of {count:,} commands: peak memory", bench.memory("VmHWM"), "MB", 200)]


def idle_day() -> list[Result]:
    """Record one idle day of answers to ?queue and measure what is left of it in memory and on disk."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        memory, disk = pool.apply(_idle_day)
    return [
        at_most("one idle day: memory", memory, "MB", 10),
        at_most("one idle day: telemetry on disk", disk, "MB", 5),
    ]


def _idle_day() -> tuple[float, float]:
    async def run() -> tuple[float, float]:
        with tempfile.TemporaryDirectory(prefix="toolpost-bench-") as name:
            telemetry = Telemetry.open(Path(name))
            before = _resident()
            now = time.time_ns() // 1000
            for beat in range(_HEARTBEATS):
                time_us = now - (_HEARTBEATS - beat) * 250_000
                telemetry.record("edm", Report(time_us, "queue", {"cap": 64, "num": 0}))
                if beat % 240 == 0:
                    await telemetry.history("edm", "queue", 1000)
            memory = _resident() - before
            await telemetry.close()
            disk = sum(path.stat().st_size for path in Path(name).iterdir()) / 1e6
            return memory, disk

    return asyncio.run(run())


def _resident() -> float:
    text = Path("/proc/self/status").read_text()
    return int(text.partition("VmRSS:")[2].split()[0]) / 1024
