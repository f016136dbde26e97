"""One life of the machine, from a boot to the next restart."""

import asyncio
import os
import time
from collections.abc import Callable
from pathlib import Path

from toolpost.sim.klippy.extras import Display, Fan, register_extras
from toolpost.sim.klippy.gcode import GCode
from toolpost.sim.klippy.heaters import Heaters
from toolpost.sim.klippy.idle import IdleTimeout
from toolpost.sim.klippy.motion import Motion
from toolpost.sim.klippy.options import KlippyOptions
from toolpost.sim.klippy.parsing import Command
from toolpost.sim.klippy.pausing import MACRO, PauseResume
from toolpost.sim.klippy.print_stats import PrintStats
from toolpost.sim.klippy.sdcard import Run, VirtualSdCard
from toolpost.sim.klippy.settings import MACROS, configfile

READY = "Printer is ready"
STARTING = "Printer is not ready\nThe simulated host is starting. Please retry in a few moments.\n"
HOW_TO_RECOVER = (
    "Once the cause is put right, FIRMWARE_RESTART starts the machine again.\nPrinter is shutdown\n"
)


class Printer:
    """The machine behind the socket.

    Args:
        options: what the host is like.
        directory: where the files are.
        runs: gets an entry for every file that is started.
        restart: called when a command asks for a restart.
        call_remote: called with the name of a remote method that a macro calls.

    Attributes:
        state: startup, ready or shutdown.
        message: the state in words, for people.
    """

    def __init__(
        self,
        options: KlippyOptions,
        directory: Path,
        runs: list[Run],
        *,
        restart: Callable[[], None],
        call_remote: Callable[[str], object],
    ) -> None:
        self.state = "startup"
        self.message = STARTING
        self._boot_timer: asyncio.TimerHandle | None = None
        self._options = options
        self._call_remote = call_remote
        self._cpu = time.process_time
        self.gcode = gcode = GCode(self.problem, self.shutdown)
        self.heaters = Heaters(gcode, options.heater_time, lambda: self.state == "shutdown")
        self._idle = IdleTimeout(lambda: gcode.mutex.busy, self.heaters.turn_off)
        self._motion = Motion(gcode, options, self._idle, self.heaters.may_extrude)
        self._stats = PrintStats(lambda: self._motion.filament)
        self.sdcard = VirtualSdCard(
            gcode, self._stats, directory, runs, self.heaters.turn_off, lambda: self._display.reset()
        )
        self._display = Display(gcode, self.sdcard.progress)
        self._fan = Fan(gcode)
        self._pausing = PauseResume(gcode, self.sdcard, self.heaters.turn_off)
        self._configfile = configfile(directory)
        register_extras(gcode)
        self._register(restart)
        self._objects = self._make_objects()

    def _register(self, restart: Callable[[], None]) -> None:
        register = self.gcode.register

        async def restart_when_still(_command: Command) -> None:
            await self._motion.drain()
            restart()

        for name, words in (
            ("RESTART", "Starts the host again"),
            ("FIRMWARE_RESTART", "Starts the firmware and the host again"),
        ):
            register(name, restart_when_still, words, always=True)
        register("M112", lambda _command: self.shutdown("Shutdown due to M112 command"), always=True)
        register("STATUS", self._say_state, "Says whether the machine is ready")
        register("SET_IDLE_TIMEOUT", self._set_timeout, "TIMEOUT: seconds until the machine is idle")
        register("SET_PRINT_STATS_INFO", self._stats.set_info, "Takes the layers from the slicer")
        register("PAUSE_QUEUE", lambda _command: self._remote("pause_job_queue"), MACRO)
        register("START_QUEUE", lambda _command: self._remote("start_job_queue"), MACRO)

    # -- life

    def boot(self) -> None:
        """Start; ready after the startup time."""
        loop = asyncio.get_running_loop()
        self._boot_timer = loop.call_later(self._options.startup_time, self._become_ready)

    def _become_ready(self) -> None:
        self._boot_timer = None
        if self.state != "startup":
            return
        self.state = "ready"
        self.message = READY
        self.gcode.inform("Klipper state: Ready")

    def shutdown(self, text: str) -> None:
        """Shut down, as after an emergency stop; the first cause stays.

        The line that runs runs on to its end, and so long ``print_stats`` says "printing".
        """
        if self.state == "shutdown":
            return
        was_ready = self.state == "ready"
        self.state = "shutdown"
        self.message = f"{text}\n{HOW_TO_RECOVER}"
        self.sdcard.halt()
        self.heaters.cut_off()
        self._motion.stop()
        if was_ready:
            self.gcode.inform("Klipper state: Shutdown")

    def stop(self) -> asyncio.Task[None] | None:
        """End at once, as with the process; return the task that ends, if there is one."""
        if self._boot_timer is not None:
            self._boot_timer.cancel()
        self.gcode.outputs.clear()
        return self.sdcard.stop()

    def problem(self) -> str | None:
        """Return why commands cannot be taken now, None if they can."""
        return None if self.state == "ready" else self.message

    # -- commands

    def _say_state(self, _command: Command) -> None:
        self.gcode.inform("Klipper state: Ready")

    def _set_timeout(self, command: Command) -> None:
        self._idle.timeout = command.number("TIMEOUT", self._idle.timeout, above=0.0)
        self.gcode.inform(f"idle_timeout: Timeout set to {self._idle.timeout:.2f} s")

    def _remote(self, name: str) -> None:
        self._call_remote(name)

    # -- objects

    def _make_objects(self) -> dict[str, Callable[[float], dict[str, object]]]:
        return {
            "gcode": lambda _now: self.gcode.status(),
            "webhooks": lambda _now: {"state": self.state, "state_message": self.message},
            "configfile": lambda _now: dict(self._configfile),
            "mcu": lambda _now: _mcu(),
            "heaters": lambda _now: self.heaters.heaters(),
            "heater_bed": self.heaters.heater_bed,
            "fan": lambda _now: self._fan.status(),
            "gcode_move": lambda _now: self._motion.gcode_move(),
            "print_stats": self._stats.status,
            "virtual_sdcard": lambda _now: self.sdcard.status(),
            "pause_resume": lambda _now: self._pausing.status(),
            "display_status": lambda _now: self._display.status(),
            **{f"gcode_macro {name}": lambda _now: {} for name in MACROS},
            "stepper_enable": lambda _now: self._motion.stepper_enable(),
            "motion_report": self._motion.motion_report,
            "toolhead": self._motion.toolhead,
            "extruder": self.heaters.extruder,
            "idle_timeout": self._idle.status,
            "system_stats": lambda _now: self._system_stats(),
        }

    def object_names(self) -> list[str]:
        """Return the names of all objects."""
        return list(self._objects)

    def status(self, name: str, now: float) -> dict[str, object]:
        """Return an object's fields; none for an object that does not exist (measured)."""
        found = self._objects.get(name)
        return {} if found is None else found(now)

    def _system_stats(self) -> dict[str, object]:
        return {
            "sysload": round(os.getloadavg()[0], 2),
            "cputime": self._cpu(),
            "memavail": 1_000_000,
        }


def _mcu() -> dict[str, object]:
    return {
        "mcu_version": "simulated",
        "mcu_build_versions": "simulated",
        "mcu_constants": {"MCU": "simulated", "CLOCK_FREQ": 50_000_000},
        "last_stats": {"mcu_awake": 0.0, "mcu_task_avg": 0.0, "bytes_retransmit": 0, "freq": 50_000_000},
    }
