"""What a simulated Klipper host is like."""

import math
from pathlib import Path

import msgspec

_TIMES = (
    "line_time",
    "startup_time",
    "restart_time",
    "answer_delay",
    "buffer_time",
    "client_timeout",
)
_POSITIVE_TIMES = ("tick", "heater_time")


class KlippyOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a simulated Klipper host is like. Times are in seconds.

    Attributes:
        line_time: what each move takes (G0 to G3, G28); ``G4`` takes its own time.
        buffer_time: motion that may be queued ahead: a line that fits is done at once, so that
            the end of a file comes this much before the end of its motion. A real host has
            about 2 s; with 0 each line takes its time.
        tick: between two status updates (250 ms in a real host).
        startup_time: from a boot until the machine is ready.
        restart_time: from the closing of the socket by a restart until it is bound again (1 s in
            a real host).
        answer_delay: until anything is sent, order kept.
        client_timeout: a client that reads nothing for this long is closed (5 to 6 s in a real
            host).
        heater_time: the time constant of the heaters.
        strict_motion: refuse moves of axes that were not homed, moves out of range and extrusion
            below 170 °C, as a real host does.
        gcodes: the directory of ``virtual_sdcard``; None for ``gcodes`` beside the socket.
    """

    line_time: float = 0.002
    buffer_time: float = 0.0
    tick: float = 0.25
    startup_time: float = 0.5
    restart_time: float = 0.1
    answer_delay: float = 0.0
    client_timeout: float = 5.0
    heater_time: float = 1.0
    strict_motion: bool = False
    gcodes: Path | None = None

    def __post_init__(self) -> None:
        """Refuse numbers that mean nothing.

        Raises:
            ValueError: a time is negative or not finite, or 0 where it must not be.
        """
        for name in _TIMES:
            value = getattr(self, name)
            if not math.isfinite(value) or value < 0:
                raise ValueError(f"{name} must be 0 or more seconds, not {value}")
        for name in _POSITIVE_TIMES:
            value = getattr(self, name)
            if not math.isfinite(value) or value <= 0:
                raise ValueError(f"{name} must be more than 0 seconds, not {value}")
