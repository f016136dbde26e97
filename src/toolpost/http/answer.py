"""Sending whole answers over ASGI."""

from typing import Final

from starlette.types import Send

CORS_METHODS: Final = b"GET, POST, PUT, PATCH, DELETE, OPTIONS"
JSON: Final = b"application/json"
TEXT: Final = b"text/plain; charset=utf-8"


async def send_answer(send: Send, status: int, body: bytes, content_type: bytes | None) -> None:
    """Send an answer with its whole body."""
    headers = [(b"content-length", b"%d" % len(body)), (b"x-content-type-options", b"nosniff")]
    if content_type is not None:
        headers.append((b"content-type", content_type))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


async def send_text(send: Send, status: int, text: str) -> None:
    """Send words for a person."""
    await send_answer(send, status, text.encode("utf-8", "replace"), TEXT)
