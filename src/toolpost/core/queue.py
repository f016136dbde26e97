"""The order of a machine's jobs and the rule that picks the next one."""

from collections.abc import Iterable

from toolpost.core.job import Job, JobState

STARTED = frozenset({JobState.PROCESSING, JobState.PROCESSING_STOPPED})


def active(jobs: Iterable[Job]) -> Job | None:
    """Return the job that holds the machine: started and not ended."""
    return next((job for job in jobs if job.state in STARTED), None)


def next_to_start(jobs: Iterable[Job]) -> Job | None:
    """Return the job to start once the machine is ready: the first pending one, if none holds it."""
    jobs = sorted((job for job in jobs if not job.ended), key=lambda job: job.seq)
    if active(jobs) is not None:
        return None
    return next((job for job in jobs if job.state is JobState.PENDING), None)
