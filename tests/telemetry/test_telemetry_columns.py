import io
import math
from array import array

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolpost.telemetry import columns as col

NUMBERS = st.one_of(
    st.integers(-(2**50), 2**50).map(float),
    st.floats(),
    st.decimals(-10_000, 10_000, places=3).map(float),
    st.floats(width=32),
)


def unpack(data, columns):
    source = io.BytesIO(data)
    return col.PackedRows(source, col.Head(source, columns))


def round_trip(kind, items):
    times = array("q", range(5, 5 + len(items)))
    rows = unpack(col.pack(times, kind, [items]), 1)
    assert rows.rows == len(items)
    assert rows.first_us == 5
    column = rows.column(0)
    values = column.values(0, len(items))
    some = list(range(0, len(items), 3))
    assert column.pick(col.picker(some), len(some)) == [values[n] for n in some]
    return values


@given(st.lists(NUMBERS, min_size=1, max_size=100))
def test_numbers_come_back_exactly(items):
    values = round_trip(col.NUM, array("d", items))
    assert values == [item if math.isfinite(item) else None for item in items]


@given(st.integers(0, 6), st.lists(st.integers(-(10**9), 10**9), min_size=1, max_size=300))
def test_decimals_are_packed_as_integers(scale, integers):
    items = array("d", [number / 10**scale for number in integers])
    data = col.pack(array("q", range(len(items))), col.NUM, [items])
    assert len(data) <= col.header_size(1) + 8 * len(items)
    assert unpack(data, 1).column(0).values(0, len(items)) == list(items)


def test_whole_numbers_are_integers_and_others_floats():
    for items in ([100.0, 0.1], [100.0, 1e-20], [100.0, math.pi], [100.0, math.nan]):
        values = round_trip(col.NUM, array("d", items))
        assert type(values[0]) is int
        assert type(values[1]) is not int
    assert col.restore_floats(array("d", [100, 0.5, math.inf])) == [100, 0.5, None]


@pytest.mark.parametrize(
    ("items", "size"),
    [
        ([7.25] * 1_000, 0),
        ([0.001 * n for n in range(250)], 1),
        ([20 + n / 1_000 for n in range(1_000)], 2),
        ([float(n * n) for n in range(1_000)], 4),
        ([1.0 / 3] * 7 + [math.pi], 8),
        ([2.0**-20, 3 * 2.0**-21], 4),
    ],
)
def test_width(items, size):
    items = [round(item, 3) if size < 4 else item for item in items]
    data = col.pack(array("q", range(len(items))), col.NUM, [array("d", items)])
    assert len(data) == col.header_size(1) + (4 + size) * len(items)


@given(st.lists(st.booleans(), min_size=1, max_size=50))
def test_bools(items):
    values = round_trip(col.BOOL, bytearray(items))
    assert values == items
    assert all(type(value) is bool for value in values)


@given(st.lists(st.text(st.characters(codec="utf-8"), max_size=5), min_size=1, max_size=400))
def test_texts(items):
    assert round_trip(col.TEXT, items) == items


def test_many_texts():
    items = [str(n) for n in range(70_000)]
    assert round_trip(col.TEXT, items) == items


def test_nulls():
    rows = unpack(col.pack(array("q", [1, 2]), col.NULL, [None]), 1)
    assert rows.column(0).values(0, 2) == [None, None]


@given(st.lists(st.integers(0, 2**61), min_size=1, max_size=50).map(sorted))
def test_times(times):
    rows = unpack(col.pack(array("q", times), "", []), 0)
    assert [rows.first_us + offset for offset in rows.offsets] == times
