"""One machine at work: its driver, its jobs, its log and its reports, put together."""

import asyncio
import logging

from toolpost.clock import now_us
from toolpost.commlog import CommLog
from toolpost.config import MachineConfig
from toolpost.core.job import Job, JobState, Reason
from toolpost.core.machine import Execution
from toolpost.core.report import Report
from toolpost.drivers.base import Driver
from toolpost.drivers.registry import open_driver
from toolpost.events import Events, JobChanged, MachineChanged, QueueAction, QueueChanged, Reported
from toolpost.job_queue import JobQueue
from toolpost.ledger import Ledger
from toolpost.runner import Runner
from toolpost.store import Store
from toolpost.telemetry import Telemetry

log = logging.getLogger(__name__)

_STOP_TIMEOUT = 1.0
_INIT_LINES = "init_lines"


class Machine:
    """One machine (`DriverListener`).

    Args:
        name: its name.
        config: its configuration.
        store: jobs, programs and settings.
        telemetry: takes its reports.
        comm: its comm log.
        events: is told what happens.
    """

    def __init__(
        self,
        name: str,
        config: MachineConfig,
        store: Store,
        telemetry: Telemetry,
        comm: CommLog,
        events: Events,
    ) -> None:
        self.name = name
        self.config = config
        self._settings = store.settings
        self._telemetry = telemetry
        self._events = events
        self.init_lines: list[str] = store.settings.get(name, _INIT_LINES) or []
        self.driver: Driver = open_driver(name, config, comm, self)
        self.ledger = Ledger(
            name,
            store.jobs,
            keep_shown=config.history.shown,
            keep_stored=config.history.stored,
            changed=self._job_changed,
        )
        self.queue = JobQueue(
            name, config.queue, self.ledger, self.driver, store.settings, self._queue_changed
        )
        self.runner = Runner(name, self.ledger, self.driver, store.programs)
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Take up what the store knows and begin to drive."""
        self.ledger.load(load_on_startup=self.config.queue.load_on_startup)
        self.queue.load()
        self._tasks = [
            asyncio.create_task(self.driver.run(), name=f"{self.name}: link"),
            asyncio.create_task(self.runner.run(), name=f"{self.name}: runner"),
        ]
        for task in self._tasks:
            task.add_done_callback(self._task_ended)

    async def halt(self) -> None:
        """Stop the machine if it executes anything, and take no more commands."""
        job = self.ledger.active
        running = job is not None and job.state is JobState.PROCESSING
        if running or self.driver.state.execution is Execution.ACTIVE:
            log.warning("%s: stopped while it was executing", self.name)
            self.driver.stop()
            if job is not None and running:
                ended = job.to(JobState.ABORTED, Reason.HOST_STOPPED, now_us(), "Toolpost was stopped")
                await asyncio.wait([self.ledger.declare(ended)], timeout=_STOP_TIMEOUT)
            await self.driver.stopped(_STOP_TIMEOUT)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.queue.close()
        self.driver.close()
        self.ledger.close()

    async def set_init_lines(self, lines: list[str]) -> None:
        """Set the init lines; they are on disk when this returns.

        Raises:
            StorageError: they could not be stored, and the old ones still hold.
        """
        await self._settings.set(self.name, _INIT_LINES, lines)
        self.init_lines = lines

    # DriverListener

    def reported(self, report: Report) -> None:
        """The machine has reported."""
        self._telemetry.record(self.name, report)
        self._events.publish(Reported(self.name, report))

    def session_started(self) -> None:
        """The machine has just booted or been connected."""
        if self.config.auto_init:
            commands = self.driver.commands(self.init_lines)
            refused = [line for line in commands if not self.driver.enqueue(line)]
            if refused:
                log.error("%s: %d init lines could not be sent", self.name, len(refused))

    def changed(self) -> None:
        """The machine's state has changed."""
        self.runner.wake()
        self.queue.machine_changed()
        self._events.publish(MachineChanged(self.name, self.driver.state))

    def _queue_changed(self, action: QueueAction, listed: bool) -> None:
        self._events.publish(QueueChanged(self.name, action, listed))

    def _job_changed(self, job: Job) -> None:
        self.runner.wake()
        self.queue.job_changed(job)
        self._events.publish(JobChanged(job))

    def _task_ended(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            log.critical("%s ended: %r", task.get_name(), error, exc_info=error)
