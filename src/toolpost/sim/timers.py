"""Timers that are known by their names."""

import asyncio
from collections.abc import Callable


class Timers:
    """Timers by name; a new one takes the place of the one that has its name.

    Args:
        loop: the loop that runs them.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._handles: dict[str, asyncio.TimerHandle] = {}

    def start(self, name: str, seconds: float | None, call: Callable[[], None]) -> None:
        """Call ``call`` after ``seconds``; never when that is None."""
        self.cancel(name)
        if seconds is None:
            return

        def due() -> None:
            self._handles.pop(name, None)
            call()

        self._handles[name] = self._loop.call_later(seconds, due)

    def cancel(self, *names: str) -> None:
        """Stop these timers; one that does not run is no matter."""
        for name in names:
            handle = self._handles.pop(name, None)
            if handle is not None:
                handle.cancel()

    def close(self) -> None:
        """Stop them all."""
        self.cancel(*self._handles)
