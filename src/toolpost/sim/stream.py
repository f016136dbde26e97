"""Bytes in and out of one non-blocking file descriptor, at a serial line's speed if wanted."""

import asyncio
import os
import time
from collections import deque
from collections.abc import Callable

from toolpost.sim.pacing import Wire

READ_SIZE = 65_536
"""Bytes read at once without a wire speed."""

OUTPUT_LIMIT = 65_536
"""Bytes that wait for a host that does not read; beyond it the oldest answers are dropped."""


class Stream:
    """Reads and writes a file descriptor without ever blocking or spinning.

    Args:
        loop: the loop that watches the descriptor.
        fd: a non-blocking descriptor; the stream does not close it.
        on_data: takes what was read.
        on_gone: called once when the other side is gone; the stream has then stopped.
        baud: speed of the wire in both directions, bits per second; None for no limit.

    Attributes:
        dropped: answers that were dropped because the host did not read.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        fd: int,
        on_data: Callable[[bytes], None],
        on_gone: Callable[[], None],
        baud: int | None = None,
    ) -> None:
        self._loop = loop
        self._fd = fd
        self._on_data = on_data
        self._on_gone = on_gone
        self._down = Wire(baud) if baud else None
        self._up = Wire(baud) if baud else None
        self._output: deque[bytes] = deque()
        self._size = 0
        self._piece = b""
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._stopped = False
        self.dropped = 0
        loop.add_reader(fd, self._read)

    def stop(self) -> None:
        """Let go of the descriptor. Everything not yet written is lost."""
        if self._stopped:
            return
        self._stopped = True
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        self._output.clear()

    def write(self, data: bytes) -> None:
        """Send ``data`` up; what does not go at once waits, within ``OUTPUT_LIMIT``."""
        if self._stopped or not data:
            return
        idle = not self._piece and not self._output
        self._output.append(data)
        self._size += len(data)
        while self._size > OUTPUT_LIMIT and len(self._output) > 1:
            self._size -= len(self._output.popleft())
            self.dropped += 1
        if idle:
            self._next_piece()

    # -- from the host

    def _read(self) -> None:
        """Take what the host sent; with a wire, give it on when it has crossed it."""
        if self._stopped:
            return
        now = time.monotonic()
        wire = self._down
        try:
            data = os.read(self._fd, wire.room(now) if wire else READ_SIZE)
        except (BlockingIOError, InterruptedError):
            if wire:
                wire.rest()
                self._loop.add_reader(self._fd, self._read)
            return
        except OSError:  # EIO: a pty that no host has open; ECONNRESET: a socket
            data = b""
        if not data:
            self._gone()
        elif wire:
            self._loop.remove_reader(self._fd)
            crossed = wire.carry(len(data))
            self._after("read", crossed - now, lambda: self._hand_over(data))
        else:
            self._on_data(data)

    def _hand_over(self, data: bytes) -> None:
        self._on_data(data)
        self._read()

    # -- to the host

    def _next_piece(self) -> None:
        """Take the next piece of the output and write it, after its time on the wire."""
        while self._output and not self._piece:
            now = time.monotonic()
            if self._up is None:
                self._piece = self._take(self._size)
                self._flush()
                continue
            self._piece = self._take(self._up.room(now))
            crossed = self._up.carry(len(self._piece))
            self._after("write", crossed - now, self._flush_on)
            return
        if self._up and not self._piece:
            self._up.rest()

    def _take(self, count: int) -> bytes:
        """Return up to ``count`` bytes of the output."""
        taken = bytearray()
        while self._output and len(taken) < count:
            first = self._output.popleft()
            need = count - len(taken)
            taken += first[:need]
            if len(first) > need:
                self._output.appendleft(first[need:])
        self._size -= len(taken)
        return bytes(taken)

    def _flush_on(self) -> None:
        self._flush()
        self._next_piece()

    def _flush(self) -> None:
        """Write the present piece; wait for the descriptor when it takes no more."""
        try:
            while self._piece:
                written = os.write(self._fd, self._piece)
                self._piece = self._piece[written:]
        except (BlockingIOError, InterruptedError):
            self._loop.add_writer(self._fd, self._writable)
        except OSError:
            self._gone()

    def _writable(self) -> None:
        self._loop.remove_writer(self._fd)
        self._flush_on()

    # -- both

    def _gone(self) -> None:
        if not self._stopped:
            self.stop()
            self._piece = b""
            self._on_gone()

    def _after(self, name: str, delay: float, call: Callable[[], None]) -> None:
        """Call in ``delay`` seconds, not sooner than the loop can time without spinning."""

        def due() -> None:
            self._timers.pop(name, None)
            call()

        self._timers[name] = self._loop.call_later(max(0.001, delay), due)
