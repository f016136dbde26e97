"""What tests from outside stand on: a server as a process, a client, and a simulated core on a pty.

with Port(SparkOptions(command_time=0)) as port, Server(tmp_path, spark_config(port.path)) as server:
    assert server.client.call("/add-job", commands=["G0 X1"])["ok"]
    wait_until(lambda: port.core.executed == 1)
"""

import asyncio
import contextlib
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar
from urllib.parse import urlsplit

from toolpost.sim.faults import Fault
from toolpost.sim.options import SparkOptions
from toolpost.sim.ports import PtyPort
from toolpost.sim.spark import SparkCore

T = TypeVar("T")
Body = bytes | str | dict[str, Any] | list[Any] | None

JSON = {"Content-Type": "application/json"}
_READY = "toolpost: ready on "


def spark_config(link: str = "sim", *, listen: str = "127.0.0.1:0", more: str = "") -> str:
    """A configuration with one Spark machine, ``edm``; `more` is added at the end."""
    return (
        f'[server]\nlisten = "{listen}"\n[machines.edm]\ndriver = "spark"\nlink = "{link}"\n'
        f"[machines.edm.spark]\nhold_off = 0.125\n{more}\n"
    )


def wait_until(true: Callable[[], T], timeout: float = 10.0) -> T:
    """Returns the first true result of `true`; fails after `timeout` seconds."""
    deadline = time.monotonic() + timeout
    while not (result := true()):
        assert time.monotonic() < deadline, f"not so within {timeout} s"
        time.sleep(0.005)
    return result


def free_port(host: str = "127.0.0.1") -> int:
    """A TCP port that nobody listens on; where ``:0`` can be written, that is better."""
    with socket.create_server((host, 0)) as probe:
        return int(probe.getsockname()[1])


def toolpost(*arguments: str | Path, timeout: float = 20.0) -> subprocess.CompletedProcess[str]:
    """Runs ``toolpost`` with `arguments` to its end."""
    command = [sys.executable, "-m", "toolpost", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)


class Answer(NamedTuple):
    """What a server said."""

    status: int
    headers: dict[str, str]  # names in lower case
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode()

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Client:
    """A keep-alive HTTP client.

    Args:
        url: of the server, and before the path of each request.
        headers: sent with every request.
    """

    def __init__(self, url: str, headers: dict[str, str] | None = None, timeout: float = 20.0) -> None:
        parts = urlsplit(url)
        assert parts.hostname is not None
        self.host, self.port = parts.hostname, parts.port or 80
        self._prefix = parts.path.rstrip("/")
        self._headers = headers or {}
        self._connection = http.client.HTTPConnection(self.host, self.port, timeout=timeout)

    def request(
        self, method: str, path: str, body: Body = None, headers: dict[str, str] | None = None
    ) -> Answer:
        """Sends exactly these headers, and those that HTTP itself needs."""
        data = body.encode("utf-8", "surrogateescape") if isinstance(body, str) else body
        if isinstance(data, dict | list):
            data = json.dumps(data).encode()
        self._connection.request(method, self._prefix + path, data, {**self._headers, **(headers or {})})
        response = self._connection.getresponse()
        names = {name.lower(): value for name, value in response.getheaders()}
        return Answer(response.status, names, response.read())

    def post(self, path: str, body: Body = None, headers: dict[str, str] | None = None) -> Answer:
        """A POST of JSON; `body` is sent as it is unless it is a dict or a list."""
        return self.request("POST", path, {} if body is None else body, {**JSON, **(headers or {})})

    def call(self, path: str, **request: Any) -> Any:
        """What a POST of `request` is answered; it must be 200."""
        answer = self.post(path, request)
        assert answer.status == 200, (path, answer)
        return answer.json

    def close(self) -> None:
        self._connection.close()


class Server:
    """``toolpost serve`` as a process; it can be started again on the same data.

    Args:
        folder: for its configuration, data and output.
        config: its configuration (TOML).
        arguments: more arguments of ``serve``.
        listeners: how many there are to wait for.
    """

    def __init__(self, folder: Path, config: str, *arguments: str, listeners: int = 1) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.data = folder / "data"
        self.urls: list[str] = []
        self._config = folder / "toolpost.toml"
        self._config.write_text(config)
        self._output, self._log = folder / "stdout", folder / "stderr"
        self._arguments = arguments
        self._listeners = listeners
        self._process: subprocess.Popen[bytes] | None = None
        self._clients: dict[int, Client] = {}

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    @property
    def pid(self) -> int:
        assert self._process is not None, "not running"
        return self._process.pid

    @property
    def log(self) -> str:
        """What it has written to standard error since its last start."""
        return self._log.read_text()

    @property
    def output(self) -> str:
        """What it has written to standard output since its last start."""
        return self._output.read_text()

    @property
    def client(self) -> Client:
        """A client of the first listener."""
        return self.client_of(0)

    def client_of(self, listener: int) -> Client:
        """A client of a listener; the same one each time, so for one thread."""
        if listener not in self._clients:
            self._clients[listener] = Client(self.urls[listener])
        return self._clients[listener]

    def start(self, timeout: float = 20.0) -> None:
        """Returns when every listener is ready."""
        assert self._process is None, "already running"
        command = [sys.executable, "-m", "toolpost", "serve", *self._arguments]
        command += ["--config", os.fspath(self._config), "--data", os.fspath(self.data)]
        with self._output.open("wb") as output, self._log.open("wb") as log:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=log)
        try:
            wait_until(self._is_ready, timeout)
        except BaseException:
            self.kill()
            raise

    def _is_ready(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None, f"ended before it was ready: {self.log}"
        lines = self.output.splitlines()
        self.urls = [line.removeprefix(_READY) for line in lines if line.startswith(_READY)]
        return len(self.urls) >= self._listeners

    def stop(self, number: int = signal.SIGTERM, timeout: float = 15.0) -> int:
        """Sends a signal and returns the exit status."""
        assert self._process is not None, "not running"
        self._process.send_signal(number)
        try:
            return self._process.wait(timeout)
        finally:
            self.kill()

    def kill(self) -> None:
        """Ends it by SIGKILL, if it runs."""
        for client in self._clients.values():
            client.close()
        self._clients.clear()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def comm_log(self) -> list[tuple[str, str]]:
        """The lines of all comm logs so far, as direction (or ``note``) and payload."""
        lines = []
        for path in sorted((self.data / "logs").glob("*.log")):
            for line in path.read_bytes().decode("ascii").splitlines():
                _, _, direction, payload = line.split(" ", 3)
                lines.append((direction, payload))
        return lines


class Port:
    """A simulated Spark core on a pty, in a thread of its own; a context manager.

    Args:
        options: what the core is like.
        link: a path for a symlink to the pty, which survives an ``unplug``.
        faults: as ``toolpost sim spark --fault`` takes them.
        traced: fill `trace` with (event, line) for each line; the core is slower then.
    """

    def __init__(
        self,
        options: SparkOptions | None = None,
        *,
        link: Path | None = None,
        faults: Iterable[str] = (),
        traced: bool = False,
    ) -> None:
        self.trace: list[tuple[str, bytes]] = []
        self._loop = asyncio.new_event_loop()
        self._port = PtyPort(
            self._loop,
            options,
            link=link,
            faults=map(Fault.parse, faults),
            trace=(lambda event, line: self.trace.append((event, line))) if traced else None,
        )
        self._thread = threading.Thread(target=self._loop.run_forever, name="simulated core")

    def __enter__(self) -> Self:
        self._thread.start()
        self.run(self._port.start)
        return self

    def __exit__(self, *_: object) -> None:
        self.run(self._port.close)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    @property
    def core(self) -> SparkCore:
        """The core; looking at its counters from another thread is harmless."""
        return self._port.core

    @property
    def path(self) -> str:
        """What to write for ``link`` in a configuration."""
        return self._port.path

    def run(self, call: Callable[[], T]) -> T:
        """Calls in the core's thread and returns the result."""

        async def in_loop() -> T:
            return call()

        return asyncio.run_coroutine_threadsafe(in_loop(), self._loop).result(10)

    def inject(self, fault: str) -> None:
        """Has the core have a fault, e.g. ``reboot`` or ``mute:2``."""
        self.run(lambda: self.core.inject(Fault.parse(fault)))

    def say(self, data: bytes) -> None:
        """Sends bytes up as if the core had said them."""
        self.run(lambda: self._port._send(data))


@contextlib.contextmanager
def raw_connection(server: Server, listener: int = 0, timeout: float = 10.0):
    """A socket to a server, for requests that no client sends."""
    parts = urlsplit(server.urls[listener])
    with socket.create_connection((parts.hostname, parts.port), timeout) as connection:
        yield connection
