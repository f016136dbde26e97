"""The simulated host as a process: its socket, its restarts, its faults."""

import asyncio
import random
import time
from collections.abc import Coroutine
from pathlib import Path

import msgspec

from toolpost.sim.klippy.connection import END, Connection
from toolpost.sim.klippy.endpoints import Endpoints, Request
from toolpost.sim.klippy.faults import Fault
from toolpost.sim.klippy.options import KlippyOptions
from toolpost.sim.klippy.printer import Printer
from toolpost.sim.klippy.sdcard import Run
from toolpost.sim.klippy.status import StatusTicker

DEFAULT_DISCONNECTED = 1.0
DEFAULT_SLOW = 0.5
DEFAULT_NOISE = 64
_FLUSH = 0.02  # seconds from a restart to the closing of the socket: the answer goes out first


class SimulatedKlippy:
    """A Klipper host on a Unix socket.

    Everything runs on the loop in which ``start`` was called.

    Args:
        path: the socket; whoever may open it may do everything.
        options: what the host is like.

    Attributes:
        path: the same.
        options: the same.
        gcodes: the directory of the files.
        runs: every file that was started, in order, over all restarts.
        scripts: every script that came through ``gcode/script``, in order.
        boots: boots so far.
    """

    def __init__(self, path: Path, options: KlippyOptions | None = None) -> None:
        self.path = path
        self.options = options or KlippyOptions()
        self.gcodes = self.options.gcodes or path.parent / "gcodes"
        self.runs: list[Run] = []
        self.scripts: list[str] = []
        self.boots = 0
        self._delay = self.options.answer_delay
        self._muted = False
        self._server: asyncio.Server | None = None
        self._connections: set[Connection] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._printer: Printer | None = None
        self._ticker: StatusTicker | None = None
        self._endpoints: Endpoints | None = None
        self._later: asyncio.Task[None] | None = None
        self._mute_timer: asyncio.TimerHandle | None = None

    # -- observables

    @property
    def state(self) -> str:
        """startup, ready or shutdown; "dead" when no host runs."""
        return "dead" if self._printer is None else self._printer.state

    @property
    def starts(self) -> list[str]:
        """The files that were started, in order."""
        return [run.filename for run in self.runs]

    @property
    def executed(self) -> list[tuple[str, int]]:
        """For every start the file and how many of its commands were carried out."""
        return [(run.filename, run.lines) for run in self.runs]

    @property
    def clients(self) -> int:
        """Clients that are connected."""
        return sum(connection.open for connection in self._connections)

    def status(self, name: str) -> dict[str, object]:
        """Return an object's fields now, without a tick; none when no host runs."""
        return {} if self._printer is None else self._printer.status(name, time.monotonic())

    # -- life

    async def start(self) -> None:
        """Boot and listen.

        Raises:
            OSError: the socket cannot be bound.
        """
        self.gcodes.mkdir(parents=True, exist_ok=True)
        self._boot()
        await self._listen()

    async def close(self) -> None:
        """End; the socket's file is removed."""
        if self._mute_timer is not None:
            self._mute_timer.cancel()
        self._kill()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(*(connection.lost.wait() for connection in self._connections))
        self.path.unlink(missing_ok=True)

    async def revive(self) -> None:
        """Start the process again after the fault ``die``; without effect if one runs."""
        if self._printer is None:
            self._boot()
            await self._listen()

    def _boot(self) -> None:
        self.boots += 1
        self._printer = Printer(
            self.options,
            self.gcodes,
            self.runs,
            restart=self._restart,
            call_remote=self.call_remote_method,
        )
        self._ticker = StatusTicker(self._printer, self.options.tick)
        self._endpoints = Endpoints(self._printer, self._ticker, self.scripts)
        self._printer.boot()

    async def _listen(self) -> None:
        loop = asyncio.get_running_loop()
        self._server = await loop.create_unix_server(self._connect, str(self.path))

    def _unlisten(self) -> None:
        """Listen no more; the file stays, so that a client is refused (as by a killed process)."""
        if self._server is not None:
            self._server.close()
            self._server = None

    def _drop(self, *, abort: bool) -> None:
        """Close all clients."""
        for connection in tuple(self._connections):
            if abort:
                connection.abort()
            else:
                connection.close()

    def _end_printer(self) -> None:
        """End the machine with all requests that wait for it."""
        if self._printer is None or self._ticker is None:
            return
        for request in self._tasks:
            request.cancel()
        self._ticker.stop()
        printing = self._printer.stop()
        if printing is not None:
            self._keep(printing)
        self._printer = None
        self._endpoints = None

    def _keep(self, task: asyncio.Task[None]) -> None:
        """Hold a task until it has ended."""
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _restart(self) -> None:
        """Restart soon; the answer to who asked for it is sent before."""
        self._run_later(self._go_through_restart())

    async def _go_through_restart(self) -> None:
        await asyncio.sleep(_FLUSH)
        if self._printer is not None:
            self._printer.gcode.inform("Klipper state: Disconnect")
        self._unlisten()
        self._drop(abort=False)
        self._end_printer()
        await asyncio.sleep(self.options.restart_time)
        self._boot()
        await self._listen()

    async def _go_through_disconnect(self, seconds: float) -> None:
        self._unlisten()
        self._drop(abort=True)
        await asyncio.sleep(seconds)
        await self._listen()

    def _kill(self) -> None:
        """End as by SIGKILL, whatever is going on."""
        if self._later is not None:
            self._later.cancel()
            self._keep(self._later)
            self._later = None
        self._unlisten()
        self._drop(abort=True)
        self._end_printer()

    # -- clients

    def _connect(self) -> Connection:
        connection = Connection(
            self._take, self._lose, delay=self._delay, timeout=self.options.client_timeout
        )
        connection.muted = self._muted
        self._connections.add(connection)
        return connection

    def _lose(self, connection: Connection) -> None:
        self._connections.discard(connection)
        if self._endpoints is not None:
            self._endpoints.forget(connection)

    def _take(self, connection: Connection, frame: bytes) -> None:
        """Begin a request; what is none is ignored without an answer (measured)."""
        if self._endpoints is None:
            return
        try:
            request = msgspec.json.decode(frame, type=Request)
        except (msgspec.DecodeError, UnicodeDecodeError):
            return
        task = asyncio.get_running_loop().create_task(self._endpoints.answer(connection, request))
        self._keep(task)

    # -- what a test can do

    def call_remote_method(self, name: str, **params: object) -> int:
        """Do what ``action_call_remote_method`` does in a macro; return how many clients it went to."""
        return 0 if self._endpoints is None else self._endpoints.call_remote(name, params)

    def inject(self, text: str) -> None:
        """Have a fault now.

        Args:
            text: ``NAME[:ARG]``, see ``faults.KINDS``.

        Raises:
            ValueError: there is no such fault, or its argument is wrong.
        """
        fault = Fault.parse(text)
        match fault.name:
            case "shutdown" if self._printer is not None:
                self._printer.shutdown(fault.text or "MCU 'mcu' shutdown: simulated fault")
            case "error" if self._printer is not None:
                self._printer.sdcard.error = fault.text or "Simulated error"
            case "disconnect":
                self._run_later(self._go_through_disconnect(_or(fault.amount, DEFAULT_DISCONNECTED)))
            case "restart" | "firmware-restart":
                self._restart()
            case "die":
                self._kill()
            case "slow":
                self._set_delay(_or(fault.amount, DEFAULT_SLOW))
            case "mute":
                self._mute(fault.amount)
            case "garbage":
                noise = random.Random(0).randbytes(int(_or(fault.amount, DEFAULT_NOISE)))  # noqa: S311
                for connection in self._connections:
                    connection.send_bytes(noise + END)
            case _:
                pass  # no machine that could have it

    def _run_later(self, what: Coroutine[object, object, None]) -> None:
        """Go through something that takes time, unless that is going on already."""
        if self._later is not None and not self._later.done():
            what.close()
            return
        self._later = asyncio.get_running_loop().create_task(what)

    def _set_delay(self, seconds: float) -> None:
        self._delay = seconds
        for connection in self._connections:
            connection.delay = seconds

    def _mute(self, seconds: float | None) -> None:
        if self._mute_timer is not None:
            self._mute_timer.cancel()
            self._mute_timer = None
        self._set_muted(muted=True)
        if seconds is not None:
            loop = asyncio.get_running_loop()
            self._mute_timer = loop.call_later(seconds, lambda: self._set_muted(muted=False))

    def _set_muted(self, *, muted: bool) -> None:
        self._muted = muted
        for connection in self._connections:
            connection.muted = muted


def _or(value: float | None, default: float) -> float:
    return default if value is None else value
