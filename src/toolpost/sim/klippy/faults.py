"""Faults that a simulated Klipper host can be told to have, as text: ``NAME[:ARG]``."""

import math
from typing import Self

import msgspec

SECONDS = "seconds"
BYTES = "bytes"
TEXT = "text"

KINDS: dict[str, str | None] = {
    "shutdown": TEXT,
    "disconnect": SECONDS,
    "restart": None,
    "firmware-restart": None,
    "die": None,
    "slow": SECONDS,
    "mute": SECONDS,
    "error": TEXT,
    "garbage": BYTES,
}
"""Each fault's name and the kind of its argument.

- ``shutdown[:text]``: the machine stops itself; ``print_stats`` stays "printing" until the line
  that runs has ended.
- ``disconnect[:seconds]``: the socket is closed and bound again, 1 s later when no time is
  given; the machine goes on meanwhile.
- ``restart``, ``firmware-restart``: a restart that nobody asked for through the socket.
- ``die``: the process is killed; nothing listens until ``revive``.
- ``slow[:seconds]``: from now on everything is sent this much later, 0.5 s when no time is given.
- ``mute[:seconds]``: what would be sent is lost; without seconds for ever.
- ``error[:text]``: the next line of the file fails.
- ``garbage[:bytes]``: every client is sent a frame of noise, 64 bytes when no number is given.
"""

MAX_GARBAGE = 1_000_000
"""The most bytes that one ``garbage`` may ask for."""


class Fault(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One fault.

    Attributes:
        name: one of ``KINDS``.
        amount: seconds or bytes, by the kind; None when not given.
        text: the argument of a kind that takes text; None when not given.
    """

    name: str
    amount: float | None = None
    text: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read a fault from ``NAME[:ARG]``.

        Raises:
            ValueError: the name is unknown, or the argument is not what it must be; the message
                names the fix and, for a name, all valid names.
        """
        name, colon, argument = text.strip().partition(":")
        if name not in KINDS:
            raise ValueError(f"unknown fault {name!r}; valid: {', '.join(KINDS)}")
        kind = KINDS[name]
        if not colon:
            return cls(name)
        if kind is None:
            raise ValueError(f"fault {name} takes no argument, but got {argument!r}")
        if kind == TEXT:
            return cls(name, text=argument)
        return cls(name, amount=_amount(name, kind, argument))


def _amount(name: str, kind: str, argument: str) -> float:
    try:
        amount = float(argument)
    except ValueError:
        amount = math.nan
    if not math.isfinite(amount) or amount < 0:
        raise ValueError(f"fault {name} needs {kind} as a number >= 0, but got {argument!r}")
    if kind == BYTES and (amount > MAX_GARBAGE or amount != int(amount)):
        raise ValueError(f"fault {name} needs a whole number of bytes up to {MAX_GARBAGE}")
    return amount
