"""Links over a serial device or a pty."""

import asyncio
import contextlib
import fcntl
import os
import termios
from pathlib import Path

from toolpost.errors import LinkError
from toolpost.links.base import Link, LinkListener, Opener
from toolpost.links.stream import StreamLink


def serial_opener(path: Path, baud: int) -> Opener:
    """Return an opener of a serial device, raw 8N1 and exclusive.

    Args:
        path: device, e.g. ``/dev/serial/by-id/...``, or a pty.
        baud: bits per second; any number that the device takes.
    """

    async def open_serial(listener: LinkListener) -> Link:
        # Opening may block for long on a device that is not well, and its library takes 50 ms to import.
        port = await asyncio.to_thread(_open, path, baud)
        return StreamLink(port.fileno(), listener, port.close)

    return open_serial


class _Port:
    """An open device with its lock."""

    def __init__(self, path: Path, baud: int) -> None:
        from serialx import BaseSerial, Serial

        self._serial: BaseSerial = Serial(  # type: ignore[abstract]  # which class it is depends on the platform
            str(path), baud, exclusive=True, rtscts=False, dsrdtr=False, close_timeout=0.0
        )
        self._serial.open()

    def fileno(self) -> int:
        return int(self._serial.fileno())

    def close(self) -> None:
        # What a dead device has not taken would otherwise hold up the close for half a minute.
        with contextlib.suppress(OSError, termios.error):
            termios.tcflush(self._serial.fileno(), termios.TCIOFLUSH)
        with contextlib.suppress(OSError):
            self._serial.close()


def _open(path: Path, baud: int) -> _Port:
    try:
        port = _Port(path, baud)
    except FileNotFoundError:
        raise LinkError(f"{path}: no such device") from None
    except OSError as error:
        raise LinkError(f"{path}: {error.strerror or error}") from None
    # TIOCEXCL does not stop root, and a second reader steals bytes: the lock is asked for as well.
    fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
    try:
        fcntl.flock(port.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        port.close()
        raise LinkError(f"{path}: another program uses this device") from None
    os.set_blocking(port.fileno(), False)
    return port
