"""What a simulated Spark core answers to signals and to questions, and when."""

import asyncio
from collections.abc import Callable

from toolpost.sim import replies
from toolpost.sim.delay import DelayLine
from toolpost.sim.motion import Motion
from toolpost.sim.timers import Timers

_EDM_GAP = 0.003  # other answers may come between the two parts of a report for this long
_EDM = "edm"


class Answers:
    """Sends answers, each after the same delay.

    Args:
        send: takes what goes up.
        loop: the loop that runs the delay.
        timers: for the gap between the two parts of an answer to ``?edm``.
        clock: the time, seconds.
        delay: seconds until an answer is sent.

    Attributes:
        delay: seconds until an answer is sent, for those given from now on.
    """

    def __init__(
        self,
        send: Callable[[bytes], None],
        loop: asyncio.AbstractEventLoop,
        timers: Timers,
        clock: Callable[[], float],
        delay: float,
    ) -> None:
        self.delay = delay
        self._line = DelayLine(loop, send, clock)
        self._timers = timers
        self._unanswered = 0
        self._edm_rest = b""
        self._edm_asked = 0

    def queue(self, capacity: int, number: int) -> None:
        """Answer ``?queue``, unless this answer shall be lost."""
        if self._unanswered:
            self._unanswered -= 1
        else:
            self.give(replies.queue(capacity, number))

    def drop_next(self) -> None:
        """Lose the answer to the next ``?queue``."""
        self._unanswered += 1

    def position(self, motion: Motion, now: float) -> None:
        """Answer ``?pos``."""
        self.give(replies.position(motion, now))

    def discharge(self, now: float, *, cutting: bool) -> None:
        """Answer ``?edm``; every other time another answer may come between its lines."""
        if self._edm_rest:
            self._end_discharge()
        first, rest = replies.discharge(cutting, now)
        self._edm_asked += 1
        if self._edm_asked % 2:
            self._line.push(first + rest, self.delay)
            return
        self._line.push(first, self.delay)
        self._edm_rest = rest
        self._timers.start(_EDM, _EDM_GAP, self._end_discharge)

    def give(self, data: bytes) -> None:
        """Send any other answer."""
        self._line.push(data, self.delay)
        if self._edm_rest:
            self._end_discharge()

    def cut_short(self) -> None:
        """Drop the second part of an answer to ``?edm``, if it is not given yet."""
        self._timers.cancel(_EDM)
        self._edm_rest = b""

    def clear(self) -> None:
        """Drop all that is not sent yet."""
        self._line.clear()
        self.cut_short()

    def _end_discharge(self) -> None:
        rest = self._edm_rest
        self.cut_short()
        self._line.push(rest, self.delay)
