"""The wall clock, as whole microseconds.

Order never rests on it: jobs are ordered by their sequence number and intervals are measured with the
monotonic clock, because the wall clock of a small board may jump.
"""

import time


def now_us() -> int:
    """Return the Unix time in whole microseconds."""
    return time.time_ns() // 1000


def seconds(time_us: int) -> float:
    """Return a time in microseconds as Unix seconds, exact to the microsecond."""
    return time_us / 1_000_000
