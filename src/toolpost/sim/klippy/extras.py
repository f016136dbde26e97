"""Small things: the display's text, the fan, echoes, endstops, and what is taken and has no effect."""

import asyncio
from collections.abc import Callable

from toolpost.sim.klippy.errors import CommandError
from toolpost.sim.klippy.gcode import GCode
from toolpost.sim.klippy.parsing import Command

TOLERATED = (
    "G17",
    "G18",
    "G19",
    "G21",
    "M110",
    "M204",
    "SET_GCODE_OFFSET",
    "SET_GCODE_VARIABLE",
    "SET_PRESSURE_ADVANCE",
    "SET_STEPPER_ENABLE",
    "SET_VELOCITY_LIMIT",
    "BED_MESH_CALIBRATE",
    "BED_MESH_CLEAR",
)
"""Commands that a file may have in it and that change nothing here."""

PREFIXES = {"echo": "echo:", "command": "//", "error": "!!"}
"""What ``RESPOND TYPE=`` puts before its text."""

_ENDSTOP_TIME = 0.25  # a query of the endstops waits for the motion ahead (measured)


class Display:
    """The object ``display_status``.

    Args:
        gcode: where the commands are registered.
        file_progress: how much of the file is done, 0 to 1.
    """

    def __init__(self, gcode: GCode, file_progress: Callable[[], float]) -> None:
        self._file_progress = file_progress
        self._progress: float | None = None
        self._message: str | None = None
        gcode.register("M117", self._show)
        gcode.register("SET_DISPLAY_TEXT", self._show_text, "MSG: shows a text")
        gcode.register("M73", self._set_progress)

    def _show(self, command: Command) -> None:
        self._message = command.text or None

    def _show_text(self, command: Command) -> None:
        self._message = command.params.get("MSG")

    def _set_progress(self, command: Command) -> None:
        if "P" in command.params:
            self._progress = min(1.0, max(0.0, command.number("P") / 100))

    def reset(self) -> None:
        """Forget the progress that a file gave with ``M73``."""
        self._progress = None

    def status(self) -> dict[str, object]:
        """Return the object's fields."""
        progress = self._file_progress() if self._progress is None else self._progress
        return {"progress": progress, "message": self._message}


class Fan:
    """The object ``fan``."""

    def __init__(self, gcode: GCode) -> None:
        self._speed = 0.0
        gcode.register("M106", self._set)
        gcode.register("M107", self._off)

    def _set(self, command: Command) -> None:
        self._speed = min(1.0, command.number("S", 255.0, least=0.0) / 255)

    def _off(self, _command: Command) -> None:
        self._speed = 0.0

    def status(self) -> dict[str, object]:
        """Return the object's fields; speed from 0 to 1."""
        return {"speed": self._speed, "rpm": None}


async def query_endstops() -> dict[str, str]:
    """Return the state of each endstop, after a time."""
    await asyncio.sleep(_ENDSTOP_TIME)
    return {f"stepper_{axis}": "open" for axis in "xyz"}


def register_extras(gcode: GCode) -> None:
    """Add the commands that only put something out, or do nothing at all."""

    def echo(command: Command) -> None:
        gcode.respond(f"echo: {command.text}")

    def respond(command: Command) -> None:
        kind = command.params.get("TYPE", "echo").lower()
        if kind not in PREFIXES:
            raise CommandError(f"RESPOND TYPE '{kind}' is invalid; valid: {', '.join(PREFIXES)}")
        prefix = command.params.get("PREFIX", PREFIXES[kind])
        gcode.respond(f"{prefix} {command.params.get('MSG', '')}")

    async def endstops(_command: Command) -> None:
        found = await query_endstops()
        gcode.respond(" ".join(f"{name}:{state}" for name, state in found.items()))

    def nothing(_command: Command) -> None:
        return None

    gcode.register("M118", echo)
    gcode.register("RESPOND", respond, "MSG, TYPE, PREFIX: puts a line out")
    gcode.register("M119", endstops)
    gcode.register("QUERY_ENDSTOPS", endstops, "Says which endstops are pressed")
    gcode.register("M115", lambda _command: gcode.inform("FIRMWARE_NAME:Klipper"), always=True)
    for name in TOLERATED:
        gcode.register(name, nothing)
