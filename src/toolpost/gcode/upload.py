"""Files that are arriving."""

import asyncio
import contextlib
import hashlib
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from toolpost.errors import NotAcceptedError, StorageError
from toolpost.gcode import names
from toolpost.gcode.content import BLOCK, ContentWriter
from toolpost.gcode.entries import Change
from toolpost.gcode.errors import ChecksumError, FileTooLargeError

Adopt = Callable[[Path, str, str], Awaitable[Change]]


class Upload:
    """A file that is arriving. It has a name, and is there for others, only when it is committed.

    If it is not, for whatever reason, nothing is left of it.

    Args:
        part: where it is written.
        adopt: gives it its name and tells that it is there: takes the part, the name and the SHA-256.
        slots: one is taken while it goes on.
        max_bytes: longest file.
        keep_free: bytes of the disk that are not for it.

    Attributes:
        size: bytes that have arrived.
    """

    def __init__(
        self, part: Path, adopt: Adopt, slots: asyncio.Semaphore, max_bytes: int, keep_free: int
    ) -> None:
        self._part = part
        self._adopt = adopt
        self._slots = slots
        self._max_bytes = max_bytes
        self._keep_free = keep_free
        self._buffer = bytearray()
        self._digest = hashlib.sha256()
        # Threads that outlive their caller find the upload given up.
        self._lock = threading.Lock()
        self._writer: ContentWriter | None = None
        self._over = False
        self.size = 0

    async def __aenter__(self) -> Self:
        if self._slots.locked():
            raise NotAcceptedError("too many uploads at the same time; try again")
        await self._slots.acquire()
        try:
            await asyncio.to_thread(self._write, b"")
        except BaseException:
            await self.__aexit__(None, None, None)
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._slots.release()
        await asyncio.shield(asyncio.ensure_future(asyncio.to_thread(self._discard)))

    async def write(self, data: bytes) -> None:
        """Take the next bytes; waits while the disk is behind.

        Raises:
            FileTooLargeError: the file is longer than allowed.
            StorageError: the disk did not take it.
        """
        self.size += len(data)
        if self.size > self._max_bytes:
            raise FileTooLargeError(f"a file must be at most {self._max_bytes} bytes")
        self._buffer += data
        if len(self._buffer) >= BLOCK:
            full, self._buffer = self._buffer, bytearray()
            await asyncio.to_thread(self._write, full)

    async def commit(self, name: str, checksum: str | None = None) -> Change:
        """Let the file have its name; it is on disk when this returns.

        Args:
            name: relative to the root; missing directories are made, a file of that name is replaced.
            checksum: SHA-256 in hex that the content must have.

        Raises:
            ChecksumError: it has another one.
            ToolpostError: as `Files`.
        """
        names.split_name(name)
        sha256 = await asyncio.to_thread(self._finish, checksum)
        return await self._adopt(self._part, name, sha256)

    def _write(self, data: bytes | bytearray) -> None:
        with self._lock, _storing():
            if self._over:
                raise StorageError("the upload was given up")
            if self._writer is None:
                self._writer = ContentWriter(self._part, self._keep_free)
            self._digest.update(data)
            self._writer.write(data)

    def _finish(self, checksum: str | None) -> str:
        self._write(self._buffer)
        sha256 = self._digest.hexdigest()
        if checksum is not None and checksum.strip().lower() != sha256:
            raise ChecksumError("checksum: the file that arrived has another one")
        with self._lock, _storing():
            if self._writer is not None:
                self._writer.finish(0o644)
        return sha256

    def _discard(self) -> None:
        with self._lock:
            self._over = True
            if self._writer is not None:
                self._writer.close()
                self._writer = None
            with contextlib.suppress(OSError):
                self._part.unlink(missing_ok=True)


@contextlib.contextmanager
def _storing() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageError(f"the upload could not be stored: {error.strerror}") from None
