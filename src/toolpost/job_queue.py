"""The queue of one machine at work: it calls its jobs one by one, and the runner starts what is called."""

import asyncio
import logging
from collections.abc import Callable, Iterable, Sequence

import msgspec

from toolpost.clock import now_us
from toolpost.config import QueueConfig
from toolpost.core.job import Job, JobState, Reason
from toolpost.core.program import Program
from toolpost.core.queue import QueueState, QueueView, reconcile, state_after_load
from toolpost.drivers.base import Driver, Outcome
from toolpost.errors import StorageError, ToolpostError
from toolpost.events import QueueAction
from toolpost.ledger import Ledger
from toolpost.store.settings import SettingStore

log = logging.getLogger(__name__)

_STATE = "queue_state"


class JobQueue:
    """The queue of one machine (moonraker_job_queue.md).

    Args:
        machine: its name.
        config: its options.
        ledger: the machine's jobs.
        driver: drives it.
        settings: keep the queue's state over a restart.
        tell: called with what has happened to the queue, once that is on disk, and whether its jobs or their
            order have changed.
    """

    def __init__(
        self,
        machine: str,
        config: QueueConfig,
        ledger: Ledger,
        driver: Driver,
        settings: SettingStore,
        tell: Callable[[QueueAction, bool], None],
    ) -> None:
        self._machine = machine
        self._config = config
        self._ledger = ledger
        self._driver = driver
        self._settings = settings
        self._tell = tell
        self._state = QueueState.PAUSED
        self._loading: asyncio.Task[None] | None = None
        self._called: Job | None = None
        self._fresh = config.load_on_startup
        self._pause_requested = False

    def load(self) -> None:
        """Take up the state in which the queue was left."""
        if self._settings.get(self._machine, _STATE) == QueueState.READY and self._ledger.queued:
            self._state = QueueState.READY

    @property
    def view(self) -> QueueView:
        """The queue as its clients see it."""
        jobs = self._ledger.queued
        if self._called is not None:
            jobs = [self._called, *jobs]
        return QueueView(self._state, jobs)

    # What clients ask for.

    async def add(self, entries: Sequence[tuple[str, Program]], actor: str) -> None:
        """Add jobs at the end; they are on disk when this returns.

        Raises:
            StorageError: they could not be stored, and none of them is in the queue.
        """
        if not entries:
            return
        jobs = [self._ledger.new(program, {}, name=name, called=False) for name, program in entries]
        await self._ledger.add(jobs, actor)
        self._added()

    async def replace(
        self,
        entries: Sequence[tuple[str, Program]],
        shown: frozenset[str] | None,
        actor: str,
    ) -> None:
        """Make the queue a list of files; jobs that are in it already are kept (`reconcile`). As `add`."""
        programs = dict(entries)
        plan = reconcile(self._ledger.queued, [name for name, _ in entries], shown)
        at_us = now_us()
        changed = [
            job.to(JobState.CANCELED, Reason.CANCELED_BY_USER, at_us, "removed from the queue")
            for job in plan.removed
        ]
        added = []
        last = -1
        for job in plan.order:
            if isinstance(job, str):
                new = self._ledger.new(programs[job], {}, name=job, called=False)
                last = max(last + 1, new.position)
                added.append(msgspec.structs.replace(new, position=last))
            elif job.position > last:
                last = job.position
            else:
                last += 1
                changed.append(msgspec.structs.replace(job, position=last))
        if changed or added:
            await self._ledger.change(*changed, added=added, actor=actor)
        self._added()

    async def remove(self, job_ids: Iterable[str] | None, actor: str) -> None:
        """Remove waiting jobs, all of them for None; ids that are not in the queue are ignored.

        Raises:
            StorageError: it could not be stored, and all of them are still there.
        """
        wanted = None if job_ids is None else set(job_ids)
        found = [job for job in self.view.jobs if wanted is None or job.id in wanted]
        if not found:
            return
        if self._called is not None and self._called in found:
            self._called = None
            self._abort_load()
        at_us = now_us()
        detail = "removed from the queue"
        ended = [job.to(JobState.CANCELED, Reason.CANCELED_BY_USER, at_us, detail) for job in found]
        await self._ledger.change(*ended, actor=actor)
        self._tell(QueueAction.JOBS_REMOVED, True)

    async def jump(self, job_id: str, actor: str) -> bool:
        """Put a waiting job first; False if there is none of that id.

        Raises:
            StorageError: it could not be stored, and the order is as it was.
        """
        jobs = self._ledger.queued
        job = next((job for job in jobs if job.id == job_id), None)
        if job is None:
            return False
        if jobs[0] is not job:
            first = msgspec.structs.replace(job, position=jobs[0].position - 1)
            await self._ledger.change(first, actor=actor)
        self._tell(QueueAction.STATE_CHANGED, True)
        return True

    async def pause(self) -> None:
        """Load nothing more; a load under way is aborted at once.

        Raises:
            StorageError: it could not be stored; the queue is paused all the same.
        """
        called = self._called
        self._pause_requested = True
        self.halt()
        if called is not None and self._is_waiting(called):
            await self._ledger.change(
                msgspec.structs.replace(called, called=False, reason=Reason.QUEUE_POSITION)
            )
        await self._settings.set(self._machine, _STATE, QueueState.PAUSED)

    def halt(self) -> None:
        """Be paused at once; what waits stays in the queue."""
        self._abort_load()
        self._called = None
        self._enter(QueueState.PAUSED)

    async def start(self) -> None:
        """Load the next job now if the machine is free, otherwise when it has completed what it does.

        Raises:
            StorageError: it could not be stored.
        """
        self._pause_requested = False
        if self._state in {QueueState.LOADING, QueueState.STARTING}:
            return
        if not self._ledger.queued:
            self._enter(QueueState.PAUSED)
        elif self._driver.ready and not self._ledger.called:
            self._begin_load(delay=0.0, gcode="")
            return
        else:
            self._enter(QueueState.READY)
        await self._settings.set(self._machine, _STATE, self._state)

    # What the machine does.

    def machine_changed(self) -> None:
        """Load the first job once after the start of Toolpost, where that is wanted."""
        if self._fresh and self._driver.ready:
            self._fresh = False
            if self._ledger.queued and not self._ledger.called:
                self._begin_load(delay=self._config.job_transition_delay, gcode="")

    def job_changed(self, job: Job) -> None:
        """Go on as a job goes on; called when its change is on disk."""
        if self._called is not None and job.seq == self._called.seq and not self._is_waiting(job):
            self._called = None
            if job.state is JobState.PROCESSING:
                self._loaded()
            elif self._state is QueueState.STARTING:
                self._enter(QueueState.PAUSED)
            return
        if self._state is QueueState.READY and job.ended and job.started_us is not None:
            if job.state is not JobState.COMPLETED or not self._ledger.queued:
                self._enter(QueueState.PAUSED)
            elif not self._ledger.called:
                config = self._config
                self._begin_load(delay=config.job_transition_delay, gcode=config.job_transition_gcode)

    def close(self) -> None:
        """Call nothing more."""
        if self._loading is not None:
            self._loading.cancel()

    def _added(self) -> None:
        self._tell(QueueAction.JOBS_ADDED, True)
        goes_on = self._config.automatic_transition and not self._pause_requested
        if goes_on and self._state is QueueState.PAUSED and self._ledger.called and self._ledger.queued:
            self._enter(QueueState.READY)

    def _loaded(self) -> None:
        state = state_after_load(
            jobs_left=bool(self._ledger.queued),
            automatic_transition=self._config.automatic_transition,
        )
        self._state = state
        self._remember(state)
        self._tell(QueueAction.JOB_LOADED, True)

    def _begin_load(self, *, delay: float, gcode: str) -> None:
        self._enter(QueueState.LOADING)
        self._loading = asyncio.get_running_loop().create_task(self._load(delay, gcode))

    async def _load(self, delay: float, gcode: str) -> None:
        try:
            if delay:
                await asyncio.sleep(delay)
            if gcode.strip():
                await self._run_gcode(gcode)
            queued = self._ledger.queued
            if not queued or self._ledger.called:
                self._enter(QueueState.PAUSED)
                return
            self._enter(QueueState.STARTING)
            self._called = msgspec.structs.replace(queued[0], called=True, reason=Reason.MACHINE_BUSY)
            await self._ledger.change(self._called)
        except (StorageError, ToolpostError) as error:
            log.error("%s: the next job could not be loaded: %s", self._machine, error)
            self._called = None
            self._enter(QueueState.PAUSED)

    async def _run_gcode(self, gcode: str) -> None:
        """Execute the commands between two jobs; ToolpostError if they do not run to their end."""
        source = _Lines(self._driver.commands(gcode.splitlines()))
        ending = await self._driver.execute(source, {})
        if ending.outcome is not Outcome.COMPLETED:
            raise ToolpostError(f"job_transition_gcode: {ending.detail or ending.outcome.name.lower()}")

    def _abort_load(self) -> None:
        if self._loading is None or self._loading.done() or self._state is not QueueState.LOADING:
            return
        self._loading.cancel()
        if self._driver.state.job_sent:
            self._driver.stop()

    def _is_waiting(self, job: Job) -> bool:
        present = self._ledger.get(job.seq)
        return present is not None and present.state is JobState.PENDING

    def _enter(self, state: QueueState) -> None:
        if state is not self._state:
            self._state = state
            self._remember(state)
            self._tell(QueueAction.STATE_CHANGED, False)

    def _remember(self, state: QueueState) -> None:
        """Keep a state that a restart may take up; a load under way is none."""
        if state in {QueueState.READY, QueueState.PAUSED}:
            stored = self._settings.submit(self._machine, _STATE, state)
            stored.add_done_callback(self._remembered)

    def _remembered(self, stored: "asyncio.Future[None]") -> None:
        if not stored.cancelled() and (error := stored.exception()) is not None:
            log.warning("%s: the queue's state: %s", self._machine, error)


class _Lines:
    """Commands in memory (`LineSource`)."""

    def __init__(self, commands: list[bytes]) -> None:
        self._commands = commands

    @property
    def exhausted(self) -> bool:
        return not self._commands

    def take(self, most: int) -> list[bytes]:
        taken, self._commands = self._commands[:most], self._commands[most:]
        return taken
