"""The Unix socket: the same JSON-RPC, each message ended by the byte 0x03.

Source: external_api/introduction.md of Moonraker's documentation, "Unix Socket Connection".
"""

import asyncio
import contextlib
import logging
import socket
import struct
from pathlib import Path
from typing import Final

from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.rpc import Methods
from toolpost.dialects.moonraker.session import MAX_MESSAGE, Session
from toolpost.errors import StartError

log = logging.getLogger(__name__)

_END: Final = b"\x03"
_CREDENTIALS: Final = struct.Struct("3i")


class UnixListener:
    """A Unix socket at which requests are answered; only the user whom the server runs as may open it.

    Args:
        path: where; what is there is replaced.
        methods: what can be called.
        connections: where its connections are entered.
        max_message: bytes of one message.
    """

    def __init__(
        self, path: Path, methods: Methods, connections: Connections, max_message: int = MAX_MESSAGE
    ) -> None:
        self._path = path
        self._methods = methods
        self._connections = connections
        self._max_message = max_message
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def open(self) -> None:
        """Begin to answer.

        Raises:
            StartError: the path is not to be had.
        """
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._path.unlink(missing_ok=True)
            sock.bind(str(self._path))
            # Before listen: nobody can have connected with other rights.
            self._path.chmod(0o600)
            self._server = await asyncio.start_unix_server(self._accept, sock=sock, limit=self._max_message)
        except OSError as error:
            sock.close()
            raise StartError(f"cannot listen on {self._path}: {error.strerror or error}") from None

    async def close(self) -> None:
        """Take no more requests, and end the connections."""
        if self._server is None:
            return
        self._server.close()
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)
        self._path.unlink(missing_ok=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is None:
            return
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        actor = f"unix:{_user(writer)}"
        connection = self._connections.open("unix", actor, actor)
        if connection is None:
            writer.close()
            return
        try:
            with contextlib.suppress(asyncio.CancelledError):
                await self._serve(connection, reader, writer)
        finally:
            self._connections.close(connection)
            # What could not be written by now never will be.
            writer.transport.abort()

    async def _serve(
        self, connection: Connection, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        session = Session(self._methods, connection)

        async def write(text: str) -> None:
            writer.write(text.encode() + _END)
            await writer.drain()

        reading = asyncio.create_task(self._read(connection, session, reader), name=f"{connection}")
        try:
            await connection.pump(write)
        finally:
            reading.cancel()
            if connection.dropped:
                writer.transport.abort()
            await session.finish()
            await asyncio.wait([reading])

    async def _read(self, connection: Connection, session: Session, reader: asyncio.StreamReader) -> None:
        try:
            while connection.open:
                message = await reader.readuntil(_END)
                await session.take(message[:-1])
        except asyncio.LimitOverrunError:
            log.warning(
                "%s: sends a message of more than %d bytes; disconnected", connection, self._max_message
            )
        except (asyncio.IncompleteReadError, OSError):
            pass
        finally:
            connection.close()


def _user(writer: asyncio.StreamWriter) -> int:
    """Return the user id at the other end (unix(7), SO_PEERCRED)."""
    sock = writer.get_extra_info("socket")
    credentials = sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    user: int = _CREDENTIALS.unpack(credentials)[1]
    return user
