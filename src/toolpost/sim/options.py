"""What a simulated Spark core is like."""

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta


class SparkOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a simulated Spark core is like.

    Attributes:
        capacity: commands that the queue holds, as ``?queue`` reports; one more is lost.
        command_time: seconds that each G or M command takes; 0 executes at once. ``set``,
            ``get`` and ``stat`` take no time, and ``G4 P<seconds>`` takes its own unless no
            command takes any.
        realtime_moves: G0 and G1 take the time that their distance and feed give, and
            ``command_time`` is for all others.
        answer_delay: seconds until the answer to a signal, to ``get`` or ``stat`` is sent.
        hold_off: seconds after ``!`` in which all but ``?`` signals is ignored; 0 for the older
            firmware, which has no such time.
        boot_message: ``sys`` (newer firmware), ``init`` (older) or ``none``.
        boot_time: seconds that a boot takes; what arrives meanwhile is discarded.
    """

    capacity: int = 64
    command_time: float = 0.05
    realtime_moves: bool = False
    answer_delay: float = 0.0
    hold_off: float = 0.5
    boot_message: Literal["sys", "init", "none"] = "sys"
    boot_time: float = 0.0

    def __post_init__(self) -> None:
        """Refuse numbers that mean nothing.

        Raises:
            ValueError: a time is negative or not finite, or the capacity is below 1.
        """
        if self.capacity < 1:
            raise ValueError(f"capacity must be at least 1, not {self.capacity}")
        for name in ("command_time", "answer_delay", "hold_off", "boot_time"):
            value = getattr(self, name)
            if not math.isfinite(value) or value < 0:
                raise ValueError(f"{name} must be 0 or more seconds, not {value}")

    @property
    def timed(self) -> bool:
        """Whether any command takes time."""
        return self.command_time > 0 or self.realtime_moves


class SimulatedSparkOptions(SparkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The simulated core of a machine whose link is ``sim``.

    Attributes:
        baud: speed of its wire, bits per second; without it, no limit.
        faults: what shall go wrong, as ``toolpost sim spark --fault`` takes it.
    """

    baud: Annotated[int, Meta(ge=1)] | None = None
    faults: tuple[str, ...] = ()
