"""Content that jobs need, kept apart from the names that people change."""

import contextlib
import os
import re
import secrets
import threading
from pathlib import Path

from toolpost.errors import NotAcceptedError, StorageError
from toolpost.gcode.content import ContentWriter, Identity, hash_content, identity, is_settled
from toolpost.gcode.entries import PinnedFile

_SUFFIX = ".gcode"
_SHA256 = re.compile(r"[0-9a-f]{64}")
_TRIES = 3
_TRIM_TO = 0.9
_MAX_KNOWN = 20_000


class PinStore:
    """One read-only file for each content, named by its hash. Its methods block; they are for a thread.

    It is a copy and no hard link: a link would change with every program that writes into the file instead
    of replacing it (``cp``, an editor, a network share). On file systems that can, both share their blocks.

    Args:
        directory: where the files are; made if missing, nothing else may be in it.
        keep_free: bytes of the disk that are not for them.
    """

    def __init__(self, directory: Path, keep_free: int) -> None:
        self._directory = directory.absolute()
        self._prefix = f"{self._directory}{os.sep}"
        self._keep_free = keep_free
        self._writing = threading.Lock()
        self._known: dict[Identity, str] = {}
        self._directory.mkdir(parents=True, exist_ok=True)
        for left_over in self._directory.glob("*.part"):
            left_over.unlink(missing_ok=True)
        sizes = [path.stat().st_size for path in self._directory.iterdir()]
        self._sizes = set(sizes)
        self._total = sum(sizes)

    def get(self, sha256: str) -> PinnedFile:
        """Return content that was pinned.

        Raises:
            StorageError: it is not there.
        """
        if not _SHA256.fullmatch(sha256):
            raise StorageError(f"{sha256[:64]!r} is no SHA-256")
        # Thousands of jobs are added in one request: a plain text is faster than a Path.
        path = f"{self._prefix}{sha256}{_SUFFIX}"
        try:
            size = os.stat(path).st_size  # noqa: PTH116
        except OSError as error:
            raise StorageError(f"content {sha256[:12]} cannot be read: {error.strerror}") from None
        return PinnedFile(sha256, size, path)

    def learn(self, status: os.stat_result, sha256: str) -> None:
        """Remember the hash of a file, for as long as the file does not change."""
        if len(self._known) >= _MAX_KNOWN:
            with contextlib.suppress(KeyError, RuntimeError):
                self._known.pop(next(iter(self._known)))
        self._known[identity(status)] = sha256

    def recall(self, status: os.stat_result) -> PinnedFile | None:
        """Return a file's content if it is pinned and the file has not changed since."""
        sha256 = self._known.get(identity(status))
        if sha256 is None:
            return None
        with contextlib.suppress(StorageError):
            return self.get(sha256)
        return None

    def pin(self, fd: int) -> PinnedFile:
        """Keep what an open file holds now; it is on disk when this returns.

        Raises:
            NotAcceptedError: somebody is writing it.
            StorageError: the disk did not take it, or cannot be read.
        """
        with self._writing:
            try:
                return self.recall(os.fstat(fd)) or self._find(fd) or self._copy(fd)
            except OSError as error:
                raise StorageError(f"the content could not be kept: {error.strerror}") from None

    def trim(self, in_use: set[str], max_bytes: int) -> None:
        """Delete the oldest contents that no job needs, if all together are larger than `max_bytes`.

        What has just been pinned is not in `in_use` yet: do not call this before its job is.
        """
        with self._writing:
            if self._total <= max_bytes:
                return
            files = [(path, path.stat()) for path in self._directory.glob(f"*{_SUFFIX}")]
            self._total = sum(status.st_size for _, status in files)
            for path, status in sorted(files, key=lambda file: file[1].st_ctime_ns):
                if self._total <= max_bytes * _TRIM_TO:
                    return
                if path.stem not in in_use:
                    path.unlink(missing_ok=True)
                    self._total -= status.st_size

    def _find(self, fd: int) -> PinnedFile | None:
        """Return the content if it is pinned already; a glance at the sizes spares most of the reading."""
        before = os.fstat(fd)
        if before.st_size not in self._sizes:
            return None
        sha256 = hash_content(fd)
        if not self._path(sha256).exists():
            return None
        self._learn_if_settled(before, fd, sha256)
        return self.get(sha256)

    def _copy(self, fd: int) -> PinnedFile:
        for _ in range(_TRIES):
            before = os.fstat(fd)
            part = self._directory / f"{secrets.token_hex(8)}.part"
            try:
                sha256 = self._write(fd, part)
                if identity(os.fstat(fd)) != identity(before):
                    continue
                part.rename(self._path(sha256))
            finally:
                part.unlink(missing_ok=True)
            self._sync()
            self._total += before.st_size
            self._sizes.add(before.st_size)
            self._learn_if_settled(before, fd, sha256)
            return PinnedFile(sha256, before.st_size, str(self._path(sha256)))
        raise NotAcceptedError("the file is being written; try again when it is complete")

    def _write(self, fd: int, part: Path) -> str:
        writer = ContentWriter(part, self._keep_free)
        try:
            writer.copy(fd)
            writer.finish(0o444)
            return writer.sha256()
        finally:
            writer.close()

    def _learn_if_settled(self, before: os.stat_result, fd: int, sha256: str) -> None:
        after = os.fstat(fd)
        if identity(after) == identity(before) and is_settled(before):
            self.learn(after, sha256)

    def _sync(self) -> None:
        fd = os.open(self._directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)

    def _path(self, sha256: str) -> Path:
        return self._directory / f"{sha256}{_SUFFIX}"
