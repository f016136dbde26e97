"""Moonraker's API for one machine, put together."""

import re

from starlette.routing import BaseRoute, Mount, WebSocketRoute

from toolpost.dialects.moonraker.connections import Connections
from toolpost.dialects.moonraker.database import DatabaseMethods
from toolpost.dialects.moonraker.files import FileMethods
from toolpost.dialects.moonraker.history import HistoryMethods
from toolpost.dialects.moonraker.http import MethodRoutes, not_found
from toolpost.dialects.moonraker.identify import CONNECTION_METHODS
from toolpost.dialects.moonraker.info import InfoMethods
from toolpost.dialects.moonraker.job_queue import JobQueueMethods
from toolpost.dialects.moonraker.objects import ObjectMethods
from toolpost.dialects.moonraker.printer import PrinterMethods
from toolpost.dialects.moonraker.rpc import Methods
from toolpost.dialects.moonraker.system import SystemMethods
from toolpost.dialects.moonraker.transfer import Transfer
from toolpost.dialects.moonraker.websocket import WebSocketEndpoint
from toolpost.events import Events
from toolpost.http.body import BodyReader
from toolpost.shop import Shop

_PATHS = re.compile(r"(?:/machines/[^/]+)?/(?:server|printer|machine|access)/.*")


def takes_forms(path: str) -> bool:
    """Whether arguments may come as a form at a path: Moonraker's clients send them so."""
    return _PATHS.fullmatch(path) is not None


class Moonraker:
    """The API of one machine: its methods, and the connections that are told of changes.

    Args:
        shop: does the work.
        machine: name of the machine.
        events: what happens.
    """

    def __init__(self, shop: Shop, machine: str, events: Events) -> None:
        self._connections = Connections()
        queue = JobQueueMethods(shop, machine, self._connections)
        info = InfoMethods(shop, machine, self._connections)
        files = FileMethods(shop, self._connections)
        system = SystemMethods(shop, machine, self._connections)
        objects = ObjectMethods(shop, machine, self._connections)
        printer = PrinterMethods(shop, machine, self._connections, objects.reset)
        history = HistoryMethods(shop, machine, self._connections)
        parts = (queue, info, files, DatabaseMethods(shop), system, objects, printer, history)
        self._methods = Methods([*CONNECTION_METHODS, *(m for part in parts for m in part.methods())])
        self._unsubscribe = [events.subscribe(part.event) for part in parts]
        self._transfer = Transfer(shop, machine, files)

    def routes(self, bodies: BodyReader) -> list[BaseRoute]:
        """Return the routes: each method over HTTP, all over WebSocket."""
        socket = WebSocketEndpoint(self._methods, self._connections)
        return [
            *self._transfer.routes(),
            MethodRoutes(self._methods, bodies),
            WebSocketRoute("/websocket", socket),
            *(Mount(f"/{root}", app=not_found) for root in ("server", "printer", "machine", "access")),
        ]

    def close(self) -> None:
        """Let go of all connections."""
        for unsubscribe in self._unsubscribe:
            unsubscribe()
        self._connections.close_all()
