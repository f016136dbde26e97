"""The comm log: every payload on the wire of a machine, both ways, with its time.

One line a payload, ``2026-11-22 06:56:54.654+00:00 up|down|note <payload>``, in files that `grep` can read:
bytes that are not printable ASCII are written as escapes. ``note`` lines tell what happened to the link.
Lines are handed to a thread in small batches, so that a slow disk never holds up the machine; the thread
makes them durable once a second.
"""

import asyncio
import contextlib
import logging
import os
import queue
import re
import threading
import time
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

log = logging.getLogger(__name__)

_FLUSH_AFTER = 0.02
_SYNC_EVERY = 1.0
_CLOSE_TIMEOUT = 5.0
_PRINTABLE = bytes(range(0x20, 0x7F)) + b"\n"


_Bytes = Annotated[int, Meta(ge=64 * 1024)]


class CommLogLimits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Bounds of one machine's comm log.

    Attributes:
        file_bytes: size at which a new file is begun.
        total_bytes: size of all files together; the oldest are deleted.
        max_age_days: age at which a file is deleted.
        backlog_bytes: lines that may wait for the disk; what is beyond is dropped, and the log says so.
    """

    file_bytes: _Bytes = 16 * 2**20
    total_bytes: _Bytes = 256 * 2**20
    max_age_days: Annotated[float, Meta(gt=0)] = 30.0
    backlog_bytes: _Bytes = 16 * 2**20


class CommLog:
    """The log of one machine. Its methods belong to the event loop.

    Args:
        directory: where the files are; made if missing.
        machine: name of the machine, which begins the names of the files.
        limits: bounds in size and age.
    """

    def __init__(self, directory: Path, machine: str, limits: CommLogLimits) -> None:
        self._files = _Files(directory, machine, limits)
        self._limits = limits
        self._pending: list[bytes] = []
        self._pending_bytes = 0
        self._dropped = 0
        self._second = -1
        self._date = ""
        self._timer: asyncio.TimerHandle | None = None
        self._queue: queue.SimpleQueue[list[bytes] | None] = queue.SimpleQueue()
        # Each of the two counts is changed by one thread only.
        self._queued_bytes = 0
        self._written_bytes = 0
        self._thread = threading.Thread(target=self._write_all, name=f"commlog-{machine}", daemon=True)
        self._thread.start()

    def up(self, lines: list[bytes]) -> None:
        """Log lines from the machine, as they came."""
        prefix = self._prefix(b"up")
        block = prefix + (b"\n" + prefix).join(lines) + b"\n"
        if b"\\" in block or block.translate(None, _PRINTABLE):
            block = b"".join(prefix + _escaped(line) + b"\n" for line in lines)
        self._add(block)

    def down(self, block: bytes) -> None:
        """Log a block of lines to the machine, each with its LF; all of it is printable ASCII."""
        prefix = self._prefix(b"down")
        self._add(prefix + block[:-1].replace(b"\n", b"\n" + prefix) + b"\n")

    def note(self, text: str) -> None:
        """Log what happened to the link."""
        self._add(self._prefix(b"note") + _escaped(text.encode()) + b"\n")

    def close(self) -> None:
        """Write and sync all that is pending and stop the thread."""
        self._flush()
        self._queue.put(None)
        self._thread.join(_CLOSE_TIMEOUT)
        if self._thread.is_alive():
            log.error("the comm log was not finished in %g s: the disk hangs", _CLOSE_TIMEOUT)

    def _prefix(self, word: bytes) -> bytes:
        now_ms = time.time_ns() // 1_000_000
        second, ms = divmod(now_ms, 1000)
        if second != self._second:
            self._second = second
            self._date = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(second))
        return b"%s.%03d+00:00 %s " % (self._date.encode(), ms, word)

    def _add(self, block: bytes) -> None:
        backlog = self._pending_bytes + self._queued_bytes - self._written_bytes
        if backlog > self._limits.backlog_bytes:
            self._dropped += block.count(b"\n")
            return
        if self._dropped:
            dropped, self._dropped = self._dropped, 0
            block = self._prefix(b"note") + b"%d lines were not logged\n" % dropped + block
        self._pending.append(block)
        self._pending_bytes += len(block)
        if self._timer is None:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(_FLUSH_AFTER, self._flush)

    def _flush(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._pending:
            self._queued_bytes += self._pending_bytes
            self._queue.put(self._pending)
            self._pending, self._pending_bytes = [], 0

    def _write_all(self) -> None:
        """Write what comes through the queue until None comes; runs in the thread."""
        sync_at: float | None = None
        while True:
            wait = None if sync_at is None else max(0.0, sync_at - time.monotonic())
            try:
                batch = self._queue.get(timeout=wait)
            except queue.Empty:
                self._files.sync()
                sync_at = None
                continue
            if batch is None:
                break
            data = b"".join(batch)
            self._files.write(data)
            self._written_bytes += len(data)
            if sync_at is None:
                sync_at = time.monotonic() + _SYNC_EVERY
            elif sync_at <= time.monotonic():
                self._files.sync()
                sync_at = time.monotonic() + _SYNC_EVERY
        self._files.close()


class _Files:
    """The files of one log; used by its thread alone."""

    def __init__(self, directory: Path, machine: str, limits: CommLogLimits) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self._directory = directory
        self._machine = machine
        self._limits = limits
        self._fd = -1
        self._size = 0
        self._day = ""
        self._failing = False

    def write(self, data: bytes) -> None:
        """Append; a disk that does not take it costs these lines and one warning."""
        try:
            self._write(data)
        except OSError as error:
            if not self._failing:
                log.warning("%s: the comm log cannot be written: %s", self._machine, error.strerror)
            self._failing = True
            return
        if self._failing:
            self._failing = False
            log.warning("%s: the comm log is written again", self._machine)

    def sync(self) -> None:
        """Make what was written durable."""
        if self._fd >= 0:
            with contextlib.suppress(OSError):
                os.fdatasync(self._fd)

    def close(self) -> None:
        """Sync and close the present file."""
        if self._fd >= 0:
            self.sync()
            os.close(self._fd)
            self._fd = -1

    def _write(self, data: bytes) -> None:
        day = time.strftime("%Y-%m-%d", time.gmtime())
        if self._fd < 0 or day != self._day or self._size >= self._limits.file_bytes:
            self._open(day)
        view = memoryview(data)
        while view:
            taken = os.write(self._fd, view)
            self._size += taken
            view = view[taken:]

    def _open(self, day: str) -> None:
        self.close()
        path = self._next_path(day)
        self._fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o640)
        self._size = os.fstat(self._fd).st_size
        self._day = day
        if self._size and not _ends_with_newline(path):
            os.write(self._fd, b"\n")
        self._trim(path)

    def _next_path(self, day: str) -> Path:
        """Return the day's last file, or the one after it if that is full; numbers are never used again."""
        latest = max((key for key in self._files() if key[0] == day), default=(day, 1))
        path = self._path(*latest)
        if path.exists() and path.stat().st_size >= self._limits.file_bytes:
            return self._path(day, latest[1] + 1)
        return path

    def _path(self, day: str, number: int) -> Path:
        return self._directory / f"{self._machine}-{day}-{number:04}.log"

    def _files(self) -> list[tuple[str, int]]:
        """Return day and number of every file of this machine, the newest first."""
        name = re.compile(re.escape(self._machine) + r"-(\d{4}-\d\d-\d\d)-(\d{4,})\.log")
        matches = (name.fullmatch(path.name) for path in self._directory.iterdir())
        return sorted(((match[1], int(match[2])) for match in matches if match), reverse=True)

    def _trim(self, current: Path) -> None:
        """Delete what is beyond the bounds, the oldest first; never the present file."""
        oldest = time.time() - self._limits.max_age_days * 86400
        total = self._limits.file_bytes
        for key in self._files():
            path = self._path(*key)
            if path == current:
                continue
            stat = path.stat()
            total += stat.st_size
            if total > self._limits.total_bytes or stat.st_mtime < oldest:
                path.unlink(missing_ok=True)


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"


def _escaped(line: bytes) -> bytes:
    return line.decode("latin-1").encode("unicode_escape")
