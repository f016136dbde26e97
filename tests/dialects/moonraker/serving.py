"""A uvicorn server with the dialect's endpoints on the fake queue, in the loop of the test, and clients."""

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator, Iterable
from typing import Any, NamedTuple

import uvicorn
from starlette.routing import Mount, Router, WebSocketRoute
from tests.dialects.moonraker.fake_queue import FakeQueue
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.asyncio.client import ClientConnection, connect

from toolpost.dialects.moonraker.connections import Connections
from toolpost.dialects.moonraker.http import MethodRoutes, not_found
from toolpost.dialects.moonraker.identify import CONNECTION_METHODS
from toolpost.dialects.moonraker.rpc import Method, Methods
from toolpost.dialects.moonraker.websocket import ABORT, WebSocketEndpoint
from toolpost.http.body import BodyReader
from toolpost.http.server import BoundedProtocol

MAX_BODY = 64 * 1024


class AbortableWebSocket(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket, which the application can cut: as http/server.py has it for the real listeners."""

    def handle_connect(self, event: Any) -> None:
        super().handle_connect(event)
        if self.response.status_code == 101:
            self.scope[ABORT] = self.transport.abort


class Answer(NamedTuple):
    status: int
    reason: str
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Site:
    """Where a server is to be reached.

    Args:
        port: on 127.0.0.1.
        prefix: before every path, e.g. ``/machines/edm``.
    """

    def __init__(self, port: int, prefix: str = "") -> None:
        self.port = port
        self.prefix = prefix

    async def http(
        self, verb: str, path: str, body: bytes = b"", headers: dict[str, str] | None = None
    ) -> Answer:
        """Sends a request exactly so, and returns the answer."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port, limit=2**24)
        lines = [f"{verb} {self.prefix}{path} HTTP/1.1", "Host: localhost", "Connection: close"]
        lines += [f"{name}: {value}" for name, value in (headers or {}).items()]
        if body:
            lines.append(f"Content-Length: {len(body)}")
        writer.write("\r\n".join([*lines, "", ""]).encode() + body)
        head, _, content = (await reader.read()).partition(b"\r\n\r\n")
        writer.close()
        status, *fields = head.decode("latin-1").split("\r\n")
        names = dict(field.split(": ", 1) for field in fields)
        return Answer(
            int(status.split(" ")[1]),
            status.split(" ", 2)[2],
            {name.lower(): value for name, value in names.items()},
            content,
        )

    async def rpc_http(self, body: bytes) -> Answer:
        return await self.http("POST", "/server/jsonrpc", body, {"Content-Type": "application/json"})

    @contextlib.asynccontextmanager
    async def client(self, **options: Any) -> AsyncIterator["Client"]:
        url = f"ws://127.0.0.1:{self.port}{self.prefix}/websocket"
        async with connect(url, compression=None, max_size=None, **options) as ws:
            yield Client(ws)


class Service(Site):
    """What is served, and where."""

    def __init__(
        self, methods: Iterable[Method] = (), *, limit: int = 256, max_message: int = 1 << 20
    ) -> None:
        super().__init__(0)
        self.connections = Connections(limit)
        self.queue = FakeQueue(self.connections)
        self.methods = Methods([*self.queue.methods, *CONNECTION_METHODS, *methods])
        endpoint = WebSocketEndpoint(self.methods, self.connections, max_message)
        bodies = BodyReader(MAX_BODY, 2 * MAX_BODY)
        routes = [MethodRoutes(self.methods, bodies), WebSocketRoute("/websocket", endpoint)]
        self.app = Router(
            [*routes, Mount("/machines/edm", routes=routes)], redirect_slashes=False, default=not_found
        )


class Client:
    """A WebSocket client that knows JSON-RPC."""

    def __init__(self, ws: ClientConnection) -> None:
        self.ws = ws
        self.notifications: list[Any] = []
        self._last = 0

    async def send(self, text: str | bytes) -> None:
        await self.ws.send(text)

    async def message(self) -> Any:
        return json.loads(await asyncio.wait_for(self.ws.recv(), 5))

    async def call(self, method: str, /, **params: Any) -> Any:
        """Returns what a call is answered; what comes before is kept as a notification."""
        self._last += 1
        request = {"jsonrpc": "2.0", "method": method, "params": params, "id": self._last}
        await self.ws.send(json.dumps(request))
        while (message := await self.message()).get("id") != self._last:
            self.notifications.append(message)
        return message.get("result", message.get("error"))


@contextlib.asynccontextmanager
async def serving(*methods: Method, **options: Any) -> AsyncIterator[Service]:
    """A running server."""
    service = Service(methods, **options)
    sock = socket.create_server(("127.0.0.1", 0))
    service.port = sock.getsockname()[1]
    server = uvicorn.Server(
        uvicorn.Config(
            service.app,
            http=BoundedProtocol,
            ws=AbortableWebSocket,
            ws_max_size=2 << 20,
            ws_per_message_deflate=False,
            lifespan="off",
            limit_concurrency=512,
            log_config=None,
            access_log=False,
            timeout_graceful_shutdown=1,
        )
    )
    server.capture_signals = contextlib.nullcontext
    task = asyncio.create_task(server.serve([sock]))
    while not server.started:
        await asyncio.sleep(0.001)
    try:
        yield service
    finally:
        server.should_exit = True
        await task
