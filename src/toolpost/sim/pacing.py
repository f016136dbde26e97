"""How long bytes take on a serial wire."""

BITS_PER_BYTE = 10
"""8N1: a start bit, eight data bits, a stop bit."""

QUANTUM = 0.002
"""Bytes are carried in pieces of this many seconds of wire time."""

MAX_DEBT = 0.1
"""A wire that was served late makes up for at most this much, seconds."""


class Wire:
    """One direction of a serial line: which bytes may pass, and when they have passed.

    Bytes are taken off the sender in pieces, and each piece is handed over when its last byte
    has crossed the wire. The schedule is absolute: a piece that is handed over late by a timer
    takes nothing from the rate, because the next one is so much longer. A wire that has nothing
    to carry saves nothing up.

    Args:
        baud: bits per second.

    Attributes:
        rate: bytes per second.
    """

    def __init__(self, baud: int) -> None:
        self.rate = baud / BITS_PER_BYTE
        self._free_at = 0.0
        self._busy = False

    def room(self, now: float) -> int:
        """Return how many bytes the next piece may have, at least 1."""
        if not self._busy:
            self._free_at = now
        self._free_at = max(self._free_at, now - MAX_DEBT)
        late = max(0.0, now - self._free_at)
        return max(1, int((QUANTUM + late) * self.rate))

    def carry(self, count: int) -> float:
        """Put ``count`` bytes on the wire after ``room``; return when they have crossed it."""
        self._busy = True
        self._free_at += count / self.rate
        return self._free_at

    def rest(self) -> None:
        """Say that there is nothing to carry now."""
        self._busy = False
