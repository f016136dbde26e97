"""A driver on a simulated core in this process."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from toolpost.commlog import CommLog, CommLogLimits
from toolpost.core.report import Report
from toolpost.drivers.spark.driver import SparkDriver
from toolpost.drivers.spark.options import SparkOptions
from toolpost.links.base import Link, LinkListener
from toolpost.links.net import socket_link
from toolpost.sim.faults import Fault
from toolpost.sim.options import SparkOptions as CoreOptions
from toolpost.sim.ports import SimulatedSpark

QUICK = SparkOptions(hold_off=0.05, answer_timeout=0.3, silence_limit=0.8)
TIMEOUT = 20.0


class Program:
    """A program in memory (`LineSource`)."""

    def __init__(self, commands: list[bytes]) -> None:
        self._commands = commands
        self._next = 0

    @property
    def exhausted(self) -> bool:
        return self._next >= len(self._commands)

    def take(self, most: int) -> list[bytes]:
        taken = self._commands[self._next : self._next + most]
        self._next += len(taken)
        return taken


def moves(count: int) -> list[bytes]:
    return [b"G1 X%d Y%d" % (i, i % 7) for i in range(count)]


class Bench:
    """One driver, one core, and what they said. Also the driver's listener."""

    def __init__(self) -> None:
        self.reports: list[Report] = []
        self.sessions = 0
        self.executed: list[bytes] = []
        self.received: list[bytes] = []
        self._changes: list[asyncio.Event] = []
        self.simulated: SimulatedSpark
        self.driver: SparkDriver

    @property
    def core(self):
        return self.simulated.core

    def reported(self, report: Report) -> None:
        self.reports.append(report)

    def session_started(self) -> None:
        self.sessions += 1

    def changed(self) -> None:
        pass

    def tagged(self, tag: str) -> list[Report]:
        return [report for report in self.reports if report.tag == tag]

    def trace(self, event: str, line: bytes) -> None:
        if event == "executed":
            self.executed.append(line)
        elif event == "received":
            self.received.append(line)

    async def until(self, condition: Callable[[], bool], timeout: float = TIMEOUT) -> None:
        async with asyncio.timeout(timeout):
            while not condition():
                await asyncio.sleep(0.001)

    async def ready(self) -> None:
        await self.until(lambda: self.driver.ready)

    async def run(self, commands: list[bytes], signals: dict[str, float] | None = None):
        async with asyncio.timeout(TIMEOUT):
            return await self.driver.execute(Program(commands), signals or {})

    def inject(self, text: str) -> None:
        self.core.inject(Fault.parse(text))


@asynccontextmanager
async def driving(
    directory: Path, core: CoreOptions, options: SparkOptions = QUICK, faults: tuple[str, ...] = ()
) -> AsyncIterator[Bench]:
    bench = Bench()
    bench.simulated = SimulatedSpark(
        asyncio.get_running_loop(),
        core,
        faults=[Fault.parse(text) for text in faults],
        trace=bench.trace,
    )

    async def opener(listener: LinkListener) -> Link:
        from toolpost.errors import LinkError

        try:
            return socket_link(bench.simulated.connect(), listener)
        except OSError as error:
            raise LinkError(str(error)) from None

    comm = CommLog(directory, "edm", CommLogLimits())
    bench.driver = SparkDriver("edm", opener, comm, bench, options)
    task = asyncio.create_task(bench.driver.run())
    try:
        await bench.ready()
        yield bench
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        bench.driver.close()
        bench.simulated.close()
        comm.close()
