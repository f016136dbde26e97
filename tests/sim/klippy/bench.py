"""A simulated Klipper host on a socket in a directory of its own, and a client of it."""

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from toolpost.sim.klippy import KlippyOptions, SimulatedKlippy

TICK = 0.05
FAST = {"tick": TICK, "startup_time": 0.0, "restart_time": 0.02, "heater_time": 0.02}


class RefusedError(Exception):
    """The host answered with an error; its message."""


class Client:
    """One connection, with what it was sent."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.updates: list[dict] = []
        self.others: list[dict] = []
        self.status: dict[str, dict] = {}
        self.closed = asyncio.Event()
        self._answers: dict[int, asyncio.Future] = {}
        self._count = 0

    async def open(self, path: Path) -> "Client":
        self.reader, self.writer = await asyncio.open_unix_connection(path, limit=1 << 24)
        self._task = asyncio.create_task(self._read())
        return self

    async def _read(self) -> None:
        try:
            while True:
                self._take((await self.reader.readuntil(b"\x03"))[:-1])
        except (asyncio.IncompleteReadError, ConnectionError):
            self.closed.set()
            for answer in self._answers.values():
                answer.cancel()

    def _take(self, frame: bytes) -> None:
        try:
            message = json.loads(frame)
        except ValueError:
            self.others.append({"noise": frame})
            return
        answer = self._pop(message.get("id"))
        if answer is not None:
            answer.set_result(message)
        elif message.get("method") == "output":
            self.lines.append(message["params"]["response"])
        elif message.get("method") == "status":
            self.updates.append(message["params"]["status"])
            for name, fields in message["params"]["status"].items():
                self.status.setdefault(name, {}).update(fields)
        else:
            self.others.append(message)

    def _pop(self, number: object) -> asyncio.Future | None:
        return self._answers.pop(number, None) if isinstance(number, int) else None

    def send(self, method: str, **params: object) -> asyncio.Future:
        self._count += 1
        answer = self._answers[self._count] = asyncio.get_running_loop().create_future()
        request = {"id": self._count, "method": method, "params": params}
        self.raw(json.dumps(request).encode() + b"\x03")
        return answer

    def raw(self, data: bytes) -> None:
        self.writer.write(data)

    async def call(self, method: str, **params: object):
        message = await asyncio.wait_for(self.send(method, **params), 10)
        if "error" in message:
            assert message["error"]["error"] == "WebRequestError"
            raise RefusedError(message["error"]["message"])
        return message["result"]

    async def run(self, script: str):
        return await self.call("gcode/script", script=script)

    async def print(self, name: str):
        return await self.run(f'SDCARD_PRINT_FILE FILENAME="{name}"')

    async def listen(self, **objects: object) -> None:
        """Subscribe to the output, and to the objects if any are given."""
        await self.call("gcode/subscribe_output", response_template={"method": "output"})
        if objects:
            template = {"method": "status"}
            answer = await self.call("objects/subscribe", objects=objects, response_template=template)
            self.status = answer["status"]

    def close(self) -> None:
        self._task.cancel()
        self.writer.close()


class Bench:
    """The host, and what a test needs around it."""

    def __init__(self, host: SimulatedKlippy) -> None:
        self.host = host
        self.clients: list[Client] = []

    async def client(self, **objects: object) -> Client:
        client = await Client().open(self.host.path)
        self.clients.append(client)
        await client.listen(**objects)
        return client

    async def reconnect(self) -> Client:
        """Connect as soon as that can be done."""
        for _ in range(500):
            try:
                return await self.client()
            except (OSError, asyncio.CancelledError):
                await asyncio.sleep(0.01)
        raise AssertionError("no host to connect to")

    def file(self, name: str, text: str | bytes) -> None:
        path = self.host.gcodes / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())

    def state(self) -> object:
        return self.host.status("print_stats")["state"]


async def wait_until(condition: Callable[[], object], timeout: float = 5.0) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        await asyncio.sleep(0.002)


@asynccontextmanager
async def running(directory: Path, *, ready: bool = True, **options: object) -> AsyncIterator[Bench]:
    """Run a host."""
    host = SimulatedKlippy(directory / "klippy.sock", KlippyOptions(**{**FAST, **options}))
    bench = Bench(host)
    await host.start()
    try:
        if ready:
            await wait_until(lambda: host.state == "ready")
        yield bench
    finally:
        for client in bench.clients:
            client.close()
        await host.close()
