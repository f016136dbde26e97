"""Sorts incoming reports: which shape a report belongs to, and whether its time is usable."""

from collections.abc import Iterator

from toolpost.core.report import Report, Value
from toolpost.telemetry import columns as col
from toolpost.telemetry.limits import Limits
from toolpost.telemetry.shape import Shape, ShapeDef

STEP_BACK_US = 5_000_000
"""A clock that steps back by less than this makes reports wait until it has caught up."""

_MAX_TIME_US = 1 << 62
_KINDS = {int: col.NUM, float: col.NUM, bool: col.BOOL, str: col.TEXT, type(None): col.NULL}
_MAX_LOOKUPS = 1_024


class TagState:
    """What is known of one tag of one machine.

    Attributes:
        epoch: number that grows whenever the clock steps back by `STEP_BACK_US` or more.
        shapes: the shapes of the tag.
    """

    __slots__ = ("_last_row_us", "_last_shape", "_last_us", "_lookups", "epoch", "shapes")

    def __init__(self) -> None:
        self.epoch = 0
        self.shapes: list[Shape] = []
        self._last_us = -1
        self._last_row_us = -1
        self._last_shape: Shape | None = None
        self._lookups: dict[tuple[tuple[str, ...], tuple[type, ...]], Shape | None] = {}

    def adopt(self, shape: Shape) -> None:
        """Take in a shape that was read from disk, with its latest time."""
        self.shapes.append(shape)
        ends = [(run.epoch, run.lasts[-1]) for run in shape.runs if run.ids]
        if shape.times:
            ends.append((shape.epoch, shape.times[-1]))
        for epoch, last_us in ends:
            if (epoch, last_us) > (self.epoch, self._last_us):
                self.epoch, self._last_shape = epoch, shape
                self._last_us = self._last_row_us = last_us

    def steps_back(self, time_us: int) -> bool:
        """Say whether a report's time needs a new epoch."""
        return self._last_us - time_us >= STEP_BACK_US

    def new_epoch(self) -> None:
        """Accept a clock that was set back."""
        self.epoch += 1
        self._last_us = self._last_row_us = -1

    def row_time(self, time_us: int, shape: Shape) -> int | None:
        """Return the time under which a row is stored, or None if it has to be dropped.

        Rows of different shapes never have the same time, so that merged shapes have one order:
        the later one is moved by a microsecond.
        """
        if time_us < self._last_us:
            return None
        self._last_us = time_us
        earliest = self._last_row_us + (shape is not self._last_shape)
        self._last_row_us = max(time_us, earliest)
        self._last_shape = shape
        return self._last_row_us

    def find(self, values: dict[str, Value]) -> Shape | None:
        """Return the shape for a report's values, or None if there is none yet."""
        signature = (tuple(values), tuple(map(type, values.values())))
        shape = self._lookups.get(signature)
        if shape is None:
            shape = self._search(*signature)
            if shape is not None:
                if len(self._lookups) >= _MAX_LOOKUPS:
                    self._lookups.clear()
                self._lookups[signature] = shape
        return shape

    def _search(self, keys: tuple[str, ...], types: tuple[type, ...]) -> Shape | None:
        kinds = [_KINDS.get(kind) for kind in types]
        for shape in self.shapes:
            if shape.definition.keys == keys and all(
                kind == there or (kind == col.NULL and there == col.NUM)
                for kind, there in zip(kinds, shape.definition.kinds, strict=True)
            ):
                return shape
        return None


class Intake:
    """Finds or makes the shape of every report.

    Args:
        limits: the bounds of tags, shapes, keys and names.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._tags: dict[str, dict[str, TagState]] = {}
        self._next_shape = 1

    def adopt(self, shape: Shape) -> None:
        """Take in a shape that was read from disk."""
        machine, tag = shape.definition.machine, shape.definition.tag
        self._tags.setdefault(machine, {}).setdefault(tag, TagState()).adopt(shape)
        self.reserve(shape.number)

    def reserve(self, shape_number: int) -> None:
        """Never give this number to a new shape."""
        self._next_shape = max(self._next_shape, shape_number + 1)

    def shapes_of(self, machine: str, tag: str) -> list[Shape]:
        """Return the shapes of a tag; none if it is unknown."""
        state = self._tags.get(machine, {}).get(tag)
        return state.shapes if state else []

    def tags(self) -> Iterator[tuple[str, str]]:
        """Yield machine and tag of everything known."""
        for machine, tags in self._tags.items():
            for tag in tags:
                yield machine, tag

    def state(self, machine: str, tag: str) -> TagState | None:
        """Return the state of a tag, made if need be; None if there are too many tags."""
        tags = self._tags.get(machine)
        if tags is None:
            tags = self._tags[machine] = {}
        state = tags.get(tag)
        if state is None:
            if len(tags) >= self._limits.tags_per_machine or not self._is_name(tag):
                return None
            state = tags[tag] = TagState()
        return state

    def new_shape(self, machine: str, report: Report, state: TagState) -> Shape | None:
        """Make the shape of a report; None if it is beyond a limit."""
        limits, values = self._limits, report.values
        kinds = [_KINDS.get(type(value), "") for value in values.values()]
        if (
            len(state.shapes) >= limits.shapes_per_tag
            or len(values) > limits.keys_per_report
            or not all(kinds)
            or not all(map(self._is_name, values))
        ):
            return None
        definition = ShapeDef(machine, report.tag, tuple(values), "".join(kinds))
        shape = Shape(self._next_shape, definition)
        self._next_shape += 1
        state.shapes.append(shape)
        return shape

    def _is_name(self, name: object) -> bool:
        """Say whether a tag or key can be stored: bounded, and with a UTF-8 form."""
        if not isinstance(name, str) or len(name) > self._limits.name_chars:
            return False
        try:
            name.encode()
        except UnicodeEncodeError:
            return False
        return True


def is_time(time_us: int) -> bool:
    """Say whether a time can be stored."""
    return 0 <= time_us < _MAX_TIME_US
