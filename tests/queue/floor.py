"""A machine, its queue and the shop over a simulated core in this process; no HTTP, and it can crash.

async with floor(tmp_path, automatic_transition=True) as shop_floor:
    await shop_floor.post("a", "b")
"""

import asyncio
import contextlib
import queue
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from toolpost.commlog import CommLog
from toolpost.config import MachineConfig, QueueConfig
from toolpost.core.job import Job
from toolpost.drivers import registry
from toolpost.drivers.spark.options import SparkOptions
from toolpost.errors import LinkError
from toolpost.events import Events, QueueChanged
from toolpost.links.base import Link, LinkListener
from toolpost.links.net import socket_link
from toolpost.machine import Machine
from toolpost.shop import Shop
from toolpost.sim.faults import Fault
from toolpost.sim.options import SparkOptions as CoreOptions
from toolpost.sim.ports import SimulatedSpark
from toolpost.store import Store
from toolpost.store.files import Files

NAME = "edm"
TIMEOUT = 10.0


class NoTelemetry:
    def record(self, machine, report):
        pass


class Floor:
    """A shop with one machine.

    The core executes only as many commands as it has been `permit`-ted; it takes as many as it likes.

    Attributes:
        received: the commands that the core got, in order.
        executed: those that it has executed.
        free: those that need no permission, if they come alone.
        states: the queue's states in the order in which they were told, the first one included.
        told: the actions that were told.
    """

    def __init__(self, directory: Path, options: QueueConfig, *, core_time: float = 0.0) -> None:
        self.directory = directory
        self.received: list[str] = []
        self.executed: list[str] = []
        self.free: set[bytes] = set()
        self._permitted: float = float("inf")
        self._options = options
        loop = asyncio.get_running_loop()
        core = CoreOptions(command_time=core_time, hold_off=0.0)
        self._simulated = SimulatedSpark(loop, core, trace=self._trace)
        self.core = self._simulated.core
        (directory / "gcodes").mkdir(parents=True, exist_ok=True)
        self.open()

    def open(self) -> None:
        """Start Toolpost."""
        self.store = Store(self.directory)
        self._comm = CommLog(self.directory / "logs", NAME, MachineConfig(driver="spark", link="sim").log)
        config = MachineConfig(
            driver="spark",
            link="sim",
            queue=self._options,
            spark=SparkOptions(hold_off=0.005, answer_timeout=0.5, silence_limit=2.0),
        )
        events = Events()
        with patch.object(registry, "_opener", lambda _config: self._open_link):
            self.machine = Machine(NAME, config, self.store, NoTelemetry(), self._comm, events)
        files = Files(self.directory / "gcodes", self.directory / "programs" / "files")
        self.shop = Shop({NAME: self.machine}, self.store, NoTelemetry(), files, 2**30)
        self.states: list[str] = []
        self.told: list[str] = []
        self._unsubscribe = events.subscribe(self._happened)
        self.machine.start()
        self.states.append(self.state)

    async def _open_link(self, listener: LinkListener) -> Link:
        try:
            return socket_link(self._simulated.connect(), listener)
        except OSError as error:
            raise LinkError(str(error)) from None

    def _happened(self, event: object) -> None:
        if isinstance(event, QueueChanged):
            self.told.append(event.action.value)
            if self.state != self.states[-1]:
                self.states.append(self.state)

    def _trace(self, event: str, line: bytes) -> None:
        if event == "received" and line[:1] in b"GM":
            self.received.append(line.decode())
            if line in self.free:
                self.permit(1)
        elif event == "executed":
            self.executed.append(line.decode())
            self._permitted -= 1
            if self._permitted <= 0:
                self.core._execution.stall()

    def permit(self, commands: float) -> None:
        """Let the core execute so many commands from now on."""
        self._permitted = commands
        if commands > 0:
            self.core._end_stall()
        else:
            self.core._execution.stall()

    def inject(self, fault: str) -> None:
        self.core.inject(Fault.parse(fault))

    # What a person does.

    def write(self, name: str, *lines: str) -> None:
        """Write a file of these lines."""
        (self.directory / "gcodes" / name).write_text("".join(f"{line}\n" for line in lines))

    async def post(
        self, *names: str, replace: bool = False, shown: frozenset[str] | None = None
    ) -> list[str]:
        """Add files, and write those that are missing; returns the ids of the new jobs."""
        for name in names:
            if not (self.directory / "gcodes" / f"{name}.gcode").exists():
                self.write(f"{name}.gcode", f"G1 X{len(name)} ; {name}")
        before = {job.id for job in self.jobs}
        files = [f"{name}.gcode" for name in names]
        await self.shop.enqueue(NAME, files, replace=replace, shown=shown, actor="me")
        return [job.id for job in self.jobs if job.id not in before]

    async def start(self) -> None:
        await self.shop.start_queue(NAME)

    async def pause(self) -> None:
        await self.shop.pause_queue(NAME)

    async def jump(self, job_id: str) -> None:
        await self.shop.jump(NAME, job_id, "me")

    async def remove(self, *job_ids: str) -> None:
        await self.shop.dequeue(NAME, job_ids, "me")

    async def remove_all(self) -> None:
        await self.shop.dequeue(NAME, None, "me")

    async def cancel(self) -> None:
        await self.shop.cancel(NAME, "me")

    async def submit(self, *lines: str) -> Job:
        """Have a job past the queue, as one that the shop took a moment before it would refuse it."""
        program = self.store.programs.add([[line.encode() for line in lines]])
        job = self.machine.ledger.new(program, {})
        await self.machine.ledger.add([job], "me")
        return job

    # What is to be seen.

    @property
    def state(self) -> str:
        return self.shop.queue(NAME).state.value

    @property
    def ids(self) -> list[str]:
        return [job.id for job in self.shop.queue(NAME).jobs]

    @property
    def names(self) -> str:
        """The names of the waiting jobs, without their ``.gcode``."""
        return " ".join(job.name.removesuffix(".gcode") for job in self.shop.queue(NAME).jobs)

    @property
    def jobs(self) -> list[Job]:
        return self.shop.jobs(NAME)

    @property
    def history(self) -> dict[str, str]:
        """State and reason by id."""
        return {job.id: f"{job.state} {job.reason}" for job in self.jobs}

    @property
    def outcomes(self) -> Counter[str]:
        """How many jobs are in which state."""
        return Counter(job.state.value for job in self.jobs)

    @property
    def running(self) -> str | None:
        """The id of the job that holds the machine."""
        active = self.machine.ledger.active
        return active.id if active is not None else None

    async def until(self, true: Callable[[], Any], timeout: float = TIMEOUT) -> None:
        try:
            async with asyncio.timeout(timeout):
                while not true():
                    await asyncio.sleep(0.001)
        except TimeoutError:
            seen = (self.state, self.names, dict(self.history), self.received)
            raise AssertionError(f"not so within {timeout} s: {seen}") from None

    async def ready(self) -> None:
        """Wait until the machine could start a job."""
        await self.until(lambda: self.machine.driver.ready)

    async def settled(self) -> None:
        """Wait until nothing goes on by itself and all is on disk."""
        await self.until(lambda: self.state in {"ready", "paused"})
        with contextlib.suppress(Exception):
            await self.store.settings.set(NAME, "barrier", 0)
        await self.until(lambda: self.state in {"ready", "paused"})

    async def busy(self) -> Job:
        """Have a job run past the queue, until the core is permitted to end it."""
        await self.ready()
        self.permit(0)
        job = await self.submit("G1 X99")
        await self.until(lambda: "G1 X99" in self.received)
        return job

    # Ends.

    async def crash(self) -> None:
        """Leave as by ``kill -9``: what the disk has not taken is lost, and the core is told nothing."""
        database = self.store._database
        with contextlib.suppress(queue.Empty):
            while True:
                database._changes.get_nowait()
        self._unsubscribe()
        self.machine.ledger._changed = lambda _job: None
        tasks = list(self.machine._tasks)
        if self.machine.queue._loading is not None:
            tasks.append(self.machine.queue._loading)
        for task in tasks:
            task.cancel()
        self.machine.driver._sender.stop = lambda: None
        self.machine.driver.close()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._leave()

    async def stop(self) -> None:
        """Leave as by SIGTERM."""
        self._unsubscribe()
        await self.machine.halt()
        self._leave()

    def _leave(self) -> None:
        self.machine.queue.close()
        self.machine.ledger.close()
        self.store.close()
        self._comm.close()

    def close(self) -> None:
        self._simulated.close()


@asynccontextmanager
async def floor(directory: Path, *, core_time: float = 0.0, **queue_options: Any) -> AsyncIterator[Floor]:
    """A floor whose machine is ready."""
    options = QueueConfig(**{"job_transition_delay": 0.0} | queue_options)
    shop_floor = Floor(directory, options, core_time=core_time)
    try:
        await shop_floor.ready()
        yield shop_floor
    finally:
        await shop_floor.stop()
        shop_floor.close()
