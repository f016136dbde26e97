"""Reading a request's body, within bounds."""

import asyncio
from typing import Final

from starlette.types import Message, Receive

READ_TIMEOUT: Final = 30.0
"""Seconds without a byte of the body after which a request is given up."""


class BodyError(Exception):
    """A body that cannot be read. The message is safe to show."""


class BodyTooLargeError(BodyError):
    """The body is longer than allowed."""


class BodyBusyError(BodyError):
    """Too many large bodies are being read at the same time."""


class ClientGoneError(BodyError):
    """The client went away before the body was complete."""


class BodyReader:
    """Reads bodies and bounds the memory that all of them take together.

    Args:
        max_bytes: longest body of one request.
        max_total: bytes of all bodies that may be held at one time.
    """

    def __init__(self, max_bytes: int, max_total: int) -> None:
        self._max_bytes = max_bytes
        self._max_total = max_total
        self._held = 0

    async def read(self, receive: Receive, most: int | None = None) -> bytes | bytearray:
        """Return the body.

        Args:
            receive: from where (ASGI).
            most: longest body of this call, where that is less than what the server takes.

        Raises:
            BodyError: it is too long, does not come, or there is no room for it now.
        """
        most = self._max_bytes if most is None else min(most, self._max_bytes)
        message = await self._next(receive)
        body: bytes = message.get("body", b"")
        if not message.get("more_body", False):
            if len(body) > most:
                raise BodyTooLargeError(f"the body must be at most {most} bytes")
            return body
        return await self._read_rest(body, receive, most)

    async def _read_rest(self, first: bytes, receive: Receive, most: int) -> bytearray:
        body = bytearray(first)
        self._held += len(first)
        try:
            more = True
            while more:
                message = await self._next(receive)
                chunk = message.get("body", b"")
                body += chunk
                self._held += len(chunk)
                more = message.get("more_body", False)
                if len(body) > most:
                    raise BodyTooLargeError(f"the body must be at most {most} bytes")
                if self._held > self._max_total:
                    raise BodyBusyError("too many large requests at the same time; try again")
        finally:
            self._held -= len(body)
        return body

    async def _next(self, receive: Receive) -> Message:
        try:
            async with asyncio.timeout(READ_TIMEOUT):
                message = await receive()
        except TimeoutError:
            raise ClientGoneError("the body did not come") from None
        if message["type"] != "http.request":
            raise ClientGoneError("the client went away")
        return message
