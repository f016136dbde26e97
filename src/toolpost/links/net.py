"""Links over TCP and Unix sockets."""

import asyncio
import errno
import os
import socket
from pathlib import Path

from toolpost.errors import LinkError
from toolpost.links.base import Link, LinkListener, Opener
from toolpost.links.stream import StreamLink

_CONNECT_TIMEOUT = 5.0


def tcp_opener(host: str, port: int) -> Opener:
    """Return an opener of a TCP connection to ``host:port``."""

    async def open_tcp(listener: LinkListener) -> Link:
        try:
            async with asyncio.timeout(_CONNECT_TIMEOUT):
                sock = await _connect_any(host, port)
        except (OSError, UnicodeError) as error:
            raise LinkError(f"tcp://{host}:{port}: {_words(error)}") from None
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return socket_link(sock, listener)

    return open_tcp


def unix_opener(path: Path) -> Opener:
    """Return an opener of a connection to the Unix socket at `path`."""

    async def open_unix(listener: LinkListener) -> Link:
        try:
            async with asyncio.timeout(_CONNECT_TIMEOUT):
                sock = await _connect(socket.socket(socket.AF_UNIX), str(path))
        except OSError as error:
            raise LinkError(f"unix:{path}: {_words(error)}") from None
        return socket_link(sock, listener)

    return open_unix


def socket_link(sock: socket.socket, listener: LinkListener) -> Link:
    """Return a link over a connected socket, which the link then owns."""
    sock.setblocking(False)
    return StreamLink(sock.fileno(), listener, sock.close)


async def _connect_any(host: str, port: int) -> socket.socket:
    """Connect to the first address of a host that takes the connection: ``localhost`` often has two."""
    loop = asyncio.get_running_loop()
    failure = OSError(errno.EADDRNOTAVAIL, "no address")
    for family, kind, proto, _, address in await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM):
        try:
            return await _connect(socket.socket(family, kind, proto), address)
        except OSError as error:
            failure = error
    raise failure


def _words(error: OSError | UnicodeError) -> str:
    if isinstance(error, UnicodeError):
        return "no valid host name"
    # The loop puts words of its own into its errors, and none into that of a timeout.
    if error.errno is not None and error.errno > 0:
        return os.strerror(error.errno)
    return error.strerror or "no answer"


async def _connect(sock: socket.socket, address: object) -> socket.socket:
    sock.setblocking(False)
    try:
        await asyncio.get_running_loop().sock_connect(sock, address)  # type: ignore[arg-type]  # typeshed knows no address of every family
    except BaseException:
        sock.close()
        raise
    return sock
