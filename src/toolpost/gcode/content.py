"""Writing content to disk so that it is there for good, or not at all."""

import errno
import hashlib
import os
import time
from pathlib import Path
from typing import Final

BLOCK: Final = 1024 * 1024
"""Bytes that are read or written at a time."""

Identity = tuple[int, int, int, int, int]
"""What changes whenever the content of a file does: device, inode, size, and times of change."""

_SYNC_EVERY = 16 * 1024 * 1024
_SETTLED = 0.05
_NO_KERNEL_COPY = {errno.EXDEV, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.EPERM}


class ContentWriter:
    """A new file that has no lasting name yet. Blocks; for a thread.

    All methods raise OSError as the operating system does; the file is of no use then.

    Args:
        path: where it is written.
        keep_free: bytes of the disk that are not for it, so that the database can still be written.
    """

    def __init__(self, path: Path, keep_free: int) -> None:
        self._keep_free = keep_free
        self._unsynced = 0
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            self._check_room()
        except OSError:
            self.close()
            raise

    def write(self, data: bytes | bytearray) -> None:
        """Write on."""
        self._make_room(len(data))
        view = memoryview(data)
        while view:
            view = view[os.write(self._fd, view) :]

    def copy(self, source: int) -> None:
        """Write all that a file holds; shared with it where the file system can do that (btrfs, XFS)."""
        offset = 0
        try:
            while True:
                self._make_room(_SYNC_EVERY)
                copied = os.copy_file_range(source, self._fd, _SYNC_EVERY, offset)
                if not copied:
                    return
                offset += copied
        except OSError as error:
            if offset or error.errno not in _NO_KERNEL_COPY:
                raise
        while data := os.pread(source, BLOCK, offset):
            self.write(data)
            offset += len(data)

    def sha256(self) -> str:
        """Return the hash of what was written, read back."""
        return hash_content(self._fd)

    def finish(self, mode: int) -> None:
        """Put it on disk, with these permissions. It has still to be renamed."""
        os.fchmod(self._fd, mode)
        os.fsync(self._fd)

    def close(self) -> None:
        """Close it; whoever wanted it has to rename or remove it."""
        os.close(self._fd)

    def _make_room(self, size: int) -> None:
        """Look for room, and let no more wait to be written than the disk takes in a moment."""
        self._unsynced += size
        if self._unsynced > _SYNC_EVERY:
            self._unsynced = size
            os.fdatasync(self._fd)
            self._check_room()

    def _check_room(self) -> None:
        disk = os.fstatvfs(self._fd)
        if disk.f_bavail * disk.f_frsize < self._keep_free + _SYNC_EVERY:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def hash_content(fd: int) -> str:
    """Return the SHA-256 of a file in hex. Blocks; for a thread."""
    digest = hashlib.sha256()
    offset = 0
    while data := os.pread(fd, BLOCK, offset):
        digest.update(data)
        offset += len(data)
    return digest.hexdigest()


def identity(status: os.stat_result) -> Identity:
    """Return what tells whether a file still holds what it did."""
    return (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)


def is_settled(status: os.stat_result) -> bool:
    """Return whether a further change of a file would show in its identity; clocks of files are coarse."""
    return time.time() - max(status.st_mtime, status.st_ctime) > _SETTLED
