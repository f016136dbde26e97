"""A link over any file descriptor that reads and writes a stream: serial port, pty or socket."""

import asyncio
import os
from collections.abc import Callable

from toolpost.links.base import LinkListener

_READ_SIZE = 65536
_READS_AT_ONCE = 8


class StreamLink:
    """A link over a non-blocking file descriptor, without a transport in between.

    The descriptor is driven directly because the order of unwritten bytes matters here: a stop must be
    able to overtake them, and to drop them, at the border of a line.

    Args:
        fd: non-blocking descriptor; the link owns it.
        listener: who is told.
        release: closes the descriptor and gives back whatever else was taken to open it.
    """

    def __init__(self, fd: int, listener: LinkListener, release: Callable[[], None]) -> None:
        self._fd = fd
        self._listener = listener
        self._release = release
        self._loop = asyncio.get_running_loop()
        self._buffer = bytearray()
        self._begun = False
        self._open = True
        self._loop.add_reader(fd, self._readable)

    @property
    def unwritten(self) -> int:
        """Bytes that the operating system has not taken yet."""
        return len(self._buffer)

    def write(self, data: bytes) -> None:
        """Write lines behind all that was written before."""
        if self._buffer:
            self._buffer += data
        elif self._open:
            self._send(data)

    def write_now(self, data: bytes) -> None:
        """Write lines ahead of every whole line that is still unwritten."""
        if not self._buffer:
            self.write(data)
            return
        at = self._buffer.index(b"\n") + 1 if self._begun else 0
        self._buffer[at:at] = data

    def discard(self) -> bytes:
        """Drop and return the whole lines still unwritten; the rest of a begun line still goes out."""
        if not self._buffer:
            return b""
        at = self._buffer.index(b"\n") + 1 if self._begun else 0
        dropped = bytes(self._buffer[at:])
        del self._buffer[at:]
        if not self._buffer:
            self._loop.remove_writer(self._fd)
        return dropped

    def close(self) -> None:
        """Close the link. The listener hears nothing of it."""
        if not self._open:
            return
        self._open = False
        self._loop.remove_reader(self._fd)
        if self._buffer:
            self._loop.remove_writer(self._fd)
            self._buffer.clear()
        self._release()

    def _send(self, data: bytes) -> None:
        try:
            taken = os.write(self._fd, data)
        except (BlockingIOError, InterruptedError):
            taken = 0
        except OSError as error:
            self._fail(f"write failed: {error.strerror}")
            return
        if taken < len(data):
            self._begun = taken > 0 and data[taken - 1] != 0x0A
            self._buffer += data[taken:]
            self._loop.add_writer(self._fd, self._writable)

    def _writable(self) -> None:
        try:
            taken = os.write(self._fd, self._buffer)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._fail(f"write failed: {error.strerror}")
            return
        self._begun = self._buffer[taken - 1] != 0x0A if taken else self._begun
        del self._buffer[:taken]
        if not self._buffer:
            self._loop.remove_writer(self._fd)
            self._listener.drained()

    def _readable(self) -> None:
        # A broken connection may be told once only, with its last bytes: read on until none are left.
        for _ in range(_READS_AT_ONCE):
            try:
                data = os.read(self._fd, _READ_SIZE)
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                self._fail(f"read failed: {error.strerror}")
                return
            if not data:
                self._fail("the other end is gone")
                return
            self._listener.received(data)
            if not self._open:
                return

    def _fail(self, reason: str) -> None:
        if self._open:
            self.close()
            self._listener.lost(reason)
