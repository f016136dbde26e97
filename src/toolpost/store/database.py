"""The database of jobs: SQLite, one writer.

A dedicated thread makes all changes. What has queued up while one transaction was being synced goes into the
next one together, so that many callers share one sync. A change is on disk when its future is done.
"""

import asyncio
import contextlib
import logging
import queue
import sqlite3
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

import msgspec

from toolpost.errors import StartError, StorageError
from toolpost.store.sql import load_migrations, load_queries

T = TypeVar("T")
Rows: TypeAlias = list[tuple[Any, ...]]

QUERIES = load_queries()

CLOSE_TIMEOUT = 5.0
"""Seconds that a close waits for changes to be made."""

log = logging.getLogger(__name__)


class _Change(msgspec.Struct):
    """One caller's change and what is to be told of it."""

    apply: Callable[[sqlite3.Connection], object]
    future: "asyncio.Future[Any]"
    result: object = None
    error: Exception | None = None


class Database:
    """The database and its writer thread.

    Args:
        path: the database file; made if missing.

    Raises:
        StartError: the file cannot be opened, is damaged, or was written by a newer version.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._connection = _open(path)
            # Its own connection: a read on the event loop must not wait for a commit to be synced.
            self._reader = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
        except sqlite3.Error as error:
            raise StartError(f"{path}: {error}") from None
        self._version = 0
        self._changes: queue.SimpleQueue[_Change | None] = queue.SimpleQueue()
        self._loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._write_all, name="database", daemon=True)
        self._thread.start()

    async def write(self, apply: Callable[[sqlite3.Connection], T]) -> T:
        """Run `apply` inside a transaction and return its result once it is on disk.

        Changes are made in the order of the calls.

        Raises:
            StorageError: the disk did not take it; nothing of it was kept.
        """
        return await self.submit(apply)

    def submit(self, apply: Callable[[sqlite3.Connection], T]) -> "asyncio.Future[T]":
        """Queue a change, in order with all others, and return its future, as `write`."""
        future: asyncio.Future[T] = self._loop.create_future()
        self._changes.put(_Change(apply, future))
        return future

    def read(self, name: str, /, **parameters: object) -> Rows:
        """Return the rows of a named query, as they are on disk now."""
        return cast("Rows", self._reader.execute(QUERIES[name], parameters).fetchall())

    def changed_elsewhere(self) -> bool:
        """Whether another process has changed the database since the last call."""
        version: int = self._reader.execute("PRAGMA data_version").fetchone()[0]
        changed, self._version = version != self._version, version
        return changed

    def close(self) -> None:
        """Make the changes already queued and close the file; a disk that hangs is not waited for long."""
        self._reader.close()
        self._changes.put(None)
        self._thread.join(CLOSE_TIMEOUT)
        if self._thread.is_alive():
            log.error("the database did not finish in %g s: the disk hangs", CLOSE_TIMEOUT)
        else:
            self._connection.close()

    def _write_all(self) -> None:
        """Make changes until None comes; runs in the thread."""
        while True:
            group = [self._changes.get()]
            while not self._changes.empty():
                group.append(self._changes.get())
            changes = [change for change in group if change is not None]
            if changes:
                self._commit(changes)
                self._loop.call_soon_threadsafe(_tell, changes)
            if None in group:
                return

    def _commit(self, changes: list[_Change]) -> None:
        connection = self._connection
        try:
            connection.execute("BEGIN IMMEDIATE")
            for change in changes:
                connection.execute("SAVEPOINT change")
                try:
                    change.result = change.apply(connection)
                except Exception as error:  # whatever it is, the caller is told
                    change.error = error
                    if not connection.in_transaction:
                        raise  # On a full disk SQLite rolls the whole transaction back by itself.
                    connection.execute("ROLLBACK TO change")
                connection.execute("RELEASE change")
            connection.execute("COMMIT")
        except sqlite3.Error as error:
            for change in changes:
                change.error = change.error or error
            if connection.in_transaction:
                with contextlib.suppress(sqlite3.Error):
                    connection.execute("ROLLBACK")


def _tell(changes: list[_Change]) -> None:
    for change in changes:
        if change.future.done():
            continue
        if change.error is None:
            change.future.set_result(change.result)
        elif isinstance(change.error, sqlite3.IntegrityError):
            change.future.set_exception(change.error)
        elif isinstance(change.error, sqlite3.Error):
            change.future.set_exception(StorageError(f"could not be stored: {change.error}"))
        else:
            change.future.set_exception(change.error)


def _open(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA journal_size_limit = 4194304")
        _migrate(connection, path)
    except BaseException:
        connection.close()
        raise
    return connection


def _migrate(connection: sqlite3.Connection, path: Path) -> None:
    migrations = load_migrations()
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version > len(migrations):
        raise StartError(
            f"{path}: written by a newer version of Toolpost (schema {version}, "
            f"this version knows {len(migrations)})"
        )
    for number, script in enumerate(migrations[version:], start=version + 1):
        connection.executescript(f"BEGIN;\n{script}\nPRAGMA user_version = {number};\nCOMMIT;")
