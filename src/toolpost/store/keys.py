"""API keys: only their hashes are kept.

A key is 256 random bits, so a plain SHA-256 of it cannot be guessed back; hashes are compared in constant
time.
"""

import hashlib
import hmac
import secrets
import sqlite3

import msgspec

from toolpost.clock import now_us
from toolpost.store.database import QUERIES, Database


class ApiKey(msgspec.Struct, frozen=True):
    """What is known of a key: its name, its hash, and when it was made (Unix µs)."""

    name: str
    sha256: bytes
    created_us: int


class KeyStore:
    """The API keys.

    Args:
        database: where they are.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._keys = self._load()

    def names(self) -> list[str]:
        """Return the names of all keys."""
        return [key.name for key in self._keys]

    def owner(self, secret: str) -> str | None:
        """Return the name of the key that `secret` is, or None."""
        if self._database.changed_elsewhere():
            self._keys = self._load()
        digest = hashlib.sha256(secret.encode("utf-8", "surrogatepass")).digest()
        found = None
        for key in self._keys:
            if hmac.compare_digest(key.sha256, digest):
                found = key.name
        return found

    async def add(self, name: str) -> str | None:
        """Make a key and return it; it is shown this once. None if the name is taken."""
        secret = secrets.token_urlsafe(32)
        row = {
            "name": name,
            "sha256": hashlib.sha256(secret.encode()).digest(),
            "created_us": now_us(),
        }

        def apply(connection: sqlite3.Connection) -> None:
            connection.execute(QUERIES["insert_key"], row)

        try:
            await self._database.write(apply)
        except sqlite3.IntegrityError:
            return None
        self._keys = self._load()
        return secret

    async def delete(self, name: str) -> bool:
        """Delete a key; return whether there was one of that name."""

        def apply(connection: sqlite3.Connection) -> int:
            return connection.execute(QUERIES["delete_key"], {"name": name}).rowcount

        deleted = await self._database.write(apply)
        self._keys = self._load()
        return deleted > 0

    def _load(self) -> list[ApiKey]:
        return [ApiKey(*row) for row in self._database.read("keys")]
