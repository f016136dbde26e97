"""Programs on disk: one immutable file for each content, named by its hash."""

import contextlib
import hashlib
import os
import secrets
from collections.abc import Iterable
from pathlib import Path

from toolpost.core.program import Program
from toolpost.errors import ProgramError, StorageError

_READ_SIZE = 256 * 1024
_TRIM_TO = 0.9


class ProgramStore:
    """The folder of programs.

    A program's file holds one command a line, each ending in LF, just as they go on the wire.

    Args:
        directory: where the files are; made if missing.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        directory.mkdir(parents=True, exist_ok=True)
        for left_over in directory.glob("*.part"):
            left_over.unlink(missing_ok=True)
        self._total = sum(_on_disk(path.stat()) for path in self._programs())

    def add(self, blocks: Iterable[list[bytes]]) -> Program:
        """Store commands and return their program; it is on disk when this returns. Blocks; for a thread.

        Raises:
            StorageError: the disk did not take it.
        """
        part = self._directory / f"{secrets.token_hex(8)}.part"
        try:
            with part.open("wb") as file:
                digest = hashlib.sha256()
                commands = 0
                for block in blocks:
                    if not block:
                        continue
                    data = b"\n".join(block) + b"\n"
                    commands += len(block)
                    digest.update(data)
                    file.write(data)
                file.flush()
                size = file.tell()
                os.fsync(file.fileno())
                self._total += _on_disk(os.fstat(file.fileno()))
            program = Program(digest.hexdigest(), commands, size)
            part.rename(self._path(program.sha256))
            _sync_directory(self._directory)
        except OSError as error:
            raise StorageError(f"the program could not be stored: {error.strerror}") from None
        finally:
            part.unlink(missing_ok=True)
        return program

    def open(self, sha256: str) -> "ProgramReader":
        """Return a reader of a program, whose content is what its name says. Blocks.

        Raises:
            ProgramError: there is no such program, or its content has changed.
            StorageError: it cannot be read now.
        """
        try:
            with self._path(sha256).open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            if digest != sha256:
                raise ProgramError(f"program {sha256[:12]} is damaged")
            return ProgramReader(self._path(sha256))
        except FileNotFoundError:
            raise ProgramError(f"program {sha256[:12]} is missing") from None
        except OSError as error:
            raise StorageError(f"program {sha256[:12]} cannot be read: {error.strerror}") from None

    def has(self, sha256: str) -> bool:
        """Whether there is such a program."""
        return self._path(sha256).exists()

    @property
    def size(self) -> int:
        """Bytes that all programs take together."""
        return self._total

    def trim(self, in_use: set[str], max_bytes: int) -> None:
        """Delete the oldest programs that no job needs, if all together are larger than `max_bytes`."""
        if self._total <= max_bytes:
            return
        files = [(path, path.stat()) for path in self._programs()]
        self._total = sum(_on_disk(stat) for _, stat in files)
        for path, stat in sorted(files, key=lambda file: file[1].st_mtime):
            if self._total <= max_bytes * _TRIM_TO:
                return
            if path.name not in in_use:
                path.unlink(missing_ok=True)
                self._total -= _on_disk(stat)

    def _programs(self) -> list[Path]:
        return [path for path in self._directory.iterdir() if path.is_file() and path.suffix != ".part"]

    def _path(self, sha256: str) -> Path:
        return self._directory / sha256


class ProgramReader:
    """Reads a program's commands in order, a block of the file at a time."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb", buffering=0)
        self._commands: list[bytes] = []
        self._next = 0
        self._cut = b""
        self._ended = False
        os.posix_fadvise(self._file.fileno(), 0, 0, os.POSIX_FADV_SEQUENTIAL)
        try:
            self._look_ahead()
        except BaseException:
            self._file.close()
            raise

    @property
    def exhausted(self) -> bool:
        """Whether all commands have been taken."""
        return self._ended and self._next >= len(self._commands)

    def take(self, most: int) -> list[bytes]:
        """Return the next commands, at most `most`; an empty list only after the last one.

        Raises:
            StorageError: the file cannot be read. No command is left out by that.
        """
        self._look_ahead()
        taken = self._commands[self._next : self._next + most]
        self._next += len(taken)
        # What cannot be read is told when it is asked for: these commands are not lost.
        with contextlib.suppress(StorageError):
            self._look_ahead()
        return taken

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _look_ahead(self) -> None:
        """Have the next command in memory, or know that there is none."""
        while self._next >= len(self._commands) and not self._ended:
            try:
                data = self._file.read(_READ_SIZE)
            except OSError as error:
                raise StorageError(f"the program cannot be read: {error.strerror}") from None
            self._next = 0
            self._ended = len(data) == 0
            self._commands = (self._cut + data).split(b"\n")
            self._cut = self._commands.pop()


def _on_disk(stat: os.stat_result) -> int:
    """Return the bytes that a file takes on disk."""
    return stat.st_blocks * 512


def _sync_directory(directory: Path) -> None:
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
