"""The sealed chunks: one SQLite file, of which chunks are read column by column."""

import contextlib
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import msgspec

from toolpost.telemetry.columns import Column, Head, PackedRows
from toolpost.telemetry.recent import Recent
from toolpost.telemetry.shape import Shape, ShapeDef

PAGE_BYTES = 16_384
_CACHE_KIB = 2_048
_KEPT_TIMES = 1 << 20
_KEPT_VALUES = 1 << 20
"""Times (4 bytes each) and values (mostly 1 or 2) that stay in RAM after a query."""

SQL = dict(
    re.findall(
        r"^-- (\w+) --\n(.*?)(?=^-- \w+ --$|\Z)",
        Path(__file__).with_name("chunks.sql").read_text("utf-8"),
        re.MULTILINE | re.DOTALL,
    )
)


class ChunkFile:
    """The database. Use it in the thread that made it. Methods raise sqlite3.Error.

    Args:
        path: the file; it is made if missing.
        max_pages: pages of `PAGE_BYTES` that the file may have.
        wal_pages: pages of the WAL that start a checkpoint.
    """

    def __init__(self, path: Path, max_pages: int, wal_pages: int) -> None:
        self._max_pages = max_pages
        self._heads = Recent[int, Head](_KEPT_TIMES)
        self._columns = Recent[tuple[int, int], Column](_KEPT_VALUES)
        self._db = sqlite3.connect(path, isolation_level=None)
        try:
            for pragma in (
                f"page_size = {PAGE_BYTES}",
                "auto_vacuum = INCREMENTAL",
                "journal_mode = WAL",
                "synchronous = NORMAL",
                f"cache_size = -{_CACHE_KIB}",
                f"wal_autocheckpoint = {wal_pages}",
                f"journal_size_limit = {wal_pages * PAGE_BYTES}",
                f"max_page_count = {max_pages}",
            ):
                self._db.execute(f"PRAGMA {pragma}").close()
            self._db.executescript(SQL["schema"])
            self._next_id = 1
        except BaseException:
            self._db.close()
            raise

    def load(self) -> dict[int, Shape]:
        """Return every shape by its number, with the index of its chunks and an empty tail."""
        shapes: dict[int, Shape] = {}
        decoder = msgspec.msgpack.Decoder(ShapeDef)
        for number, definition, sealed in self._db.execute(SQL["shapes"]):
            shape = shapes[number] = Shape(number, decoder.decode(definition))
            shape.sealed, shape.stored = sealed, True
        for chunk, number, epoch, first_us, last_us in self._db.execute(SQL["chunks"]):
            shapes[number].run(epoch).add(chunk, first_us, last_us)
            self._next_id = chunk + 1
        return shapes

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._db.execute("COMMIT")
        except BaseException:
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            raise

    def put(self, shape: Shape, sealed: int, data: bytes) -> int:
        """Store a chunk made of the shape's tail; return its number.

        Args:
            shape: the shape; its definition is stored too if it is not yet.
            sealed: the shape's new number of sealed rows.
            data: the packed rows.
        """
        chunk = self._next_id
        first_us, last_us = shape.times[0], shape.times[-1]
        with self._transaction():
            self._put_shape(shape, sealed)
            self._db.execute(SQL["put_chunk"], (chunk, shape.number, shape.epoch, first_us, last_us))
            self._db.execute(SQL["put_body"], (chunk, data))
        self._next_id += 1
        return chunk

    def _put_shape(self, shape: Shape, sealed: int) -> None:
        definition = msgspec.msgpack.encode(shape.definition)
        self._db.execute(SQL["put_shape"], (shape.number, definition, sealed))

    def forget(self, shape: Shape) -> None:
        """Remove the definition of a shape that has no rows left."""
        self._db.execute(SQL["drop_shape"], (shape.number,))

    def make_room(self, data_bytes: int) -> list[tuple[int, int]]:
        """Delete the oldest chunks until ``data_bytes`` more fit.

        Returns:
            The number and the shape's number of every deleted chunk.
        """
        need = data_bytes // (PAGE_BYTES - 4) + 4
        gone: list[tuple[int, int]] = []
        while self._used_pages() + need > self._max_pages:
            oldest = self._db.execute(SQL["oldest"], (4,)).fetchall()
            if not oldest:
                break
            self._delete(oldest)
            gone += oldest
        return gone

    def drop_before(self, time_us: int) -> list[tuple[int, int]]:
        """Delete the chunks that end before a Unix time; return as `make_room` does."""
        aged = self._db.execute(SQL["aged"], (time_us,)).fetchall()
        if aged:
            self._delete(aged)
        return aged

    def _delete(self, chunks: list[tuple[int, int]]) -> None:
        numbers = [(chunk,) for chunk, _ in chunks]
        with self._transaction():
            self._db.executemany(SQL["drop_chunk"], numbers)
            self._db.executemany(SQL["drop_body"], numbers)

    def _pragma(self, name: str) -> int:
        return int(self._db.execute(f"PRAGMA {name}").fetchone()[0])

    def _used_pages(self) -> int:
        return self._pragma("page_count") - self._pragma("freelist_count")

    def shrink(self) -> None:
        """Give pages back to the file system if the file is longer than allowed."""
        excess = self._pragma("page_count") - self._max_pages
        if excess > 0:
            self._db.execute(f"PRAGMA incremental_vacuum({excess})").fetchall()

    def open_blob(self, chunk: int) -> sqlite3.Blob:
        """Open the packed rows of a chunk for reading; the caller closes them."""
        return self._db.blobopen("body", "data", chunk, readonly=True)

    def open_rows(self, chunk: int, columns: int) -> "ChunkRows":
        """Open a chunk of so many columns for reading."""
        return ChunkRows(self, chunk, columns, self._heads, self._columns)

    def checkpoint(self) -> None:
        """Make every chunk survive a loss of power."""
        self._db.execute("PRAGMA wal_checkpoint(FULL)").fetchall()

    def close(self) -> None:
        """Close the file."""
        self._db.close()


class ChunkRows:
    """The rows of a chunk. Close it; the database is read only for what is not in RAM."""

    __slots__ = ("_blob", "_chunk", "_columns", "_file", "_head", "first_us", "offsets", "rows")

    def __init__(
        self,
        file: ChunkFile,
        chunk: int,
        columns: int,
        heads: Recent[int, Head],
        kept: Recent[tuple[int, int], Column],
    ) -> None:
        self._file = file
        self._chunk = chunk
        self._columns = kept
        self._blob: sqlite3.Blob | None = None
        head = heads.get(chunk)
        if head is None:
            head = Head(self._opened(), columns)
            heads.put(chunk, head, head.rows)
        self._head = head
        self.rows = head.rows
        self.first_us = head.first_us
        self.offsets = head.offsets

    def _opened(self) -> sqlite3.Blob:
        if self._blob is None:
            self._blob = self._file.open_blob(self._chunk)
        return self._blob

    def column(self, place: int) -> Column:
        """Return the column at ``place``."""
        key = (self._chunk, place)
        column = self._columns.get(key)
        if column is None:
            column = PackedRows(self._opened(), self._head).column(place)
            self._columns.put(key, column, self.rows)
        return column

    def close(self) -> None:
        """Close what was opened."""
        if self._blob is not None:
            self._blob.close()
