"""A machine's report of its state: what Spark calls a p-state."""

import math
from typing import TypeAlias

import msgspec

Value: TypeAlias = bool | int | float | str | None
"""One reported value. ``None`` stands for a number that is not finite: JSON has no word for it."""


class Report(msgspec.Struct, frozen=True, gc=False):
    """One report of a machine: a tag and a flat map, with the time of its reception.

    Attributes:
        time_us: Unix time of reception, whole microseconds.
        tag: what the report is about, e.g. ``pos`` or ``queue``.
        values: flat key to value, in the order in which the machine sent them.
    """

    time_us: int
    tag: str
    values: dict[str, Value]


def number(value: Value) -> float | None:
    """Return ``value`` if it is a finite number, otherwise None. Booleans are no numbers here."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return None
    return value
