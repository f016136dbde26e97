"""When to ask for the core's queue again: soon enough never to starve it, seldom enough not to babble.

All times in seconds. Pure rules over what the last two answers said.
"""

HEARTBEAT = 0.25
"""Interval of ``?queue`` while nothing is going on; the core counts as dead without answers."""

REFILL_MOST = 0.025
"""Longest wait while commands are unsent: half of what 48 commands of 1 ms last."""

DRAIN_MOST = 0.006
"""Longest wait for the end of the last command: it bounds how late a job is seen to be completed."""


def refill_delay(waiting: int, executed: int, elapsed: float) -> float:
    """Return the time after which the queue may be half empty.

    Args:
        waiting: commands in the core's queue.
        executed: commands executed in the last `elapsed` seconds.
        elapsed: seconds between the last two answers.
    """
    if executed <= 0 or elapsed <= 0:
        return REFILL_MOST
    return min(REFILL_MOST, waiting / 2 * elapsed / executed)


def drain_delay(waiting: int, executed: int, elapsed: float) -> float:
    """Return the time to wait while all is sent and the core works off what it holds; as `refill_delay`."""
    return min(DRAIN_MOST, max(0.001, refill_delay(waiting, executed, elapsed)))
