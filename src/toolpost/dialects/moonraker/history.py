"""The history: the jobs that have begun, whichever API they came by (external_api/history.md)."""

import asyncio
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, Final, Literal

import msgspec

from toolpost.clock import now_us, seconds
from toolpost.core.job import Job, JobState
from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.rpc import Method, NoParams
from toolpost.dialects.moonraker.status import duration, outcome
from toolpost.errors import ToolpostError
from toolpost.events import Event, JobChanged
from toolpost.shop import Shop

NOTIFICATION: Final = "notify_history_changed"

_FEW: Final = 16


class ListParams(msgspec.Struct, frozen=True):
    """Which jobs: `limit` of them, 0 for all, from the place `start`; times are those of their start."""

    limit: int = 50
    start: int = 0
    before: float | None = None
    since: float | None = None
    order: Literal["asc", "desc"] = "desc"


class JobParams(msgspec.Struct, frozen=True):
    """One job."""

    uid: str


class DeleteParams(msgspec.Struct, frozen=True):
    """One job, or all that have ended."""

    uid: str | None = None
    all: bool = False


class HistoryMethods:
    """The history of one machine. It holds the jobs that are kept in memory.

    Args:
        shop: knows them.
        machine: name of the machine.
        connections: are told of changes.
    """

    def __init__(self, shop: Shop, machine: str, connections: Connections) -> None:
        self._shop = shop
        self._machine = machine
        self._connections = connections
        self._added: set[int] = set()
        self._untold: deque[tuple[str, Job]] = deque()
        self._telling: asyncio.Task[None] | None = None

    def methods(self) -> list[Method]:
        """Return the methods."""
        path, name = "/server/history", "server.history"
        return [
            Method(f"{name}.list", ("GET", f"{path}/list"), ListParams, self.list_jobs),
            Method(f"{name}.totals", ("GET", f"{path}/totals"), NoParams, self.totals),
            Method(f"{name}.get_job", ("GET", f"{path}/job"), JobParams, self.get_job),
            Method(f"{name}.delete_job", ("DELETE", f"{path}/job"), DeleteParams, self.delete_job),
        ]

    async def list_jobs(self, params: ListParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.history.list``; `count` counts the jobs that lie between the times."""
        jobs = [
            job
            for job in self._jobs()
            if (params.before is None or _start(job) < params.before)
            and (params.since is None or _start(job) > params.since)
        ]
        if params.order == "desc":
            jobs.reverse()
        first = max(0, params.start)
        page = jobs[first : first + params.limit] if params.limit > 0 else jobs[first:]
        return {"count": len(jobs), "jobs": await self._entries(page)}

    async def totals(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.history.totals``: of the jobs that have ended."""
        times = [duration(job, 0) for job in self._jobs() if job.ended]
        total, longest = sum(times), max(times, default=0.0)
        return {
            "job_totals": {
                "total_jobs": len(times),
                "total_time": total,
                "total_print_time": total,
                "total_filament_used": 0.0,
                "longest_job": longest,
                "longest_print": longest,
            },
            "auxiliary_totals": [],
        }

    async def get_job(self, params: JobParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.history.get_job``."""
        return {"job": (await self._entries([self._find(params.uid)]))[0]}

    async def delete_job(self, params: DeleteParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.history.delete_job``: Toolpost keeps nothing of them."""
        if params.all:
            jobs = [job for job in self._jobs() if job.ended]
        elif params.uid is None:
            raise RpcError(400, "No data for argument: uid")
        else:
            jobs = [self._find(params.uid)]
        await self._shop.delete_jobs(self._machine, jobs)
        return {"deleted_jobs": [job.id for job in jobs]}

    def event(self, event: Event) -> None:
        """Tell all connections of a job that begins or ends."""
        if not isinstance(event, JobChanged) or event.job.machine != self._machine:
            return
        job = event.job
        if not _has_begun(job):
            return
        if job.ended:
            self._added.discard(job.seq)
            self._tell("finished", job)
        elif job.state is JobState.PROCESSING and job.seq not in self._added:
            self._added.add(job.seq)
            self._tell("added", job)

    def _tell(self, action: str, job: Job) -> None:
        if not len(self._connections):
            return
        self._untold.append((action, job))
        if self._telling is None:
            self._telling = asyncio.get_running_loop().create_task(self._tell_all())

    async def _tell_all(self) -> None:
        """Tell in order; whether the file is there must be looked up, and that may take time."""
        try:
            while self._untold:
                action, job = self._untold.popleft()
                entry = (await self._entries([job]))[0]
                self._connections.notify(NOTIFICATION, {"action": action, "job": entry})
        finally:
            self._telling = None

    def _jobs(self) -> list[Job]:
        """Return the jobs that have begun, in the order of their start."""
        return sorted((job for job in self._shop.jobs(self._machine) if _has_begun(job)), key=_start)

    def _find(self, uid: str) -> Job:
        found = next((job for job in self._jobs() if job.id == uid), None)
        if found is None:
            raise RpcError(404, f"There is no job {uid[:50]} in the history")
        return found

    async def _entries(self, jobs: Sequence[Job]) -> list[dict[str, Any]]:
        existing = await self._existing({job.name for job in jobs if job.name})
        now = now_us()
        return [_entry(job, now, exists=job.name in existing) for job in jobs]

    async def _existing(self, names: Iterable[str]) -> set[str]:
        """Return those names of files that are there now."""
        wanted = set(names)
        found: set[str] = set()
        try:
            if len(wanted) > _FEW:
                return wanted & {entry.path for entry in await self._shop.files.entries()}
        except ToolpostError:
            return found
        for name in wanted:
            try:
                found.add((await self._shop.files.info(name)).path)
            except ToolpostError:
                continue
        return found


def _has_begun(job: Job) -> bool:
    """Whether a job has started, or its turn had come and it could not: what merely waited is not shown."""
    return job.started_us is not None or (job.ended and job.called)


def _start(job: Job) -> float:
    """Return when a job started; one that could not, began and ended at once."""
    return seconds(next(at for at in (job.started_us, job.ended_us, job.created_us) if at is not None))


def _entry(job: Job, now: int, *, exists: bool) -> dict[str, Any]:
    ran = duration(job, now)
    return {
        "job_id": job.id,
        "user": None,
        "filename": job.name,
        "status": outcome(job),
        "start_time": _start(job),
        "end_time": seconds(job.ended_us) if job.ended_us is not None else None,
        "print_duration": ran,
        "total_duration": ran,
        "filament_used": 0.0,
        "metadata": {},
        "auxiliary_data": [],
        "exists": exists,
    }
