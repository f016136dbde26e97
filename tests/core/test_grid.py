import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolpost.telemetry import SampleGrid


@pytest.mark.parametrize(
    ("start", "end", "step", "text"),
    [
        (-1, 1, 1, "start: must be >= 0"),
        (1, -1, 1, "end: must be >= 0"),
        (2, 1, 1, "end: must be >= start"),
        (1, 2, 0, "step: must be > 0"),
        (1, 2, -1, "step: must be > 0"),
        (0, 10_001, 1, "too many steps"),
        (0, 1e300, 1e-300, "too many steps"),
        (0, 1, 5e-324, "too many steps"),
        (math.nan, 1, 1, "start: must be finite"),
        (0, math.inf, 1, "end: must be finite"),
        (0, 1, math.nan, "step: must be finite"),
        (0, 1, math.inf, "step: must be finite"),
    ],
)
def test_refuses(start, end, step, text):
    with pytest.raises(ValueError) as caught:
        SampleGrid.from_seconds(start, end, step)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("start", "end", "step", "count"),
    [
        (1000, 1000, 1e-10, 1),
        (1735689600.1, 1735689600.1, 1e-10, 1),
        (0, 0, 5e-324, 1),
        (1000, 1001, 1e30, 1),
        (1000, 1000.5, 0.1, 6),
        (1735689600, 1735689601, 0.3, 4),
        (0, 0.3, 0.1, 4),
        (1735689600.1, 1735689600.7, 0.2, 4),
        (1735689600.123, 1735689601.123, 0.001, 1001),
        (0, 10_000, 1, 10_001),
        (0, 0.9999, 1, 1),
        (1e300, 1e300, 1, 1),
        (1.7e308, 1.7e308, 1, 1),
    ],
)
def test_number_of_samples(start, end, step, count):
    grid = SampleGrid.from_seconds(start, end, step)
    assert grid.count == count
    assert len(grid.times_us()) == len(grid.seconds()) == count
    assert grid.seconds()[0] == pytest.approx(start, abs=1e-6)


def test_limit_is_the_callers():
    with pytest.raises(ValueError, match="too many steps"):
        SampleGrid.from_seconds(0, 10, 1, most=10)
    assert SampleGrid.from_seconds(0, 9, 1, most=10).count == 10


def test_does_not_drift():
    grid = SampleGrid.from_seconds(0, 3_000, 1 / 3)
    exact = [round(Fraction(k, 3) * 10**6) for k in range(grid.count)]
    assert grid.times_us() == exact
    assert grid.window_us == 333_333


@given(
    start=st.floats(0, 4e9),
    length=st.floats(0, 1e6),
    step=st.floats(1e-12, 1e30),
)
def test_samples_end_at_the_end(start, length, step):
    end = start + length
    if (end - start) / step > 10_000:
        with pytest.raises(ValueError, match="too many steps"):
            SampleGrid.from_seconds(start, end, step)
        return
    grid = SampleGrid.from_seconds(start, end, step)
    assert 1 <= grid.count <= 10_001
    times = grid.seconds()
    assert times == sorted(times)
    assert times[-1] <= end + 2e-6
    following = start + grid.count * step
    assert following > end or math.isclose(following, end, rel_tol=1e-9) or step < 1e-5
