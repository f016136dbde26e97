"""The WebSocket at ``/websocket``: JSON-RPC in text frames, and the notifications."""

import asyncio
import contextlib
import logging
from typing import Final

from starlette.types import Message, Receive, Scope, Send

from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.rpc import Methods
from toolpost.dialects.moonraker.session import MAX_MESSAGE, Session

log = logging.getLogger(__name__)

ABORT: Final = "toolpost.abort"
"""Key of the scope under which the server may leave a function that cuts the connection at once."""

_TOO_BIG: Final = 1009
_POLICY: Final = 1008
_CLOSE_TIMEOUT: Final = 1.0


class WebSocketEndpoint:
    """The WebSocket as an ASGI application (ASGI 3, spec version 2.4); the server answers pings.

    Args:
        methods: what can be called.
        connections: where its connections are entered.
        max_message: bytes of one message.
    """

    def __init__(self, methods: Methods, connections: Connections, max_message: int = MAX_MESSAGE) -> None:
        self._methods = methods
        self._connections = connections
        self._max_message = max_message

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection to its end."""
        message = await receive()
        if message["type"] != "websocket.connect":
            return
        peer = scope.get("client") or ("", 0)
        actor = scope.get("toolpost.actor", "")
        connection = self._connections.open("websocket", actor, f"{peer[0]}:{peer[1]}")
        if connection is None:
            await send({"type": "websocket.close", "code": _POLICY})
            return
        try:
            with contextlib.suppress(OSError):
                await send({"type": "websocket.accept"})
                await self._serve(connection, scope, receive, send)
        finally:
            self._connections.close(connection)

    async def _serve(self, connection: Connection, scope: Scope, receive: Receive, send: Send) -> None:
        session = Session(self._methods, connection)

        async def write(text: str) -> None:
            try:
                await send({"type": "websocket.send", "text": text})
            except RuntimeError as error:
                # What uvicorn raises once it has sent a close of its own.
                raise ConnectionResetError from error

        reader = asyncio.create_task(self._read(connection, session, receive, send), name=f"{connection}")
        try:
            await connection.pump(write)
        finally:
            reader.cancel()
            if connection.dropped:
                await _cut(scope, send)
            # What was asked for is done, whether or not the client waits for the answer.
            await session.finish()
            await asyncio.wait([reader])
        if not reader.cancelled():
            reader.result()

    async def _read(self, connection: Connection, session: Session, receive: Receive, send: Send) -> None:
        try:
            while connection.open:
                data = _data(await receive())
                if data is None:
                    break
                if len(data) > self._max_message:
                    log.warning("%s: sends a message of %d bytes; disconnected", connection, len(data))
                    await send({"type": "websocket.close", "code": _TOO_BIG})
                    break
                await session.take(data)
        finally:
            connection.close()


def _data(message: Message) -> str | bytes | None:
    """Return what a message holds, or None if it is the last one."""
    if message["type"] != "websocket.receive":
        return None
    text: str | None = message.get("text")
    if text is not None:
        return text
    data: bytes = message.get("bytes") or b""
    return data


async def _cut(scope: Scope, send: Send) -> None:
    """End the connection of a client that does not read: it would not read that either."""
    if ABORT in scope:
        scope[ABORT]()
        return
    with contextlib.suppress(OSError, TimeoutError):
        async with asyncio.timeout(_CLOSE_TIMEOUT):
            await send({"type": "websocket.close", "code": _POLICY})
