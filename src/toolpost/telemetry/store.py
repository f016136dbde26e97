"""The store behind `Telemetry`: tails, journal, chunks and retention. One thread uses it."""

import contextlib
import logging
import sqlite3
import time
from collections.abc import Sequence
from pathlib import Path

from toolpost.core.grid import SampleGrid
from toolpost.core.report import Report, Value
from toolpost.errors import StorageError
from toolpost.telemetry import reader
from toolpost.telemetry.chunks import PAGE_BYTES, ChunkFile
from toolpost.telemetry.columns import pack
from toolpost.telemetry.intake import Intake, is_time
from toolpost.telemetry.journal import Block, Journal
from toolpost.telemetry.limits import Limits
from toolpost.telemetry.shape import Shape

CHUNK_ROWS = 8_000
"""Rows that a tail has when it is sealed. At 4,000 the sparse query is 1.5 times slower: opening
a chunk costs more than what is read of it. At 12,000 nothing is gained, and tails take more RAM."""
FRAME_REPORTS = 2_048
"""Most reports in one frame of the journal."""
SYNC_S = 10.0
"""Seconds between syncs: what a loss of power may take. A kill takes only what is pending."""
RETRY_S = 5.0
"""Seconds to wait after the database refused a chunk."""
RETIRE_S = 600.0
"""Seconds between passes that delete what is too old."""

_MIN_BYTES = 4 << 20
_MAX_RESERVE = 32 << 20
_MAX_WAL_PAGES = 64
_log = logging.getLogger(__name__)

_Rows = tuple[list[int], list[tuple[Value, ...]]]


class _Episode:
    """Says once that something does not work, and once that it does again."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._active = False

    def fail(self, error: BaseException) -> None:
        if not self._active:
            self._active = True
            _log.warning("telemetry: cannot write the %s, data is dropped: %s", self._what, error)

    def succeed(self) -> None:
        if self._active:
            self._active = False
            _log.info("telemetry: the %s can be written again", self._what)


class Store:
    """Reports on disk. Make it and use it in one thread.

    Args:
        directory: where ``telemetry.db`` and ``telemetry.journal`` are.
        limits: the bounds.

    Attributes:
        dropped: reports that were not stored, since the store was opened.

    Raises:
        StorageError: the files cannot be opened or made.
    """

    def __init__(self, directory: Path, limits: Limits) -> None:
        self.dropped = 0
        self._limits = limits
        allowed = max(limits.max_bytes, _MIN_BYTES)
        # For the journal, its rewritten copy and the WAL; the rest is for chunks.
        self._reserve = min(_MAX_RESERVE, allowed // 4)
        self._intake = Intake(limits)
        self._shapes: dict[int, Shape] = {}
        self._announced: set[int] = set()
        self._journal_trouble = _Episode("journal")
        self._chunk_trouble = _Episode("database")
        self._retry_at = self._compact_at = self._synced_at = 0.0
        self._retired_at = (time.monotonic(), time.time())
        try:
            directory.mkdir(parents=True, exist_ok=True)
            pages = (allowed - self._reserve) // PAGE_BYTES
            wal_pages = min(_MAX_WAL_PAGES, self._reserve // 4 // PAGE_BYTES)
            self._chunks = _open_chunks(directory / "telemetry.db", pages, wal_pages)
        except (OSError, sqlite3.Error) as error:
            raise StorageError(f"telemetry in {directory}: {error}") from error
        try:
            self._journal = Journal(directory / "telemetry.journal")
            self._rewrite_at = max(self._journal.size, self._reserve // 8)
            self._load()
        except (OSError, sqlite3.Error) as error:
            self._chunks.close()
            raise StorageError(f"telemetry in {directory}: {error}") from error

    def _load(self) -> None:
        self._shapes = self._chunks.load()
        for blocks in self._journal.replay():
            for block in blocks:
                self._replay(block)
        for shape in list(self._shapes.values()):
            self._intake.reserve(shape.number)
            if shape.times or any(run.ids for run in shape.runs):
                self._intake.adopt(shape)
            else:
                self._chunks.forget(shape)
                del self._shapes[shape.number]
        self._chunks.shrink()

    def _replay(self, block: Block) -> None:
        """Take rows back from the journal, except those that are in a chunk."""
        if block.definition is not None:
            self._announced.add(block.shape)
            if block.shape not in self._shapes:
                self._shapes[block.shape] = Shape(block.shape, block.definition)
        if block.shape not in self._announced:
            return
        shape = self._shapes[block.shape]
        times = block.absolute_times()
        known = shape.sealed + len(shape.times) - block.first
        if known >= len(times):
            return
        if not shape.times:
            shape.sealed = max(shape.sealed, block.first)
        columns = block.decoded_columns()
        if known > 0:
            times, columns = times[known:], [column[known:] for column in columns]
        self._extend(shape, block.epoch, times, columns)

    def append(self, batch: Sequence[tuple[str, Report]]) -> None:
        """Store reports in the order of their reception. Never raises for a full disk."""
        for start in range(0, len(batch), FRAME_REPORTS):
            self._append(batch[start : start + FRAME_REPORTS])
        now = time.monotonic()
        if now - self._synced_at >= SYNC_S:
            self._synced_at = now
            self._sync()
        if self._journal.size >= self._rewrite_at and now >= self._compact_at:
            self._compact_at = 0.0 if self._compact() else now + RETRY_S
        if now - self._retired_at[0] >= RETIRE_S:
            self._retire(now, time.time())

    def _append(self, batch: Sequence[tuple[str, Report]]) -> None:
        intake = self._intake
        fresh: dict[Shape, _Rows] = {}
        for machine, report in batch:
            state = intake.state(machine, report.tag)
            if state is None or not is_time(report.time_us):
                self.dropped += 1
                continue
            shape = state.find(report.values)
            if shape is None:
                shape = intake.new_shape(machine, report, state)
                if shape is None:
                    self.dropped += 1
                    continue
                self._shapes[shape.number] = shape
            if state.steps_back(report.time_us):
                self._commit(fresh)
                fresh = {}
                state.new_epoch()
                for other in state.shapes:
                    self._end_epoch(other, state.epoch)
            time_us = state.row_time(report.time_us, shape)
            if time_us is None:
                self.dropped += 1
                continue
            rows = fresh.get(shape)
            if rows is None:
                self._end_epoch(shape, state.epoch)
                rows = fresh[shape] = ([], [])
            rows[0].append(time_us)
            rows[1].append(tuple(report.values.values()))
        self._commit(fresh)

    def _commit(self, fresh: dict[Shape, _Rows]) -> None:
        """Write rows to the journal, then to the tails."""
        blocks: list[Block] = []
        accepted: list[tuple[Shape, list[int], list[Sequence[object]]]] = []
        for shape, (times, rows) in fresh.items():
            if len(shape.times) >= 2 * CHUNK_ROWS:
                self._seal(shape)
            if len(shape.times) >= 2 * CHUNK_ROWS or self._journal.size > self._reserve // 2:
                self.dropped += len(times)  # the disk is full: nothing leaves RAM or the journal
                continue
            columns = shape.clean(rows, self._limits.text_chars)
            definition = None if shape.number in self._announced else shape.definition
            first = shape.sealed + len(shape.times)
            blocks.append(Block.of(shape, definition, first, times, columns))
            accepted.append((shape, times, columns))
        if not blocks:
            return
        try:
            self._journal.append(blocks)
        except OSError as error:
            self.dropped += sum(len(times) for _, times, _ in accepted)
            self._journal_trouble.fail(error)
            return
        self._journal_trouble.succeed()
        for shape, times, columns in accepted:
            self._announced.add(shape.number)
            self._extend(shape, shape.epoch, times, columns)

    def _extend(
        self,
        shape: Shape,
        epoch: int,
        times: Sequence[int],
        columns: Sequence[Sequence[object]],
    ) -> None:
        self._end_epoch(shape, epoch)
        shape.extend(times, columns)
        if len(shape.times) >= CHUNK_ROWS:
            self._seal(shape)

    def _end_epoch(self, shape: Shape, epoch: int) -> None:
        """Make sure that a shape's tail is of ``epoch``, without mixing it with older rows."""
        if shape.times and shape.epoch != epoch and not self._seal(shape):
            self.dropped += len(shape.times)
            self._forget_tail(shape)
        shape.epoch = epoch

    def _forget_tail(self, shape: Shape) -> None:
        shape.sealed += len(shape.times)
        shape.clear()

    def _seal(self, shape: Shape) -> bool:
        """Move a tail into a chunk; say whether that worked."""
        if time.monotonic() < self._retry_at:
            return False
        data = pack(shape.times, shape.definition.kinds, shape.columns)
        sealed = shape.sealed + len(shape.times)
        try:
            self._forget_chunks(self._chunks.make_room(len(data)))
            chunk = self._chunks.put(shape, sealed, data)
        except sqlite3.Error as error:
            self._chunk_trouble.fail(error)
            self._retry_at = time.monotonic() + RETRY_S
            return False
        self._chunk_trouble.succeed()
        shape.stored = True
        shape.run(shape.epoch).add(chunk, shape.times[0], shape.times[-1])
        self._forget_tail(shape)
        return True

    def _forget_chunks(self, chunks: Sequence[tuple[int, int]]) -> None:
        for chunk, number in chunks:
            shape = self._shapes[number]
            for run in shape.runs:
                run.remove(chunk)
            shape.runs = [run for run in shape.runs if run.ids]

    def _sync(self) -> None:
        try:
            self._journal.sync()
        except OSError as error:
            self._journal_trouble.fail(error)

    def _compact(self) -> bool:
        """Rewrite the journal with nothing but the tails, after sealing those that are large.

        Returns:
            Whether that worked.
        """
        tails = sorted(
            (shape for shape in self._shapes.values() if shape.times), key=lambda tail: tail.weight
        )
        weight = sum(tail.weight for tail in tails)
        while tails and weight > self._reserve // 4:
            largest = tails.pop()
            weight -= largest.weight
            if not self._seal(largest):
                return False
        blocks = [
            Block.of(tail, tail.definition, tail.sealed, tail.times, tail.listed_columns()) for tail in tails
        ]
        try:
            # What leaves the journal has to be safe in the database first.
            self._chunks.checkpoint()
            self._journal.rewrite(blocks)
        except (OSError, sqlite3.Error) as error:
            self._journal_trouble.fail(error)
            return False
        self._announced = {tail.number for tail in tails}
        self._rewrite_at = max(self._reserve // 8, 2 * self._journal.size)
        return True

    def _retire(self, now: float, unix: float) -> None:
        """Delete what is too old, unless the clock was set since the last pass."""
        before, unix_before = self._retired_at
        self._retired_at = (now, unix)
        if abs((unix - unix_before) - (now - before)) > 60:
            # A clock that is wrong by years must not delete everything.
            return
        horizon = int((unix - self._limits.max_age_s) * 1e6)
        try:
            self._forget_chunks(self._chunks.drop_before(horizon))
        except sqlite3.Error as error:
            self._chunk_trouble.fail(error)
        for shape in self._shapes.values():
            if shape.times and shape.times[-1] < horizon:
                self._forget_tail(shape)

    def tags(self) -> list[tuple[str, str]]:
        """Return machine and tag of everything stored."""
        return list(self._intake.tags())

    def query(self, machine: str, keys: Sequence[str], grid: SampleGrid) -> dict[str, list[Value]]:
        """Sample series: see `Telemetry.query`."""
        return reader.query(lambda tag: self._intake.shapes_of(machine, tag), keys, grid, self._chunks)

    def history(self, machine: str, tag: str, count: int) -> list[Report]:
        """Return the latest reports of a tag, latest first."""
        return reader.history(self._intake.shapes_of(machine, tag), count, self._chunks)

    def close(self) -> None:
        """Sync and close the files."""
        self._sync()
        self._journal.close()
        with contextlib.suppress(sqlite3.Error):
            self._chunks.close()


def _open_chunks(path: Path, pages: int, wal_pages: int) -> ChunkFile:
    """Open the database; one that is damaged is put aside, for telemetry must not stop a start."""
    try:
        return ChunkFile(path, pages, wal_pages)
    except sqlite3.OperationalError:
        raise
    except sqlite3.DatabaseError as error:
        aside = path.with_name(f"{path.name}.damaged")
        path.replace(aside)
        for suffix in ("-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)
        _log.warning("telemetry: %s is damaged (%s), it is now %s", path, error, aside)
        return ChunkFile(path, pages, wal_pages)
