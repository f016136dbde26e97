"""The object ``print_stats``: what the file that is printed has come to."""

import time
from collections.abc import Callable

from toolpost.sim.klippy.parsing import Command


class PrintStats:
    """State and times of the present or last file.

    Args:
        filament: filament used since the boot, mm.

    Attributes:
        filename: as it was asked for; empty when no file was.
        state: standby, printing, paused, complete, cancelled or error.
        message: why, when the state is error.
    """

    def __init__(self, filament: Callable[[], float]) -> None:
        self._filament = filament
        self.reset()

    def reset(self) -> None:
        """Forget the file."""
        self.filename = ""
        self.state = "standby"
        self.message = ""
        self._started_at: float | None = None
        self._paused_at: float | None = None
        self._paused = 0.0
        self._before_extrusion = 0.0
        self._total = 0.0
        self._used = 0.0
        self._filament_at = self._filament()
        self._layers: int | None = None
        self._layer: int | None = None

    def select(self, filename: str) -> None:
        """Begin anew with a file."""
        self.reset()
        self.filename = filename

    def note_start(self) -> None:
        """Printing begins or goes on."""
        now = time.monotonic()
        if self._started_at is None:
            self._started_at = now
        elif self._paused_at is not None:
            self._paused += now - self._paused_at
            self._paused_at = None
        self._filament_at = self._filament()
        self.state = "printing"
        self.message = ""

    def note_pause(self) -> None:
        """Printing stops, and the file stays open; an error stays an error."""
        if self._paused_at is None:
            self._update(time.monotonic())
            self._paused_at = time.monotonic()
        if self.state != "error":
            self.state = "paused"

    def note_end(self, state: str, message: str = "") -> None:
        """Printing ends; without effect when it has ended before.

        Args:
            state: complete, cancelled or error.
            message: what went wrong.
        """
        if self._started_at is None:
            return
        self._update(time.monotonic())
        self.state = state
        self.message = message
        self._started_at = None

    def _update(self, now: float) -> None:
        """Bring the times and the filament up to ``now``."""
        if self._started_at is None:
            return
        self._total = now - self._started_at
        if self._paused_at is None:
            filament = self._filament()
            self._used += filament - self._filament_at
            self._filament_at = filament
        if self._used <= 0:
            self._before_extrusion = self._total - self._pauses(now)

    def _pauses(self, now: float) -> float:
        since = now if self._paused_at is None or self._started_at is None else self._paused_at
        return self._paused + now - since

    def set_info(self, command: Command) -> None:
        """Take the layers that a slicer reports (``SET_PRINT_STATS_INFO``)."""
        total = int(command.number("TOTAL_LAYER", float(self._layers or 0), least=0))
        if total != (self._layers or 0):
            self._layers, self._layer = (total, 0) if total else (None, None)
        if self._layers is not None:
            layer = int(command.number("CURRENT_LAYER", float(self._layer or 0), least=0))
            self._layer = min(layer, self._layers)

    def status(self, now: float) -> dict[str, object]:
        """Return the object's fields at ``now``; durations in seconds, filament in mm."""
        self._update(now)
        return {
            "filename": self.filename,
            "total_duration": self._total,
            "print_duration": self._total - self._before_extrusion - self._pauses(now),
            "filament_used": self._used,
            "state": self.state,
            "message": self.message,
            "info": {"total_layer": self._layers, "current_layer": self._layer},
        }
