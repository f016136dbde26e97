"""Listeners: uvicorn with bounds of our own."""

import asyncio
import contextlib
import ipaddress
import socket
from collections.abc import Iterator
from typing import Any, Final

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from toolpost.config import Address
from toolpost.errors import StartError

MAX_HEAD: Final = 32 * 1024
"""Bytes of a request's first line and headers together."""

HEAD_TIMEOUT: Final = 15.0
"""Seconds within which the head of a connection's first request must have come."""

_KEEP_ALIVE: Final = 75
_BACKLOG: Final = 256
_GRACE: Final = 2


class BoundedProtocol(HttpToolsProtocol):
    """uvicorn's HTTP protocol; a head that is too long or does not come ends the connection."""

    def connection_made(self, transport: Any) -> None:  # noqa: ANN401  # as the base class has it
        """Begin to wait for the first head."""
        super().connection_made(transport)
        self._head_bytes = 0
        self._head_timer = asyncio.get_running_loop().call_later(HEAD_TIMEOUT, transport.close)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the timer."""
        self._head_timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Count what belongs to a head that is not complete."""
        self._head_bytes += len(data)
        super().data_received(data)
        if self._head_bytes > MAX_HEAD and not self.transport.is_closing():
            self.send_400_response("the request's head is too long")

    def on_headers_complete(self) -> None:
        """The head is there; what follows is counted as the body."""
        self._head_timer.cancel()
        self._head_bytes = -(1 << 62)
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """The next head begins."""
        self._head_bytes = 0
        super().on_message_complete()


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
                ws="none",
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
        await self._ready.wait()

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
