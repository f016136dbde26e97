"""Queries and history against the naive reference, with restarts in between."""

import asyncio
import tempfile
from pathlib import Path

import pytest
import telemetry_reference as reference
from hypothesis import given, settings
from hypothesis import strategies as st

from toolpost.core.report import Report
from toolpost.telemetry import SampleGrid, Telemetry, store

NUMBER = st.one_of(st.integers(-1_000, 1_000), st.decimals(-50, 50, places=3).map(float))
VALUES = st.one_of(
    st.fixed_dictionaries({"x": NUMBER, "m.y": NUMBER}),
    st.fixed_dictionaries({"x": st.one_of(st.none(), NUMBER), "on": st.booleans()}),
    st.fixed_dictionaries({"x": st.sampled_from(["a", "b", "é"])}),
    st.fixed_dictionaries({"x": st.none(), "z": st.floats(allow_nan=False, allow_infinity=False)}),
    st.just({}),
)
# Gaps in 1/4 ms, so that rows fall on the edges of windows; 0 is for rows of one shape only.
GAP = st.integers(1, 40).map(lambda n: n * 250)
KEYS = ["a.x", "a.m.y", "a.on", "a.z", "b.x", "b.m.y", "b", "a", "a.", "c.x", ".x", "a.x"]
START_US = 1_735_689_600_000_000


@st.composite
def histories(draw):
    time_us = START_US
    parts = []
    for _ in range(draw(st.integers(1, 3))):
        part = []
        for _ in range(draw(st.integers(0, 25))):
            time_us += draw(GAP)
            part.append(Report(time_us, draw(st.sampled_from("ab")), draw(VALUES)))
        parts.append(part)
    return parts


@settings(max_examples=120, deadline=None)
@given(
    parts=histories(),
    rows=st.integers(1, 9),
    first=st.integers(-20, 400),
    step=st.sampled_from([0.0001, 0.00025, 0.001, 1 / 3000, 0.0025, 0.01, 0.1, 5.0, 1e30]),
    count=st.integers(1, 60),
)
def test_query_equals_reference(parts, rows, first, step, count):
    start = START_US / 1e6 + first * 0.001
    grid = SampleGrid.from_seconds(start, start + min(step, 10) * (count - 1), step)
    reports = [report for part in parts for report in part]

    async def run(directory):
        for part in parts:
            telemetry = Telemetry.open(directory)
            for report in part:
                telemetry.record("m", report)
            await telemetry.query("m", KEYS, grid)
            await telemetry.close()
        telemetry = Telemetry.open(directory)
        result = await telemetry.query("m", KEYS, grid)
        assert await telemetry.query("other", KEYS[:1], grid) == {"a.x": [None] * grid.count}
        histories = {tag: await telemetry.history("m", tag, 10_000) for tag in "ab"}
        latest = {tag: telemetry.latest("m", tag) for tag in "ab"}
        await telemetry.close()
        return result, histories, latest

    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as name:
        patch.setattr(store, "CHUNK_ROWS", rows)
        patch.setattr(store, "FRAME_REPORTS", 7)
        result, histories, latest = asyncio.run(run(Path(name)))
    expected = reference.sample(reports, KEYS, grid)
    assert result == expected
    assert {k: list(map(type, v)) for k, v in result.items()} == {
        key: [int if type(v) is float and v.is_integer() and abs(v) < 2**51 else type(v) for v in row]
        for key, row in expected.items()
    }
    for tag in "ab":
        wanted = [report for report in reversed(reports) if report.tag == tag]
        assert histories[tag] == wanted
        assert latest[tag] == (wanted[0] if wanted else None)


def feed(telemetry, count, first=0, values=None, tag="t", step=10_000):
    for n in range(first, first + count):
        made = {"n": n, "x": n / 1000} if values is None else values(n)
        telemetry.record("m", Report(START_US + n * step, tag, made))


def test_latest_ten_thousand_after_a_restart(tmp_path):
    async def run():
        telemetry = Telemetry.open(tmp_path)
        for part in range(5):
            feed(telemetry, 4_000, part * 4_000)
            await telemetry.history("m", "t", 300)
        before = await telemetry.history("m", "t", 10_000)
        await telemetry.close()
        telemetry = Telemetry.open(tmp_path)
        after = await telemetry.history("m", "t", 10_000)
        few = await telemetry.history("m", "t", 3)
        await telemetry.close()
        return before, after, few

    before, after, few = asyncio.run(run())
    assert [r.values["n"] for r in after] == list(range(19_999, 9_999, -1))
    assert before == after
    assert few == after[:3]


def test_history_from_the_ring_is_immediate(tmp_path):
    async def run():
        telemetry = Telemetry.open(tmp_path)
        assert telemetry.latest("m", "t") is None
        assert await telemetry.history("m", "t", 5) == []
        feed(telemetry, 10)
        assert telemetry.latest("m", "t").values["n"] == 9
        thread, telemetry._thread = telemetry._thread, None  # a hop would fail
        assert len(await telemetry.history("m", "t", 10_000)) == 10
        assert [r.values["n"] for r in await telemetry.history("m", "t", 2)] == [9, 8]
        telemetry._thread = thread
        for count, text in ((0, "count: must be > 0"), (10_001, "count: too big")):
            with pytest.raises(ValueError, match=text):
                await telemetry.history("m", "t", count)
        await telemetry.close()

    asyncio.run(run())


def test_large_grid_over_chunks_and_tail(tmp_path):
    reports = [
        Report(START_US + n * 10_000 + n % 7, "t", {"n": n, "on": n % 5 == 0, "s": "ab"[n // 5000]})
        for n in range(9_900)
    ]
    grid = SampleGrid.from_seconds(START_US / 1e6, START_US / 1e6 + 99, 0.011)

    async def run():
        telemetry = Telemetry.open(tmp_path)
        for report in reports:
            telemetry.record("m", report)
        result = await telemetry.query("m", ["t.n", "t.on", "t.s"], grid)
        await telemetry.close()
        return result

    result = asyncio.run(run())
    for at, n, on, s in zip(grid.times_us(), *result.values(), strict=True):
        row = (at - START_US) // 10_000
        near = [r for r in reports[max(0, row - 2) : row + 1] if at - 11_000 <= r.time_us <= at]
        expected = near[-1] if near else None
        assert (n, on, s) == (tuple(expected.values.values()) if expected else (None,) * 3)


def test_reports_of_one_moment_keep_their_order(tmp_path):
    async def run():
        telemetry = Telemetry.open(tmp_path)
        for n in range(6):
            values = {"n": n} if n % 2 else {"n": n, "odd": False}
            telemetry.record("m", Report(START_US, "t", values))
        await telemetry.close()
        telemetry = Telemetry.open(tmp_path)
        reports = await telemetry.history("m", "t", 10)
        await telemetry.close()
        return reports

    reports = asyncio.run(run())
    assert [r.values["n"] for r in reports] == [5, 4, 3, 2, 1, 0]
    assert all(0 <= r.time_us - START_US < 6 for r in reports)


def test_strange_values_are_stored_as_what_can_be_sent(tmp_path):
    strange = [float("nan"), float("inf"), 10**400, None, 2**60, 1.5]

    async def run():
        telemetry = Telemetry.open(tmp_path)
        for n, value in enumerate(strange):
            values = {"v": value, "s": "x" * 1_000 if n else "\ud800"}
            telemetry.record("m", Report(START_US + n, "t", values))
        await telemetry.close()
        telemetry = Telemetry.open(tmp_path)
        reports = await telemetry.history("m", "t", 10)
        await telemetry.close()
        return [list(r.values.values()) for r in reversed(reports)]

    long = "x" * 256
    assert asyncio.run(run()) == [
        [None, "?"],
        [None, long],
        [None, long],
        [None, long],
        [2**60, long],
        [1.5, long],
    ]
