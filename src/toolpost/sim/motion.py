"""Where a simulated machine's axes are, during and after its moves."""

import math
import re
from collections.abc import Mapping

AXES = ("x", "y", "z", "c")
"""Axis names in the order of every position; x, y and z in mm, c in degrees."""

SYSTEMS = {
    b"G53": "machine",
    b"G54": "grinder",
    b"G55": "work",
    b"G56": "toolsupply",
}
"""The coordinate system that each command selects."""

PREFIX = {"machine": "m", "grinder": "g", "work": "w", "toolsupply": "t"}
"""The letter of each coordinate system in ``pos`` reports and ``cs.`` settings."""

RAPID_FEED = 1200.0
"""Speed of G0, mm/min."""

DEFAULT_FEED = 60.0
"""Speed of G1 until a command gives one with F, mm/min."""

_PLAIN = rb"[-+]?+[0-9]{1,6}+(?:\.[0-9]{0,6}+)?+"
RUN = re.compile(
    rb"(?:(?:G[01](?: [A-Z]%b){1,7}+|M[0-9]{1,3}+(?: [ABDEG-W]%b){0,6}+)\n)++" % (_PLAIN, _PLAIN)
)
"""Consecutive plain G0, G1 and M lines, each well within the firmware's line buffer. An M line in
a run has no axis words, so that the last X of the run is where the x axis ends."""

Position = tuple[float, float, float, float]

_WORD = re.compile(rb"([A-Z])\s*([-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+))")
_CODE = re.compile(rb"([GM])0*([0-9]+(?:\.[0-9])?)")
_NUMBER = re.compile(rb"[-+]?[0-9]+(?:\.[0-9]*)?")
_LETTERS = tuple(axis.upper().encode() for axis in AXES)


class Motion:
    """The axes: a position, and while a move runs its start, target and times.

    Positions given in commands are absolute, in the selected coordinate system.

    Args:
        settings: the machine's settings; ``cs.<letter>.<axis>`` are the origins of the
            coordinate systems, in machine coordinates.

    Attributes:
        system: the selected coordinate system, a value of ``SYSTEMS``.
        feed: speed of G1, mm/min.
    """

    def __init__(self, settings: Mapping[str, float]) -> None:
        self._settings = settings
        self.system = "machine"
        self.feed = DEFAULT_FEED
        self._start: Position = (0.0, 0.0, 0.0, 0.0)
        self._target = self._start
        self._began = 0.0
        self._ends = 0.0
        self._paused_at: float | None = None

    def position(self, now: float) -> Position:
        """Return the machine position at the time ``now`` (seconds, as given to ``begin``)."""
        if self._paused_at is not None:
            now = self._paused_at
        if now >= self._ends:
            return self._target
        done = max(0.0, (now - self._began) / (self._ends - self._began))
        x, y, z, c = (a + (b - a) * done for a, b in zip(self._start, self._target, strict=True))
        return x, y, z, c

    def local(self, position: Position) -> Position:
        """Return a machine position in the selected coordinate system."""
        x, y, z, c = (value - self._origin(axis) for axis, value in zip(AXES, position, strict=True))
        return x, y, z, c

    def begin(self, line: bytes, now: float) -> float:
        """Start the move, homing or mode change of a command; return the length of its path.

        Args:
            line: a command; one that moves nothing only ends the move before it.
            now: when it starts, seconds.

        Returns:
            The distance in mm (or degrees if only c turns); 0 without a move. The move is done
            at once until ``last`` tells how long it takes.
        """
        self._start = self._target
        self._began = self._ends = now
        code = _CODE.match(line)
        head = code[1] + code[2] if code else b""
        if head in SYSTEMS:
            self.system = SYSTEMS[head]
        elif head == b"G28":
            named = [letter for letter in _LETTERS if letter in line]
            self._move(dict.fromkeys(named or _LETTERS, 0.0), 0)
        elif head in (b"G0", b"G1") or head.startswith(b"G38."):
            words = _words(line)
            self.feed = words.get(b"F", 0.0) or self.feed
            self._move(words, 1)
        linear = math.dist(self._start[:3], self._target[:3])
        return linear or abs(self._target[3] - self._start[3])

    def last(self, seconds: float) -> None:
        """Set how long the move that ``begin`` started takes."""
        self._ends = self._began + seconds

    def halt(self, now: float) -> None:
        """Stop where the axes are at ``now``."""
        self._target = self.position(now)
        self._ends = now
        self._paused_at = None

    def pause(self, now: float) -> None:
        """Stand still from ``now`` on, in the middle of a move if need be."""
        self._paused_at = now

    def resume(self, now: float) -> None:
        """Go on after ``pause``; what was left of the move then is still left."""
        if self._paused_at is not None:
            late = now - self._paused_at
            self._began += late
            self._ends += late
            self._paused_at = None

    def run(self, lines: bytes, start: int, stop: int) -> None:
        """Carry out at once what ``RUN`` matched in ``lines[start:stop]``.

        The last word of each axis decides, so that nothing else is parsed.
        """
        target = list(self._target)
        for index, letter in enumerate(_LETTERS):
            at = lines.rfind(letter, start, stop)
            number = _NUMBER.match(lines, at + 1) if at >= 0 else None
            if number:
                target[index] = float(number[0]) + self._origin(AXES[index])
        at = lines.rfind(b"F", start, stop)
        number = _NUMBER.match(lines, at + 1) if at >= 0 else None
        if number:
            self.feed = float(number[0]) or self.feed
        x, y, z, c = target
        self._start = self._target = (x, y, z, c)
        self._began = self._ends = 0.0

    def _origin(self, axis: str) -> float:
        return self._settings.get(f"cs.{PREFIX[self.system]}.{axis}", 0.0)

    def _move(self, words: Mapping[bytes, float], local: int) -> None:
        """Set the target from axis words; ``local`` 1 for the selected system, 0 for machine."""
        x, y, z, c = (
            words[letter] + local * self._origin(axis) if letter in words else old
            for letter, axis, old in zip(_LETTERS, AXES, self._start, strict=True)
        )
        self._target = (x, y, z, c)


def _words(line: bytes) -> dict[bytes, float]:
    """Return a command's words by their letters; the last of a letter counts."""
    return {match[1]: float(match[2]) for match in _WORD.finditer(line, 1)}
