import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolpost.drivers.spark.pacing import DRAIN_MOST, HEARTBEAT, REFILL_MOST, drain_delay, refill_delay

counts = st.integers(0, 10_000)
times = st.floats(0, 100)


@given(counts, st.integers(-5, 10_000), times)
def test_refill_is_bounded(waiting, executed, elapsed):
    assert 0 <= refill_delay(waiting, executed, elapsed) <= REFILL_MOST


@given(counts, st.integers(-5, 10_000), times)
def test_drain_is_bounded_and_never_babbles(waiting, executed, elapsed):
    assert 0.001 <= drain_delay(waiting, executed, elapsed) <= DRAIN_MOST


@given(counts, st.integers(1, 10_000), st.floats(1e-6, 100))
def test_the_queue_is_not_more_than_half_empty_then(waiting, executed, elapsed):
    rate = executed / elapsed
    assert refill_delay(waiting, executed, elapsed) * rate <= waiting / 2 + 1e-6


@given(counts, counts, st.integers(1, 10_000), st.floats(1e-6, 100))
def test_a_fuller_queue_waits_no_shorter(a, b, executed, elapsed):
    low, high = sorted((a, b))
    assert refill_delay(low, executed, elapsed) <= refill_delay(high, executed, elapsed)


def test_figures():
    # 48 commands of 1 ms last 48 ms, of which half are 24.
    assert refill_delay(48, 100, 0.1) == pytest.approx(0.024)
    assert refill_delay(48, 100, 0.2) == REFILL_MOST
    assert refill_delay(0, 10, 0.1) == 0
    assert refill_delay(48, 0, 0.1) == REFILL_MOST
    assert refill_delay(48, 10, 0) == REFILL_MOST
    assert drain_delay(0, 10, 0.1) == 0.001
    assert drain_delay(4, 1000, 1) == 0.002
    assert drain_delay(48, 0, 0.1) == DRAIN_MOST
    assert DRAIN_MOST < REFILL_MOST < HEARTBEAT
