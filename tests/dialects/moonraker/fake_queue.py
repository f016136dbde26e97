"""A queue in memory that answers the six calls of the job queue, for what is around them to be tested."""

import itertools
from typing import Any

import msgspec

from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.rpc import Method, NoParams

FILES = {
    "a.gcode", "b.gcode", "subdir/c.gcode", "comma,name.gcode", "with space.gcode", "ümlaut.gcode",
    "noext", "mid.gcode", "long.gcode", "err.gcode", "range.gcode", "pauses.gcode", "tiny.gcode",
}  # fmt: skip


class PostParams(msgspec.Struct):
    filenames: list[str]
    reset: bool = False


class DeleteParams(msgspec.Struct):
    job_ids: list[str] | msgspec.UnsetType = msgspec.UNSET
    all_jobs: bool = msgspec.field(name="all", default=False)


class JumpParams(msgspec.Struct):
    job_id: str | None


class FakeQueue:
    """The queue and its six methods."""

    def __init__(self, connections: Connections) -> None:
        self.jobs: list[dict[str, Any]] = []
        self.state = "paused"
        self._connections = connections
        self._ids = itertools.count(1)

    @property
    def methods(self) -> list[Method]:
        base, path = "server.job_queue", "/server/job_queue"
        return [
            Method(f"{base}.status", ("GET", f"{path}/status"), NoParams, self.status),
            Method(f"{base}.post_job", ("POST", f"{path}/job"), PostParams, self.post),
            Method(f"{base}.delete_job", ("DELETE", f"{path}/job"), DeleteParams, self.delete),
            Method(f"{base}.pause", ("POST", f"{path}/pause"), NoParams, self.pause),
            Method(f"{base}.start", ("POST", f"{path}/start"), NoParams, self.start),
            Method(f"{base}.jump", ("POST", f"{path}/jump"), JumpParams, self.jump),
        ]

    def add(self, names: list[str]) -> list[str]:
        """Add jobs whatever their names, and return their ids."""
        new = [
            {"filename": name, "job_id": f"{next(self._ids):016X}", "time_added": 1.5, "time_in_queue": 0.25}
            for name in names
        ]
        self.jobs += new
        return [job["job_id"] for job in new]

    async def status(self, _: NoParams, connection: Connection) -> object:
        connection.show(self._shown)
        return {"queued_jobs": self.jobs, "queue_state": self.state}

    async def post(self, params: PostParams, connection: Connection) -> object:
        for name in params.filenames:
            if name not in FILES:
                raise RpcError(400, f"G-Code File {name} does not exist")
        if params.reset:
            self.jobs.clear()
        self.add(params.filenames)
        self._tell("jobs_added")
        return await self.status(NoParams(), connection)

    async def delete(self, params: DeleteParams, connection: Connection) -> object:
        before = len(self.jobs)
        if params.all_jobs:
            self.jobs.clear()
        elif params.job_ids is msgspec.UNSET:
            raise RpcError(400, "No data for argument: job_ids")
        else:
            self.jobs = [job for job in self.jobs if job["job_id"] not in params.job_ids]
        if len(self.jobs) != before:
            self._tell("jobs_removed")
        return await self.status(NoParams(), connection)

    async def pause(self, _: NoParams, connection: Connection) -> object:
        return await self.status(NoParams(), connection)

    async def start(self, _: NoParams, connection: Connection) -> object:
        return await self.status(NoParams(), connection)

    async def jump(self, params: JumpParams, connection: Connection) -> object:
        found = [job for job in self.jobs if job["job_id"] == params.job_id]
        if not found:
            raise RpcError(400, f"Invalid job id: {params.job_id}")
        self.jobs.remove(found[0])
        self.jobs.insert(0, found[0])
        self._tell("state_changed")
        return await self.status(NoParams(), connection)

    @property
    def _shown(self) -> frozenset[str]:
        return frozenset(job["job_id"] for job in self.jobs)

    def _tell(self, action: str) -> None:
        event = {"action": action, "updated_queue": self.jobs, "queue_state": self.state}
        self._connections.notify("notify_job_queue_changed", event, shows=self._shown)
