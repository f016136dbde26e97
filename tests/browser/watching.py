"""What the browser tests stand on: a static site, and watches over what a page does."""

import contextlib
import functools
import http.server
import json
import os
import socket
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from playwright.sync_api import ConsoleMessage, Page, Request, Response, WebSocket

CHROMIUM_FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


def port_taken(port: int) -> bool:
    """Whether a client that connects to ``localhost:port`` would reach somebody."""
    for address in ("127.0.0.1", "::1"):
        with contextlib.suppress(OSError), socket.create_connection((address, port), timeout=1):
            return True
    return False


class _Files(http.server.SimpleHTTPRequestHandler):
    def __init__(self, *args: Any, instead: Mapping[str, bytes], **kwargs: Any) -> None:
        self._instead = instead
        super().__init__(*args, **kwargs)

    def do_GET(self) -> None:
        if self.path in self._instead:
            body = self._instead[self.path]
            self.send_response(200)
            self.send_header("Content-Type", self.guess_type(self.path))
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
        elif self.path == "/favicon.ico":
            self.send_response(204)
            self.end_headers()
        else:
            super().do_GET()

    def log_message(self, *args: object) -> None:
        pass


class StaticSite:
    """Serves a folder on a free port of 127.0.0.1 from a thread, until closed.

    Args:
        folder: what it serves.
        instead: bodies that are served in the place of files, by their paths.
    """

    def __init__(self, folder: Path, instead: Mapping[str, bytes] | None = None) -> None:
        handler = functools.partial(_Files, directory=os.fspath(folder), instead=instead or {})
        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self.origin = f"http://127.0.0.1:{self._server.server_port}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class Watch:
    """Notes everything that goes wrong in a page, and the answers it receives."""

    def __init__(self, page: Page) -> None:
        self.problems: list[str] = []
        self._page = page
        self._responses: list[Response] = []
        page.on("pageerror", lambda error: self.problems.append(f"page error: {error}"))
        page.on("console", self._console)
        page.on("requestfailed", self._request_failed)
        page.on("response", self._response)

    def _console(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self.problems.append(f"console: {message.text}")

    def _request_failed(self, request: Request) -> None:
        self.problems.append(f"request failed: {request.method} {request.url} {request.failure}")

    def _response(self, response: Response) -> None:
        self._responses.append(response)
        if response.status >= 400:
            request = response.request
            self.problems.append(
                f"status {response.status}: {request.method} {request.url} {request.post_data}"
            )

    def settle(self, milliseconds: float = 300) -> None:
        """Lets events that are under way arrive."""
        self._page.wait_for_timeout(milliseconds)

    def take_problems(self) -> list[str]:
        """The problems since the last call."""
        self.settle()
        taken, self.problems[:] = list(self.problems), []
        return taken

    @contextlib.contextmanager
    def provoked(self) -> Iterator[list[str]]:
        """Problems inside the block are meant to happen: they go to the list it yields."""
        self.settle()
        before = len(self.problems)
        found: list[str] = []
        yield found
        self.settle()
        found += self.problems[before:]
        del self.problems[before:]

    @contextlib.contextmanager
    def answers(self, path: str) -> Iterator[list[tuple[Any, Any]]]:
        """Collects (request, answer) of each POST to ``path`` that was answered in the block.

        The list is filled when the block ends.
        """
        self.settle(0)
        before = len(self._responses)
        found: list[tuple[Any, Any]] = []
        yield found
        self.settle()
        for response in self._responses[before:]:
            if response.request.method == "POST" and response.url.endswith(path):
                answer = response.json() if response.ok else response.text()
                found.append((response.request.post_data_json, answer))


class Call(NamedTuple):
    """A JSON-RPC call of a page, and its answer."""

    method: str
    params: Any
    result: Any
    error: Any


class RpcWatch:
    """Notes the JSON-RPC 2.0 that a page speaks over its WebSockets."""

    def __init__(self, page: Page) -> None:
        self.calls: list[Call] = []
        """Those that were answered, in the order of their answers."""
        self.notifications: list[tuple[str, Any]] = []
        """Method and params of each."""
        self.closed = 0
        """WebSockets that have been closed, by whichever side."""
        self._asked: dict[tuple[WebSocket, Any], tuple[str, Any]] = {}
        page.on("websocket", self._opened)

    def unanswered(self) -> list[tuple[str, Any]]:
        """Method and params of each call that waits for its answer."""
        return list(self._asked.values())

    def of(self, method: str) -> list[Call]:
        """The answered calls of a method."""
        return [call for call in self.calls if call.method == method]

    def _opened(self, socket: WebSocket) -> None:
        socket.on("framesent", lambda payload: self._sent(socket, payload))
        socket.on("framereceived", lambda payload: self._received(socket, payload))
        socket.on("close", self._close)

    def _close(self, socket: WebSocket) -> None:
        self.closed += 1
        for key in [key for key in self._asked if key[0] is socket]:
            del self._asked[key]

    def _sent(self, socket: WebSocket, payload: str | bytes) -> None:
        for message in _messages(payload):
            self._asked[socket, message["id"]] = message["method"], message.get("params")

    def _received(self, socket: WebSocket, payload: str | bytes) -> None:
        for message in _messages(payload):
            if "method" in message:
                self.notifications.append((message["method"], message.get("params")))
            else:
                method, params = self._asked.pop((socket, message["id"]), ("", None))
                self.calls.append(Call(method, params, message.get("result"), message.get("error")))


def _messages(payload: str | bytes) -> list[dict[str, Any]]:
    """One message or a batch."""
    data = json.loads(payload)
    return data if isinstance(data, list) else [data]
