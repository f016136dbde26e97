"""The connections that are open, and what each has been told.

A message to all is encoded once and put into every connection's queue in the same turn of the loop, so
that no two are ever out of order. A queue is bounded: a client that does not read is let go, and nobody else
waits for it.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from typing import Any, Final, TypeAlias

import msgspec

log = logging.getLogger(__name__)

MAX_CONNECTIONS: Final = 256
"""Connections that stay, at one time, over all transports."""

MAX_MESSAGES: Final = 1024
"""Messages that a client may leave unread before it is let go."""

MAX_CHARACTERS: Final = 32 * 2**20
"""Characters of messages that a client may leave unread before it is let go."""

STALL_TIMEOUT: Final = 30.0
"""Seconds within which a client must have read enough for the next message to go out."""

_ROOMY: Final = 2**20

Write: TypeAlias = Callable[[str], Awaitable[None]]


class Identity(msgspec.Struct, frozen=True):
    """What a client says it is; nothing rests on it being true."""

    client_name: str
    version: str
    type: str
    url: str


class Connection:
    """A client's connection, or a single request over HTTP.

    Args:
        transport: ``http``, ``websocket`` or ``unix``.
        actor: who it is, as the gate found.
        peer: its address, for the log.
        number: unique among those that stay; 0 for a request over HTTP.

    Attributes:
        identity: what it has said that it is.
        shown_jobs: ids of the queue as this client was last shown it. Ids are never used again, so what is
            not in the queue any more need not be remembered.
    """

    def __init__(self, transport: str, actor: str, peer: str = "", number: int = 0) -> None:
        self.transport = transport
        self.actor = actor
        self.peer = peer
        self.number = number
        self.identity: Identity | None = None
        self.shown_jobs: frozenset[str] = frozenset()
        self.dropped = False
        self._open = self.persistent
        self._unsent: deque[str | frozenset[str]] = deque()
        self._characters = 0
        self._wake = asyncio.Event()
        self._roomy = asyncio.Event()
        self._deadline: asyncio.Timeout | None = None
        self._at_close: list[Callable[[], object]] = []

    def __str__(self) -> str:
        name = f", {self.identity.client_name[:40]!r}" if self.identity is not None else ""
        return f"{self.transport} {self.number} ({self.peer}{name})"

    @property
    def persistent(self) -> bool:
        """Whether it stays after the call, and can be notified."""
        return self.number > 0

    @property
    def open(self) -> bool:
        """Whether messages are still taken."""
        return self._open

    def at_close(self, call: Callable[[], object]) -> None:
        """Call `call` when the connection ends, e.g. to end a subscription."""
        self._at_close.append(call)

    def notify(self, method: str, *params: object) -> None:
        """Notify this client alone; it is lost if the connection has ended."""
        self.send(encode_notification(method, params))

    def show(self, jobs: frozenset[str]) -> None:
        """Note that the client is shown the queue in what is sent next, or was in what was sent last."""
        if not self._unsent:
            self.shown_jobs = jobs
        else:
            # Not before what waits has gone out: a client that reads slowly has not been shown it yet.
            self._unsent.append(jobs)

    def send(self, text: str) -> None:
        """Queue a message; a client with too many unread ones is let go."""
        if not self._open:
            return
        self._unsent.append(text)
        self._characters += len(text)
        self._wake.set()
        if len(self._unsent) > MAX_MESSAGES or self._characters > MAX_CHARACTERS:
            self.drop(f"leaves {len(self._unsent)} messages ({self._characters} characters) unread")

    def drop(self, why: str) -> None:
        """Let go of a client that is a burden."""
        if self._open:
            log.warning("%s: %s; disconnected", self, why)
            self.dropped = True
            self.close()

    def close(self) -> None:
        """Take no more messages, and forget those that are queued."""
        self._open = False
        self._unsent.clear()
        self._characters = 0
        self._wake.set()
        self._roomy.set()
        if self._deadline is not None:
            # A write that a client holds up ends now.
            self._deadline.reschedule(0)
        calls, self._at_close = self._at_close, []
        for call in calls:
            call()

    async def room(self) -> None:
        """Return when the client has read nearly everything, or is gone."""
        while self._open and self._characters > _ROOMY:
            self._roomy.clear()
            await self._roomy.wait()

    async def pump(self, write: Write) -> None:
        """Write what is queued, until the connection is closed or its client is let go.

        Args:
            write: sends one message; OSError if the client is gone.
        """
        while self._open:
            if not self._unsent:
                self._wake.clear()
                await self._wake.wait()
                continue
            item = self._unsent.popleft()
            if isinstance(item, str):
                await self._write(write, item)
            else:
                self.shown_jobs = item

    async def _write(self, write: Write, text: str) -> None:
        try:
            async with asyncio.timeout(STALL_TIMEOUT) as self._deadline:
                await write(text)
        except TimeoutError:
            self.drop(f"has read nothing for {STALL_TIMEOUT:g} s")
        except OSError:
            self.close()
        finally:
            self._deadline = None
        if self._open:
            self._characters -= len(text)
            if self._characters <= _ROOMY:
                self._roomy.set()


class Connections:
    """All connections that stay.

    Args:
        limit: how many there may be.
    """

    def __init__(self, limit: int = MAX_CONNECTIONS) -> None:
        self._limit = limit
        self._last = 0
        self._all: dict[int, Connection] = {}

    def __len__(self) -> int:
        return len(self._all)

    def __iter__(self) -> Iterator[Connection]:
        return iter(list(self._all.values()))

    def open(self, transport: str, actor: str, peer: str) -> Connection | None:
        """Return a new connection, or None if there are too many."""
        if len(self._all) >= self._limit:
            log.warning("%s %s: refused, there are %d connections", transport, peer, self._limit)
            return None
        self._last += 1
        connection = Connection(transport, actor, peer, self._last)
        self._all[self._last] = connection
        return connection

    def close(self, connection: Connection) -> None:
        """Forget a connection."""
        self._all.pop(connection.number, None)
        connection.close()

    def close_all(self) -> None:
        """End all connections, as the server does when it stops."""
        for connection in self:
            connection.close()

    def notify(self, method: str, *params: object, shows: frozenset[str] | None = None) -> None:
        """Notify all clients: at once, in the order of the calls, and each message is encoded once.

        Args:
            method: name of the notification.
            params: what it tells.
            shows: ids of the whole queue, if the message shows it.
        """
        if not self._all:
            return
        text = encode_notification(method, params)
        for connection in self:
            connection.send(text)
            if shows is not None:
                connection.show(shows)


def encode_notification(method: str, params: tuple[Any, ...]) -> str:
    """Return a notification as it is sent (1.4); one that tells nothing more has no params."""
    message: dict[str, object] = {"jsonrpc": "2.0", "method": method}
    if params:
        message["params"] = params
    return msgspec.json.encode(message).decode()
