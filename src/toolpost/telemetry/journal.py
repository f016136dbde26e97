"""The journal of rows that are not in a chunk yet: framed, checked, append-only."""

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from itertools import accumulate
from operator import sub
from pathlib import Path
from typing import Any

import msgspec

from toolpost.telemetry.shape import Shape, ShapeDef

_FRAME = struct.Struct("<II")  # bytes of payload, their CRC-32


class Block(msgspec.Struct, array_like=True, gc=False):
    """Rows of one shape.

    Attributes:
        shape: the shape's number.
        definition: the shape, in its first block of a journal; later blocks have None.
        epoch: epoch of the rows.
        first: number of the first row within the shape.
        times: first time, then differences; Unix microseconds.
        columns: one sequence per key, as MessagePack: at a start most blocks are in chunks
            already, and what is not needed is not decoded.
    """

    shape: int
    definition: ShapeDef | None
    epoch: int
    first: int
    times: list[int]
    columns: msgspec.Raw

    @classmethod
    def of(
        cls,
        shape: Shape,
        definition: ShapeDef | None,
        first: int,
        times: Sequence[int],
        columns: Sequence[Sequence[Any]],
    ) -> "Block":
        """Make a block of rows; ``times`` are Unix microseconds."""
        packed = msgspec.Raw(msgspec.msgpack.encode(columns))
        differences = [times[0], *map(sub, times[1:], times)]
        return cls(shape.number, definition, shape.epoch, first, differences, packed)

    def absolute_times(self) -> list[int]:
        """Return the rows' times, Unix microseconds."""
        return list(accumulate(self.times))

    def decoded_columns(self) -> list[list[Any]]:
        """Return the columns."""
        return _DECODER.decode(self.columns)


_DECODER = msgspec.msgpack.Decoder(list[list[Any]])


class Journal:
    """An append-only file of frames. Every method may raise OSError and leaves the file whole.

    Args:
        path: the file; it is made if missing. A torn end is cut off.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._encoder = msgspec.msgpack.Encoder()
        self._decoder = msgspec.msgpack.Decoder(list[Block])
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
        self._torn = False
        self._synced = True
        self.size = os.fstat(self._file).st_size

    def replay(self) -> Iterator[list[Block]]:
        """Yield the blocks of every whole frame; afterwards the file ends with the last one."""
        content = self._path.read_bytes()
        at = 0
        while at + _FRAME.size <= len(content):
            length, crc = _FRAME.unpack_from(content, at)
            payload = content[at + _FRAME.size : at + _FRAME.size + length]
            if not length or len(payload) < length or zlib.crc32(payload) != crc:
                break
            try:
                blocks = self._decoder.decode(payload)
            except msgspec.MsgspecError:
                break
            at += _FRAME.size + length
            yield blocks
        if at < len(content):
            self.size = at
            self._torn = True
            self._mend()

    def append(self, blocks: list[Block]) -> None:
        """Add one frame with one write."""
        self._mend()
        frame = self._frame(blocks)
        self._torn = True
        try:
            _write(self._file, frame)
        except OSError:
            with contextlib.suppress(OSError):
                self._mend()
            raise
        self._torn = False
        self._synced = False
        self.size += len(frame)

    def _mend(self) -> None:
        """Cut off what a failed write left: no frame behind it would ever be read."""
        if self._torn:
            os.ftruncate(self._file, self.size)
            self._torn = False

    def _frame(self, blocks: list[Block]) -> bytes:
        payload = self._encoder.encode(blocks)
        return _FRAME.pack(len(payload), zlib.crc32(payload)) + payload

    def rewrite(self, blocks: list[Block]) -> None:
        """Replace the content by ``blocks``, atomically and synced."""
        fresh = self._path.with_name(self._path.name + ".new")
        frames = b"".join(self._frame([block]) for block in blocks)
        file = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC, 0o600)
        try:
            _write(file, frames)
            os.fdatasync(file)
            fresh.replace(self._path)
        except OSError:
            os.close(file)
            with contextlib.suppress(OSError):
                fresh.unlink()
            raise
        os.close(self._file)
        self._file, self.size, self._torn, self._synced = file, len(frames), False, True
        _sync_directory(self._path.parent)

    def sync(self) -> None:
        """Make what was appended survive a loss of power."""
        if not self._synced:
            os.fdatasync(self._file)
            self._synced = True

    def close(self) -> None:
        """Close the file; nothing is synced."""
        os.close(self._file)


def _write(file: int, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(file, rest) :]


def _sync_directory(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
