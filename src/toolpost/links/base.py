"""What a driver sees of a link."""

from collections.abc import Awaitable, Callable
from typing import Protocol, TypeAlias


class LinkListener(Protocol):
    """The one who is told what happens on a link."""

    def received(self, data: bytes) -> None:
        """Bytes have come from the machine, cut anywhere."""

    def drained(self) -> None:
        """All that was written has been taken by the operating system."""

    def lost(self, reason: str) -> None:
        """The link is gone; said once, after which the link is closed."""


class Link(Protocol):
    """An open link. Whole lines are written, each ending in LF."""

    @property
    def unwritten(self) -> int:
        """Bytes that the operating system has not taken yet."""

    def write(self, data: bytes) -> None:
        """Write lines behind all that was written before."""

    def write_now(self, data: bytes) -> None:
        """Write lines ahead of every whole line that is still unwritten."""

    def discard(self) -> bytes:
        """Drop and return the whole lines still unwritten; the rest of a begun line still goes out."""

    def close(self) -> None:
        """Close the link. The listener hears nothing of it."""


Opener: TypeAlias = Callable[[LinkListener], Awaitable[Link]]
"""Opens a link for a listener; raises LinkError, with words for a person, if it cannot."""
