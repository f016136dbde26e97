"""What the server and the machine are, and whether the machine is there (external_api/server.md, printer.md).

Moonraker's clients know one kind of machine, Klipper, by the state of its host. What they ask for is answered
with what Toolpost knows of the machine, whichever its firmware; nothing is made up.
"""

import os
import platform
import socket
import sys
from pathlib import Path

import msgspec

from toolpost.core.machine import LinkState
from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.rpc import Method, NoParams
from toolpost.events import Event, MachineChanged
from toolpost.shop import Shop
from toolpost.version import VERSION

API_VERSION = (1, 5, 0)
COMPONENTS = ("history", "job_queue", "klippy_connection")

STATES = {
    LinkState.ONLINE: ("ready", "Printer is ready"),
    LinkState.CONNECTING: ("startup", "The machine has not answered yet"),
    LinkState.FAULT: ("shutdown", "The machine reports a fault; it needs a power cycle"),
    LinkState.OFFLINE: ("disconnected", "The machine does not answer"),
}
_NOTIFICATIONS = {
    "ready": "notify_klippy_ready",
    "shutdown": "notify_klippy_shutdown",
    "disconnected": "notify_klippy_disconnected",
}


class ServerInfo(msgspec.Struct, frozen=True):
    """The answer of ``server.info``."""

    klippy_connected: bool
    klippy_state: str
    components: tuple[str, ...]
    failed_components: tuple[str, ...]
    registered_directories: tuple[str, ...]
    warnings: tuple[str, ...]
    websocket_count: int
    moonraker_version: str
    missing_klippy_requirements: tuple[str, ...]
    api_version: tuple[int, int, int]
    api_version_string: str


class PrinterInfo(msgspec.Struct, frozen=True):
    """The answer of ``printer.info``."""

    state: str
    state_message: str
    hostname: str
    software_version: str
    cpu_info: str
    python_path: str
    process_id: int
    app: str


class InfoMethods:
    """What is asked first of all.

    Args:
        shop: knows the machine.
        machine: its name.
        connections: are told when the machine comes and goes.
    """

    def __init__(self, shop: Shop, machine: str, connections: Connections) -> None:
        self._shop = shop
        self._machine = machine
        self._connections = connections
        self._told = ""

    def methods(self) -> list[Method]:
        """Return the methods."""
        return [
            Method("server.info", ("GET", "/server/info"), NoParams, self.server_info),
            Method("printer.info", ("GET", "/printer/info"), NoParams, self.printer_info),
        ]

    async def server_info(self, params: NoParams, connection: Connection) -> ServerInfo:  # noqa: ARG002
        """``server.info``."""
        state, _ = self._state()
        return ServerInfo(
            klippy_connected=state != "disconnected",
            klippy_state=state,
            components=COMPONENTS,
            failed_components=(),
            registered_directories=("gcodes",),
            warnings=(),
            websocket_count=len(self._connections),
            moonraker_version=f"toolpost-{VERSION}",
            missing_klippy_requirements=(),
            api_version=API_VERSION,
            api_version_string=".".join(map(str, API_VERSION)),
        )

    async def printer_info(self, params: NoParams, connection: Connection) -> PrinterInfo:  # noqa: ARG002
        """``printer.info``."""
        state, message = self._state()
        return PrinterInfo(
            state="error" if state == "disconnected" else state,
            state_message=message,
            hostname=socket.gethostname(),
            software_version=f"toolpost-{VERSION}",
            cpu_info=f"{os.cpu_count()} core {platform.machine()}",
            python_path=str(Path(sys.executable)),
            process_id=os.getpid(),
            app="Toolpost",
        )

    def event(self, event: Event) -> None:
        """Tell all connections that the machine has come or gone."""
        if isinstance(event, MachineChanged) and event.machine == self._machine:
            state, _ = STATES[event.state.link]
            if state != self._told:
                self._told = state
                if state in _NOTIFICATIONS:
                    self._connections.notify(_NOTIFICATIONS[state])

    def _state(self) -> tuple[str, str]:
        return STATES[self._shop.link(self._machine)]
