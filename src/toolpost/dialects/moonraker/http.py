"""The methods over HTTP: routes, arguments in, ``{"result": ...}`` out, and JSON-RPC by POST.

Source: dialects/moonraker.md 1, 1.1, 1.2 and 1.3.
"""

import hashlib
from typing import Final

import msgspec
from starlette.routing import BaseRoute, Match
from starlette.types import Receive, Scope, Send

from toolpost.dialects.moonraker.connections import Connection
from toolpost.dialects.moonraker.errors import RpcError, as_rpc_error
from toolpost.dialects.moonraker.jsonrpc import answer_message, decode_message
from toolpost.dialects.moonraker.query import decode_arguments
from toolpost.dialects.moonraker.rpc import Method, Methods
from toolpost.dialects.moonraker.session import MAX_MESSAGE
from toolpost.http.body import BodyBusyError, BodyError, BodyReader, BodyTooLargeError

RPC_PATH: Final = "/server/jsonrpc"

MAX_TAGGED: Final = 256 * 1024
"""Bytes of an answer up to which it has an ETag: a longer one costs more to hash than it ever saves."""

_JSON: Final = b"application/json; charset=UTF-8"
_HTML: Final = b"text/html; charset=UTF-8"
_ENCODER: Final = msgspec.json.Encoder()


class MethodRoutes(BaseRoute):
    """All methods that have a path, and ``POST /server/jsonrpc``, as one route.

    A path is looked up, however many there are.

    Args:
        methods: what can be called; complete.
        bodies: reads the requests.
    """

    def __init__(self, methods: Methods, bodies: BodyReader) -> None:
        self._methods = methods
        self._bodies = bodies
        self._paths: dict[str, dict[str, Method | None]] = {RPC_PATH: {"POST": None}}
        for method in methods:
            for verb, path in method.http_pairs:
                self._paths.setdefault(path, {})[verb] = method

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Whether the path is one of a method."""
        if scope["type"] == "http" and _path(scope) in self._paths:
            return Match.FULL, {}
        return Match.NONE, {}

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        verbs = self._paths[_path(scope)]
        if scope["method"] not in verbs:
            error = RpcError(405, "Method Not Allowed")
            await send_error(scope, send, error, [(b"allow", ", ".join(sorted(verbs)).encode("ascii"))])
            return
        method = verbs[scope["method"]]
        try:
            if method is None:
                await self._answer_rpc(scope, receive, send)
            else:
                await self._answer(method, scope, receive, send)
        except RpcError as error:
            await send_error(scope, send, error)

    async def _answer(self, method: Method, scope: Scope, receive: Receive, send: Send) -> None:
        content_type, if_none_match, has_body = _read_headers(scope)
        body = await self._read(receive) if has_body else b""
        arguments = decode_arguments(scope["query_string"], content_type, body)
        if method.from_http is not None:
            arguments = method.from_http(arguments)
        result = await self._methods.dispatch(method.name, arguments, _connection(scope))
        try:
            answer = b'{"result":' + _ENCODER.encode(result) + b"}"
        except Exception as error:  # noqa: BLE001  # a result that is none is a fault of the handler
            raise as_rpc_error(error, method.name) from None
        await send_result(scope, send, answer, if_none_match)

    async def _answer_rpc(self, scope: Scope, receive: Receive, send: Send) -> None:
        message = decode_message(await self._read(receive), self._methods)
        if message is None:
            raise RpcError(400, "Invalid Request: it must be a JSON object or an array of them")
        answer = await answer_message(message, self._methods, _connection(scope))
        # 1.3: errors too have the status 200, and what is not answered has an empty body.
        await _send(scope, send, 200, answer or b"", [(b"content-type", _JSON if answer else _HTML)])

    async def _read(self, receive: Receive) -> bytes | bytearray:
        try:
            return await self._bodies.read(receive, MAX_MESSAGE)
        except BodyTooLargeError as error:
            raise RpcError(413, str(error)) from None
        except BodyBusyError as error:
            raise RpcError(503, str(error)) from None
        except BodyError as error:
            raise RpcError(400, str(error)) from None


async def not_found(scope: Scope, receive: Receive, send: Send) -> None:  # noqa: ARG001  # an ASGI application
    """Answer 404 as Moonraker does (1.1), for whatever path no route has."""
    await send_error(scope, send, RpcError(404, "Not Found"))


async def send_error(
    scope: Scope, send: Send, error: RpcError, headers: list[tuple[bytes, bytes]] | None = None
) -> None:
    """Answer with an error: ``{"error": {"code": ..., "message": ...}}``."""
    body = _ENCODER.encode({"error": {"code": error.status, "message": error.message}})
    await _send(scope, send, error.status, body, [(b"content-type", _JSON), *(headers or [])])


async def send_result(scope: Scope, send: Send, body: bytes, if_none_match: bytes = b"") -> None:
    """Answer 200 with JSON; a GET with an ETag, or with 304 if the client has that body (RFC 9110 13.1.2)."""
    headers = [(b"content-type", _JSON)]
    if scope["method"] == "GET" and len(body) <= MAX_TAGGED:
        tag = b'"' + hashlib.sha1(body, usedforsecurity=False).hexdigest().encode("ascii") + b'"'
        headers.append((b"etag", tag))
        if if_none_match and _has_tag(if_none_match, tag):
            await _send(scope, send, 304, b"", [(b"etag", tag)])
            return
    await _send(scope, send, 200, body, headers)


async def _send(
    scope: Scope, send: Send, status: int, body: bytes, headers: list[tuple[bytes, bytes]]
) -> None:
    if scope["method"] == "HEAD":
        body = b""
    if status != 304:
        headers.append((b"content-length", b"%d" % len(body)))
    headers.append((b"x-content-type-options", b"nosniff"))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def _path(scope: Scope) -> str:
    """Return the path below where the routes are mounted."""
    path: str = scope["path"]
    return path.removeprefix(scope.get("root_path", ""))


def _connection(scope: Scope) -> Connection:
    peer = scope.get("client") or ("", 0)
    return Connection("http", scope.get("toolpost.actor", ""), peer[0])


def _read_headers(scope: Scope) -> tuple[str, bytes, bool]:
    """Return the Content-Type, If-None-Match, and whether there is a body (RFC 9112 6.3)."""
    content_type, if_none_match, has_body = "", b"", False
    for name, value in scope["headers"]:
        if name == b"content-type":
            content_type = value.decode("latin-1")
        elif name == b"if-none-match":
            if_none_match = value
        elif name == b"transfer-encoding" or (name == b"content-length" and value != b"0"):
            has_body = True
    return content_type, if_none_match, has_body


def _has_tag(header: bytes, tag: bytes) -> bool:
    """Whether a tag is in a list of them, compared weakly."""
    return any(part.strip().removeprefix(b"W/") in {tag, b"*"} for part in header.split(b","))
