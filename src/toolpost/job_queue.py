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
from toolpost.errors import ToolpostError
from toolpost.events import QueueAction
from toolpost.ledger import Ledger
from toolpost.store.settings import SettingStore

log = logging.getLogger(__name__)

_KEPT = "queue"


class _Kept(msgspec.Struct, frozen=True):
    """What of a queue outlives a restart, beside its jobs."""

    state: QueueState
    pause_requested: bool


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
        self._resting = QueueState.PAUSED
        self._kept: asyncio.Future[None] | None = None
        self._loading: asyncio.Task[None] | None = None
        self._in_gcode = False
        self._called: int | None = None
        self._fresh = config.load_on_startup
        self._asked = False
        self._pause_requested = False

    def load(self) -> None:
        """Take up the state in which the queue was left."""
        stored = self._settings.get(self._machine, _KEPT)
        if stored is None:
            return
        kept = msgspec.convert(stored, _Kept)
        self._pause_requested = kept.pause_requested
        # Ready means that there is a job whose completion is awaited; a load that was cut off is none.
        if kept.state is QueueState.READY and self._ledger.queued and self._ledger.called:
            self._state = self._resting = QueueState.READY
        else:
            self._remember(QueueState.PAUSED)

    @property
    def view(self) -> QueueView:
        """The queue as its clients see it."""
        jobs = self._ledger.queued
        called = None if self._called is None else self._ledger.get(self._called)
        if called is not None:
            jobs = sorted([called, *jobs], key=lambda job: (job.position, job.seq))
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
        await self._added()

    async def replace(
        self,
        entries: Sequence[tuple[str, Program]],
        shown: frozenset[str] | None,
        actor: str,
    ) -> None:
        """Make the queue a list of files; jobs that are in it already are kept (`reconcile`). As `add`."""
        programs = dict(entries)
        plan = reconcile(self.view.jobs, [name for name, _ in entries], shown)
        changed = self._removed(plan.removed)
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
        self._pause_if_empty()
        await self._added()

    async def remove(self, job_ids: Iterable[str] | None, actor: str) -> None:
        """Remove waiting jobs, all of them for None; ids that are not in the queue are ignored.

        Raises:
            StorageError: it could not be stored, and all of them are still there.
        """
        wanted = None if job_ids is None else set(job_ids)
        found = [job for job in self.view.jobs if wanted is None or job.id in wanted]
        if not found:
            return
        await self._ledger.change(*self._removed(found), actor=actor)
        self._pause_if_empty()
        self._tell(QueueAction.JOBS_REMOVED, True)

    async def jump(self, job_id: str, actor: str) -> bool:
        """Put a waiting job first; False if there is none of that id.

        Raises:
            StorageError: it could not be stored, and the order is as it was.
        """
        jobs = self.view.jobs
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
        self._pause_requested = True
        self._give_up()
        await self._remember(QueueState.PAUSED)

    def halt(self) -> None:
        """Be paused at once; what waits stays in the queue."""
        self._fresh = self._asked = False
        aborts = self._state is QueueState.LOADING
        self._enter(QueueState.PAUSED)
        if aborts and self._loading is not None:
            self._loading.cancel()
        if self._in_gcode:
            self._driver.stop()

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
            self._remember(self._resting)
            return
        else:
            self._enter(QueueState.READY)
            # Without a job there is no completion to wait for: single commands, or the hold-off of a stop.
            self._asked = not self._ledger.called and self._driver.accepting
        await self._remember(self._resting)

    # What the machine does.

    def machine_changed(self) -> None:
        """Load what is to be loaded once the machine is ready; pause if it goes away before a job has begun.

        Nothing is to move by itself when a machine is back.
        """
        begun = self._state in {QueueState.LOADING, QueueState.STARTING}
        if (begun or self._asked) and not self._driver.accepting:
            log.error("%s: the next job could not be loaded: the machine does not answer", self._machine)
            self._give_up()
        elif (self._fresh or self._asked) and self._driver.ready:
            delay = 0.0 if self._asked else self._config.job_transition_delay
            self._fresh = self._asked = False
            if self._may_load and not begun:
                self._begin_load(delay=delay, gcode="")

    def job_changed(self, job: Job) -> None:
        """Go on as a job goes on; called when its change is on disk."""
        if job.seq == self._called and not self._is_waiting(job):
            self._called = None
            if job.state is JobState.PROCESSING:
                self._loaded()
            else:
                self._enter(QueueState.PAUSED)
                self._tell(QueueAction.JOBS_REMOVED, True)
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

    @property
    def _may_load(self) -> bool:
        return bool(self._ledger.queued) and not self._ledger.called

    async def _added(self) -> None:
        self._tell(QueueAction.JOBS_ADDED, True)
        goes_on = self._config.automatic_transition and not self._pause_requested
        if goes_on and self._state is QueueState.PAUSED and self._ledger.called and self._ledger.queued:
            self._enter(QueueState.READY)
            if self._kept is not None:
                await asyncio.wait([self._kept])

    def _removed(self, jobs: Sequence[Job]) -> list[Job]:
        """Return waiting jobs as they are once they are removed; the load of one of them is aborted."""
        if any(job.seq == self._called for job in jobs):
            self._give_up()
        present = [self._ledger.get(job.seq) or job for job in jobs]
        at_us = now_us()
        detail = "removed from the queue"
        return [job.to(JobState.CANCELED, Reason.CANCELED_BY_USER, at_us, detail) for job in present]

    def _pause_if_empty(self) -> None:
        if not self._ledger.queued and self._state in {QueueState.READY, QueueState.LOADING}:
            self._give_up()

    def _loaded(self) -> None:
        if self._state is QueueState.STARTING:
            self._state = self._state_after_load(jobs_left=bool(self._ledger.queued))
            self._remember(self._state)
        self._tell(QueueAction.JOB_LOADED, True)

    def _state_after_load(self, *, jobs_left: bool) -> QueueState:
        return state_after_load(jobs_left=jobs_left, automatic_transition=self._config.automatic_transition)

    def _begin_load(self, *, delay: float, gcode: str) -> None:
        self._enter(QueueState.LOADING)
        self._loading = asyncio.get_running_loop().create_task(self._load(delay, gcode))

    async def _load(self, delay: float, gcode: str) -> None:
        try:
            if delay:
                await asyncio.sleep(delay)
            if gcode.strip() and self._may_load:
                await self._run_gcode(gcode)
            if not self._may_load:
                self._enter(QueueState.PAUSED)
                return
            await self._call(self._ledger.queued)
        except ToolpostError as error:
            log.error("%s: the next job could not be loaded: %s", self._machine, error)
            self._give_up()
        except Exception:
            log.exception("%s: the next job could not be loaded", self._machine)
            self._give_up()

    async def _call(self, queued: Sequence[Job]) -> None:
        """Call the first job: from now on it is the runner's."""
        self._called = queued[0].seq
        self._enter(QueueState.STARTING)
        # On disk before the job's start is, so that no crash in between leaves it untrue.
        self._remember(self._state_after_load(jobs_left=len(queued) > 1))
        await self._ledger.change(msgspec.structs.replace(queued[0], called=True, reason=Reason.MACHINE_BUSY))

    async def _run_gcode(self, gcode: str) -> None:
        """Execute the commands between two jobs; ToolpostError if they do not run to their end."""
        source = _Lines(self._driver.commands(gcode.splitlines()))
        self._in_gcode = True
        try:
            ending = await self._driver.execute(source, {})
        finally:
            self._in_gcode = False
        if ending.outcome is not Outcome.COMPLETED:
            raise ToolpostError(f"job_transition_gcode: {ending.detail or ending.outcome.name.lower()}")

    def _give_up(self) -> None:
        """Be paused at once, as `halt`; a job that is called but not being started yet waits again."""
        called = None if self._called is None else self._ledger.get(self._called)
        if called is not None and called.state is JobState.PENDING:
            self._called = None
            self._ledger.declare(msgspec.structs.replace(called, called=False, reason=Reason.QUEUE_POSITION))
        self.halt()

    def _is_waiting(self, job: Job) -> bool:
        present = self._ledger.get(job.seq)
        return present is not None and present.state is JobState.PENDING

    def _enter(self, state: QueueState) -> None:
        if state is not self._state:
            self._state = state
            if state in {QueueState.READY, QueueState.PAUSED}:
                self._remember(state)
            self._tell(QueueAction.STATE_CHANGED, False)

    def _remember(self, state: QueueState) -> "asyncio.Future[None]":
        """Keep the state that a restart takes up; the future is done when it is on disk."""
        self._resting = state
        kept = _Kept(state, self._pause_requested)
        self._kept = self._settings.submit(self._machine, _KEPT, kept)
        self._kept.add_done_callback(self._remembered)
        return self._kept

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
