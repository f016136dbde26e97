"""The lock of a data directory: one server at a time."""

import contextlib
import fcntl
import os
from pathlib import Path

from toolpost.errors import StartError


class DirectoryLock:
    """Holds a data directory until closed; the operating system lets go of it with the process.

    Args:
        directory: the data directory; made if missing.

    Raises:
        StartError: another server holds it, or it cannot be written.
    """

    def __init__(self, directory: Path) -> None:
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._fd = os.open(directory / "toolpost.lock", os.O_RDWR | os.O_CREAT, 0o640)
        except OSError as error:
            raise StartError(f"data directory {directory}: {error.strerror}") from None
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(self._fd, 20).decode("ascii", "replace").strip()
            os.close(self._fd)
            raise StartError(
                f"data directory {directory}: another Toolpost (process {owner}) uses it"
            ) from None
        # Only words for the next one who asks: a full disk must not stop the server here.
        with contextlib.suppress(OSError):
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, f"{os.getpid()}\n".encode(), 0)

    def close(self) -> None:
        """Let go of the directory."""
        os.close(self._fd)
