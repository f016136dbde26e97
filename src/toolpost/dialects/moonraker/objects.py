"""The printer objects: asked for, subscribed to, and told of as they change (external_api/printer.md)."""

import asyncio
import os
import time
from pathlib import Path
from typing import Any, Final

import msgspec

from toolpost.clock import now_us
from toolpost.core.job import Job
from toolpost.dialects.moonraker.arguments import split
from toolpost.dialects.moonraker.connections import Connection, Connections, encode_notification
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.info import STATES
from toolpost.dialects.moonraker.rpc import Method, NoParams
from toolpost.dialects.moonraker.status import (
    Objects,
    Span,
    View,
    Wanted,
    changes,
    printer_objects,
    select,
)
from toolpost.errors import ToolpostError
from toolpost.events import Event, JobChanged, MachineChanged, Reported
from toolpost.shop import Shop

NOTIFICATION: Final = "notify_status_update"

INTERVAL: Final = 0.25
"""Seconds between two notifications, at least."""

_POSITION: Final = "pos"
_MEMORY: Final = Path("/proc/meminfo")


class QueryParams(msgspec.Struct, frozen=True):
    """The objects that are wanted; of each a list of its fields, or null for all."""

    objects: dict[str, Any]


class SubscribeParams(msgspec.Struct, frozen=True):
    """As of a query; over HTTP with the connection that shall be notified."""

    objects: dict[str, Any]
    connection_id: int | None = None


class _Subscription(msgspec.Struct):
    """What a connection wants to be told, and what it was told last."""

    connection: Connection
    wanted: Wanted
    told: Objects


class ObjectMethods:
    """The printer objects of one machine.

    Changes are told when there are any, and looked for when something has happened.

    Args:
        shop: knows the machine.
        machine: its name.
        connections: those that may subscribe.
    """

    def __init__(self, shop: Shop, machine: str, connections: Connections) -> None:
        self._shop = shop
        self._machine = machine
        self._connections = connections
        self._subscriptions: dict[int, _Subscription] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._told_at = 0.0
        self._last: Job | None = None
        self._span: tuple[int, Span | None] = (0, None)
        self._seeking: asyncio.Task[None] | None = None

    def methods(self) -> list[Method]:
        """Return the methods."""
        path, name = "/printer/objects", "printer.objects"
        return [
            Method(f"{name}.list", ("GET", f"{path}/list"), NoParams, self.list_objects),
            Method(
                f"{name}.query",
                ("GET", f"{path}/query"),
                QueryParams,
                self.query,
                more_http=(("POST", f"{path}/query"),),
                from_http=_from_http,
            ),
            Method(
                f"{name}.subscribe",
                ("POST", f"{path}/subscribe"),
                SubscribeParams,
                self.subscribe,
                from_http=_from_http,
            ),
        ]

    async def list_objects(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``printer.objects.list``."""
        return {"objects": list(self._objects())}

    async def query(self, params: QueryParams, connection: Connection) -> object:  # noqa: ARG002
        """``printer.objects.query``."""
        return _answer(select(self._objects(), _wanted(params.objects)))

    async def subscribe(self, params: SubscribeParams, connection: Connection) -> object:
        """``printer.objects.subscribe``: in place of what the connection has subscribed to before."""
        if not connection.persistent:
            connection = self._connection(params.connection_id)
        wanted = _wanted(params.objects)
        objects = self._objects()
        # Not remembered: what is not there, however much of it a client names.
        known = {
            name: None if fields is None else tuple(sorted(objects[name].keys() & set(fields)))
            for name, fields in wanted.items()
            if name in objects
        }
        number = connection.number
        if number not in self._subscriptions:
            connection.at_close(lambda: self._subscriptions.pop(number, None))
        self._subscriptions[number] = _Subscription(connection, known, objects)
        return _answer(select(objects, wanted))

    def event(self, event: Event) -> None:
        """Look whether there is anything to tell."""
        if isinstance(event, JobChanged):
            if event.job.machine != self._machine:
                return
            self._job_changed(event.job)
        elif not isinstance(event, MachineChanged | Reported) or event.machine != self._machine:
            return
        self._look()

    def reset(self) -> None:
        """Forget the outcome of the last job, as ``SDCARD_RESET_FILE`` does."""
        self._last = None
        self._look()

    def _connection(self, number: int | None) -> Connection:
        if number is None:
            raise RpcError(400, "No data for argument: connection_id")
        found = next((one for one in self._connections if one.number == number), None)
        if found is None:
            raise RpcError(400, f"There is no connection {number}")
        return found

    # What has happened.

    def _job_changed(self, job: Job) -> None:
        if job.started_us is None:
            return
        if self._last is None or job.started_us >= (self._last.started_us or 0):
            self._last = job
            self._seek(job)

    def _job(self) -> Job | None:
        """Return the job that runs, or was the last to run since Toolpost started."""
        active = self._shop.active_job(self._machine)
        if active is not None:
            self._last = active
        elif self._last is not None:
            self._last = self._shop.job(self._machine, self._last.seq) or self._last
        return self._last

    def _seek(self, job: Job) -> None:
        """Find out where in its file a job's commands are: clients show its progress by that."""
        if self._span[0] != job.seq:
            self._span = job.seq, None
            if job.name:
                self._seeking = asyncio.get_running_loop().create_task(self._find(job))

    async def _find(self, job: Job) -> None:
        try:
            entry = await self._shop.files.info(job.name)
            known = await self._shop.files.metadata(job.name)
        except ToolpostError:
            return
        if self._span[0] == job.seq:
            end = known.gcode_end_byte or entry.size
            self._span = job.seq, Span(known.gcode_start_byte or 0, end, entry.size)
            self._look()

    # What there is to tell.

    def _objects(self) -> Objects:
        job = self._job()
        if job is not None:
            self._seek(job)
        progress = self._shop.progress(job) if job is not None else None
        state, message = STATES[self._shop.link(self._machine)]
        return printer_objects(
            View(
                now_us=now_us(),
                state=state,
                message=message,
                machine=self._shop.state(self._machine),
                job=job,
                executed=progress.executed if progress is not None else None,
                span=self._span[1],
                position=self._shop.latest(self._machine, _POSITION),
                system=_system(),
            )
        )

    def _look(self) -> None:
        if self._subscriptions and self._timer is None:
            loop = asyncio.get_running_loop()
            delay = max(0.0, self._told_at + INTERVAL - loop.time())
            self._timer = loop.call_later(delay, self._tell)

    def _tell(self) -> None:
        """Tell each connection what has changed; those that want the same share one message."""
        self._timer = None
        if not self._subscriptions:
            return
        objects = self._objects()
        texts: dict[tuple[int, tuple[Any, ...]], str] = {}
        for subscription in list(self._subscriptions.values()):
            key = id(subscription.told), tuple(subscription.wanted.items())
            text = texts.get(key)
            if text is None:
                changed = changes(subscription.told, objects, subscription.wanted)
                text = encode_notification(NOTIFICATION, (changed, time.monotonic())) if changed else ""
                texts[key] = text
            if text:
                self._told_at = asyncio.get_running_loop().time()
                subscription.told = objects
                subscription.connection.send(text)


def _answer(status: Objects) -> dict[str, Any]:
    return {"eventtime": time.monotonic(), "status": status}


def _wanted(objects: dict[str, Any]) -> dict[str, tuple[str, ...] | None]:
    wanted: dict[str, tuple[str, ...] | None] = {}
    for name, fields in objects.items():
        if fields is None:
            wanted[name] = None
        elif isinstance(fields, list) and all(isinstance(field, str) for field in fields):
            wanted[name] = tuple(fields)
        else:
            raise RpcError(400, f"Invalid argument [objects]: {name[:100]}: must be null or a list of names")
    return wanted


def _from_http(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the params of ``?toolhead&print_stats=state,filename``, or those in a JSON body as they are."""
    params: dict[str, Any] = {
        name: arguments.pop(name) for name in ("objects", "connection_id") if name in arguments
    }
    if "objects" not in params and arguments:
        params["objects"] = {
            name: (split(value) or None) if isinstance(value, str) else value
            for name, value in arguments.items()
        }
    return params


def _system() -> dict[str, Any]:
    """Return figures of this computer and this process, as far as the operating system gives them."""
    system: dict[str, Any] = {"sysload": os.getloadavg()[0], "cputime": time.process_time()}
    try:
        for line in _MEMORY.read_bytes().splitlines():
            if line.startswith(b"MemAvailable:"):
                system["memavail"] = int(line.split()[1])
                break
    except OSError:
        pass
    return system
