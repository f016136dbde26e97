"""Packs the columns of a chunk so that any row can be read without decoding the others.

A packed chunk is ``rows:u32``, one 16-byte entry for the times and one per column, then the
columns' bytes back to back. All integers are little-endian, as are the hosts that run this.

=======  =========================================================================
entry    column
=======  =========================================================================
SCALED   unsigned integers ``u`` of 0, 1, 2, 4 or 8 bytes; value ``(base + u) / 10**scale``
FLOAT    float32 or float64; a value that is not finite stands for null
BOOL     one byte each; width 0: all are ``base``
TEXT     indices of 0, 1, 2 or 4 bytes, then a MessagePack list of ``base`` bytes
NULL     nothing
=======  =========================================================================
"""

import math
import struct
from array import array
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import repeat
from operator import itemgetter, truediv
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias

import msgspec

from toolpost.core.report import Value

NUM, BOOL, TEXT, NULL = "nbs-"
"""The kinds of a shape's columns."""

ColumnData: TypeAlias = "array[float] | bytearray | list[str] | None"
"""A column as it collects in RAM: numbers, bools, texts; None for a column of nulls."""

_SCALED, _FLOAT, _BOOL, _TEXT, _NULL = range(5)
_ENTRY = struct.Struct("<BBBxIq")  # encoding, width, scale, offset, base
_ROWS = struct.Struct("<I")
_START = struct.Struct("<IBBBxIq")  # rows, then the entry of the times
_Code: TypeAlias = Literal["B", "H", "I", "Q"]
_CODES: dict[int, _Code] = {1: "B", 2: "H", 4: "I", 8: "Q"}
_MAX_SCALE = 6
_EXACT = 2**51
"""Below this, ``round(v * 10**k)`` of a decimal float is the integer that was meant."""
_PROBE = 64
"""Rows tried first for a scale, so that a scale that does not fit costs little."""


class Entry(NamedTuple):
    """Where and how one column is packed. ``base`` depends on the encoding."""

    encoding: int
    width: int
    scale: int
    offset: int
    base: int


class Column(NamedTuple):
    """One column of a chunk or of a tail, ready to be read at any row.

    Attributes:
        source: raw items by row, or None if every row has the value ``constant``.
        restore: turns raw items into values.
        constant: the value of every row if there is no source.
    """

    source: Any
    restore: Callable[[Iterable[Any]], list[Value]]
    constant: Value = None

    def pick(self, getter: Callable[[Any], Sequence[Any]], count: int) -> list[Value]:
        """Return the values of the ``count`` rows that ``getter`` (see `picker`) takes."""
        if self.source is None:
            return [self.constant] * count
        return self.restore(getter(self.source))

    def values(self, start: int, stop: int) -> list[Value]:
        """Return the values of the rows ``start`` to ``stop`` (excluded)."""
        if self.source is None:
            return [self.constant] * (stop - start)
        return self.restore(self.source[start:stop])


def picker(rows: Sequence[int]) -> Callable[[Any], Sequence[Any]]:
    """Return a function that takes the items at ``rows`` (at least one) out of a sequence."""
    if len(rows) == 1:
        row = rows[0]
        return lambda source: (source[row],)
    return itemgetter(*rows)


def pack(times: "array[int]", kinds: str, columns: Sequence[ColumnData]) -> bytes:
    """Pack the rows of a tail.

    Args:
        times: ascending Unix microseconds, at least one.
        kinds: one of `NUM`, `BOOL`, `TEXT`, `NULL` per column.
        columns: as many items each as ``times``, except for columns of nulls.
    """
    first = times[0]
    wide = times[-1] - first >= 1 << 32
    offsets = array("Q" if wide else "I", [time - first for time in times])
    packed = [(Entry(_SCALED, offsets.itemsize, 0, 0, first), offsets.tobytes())]
    packed.extend(_pack_column(column) for _, column in zip(kinds, columns, strict=True))
    at = _ROWS.size + _ENTRY.size * len(packed)
    head = [_ROWS.pack(len(times))]
    for entry, data in packed:
        head.append(_ENTRY.pack(*entry._replace(offset=at)))
        at += len(data)
    return b"".join(head) + b"".join(data for _, data in packed)


def _pack_column(column: ColumnData) -> tuple[Entry, bytes]:
    if column is None:
        return Entry(_NULL, 0, 0, 0, 0), b""
    if isinstance(column, array):
        return _pack_numbers(column)
    if isinstance(column, bytearray):
        if column.count(column[0]) == len(column):
            return Entry(_BOOL, 0, 0, 0, column[0]), b""
        return Entry(_BOOL, 1, 0, 0, 0), bytes(column)
    places: dict[str, int] = {}
    indices = [places.setdefault(text, len(places)) for text in column]
    width = _width(len(places) - 1)
    words = msgspec.msgpack.encode(list(places))
    data = array(_CODES[width], indices).tobytes() if width else b""
    return Entry(_TEXT, width, 0, 0, len(words)), data + words


def _pack_numbers(column: "array[float]") -> tuple[Entry, bytes]:
    scaled = _scaled(column)
    if scaled is not None:
        scale, integers = scaled
        base = min(integers)
        width = _width(max(integers) - base)
        if not width:
            return Entry(_SCALED, 0, scale, 0, base), b""
        data = array(_CODES[width], [integer - base for integer in integers])
        return Entry(_SCALED, width, scale, 0, base), data.tobytes()
    single = array("f", column)
    if array("d", single) == column:
        return Entry(_FLOAT, 4, 0, 0, 0), single.tobytes()
    return Entry(_FLOAT, 8, 0, 0, 0), column.tobytes()


def _scaled(column: "array[float]") -> tuple[int, list[int]] | None:
    """Return the smallest decimal scale and integers that restore every value, or None."""
    if not math.isfinite(sum(column)):  # also skips sums that overflow: those are no decimals
        return None
    low, high = min(column), max(column)
    if low == high:
        column = column[:1]
    probe = column[:_PROBE]
    for scale in range(_MAX_SCALE + 1):
        factor = 10**scale
        if max(-low, high) * factor >= _EXACT:
            return None
        if _integers(probe, factor) is None:
            continue
        integers = _integers(column, factor)
        if integers is not None:
            return scale, integers
    return None


def _integers(column: "array[float]", factor: int) -> list[int] | None:
    integers = [round(value * factor) for value in column]
    restored = array("d", map(truediv, integers, repeat(factor)))
    return integers if restored == column else None


def _width(span: int) -> int:
    """Return the bytes of the narrowest unsigned integer for 0 to ``span``."""
    if not span:
        return 0
    return next(width for width in _CODES if span < 1 << 8 * width)


def header_size(columns: int) -> int:
    """Return the bytes before the first column of a chunk with this many columns."""
    return _ROWS.size + _ENTRY.size * (columns + 1)


class Source(Protocol):
    """Bytes that are read in parts: a blob, or a file."""

    def read(self, length: int, /) -> bytes:
        """Return the next ``length`` bytes."""
        ...

    def seek(self, offset: int, /) -> object:
        """Go to an offset."""
        ...


class Head:
    """The part of a chunk that every query needs. It is worth keeping.

    Args:
        source: the chunk, at its beginning.
        columns: number of columns, the times not counted.

    Attributes:
        entries: the bytes that describe the columns.
        rows: number of rows.
        first_us: time of the first row, Unix microseconds.
        offsets: the rows' times, microseconds after ``first_us``, ascending.
    """

    __slots__ = ("entries", "first_us", "offsets", "rows")

    def __init__(self, source: Source, columns: int) -> None:
        self.entries = source.read(header_size(columns))
        self.rows: int
        self.first_us: int
        self.rows, _, width, _, _, self.first_us = _START.unpack_from(self.entries)
        self.offsets = array(_CODES[width])
        self.offsets.frombytes(source.read(self.rows * width))


class PackedRows:
    """A packed chunk of which only what is asked for is read.

    Args:
        source: the chunk.
        head: its head.
    """

    __slots__ = ("_entries", "_source", "first_us", "offsets", "rows")

    def __init__(self, source: Source, head: Head) -> None:
        self._source = source
        self._entries = head.entries
        self.rows = head.rows
        self.first_us = head.first_us
        self.offsets = head.offsets

    def _read(self, start: int, stop: int) -> bytes:
        self._source.seek(start)
        return self._source.read(stop - start)

    def column(self, place: int) -> Column:
        """Return the column at ``place``, counted from 0."""
        entry = Entry._make(_ENTRY.unpack_from(self._entries, _START.size + _ENTRY.size * place))
        end = entry.offset + self.rows * entry.width
        if entry.encoding == _NULL:
            return Column(None, list)
        if entry.encoding == _TEXT:
            data = self._read(entry.offset, end + entry.base)
            words = msgspec.msgpack.decode(data[end - entry.offset :], type=list[str])
            if not entry.width:
                return Column(None, list, words[0])
            indices = memoryview(data)[: end - entry.offset].cast(_CODES[entry.width])
            return Column(indices, partial(_restore_texts, words))
        if not entry.width:
            if entry.encoding == _BOOL:
                return Column(None, list, bool(entry.base))
            return Column(None, list, _restore_scaled(entry.base, 10**entry.scale, (0,))[0])
        data = self._read(entry.offset, end)
        if entry.encoding == _BOOL:
            return Column(data, restore_bools)
        if entry.encoding == _FLOAT:
            return Column(memoryview(data).cast("f" if entry.width == 4 else "d"), restore_floats)
        source = memoryview(data).cast(_CODES[entry.width])
        return Column(source, partial(_restore_scaled, entry.base, 10**entry.scale))


def _restore_texts(words: list[str], raw: Iterable[int]) -> list[Value]:
    return [words[index] for index in raw]


def _restore_scaled(base: int, factor: int, raw: Iterable[int]) -> list[Value]:
    if factor == 1:
        return [base + item for item in raw]
    return [number / factor if (number := base + item) % factor else number // factor for item in raw]


def restore_bools(raw: Iterable[int]) -> list[Value]:
    """Turn bytes into bools."""
    return [item == 1 for item in raw]


def restore_floats(raw: Iterable[float]) -> list[Value]:
    """Turn floats into values: null if not finite, whole numbers as integers."""
    return [
        (int(item) if item.is_integer() and -_EXACT < item < _EXACT else item)
        if math.isfinite(item)
        else None
        for item in raw
    ]


def live_column(data: ColumnData) -> Column:
    """Return the column of a tail."""
    if data is None:
        return Column(None, list)
    if isinstance(data, array):
        return Column(data, restore_floats)
    if isinstance(data, bytearray):
        return Column(data, restore_bools)
    return Column(data, list)
