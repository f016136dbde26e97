"""Databases for tests, and disks that are full on demand."""

import asyncio
from contextlib import contextmanager

from toolpost.core.job import Job
from toolpost.store.database import Database


@contextmanager
def opened(path):
    """A database, closed at the end whatever happens."""
    database = Database(path)
    try:
        yield database
    finally:
        database.close()


async def fill(database):
    """Let SQLite find the disk full from now on: no page is to be had beyond those there are."""

    def limit(connection):
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        connection.execute(f"PRAGMA max_page_count = {pages}")

    await database.write(limit)


async def free(database):
    """Let there be room again."""
    await database.write(
        lambda connection: connection.execute("PRAGMA max_page_count = 1073741823").fetchone()
    )


def run(main):
    """Run a coroutine function to its end."""
    return asyncio.run(main())


def job(seq, **values):
    return Job(
        **{"seq": seq, "id": f"J{seq}", "machine": "m", "program": "p" * 64, "commands": 3, "created_us": 10}
        | values
    )
