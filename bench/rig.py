"""A server under test, as its users run it, and a simulated core on a pty beside it."""

import asyncio
import os
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec

from toolpost.sim.options import SparkOptions
from toolpost.sim.ports import PtyPort
from toolpost.sim.spark import SparkCore

_CONFIG = """
[server]
listen = "127.0.0.1:0"
[machines.edm]
driver = "spark"
link = "{link}"
[machines.edm.spark]
hold_off = {hold_off}
[machines.edm.history]
shown = 100
"""


class Client:
    """A keep-alive HTTP client for small JSON calls, as quick as a benchmark needs it."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    @classmethod
    async def connect(cls, url: str) -> "Client":
        host, _, port = url.removeprefix("http://").partition(":")
        return cls(*await asyncio.open_connection(host, int(port), limit=2**26))

    async def post(self, path: str, request: object) -> Any:  # noqa: ANN401
        body = msgspec.json.encode(request)
        self._writer.write(
            f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            f"Content-Length: {len(body)}\r\n\r\n".encode()
            + body
        )
        head = (await self._reader.readuntil(b"\r\n\r\n")).lower()
        length = int(head.partition(b"content-length: ")[2].split(b"\r\n", 1)[0])
        answer = await self._reader.readexactly(length)
        assert head.startswith(b"http/1.1 200"), (head, answer)
        return msgspec.json.decode(answer)

    async def close(self) -> None:
        self._writer.close()
        await self._writer.wait_closed()


class Rig:
    """One server with its simulated core and a client."""

    def __init__(self, port: PtyPort, process: asyncio.subprocess.Process, client: Client, url: str) -> None:
        self.port = port
        self.process = process
        self.client = client
        self.url = url

    @property
    def core(self) -> SparkCore:
        """The simulated core, in this process."""
        return self.port.core

    def memory(self, field: str = "VmRSS") -> float:
        """Return a field of the server's memory account in MB."""
        for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
            if line.startswith(field):
                return int(line.split()[1]) / 1024
        raise LookupError(field)

    async def until_idle(self, timeout: float = 600.0) -> None:
        """Return when no job is waiting or running."""
        async with asyncio.timeout(timeout):
            while True:
                status = await self.client.post("/status", {})
                if not status["busy"] and "running_job" not in status:
                    return
                await asyncio.sleep(0.002)

    async def run_job(self, commands: list[str], **request: object) -> str:
        """Add a job and return its id."""
        answer = await self.client.post("/add-job", {"commands": commands, **request})
        assert answer["ok"], answer
        return str(answer["job_id"])


@asynccontextmanager
async def rig(options: SparkOptions, *, baud: int | None = None, hold_off: float = 0.5) -> AsyncIterator[Rig]:
    """Run a server on a new data directory against a simulated core."""
    with tempfile.TemporaryDirectory(prefix="toolpost-bench-") as name:
        directory = Path(name)
        port = PtyPort(asyncio.get_running_loop(), options, link=directory / "core", baud=baud)
        port.start()
        config = directory / "toolpost.toml"
        config.write_text(_CONFIG.format(link=directory / "core", hold_off=hold_off))
        process, url = await start_server(config, directory / "data")
        client = await Client.connect(url)
        try:
            while not (await client.post("/status", {}))["device_alive"]:
                await asyncio.sleep(0.01)
            yield Rig(port, process, client, url)
        finally:
            await client.close()
            await stop_server(process)
            port.close()


async def start_server(config: Path, data: Path) -> tuple[asyncio.subprocess.Process, str]:
    """Start a server and return it with the URL of its first listener, once that takes requests."""
    log = (data.parent / "server.log").open("ab")
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "toolpost", "serve", "--config", str(config), "--data", str(data),
        stdout=asyncio.subprocess.PIPE, stderr=log, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    log.close()
    assert process.stdout is not None
    line = (await process.stdout.readline()).decode()
    if "ready on " not in line:
        raise RuntimeError((data.parent / "server.log").read_text())
    return process, line.split("ready on ")[1].strip()


async def stop_server(process: asyncio.subprocess.Process) -> None:
    """Stop a server as a service manager does."""
    if process.returncode is None:
        process.terminate()
        await process.wait()


def wall(monotonic: float) -> float:
    """Return the Unix time of a time of `time.monotonic`."""
    return time.time() - time.monotonic() + monotonic
