"""Listeners: uvicorn with bounds of our own."""

import asyncio
import contextlib
import ipaddress
import logging
import socket
from collections.abc import Iterator
from typing import Any, Final, cast

import uvicorn
from httptools import HttpParserError
from starlette.types import ASGIApp
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from toolpost.config import Address
from toolpost.errors import StartError

log = logging.getLogger(__name__)

MAX_HEAD: Final = 32 * 1024
"""Bytes of a request's first line and headers together."""

HEAD_TIMEOUT: Final = 15.0
"""Seconds within which the head of a request must have come once it has begun."""

MAX_MESSAGE: Final = 8 * 2**20
"""Bytes of one WebSocket message."""

STALL_TIMEOUT: Final = 30.0
"""Seconds for which a client may leave its answer unread."""

MAX_UNREAD: Final = 64 * 2**20
"""Bytes of answers that all clients together may leave unread."""

_KEEP_ALIVE: Final = 75
_BACKLOG: Final = 256
_GRACE: Final = 2


class BoundedProtocol(HttpToolsProtocol):
    """uvicorn's HTTP protocol, which ends connections that would cost too much.

    Those are connections whose head is too long or does not come, and those that do not read their answers.
    """

    unread = 0
    """Bytes of answers that clients of all connections have not read."""

    def connection_made(self, transport: Any) -> None:  # noqa: ANN401  # as the base class has it
        """Begin to wait for the first head."""
        super().connection_made(transport)
        if len(self.connections) > (self.limit_concurrency or 0):
            transport.abort()
        self._head_bytes = 0
        self._own_unread = 0
        self._stall_timer: asyncio.TimerHandle | None = None
        self._head_timer: asyncio.TimerHandle | None = None
        self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the timers."""
        self._stop_waiting_for_head()
        self._count_unread(0)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Count what belongs to a head that is not complete."""
        self._head_bytes += len(data)
        super().data_received(data)
        if self._head_bytes > MAX_HEAD and not self.transport.is_closing():
            self.send_400_response("the request's head is too long")
        elif self._head_bytes > 0 and self._head_timer is None:
            self._wait_for_head()

    def on_headers_complete(self) -> None:
        """The head is there; what follows belongs to the body."""
        # One that has come in one piece was not counted.
        if len(self.url) + sum(len(name) + len(value) + 4 for name, value in self.headers) > MAX_HEAD:
            raise HttpParserError("the request's head is too long")
        self._stop_waiting_for_head()
        self._head_bytes = -(1 << 62)
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """What follows belongs to the next head."""
        self._head_bytes = 0
        super().on_message_complete()

    def pause_writing(self) -> None:
        """The client reads slower than it is answered."""
        super().pause_writing()
        self._count_unread(self.transport.get_write_buffer_size())
        if BoundedProtocol.unread > MAX_UNREAD:
            log.warning("%s: does not read its answers; disconnected", self.client)
            self.transport.abort()
        else:
            self._stall_timer = asyncio.get_running_loop().call_later(STALL_TIMEOUT, self.transport.abort)

    def resume_writing(self) -> None:
        """The client has read nearly all."""
        self._count_unread(0)
        super().resume_writing()

    def _count_unread(self, size: int) -> None:
        BoundedProtocol.unread += size - self._own_unread
        self._own_unread = size
        if self._stall_timer is not None:
            self._stall_timer.cancel()
            self._stall_timer = None

    def _wait_for_head(self) -> None:
        self._head_timer = asyncio.get_running_loop().call_later(HEAD_TIMEOUT, self.transport.close)

    def _stop_waiting_for_head(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None


class BoundedWebSocket(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket, which the application can cut at once: a client that does not read is let go."""

    def handle_connect(self, event: Any) -> None:  # noqa: ANN401  # as the base class has it
        """Let the application know how to cut the connection."""
        super().handle_connect(event)
        if self.response.status_code == 101:
            cast("dict[str, Any]", self.scope)["toolpost.abort"] = self.transport.abort


class Listener(uvicorn.Server):
    """One address at which requests are answered.

    Args:
        address: where.
        app: answers them.
        max_connections: connections at one time.
    """

    def __init__(self, address: Address, app: ASGIApp, max_connections: int) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                http=BoundedProtocol,
                ws=BoundedWebSocket,
                ws_max_size=MAX_MESSAGE,
                ws_per_message_deflate=False,
                lifespan="off",
                log_config=None,
                access_log=False,
                proxy_headers=False,
                server_header=False,
                limit_concurrency=max_connections,
                timeout_keep_alive=_KEEP_ALIVE,
                timeout_graceful_shutdown=_GRACE,
            )
        )
        self._address = address
        self._socket = bind(address)
        self._task: asyncio.Task[None] | None = None
        self._ready = asyncio.Event()

    @property
    def url(self) -> str:
        """Where it can be reached."""
        host, port = self._socket.getsockname()[:2]
        return f"http://{Address(host, port)}"

    async def open(self) -> None:
        """Begin to answer; requests are taken when this returns."""
        self._task = asyncio.create_task(self.serve([self._socket]), name=f"listener {self.url}")
        ready = asyncio.create_task(self._ready.wait())
        await asyncio.wait([ready, self._task], return_when=asyncio.FIRST_COMPLETED)
        ready.cancel()
        if self._task.done():
            await self._task

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Say that requests are taken."""
        await super().startup(sockets)
        self._ready.set()

    async def close(self) -> None:
        """Take no more requests, finish those under way and close."""
        self.should_exit = True
        if self._task is not None:
            await self._task

    def release(self) -> None:
        """Give the address back."""
        self._socket.close()

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals alone: the program has one place for them."""
        yield


def bind(address: Address) -> socket.socket:
    """Return a listening socket.

    Raises:
        StartError: the address is not to be had.
    """
    try:
        family, kind, proto, _, where = socket.getaddrinfo(
            address.host, address.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        sock = socket.socket(family, kind, proto)
    except OSError as error:
        raise StartError(f"cannot listen on {address}: {error.strerror}") from None
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(where)
        sock.listen(_BACKLOG)
    except OSError as error:
        sock.close()
        raise StartError(f"cannot listen on {address}: {error.strerror}") from None
    return sock


def is_loopback(address: Address) -> bool:
    """Whether only programs on this computer can reach an address."""
    if address.host == "localhost":
        return True
    try:
        return ipaddress.ip_address(address.host).is_loopback
    except ValueError:
        return False
