"""The only starter of jobs: one for each machine."""

import asyncio
import logging

from toolpost.clock import now_us
from toolpost.core.job import Job, JobState, Reason
from toolpost.drivers.base import Driver, Ending, Outcome
from toolpost.errors import ProgramError, StorageError
from toolpost.ledger import Ledger
from toolpost.store.programs import ProgramReader, ProgramStore

log = logging.getLogger(__name__)

_RETRY_AFTER = 1.0


class Runner:
    """Starts a machine's next job when the machine is ready for it, and sees it to its end.

    Args:
        name: name of the machine, for messages.
        ledger: its jobs.
        driver: drives it.
        programs: where the programs are.
    """

    def __init__(self, name: str, ledger: Ledger, driver: Driver, programs: ProgramStore) -> None:
        self._name = name
        self._ledger = ledger
        self._driver = driver
        self._programs = programs
        self._wake = asyncio.Event()

    def wake(self) -> None:
        """Look whether a job can be started: something has changed."""
        self._wake.set()

    async def run(self) -> None:
        """Start jobs until canceled."""
        while True:
            self._wake.clear()
            job = self._ledger.next
            if job is not None and self._driver.ready:
                await self._run_guarded(job)
                continue
            if job is not None:
                away = not self._driver.state.alive
                self._ledger.explain(job, Reason.MACHINE_OFFLINE if away else Reason.MACHINE_BUSY)
            await self._wake.wait()

    async def _run_guarded(self, job: Job) -> None:
        """Run a job; a defect of ours ends the job, not the runner."""
        try:
            await self._run_job(job)
        except Exception:
            log.exception("%s: job %s", self._name, job.id)
            self._driver.stop()
            detail = "internal error; the server's log says more"
            self._end(job, Ending(Outcome.FAILED, Reason.INTERNAL_ERROR, detail))

    async def _run_job(self, job: Job) -> None:
        try:
            reader = await asyncio.to_thread(self._programs.open, job.program)
        except ProgramError as error:
            self._end(job, Ending(Outcome.FAILED, Reason.PROGRAM_MISSING, str(error)))
            return
        except StorageError as error:
            await self._wait_for_disk(job, error)
            return
        try:
            # The intent to start is on disk before the first byte leaves: a start happens at most once.
            present = self._ledger.next
            still = present is not None and present.seq == job.seq and self._driver.ready
            if still and await self._commit_start(job):
                await self._execute(job, reader)
        finally:
            reader.close()

    async def _commit_start(self, job: Job) -> bool:
        try:
            await self._ledger.change(job.to(JobState.PROCESSING, Reason.RUNNING, now_us()))
        except StorageError as error:
            await self._wait_for_disk(job, error)
            return False
        return self._is(job, JobState.PROCESSING)

    async def _wait_for_disk(self, job: Job, error: StorageError) -> None:
        log.error("%s: job %s cannot be started: %s", self._name, job.id, error)
        self._ledger.explain(job, Reason.STORAGE_FAILED)
        await asyncio.sleep(_RETRY_AFTER)

    def _is(self, job: Job, state: JobState) -> bool:
        """Whether the job is in a state now; it may have been canceled while this waited."""
        present = self._ledger.get(job.seq)
        return present is not None and present.state is state

    async def _execute(self, job: Job, reader: ProgramReader) -> None:
        log.info("%s: job %s started: %d commands", self._name, job.id, job.commands)
        ending = await self._driver.execute(reader, job.signals)
        self._end(job, ending)

    def _end(self, job: Job, ending: Ending) -> None:
        present = self._ledger.get(job.seq)
        if present is None or present.ended:
            log.info("%s: job %s %s", self._name, job.id, present.state if present else "ended")
            return
        at_us = now_us()
        if ending.outcome is Outcome.COMPLETED:
            ended = present.to(JobState.COMPLETED, Reason.DONE, at_us)
        else:
            ended = present.to(JobState.ABORTED, ending.reason, at_us, ending.detail)
        self._ledger.declare(ended)
        log.info("%s: job %s %s %s", self._name, ended.id, ended.state, ended.detail)
