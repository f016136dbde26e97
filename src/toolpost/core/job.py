"""Jobs and the rules of their life.

A job is one run of one program on one machine. Its states are those of IPP (RFC 8011, section 5.3.7),
always with a reason; every transition goes through `Job.to`, which refuses what the rules do not allow.
"""

import enum
from typing import Final

import msgspec

from toolpost.errors import ToolpostError


class JobState(enum.StrEnum):
    """The states of a job (RFC 8011, section 5.3.7)."""

    PENDING = "pending"
    PENDING_HELD = "pending-held"
    PROCESSING = "processing"
    PROCESSING_STOPPED = "processing-stopped"
    CANCELED = "canceled"
    ABORTED = "aborted"
    COMPLETED = "completed"


class Reason(enum.StrEnum):
    """Why a job is in its state."""

    MACHINE_BUSY = "machine-busy"
    MACHINE_OFFLINE = "machine-offline"
    STORAGE_FAILED = "storage-failed"
    RUNNING = "running"
    DONE = "done"
    CANCELED_BY_USER = "canceled-by-user"
    HOST_RESTARTED = "host-restarted"
    HOST_STOPPED = "host-stopped"
    INTERNAL_ERROR = "internal-error"
    LINK_LOST = "link-lost"
    MACHINE_FAULT = "machine-fault"
    MACHINE_RESET = "machine-reset"
    MACHINE_SILENT = "machine-silent"
    PROGRAM_MISSING = "program-missing"
    QUEUE_POSITION = "queue-position"
    QUEUE_FULL = "queue-full"


_S: Final = JobState
_NEXT: Final[dict[JobState, frozenset[JobState]]] = {
    _S.PENDING: frozenset({_S.PENDING, _S.PENDING_HELD, _S.PROCESSING, _S.CANCELED, _S.ABORTED}),
    _S.PENDING_HELD: frozenset({_S.PENDING, _S.CANCELED, _S.ABORTED}),
    _S.PROCESSING: frozenset({_S.PENDING, _S.PROCESSING_STOPPED, _S.CANCELED, _S.ABORTED, _S.COMPLETED}),
    _S.PROCESSING_STOPPED: frozenset({_S.PROCESSING, _S.CANCELED, _S.ABORTED}),
    _S.CANCELED: frozenset(),
    _S.ABORTED: frozenset(),
    _S.COMPLETED: frozenset(),
}
"""What may follow what. ``processing`` goes back to ``pending`` only when the start could not be recorded,
so that no byte of the job has left; ended states never change (a retry is a new job)."""


class TransitionError(ToolpostError):
    """The rules of a job's life do not allow this step."""


class Job(msgspec.Struct, frozen=True, kw_only=True):
    """One run of one program on one machine.

    Attributes:
        seq: position in the order of adding; never used again, so it is what orders jobs.
        id: public name, unique for ever.
        machine: name of the machine it runs on.
        program: SHA-256 of the program's content, in hex.
        commands: number of commands in the program.
        name: name of the file in the ``gcodes`` root that it was made from, or "".
        position: place among the waiting jobs; the lowest is the next.
        called: whether it may start as soon as the machine is ready; the queue calls its jobs one by one.
        signals: signal line to interval in seconds, sent while the job runs.
        state: where it is in its life.
        reason: why it is there.
        detail: words for a person, or "".
        created_us, started_us, ended_us: Unix times in microseconds.
    """

    seq: int
    id: str
    machine: str
    program: str
    commands: int
    name: str = ""
    position: int = 0
    called: bool = True
    signals: dict[str, float] = {}
    state: JobState = JobState.PENDING
    reason: Reason = Reason.MACHINE_BUSY
    detail: str = ""
    created_us: int
    started_us: int | None = None
    ended_us: int | None = None

    @property
    def ended(self) -> bool:
        """Whether the job has reached a state that never changes."""
        return not _NEXT[self.state]

    def to(self, state: JobState, reason: Reason, at_us: int, detail: str = "") -> "Job":
        """Return the job after a transition.

        Raises:
            TransitionError: the rules do not allow `state` after the present one.
        """
        if state not in _NEXT[self.state]:
            raise TransitionError(f"job {self.id} is {self.state} and cannot become {state}")
        started, ended = self.started_us, self.ended_us
        if state is JobState.PROCESSING and started is None:
            started = at_us
        elif state is JobState.PENDING:
            started = None
        if not _NEXT[state]:
            ended = at_us
        return msgspec.structs.replace(
            self, state=state, reason=reason, detail=detail, started_us=started, ended_us=ended
        )


def after_restart(job: Job, *, load_on_startup: bool, at_us: int) -> Job:
    """Return what a job found in the store at start has become.

    No job that had started goes on or starts again by itself: a person decides. A job that was called but
    had not started goes back into the queue, if it came from there. Any other waits on if the queue may
    load at start-up, and is held otherwise, because a machine that begins to move when the power comes
    back surprises whoever stands before it.
    """
    if job.state is JobState.PROCESSING:
        return job.to(JobState.PROCESSING_STOPPED, Reason.HOST_RESTARTED, at_us)
    if job.state is not JobState.PENDING or not job.called:
        return job
    if job.name:
        return msgspec.structs.replace(job, called=False, reason=Reason.QUEUE_POSITION)
    if not load_on_startup:
        return job.to(JobState.PENDING_HELD, Reason.HOST_RESTARTED, at_us)
    return job
