"""Working off what the client of one connection asks for."""

import asyncio
from collections import deque
from collections.abc import Coroutine
from typing import Any, Final

from toolpost.dialects.moonraker.connections import Connection
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.jsonrpc import Message, answer_message, decode_message, refuse_message
from toolpost.dialects.moonraker.rpc import Methods, Order

MAX_MESSAGE: Final = 8 * 2**20
"""Bytes of one message."""

MAX_WAITING: Final = 256
"""Messages that may wait for their turn before no more are read."""

MAX_WAITING_BYTES: Final = 16 * 2**20
"""Bytes of such messages."""

MAX_BESIDE: Final = 32
"""Calls that may take long, at one time; more are refused."""

MAX_URGENT: Final = 64
"""Calls at one time that run at once; further urgent ones wait to be read."""


class Session:
    """The calls of one connection.

    They are worked off in the order in which they came, each after the one before it. Those that may take
    long run beside them, and an emergency stop waits for nothing (`Order`).

    Args:
        methods: what can be called.
        connection: who calls.
    """

    def __init__(self, methods: Methods, connection: Connection) -> None:
        self._methods = methods
        self._connection = connection
        self._waiting: deque[Message] = deque()
        self._waiting_bytes = 0
        self._worker: asyncio.Task[None] | None = None
        self._beside: set[asyncio.Task[None]] = set()
        self._progress = asyncio.Event()

    async def take(self, data: str | bytes | bytearray) -> None:
        """Take a message from the client; returns when the next one may be read."""
        message = decode_message(data, self._methods)
        # Neither object nor array: silence, and the connection goes on (1.3).
        if message is None or not message.calls:
            return
        if message.order is Order.IN_TURN:
            self._waiting.append(message)
            self._waiting_bytes += message.size
            if self._worker is None:
                self._worker = asyncio.create_task(self._work(), name=f"{self._connection}")
        elif message.order is Order.BESIDE and len(self._beside) >= MAX_BESIDE:
            busy = RpcError(429, f"more than {MAX_BESIDE} calls of this connection have not ended")
            self._reply(refuse_message(message, busy))
        else:
            self._run_beside(self._answer(message))
        while self._is_full() and self._connection.open:
            self._progress.clear()
            await self._progress.wait()

    async def finish(self) -> None:
        """Return when all that was asked for is done; cancelled, it cancels what is not."""
        while tasks := {*self._beside, *([self._worker] if self._worker is not None else [])}:
            try:
                await asyncio.wait(tasks)
            except asyncio.CancelledError:
                for task in tasks:
                    task.cancel()
                raise

    def _is_full(self) -> bool:
        return (
            len(self._waiting) >= MAX_WAITING
            or self._waiting_bytes > MAX_WAITING_BYTES
            or len(self._beside) >= MAX_URGENT
        )

    def _run_beside(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work, name=f"{self._connection}")
        self._beside.add(task)
        task.add_done_callback(self._end_beside)

    def _end_beside(self, task: asyncio.Task[None]) -> None:
        self._beside.discard(task)
        self._progress.set()

    async def _work(self) -> None:
        try:
            while self._waiting:
                # A client that reads slowly gets its answers slowly, instead of filling the memory with them.
                await self._connection.room()
                message = self._waiting.popleft()
                self._waiting_bytes -= message.size
                await self._answer(message)
                self._progress.set()
                # Many short calls must not hold up the other connections.
                await asyncio.sleep(0)
        finally:
            self._worker = None

    async def _answer(self, message: Message) -> None:
        self._reply(await answer_message(message, self._methods, self._connection))

    def _reply(self, answer: bytes | None) -> None:
        if answer is not None:
            self._connection.send(answer.decode())
