"""The methods that make the machine do something (external_api/printer.md)."""

import re
from collections.abc import Callable
from typing import Final

import msgspec

from toolpost.core.report import Report
from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.rpc import Method, NoParams, Order
from toolpost.errors import FileMissingError, InvalidRequestError, NotAcceptedError
from toolpost.events import Event, Reported
from toolpost.shop import Shop

NOTIFICATION: Final = "notify_gcode_response"

MAX_LINES: Final = 1000
"""Lines of a script; what is longer is a job."""

_OK: Final = "ok"
_ERROR: Final = "error"
_STOPS: Final = frozenset({"CANCEL_PRINT", "M112"})
_RESET: Final = "SDCARD_RESET_FILE"
_MACRO: Final = re.compile(r"[A-Z]{2,}_[A-Z0-9_]*|_[A-Z0-9_]+")


class StartParams(msgspec.Struct, frozen=True):
    """A file in the root ``gcodes``."""

    filename: str


class ScriptParams(msgspec.Struct, frozen=True):
    """Lines for the machine."""

    script: str


class PrinterMethods:
    """What a person does with one machine.

    Pause and resume are not here, because there is no machine that can.

    Args:
        shop: does the work.
        machine: name of the machine.
        connections: are told of the machine's errors.
        reset: forgets the outcome of the last job.
    """

    def __init__(self, shop: Shop, machine: str, connections: Connections, reset: Callable[[], None]) -> None:
        self._shop = shop
        self._machine = machine
        self._connections = connections
        self._reset = reset

    def methods(self) -> list[Method]:
        """Return the methods; whatever may hold a stop waits for nothing."""
        path, now = "/printer", Order.URGENT
        stop = f"{path}/emergency_stop"
        return [
            Method("printer.print.start", ("POST", f"{path}/print/start"), StartParams, self.start),
            Method("printer.print.cancel", ("POST", f"{path}/print/cancel"), NoParams, self.stop, now),
            Method("printer.emergency_stop", ("POST", stop), NoParams, self.stop, now),
            Method("printer.gcode.script", ("POST", f"{path}/gcode/script"), ScriptParams, self.script, now),
            Method("printer.gcode.help", ("GET", f"{path}/gcode/help"), NoParams, self.help),
        ]

    async def start(self, params: StartParams, connection: Connection) -> object:
        """``printer.print.start``: run a file now, whatever waits in the queue."""
        try:
            await self._shop.print_file(self._machine, params.filename, actor=connection.actor)
        except FileMissingError as error:
            raise RpcError(400, f"G-Code File {error.name} does not exist") from None
        except NotAcceptedError as error:
            raise RpcError(400, str(error)) from None
        return _OK

    async def stop(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``printer.emergency_stop`` and ``printer.print.cancel``: the machine is told before anything."""
        await self._shop.cancel(self._machine, connection.actor)
        return _OK

    async def script(self, params: ScriptParams, connection: Connection) -> object:
        """``printer.gcode.script``: send lines; a stop among them is all that is done."""
        lines = params.script.splitlines()
        if len(lines) > MAX_LINES:
            raise RpcError(400, f"a script has at most {MAX_LINES} lines; run a longer one as a job")
        problem = ""
        for line in lines:
            try:
                stops = _word(line) in _STOPS or self._shop.is_stop(self._machine, line)
            except InvalidRequestError as error:
                problem = problem or f"{line[:50]!r}: {error}"
            else:
                if stops:
                    await self._shop.cancel(self._machine, connection.actor)
                    return _OK
        # Half of a script is another script: one that needs a macro is not sent at all.
        macro = next((word for word in map(_word, lines) if _MACRO.fullmatch(word) and word != _RESET), None)
        if macro is not None:
            problem = problem or f"this machine has no command {macro[:50]}; nothing was sent"
        if problem:
            raise RpcError(400, problem)
        for line in lines:
            if _word(line) == _RESET:
                self._reset()
            elif not await self._shop.write_line(self._machine, line, urgent=None, actor=connection.actor):
                raise RpcError(400, f"{line[:50]!r} was not sent: {self._refusal()}")
        return _OK

    async def help(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``printer.gcode.help``: there are no macros, and no firmware tells what its commands do."""
        return {}

    def event(self, event: Event) -> None:
        """Tell all connections what the machine complains of."""
        if isinstance(event, Reported) and event.machine == self._machine and event.report.tag == _ERROR:
            self._connections.notify(NOTIFICATION, f"!! {_complaint(event.report)}")

    def _refusal(self) -> str:
        if not self._shop.status(self._machine).alive:
            return "the machine does not answer"
        return "a job has not ended, or too many commands wait"


def _word(line: str) -> str:
    """Return the first word of a line."""
    words = line.partition(";")[0].split(maxsplit=1)
    return words[0].upper() if words else ""


def _complaint(report: Report) -> str:
    message = report.values.get("msg", "")
    source = report.values.get("src")
    return f"{message}: {source}" if source else f"{message}"
