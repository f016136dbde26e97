"""What happens in the shop, told to whoever wants to know."""

import enum
from collections.abc import Callable
from typing import TypeAlias

import msgspec

from toolpost.core.job import Job
from toolpost.core.machine import MachineState
from toolpost.core.report import Report
from toolpost.gcode.entries import Change


class QueueAction(enum.StrEnum):
    """What has happened to a queue (Moonraker, notify_job_queue_changed)."""

    STATE_CHANGED = "state_changed"
    JOBS_ADDED = "jobs_added"
    JOBS_REMOVED = "jobs_removed"
    JOB_LOADED = "job_loaded"


class JobChanged(msgspec.Struct, frozen=True, tag=True):
    """A job was added or made a transition, and that is on disk."""

    job: Job


class MachineChanged(msgspec.Struct, frozen=True, tag=True):
    """The state of a machine has changed."""

    machine: str
    state: MachineState


class Reported(msgspec.Struct, frozen=True, tag=True):
    """A machine has reported."""

    machine: str
    report: Report


class QueueChanged(msgspec.Struct, frozen=True, tag=True):
    """The queue of a machine has changed, and that is on disk; `listed` if its jobs or their order have."""

    machine: str
    action: QueueAction
    listed: bool = True


class FileChanged(msgspec.Struct, frozen=True, tag=True):
    """Something in the ``gcodes`` root has changed, and that is on disk."""

    change: Change


Event: TypeAlias = FileChanged | JobChanged | MachineChanged | QueueChanged | Reported


class Events:
    """Passes each event to every subscriber, in order, at once."""

    def __init__(self) -> None:
        self._subscribers: list[Callable[[Event], None]] = []

    def subscribe(self, subscriber: Callable[[Event], None]) -> Callable[[], None]:
        """Call `subscriber` for each event from now on; the result ends the subscription."""
        self._subscribers.append(subscriber)
        return lambda: self._subscribers.remove(subscriber)

    def publish(self, event: Event) -> None:
        """Tell all subscribers."""
        for subscriber in self._subscribers.copy():
            subscriber(event)
