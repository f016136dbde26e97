"""What the browser tests stand on: a static site, a Toolpost process and a watch over a page."""

import contextlib
import functools
import http.server
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from playwright.sync_api import ConsoleMessage, Page, Request, Response

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


def free_port() -> int:
    """A TCP port of 127.0.0.1 that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def port_taken(port: int) -> bool:
    """Whether a client that connects to ``localhost:port`` would reach somebody."""
    for address in ("127.0.0.1", "::1"):
        with contextlib.suppress(OSError), socket.create_connection((address, port), timeout=1):
            return True
    return False


class _Files(http.server.SimpleHTTPRequestHandler):
    def do_GET(self) -> None:
        if self.path == "/favicon.ico":
            self.send_response(204)
            self.end_headers()
        else:
            super().do_GET()

    def log_message(self, *args: object) -> None:
        pass


class StaticSite:
    """Serves a folder on a free port of 127.0.0.1 from a thread, until closed."""

    def __init__(self, folder: Path) -> None:
        handler = functools.partial(_Files, directory=os.fspath(folder))
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


class Toolpost:
    """``toolpost serve`` as a process, with its configuration and data in one folder.

    It can be stopped and started again on the same data.
    """

    def __init__(self, folder: Path, config: str) -> None:
        self._data = folder / "data"
        self._config = folder / "toolpost.toml"
        self._config.write_text(config)
        self._folder = folder
        self._process: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self.output: list[str] = []

    def start(self, listeners: int, timeout: float = 20.0) -> None:
        """Returns when that many listeners are ready; ``timeout`` is in seconds."""
        assert self._process is None, "already running"
        command = [sys.executable, "-m", "toolpost", "serve"]
        command += ["--config", os.fspath(self._config), "--data", os.fspath(self._data)]
        self._process = subprocess.Popen(
            command,
            cwd=self._folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
        )
        self._reader = threading.Thread(target=self._read, args=(self._process,), daemon=True)
        self._reader.start()
        deadline = time.monotonic() + timeout
        ready = 0
        while ready < listeners:
            try:
                line = self._lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                self._fail(f"only {ready} of {listeners} listeners were ready after {timeout} s")
            if line is None:
                self._fail("ended before it was ready")
            ready += line.startswith("toolpost: ready on http://")

    def stop(self, timeout: float = 15.0) -> int:
        """Sends SIGTERM and returns the exit status; ``timeout`` is in seconds."""
        process = self._process
        assert process is not None, "not running"
        process.send_signal(signal.SIGTERM)
        try:
            status = process.wait(timeout)
        except subprocess.TimeoutExpired:
            self._fail(f"did not end within {timeout} s of SIGTERM")
        self._reap()
        return status

    def sent(self) -> list[str]:
        """Every line that went to the machine so far, by the comm log of this data folder."""
        lines: list[str] = []
        for path in sorted((self._data / "logs").rglob("*.log")):
            for line in path.read_text("ascii").splitlines():
                _date, _clock, direction, payload = line.split(" ", 3)
                if direction == "down":
                    lines.append(payload)
        return lines

    def kill(self) -> None:
        """Ends the process, if there is one, whatever it does."""
        if self._process is not None:
            self._process.kill()
            self._reap()

    def _reap(self) -> None:
        assert self._process is not None
        assert self._reader is not None
        self._process.wait()
        self._reader.join(timeout=5)
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._process = self._reader = None
        self._lines = queue.SimpleQueue()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self.output.append(line.rstrip("\n"))
            self._lines.put(line)
        self._lines.put(None)

    def _fail(self, why: str) -> None:
        self.kill()
        raise AssertionError("\n".join([f"toolpost serve: {why}", *self.output[-40:]]))


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
