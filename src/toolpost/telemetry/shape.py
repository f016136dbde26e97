"""A shape: the reports of one tag that have the same keys and kinds, and its rows in RAM."""

import math
from array import array
from bisect import bisect_left
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from toolpost.core.report import Value
from toolpost.telemetry import columns as col


class ShapeDef(msgspec.Struct, frozen=True, array_like=True):
    """What makes a shape; ``kinds`` has one letter of `columns` per key."""

    machine: str
    tag: str
    keys: tuple[str, ...]
    kinds: str


class Run:
    """The chunks of a shape in one epoch: their times ascend and do not overlap.

    Attributes:
        epoch: number that grows whenever the clock of a tag steps back.
        firsts: time of each chunk's first row, Unix microseconds.
        lasts: time of each chunk's last row, Unix microseconds.
        ids: the chunks' numbers, ascending.
    """

    __slots__ = ("epoch", "firsts", "ids", "lasts")

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch
        self.firsts = array("q")
        self.lasts = array("q")
        self.ids = array("q")

    def add(self, chunk: int, first_us: int, last_us: int) -> None:
        """Append a chunk."""
        self.ids.append(chunk)
        self.firsts.append(first_us)
        self.lasts.append(last_us)

    def remove(self, chunk: int) -> None:
        """Forget a chunk, if it is there."""
        place = bisect_left(self.ids, chunk)
        if place < len(self.ids) and self.ids[place] == chunk:
            del self.ids[place], self.firsts[place], self.lasts[place]


class Shape:
    """One shape with the rows that are not sealed yet, its *tail*.

    Attributes:
        number: the shape's number in the store.
        definition: machine, tag, keys and kinds.
        sealed: rows that are in chunks, or were; the tail's first row has this number.
        stored: whether the definition is in the database.
        epoch: the epoch of the tail's rows.
        times: the tail's times, ascending Unix microseconds.
        columns: the tail's columns.
        runs: the sealed chunks by epoch, ascending.
    """

    __slots__ = (
        "_words",
        "columns",
        "definition",
        "epoch",
        "number",
        "places",
        "runs",
        "sealed",
        "stored",
        "texts_weight",
        "times",
    )

    def __init__(self, number: int, definition: ShapeDef) -> None:
        self.number = number
        self.definition = definition
        self.places = {key: place for place, key in enumerate(definition.keys)}
        self.sealed = 0
        self.stored = False
        self.epoch = 0
        self.runs: list[Run] = []
        self.clear()

    def clear(self) -> None:
        """Empty the tail."""
        self.times = array("q")
        self.columns: list[col.ColumnData] = [_empty(kind) for kind in self.definition.kinds]
        self.texts_weight = 0
        self._words: dict[str, str] = {}

    @property
    def weight(self) -> int:
        """About as many bytes as the tail takes in the journal and in RAM."""
        return len(self.times) * (9 + 9 * len(self.columns)) + self.texts_weight

    def run(self, epoch: int) -> Run:
        """Return the run of ``epoch``, which is the last one or a new one."""
        if not self.runs or self.runs[-1].epoch != epoch:
            self.runs.append(Run(epoch))
        return self.runs[-1]

    def extend(self, times: Sequence[int], columns: Sequence[Sequence[Any]]) -> None:
        """Append rows to the tail.

        Args:
            times: Unix microseconds, ascending and not before the tail's last.
            columns: from `clean`, one sequence per key.
        """
        for data, items in zip(self.columns, columns, strict=True):
            if data is None:
                continue
            if isinstance(data, list):
                data.extend(map(self._words.setdefault, items, items))
                self.texts_weight += sum(map(len, items))
            else:
                data.extend(items)
        self.times.extend(times)

    def listed_columns(self) -> list[list[Any]]:
        """Return the tail's columns in the form that `extend` takes."""
        return [[] if column is None else list(column) for column in self.columns]

    def clean(self, rows: Sequence[tuple[Value, ...]], text_chars: int) -> list[Sequence[Any]]:
        """Turn reports' values into columns that a tail, a chunk and the journal can hold."""
        return [
            _CLEANERS[kind](items, text_chars)
            for kind, items in zip(self.definition.kinds, zip(*rows, strict=True), strict=True)
        ]


def _empty(kind: str) -> col.ColumnData:
    if kind == col.NUM:
        return array("d")
    if kind == col.BOOL:
        return bytearray()
    return [] if kind == col.TEXT else None


def _clean_numbers(items: Sequence[Any], _: int) -> Sequence[Any]:
    try:
        array("d", items)
    except (TypeError, OverflowError):
        return [_as_float(item) for item in items]
    return items


def _as_float(item: float | None) -> float:
    """Return the float that stands for ``item``: NaN for null and for what no float can hold."""
    try:
        return math.nan if item is None else float(item)
    except OverflowError:
        return math.nan


def _clean_texts(items: Sequence[Any], text_chars: int) -> Sequence[Any]:
    if max(map(len, items)) > text_chars:
        items = [item[:text_chars] for item in items]
    if not all(map(str.isascii, items)):
        # A lone surrogate has no UTF-8 form, and the journal and the chunks hold UTF-8.
        items = [item.encode(errors="replace").decode() for item in items]
    return items


def _clean_bools(items: Sequence[Any], _: int) -> Sequence[Any]:
    return items


def _clean_nulls(_: Sequence[Any], __: int) -> Sequence[Any]:
    return ()


_CLEANERS: dict[str, Callable[[Sequence[Any], int], Sequence[Any]]] = {
    col.NUM: _clean_numbers,
    col.BOOL: _clean_bools,
    col.TEXT: _clean_texts,
    col.NULL: _clean_nulls,
}
