"""The jobs of one machine, in memory and on disk.

Decisions are made on what is in memory, at once and on one thread; each of them is handed to the database
in the same order, and is acknowledged when it is on disk. What the machine itself has done is a fact,
whether the disk takes it or not: it is written again until it is.
"""

import asyncio
import logging
import secrets
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice

import msgspec

from toolpost.clock import now_us
from toolpost.core.job import Job, JobState, Reason, after_restart
from toolpost.core.program import Program
from toolpost.core.queue import active, next_to_start
from toolpost.store.jobs import JobStore

log = logging.getLogger(__name__)

SYSTEM = "system"
"""The actor of what Toolpost does by itself."""

_RETRY_AFTER = 1.0
_TRIM_EVERY = 100
_POSITION_STEP = 1 << 20


class Ledger:
    """The jobs of one machine.

    Args:
        machine: its name.
        store: where jobs are kept.
        keep_shown: ended jobs that are kept in memory, for lists.
        keep_stored: jobs that are kept on disk.
        changed: called with each job once its change is on disk.
    """

    def __init__(
        self,
        machine: str,
        store: JobStore,
        *,
        keep_shown: int,
        keep_stored: int,
        changed: Callable[[Job], None],
    ) -> None:
        self._machine = machine
        self._store = store
        self._keep_shown = keep_shown
        self._keep_stored = keep_stored
        self._changed = changed
        self._jobs: dict[int, Job] = {}
        self._unsaved: set[int] = set()
        self._open: dict[int, Job] = {}
        self._called: dict[int, Job] = {}
        self._queued: list[Job] | None = None
        self._random: list[str] = []
        self._changing: dict[int, Job] = {}
        self._debts: dict[int, tuple[Job, str]] = {}
        self._retry: asyncio.TimerHandle | None = None

    def load(self, *, load_on_startup: bool) -> None:
        """Read the jobs from the store; what was under way when the process ended is set right."""
        for job in self._store.load(self._machine, self._keep_shown):
            self._put(job)
            fixed = after_restart(job, load_on_startup=load_on_startup, at_us=now_us())
            if fixed is not job:
                self.declare(fixed)
        self._trim()

    def __iter__(self) -> Iterator[Job]:
        """Go through the jobs in the order of adding; those that are not on disk yet are left out."""
        return (job for seq, job in self._jobs.items() if seq not in self._unsaved)

    def get(self, seq: int) -> Job | None:
        """Return a job as it is now; None if it has ended and is not shown any more."""
        return self._jobs.get(seq)

    @property
    def open(self) -> list[Job]:
        """The jobs that have not ended, those not on disk yet included."""
        return list(self._open.values())

    @property
    def called(self) -> list[Job]:
        """The jobs that have not ended and do not just wait in the queue."""
        return list(self._called.values())

    @property
    def queued(self) -> list[Job]:
        """The jobs that wait in the queue, in order; those not on disk yet are left out."""
        if self._queued is None:
            waiting = [job for job in self._open.values() if _is_queued(job) and job.seq not in self._unsaved]
            self._queued = sorted(waiting, key=lambda job: (job.position, job.seq))
        return self._queued

    @property
    def active(self) -> Job | None:
        """The job that holds the machine."""
        return active(self._called.values())

    @property
    def next(self) -> Job | None:
        """The job to start once the machine is ready; none before it, or its call, is on disk."""
        job = next_to_start(self._called.values())
        return None if job is None or job.seq in self._unsaved or job.seq in self._changing else job

    def _random_part(self) -> str:
        """Return ten random hex digits; many are made at a time, because each call of the system counts."""
        if not self._random:
            digits = secrets.token_hex(5 * 256).upper()
            self._random = [digits[at : at + 10] for at in range(0, len(digits), 10)]
        return self._random.pop()

    def new(self, program: Program, signals: dict[str, float], *, name: str = "", called: bool = True) -> Job:
        """Return a new job, which is at the end of the queue once it is added."""
        seq = self._store.next_seq()
        return Job(
            seq=seq,
            id=f"{seq:06X}{self._random_part()}",
            machine=self._machine,
            program=program.sha256,
            commands=program.commands,
            name=name,
            position=seq * _POSITION_STEP,
            called=called,
            signals=signals,
            reason=Reason.MACHINE_BUSY if called else Reason.QUEUE_POSITION,
            created_us=now_us(),
        )

    async def add(self, jobs: Sequence[Job], actor: str) -> None:
        """Add new jobs; they are on disk when this returns.

        Raises:
            StorageError: they could not be stored, and there are no such jobs.
        """
        self._put_new(jobs)
        self._pay_debts()
        future = self._store.add(jobs, actor)
        # Not after the await: whoever waits may be canceled, and the jobs are on disk or not all the same.
        future.add_done_callback(partial(self._added, jobs))
        await asyncio.shield(future)

    async def change(self, *jobs: Job, added: Sequence[Job] = (), actor: str = SYSTEM) -> None:
        """Make transitions that a machine may rest on, and add new jobs; all is on disk when this returns.

        Raises:
            StorageError: they could not be stored, the jobs are as they were, and none is new.
        """
        self._put_new(added)
        before = [self._jobs[job.seq] for job in jobs]
        for job in jobs:
            self._put(job)
            self._changing[job.seq] = job
        self._pay_debts()
        future = self._store.update(jobs, now_us(), actor, added)
        future.add_done_callback(partial(self._added, added))  # As in `add`.
        future.add_done_callback(partial(self._settled, jobs, before))
        await asyncio.shield(future)

    async def delete(self, jobs: Sequence[Job]) -> None:
        """Forget jobs that have ended; they are gone from the disk when this returns.

        Raises:
            StorageError: it could not be stored, and they are still there.
        """
        self._pay_debts()
        future = self._store.delete([job.seq for job in jobs])
        future.add_done_callback(partial(self._deleted, jobs))  # As in `add`.
        await asyncio.shield(future)

    def explain(self, job: Job, reason: Reason) -> None:
        """Say why a pending job waits; it changes with the machine, so it is not stored."""
        job = self._jobs.get(job.seq, job)
        if job.state is JobState.PENDING:
            self._put(msgspec.structs.replace(job, reason=reason))

    def declare(self, job: Job, actor: str = SYSTEM) -> "asyncio.Future[None]":
        """Make a transition that has happened already; the future tells whether the disk took it at once.

        If it did not, it is tried again until it does, and always before what is stored later.
        """
        self._put(job)
        self._forget()
        self._pay_debts()
        return self._submit(job, actor)

    def end_called(self, state: JobState, reason: Reason, actor: str) -> "list[asyncio.Future[None]]":
        """End every job that has not ended and does not just wait in the queue, as `declare`."""
        at_us = now_us()
        return [self.declare(job.to(state, reason, at_us), actor) for job in self.called]

    def _trim(self) -> None:
        def trimmed(future: "asyncio.Future[None]") -> None:
            if not future.cancelled() and (error := future.exception()) is not None:
                log.warning("%s: old jobs could not be deleted: %s", self._machine, error)

        self._store.trim(self._machine, self._keep_stored).add_done_callback(trimmed)

    def _put_new(self, jobs: Sequence[Job]) -> None:
        for job in jobs:
            self._unsaved.add(job.seq)
            self._put(job)
        if any(job.seq % _TRIM_EVERY == 0 for job in jobs):
            self._trim()

    def _added(self, jobs: Sequence[Job], future: "asyncio.Future[None]") -> None:
        failed = future.cancelled() or future.exception() is not None
        self._queued = None
        for job in jobs:
            self._unsaved.discard(job.seq)
            if failed:
                self._jobs.pop(job.seq, None)
                self._open.pop(job.seq, None)
                self._called.pop(job.seq, None)
        for job in () if failed else jobs:
            self._changed(self._jobs.get(job.seq, job))

    def _deleted(self, jobs: Sequence[Job], future: "asyncio.Future[None]") -> None:
        if not future.cancelled() and future.exception() is None:
            for job in jobs:
                self._jobs.pop(job.seq, None)
                self._debts.pop(job.seq, None)

    def _settled(self, jobs: Sequence[Job], before: Sequence[Job], future: "asyncio.Future[None]") -> None:
        failed = future.cancelled() or future.exception() is not None
        for job, old in zip(jobs, before, strict=True):
            if self._changing.get(job.seq) is job:
                del self._changing[job.seq]
            if failed and self._jobs.get(job.seq) is job:
                self._put(old)
        self._forget()
        for job in () if failed else jobs:
            self._changed(job)

    def _submit(self, job: Job, actor: str) -> "asyncio.Future[None]":
        future = self._store.update([job], now_us(), actor)
        future.add_done_callback(partial(self._submitted, job, actor))
        return future

    def _submitted(self, job: Job, actor: str, future: "asyncio.Future[None]") -> None:
        if future.cancelled():
            return
        error = future.exception()
        if error is None:
            self._changed(job)
            return
        if self._jobs.get(job.seq, job) is not job:
            return  # A later transition has been handed to the disk, which must not be overwritten.
        log.error("%s: job %s: %s; trying again", self._machine, job.id, error)
        self._debts[job.seq] = (job, actor)
        if self._retry is None:
            self._retry = asyncio.get_running_loop().call_later(_RETRY_AFTER, self._pay_debts)

    def _pay_debts(self) -> None:
        """Hand to the disk again what it has not taken."""
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        debts, self._debts = self._debts, {}
        for job, actor in debts.values():
            self._submit(job, actor)

    def close(self) -> None:
        """Give up what the disk has not taken."""
        if self._retry is not None:
            self._retry.cancel()

    def _put(self, job: Job) -> None:
        self._jobs[job.seq] = job
        self._queued = None
        if _is_queued(job):
            self._called.pop(job.seq, None)
        elif not job.ended:
            self._called[job.seq] = job
        if not job.ended:
            self._open[job.seq] = job
            return
        self._open.pop(job.seq, None)
        self._called.pop(job.seq, None)

    def _forget(self) -> None:
        """Leave the oldest ended jobs that are too many, but none whose end may still be undone."""
        surplus = len(self._jobs) - len(self._open) - self._keep_shown
        if surplus > 0:
            ended = (seq for seq, job in self._jobs.items() if job.ended and seq not in self._changing)
            for seq in list(islice(ended, surplus)):
                del self._jobs[seq]


def _is_queued(job: Job) -> bool:
    return job.state is JobState.PENDING and not job.called
