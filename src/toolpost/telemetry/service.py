"""`Telemetry`: what the rest of the server sees of the reports and their history."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import TypeVar

from toolpost.core.grid import SampleGrid
from toolpost.core.report import Report, Value
from toolpost.telemetry.limits import Limits
from toolpost.telemetry.store import Store

FLUSH_S = 1.0
"""Most seconds that a report waits before it is written; a kill loses no more than that."""
FLUSH_REPORTS = 4_096
"""Pending reports that are written at once."""
MAX_COUNT = 10_000
"""Most reports that `Telemetry.history` returns."""

_log = logging.getLogger(__name__)
_T = TypeVar("_T")
_DEFAULTS = Limits()


class _Ring(deque[Report]):
    """The latest reports of one tag. ``complete`` while it has all that there ever were."""

    __slots__ = ("_complete",)

    def __init__(self, size: int, latest: Report | None = None) -> None:
        super().__init__(() if latest is None else (latest,), size)
        self._complete = latest is None

    def has(self, count: int) -> bool:
        """Say whether the latest ``count`` reports are all here."""
        return len(self) >= count or (self._complete and len(self) < (self.maxlen or 0))


class Telemetry:
    """The latest reports per machine and tag, and every series on disk.

    Make it with `open`. Everything but `open` belongs to one event loop.
    """

    def __init__(
        self,
        store: Store,
        thread: ThreadPoolExecutor,
        latest: dict[tuple[str, str], Report],
        limits: Limits,
    ) -> None:
        """Use `open` instead."""
        self._store = store
        self._thread = thread
        self._limits = limits
        self._pending: list[tuple[str, Report]] = []
        self._timer: asyncio.TimerHandle | None = None
        self._writing: Future[None] | None = None
        self._overflow = 0
        self._closed = False
        self._rings: dict[str, dict[str, _Ring]] = {}
        for (machine, tag), report in latest.items():
            self._rings.setdefault(machine, {})[tag] = _Ring(limits.ring_reports, report)

    @classmethod
    def open(cls, directory: Path, limits: Limits = _DEFAULTS) -> "Telemetry":
        """Open or make ``telemetry.db`` and ``telemetry.journal`` in ``directory``. Blocks.

        Raises:
            StorageError: the files cannot be opened or made.
        """
        thread = ThreadPoolExecutor(1, "telemetry")
        try:
            store, latest = thread.submit(_open, directory, limits).result()
        except BaseException:
            thread.shutdown()
            raise
        return cls(store, thread, latest, limits)

    @property
    def dropped(self) -> int:
        """Reports that were not stored since `open`: disk full, clock set back, beyond a limit."""
        return self._store.dropped + self._overflow

    def record(self, machine: str, report: Report) -> None:
        """Take in a report. Call it on the event loop; it never blocks and never raises.

        The report can be read at once; it is on disk within a second. A report whose time is
        up to 5 s before its predecessor's is kept in RAM only.
        """
        try:
            ring = self._rings[machine][report.tag]
        except KeyError:
            tags = self._rings.setdefault(machine, {})
            if len(tags) >= self._limits.tags_per_machine:
                self._overflow += 1
                return
            ring = tags[report.tag] = _Ring(self._limits.ring_reports)
        ring.append(report)
        pending = self._pending
        pending.append((machine, report))
        if self._timer is None or len(pending) >= FLUSH_REPORTS:
            self._schedule()

    def _schedule(self) -> None:
        """See to it that what is pending gets written."""
        if self._closed:
            self._overflow += len(self._pending)
            self._pending.clear()
        elif len(self._pending) > self._limits.pending_reports:
            self._pending.pop()
            self._overflow += 1
        elif len(self._pending) >= FLUSH_REPORTS and self._is_idle():
            self._flush()
        elif self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(FLUSH_S, self._on_timer)

    def _is_idle(self) -> bool:
        return self._writing is None or self._writing.done()

    def _on_timer(self) -> None:
        self._timer = None
        if self._is_idle():
            self._flush()
        elif self._pending:
            self._schedule()

    def _flush(self) -> None:
        self._writing = self._thread.submit(self._write, self._take_pending())

    def _take_pending(self) -> list[tuple[str, Report]]:
        batch, self._pending = self._pending, []
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        return batch

    def _write(self, batch: list[tuple[str, Report]]) -> None:
        """Store a batch, in the store's thread; a defect there must not stop the server."""
        try:
            self._store.append(batch)
        except Exception:  # noqa: BLE001 (logged with its traceback; the job stream must go on)
            _log.exception("telemetry: %d reports are lost", len(batch))

    async def _call(self, function: Callable[[], _T]) -> _T:
        """Run a function in the store's thread, after writing what is pending."""
        batch = self._take_pending()

        def run() -> _T:
            if batch:
                self._write(batch)
            return function()

        return await asyncio.get_running_loop().run_in_executor(self._thread, run)

    def latest(self, machine: str, tag: str) -> Report | None:
        """Return the latest report of a tag, which may be from before a restart; from RAM."""
        ring = self._rings.get(machine, {}).get(tag)
        return ring[-1] if ring else None

    async def history(self, machine: str, tag: str, count: int) -> list[Report]:
        """Return the latest reports of a tag, latest reception first.

        Args:
            machine: the machine's name.
            tag: the reports' tag.
            count: most reports to return, 1 to `MAX_COUNT`.

        Raises:
            ValueError: ``count`` is out of range.
        """
        if count < 1:
            raise ValueError("count: must be > 0")
        if count > MAX_COUNT:
            raise ValueError("count: too big")
        ring = self._rings.get(machine, {}).get(tag)
        if ring is None:
            return []
        if ring.has(count):
            return list(islice(reversed(ring), count))
        return await self._call(lambda: self._store.history(machine, tag, count))

    async def query(self, machine: str, keys: Sequence[str], grid: SampleGrid) -> dict[str, list[Value]]:
        """Sample series by the rule of `spark_spooler.md /query-ts`.

        Args:
            machine: the machine's name.
            keys: ``<tag>.<key>`` each; a key may contain dots, a tag has none.
            grid: the samples.

        Returns:
            For every key one value per sample: the latest in ``[T - step, T]``, both ends
            included, None where there is none. Unknown keys have None throughout. Treat the
            lists as read-only: keys without data share one.
        """
        return await self._call(lambda: self._store.query(machine, keys, grid))

    async def close(self) -> None:
        """Write what is pending and close the files. Later reports are dropped."""
        if self._closed:
            return
        self._closed = True
        try:
            await self._call(self._store.close)
        finally:
            self._thread.shutdown(wait=False)


def _open(directory: Path, limits: Limits) -> tuple[Store, dict[tuple[str, str], Report]]:
    store = Store(directory, limits)
    latest = {}
    for machine, tag in store.tags():
        for report in store.history(machine, tag, 1):
            latest[machine, tag] = report
    return store, latest
