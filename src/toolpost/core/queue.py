"""The queue's rules: its states, the order of its jobs, and which job may start.

The four states and what each means are those of moonraker_job_queue.md. ``ready`` is taken at its word: the
next job is loaded when the present one is completed, whoever started that.
"""

import enum
from collections import defaultdict, deque
from collections.abc import Iterable, Sequence

import msgspec

from toolpost.core.job import Job, JobState

STARTED = frozenset({JobState.PROCESSING, JobState.PROCESSING_STOPPED})


class QueueState(enum.StrEnum):
    """The states of a queue (moonraker_job_queue.md)."""

    READY = "ready"
    LOADING = "loading"
    STARTING = "starting"
    PAUSED = "paused"


class QueueView(msgspec.Struct, frozen=True):
    """A queue as its clients see it: its state and the waiting jobs in order."""

    state: QueueState
    jobs: list[Job]


def active(jobs: Iterable[Job]) -> Job | None:
    """Return the job that holds the machine: started and not ended."""
    return next((job for job in jobs if job.state in STARTED), None)


def next_to_start(jobs: Iterable[Job]) -> Job | None:
    """Return the job to start once the machine is ready: the first one called, if none holds it."""
    waiting = []
    for job in jobs:
        if job.state in STARTED:
            return None
        if job.state is JobState.PENDING and job.called:
            waiting.append(job)
    return min(waiting, key=lambda job: (job.position, job.seq), default=None)


def state_after_load(*, jobs_left: bool, automatic_transition: bool) -> QueueState:
    """Return the state once a job has been loaded: ready only if it will load another by itself."""
    return QueueState.READY if jobs_left and automatic_transition else QueueState.PAUSED


class Reconciled(msgspec.Struct, frozen=True):
    """What a reposted list means for the jobs there are.

    Attributes:
        order: for each place a waiting job, or the name of one to be added.
        removed: jobs that are in the list no more.
    """

    order: list[Job | str]
    removed: list[Job]


def reconcile(jobs: Sequence[Job], names: Sequence[str], shown: frozenset[str] | None) -> Reconciled:
    """Match a list of file names, which a client posts to replace the queue, to the waiting jobs.

    Clients reorder, copy and remove by posting the whole list. Jobs whose names are in it keep their id and
    all they have; equal names match in order, those that the client has been shown before the others. A job
    that is not in the list is removed only if the client has been shown it, so that two of them cannot eat
    each other's jobs; otherwise it stays, at the end.

    Args:
        jobs: waiting jobs, in order.
        names: the list as posted.
        shown: ids of the jobs that the client has been shown; None for all.
    """
    by_name: defaultdict[str, deque[Job]] = defaultdict(deque)
    for job in sorted(jobs, key=lambda job: shown is not None and job.id not in shown):
        by_name[job.name].append(job)
    order: list[Job | str] = [by_name[name].popleft() if by_name[name] else name for name in names]
    left = {job.seq for waiting in by_name.values() for job in waiting}
    removed = [job for job in jobs if job.seq in left and (shown is None or job.id in shown)]
    gone = {job.seq for job in removed}
    order += [job for job in jobs if job.seq in left and job.seq not in gone]
    return Reconciled(order, removed)
