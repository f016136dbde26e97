"""Lines that are sent again and again while a job runs (spark_spooler.md, /add-job ``signals``)."""

import asyncio
from collections.abc import Callable


class Polls:
    """Sends lines at their intervals: once at the start, then on an absolute schedule.

    Args:
        lines: line to interval in seconds.
        send: sends one line; a line that cannot be sent is left out.
    """

    def __init__(self, lines: dict[str, float], send: Callable[[bytes], bool]) -> None:
        self._lines = lines
        self._send = send
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._canceled = False

    def start(self) -> None:
        """Send every line and go on until `cancel`."""
        now = asyncio.get_running_loop().time()
        for line, interval in self._lines.items():
            self._fire(line.encode("ascii"), line, interval, now)

    def cancel(self) -> None:
        """Send no more; may be called from `send`, which may find the link gone."""
        self._canceled = True
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()

    def _fire(self, payload: bytes, line: str, interval: float, due: float) -> None:
        if self._canceled:
            return
        loop = asyncio.get_running_loop()
        due = max(due + interval, loop.time())
        self._timers[line] = loop.call_at(due, self._fire, payload, line, interval, due)
        self._send(payload)
