"""A dict that forgets what was not used for longest."""

from typing import Generic, TypeVar

_K = TypeVar("_K")
_V = TypeVar("_V")


class Recent(Generic[_K, _V]):
    """Keeps the entries used last.

    Args:
        weight: the most that all entries may weigh together.
    """

    __slots__ = ("_entries", "_left")

    def __init__(self, weight: int) -> None:
        self._entries: dict[_K, tuple[_V, int]] = {}
        self._left = weight

    def get(self, key: _K) -> _V | None:
        """Return an entry, or None."""
        entry = self._entries.pop(key, None)
        if entry is None:
            return None
        self._entries[key] = entry
        return entry[0]

    def put(self, key: _K, value: _V, weight: int) -> None:
        """Add an entry that is not there; forget others for it. One that is too heavy is not kept."""
        self._left -= weight
        self._entries[key] = (value, weight)
        while self._left < 0:
            self._left += self._entries.pop(next(iter(self._entries)))[1]
