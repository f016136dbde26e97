"""Faults that a simulated machine can be told to have, and when each becomes due.

As text a fault is ``NAME[:ARG][@WHEN]``. ``WHEN`` is ``N`` (once N commands were executed) or
``Ns`` (N seconds after the machine's start); without it the fault happens at once.
"""

import asyncio
import math
import re
import time
from collections.abc import Callable
from typing import Self

import msgspec

SECONDS = "seconds"
BYTES = "bytes"
TEXT = "text"

KINDS: dict[str, str | None] = {
    "mute": SECONDS,
    "stall": SECONDS,
    "reboot": None,
    "silent-reboot": None,
    "fault": None,
    "unplug": SECONDS,
    "garbage": BYTES,
    "queue-full": None,
    "slow": SECONDS,
    "drop-answer": None,
    "error": TEXT,
}
"""Each fault's name and the kind of its argument.

- ``mute[:seconds]``: nothing is sent up, commands are executed on; without seconds for ever.
- ``stall[:seconds]``: nothing is executed, signals are answered; without seconds for ever.
- ``reboot``, ``silent-reboot``: a reset, with and without the boot message.
- ``fault``: the core enters fault mode and says so; only a reboot ends it.
- ``unplug[:seconds]``: the port goes away and comes back, 1 s later when no time is given.
- ``garbage[:bytes]``: line noise goes up, 64 bytes when no number is given.
- ``queue-full``: the next command is refused and lost although there is room.
- ``slow[:seconds]``: from now on answers come this much later, 0.5 s when no time is given.
- ``drop-answer``: the answer to the next ``?queue`` is lost.
- ``error[:text]``: an error report out of the blue.
"""

MAX_GARBAGE = 1_000_000
"""The most bytes that one ``garbage`` may ask for."""

_WHEN = re.compile(r"([0-9]+(?:\.[0-9]+)?)(s?)")


class Fault(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One fault and when it happens. At most one of the two ``after_`` fields is set.

    Attributes:
        name: one of ``KINDS``.
        amount: seconds or bytes, by the kind; None when not given.
        text: the argument of a kind that takes text; None when not given.
        after_commands: happens once this many commands were executed since the start.
        after_seconds: happens this many seconds after the start.
    """

    name: str
    amount: float | None = None
    text: str | None = None
    after_commands: int | None = None
    after_seconds: float | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read a fault from ``NAME[:ARG][@WHEN]``.

        Raises:
            ValueError: the name is unknown, or the argument or the time is not what it must be;
                the message names the fix and, for a name, all valid names.
        """
        body, commands, seconds = _split_when(text.strip())
        name, colon, argument = body.partition(":")
        if name not in KINDS:
            raise ValueError(f"unknown fault {name!r}; valid: {', '.join(KINDS)}")
        kind = KINDS[name]
        if not colon:
            return cls(name, after_commands=commands, after_seconds=seconds)
        if kind is None:
            raise ValueError(f"fault {name} takes no argument, but got {argument!r}")
        if kind == TEXT:
            return cls(name, text=argument, after_commands=commands, after_seconds=seconds)
        amount = _amount(name, kind, argument)
        return cls(name, amount, after_commands=commands, after_seconds=seconds)


def _split_when(text: str) -> tuple[str, int | None, float | None]:
    """Split off ``@WHEN``; return the rest, commands and seconds."""
    body, at, when = text.rpartition("@")
    if not at:
        return text, None, None
    match = _WHEN.fullmatch(when)
    if match is None and body.partition(":")[0] == "error":
        return text, None, None
    if match is None or ("." in when and not match[2]):
        raise ValueError(f"bad time @{when} in fault {text!r}: write @100 (commands) or @2.5s")
    if match[2]:
        return body, None, float(match[1])
    return body, int(match[1]), None


def _amount(name: str, kind: str, argument: str) -> float:
    """Return a fault's argument as a number."""
    try:
        amount = float(argument)
    except ValueError:
        amount = math.nan
    if not math.isfinite(amount) or amount < 0:
        raise ValueError(f"fault {name} needs {kind} as a number >= 0, but got {argument!r}")
    if kind == BYTES and (amount > MAX_GARBAGE or amount != int(amount)):
        raise ValueError(f"fault {name} needs a whole number of bytes up to {MAX_GARBAGE}")
    return amount


class FaultSchedule:
    """Holds faults that are not due yet and hands each to ``apply`` when it is.

    Args:
        loop: the loop that runs the timers.
        apply: takes a fault that has become due.
        clock: the time, seconds.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        apply: Callable[[Fault], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._loop = loop
        self._apply = apply
        self._started_at: float | None = None
        self._unstarted: list[Fault] = []
        self._counted: list[tuple[int, Fault]] = []
        self._timers: set[asyncio.TimerHandle] = set()

    @property
    def counting(self) -> bool:
        """Whether a fault waits for a number of executed commands."""
        return bool(self._counted)

    def start(self) -> None:
        """Start the clock of ``@Ns``; the first call counts."""
        if self._started_at is None:
            self._started_at = self._clock()
            waiting, self._unstarted = self._unstarted, []
            for fault in waiting:
                self.add(fault, 0)

    def add(self, fault: Fault, executed: int) -> None:
        """Take ``fault``; apply it now if it is due.

        Args:
            fault: what shall happen.
            executed: commands executed so far.
        """
        if fault.after_commands is not None and fault.after_commands > executed:
            self._counted.append((fault.after_commands, fault))
            self._counted.sort(key=lambda entry: entry[0])
        elif fault.after_seconds is not None:
            self._add_timed(fault, fault.after_seconds)
        else:
            self._apply(fault)

    def _add_timed(self, fault: Fault, after: float) -> None:
        if self._started_at is None:
            self._unstarted.append(fault)
            return

        def due() -> None:
            self._timers.discard(timer)
            self._apply(fault)

        delay = max(0.0, self._started_at + after - self._clock())
        timer = self._loop.call_later(delay, due)
        self._timers.add(timer)

    def on_executed(self, executed: int) -> None:
        """Apply what is due now that ``executed`` commands were executed."""
        while self._counted and self._counted[0][0] <= executed:
            _, fault = self._counted.pop(0)
            self._apply(fault)

    def close(self) -> None:
        """Forget everything that is not due yet."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        self._counted.clear()
        self._unstarted.clear()
