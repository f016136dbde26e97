"""The queue of a simulated Spark core, and how its commands are executed in time."""

import asyncio
import re
from collections import deque
from collections.abc import Callable, Mapping

from toolpost.sim.motion import RAPID_FEED, Motion
from toolpost.sim.options import SparkOptions

MAX_DWELL = 86_400.0
"""The longest dwell that ``G4`` obeys, seconds."""

_DWELL = re.compile(rb"G0?4 ?P([0-9]+\.?[0-9]*|\.[0-9]+)")
_LINEAR = re.compile(rb"G0?([01])(?![0-9.])")
_SHORTEST_WAIT = 0.001  # below it a loop's timers round to a busy loop


class Execution:
    """Commands that wait, and the one that runs, until its time is over.

    Args:
        loop: the loop that runs the timer.
        clock: the time, seconds.
        options: how long commands take.
        settings: as for ``Motion``.
        carry_out: takes a command whose time is over, and when it was over.
        gone_on: called after that, when the next command runs.

    Attributes:
        motion: the axes, moved by the commands; fresh ones after a reset.
        running: the command that runs, None without one.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        clock: Callable[[], float],
        options: SparkOptions,
        settings: Mapping[str, float],
        carry_out: Callable[[bytes, float], None],
        gone_on: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._clock = clock
        self._options = options
        self._timed = options.timed
        self._settings = settings
        self._carry_out = carry_out
        self._gone_on = gone_on
        self.motion = Motion(settings)
        self.running: bytes | None = None
        self._waiting: deque[bytes] = deque()
        self._due = 0.0
        self._stalled_at: float | None = None
        self._timer: asyncio.TimerHandle | None = None

    @property
    def length(self) -> int:
        """Commands that wait or run."""
        return len(self._waiting) + (self.running is not None)

    @property
    def stalled(self) -> bool:
        """Whether nothing is executed for now."""
        return self._stalled_at is not None

    def add(self, line: bytes, now: float) -> None:
        """Put a command into the queue; start it, and end it if it takes no time, when none runs."""
        self._waiting.append(line)
        if self.running is None and self._stalled_at is None:
            self._due = now
            self._start_next()
            self.advance(now)

    def advance(self, now: float) -> None:
        """Execute everything whose time is over, then wait for the next."""
        while self.running is not None and self._due <= now and self._stalled_at is None:
            self._carry_out(self.running, self._due)
            self._start_next()
            self._gone_on()
        if self.running is not None and self._timer is None and self._stalled_at is None:
            delay = max(_SHORTEST_WAIT, self._due - now)
            self._timer = self._loop.call_later(delay, self._wake)

    def stall(self) -> None:
        """Execute nothing from now on, in the middle of a command if need be."""
        if self._stalled_at is None:
            self._stalled_at = self._clock()
            self.motion.pause(self._stalled_at)
        self._cancel_timer()

    def resume(self) -> None:
        """Go on after ``stall``; what was left of the command then is still left."""
        if self._stalled_at is None:
            return
        now = self._clock()
        stalled_at, self._stalled_at = self._stalled_at, None
        self.motion.resume(now)
        if self.running is None:
            self._due = now
            self._start_next()
        else:
            self._due += now - stalled_at
        self.advance(now)

    def drop(self) -> int:
        """Empty the queue; return how many commands that removed."""
        dropped = self.length
        self._waiting.clear()
        self.running = None
        self._cancel_timer()
        return dropped

    def reset(self) -> int:
        """Make everything fresh; return as ``drop``."""
        self._stalled_at = None
        self.motion = Motion(self._settings)
        return self.drop()

    def _start_next(self) -> None:
        """Start the next command where the one before it ended, so that no time is lost."""
        if not self._waiting:
            self.running = None
            return
        line = self._waiting.popleft()
        self.running = line
        began = self._due
        distance = self.motion.begin(line, began)
        seconds = self._duration(line, distance)
        self.motion.last(seconds)
        self._due = began + seconds

    def _duration(self, line: bytes, distance: float) -> float:
        """Return how long a command takes, seconds."""
        if not self._timed or line[:1] not in b"GM":
            return 0.0
        if dwell := _DWELL.match(line):
            return min(float(dwell[1]), MAX_DWELL)
        if self._options.realtime_moves and (move := _LINEAR.match(line)):
            return distance * 60.0 / (RAPID_FEED if move[1] == b"0" else self.motion.feed)
        return self._options.command_time

    def _wake(self) -> None:
        self._timer = None
        self.advance(self._clock())

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
