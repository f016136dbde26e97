"""The methods of the socket, and what each does."""

import os
import socket
import sys
from collections.abc import Awaitable, Callable
from typing import TypeVar, cast

import msgspec

from toolpost.sim.klippy.connection import Connection
from toolpost.sim.klippy.errors import CommandError
from toolpost.sim.klippy.extras import query_endstops
from toolpost.sim.klippy.printer import Printer
from toolpost.sim.klippy.status import StatusTicker, Wanted

Params = dict[str, object]
Handler = Callable[[Connection, Params], Awaitable[object]]

T = TypeVar("T")


class Request(msgspec.Struct):
    """A request.

    Attributes:
        id: comes back in the answer; without it there is none.
        method: the endpoint.
        params: its arguments by name.
    """

    method: str
    id: object = None
    params: Params = {}


def argument(params: Params, name: str, kind: type[T], default: T | None = None) -> T:
    """Return an argument of a request.

    Raises:
        CommandError: it is missing and there is no ``default``, or it is no ``kind``.
    """
    if name not in params:
        if default is None:
            raise CommandError(f"Missing Argument [{name}]")
        return default
    value = params[name]
    if type(value) is not kind:
        raise CommandError(f"Invalid Argument Type [{name}]")
    return value


class Endpoints:
    """All methods of one life of the host.

    Args:
        printer: the machine.
        ticker: its status.
        scripts: gets every script that came through the socket, for tests.
    """

    def __init__(self, printer: Printer, ticker: StatusTicker, scripts: list[str]) -> None:
        self._printer = printer
        self._ticker = ticker
        self._scripts = scripts
        self._outputs: dict[Connection, Params] = {}
        self._remote: dict[str, dict[Connection, Params]] = {}
        self._table: dict[str, Handler] = {
            "list_endpoints": self._list,
            "info": self._info,
            "emergency_stop": self._stop,
            "register_remote_method": self._register,
            "gcode/help": self._help,
            "gcode/script": self._script,
            "gcode/restart": self._fixed("RESTART"),
            "gcode/firmware_restart": self._fixed("FIRMWARE_RESTART"),
            "gcode/subscribe_output": self._subscribe_output,
            "objects/list": self._objects,
            "objects/query": self._query,
            "objects/subscribe": self._subscribe,
            "pause_resume/cancel": self._fixed("CANCEL_PRINT"),
            "pause_resume/pause": self._fixed("PAUSE"),
            "pause_resume/resume": self._fixed("RESUME"),
            "query_endstops/status": self._endstops,
        }
        printer.gcode.outputs.append(self._output)

    async def answer(self, connection: Connection, request: Request) -> None:
        """Do what is asked, then send the answer if one is wanted."""
        reply: dict[str, object] = {"id": request.id}
        try:
            reply["result"] = await self._find(request.method)(connection, request.params)
        except CommandError as error:
            reply["error"] = {"error": "WebRequestError", "message": str(error)}
        if request.id is not None:
            connection.send(reply)

    def _find(self, method: str) -> Handler:
        handler = self._table.get(method)
        if handler is None:
            raise CommandError(f"webhooks: No registered callback for path '{method}'")
        return handler

    def forget(self, connection: Connection) -> None:
        """Send a client that is gone nothing more."""
        self._outputs.pop(connection, None)
        self._ticker.unsubscribe(connection)
        for registered in self._remote.values():
            registered.pop(connection, None)

    def call_remote(self, name: str, params: Params) -> int:
        """Send a call of a remote method to all who registered it; return how many did."""
        registered = self._remote.get(name, {})
        for connection, template in registered.items():
            connection.send({"params": params, **template})
        return len(registered)

    def _output(self, line: str) -> None:
        for connection, template in self._outputs.items():
            connection.send({**template, "params": {"response": line}})

    # -- methods

    def _fixed(self, script: str) -> Handler:
        """Return a method that runs one command."""

        async def run(_connection: Connection, _params: Params) -> object:
            await self._printer.gcode.run_script(script)
            return {}

        return run

    async def _list(self, _connection: Connection, _params: Params) -> object:
        return {"endpoints": list(self._table)}

    async def _info(self, _connection: Connection, params: Params) -> object:
        argument(params, "client_info", dict, {})
        return {
            "state": self._printer.state,
            "state_message": self._printer.message,
            "hostname": socket.gethostname(),
            "klipper_path": "/simulated/klipper",
            "python_path": sys.executable,
            "process_id": os.getpid(),
            "user_id": os.getuid(),
            "group_id": os.getgid(),
            "log_file": None,
            "config_file": "/simulated/printer.cfg",
            "software_version": "simulated",
            "cpu_info": f"{os.cpu_count()} core",
        }

    async def _stop(self, _connection: Connection, _params: Params) -> object:
        self._printer.shutdown("Shutdown due to webhooks request")
        return {}

    async def _register(self, connection: Connection, params: Params) -> object:
        template = argument(params, "response_template", dict)
        name = argument(params, "remote_method", str)
        self._remote.setdefault(name, {})[connection] = template
        return {}

    async def _help(self, _connection: Connection, _params: Params) -> object:
        return self._printer.gcode.helps()

    async def _script(self, _connection: Connection, params: Params) -> object:
        script = argument(params, "script", str)
        self._scripts.append(script)
        await self._printer.gcode.run_script(script)
        return {}

    async def _subscribe_output(self, connection: Connection, params: Params) -> object:
        self._outputs[connection] = argument(params, "response_template", dict, {})
        return {}

    async def _objects(self, _connection: Connection, _params: Params) -> object:
        return {"objects": self._printer.object_names()}

    async def _query(self, _connection: Connection, params: Params) -> object:
        return await self._ticker.query(_wanted(params))

    async def _subscribe(self, connection: Connection, params: Params) -> object:
        wanted = _wanted(params)
        template = argument(params, "response_template", dict, {})
        self._ticker.unsubscribe(connection)
        answer = await self._ticker.query(wanted)
        if connection.open:
            self._ticker.subscribe(
                connection, wanted, lambda status: connection.send({**template, "params": status})
            )
        return answer

    async def _endstops(self, _connection: Connection, _params: Params) -> object:
        async with self._printer.gcode.mutex:
            return await query_endstops()


def _wanted(params: Params) -> Wanted:
    """Return the objects that a query names.

    Raises:
        CommandError: they are not as they must be.
    """
    objects = argument(params, "objects", dict)
    for fields in objects.values():
        if fields is None:
            continue
        if type(fields) is not list or not all(type(field) is str for field in fields):
            raise CommandError("Invalid argument")
    return cast("Wanted", objects)
