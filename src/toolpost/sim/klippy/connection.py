"""One client of the socket: JSON objects, each ended by the byte 0x03, both ways."""

import asyncio
from collections.abc import Callable

import msgspec

from toolpost.sim.delay import DelayLine

END = b"\x03"
"""What ends every object."""

MAX_FRAME = 16 * 1024 * 1024
"""A client that sends this many bytes without an end is closed."""


class Connection(asyncio.Protocol):
    """One client.

    Args:
        on_frame: takes each object as it came, without its end.
        on_lost: called once when the client is gone.
        delay: seconds until anything is sent.
        timeout: seconds after which a client that reads nothing is closed.

    Attributes:
        delay: the same; may be changed.
        muted: what would be sent is lost.
        open: whether the client can be sent anything.
        lost: set when the socket is closed for good.
    """

    def __init__(
        self,
        on_frame: "Callable[[Connection, bytes], None]",
        on_lost: "Callable[[Connection], None]",
        *,
        delay: float,
        timeout: float,
    ) -> None:
        self.delay = delay
        self.muted = False
        self.open = False
        self.lost = asyncio.Event()
        self._on_frame = on_frame
        self._on_lost = on_lost
        self._timeout = timeout
        self._loop = asyncio.get_running_loop()
        self._line = DelayLine(self._loop, self._write)
        self._rest = b""
        self._transport: asyncio.Transport | None = None
        self._stuck_timer: asyncio.TimerHandle | None = None

    # -- asyncio's side

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - a Unix socket's always is
        transport.set_write_buffer_limits(high=0)
        self._transport = transport
        self.open = True

    def data_received(self, data: bytes) -> None:
        """Hand over the objects that are complete."""
        *frames, self._rest = (self._rest + data).split(END)
        if len(self._rest) > MAX_FRAME:
            self.abort()
            return
        for frame in frames:
            self._on_frame(self, frame)

    def pause_writing(self) -> None:
        """The client does not read as fast as it is written to."""
        self._stuck_timer = self._loop.call_later(self._timeout, self.abort)

    def resume_writing(self) -> None:
        """The client has read everything."""
        self._cancel_timer()

    def connection_lost(self, _error: Exception | None) -> None:
        """End."""
        self._end()
        self.lost.set()
        self._on_lost(self)

    # -- the host's side

    def send(self, message: object) -> None:
        """Send an object."""
        self.send_bytes(msgspec.json.encode(message) + END)

    def send_bytes(self, data: bytes) -> None:
        """Send bytes as they are."""
        if self.open and not self.muted:
            self._line.push(data, self.delay)

    def close(self) -> None:
        """Close when all that was sent is on its way."""
        self._end()
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close at once."""
        self._end()
        if self._transport is not None:
            self._transport.abort()

    def _write(self, data: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(data)

    def _end(self) -> None:
        self.open = False
        self._line.clear()
        self._cancel_timer()

    def _cancel_timer(self) -> None:
        if self._stuck_timer is not None:
            self._stuck_timer.cancel()
            self._stuck_timer = None
