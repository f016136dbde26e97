"""The axes: where they are, and how long moves take."""

import asyncio
import time
from collections.abc import Awaitable, Callable

from toolpost.sim.klippy.errors import CommandError
from toolpost.sim.klippy.gcode import GCode
from toolpost.sim.klippy.idle import IdleTimeout
from toolpost.sim.klippy.options import KlippyOptions
from toolpost.sim.klippy.parsing import Command

AXES = "XYZE"
RANGE = (0.0, 200.0)
"""Where X, Y and Z can go, mm."""

MAX_VELOCITY = 300.0
MAX_ACCEL = 3000.0
MAX_DWELL = 86_400.0
"""The longest dwell that ``G4`` obeys, seconds."""

_MAKE_UP = 0.01  # a line that began this much too late, because of the loop's timers, ends in time


class Motion:
    """Positions, modes and the time that motion takes.

    Args:
        gcode: where the commands are registered.
        options: what the host is like.
        idle: is told of motion.
        may_extrude: whether the nozzle is hot enough.

    Attributes:
        filament: filament that was pushed forward and back so far, mm of the extruder's axis.
    """

    def __init__(
        self,
        gcode: GCode,
        options: KlippyOptions,
        idle: IdleTimeout,
        may_extrude: Callable[[], bool],
    ) -> None:
        self.filament = 0.0
        self._gcode = gcode
        self._options = options
        self._idle = idle
        self._may_extrude = may_extrude
        self._position = [0.0] * 4
        self._base = [0.0] * 4
        self._homed = ""
        self._absolute = True
        self._absolute_e = True
        self._speed = 25.0  # mm/s, as the file gives it
        self._speed_factor = 1.0
        self._extrude_factor = 1.0
        self._ends_at = 0.0
        self._began_at = time.monotonic()
        self._saved: dict[str, tuple[list[float], bool, bool]] = {}
        self._register()

    def _register(self) -> None:
        register = self._gcode.register
        for name in ("G0", "G1", "G2", "G3"):
            register(name, self._move)
        register("G28", self._home)
        register("G4", self._dwell)
        register("M400", lambda _command: self.drain())
        register("G92", self._set_position)
        register("G20", self._inches)
        register("M114", self._report_position, always=True)
        register("M220", self._set_speed_factor)
        register("M221", self._set_extrude_factor)
        register("G90", lambda _command: self._set_modes(absolute=True))
        register("G91", lambda _command: self._set_modes(absolute=False))
        register("M82", lambda _command: self._set_modes(absolute_e=True))
        register("M83", lambda _command: self._set_modes(absolute_e=False))
        for name in ("M18", "M84"):
            register(name, self._motors_off)
        register("SAVE_GCODE_STATE", self._save, "NAME: keeps the modes and origins")
        register("RESTORE_GCODE_STATE", self._restore, "NAME: brings them back")

    def stop(self) -> None:
        """Forget the motion that is queued, as a shutdown does."""
        self._ends_at = min(self._ends_at, time.monotonic())

    async def drain(self) -> None:
        """Wait until all motion has ended (``M400``)."""
        rest = self._ends_at - time.monotonic()
        if rest > 0:
            await asyncio.sleep(rest)

    def _spend(self, seconds: float) -> Awaitable[None] | None:
        """Queue motion; return what to wait for, None when it fits into the buffer."""
        now = time.monotonic()
        start = self._ends_at if now - self._ends_at < _MAKE_UP else now
        self._ends_at = start + seconds
        self._idle.note_motion(now, self._ends_at)
        wait = self._ends_at - now - self._options.buffer_time
        return asyncio.sleep(wait) if wait > 0 else None

    # -- commands

    def _move(self, command: Command) -> Awaitable[None] | None:
        target = list(self._position)
        try:
            for index, axis in enumerate(AXES):
                if axis not in command.params:
                    continue
                value = float(command.params[axis])
                absolute = self._absolute
                if axis == "E":
                    value *= self._extrude_factor
                    absolute = absolute and self._absolute_e
                target[index] = value + (self._base[index] if absolute else self._position[index])
            feed = float(command.params.get("F", self._speed * 60))
        except ValueError:
            raise CommandError(f"Unable to parse move '{command.line}'") from None
        if feed <= 0:
            raise CommandError(f"Invalid speed in '{command.line}'")
        self._speed = feed / 60
        self._check(target)
        self.filament += (target[3] - self._position[3]) / self._extrude_factor
        self._position = target
        return self._spend(self._options.line_time)

    def _check(self, target: list[float]) -> None:
        """Refuse what a real machine refuses, if the options ask for it."""
        if not self._options.strict_motion:
            return
        x, y, z, e = target
        place = f"{x:.3f} {y:.3f} {z:.3f} [{e:.3f}]"
        for axis, old, new in zip("xyz", self._position, target, strict=False):
            if new != old and axis not in self._homed:
                raise CommandError(f"Must home axis first: {place}")
            if new != old and not RANGE[0] <= new <= RANGE[1]:
                raise CommandError(f"Move out of range: {place}")
        if e != self._position[3] and not self._may_extrude():
            raise CommandError("Extrude below minimum temp\nThe nozzle has to have 170 °C")

    def _home(self, command: Command) -> Awaitable[None] | None:
        axes = [axis for axis in "XYZ" if axis in command.params] or list("XYZ")
        for axis in axes:
            index = AXES.index(axis)
            self._position[index] = self._base[index] = 0.0
        self._homed = "".join(axis for axis in "xyz" if axis in self._homed or axis.upper() in axes)
        return self._spend(self._options.line_time)

    def _dwell(self, command: Command) -> Awaitable[None] | None:
        # A real host heeds P alone; S is for files that were written for other firmware.
        seconds = command.number("P", 0.0, least=0.0) / 1000 + command.number("S", 0.0, least=0.0)
        return self._spend(min(seconds, MAX_DWELL))

    def _set_position(self, command: Command) -> None:
        given = [axis for axis in AXES if axis in command.params]
        for index, axis in enumerate(AXES):
            if axis in given or not given:
                value = command.number(axis, 0.0)
                self._base[index] = self._position[index] - value

    def _inches(self, _command: Command) -> None:
        raise CommandError("Machine does not support G20 (inches) command")

    def _report_position(self, _command: Command) -> None:
        x, y, z, e = self._in_file()
        self._gcode.respond(f"X:{x:.3f} Y:{y:.3f} Z:{z:.3f} E:{e:.3f}")

    def _set_speed_factor(self, command: Command) -> None:
        self._speed_factor = command.number("S", 100.0, above=0.0) / 100

    def _set_extrude_factor(self, command: Command) -> None:
        factor = command.number("S", 100.0, above=0.0) / 100
        in_file = self._in_file()[3]
        self._extrude_factor = factor
        self._base[3] = self._position[3] - in_file * factor

    def _set_modes(self, *, absolute: bool | None = None, absolute_e: bool | None = None) -> None:
        if absolute is not None:
            self._absolute = absolute
        if absolute_e is not None:
            self._absolute_e = absolute_e

    def _motors_off(self, _command: Command) -> Awaitable[None]:
        self._homed = ""
        return self.drain()

    def _save(self, command: Command) -> None:
        name = command.get("NAME", "default")
        self._saved[name] = (list(self._base), self._absolute, self._absolute_e)

    def _restore(self, command: Command) -> None:
        name = command.get("NAME", "default")
        if name not in self._saved:
            raise CommandError(f"Unknown g-code state: {name}")
        base, self._absolute, self._absolute_e = self._saved[name]
        self._base = list(base)

    # -- objects

    def _in_file(self) -> list[float]:
        """Return the position in the file's coordinates."""
        position = [now - base for now, base in zip(self._position, self._base, strict=True)]
        position[3] /= self._extrude_factor
        return position

    def gcode_move(self) -> dict[str, object]:
        """Return the object ``gcode_move``; speed in mm/min, positions in mm."""
        return {
            "speed_factor": self._speed_factor,
            "speed": self._speed * 60,
            "extrude_factor": self._extrude_factor,
            "absolute_coordinates": self._absolute,
            "absolute_extrude": self._absolute_e,
            "homing_origin": [0.0] * 4,
            "position": list(self._position),
            "gcode_position": self._in_file(),
            "axis_map": {axis: index for index, axis in enumerate(AXES)},
        }

    def toolhead(self, now: float) -> dict[str, object]:
        """Return the object ``toolhead``; times in seconds since the boot."""
        low, high = RANGE
        return {
            "homed_axes": self._homed,
            "axis_minimum": [low, low, low, 0.0],
            "axis_maximum": [high, high, high, 0.0],
            "print_time": max(0.0, self._ends_at - self._began_at),
            "stalls": 0,
            "estimated_print_time": now - self._began_at,
            "extruder": "extruder",
            "position": list(self._position),
            "max_velocity": MAX_VELOCITY,
            "max_accel": MAX_ACCEL,
            "minimum_cruise_ratio": 0.5,
            "square_corner_velocity": 5.0,
            "extra_axes": {"extruder": 3},
        }

    def motion_report(self, now: float) -> dict[str, object]:
        """Return the object ``motion_report``; mm and mm/s."""
        moving = now < self._ends_at
        return {
            "live_position": list(self._position),
            "live_velocity": self._speed * self._speed_factor if moving else 0.0,
            "live_extruder_velocity": 0.0,
            "steppers": ["extruder", "stepper_x", "stepper_y", "stepper_z"],
            "trapq": ["extruder", "toolhead"],
        }

    def stepper_enable(self) -> dict[str, object]:
        """Return the object ``stepper_enable``."""
        on = {f"stepper_{axis}": axis in self._homed for axis in "xyz"}
        return {"steppers": {**on, "extruder": bool(self._homed)}}
