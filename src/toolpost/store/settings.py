"""Settings of machines that clients write, such as the init lines."""

import asyncio
import sqlite3
from typing import Any

import msgspec

from toolpost.store.database import QUERIES, Database


class SettingStore:
    """Named values of each machine, kept as JSON.

    Args:
        database: where they are.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def get(self, machine: str, name: str) -> Any:  # noqa: ANN401  # whatever JSON holds
        """Return a value, or None if it was never set."""
        rows = self._database.read("get_setting", machine=machine, name=name)
        return msgspec.json.decode(rows[0][0]) if rows else None

    async def set(self, machine: str, name: str, value: object) -> None:
        """Set a value; it is on disk when this returns.

        Raises:
            StorageError: it could not be stored, and the old value still holds.
        """
        await self.submit(machine, name, value)

    def submit(self, machine: str, name: str, value: object) -> "asyncio.Future[None]":
        """Set a value, in order with all changes of the database; the future is done as `set` returns."""
        row = {"machine": machine, "name": name, "value": msgspec.json.encode(value).decode()}

        def apply(connection: sqlite3.Connection) -> None:
            connection.execute(QUERIES["set_setting"], row)

        return self._database.submit(apply)
