"""The six calls of the job queue and its notification (moonraker_job_queue.md)."""

import time
from collections.abc import Iterable
from typing import Any

import msgspec

from toolpost.clock import now_us
from toolpost.core.job import Job
from toolpost.core.queue import QueueView
from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.rpc import Method, NoParams
from toolpost.errors import FileMissingError
from toolpost.events import Event, QueueChanged
from toolpost.shop import Shop

NOTIFICATION = "notify_job_queue_changed"

_KEEP_FOR = 0.05


class QueuedJob(msgspec.Struct, frozen=True):
    """One waiting job."""

    filename: str
    job_id: str
    time_added: float
    time_in_queue: float


class QueueStatus(msgspec.Struct, frozen=True):
    """The answer of all six calls; its jobs are encoded already."""

    queued_jobs: msgspec.Raw
    queue_state: str


class _Listed(msgspec.Struct, frozen=True):
    """The waiting jobs as they are sent, since when (monotonic seconds), and their ids."""

    at: float
    jobs: msgspec.Raw
    ids: frozenset[str]


class PostJobParams(msgspec.Struct, frozen=True):
    """Files to add, or to replace the queue by."""

    filenames: list[str]
    reset: bool = False


class DeleteJobParams(msgspec.Struct, frozen=True):
    """Jobs to remove; all of them where `all` is true."""

    job_ids: list[str] | None = None
    all: bool = False


class JumpParams(msgspec.Struct, frozen=True):
    """The job that is to be the next."""

    job_id: str | None


class JobQueueMethods:
    """The queue of one machine.

    Args:
        shop: does the work.
        machine: name of the machine.
        connections: are told of changes.
    """

    def __init__(self, shop: Shop, machine: str, connections: Connections) -> None:
        self._shop = shop
        self._machine = machine
        self._connections = connections
        self._listed: _Listed | None = None

    def methods(self) -> list[Method]:
        """Return the six methods."""
        path = "/server/job_queue"
        name = "server.job_queue"
        return [
            Method(f"{name}.status", ("GET", f"{path}/status"), NoParams, self.status),
            Method(f"{name}.post_job", ("POST", f"{path}/job"), PostJobParams, self.post_job),
            Method(f"{name}.delete_job", ("DELETE", f"{path}/job"), DeleteJobParams, self.delete_job),
            Method(f"{name}.pause", ("POST", f"{path}/pause"), NoParams, self.pause),
            Method(f"{name}.start", ("POST", f"{path}/start"), NoParams, self.start),
            Method(f"{name}.jump", ("POST", f"{path}/jump"), JumpParams, self.jump),
        ]

    async def status(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.job_queue.status``."""
        return self._answer(connection)

    async def post_job(self, params: PostJobParams, connection: Connection) -> object:
        """``server.job_queue.post_job``: add files, or reconcile the queue with the list that is posted."""
        shown = connection.shown_jobs if connection.persistent else None
        try:
            await self._shop.enqueue(
                self._machine,
                params.filenames,
                replace=params.reset,
                shown=shown,
                actor=connection.actor,
            )
        except FileMissingError as error:
            raise RpcError(400, f"G-Code File {error.name} does not exist") from None
        return self._answer(connection)

    async def delete_job(self, params: DeleteJobParams, connection: Connection) -> object:
        """``server.job_queue.delete_job``: ids that are not in the queue are ignored."""
        if not params.all and params.job_ids is None:
            raise RpcError(400, "No data for argument: job_ids")
        job_ids = None if params.all else params.job_ids
        await self._shop.dequeue(self._machine, job_ids, connection.actor)
        return self._answer(connection)

    async def pause(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.job_queue.pause``."""
        await self._shop.pause_queue(self._machine)
        return self._answer(connection)

    async def start(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.job_queue.start``."""
        await self._shop.start_queue(self._machine)
        return self._answer(connection)

    async def jump(self, params: JumpParams, connection: Connection) -> object:
        """``server.job_queue.jump``."""
        await self._shop.jump(self._machine, str(params.job_id), connection.actor)
        return self._answer(connection)

    def event(self, event: Event) -> None:
        """Tell all connections of a change of this queue."""
        if not isinstance(event, QueueChanged) or event.machine != self._machine:
            return
        self._listed = None
        if not len(self._connections):
            return
        view = self._shop.queue(self._machine)
        listed = self._list(view) if event.listed else None
        payload: dict[str, Any] = {
            "action": event.action.value,
            "updated_queue": listed.jobs if listed is not None else None,
            "queue_state": view.state.value,
        }
        self._connections.notify(NOTIFICATION, payload, shows=listed.ids if listed is not None else None)

    def _answer(self, connection: Connection) -> QueueStatus:
        view = self._shop.queue(self._machine)
        listed = self._list(view)
        if connection.persistent:
            connection.show(listed.ids)
        return QueueStatus(listed.jobs, view.state.value)

    def _list(self, view: QueueView) -> _Listed:
        """Return the jobs, made once for all who are shown them within a moment: only ages in it differ."""
        now = time.monotonic()
        if self._listed is None or now - self._listed.at > _KEEP_FOR:
            jobs = msgspec.Raw(msgspec.json.encode(_jobs(view.jobs)))
            self._listed = _Listed(now, jobs, frozenset([job.id for job in view.jobs]))
        return self._listed


def _jobs(jobs: Iterable[Job]) -> list[QueuedJob]:
    now = now_us()
    # One expression, for there may be thousands of them, and each change shows them all.
    return [
        QueuedJob(
            job.name,
            job.id,
            job.created_us / 1e6,
            (now - job.created_us) / 1e6 if now > job.created_us else 0.0,
        )
        for job in jobs
    ]
