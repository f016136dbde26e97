"""What the rest of Toolpost sees of a driver."""

import enum
from collections.abc import Sequence
from typing import Protocol

import msgspec

from toolpost.core.job import Reason
from toolpost.core.machine import MachineState
from toolpost.core.report import Report


class LineSource(Protocol):
    """The commands of a program, in order, each without its line end."""

    def take(self, most: int) -> list[bytes]:
        """Return the next commands, at most `most`; an empty list only after the last one."""

    @property
    def exhausted(self) -> bool:
        """Whether all commands have been taken."""


class Outcome(enum.Enum):
    """How the run of a program ended."""

    COMPLETED = enum.auto()
    STOPPED = enum.auto()
    FAILED = enum.auto()


class Ending(msgspec.Struct, frozen=True):
    """The end of a run. `reason` and `detail` say more where it failed."""

    outcome: Outcome
    reason: Reason = Reason.DONE
    detail: str = ""


class LineKind(enum.Enum):
    """What a single line is to the machine."""

    NOTHING = enum.auto()
    COMMAND = enum.auto()
    SIGNAL = enum.auto()
    STOP = enum.auto()


class Line(msgspec.Struct, frozen=True):
    """A valid line: what it is, and its bytes as they go on the wire, without a line end."""

    kind: LineKind
    payload: bytes


class DriverListener(Protocol):
    """The one who is told what comes up from a machine."""

    def reported(self, report: Report) -> None:
        """The machine has reported."""

    def session_started(self) -> None:
        """The machine has just booted or been connected: its settings may be fresh."""

    def changed(self) -> None:
        """The machine's state, or whether it is ready for a job, has changed."""


class Driver(Protocol):
    """One machine, driven.

    All methods are called on the event loop, and only the coroutines wait for the machine.
    """

    @property
    def state(self) -> MachineState:
        """The machine as it is known now."""

    @property
    def ready(self) -> bool:
        """Whether a job may start: the machine answers, is idle and holds nothing back."""

    @property
    def accepting(self) -> bool:
        """Whether the machine would take commands: it answers, or has had no time to answer yet."""

    def line(self, text: str) -> Line:
        """Return what a line is to this machine.

        Raises:
            InvalidRequestError: the line must not go on the wire, with words that say why.
        """

    def commands(self, lines: Sequence[str]) -> list[bytes]:
        """Return the commands in a program's lines, those that hold none left out. Safe in any thread.

        Raises:
            InvalidLineError: a line is no command.
        """

    def enqueue(self, line: bytes) -> bool:
        """Send a command behind all earlier ones; False if the machine cannot take it."""

    def send_now(self, line: bytes) -> bool:
        """Send a line ahead of all unsent commands; False if it cannot be sent."""

    async def execute(self, source: LineSource, signals: dict[str, float]) -> Ending:
        """Run a program to its end; the machine must be `ready`."""

    def stop(self) -> None:
        """Stop everything: drop what is unsent, then tell the machine to stop."""

    async def stopped(self, timeout: float) -> None:
        """Return when the machine has confirmed a `stop`, or after `timeout` seconds."""

    async def run(self) -> None:
        """Keep the link up until canceled."""

    def close(self) -> None:
        """Close the link."""
