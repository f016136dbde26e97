"""The object ``pause_resume``, and PAUSE, RESUME and CANCEL_PRINT as macros like those of most printers."""

from collections.abc import Callable

from toolpost.sim.klippy.gcode import GCode
from toolpost.sim.klippy.parsing import Command
from toolpost.sim.klippy.sdcard import VirtualSdCard

MACRO = "G-Code macro"
"""What ``gcode/help`` says of a macro."""


class PauseResume:
    """Pauses, resumes and cancels.

    None of the three is an error when it does not apply: it puts a line out instead (measured).

    Args:
        gcode: where the commands are registered.
        sdcard: prints the file.
        turn_off: turns the heaters off; the cancel macro does so.
    """

    def __init__(self, gcode: GCode, sdcard: VirtualSdCard, turn_off: Callable[[], None]) -> None:
        self._gcode = gcode
        self._sdcard = sdcard
        self._turn_off = turn_off
        self._paused = False
        self._file_paused = False
        for name, handler in (
            ("PAUSE", self._pause),
            ("RESUME", self._resume),
            ("CANCEL_PRINT", self._cancel),
        ):
            gcode.register(name, handler, MACRO)
            gcode.register(f"{name}_BASE", handler, f"What the macro {name} calls")
        gcode.register("CLEAR_PAUSE", self._clear, "Forgets that the machine is paused")

    async def _pause(self, _command: Command) -> None:
        if self._paused:
            self._gcode.inform("Print already paused")
            return
        self._file_paused = self._sdcard.active
        if self._file_paused:
            await self._sdcard.pause()
        else:
            self._gcode.inform("action:paused")
        self._paused = True

    def _resume(self, _command: Command) -> None:
        if not self._paused:
            self._gcode.inform("Print is not paused, resume aborted")
            return
        if self._file_paused:
            self._sdcard.resume()
            self._file_paused = False
        else:
            self._gcode.inform("action:resumed")
        self._paused = False

    async def _cancel(self, command: Command) -> None:
        self._turn_off()
        if self._sdcard.active or self._file_paused:
            await self._sdcard.cancel()
        else:
            self._gcode.inform("action:cancel")
        self._clear(command)

    def _clear(self, _command: Command) -> None:
        self._paused = False

    def status(self) -> dict[str, object]:
        """Return the object's fields."""
        return {"is_paused": self._paused}
