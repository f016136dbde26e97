"""The object ``idle_timeout``: whether the machine has something to do."""

from collections.abc import Callable

READY_AFTER = 0.5
"""Seconds without motion after which "Printing" becomes "Ready"."""

DEFAULT_TIMEOUT = 600.0
"""Seconds after which "Ready" becomes "Idle" and the heaters are turned off."""


class IdleTimeout:
    """Follows the motion; its state moves on when it is looked at.

    Args:
        busy: whether a script runs or waits.
        on_idle: called when the machine becomes idle.

    Attributes:
        timeout: seconds from "Ready" to "Idle".
    """

    def __init__(self, busy: Callable[[], bool], on_idle: Callable[[], None]) -> None:
        self.timeout = DEFAULT_TIMEOUT
        self._busy = busy
        self._on_idle = on_idle
        self._state = "Idle"
        self._since = 0.0
        self._motion_ends = 0.0

    def note_motion(self, now: float, until: float) -> None:
        """Take note of motion that was queued at ``now`` and ends at ``until``."""
        self._motion_ends = until
        if self._state != "Printing":
            self._state = "Printing"
            self._since = now

    def status(self, now: float) -> dict[str, object]:
        """Return the object's fields at ``now``."""
        resting = now - self._motion_ends
        if self._state == "Printing" and resting > READY_AFTER and not self._busy():
            self._state = "Ready"
            self._since = now
        if self._state == "Ready" and now - self._since > self.timeout:
            self._state = "Idle"
            self._on_idle()
        return {
            "state": self._state,
            "printing_time": now - self._since if self._state == "Printing" else 0.0,
            "idle_timeout": self.timeout,
        }
