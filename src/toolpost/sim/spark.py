"""The simulated Spark core: what the firmware does with the lines of its serial port.

Every time here is in seconds on the core's clock, which is ``time.monotonic``. The rules are those
of the Spark serial protocol (lines down, flow control, cancel, boot and fault).
"""

import asyncio
import math
import re
import time
from collections import deque
from collections.abc import Callable
from typing import Literal

import msgspec

from toolpost.sim import replies
from toolpost.sim.delay import DelayLine
from toolpost.sim.faults import Fault, FaultSchedule
from toolpost.sim.lines import LF, MAX_LINE, LineReader
from toolpost.sim.motion import AXES, RAPID_FEED, RUN, Motion

MAX_SETTINGS = 512
"""Settings that the core can hold."""

MAX_DWELL = 86_400.0
"""The longest dwell that ``G4`` obeys, seconds."""

DEFAULT_SLOW = 0.5
DEFAULT_UNPLUGGED = 1.0
DEFAULT_NOISE = 64

_NUMBER = rb"[-+]?(?:[0-9]++(?:\.[0-9]*+)?+|\.[0-9]++)"  # possessive, or a bad line would take for ever
_COMMAND = re.compile(rb"[GM][0-9]{1,4}+(?:\.[0-9])?+(?: *[A-Z]%b)*+ *+" % _NUMBER)
_HOME = re.compile(rb"G28(?: *[XYZC])* *")
_SET = re.compile(rb"f?set +([A-Za-z0-9_]+(?:\.[A-Za-z0-9_]+)*) +([-+]?[0-9]{1,9}(?:\.[0-9]{0,9})?) *")
_DWELL = re.compile(rb"G0?4 ?P([0-9]+\.?[0-9]*|\.[0-9]+)")
_LINEAR = re.compile(rb"G0?([01])(?![0-9.])")
_SHORTEST_WAIT = 0.001  # below it a loop's timers round to a busy loop
_EDM_GAP = 0.003  # other answers may come between the two parts of a report for this long
_STILL_CUTTING = 0.5  # with commands that take no time, a cut goes on showing for this long


class SparkOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a simulated Spark core is like.

    Attributes:
        capacity: commands that the queue holds, as ``?queue`` reports; one more is lost.
        command_time: seconds that each G or M command takes; 0 executes at once. ``set``,
            ``get`` and ``stat`` take no time, and ``G4 P<seconds>`` takes its own unless no
            command takes any.
        realtime_moves: G0 and G1 take the time that their distance and feed give, and
            ``command_time`` is for all others.
        answer_delay: seconds until the answer to a signal, to ``get`` or ``stat`` is sent.
        hold_off: seconds after ``!`` in which all but ``?`` signals is ignored; 0 for the older
            firmware, which has no such time.
        boot_message: ``sys`` (newer firmware), ``init`` (older) or ``none``.
        boot_time: seconds that a boot takes; what arrives meanwhile is discarded.
    """

    capacity: int = 64
    command_time: float = 0.05
    realtime_moves: bool = False
    answer_delay: float = 0.0
    hold_off: float = 0.5
    boot_message: Literal["sys", "init", "none"] = "sys"
    boot_time: float = 0.0

    def __post_init__(self) -> None:
        """Refuse numbers that mean nothing.

        Raises:
            ValueError: a time is negative or not finite, or the capacity is below 1.
        """
        if self.capacity < 1:
            raise ValueError(f"capacity must be at least 1, not {self.capacity}")
        for name in ("command_time", "answer_delay", "hold_off", "boot_time"):
            value = getattr(self, name)
            if not math.isfinite(value) or value < 0:
                raise ValueError(f"{name} must be 0 or more seconds, not {value}")


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
        self._loop = loop
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
        self._timed = options.command_time > 0 or options.realtime_moves
        self._lines = LineReader()
        self._edits = 0
        self._motion = Motion(self.settings)
        self._faults = FaultSchedule(loop, self._apply, clock)
        self._answers = DelayLine(loop, self._up, clock)
        self._delay = options.answer_delay
        self._waiting: deque[bytes] = deque()
        self._running: bytes | None = None
        self._due = 0.0
        self._wake_timer: asyncio.TimerHandle | None = None
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._edm_rest = b""
        self._edm_asked = 0
        self._cut_at = -math.inf
        self._booted_at = self._clock()
        self._booting = False
        self._failed = False
        self._stalled_at: float | None = None
        self._muted = False
        self._deaf_until = 0.0
        self._refuse_next = 0
        self._drop_answers = 0
        self._garbled = 0
        self._closed = False
        self._straight = False
        self._reset()

    # -- observables

    @property
    def position(self) -> dict[str, float]:
        """The machine position now: mm, and degrees for c."""
        return dict(zip(AXES, self._motion.position(self._clock()), strict=True))

    @property
    def queue_length(self) -> int:
        """Commands that wait or run."""
        return len(self._waiting) + (self._running is not None)

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
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()
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
            self._after("boot", self._options.boot_time, lambda: self._end_boot(message))
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
        self._drop_commands()
        self._answers.clear()
        for name in ("boot", "edm", "stall"):
            self._cancel_timer(name)
        self._lines.reset()
        self.settings.clear()
        self.settings.update(replies.default_settings())
        self._motion = Motion(self.settings)
        self._edm_rest = b""
        self._booting = self._failed = False
        self._stalled_at = None
        self._deaf_until = 0.0
        self._choose_path()

    # -- the wire

    def receive(self, data: bytes) -> None:
        """Take bytes from the host, in any chunks."""
        if self._closed:
            return
        now = self._clock()
        if self._running is not None:
            self._advance(now)
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
        self._motion.run(lines, start, stop)

    def _choose_path(self) -> None:
        """Decide whether plain moves may be executed without a look at each."""
        self._straight = not (
            self._timed
            or self._trace
            or self._booting
            or self._failed
            or self._stalled_at is not None
            or self._deaf_until
            or self._refuse_next
            or self._faults.counting
        )

    def _discard(self, lines: bytes) -> None:
        for line in lines.split(LF)[:-1]:
            self._note("received", line)
            if _is_command(line):
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
            if self._drop_answers:
                self._drop_answers -= 1
            else:
                self._answer(replies.queue(self._options.capacity, self.queue_length))
        elif line == b"?pos":
            self._answer(replies.position(self._motion, now))
        elif line == b"?edm":
            self._answer_edm(now)
        else:
            self._note("ignored", line)

    def _answer(self, data: bytes) -> None:
        self._answers.push(data, self._delay)
        if self._edm_rest:
            self._end_edm()

    def _answer_edm(self, now: float) -> None:
        """Answer ``?edm``; every other time another answer may come between its lines."""
        if self._edm_rest:
            self._end_edm()
        first, rest = replies.discharge(self._cutting(now), now)
        self._edm_asked += 1
        if self._edm_asked % 2:
            self._answers.push(first + rest, self._delay)
            return
        self._answers.push(first, self._delay)
        self._edm_rest = rest
        self._after("edm", _EDM_GAP, self._end_edm)

    def _end_edm(self) -> None:
        self._cancel_timer("edm")
        rest, self._edm_rest = self._edm_rest, b""
        self._answers.push(rest, self._delay)

    def _cutting(self, now: float) -> bool:
        if self._timed:
            return self._running is not None and self._running.startswith(b"G1")
        return now - self._cut_at < _STILL_CUTTING

    def _bang(self, now: float) -> None:
        """Cancel (Spark serial protocol, cancel): stop the axes, drop everything, then be deaf."""
        if self._failed or self._deaf_until:
            self._note("ignored", b"!")
            return
        self.last_bang_at = now
        self.commands_after_bang = 0
        self._counting_after_bang = True
        self._motion.halt(now)
        self._drop_commands()
        self._edm_rest = b""
        self._cancel_timer("edm")
        if self._options.hold_off > 0:
            self._deaf_until = now + self._options.hold_off
        self._choose_path()

    # -- commands

    def _command(self, line: bytes, now: float) -> None:
        if self._deaf_until or (self._failed and line.rstrip() not in (b"get", b"stat")):
            self.ignored += 1
            self._note("ignored", line)
            return
        problem = _problem(line)
        if problem:
            self.rejected += 1
            self._note("ignored", line)
            self._up(replies.error(problem, line))
            return
        if self._refuse_next or self.queue_length >= self._options.capacity:
            self._refuse_next = max(0, self._refuse_next - 1)
            self.lost += 1
            self._note("lost", line)
            self._choose_path()
            self._up(replies.error("queue full", line))
            return
        self._waiting.append(line)
        if self._running is None and self._stalled_at is None:
            self._due = now
            self._start_next()
            self._advance(now)

    def _start_next(self) -> None:
        """Start the next command where the one before it ended, so that no time is lost."""
        if not self._waiting:
            self._running = None
            return
        line = self._waiting.popleft()
        self._running = line
        began = self._due
        distance = self._motion.begin(line, began)
        seconds = self._duration(line, distance)
        self._motion.last(seconds)
        self._due = began + seconds

    def _duration(self, line: bytes, distance: float) -> float:
        """Return how long a command takes, seconds."""
        if not self._timed or line[:1] not in b"GM":
            return 0.0
        if dwell := _DWELL.match(line):
            return min(float(dwell[1]), MAX_DWELL)
        if self._options.realtime_moves and (move := _LINEAR.match(line)):
            return distance * 60.0 / (RAPID_FEED if move[1] == b"0" else self._motion.feed)
        return self._options.command_time

    def _advance(self, now: float) -> None:
        """Execute everything whose time is over, then wait for the next."""
        while self._running is not None and self._due <= now and self._stalled_at is None:
            self._finish(self._running)
        if self._running is not None and self._wake_timer is None and self._stalled_at is None:
            delay = max(_SHORTEST_WAIT, self._due - now)
            self._wake_timer = self._loop.call_later(delay, self._wake)

    def _wake(self) -> None:
        self._wake_timer = None
        self._advance(self._clock())

    def _finish(self, line: bytes) -> None:
        self.executed += 1
        self.last_executed_at = self._due
        if line[:2] == b"G1":
            self._cut_at = self._due
        self._note("executed", line)
        if line[:4] == b"set ":
            self._set(line)
        elif line[:3] == b"get":
            self._answer(replies.settings_report(self.settings))
        elif line[:4] == b"stat":
            seconds = self._clock() - self._booted_at
            self._answer(replies.statistics(self.executed, seconds))
        self._start_next()
        if self._faults.counting:
            self._faults.on_executed(self.executed)
            self._choose_path()

    def _set(self, line: bytes) -> bool:
        """Carry out a ``set`` or ``fset``; answer with an error if there is no room."""
        match = _SET.fullmatch(line)
        if match is None:
            return False
        key = match[1].decode()
        if key not in self.settings and len(self.settings) >= MAX_SETTINGS:
            self._up(replies.error("too many settings", line))
            return True
        self.settings[key] = float(match[2])
        return True

    def _set_now(self, line: bytes) -> None:
        """Carry out an ``fset``, which is not queued."""
        if self._failed or self._deaf_until:
            self._note("ignored", line)
        elif not self._set(line):
            self._up(replies.error("invalid set", line))

    def _drop_commands(self) -> None:
        self.canceled += self.queue_length
        self._waiting.clear()
        self._running = None
        if self._wake_timer is not None:
            self._wake_timer.cancel()
            self._wake_timer = None

    # -- faults

    def _apply(self, fault: Fault) -> None:
        """Have a fault that is due."""
        if self._closed:
            return
        amount = fault.amount
        match fault.name:
            case "mute":
                self._muted = True
                self._for("mute", amount, self._unmute)
            case "stall":
                self._stall(amount)
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
                self._delay = self._options.answer_delay + (DEFAULT_SLOW if amount is None else amount)
            case "drop-answer":
                self._drop_answers += 1
            case "error":
                self._up(replies.error("simulated error" if fault.text is None else fault.text))
            case _:
                raise ValueError(f"unknown fault {fault.name!r}")
        self._choose_path()

    def _unmute(self) -> None:
        self._muted = False

    def _stall(self, seconds: float | None) -> None:
        now = self._clock()
        if self._stalled_at is None:
            self._stalled_at = now
            self._motion.pause(now)
        if self._wake_timer is not None:
            self._wake_timer.cancel()
            self._wake_timer = None
        self._for("stall", seconds, self._end_stall)

    def _end_stall(self) -> None:
        if self._stalled_at is None:
            return
        now = self._clock()
        if self._running is None:
            self._due = now
            self._stalled_at = None
            self._start_next()
        else:
            self._due += now - self._stalled_at
            self._motion.resume(now)
            self._stalled_at = None
        self._advance(now)
        self._choose_path()

    def _fail(self) -> None:
        """Enter fault mode (Spark serial protocol, fault): motion ends, only reports still work."""
        self._motion.halt(self._clock())
        self._drop_commands()
        self._failed = True
        self._up(replies.FAULT)

    # -- timers

    def _for(self, name: str, seconds: float | None, end: Callable[[], None]) -> None:
        """Call ``end`` after ``seconds``; never when that is None."""
        self._cancel_timer(name)
        if seconds is not None:
            self._after(name, seconds, end)

    def _after(self, name: str, seconds: float, call: Callable[[], None]) -> None:
        def due() -> None:
            self._timers.pop(name, None)
            call()

        self._cancel_timer(name)
        self._timers[name] = self._loop.call_later(seconds, due)

    def _cancel_timer(self, name: str) -> None:
        timer = self._timers.pop(name, None)
        if timer is not None:
            timer.cancel()


def _is_command(line: bytes) -> bool:
    """Return whether a line would be counted as a command."""
    return bool(line.strip()) and line[:1] != b"?" and line != b"!" and line[:5] != b"fset "


def _problem(line: bytes) -> str | None:
    """Return what is wrong with a command, None when nothing is."""
    if line[:1] in (b"G", b"M"):
        known = _COMMAND.fullmatch(line) or _HOME.fullmatch(line)
        return None if known else "invalid command"
    word = line.split(None, 1)[0]
    if word == b"set":
        return None if _SET.fullmatch(line) else "invalid set"
    if line.rstrip() in (b"get", b"stat"):
        return None
    return "unknown command"
