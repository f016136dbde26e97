"""Answers that are sent some time after they were given, in order."""

import asyncio
import time
from collections import deque
from collections.abc import Callable

MAX_WAITING = 10_000
"""Answers that may wait; beyond it the oldest is dropped."""


class DelayLine:
    """Sends each answer after its delay, never one before an earlier one.

    Args:
        loop: the loop that runs the timer.
        send: takes an answer whose time has come.
        clock: the time, seconds.

    Attributes:
        dropped: answers lost because too many waited.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        send: Callable[[bytes], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._loop = loop
        self._send = send
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self.dropped = 0

    def push(self, data: bytes, delay: float) -> None:
        """Send ``data`` after ``delay`` seconds; at once when it is 0 and nothing waits."""
        if delay <= 0 and not self._waiting:
            self._send(data)
            return
        due = self._clock() + delay
        if self._waiting:
            due = max(due, self._waiting[-1][0])
        self._waiting.append((due, data))
        if len(self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            self.dropped += 1
        if self._timer is None:
            self._arm()

    def clear(self) -> None:
        """Drop everything that waits."""
        self._waiting.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _arm(self) -> None:
        delay = max(0.001, self._waiting[0][0] - self._clock())
        self._timer = self._loop.call_later(delay, self._wake)

    def _wake(self) -> None:
        self._timer = None
        now = self._clock()
        while self._waiting and self._waiting[0][0] <= now:
            self._send(self._waiting.popleft()[1])
        if self._waiting:
            self._arm()
