"""The heaters, each with one time constant, and the commands that wait for them."""

import asyncio
import math
import time
from collections.abc import Callable
from functools import partial

from toolpost.sim.klippy.errors import CommandError
from toolpost.sim.klippy.gcode import GCode
from toolpost.sim.klippy.parsing import Command

AMBIENT = 22.0
"""Temperature of the room, °C."""

BAND = 2.0
"""A heater is at its target once it is less than this below it, K."""

MIN_EXTRUDE = 170.0
"""Below it nothing is extruded, °C."""

REPORT_EVERY = 1.0
"""Seconds between two temperature lines while a command waits."""

_POLL = 0.02


class Heater:
    """A heater whose temperature nears its target exponentially.

    Args:
        maximum: the highest target, °C.
        time_constant: seconds.
    """

    def __init__(self, maximum: float, time_constant: float) -> None:
        self.maximum = maximum
        self.target = 0.0
        self._off = False
        self._time_constant = time_constant
        self._start = AMBIENT
        self._since = time.monotonic()

    def temperature(self, now: float) -> float:
        """Return the temperature at ``now``, °C."""
        goal = AMBIENT if self._off else max(self.target, AMBIENT)
        return goal + (self._start - goal) * math.exp((self._since - now) / self._time_constant)

    def set_target(self, target: float) -> None:
        """Heat to ``target`` °C from now on; 0 turns the heater off.

        Raises:
            CommandError: the target is beyond what the heater is for.
        """
        if not 0.0 <= target <= self.maximum:
            raise CommandError(f"Requested temperature ({target}) out of range (0.0:{self.maximum})")
        now = time.monotonic()
        self._start = self.temperature(now)
        self._since = now
        self.target = target

    def cut_off(self) -> None:
        """Cool down for good with the target unchanged, as in a shutdown."""
        target = self.target
        self.set_target(target)
        self._off = True

    def heating(self, now: float) -> bool:
        """Whether the target is still to be reached."""
        return self.temperature(now) < self.target - BAND

    def status(self, now: float) -> dict[str, object]:
        """Return the fields that every heater has."""
        share = 0.0 if self._off else self.target / self.maximum
        return {
            "temperature": round(self.temperature(now), 2),
            "target": self.target,
            "power": 1.0 if share and self.heating(now) else round(share, 2),
        }


class Heaters:
    """The extruder's heater and the bed's.

    Args:
        gcode: where the commands are registered.
        time_constant: of both, seconds.
        stopped: whether the machine was shut down; ends every waiting.
    """

    def __init__(self, gcode: GCode, time_constant: float, stopped: Callable[[], bool]) -> None:
        self._gcode = gcode
        self._stopped = stopped
        self._extruder = Heater(300.0, time_constant)
        self._bed = Heater(130.0, time_constant)
        self._heaters = {"heater_bed": self._bed, "extruder": self._extruder}
        gcode.register("M105", self._report, always=True)
        for name, heater in (("M104", self._extruder), ("M140", self._bed)):
            gcode.register(name, partial(self._set, heater))
        for name, heater in (("M109", self._extruder), ("M190", self._bed)):
            gcode.register(name, partial(self._set_and_wait, heater))
        gcode.register("SET_HEATER_TEMPERATURE", self._set_by_name, "HEATER, TARGET: heats")
        gcode.register("TEMPERATURE_WAIT", self._wait, "SENSOR, MINIMUM, MAXIMUM: waits")
        gcode.register("TURN_OFF_HEATERS", lambda _command: self.turn_off(), "Stops all heating")

    def turn_off(self) -> None:
        """Set every target to 0."""
        for heater in self._heaters.values():
            heater.set_target(0.0)

    def cut_off(self) -> None:
        """Let everything cool down for good, as in a shutdown."""
        for heater in self._heaters.values():
            heater.cut_off()

    def may_extrude(self) -> bool:
        """Whether the nozzle is hot enough."""
        return self._extruder.temperature(time.monotonic()) >= MIN_EXTRUDE

    def _line(self) -> str:
        now = time.monotonic()
        return " ".join(
            f"{name}:{heater.temperature(now):.1f} /{heater.target:.1f}"
            for name, heater in (("B", self._bed), ("T0", self._extruder))
        )

    def _report(self, _command: Command) -> None:
        self._gcode.respond(self._line())

    def _set(self, heater: Heater, command: Command) -> None:
        heater.set_target(command.number("S", 0.0))

    async def _set_and_wait(self, heater: Heater, command: Command) -> None:
        self._set(heater, command)
        if heater.target:
            await self._until(lambda now: not heater.heating(now))

    def _find(self, command: Command, key: str) -> Heater:
        name = command.get(key)
        heater = self._heaters.get(name)
        if heater is None:
            raise CommandError(f"The value '{name}' is not valid for {key}")
        return heater

    def _set_by_name(self, command: Command) -> None:
        self._find(command, "HEATER").set_target(command.number("TARGET", 0.0))

    async def _wait(self, command: Command) -> None:
        heater = self._find(command, "SENSOR")
        low = command.number("MINIMUM", -math.inf)
        high = command.number("MAXIMUM", math.inf)
        if math.isinf(low) and math.isinf(high):
            raise CommandError("Error on 'TEMPERATURE_WAIT': missing MINIMUM or MAXIMUM.")
        await self._until(lambda now: low <= heater.temperature(now) <= high)

    async def _until(self, reached: Callable[[float], bool]) -> None:
        """Wait for ``reached`` or a shutdown; put out the temperatures meanwhile."""
        report_at = time.monotonic()
        while not reached(now := time.monotonic()) and not self._stopped():
            if now >= report_at:
                report_at = now + REPORT_EVERY
                self._gcode.respond(self._line())
            await asyncio.sleep(_POLL)

    def extruder(self, now: float) -> dict[str, object]:
        """Return the object ``extruder``."""
        return {
            **self._extruder.status(now),
            "can_extrude": self._extruder.temperature(now) >= MIN_EXTRUDE,
            "pressure_advance": 0.0,
            "smooth_time": 0.04,
            "motion_queue": None,
        }

    def heater_bed(self, now: float) -> dict[str, object]:
        """Return the object ``heater_bed``."""
        return self._bed.status(now)

    def heaters(self) -> dict[str, object]:
        """Return the object ``heaters``."""
        names = list(self._heaters)
        return {"available_heaters": names, "available_sensors": list(names), "available_monitors": []}
