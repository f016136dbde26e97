"""Who may come in: the checks that every request passes before a dialect sees it.

Browsers are the danger on a loopback listener: a page of any site may send requests to it, and a hostile
name server may make its own name point here. So the ``Host`` must be a name of this server, and an
``Origin``, where there is one, must be allowed. On any other listener a key is required as well; an
address is never taken for an identity, except for networks that the configuration opens in so many words.
"""

import ipaddress
import re
import socket
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Final, NamedTuple

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from toolpost.config import ServerConfig
from toolpost.http.answer import CORS_METHODS, TEXT, send_answer, send_text

_LOCAL_NAMES: Final = frozenset({"localhost", "127.0.0.1", "[::1]"})
_HOST: Final = re.compile(rb"(\[[0-9a-f:.]+\]|[^\[\]:@/]+)(?::[0-9]*)?")
_SIMPLE_TYPES: Final = (b"text/plain", b"application/x-www-form-urlencoded", b"multipart/form-data")
_BROWSER_HEADERS: Final = frozenset({b"origin", b"sec-fetch-site", b"sec-fetch-mode"})

_CHANGING: Final = frozenset({"POST", "PUT", "PATCH", "DELETE"})

_FAILURES: Final = 20
_FAILURE_WINDOW: Final = 60.0
_FAILURES_KEPT: Final = 1024


class Gate:
    """An ASGI application in front of another (ASGI 3).

    Args:
        app: what is behind the gate.
        config: hosts, origins and networks that are let in.
        local: whether the listener is on a loopback address, where no key is required.
        key_owner: returns the name of a key, or None if it is no valid key.
        takes_forms: whether forms are part of the API at a path.
    """

    def __init__(
        self,
        app: ASGIApp,
        config: ServerConfig,
        *,
        local: bool,
        key_owner: Callable[[str], str | None],
        takes_forms: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self._app = app
        self._local = local
        self._key_owner = key_owner
        self._takes_forms = takes_forms
        self._networks = [ipaddress.ip_network(text) for text in config.open_networks]
        own = socket.gethostname().lower()
        self._hosts = _LOCAL_NAMES | {own, f"{own}.local"} | {host.lower() for host in config.hosts}
        self._origins = frozenset(origin.lower().rstrip("/") for origin in config.origins)
        self._allowed: dict[tuple[bytes, bytes | None], bool] = {}
        self._failures = FailureLimit()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request or a WebSocket through, or answer it here."""
        if scope["type"] == "http":
            await self._pass_http(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._pass_websocket(scope, receive, send)

    async def _pass_http(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = _read_headers(scope)
        refusal = self._check_names(headers)
        if refusal is not None:
            await send_text(send, *refusal)
            return
        if headers.origin is not None:
            send = _with_cors(send, headers.origin)
        if scope["method"] == "OPTIONS":
            await send_answer(send, 204, b"", None)
            return
        refusal = self._check_key(scope, headers.key) or self._check_type(scope, headers)
        if refusal is not None:
            await send_text(send, *refusal)
            return
        await self._app(scope, receive, send)

    async def _pass_websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = _read_headers(scope)
        refusal = self._check_names(headers) or self._check_key(scope, headers.key)
        if refusal is None:
            await self._app(scope, receive, send)
            return
        status, text = refusal
        await receive()
        start = {
            "type": "websocket.http.response.start",
            "status": status,
            "headers": [(b"content-type", TEXT)],
        }
        await send(start)
        await send({"type": "websocket.http.response.body", "body": text.encode()})

    def _check_names(self, headers: "_Headers") -> tuple[int, str] | None:
        """Return status and text of a refusal by Host or Origin, or None."""
        if headers.host is None or not self._allows_host(headers.host):
            return 403, "this server does not go by that name (Host); see server.hosts"
        if headers.origin is not None and not self._allows_origin(headers.host, headers.origin):
            return 403, "pages of this origin may not call (Origin); see server.origins"
        return None

    def _check_type(self, scope: Scope, headers: "_Headers") -> tuple[int, str] | None:
        """Refuse what a browser sends without asking first, whatever page it is on.

        Where forms are part of an API, an allowed origin is proof enough of the page; programs have none.
        """
        if scope["method"] not in _CHANGING or not _is_simple(headers.content_type, headers.browser):
            return None
        if self._takes_forms(scope["path"]) and (headers.origin is not None or not headers.browser):
            return None
        return 400, "the Content-Type must be application/json"

    def _check_key(self, scope: Scope, key: str | None) -> tuple[int, str] | None:
        """Return status and text of a refusal, or None; notes the actor in the scope."""
        peer = scope["client"][0] if scope.get("client") else ""
        if key is not None:
            owner = self._key_owner(key)
            if owner is not None:
                scope["toolpost.actor"] = f"key:{owner}"
                return None
            self._failures.add(peer)
            if self._failures.exceeded(peer):
                return 429, "too many wrong keys from this address; wait a minute"
            return 401, "this API key is not valid"
        if self._local or self._is_open_to(peer):
            scope["toolpost.actor"] = f"address:{peer}"
            return None
        return 401, "an API key is required (X-Api-Key); make one with `toolpost key add NAME`"

    def _allows_host(self, host: bytes) -> bool:
        found = self._allowed.get((host, None))
        if found is None:
            found = self._remember((host, None), self._is_own_name(_hostname(host)))
        return found

    def _allows_origin(self, host: bytes, origin: bytes) -> bool:
        found = self._allowed.get((host, origin))
        if found is None:
            text = origin.decode("latin-1").lower()
            name = _origin_host(text)
            allowed = text in self._origins or name in _LOCAL_NAMES or _same_origin(text, host)
            found = self._remember((host, origin), allowed)
        return found

    def _remember(self, key: tuple[bytes, bytes | None], allowed: bool) -> bool:
        if len(self._allowed) > 256:
            self._allowed.clear()
        self._allowed[key] = allowed
        return allowed

    def _is_own_name(self, name: str) -> bool:
        if name in self._hosts:
            return True
        # No name server can make an address point elsewhere.
        try:
            ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            return False
        return True

    def _is_open_to(self, peer: str) -> bool:
        if not self._networks:
            return False
        try:
            address = ipaddress.ip_address(peer)
        except ValueError:
            return False
        return any(address in network for network in self._networks)


class FailureLimit:
    """Counts wrong keys per address within the last minute. Right keys are never held up by it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._failures: OrderedDict[str, tuple[float, int]] = OrderedDict()

    def add(self, peer: str) -> None:
        """Note a wrong key from an address."""
        now = self._clock()
        since, count = self._failures.pop(peer, (now, 0))
        if now - since > _FAILURE_WINDOW:
            since, count = now, 0
        self._failures[peer] = (since, count + 1)
        if len(self._failures) > _FAILURES_KEPT:
            self._failures.popitem(last=False)

    def exceeded(self, peer: str) -> bool:
        """Whether an address has sent too many."""
        since, count = self._failures.get(peer, (0.0, 0))
        return count > _FAILURES and self._clock() - since <= _FAILURE_WINDOW


class _Headers(NamedTuple):
    """What counts of a request's headers."""

    host: bytes | None
    origin: bytes | None
    key: str | None
    content_type: bytes | None
    browser: bool


def _read_headers(scope: Scope) -> _Headers:
    host = origin = key = content_type = None
    browser = False
    for name, value in scope["headers"]:
        if name == b"host":
            # A second one is refused as no name at all (RFC 9112, section 3.2).
            host = value if host is None else b""
        elif name == b"content-type":
            content_type = value
        elif name == b"x-api-key":
            key = value.decode("latin-1")
        elif name == b"authorization" and value[:7].lower() == b"bearer ":
            key = value[7:].strip().decode("latin-1")
        elif name in _BROWSER_HEADERS:
            browser = True
            if name == b"origin":
                origin = value
    return _Headers(host, origin, key, content_type, browser)


def _is_simple(content_type: bytes | None, browser: bool) -> bool:
    """Whether a browser would send this without a preflight (Fetch standard, CORS-safelisted)."""
    if content_type is None:
        return browser
    return content_type.split(b";", 1)[0].strip().lower() in _SIMPLE_TYPES


def _hostname(host: bytes) -> str:
    """Return the name in ``name[:port]``, IPv6 addresses in their brackets; "" if it is malformed."""
    match = _HOST.fullmatch(host.lower())
    return match[1].decode("latin-1") if match else ""


def _origin_host(origin: str) -> str:
    scheme, _, netloc = origin.partition("://")
    return _hostname(netloc.encode("latin-1")) if scheme in {"http", "https"} else ""


def _same_origin(origin: str, host: bytes) -> bool:
    scheme, _, netloc = origin.partition("://")
    return scheme in {"http", "https"} and netloc == host.decode("latin-1").lower()


def _with_cors(send: Send, origin: bytes) -> Send:
    headers = [
        (b"access-control-allow-origin", origin),
        (b"access-control-allow-methods", CORS_METHODS),
        (
            b"access-control-allow-headers",
            b"Content-Type, X-Api-Key, Authorization, X-Access-Token, X-Requested-With",
        ),
        (b"access-control-max-age", b"600"),
        (b"vary", b"Origin"),
    ]

    async def send_with_cors(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message["headers"], *headers]
        await send(message)

    return send_with_cors
