import asyncio
import sqlite3
import threading

import pytest

from tests.store.storing import fill, free, opened, run
from toolpost.errors import StartError, StorageError
from toolpost.store import database as module
from toolpost.store.database import Database
from toolpost.store.sql import load_migrations, load_queries

BIG = "x" * 20_000


def put(name, value="1"):
    row = ("m", name, value)
    return lambda connection: connection.execute("INSERT INTO machine_setting VALUES (?, ?, ?)", row)


def names(path):
    with sqlite3.connect(path) as connection:
        rows = connection.execute("SELECT name FROM machine_setting ORDER BY name").fetchall()
    connection.close()
    return [row[0] for row in rows]


class Blocked:
    """A change that holds the writer up, so that what comes behind it becomes one group."""

    def __init__(self, database):
        self.go = threading.Event()
        started = threading.Event()
        self.future = database.submit(lambda _: started.set() or self.go.wait(10))
        assert started.wait(10)


def test_a_change_is_on_disk_when_its_future_is_done(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            assert await database.write(lambda _: 42) == 42
            await database.write(put("a"))
            assert names(tmp_path / "d.db") == ["a"]

    run(main)


def test_a_group_is_committed_in_order_with_one_commit(tmp_path):
    order, done, statements = [], [], []

    def noted(n):
        def change(connection):
            order.append(n)
            put(f"{n:02}")(connection)

        return change

    async def main():
        with opened(tmp_path / "d.db") as database:
            blocked = Blocked(database)
            database._connection.set_trace_callback(statements.append)
            futures = [database.submit(noted(n)) for n in range(20)]
            for n, future in enumerate(futures):
                future.add_done_callback(lambda _, n=n: done.append(n))
            blocked.go.set()
            await asyncio.gather(blocked.future, *futures)
            database._connection.set_trace_callback(None)

    run(main)
    assert order == done == list(range(20))
    assert statements.count("COMMIT") == 2
    assert names(tmp_path / "d.db") == [f"{n:02}" for n in range(20)]


def test_one_failing_change_leaves_the_others_of_its_group(tmp_path):
    def half(connection):
        put("half")(connection)
        raise ValueError("no")

    async def main():
        with opened(tmp_path / "d.db") as database:
            blocked = Blocked(database)
            changes = [put("a"), half, put("b"), put("a"), lambda c: c.execute("SELECT nonsense"), put("c")]
            futures = [database.submit(change) for change in changes]
            blocked.go.set()
            return await asyncio.gather(*futures, return_exceptions=True)

    results = run(main)
    kinds = [type(result) for result in results]
    assert [kinds[i] for i in (1, 3, 4)] == [ValueError, sqlite3.IntegrityError, StorageError]
    assert not any(isinstance(results[i], Exception) for i in (0, 2, 5))
    assert names(tmp_path / "d.db") == ["a", "b", "c"]


def test_a_full_disk_is_a_storage_error_and_passes(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            await fill(database)
            with pytest.raises(StorageError, match="full"):
                await database.write(put("big", BIG))
            assert names(tmp_path / "d.db") == []
            await free(database)
            await database.write(put("big", BIG))

    run(main)
    assert names(tmp_path / "d.db") == ["big"]


def test_in_a_group_on_a_full_disk_nobody_is_told_too_much(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            await fill(database)
            blocked = Blocked(database)
            futures = [
                database.submit(put(name, value)) for name, value in (("a", "1"), ("b", BIG), ("c", "1"))
            ]
            blocked.go.set()
            await blocked.future
            return await asyncio.gather(*futures, return_exceptions=True)

    results = run(main)
    assert isinstance(results[1], StorageError)
    assert all("full" in str(result) for result in results if isinstance(result, Exception))
    told = [name for name, result in zip("abc", results, strict=True) if not isinstance(result, Exception)]
    assert names(tmp_path / "d.db") == told


def test_a_failing_commit_fails_all(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            # A deferred foreign key is looked at by COMMIT only.
            def orphan(connection):
                connection.execute("PRAGMA defer_foreign_keys = ON")
                connection.execute(
                    "INSERT INTO job_event (job, time_us, actor, state, reason, detail) "
                    "VALUES (99, 1, '', '', '', '')"
                )

            blocked = Blocked(database)
            futures = [database.submit(put("a")), database.submit(orphan)]
            blocked.go.set()
            results = await asyncio.gather(*futures, return_exceptions=True)
            assert all(isinstance(result, sqlite3.IntegrityError) for result in results)
            await database.write(put("after"))

    run(main)
    assert names(tmp_path / "d.db") == ["after"]


def test_close_makes_what_is_queued(tmp_path):
    async def main():
        database = Database(tmp_path / "d.db")
        futures = [database.submit(put(str(n))) for n in range(5)]
        database.close()
        await asyncio.gather(*futures)

    run(main)
    assert names(tmp_path / "d.db") == list("01234")


def test_a_canceled_future_is_nobodys_error(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            database.submit(put("a")).cancel()
            await database.write(put("b"))

    run(main)
    assert names(tmp_path / "d.db") == ["a", "b"]


def test_durable_settings(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            ask = database._connection.execute
            assert ask("PRAGMA journal_mode").fetchone() == ("wal",)
            assert ask("PRAGMA synchronous").fetchone() == (2,)
            assert ask("PRAGMA foreign_keys").fetchone() == (1,)

    run(main)


# Opening.


def refused(path):
    async def main():
        with pytest.raises(StartError) as caught:
            Database(path)
        return str(caught.value)

    return run(main)


def test_a_newer_schema_is_refused_and_left_alone(tmp_path):
    path = tmp_path / "d.db"
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    message = refused(path)
    assert str(path) in message
    assert "newer version of Toolpost (schema 99" in message
    connection = sqlite3.connect(path)
    assert connection.execute("SELECT name FROM sqlite_master").fetchall() == []
    connection.close()


def test_what_is_no_database_is_refused(tmp_path):
    path = tmp_path / "d.db"
    path.write_bytes(b"hello, this is not SQLite" * 100)
    assert str(path) in refused(path)
    assert path.read_bytes().startswith(b"hello")


def test_what_cannot_be_opened_is_refused(tmp_path):
    assert "no" in refused(tmp_path / "no" / "d.db")


def version(path):
    connection = sqlite3.connect(path)
    result = connection.execute("PRAGMA user_version").fetchone()[0]
    connection.close()
    return result


def test_migrations_go_on_from_where_they_were(tmp_path, monkeypatch):
    path = tmp_path / "d.db"

    async def reopen():
        with opened(path) as database:
            await database.write(put(str(version(path))))

    run(reopen)
    known = load_migrations()
    assert version(path) == len(known)
    more = [*known, "ALTER TABLE api_key ADD COLUMN note TEXT;"]
    monkeypatch.setattr(module, "load_migrations", lambda: more)
    run(reopen)
    assert version(path) == len(known) + 1
    assert names(path) == [str(len(known)), str(len(known) + 1)]


def test_a_failing_migration_changes_nothing(tmp_path, monkeypatch):
    path = tmp_path / "d.db"

    async def open_it():
        with opened(path):
            pass

    run(open_it)
    known = load_migrations()
    broken = [*known, "CREATE TABLE extra (a);\nINSERT INTO nowhere VALUES (1);"]
    monkeypatch.setattr(module, "load_migrations", lambda: broken)
    assert "nowhere" in refused(path)
    assert version(path) == len(known)
    monkeypatch.setattr(module, "load_migrations", lambda: [*known, "CREATE TABLE extra (a);"])
    run(open_it)
    assert version(path) == len(known) + 1


def test_every_query_is_valid_sql(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            for name, statement in load_queries().items():
                words = {word.strip(":,();\n") for word in statement.split() if word.startswith((":", "(:"))}
                database._connection.execute(f"EXPLAIN {statement}", dict.fromkeys(words, 1)), name

    run(main)
