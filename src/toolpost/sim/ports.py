"""How a simulated core meets a host: on a pty, or on a socket pair in the same process."""

import asyncio
import errno
import os
import pty
import select
import socket
import stat
import tty
from collections.abc import Callable, Iterable
from pathlib import Path

from toolpost.errors import StartError
from toolpost.sim.faults import Fault
from toolpost.sim.options import SparkOptions
from toolpost.sim.spark import SparkCore
from toolpost.sim.stream import Stream

HOST_POLL = 0.02
"""How often a pty that no host has open is looked at, seconds: the kernel has no event for it."""

_PTY_PREFIX = "/dev/pts/"


class PtyPort:
    """A simulated Spark core behind a pseudo-terminal, as if on a serial port.

    The core runs on whether or not a host has the port open. What it says while none has is
    lost, as on a serial line.

    Args:
        loop: the loop that runs everything.
        options: what the core is like.
        link: a path for a symlink to the pty, which stays the same when the pty changes. A
            stale link to a pty is replaced; anything else at that path is left alone.
        baud: speed of the wire, bits per second; None for no limit.
        faults: faults that the core shall have.
        trace: as for ``SparkCore``.

    Attributes:
        core: the simulated core.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        options: SparkOptions | None = None,
        *,
        link: Path | None = None,
        baud: int | None = None,
        faults: Iterable[Fault] = (),
        trace: Callable[[str, bytes], None] | None = None,
    ) -> None:
        self._loop = loop
        self._link = link
        self._baud = baud
        self._faults = tuple(faults)
        self._master = -1
        self._device = ""
        self._stream: Stream | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._dropped = 0
        self.core = SparkCore(self._send, loop, options or SparkOptions(), trace)
        self.core.unplug = self._unplug

    @property
    def path(self) -> str:
        """Where a host finds the port: the symlink, or the pty; empty while it is unplugged."""
        if self._master < 0:
            return ""
        return str(self._link) if self._link else self._device

    @property
    def dropped(self) -> int:
        """Answers dropped because the host did not read."""
        return self._dropped + (self._stream.dropped if self._stream else 0)

    def start(self) -> None:
        """Make the pty and its symlink, and boot the core.

        Raises:
            StartError: there is something else at the symlink's path, or no pty is to be had.
        """
        try:
            self._plug()
        except OSError as error:
            self._withdraw()
            raise StartError(self._explain(error)) from error
        self.core.boot()
        for fault in self._faults:
            self.core.inject(fault)

    def close(self) -> None:
        """End: the host's descriptor breaks, and the symlink is removed."""
        self.core.close()
        self._withdraw()

    def _plug(self) -> None:
        master, slave = pty.openpty()
        self._master = master
        self._device = os.ttyname(slave)
        tty.setraw(slave)
        os.close(slave)
        os.set_blocking(master, False)
        if self._link:
            _make_link(self._link, self._device)
        self._listen()

    def _explain(self, error: OSError) -> str:
        if self._link is None or error.filename is None:
            return f"cannot make the simulated port: {error.strerror or error}"
        if isinstance(error, FileExistsError):
            return f"{self._link}: is taken by something that is no link to a pty; name another path"
        return f"{self._link}: cannot be made: {error.strerror}"

    def _withdraw(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._end_stream()
        if self._link and self._device:
            _remove_link(self._link, self._device)
        if self._master >= 0:
            os.close(self._master)
        self._master = -1
        self._device = ""

    def _unplug(self, seconds: float) -> None:
        self._withdraw()
        self._timer = self._loop.call_later(seconds, self._replug)

    def _replug(self) -> None:
        self._timer = None
        try:
            self._plug()
        except OSError:
            # Somebody took the symlink's path, or ptys ran out: try again, as a person would.
            self._unplug(1.0)

    def _listen(self) -> None:
        """Serve the host that has the pty open, or look again soon."""
        self._timer = None
        if self._has_host():
            self._stream = Stream(self._loop, self._master, self.core.receive, self._host_left, self._baud)
        else:
            self._timer = self._loop.call_later(HOST_POLL, self._listen)

    def _host_left(self) -> None:
        self._end_stream()
        self._timer = self._loop.call_later(HOST_POLL, self._listen)

    def _end_stream(self) -> None:
        if self._stream is not None:
            self._dropped += self._stream.dropped
            self._stream.stop()
            self._stream = None

    def _has_host(self) -> bool:
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        return not any(events & select.POLLHUP for _, events in poll.poll(0))

    def _send(self, data: bytes) -> None:
        if self._stream is not None:
            self._stream.write(data)


class SimulatedSpark:
    """A simulated Spark core in this process (``link = "sim"``), met over a socket pair.

    The core lives on from one connection to the next, as a machine does when its host restarts.
    It is powered on by the first connection, whose first line is therefore the boot message.

    Args:
        loop: the loop that runs everything.
        options: what the core is like.
        baud: speed of the wire, bits per second; None for no limit.
        faults: faults that the core shall have; their clock starts at the first connection.
        trace: as for ``SparkCore``.

    Attributes:
        core: the simulated core.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        options: SparkOptions | None = None,
        *,
        baud: int | None = None,
        faults: Iterable[Fault] = (),
        trace: Callable[[str, bytes], None] | None = None,
    ) -> None:
        self._loop = loop
        self._baud = baud
        self._socket: socket.socket | None = None
        self._stream: Stream | None = None
        self._away_until = 0.0
        self._dropped = 0
        self._faults = tuple(faults)
        self.core = SparkCore(self._send, loop, options or SparkOptions(), trace)
        self.core.unplug = self._unplug

    @property
    def dropped(self) -> int:
        """Answers dropped because the host did not read."""
        return self._dropped + (self._stream.dropped if self._stream else 0)

    def connect(self) -> socket.socket:
        """Return the host's end of a new connection: a non-blocking stream socket.

        An earlier connection ends, as a port's does when it is opened again.

        Raises:
            OSError: the port is unplugged; ``errno`` is ``ENODEV``.
        """
        if self._loop.time() < self._away_until:
            raise OSError(errno.ENODEV, "the simulated port is unplugged")
        self._disconnect()
        ours, host = socket.socketpair()
        ours.setblocking(False)
        host.setblocking(False)
        self._socket = ours
        self._stream = Stream(self._loop, ours.fileno(), self.core.receive, self._disconnect, self._baud)
        if not self.core.boots:
            self.core.boot()
            for fault in self._faults:
                self.core.inject(fault)
        return host

    def close(self) -> None:
        """End: the connection breaks and the core stops."""
        self.core.close()
        self._disconnect()

    def _disconnect(self) -> None:
        if self._stream is not None:
            self._dropped += self._stream.dropped
            self._stream.stop()
            self._stream = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _unplug(self, seconds: float) -> None:
        self._disconnect()
        self._away_until = self._loop.time() + seconds

    def _send(self, data: bytes) -> None:
        if self._stream is not None:
            self._stream.write(data)


def _make_link(link: Path, device: str) -> None:
    """Make ``link`` point to ``device``, in one step; replace nothing but a link to a pty."""
    try:
        link.symlink_to(device)
    except FileExistsError:
        if not _is_pty_link(link):
            raise
    else:
        return
    fresh = link.with_name(f".{link.name}.{os.getpid()}")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(device)
    fresh.replace(link)


def _is_pty_link(link: Path) -> bool:
    mode = link.lstat().st_mode
    return stat.S_ISLNK(mode) and str(link.readlink()).startswith(_PTY_PREFIX)


def _remove_link(link: Path, device: str) -> None:
    """Remove ``link`` if it is still ours."""
    try:
        ours = str(link.readlink()) == device
    except OSError:
        return
    if ours:
        link.unlink(missing_ok=True)
