"""The simulated Spark core: what the firmware does with the lines of its serial port.

Every time here is in seconds on the core's clock, which is ``time.monotonic``. The rules are those
of the Spark serial protocol (lines down, flow control, cancel, boot and fault).
"""

import asyncio
import math
import time
from collections.abc import Callable

from toolpost.sim import commands, replies
from toolpost.sim.answers import Answers
from toolpost.sim.execution import Execution
from toolpost.sim.faults import Fault, FaultSchedule
from toolpost.sim.lines import LF, MAX_LINE, LineReader
from toolpost.sim.motion import AXES, RUN
from toolpost.sim.options import SparkOptions
from toolpost.sim.timers import Timers

MAX_SETTINGS = 512
"""Settings that the core can hold."""

DEFAULT_SLOW = 0.5
DEFAULT_UNPLUGGED = 1.0
DEFAULT_NOISE = 64

_STILL_CUTTING = 0.5  # with commands that take no time, a cut goes on showing for this long


class SparkCore:
    """A Spark core: takes bytes, executes commands in time, answers.

    Every command that arrives is counted in ``received`` and ends in exactly one of ``executed``,
    ``lost``, ``ignored``, ``rejected``, ``canceled`` or still in the queue.

    Args:
        send: takes what goes up, one or more whole lines at a time (noise excepted).
        loop: the loop that runs the timers.
        options: what the core is like.
        trace: takes ("received" | "executed" | "ignored" | "lost", line) for every line; None
            costs nothing.
        clock: the time, seconds; a test may bring its own, together with its loop.

    Attributes:
        received: commands that arrived; signals are none.
        executed: commands that were executed to their end.
        lost: commands that found the queue full.
        ignored: commands that arrived while the core heeds none (boot, hold-off, fault mode).
        rejected: lines that are no command and were answered with an error.
        canceled: commands that ``!``, a reboot or fault mode removed.
        first_command_at: when the first command since ``mark`` arrived, None before.
        last_executed_at: when the last command ended, None before.
        last_bang_at: when the last ``!`` that had an effect arrived, None before.
        commands_after_bang: commands that arrived since then, until ``mark``.
        boots: boots so far.
        settings: the present settings.
        unplug: called with seconds when the port shall go away for that long; set by the port.
    """

    def __init__(
        self,
        send: Callable[[bytes], None],
        loop: asyncio.AbstractEventLoop,
        options: SparkOptions,
        trace: Callable[[str, bytes], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._send = send
        self._options = options
        self._trace = trace
        self.received = 0
        self.executed = 0
        self.lost = 0
        self.ignored = 0
        self.rejected = 0
        self.canceled = 0
        self.first_command_at: float | None = None
        self.last_executed_at: float | None = None
        self.last_bang_at: float | None = None
        self.commands_after_bang = 0
        self.boots = 0
        self.settings: dict[str, float] = {}
        self.unplug: Callable[[float], None] = lambda _seconds: None

        self._counting_after_bang = False
        self._timed = options.timed
        self._lines = LineReader()
        self._edits = 0
        self._faults = FaultSchedule(loop, self._apply, clock)
        self._timers = Timers(loop)
        self._answers = Answers(self._up, loop, self._timers, clock, options.answer_delay)
        self._execution = Execution(
            loop, clock, options, self.settings, self._carry_out, self._count_for_faults
        )
        self._cut_at = -math.inf
        self._booted_at = self._clock()
        self._booting = False
        self._failed = False
        self._muted = False
        self._deaf_until = 0.0
        self._refuse_next = 0
        self._garbled = 0
        self._closed = False
        self._straight = False
        self._reset()

    # -- observables

    @property
    def position(self) -> dict[str, float]:
        """The machine position now: mm, and degrees for c."""
        return dict(zip(AXES, self._execution.motion.position(self._clock()), strict=True))

    @property
    def queue_length(self) -> int:
        """Commands that wait or run."""
        return self._execution.length

    @property
    def overlong(self) -> int:
        """Lines that were dropped because they outgrew the line buffer."""
        return self._lines.overlong

    def mark(self) -> None:
        """Begin a new measurement: forget ``first_command_at`` and the last ``!``'s count."""
        self.first_command_at = None
        self.commands_after_bang = 0
        self._counting_after_bang = False

    # -- life

    def boot(self) -> None:
        """Boot, as after power on or a reset: state fresh, queue empty, then the boot message."""
        self._boot(replies.BOOT[self._options.boot_message])

    def close(self) -> None:
        """Stop: no timer runs on, nothing more is sent or taken."""
        self._reset()
        self._faults.close()
        self._timers.close()
        self._closed = True

    def inject(self, fault: Fault) -> None:
        """Have ``fault`` happen, at once or when it is due."""
        self._faults.add(fault, self.executed)
        self._choose_path()

    def _boot(self, message: bytes) -> None:
        self._reset()
        self.boots += 1
        self._faults.start()
        if self._options.boot_time > 0:
            self._booting = True
            self._choose_path()
            self._timers.start("boot", self._options.boot_time, lambda: self._end_boot(message))
        else:
            self._end_boot(message)

    def _end_boot(self, message: bytes) -> None:
        self._booting = False
        self._booted_at = self._clock()
        self._lines.reset()
        self._choose_path()
        if message:
            self._up(message)

    def _reset(self) -> None:
        """Make the state fresh. A mute or slow line and faults not yet due stay as they are."""
        self.canceled += self._execution.reset()
        self._answers.clear()
        self._timers.cancel("boot", "stall")
        self._lines.reset()
        self.settings.clear()
        self.settings.update(replies.default_settings())
        self._booting = self._failed = False
        self._deaf_until = 0.0
        self._choose_path()

    # -- the wire

    def receive(self, data: bytes) -> None:
        """Take bytes from the host, in any chunks."""
        if self._closed:
            return
        now = self._clock()
        if self._execution.running is not None:
            self._execution.advance(now)
        if self._deaf_until and now >= self._deaf_until:
            self._deaf_until = 0.0
            self._choose_path()
        if self._booting:
            # What arrives before the boot ends is discarded (Spark serial protocol, boot); it is
            # counted here so that a test can see what a host lost.
            self._discard(self._lines.feed(data))
            self._edits = self._lines.edits
            return
        lines = self._lines.feed(data)
        if self._lines.edits != self._edits:
            self._up(replies.ERASE * (self._lines.edits - self._edits))
            self._edits = self._lines.edits
        at, end, boots = 0, len(lines), self.boots
        while at < end:
            if self._straight and (run := RUN.match(lines, at)):
                stop = run.end()
                self._run_straight(lines, at, stop, now)
                at = stop
                continue
            stop = lines.index(LF, at)
            self._take(lines[at:stop], now)
            at = stop + 1
            if self.boots != boots or self._closed:
                self._discard(lines[at:])
                return

    def _run_straight(self, lines: bytes, start: int, stop: int, now: float) -> None:
        """Execute plain moves that take no time, all in one."""
        count = lines.count(LF, start, stop)
        self.received += count
        self.executed += count
        self.last_executed_at = self._cut_at = now
        if self.first_command_at is None:
            self.first_command_at = now
        if self._counting_after_bang:
            self.commands_after_bang += count
        self._execution.motion.run(lines, start, stop)

    def _choose_path(self) -> None:
        """Decide whether plain moves may be executed without a look at each."""
        self._straight = not (
            self._timed
            or self._trace
            or self._booting
            or self._failed
            or self._execution.stalled
            or self._deaf_until
            or self._refuse_next
            or self._faults.counting
        )

    def _discard(self, lines: bytes) -> None:
        for line in lines.split(LF)[:-1]:
            self._note("received", line)
            if commands.is_command(line):
                self._count_arrival(self._clock())
                self.ignored += 1
            self._note("ignored", line)

    def _take(self, line: bytes, now: float) -> None:
        """Take one line."""
        if len(line) > MAX_LINE:
            self._lines.overlong += 1
            return
        if not line.strip():
            self._up(replies.EOL)
            return
        self._note("received", line)
        if line[:1] == b"?":
            self._signal(line, now)
        elif line == b"!":
            self._bang(now)
        elif line[:5] == b"fset ":
            self._set_now(line)
        else:
            self._count_arrival(now)
            self._command(line, now)

    def _count_arrival(self, now: float) -> None:
        self.received += 1
        if self.first_command_at is None:
            self.first_command_at = now
        if self._counting_after_bang:
            self.commands_after_bang += 1

    def _up(self, data: bytes) -> None:
        if not self._muted and not self._closed:
            self._send(data)

    def _note(self, event: str, line: bytes) -> None:
        if self._trace is not None:
            self._trace(event, line)

    # -- signals

    def _signal(self, line: bytes, now: float) -> None:
        if line == b"?queue":
            self._answers.queue(self._options.capacity, self._execution.length)
        elif line == b"?pos":
            self._answers.position(self._execution.motion, now)
        elif line == b"?edm":
            self._answers.discharge(now, cutting=self._cutting(now))
        else:
            self._note("ignored", line)

    def _cutting(self, now: float) -> bool:
        if self._timed:
            running = self._execution.running
            return running is not None and running.startswith(b"G1")
        return now - self._cut_at < _STILL_CUTTING

    def _bang(self, now: float) -> None:
        """Cancel (Spark serial protocol, cancel): stop the axes, drop everything, then be deaf."""
        if self._failed or self._deaf_until:
            self._note("ignored", b"!")
            return
        self.last_bang_at = now
        self.commands_after_bang = 0
        self._counting_after_bang = True
        self._execution.motion.halt(now)
        self.canceled += self._execution.drop()
        self._answers.cut_short()
        if self._options.hold_off > 0:
            self._deaf_until = now + self._options.hold_off
        self._choose_path()

    # -- commands

    def _command(self, line: bytes, now: float) -> None:
        if self._deaf_until or (self._failed and line.rstrip() not in (b"get", b"stat")):
            self.ignored += 1
            self._note("ignored", line)
            return
        problem = commands.problem(line)
        if problem:
            self.rejected += 1
            self._note("ignored", line)
            self._up(replies.error(problem, line))
            return
        if self._refuse_next or self._execution.length >= self._options.capacity:
            self._refuse_next = max(0, self._refuse_next - 1)
            self.lost += 1
            self._note("lost", line)
            self._choose_path()
            self._up(replies.error("queue full", line))
            return
        self._execution.add(line, now)

    def _carry_out(self, line: bytes, ended: float) -> None:
        """Do what a command does at its end."""
        self.executed += 1
        self.last_executed_at = ended
        if line[:2] == b"G1":
            self._cut_at = ended
        self._note("executed", line)
        if line[:4] == b"set ":
            self._set(line)
        elif line[:3] == b"get":
            self._answers.give(replies.settings_report(self.settings))
        elif line[:4] == b"stat":
            seconds = self._clock() - self._booted_at
            self._answers.give(replies.statistics(self.executed, seconds))

    def _count_for_faults(self) -> None:
        if self._faults.counting:
            self._faults.on_executed(self.executed)
            self._choose_path()

    def _set(self, line: bytes) -> bool:
        """Carry out a ``set`` or ``fset``; answer with an error if there is no room."""
        found = commands.assignment(line)
        if found is None:
            return False
        key, value = found
        if key not in self.settings and len(self.settings) >= MAX_SETTINGS:
            self._up(replies.error("too many settings", line))
        else:
            self.settings[key] = value
        return True

    def _set_now(self, line: bytes) -> None:
        """Carry out an ``fset``, which is not queued."""
        if self._failed or self._deaf_until:
            self._note("ignored", line)
        elif not self._set(line):
            self._up(replies.error("invalid set", line))

    # -- faults

    def _apply(self, fault: Fault) -> None:
        """Have a fault that is due."""
        if self._closed:
            return
        amount = fault.amount
        match fault.name:
            case "mute":
                self._muted = True
                self._timers.start("mute", amount, self._unmute)
            case "stall":
                self._execution.stall()
                self._timers.start("stall", amount, self._end_stall)
            case "reboot":
                self.boot()
            case "silent-reboot":
                self._boot(b"")
            case "fault":
                self._fail()
            case "unplug":
                self.unplug(DEFAULT_UNPLUGGED if amount is None else amount)
            case "garbage":
                self._garbled += 1
                self._up(replies.noise(int(DEFAULT_NOISE if amount is None else amount), self._garbled))
            case "queue-full":
                self._refuse_next += 1
            case "slow":
                later = DEFAULT_SLOW if amount is None else amount
                self._answers.delay = self._options.answer_delay + later
            case "drop-answer":
                self._answers.drop_next()
            case "error":
                self._up(replies.error("simulated error" if fault.text is None else fault.text))
            case _:
                raise ValueError(f"unknown fault {fault.name!r}")
        self._choose_path()

    def _unmute(self) -> None:
        self._muted = False

    def _end_stall(self) -> None:
        self._execution.resume()
        self._choose_path()

    def _fail(self) -> None:
        """Enter fault mode (Spark serial protocol, fault): motion ends, only reports still work."""
        self._execution.motion.halt(self._clock())
        self.canceled += self._execution.drop()
        self._failed = True
        self._up(replies.FAULT)
