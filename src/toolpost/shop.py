"""The one service that every dialect calls: calls and answers are structs, and nothing here knows HTTP."""

import asyncio
from collections.abc import Iterable, Iterator, Sequence

import msgspec

from toolpost.clock import now_us
from toolpost.config import Address, QueueConfig
from toolpost.core.grid import SampleGrid
from toolpost.core.job import Job, JobState, Reason
from toolpost.core.machine import LinkState, MachineState
from toolpost.core.program import Program
from toolpost.core.queue import QueueState, QueueView
from toolpost.core.report import Report, Value
from toolpost.drivers.base import LineKind
from toolpost.errors import InvalidLineError, InvalidRequestError, NotAcceptedError, StorageError
from toolpost.gcode.entries import PinnedFile
from toolpost.gcode.reader import read_lines
from toolpost.machine import Machine
from toolpost.store import Store
from toolpost.store.files import Files
from toolpost.store.namespaces import NamespaceStore
from toolpost.telemetry import Telemetry

_READERS = 4
_PROGRAMS_KNOWN = 10_000


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """A machine in brief.

    Attributes:
        time_us: Unix time of this status, microseconds.
        alive: whether the machine answers.
        host_commands: commands that Toolpost has still to send, those of waiting jobs included.
        machine_commands: commands sent that the machine is not known to have executed.
        running_job: id of the job that holds the machine.
    """

    time_us: int
    alive: bool
    host_commands: int
    machine_commands: int
    running_job: str | None


class Progress(msgspec.Struct, frozen=True):
    """How far a job is, in commands."""

    sent: int
    executed: int


class Shop:
    """All machines, and what can be asked of them.

    Args:
        machines: by name; the first is the default one.
        store: jobs, programs and settings.
        telemetry: the reports.
        files: the ``gcodes`` root.
        programs_bytes: bound of the programs that no job needs.
        address: where the server listens first of all, as it is configured.
    """

    def __init__(
        self,
        machines: dict[str, Machine],
        store: Store,
        telemetry: Telemetry,
        files: Files,
        programs_bytes: int,
        address: Address | None = None,
    ) -> None:
        self._machines = machines
        self._programs = store.programs
        self._stored_jobs = store.jobs
        self._telemetry = telemetry
        self._programs_bytes = programs_bytes
        self._files = files
        self._namespaces = store.namespaces
        self._address = address
        self._made: dict[tuple[str, str], Program] = {}
        self._making = 0
        # Each may make a large answer: so many at a time, whatever is asked.
        self._readers = asyncio.Semaphore(_READERS)
        self._adding: dict[str, int] = dict.fromkeys(machines, 0)
        self._cancels: dict[str, int] = dict.fromkeys(machines, 0)

    @property
    def machines(self) -> list[str]:
        """The names of all machines, the default one first."""
        return list(self._machines)

    @property
    def files(self) -> Files:
        """The ``gcodes`` root, which all machines share."""
        return self._files

    @property
    def namespaces(self) -> NamespaceStore:
        """What clients keep here for themselves; all machines share it."""
        return self._namespaces

    @property
    def address(self) -> Address | None:
        """Where the server listens first of all, as it is configured."""
        return self._address

    # Lines

    async def write_line(self, machine: str, text: str, *, urgent: bool | None, actor: str) -> bool:
        """Send a single line; return whether it was taken.

        A stop cancels everything, as `cancel`. A signal goes ahead of all commands. A command is not taken
        while a job has not ended, for it would end up in the middle of it, unless it is declared urgent.

        Args:
            machine: name of the machine.
            text: the line; a comment in it is not sent.
            urgent: send ahead of all commands (True), behind them (False), or as the line demands (None).
            actor: who asks.

        Raises:
            InvalidRequestError: the line must not go to this machine.
        """
        target = self._machines[machine]
        line = target.driver.line(text)
        if line.kind is LineKind.STOP:
            await self.cancel(machine, actor)
            return True
        if urgent is None:
            urgent = line.kind is LineKind.SIGNAL
        if not urgent and (target.ledger.called or self._adding[machine]):
            return False
        if line.kind is LineKind.NOTHING:
            return True
        if urgent or line.kind is LineKind.SIGNAL:
            return target.driver.send_now(line.payload)
        return target.driver.enqueue(line.payload)

    def is_stop(self, machine: str, text: str) -> bool:
        """Whether a line stops the machine.

        Raises:
            InvalidRequestError: the line must not go to this machine.
        """
        return self._machines[machine].driver.line(text).kind is LineKind.STOP

    def check_poll(self, machine: str, text: str) -> str:
        """Return the line to send at intervals that `text` stands for.

        Raises:
            InvalidRequestError: it is no line that may be sent again and again.
        """
        line = self._machines[machine].driver.line(text)
        if line.kind in {LineKind.NOTHING, LineKind.STOP}:
            raise InvalidRequestError("must be a line that may be sent while a job runs")
        return line.payload.decode("ascii")

    # Jobs

    async def submit(
        self,
        machine: str,
        lines: Iterable[Sequence[str]],
        signals: dict[str, float],
        *,
        actor: str,
    ) -> Job:
        """Add a job if no other is waiting or running; it is on disk when this returns.

        Args:
            machine: name of the machine.
            lines: the lines of the program, in blocks; gone through in another thread.
            signals: lines to send while the job runs, with their intervals in seconds.
            actor: who asks.

        Raises:
            NotAcceptedError: there is a job that has not ended, or the machine does not answer.
            InvalidLineError: a line is no command.
            StorageError: it could not be stored, and there is no such job.
        """
        target = self._machines[machine]
        if target.ledger.called or self._adding[machine]:
            raise NotAcceptedError("a job has not ended")
        if not target.driver.accepting:
            raise NotAcceptedError("the machine does not answer")
        cancels = self._cancels[machine]
        self._adding[machine] += 1
        try:
            program = await asyncio.to_thread(self._programs.add, _commands(target, lines))
            if self._cancels[machine] != cancels:
                raise NotAcceptedError("everything was canceled meanwhile")
            job = target.ledger.new(program, signals)
            await target.ledger.add([job], actor)
        finally:
            self._adding[machine] -= 1
        self._trim_programs()
        return target.ledger.get(job.seq) or job

    async def print_file(self, machine: str, name: str, *, actor: str) -> Job:
        """Run a file now, ahead of the queue; the job is on disk when this returns.

        Args:
            machine: name of the machine.
            name: a file in the ``gcodes`` root; what it holds now is what will run.
            actor: who asks.

        Raises:
            FileMissingError, InvalidRequestError: it is not there or no program for this machine.
            NotAcceptedError: the machine is busy or does not answer.
            StorageError: it could not be stored, and there is no such job.
        """
        target = self._machines[machine]
        self._check_free(target)
        cancels = self._cancels[machine]
        self._adding[machine] += 1
        try:
            file = await self._files.pin(name)
            program = await asyncio.to_thread(self._program_of, target, name, file)
            if self._cancels[machine] != cancels:
                raise NotAcceptedError("everything was canceled meanwhile")
            self._check_free(target, adding=1)
            job = target.ledger.new(program, {}, name=name)
            await target.ledger.add([job], actor)
        finally:
            self._adding[machine] -= 1
        return target.ledger.get(job.seq) or job

    def _check_free(self, target: Machine, adding: int = 0) -> None:
        """NotAcceptedError if a job could not start at once; `adding` are being added by the caller."""
        if target.ledger.called or self._adding[target.name] > adding:
            raise NotAcceptedError("a job has not ended")
        if target.queue.view.state in {QueueState.LOADING, QueueState.STARTING}:
            raise NotAcceptedError("the queue is loading a job")
        if not target.driver.accepting:
            raise NotAcceptedError("the machine does not answer")

    async def cancel(self, machine: str, actor: str) -> None:
        """Stop a machine, cancel every job that runs or is about to, and pause its queue.

        The machine is told before this awaits anything; the jobs' end is on disk when it returns.

        Raises:
            StorageError: all was stopped, but the disk did not take the record of it yet.
        """
        target = self._machines[machine]
        self._cancels[machine] += 1
        target.driver.stop()
        target.queue.halt()
        records = target.ledger.end_called(JobState.CANCELED, Reason.CANCELED_BY_USER, actor)
        results = await asyncio.gather(*records, return_exceptions=True)
        if any(isinstance(result, StorageError) for result in results):
            raise StorageError("everything was stopped, but the disk did not take the record of it")

    def jobs(self, machine: str) -> list[Job]:
        """Return a machine's jobs in the order of adding."""
        return list(self._machines[machine].ledger)

    def active_job(self, machine: str) -> Job | None:
        """Return the job that holds the machine."""
        return self._machines[machine].ledger.active

    def job(self, machine: str, seq: int) -> Job | None:
        """Return a job as it is now; None if it is not kept in memory."""
        return self._machines[machine].ledger.get(seq)

    async def delete_jobs(self, machine: str, jobs: Sequence[Job]) -> None:
        """Forget jobs that have ended.

        Raises:
            NotAcceptedError: one has not ended.
            StorageError: it could not be stored, and they are still there.
        """
        if not all(job.ended for job in jobs):
            raise NotAcceptedError("a job that has not ended cannot be deleted")
        await self._machines[machine].ledger.delete(jobs)

    def progress(self, job: Job) -> Progress | None:
        """Return how far a job is; None if that is not known, as of a job that did not end well."""
        if job.state is JobState.PROCESSING:
            state = self._machines[job.machine].driver.state
            executed = max(0, state.job_sent - state.machine_commands)
            return Progress(state.job_sent, executed)
        if job.state is JobState.COMPLETED:
            return Progress(job.commands, job.commands)
        return Progress(0, 0) if job.started_us is None else None

    def status(self, machine: str) -> Status:
        """Return a machine in brief."""
        target = self._machines[machine]
        state = target.driver.state
        host_commands = state.waiting_commands
        for job in target.ledger.called:
            if job.state is JobState.PROCESSING:
                host_commands += job.commands - state.job_sent
            elif job.state is not JobState.PROCESSING_STOPPED:
                host_commands += job.commands
        active = target.ledger.active
        return Status(
            time_us=now_us(),
            alive=state.alive,
            host_commands=host_commands,
            machine_commands=state.machine_commands,
            running_job=active.id if active is not None else None,
        )

    # The queue

    def queue_config(self, machine: str) -> QueueConfig:
        """Return the options of a machine's queue."""
        return self._machines[machine].config.queue

    def queue(self, machine: str) -> QueueView:
        """Return a machine's queue."""
        return self._machines[machine].queue.view

    async def enqueue(
        self,
        machine: str,
        names: Sequence[str],
        *,
        replace: bool,
        shown: frozenset[str] | None,
        actor: str,
    ) -> None:
        """Add files to a queue, or make the queue a list of files; it is on disk when this returns.

        Args:
            machine: name of the machine.
            names: files in the ``gcodes`` root; what they hold now is what will run.
            replace: the list is the whole queue; jobs that are in it already are kept (`reconcile`).
            shown: ids of the jobs that the client has been shown, None for all; no other is removed.
            actor: who asks.

        Raises:
            FileMissingError, InvalidRequestError: a file is not there or no program for this machine, and
                nothing has changed.
            StorageError: it could not be stored.
        """
        target = self._machines[machine]
        distinct = list(dict.fromkeys(names))
        # No program is deleted until the jobs that need it are there.
        self._making += 1
        try:
            pinned = await self._files.pin_all(distinct)
            programs = {}
            for name, file in zip(distinct, pinned, strict=True):
                programs[name] = await asyncio.to_thread(self._program_of, target, name, file)
            entries = [(name, programs[name]) for name in names]
            if replace:
                await target.queue.replace(entries, shown, actor)
            else:
                await target.queue.add(entries, actor)
        finally:
            self._making -= 1
        self._trim_programs()

    async def dequeue(self, machine: str, job_ids: Sequence[str] | None, actor: str) -> None:
        """Remove waiting jobs, all of them for None; StorageError if that could not be stored."""
        await self._machines[machine].queue.remove(job_ids, actor)

    async def jump(self, machine: str, job_id: str, actor: str) -> None:
        """Put a waiting job first.

        Raises:
            InvalidRequestError: there is no such job in the queue.
            StorageError: it could not be stored.
        """
        if not await self._machines[machine].queue.jump(job_id, actor):
            raise InvalidRequestError(f"Invalid job id: {job_id}")

    async def pause_queue(self, machine: str) -> None:
        """Load nothing more."""
        await self._machines[machine].queue.pause()

    async def start_queue(self, machine: str) -> None:
        """Load the next job, now or when the machine has completed what it does."""
        await self._machines[machine].queue.start()

    def _program_of(self, target: Machine, name: str, file: PinnedFile) -> Program:
        """Return the program that a file is to a machine. Blocks."""
        key = (target.config.driver, file.sha256)
        known = self._made.get(key)
        if known is not None and self._programs.has(known.sha256):
            return known
        try:
            program = self._programs.add(_commands(target, read_lines(file.path)))
        except InvalidLineError as error:
            raise InvalidRequestError(f"{name}, line {error.index + 1}: {error.problem}") from None
        if len(self._made) >= _PROGRAMS_KNOWN:
            self._made.clear()
        self._made[key] = program
        return program

    def state(self, machine: str) -> MachineState:
        """Return a machine as it is known now."""
        return self._machines[machine].driver.state

    def link(self, machine: str) -> LinkState:
        """Return the state of a machine's link."""
        return self._machines[machine].driver.state.link

    # Init lines

    def init_lines(self, machine: str) -> list[str]:
        """Return the lines that make a machine ready after its boot."""
        return self._machines[machine].init_lines

    async def set_init_lines(self, machine: str, lines: list[str]) -> None:
        """Set the init lines; they are on disk when this returns.

        Blank lines are left out, comments are kept.

        Raises:
            InvalidLineError: a line is no command.
            StorageError: they could not be stored, and the old ones still hold.
        """
        target = self._machines[machine]
        target.driver.commands(lines)
        await target.set_init_lines([line.strip() for line in lines if line.strip()])

    # Telemetry

    def latest(self, machine: str, tag: str) -> Report | None:
        """Return the latest report of a tag, which may be from before a restart."""
        return self._telemetry.latest(machine, tag)

    async def reports(self, machine: str, tag: str, count: int) -> list[Report]:
        """Return the latest reports of a tag, the latest first."""
        async with self._readers:
            return await self._telemetry.history(machine, tag, count)

    async def query(self, machine: str, keys: Sequence[str], grid: SampleGrid) -> dict[str, list[Value]]:
        """Return the series named ``tag.key``, sampled at the times of `grid`."""
        async with self._readers:
            return await self._telemetry.query(machine, keys, grid)

    def _trim_programs(self) -> None:
        if self._making or any(self._adding.values()) or self._programs.size <= self._programs_bytes:
            return
        # Jobs that are not on disk yet, and those of machines that are not configured any more.
        in_use = {job.program for m in self._machines.values() for job in m.ledger.open}
        in_use |= self._stored_jobs.programs_in_use()
        self._programs.trim(in_use, self._programs_bytes)


def _commands(target: Machine, lines: Iterable[Sequence[str]]) -> Iterator[list[bytes]]:
    done = 0
    for block in lines:
        try:
            yield target.driver.commands(block)
        except InvalidLineError as error:
            raise InvalidLineError(done + error.index, error.problem) from None
        done += len(block)
