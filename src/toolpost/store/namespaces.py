"""What clients keep here for themselves: JSON values under keys, in namespaces.

Bounded, because nobody but the clients knows what of it is still needed. A row holds the value of one first
key, with all that is nested in it, as JSON.
"""

import sqlite3
from collections.abc import Sequence
from typing import Any, Final

import msgspec
from msgspec import UNSET, Raw

from toolpost.errors import InvalidRequestError, NotAcceptedError
from toolpost.store.database import QUERIES, Database

MAX_NAMESPACES: Final = 100
"""Namespaces that hold anything."""

MAX_NAMESPACE: Final = 128
"""Characters of a namespace's name."""

MAX_KEY: Final = 1024
"""Characters of a key, all its parts together."""

MAX_PARTS: Final = 16
"""Parts of a key."""

MAX_ITEMS: Final = 2000
"""First keys in all namespaces."""

MAX_VALUE: Final = 2**20
"""Bytes of the value of a first key as JSON, with all that is nested in it."""

MAX_DEPTH: Final = 64
"""Objects and arrays within each other in a value that is set."""

MAX_TOTAL: Final = 16 * 2**20
"""Bytes of all keys and values."""


class NamespaceStore:
    """Values by namespace and path: the parts of a key, each the name of a field in the one before.

    Args:
        database: where they are.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def names(self) -> list[str]:
        """Return the names of all namespaces; each holds something."""
        return [row[0] for row in self._database.read("namespaces")]

    def get(self, namespace: str, path: Sequence[str] = ()) -> object:
        """Return a value that msgspec can encode, or UNSET if there is none.

        Args:
            namespace: name of the namespace.
            path: parts of the key; none for all that the namespace holds.

        Raises:
            InvalidRequestError: there can be no such key.
        """
        _check_names(namespace, path)
        if not path:
            return self._whole(namespace)
        rows = self._database.read("namespace_item", namespace=namespace, key=path[0])
        if not rows:
            return UNSET
        if len(path) == 1:
            return Raw(rows[0][0])
        return _fields(msgspec.json.decode(rows[0][0]), path[1:-1]).get(path[-1], UNSET)

    async def put(self, namespace: str, path: Sequence[str], value: object) -> None:
        """Set a value, and make the namespace and the objects around it; it is on disk when this returns.

        Raises:
            InvalidRequestError: key or value are too long or deep, or a value around it is no object.
            NotAcceptedError: there is too much in the namespaces already.
            StorageError: it could not be stored, and the old value still holds.
        """
        _check_path(namespace, path)
        encoded = _encode(value)
        _check_size(encoded)
        key = path[0]

        def apply(connection: sqlite3.Connection) -> None:
            if _depth(value) > MAX_DEPTH:
                raise InvalidRequestError(f"value: must be nested at most {MAX_DEPTH} deep")
            stored = _stored(connection, namespace, key)
            item = encoded
            if len(path) > 1:
                item = _with_field(stored, path, encoded)
                _check_size(item)
            _check_room(connection, namespace, key, item, stored)
            _set(connection, namespace, key, item)

        await self._database.write(apply)

    async def delete(self, namespace: str, path: Sequence[str]) -> object:
        """Delete a value and return it, or UNSET if there is none; that is on disk when this returns.

        A namespace ends with the last value in it.

        Raises:
            InvalidRequestError: there can be no such key.
            StorageError: the disk did not take it, and the value is still there.
        """
        _check_path(namespace, path)
        key = path[0]

        def apply(connection: sqlite3.Connection) -> object:
            stored = _stored(connection, namespace, key)
            if stored is None:
                return UNSET
            if len(path) == 1:
                connection.execute(QUERIES["delete_namespace_item"], {"namespace": namespace, "key": key})
                return Raw(stored)
            root = msgspec.json.decode(stored)
            deleted = _fields(root, path[1:-1]).pop(path[-1], UNSET)
            if deleted is not UNSET:
                _set(connection, namespace, key, _encode(root))
            return deleted

        return await self._database.write(apply)

    def _whole(self, namespace: str) -> object:
        # Put together as it is stored: nothing of up to MAX_TOTAL bytes is decoded on the event loop.
        parts: list[bytes] = []
        for key, value in self._database.read("namespace_items", namespace=namespace):
            parts += (b"," if parts else b"{", _encode(key), b":", value)
        return Raw(b"".join([*parts, b"}"])) if parts else UNSET


def _check_names(namespace: str, path: Sequence[str]) -> None:
    if not 0 < len(namespace) <= MAX_NAMESPACE:
        raise InvalidRequestError(f"namespace: must have 1 to {MAX_NAMESPACE} characters")
    if len(path) > MAX_PARTS:
        raise InvalidRequestError(f"key: must have at most {MAX_PARTS} parts")
    if not all(path):
        raise InvalidRequestError("key: must have no empty part")
    if sum(map(len, path)) > MAX_KEY:
        raise InvalidRequestError(f"key: must have at most {MAX_KEY} characters")


def _check_path(namespace: str, path: Sequence[str]) -> None:
    _check_names(namespace, path)
    if not path:
        raise InvalidRequestError("key: must not be empty")


def _check_size(encoded: bytes) -> None:
    if len(encoded) > MAX_VALUE:
        raise InvalidRequestError(
            f"value: must be at most {MAX_VALUE} bytes of JSON, with all else under the key's first part"
        )


def _check_room(
    connection: sqlite3.Connection, namespace: str, key: str, item: bytes, stored: bytes | None
) -> None:
    """Check the bounds of all together; what grows nothing is always let in."""
    items, namespaces, total = connection.execute(QUERIES["namespace_totals"]).fetchone()
    grown = _size(namespace, key, item)
    if stored is not None:
        grown -= _size(namespace, key, stored)
    elif items >= MAX_ITEMS:
        raise NotAcceptedError(f"there are {items} items in the namespaces; delete some")
    elif namespaces >= MAX_NAMESPACES and (namespace,) not in connection.execute(QUERIES["namespaces"]):
        raise NotAcceptedError(f"there are {namespaces} namespaces; delete what is in one")
    if grown > 0 and total + grown > MAX_TOTAL:
        raise NotAcceptedError(f"the namespaces would hold more than {MAX_TOTAL} bytes; delete some items")


def _stored(connection: sqlite3.Connection, namespace: str, key: str) -> bytes | None:
    row = connection.execute(QUERIES["namespace_item"], {"namespace": namespace, "key": key}).fetchone()
    return None if row is None else row[0]


def _set(connection: sqlite3.Connection, namespace: str, key: str, item: bytes) -> None:
    row = {
        "namespace": namespace,
        "key": key,
        "size": _size(namespace, key, item),
        "value": item,
    }
    connection.execute(QUERIES["set_namespace_item"], row)


def _size(namespace: str, key: str, item: bytes) -> int:
    return len(namespace.encode()) + len(key.encode()) + len(item)


def _with_field(stored: bytes | None, path: Sequence[str], encoded: bytes) -> bytes:
    """Return the value of a first key with one field in it set."""
    root = {} if stored is None else msgspec.json.decode(stored)
    inner = root
    for depth, part in enumerate(path[1:], start=1):
        if not isinstance(inner, dict):
            raise InvalidRequestError(f"key: what is at '{'.'.join(path[:depth])}' is no object")
        if depth == len(path) - 1:
            inner[part] = Raw(encoded)
        else:
            inner = inner.setdefault(part, {})
    return _encode(root)


def _fields(value: Any, path: Sequence[str]) -> dict[str, Any]:  # noqa: ANN401  # any JSON
    """Return the fields of the object at a path within a value; none if there is no object."""
    for part in path:
        if not isinstance(value, dict):
            return {}
        value = value.get(part)
    return value if isinstance(value, dict) else {}


def _encode(value: object) -> bytes:
    try:
        return msgspec.json.encode(value)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InvalidRequestError(f"value: cannot be stored: {error}") from None


def _depth(value: object) -> int:
    """Return how many objects and arrays are within each other, as far as one too many."""
    depth = 0
    level = [value] if isinstance(value, dict | list) else []
    while level and depth <= MAX_DEPTH:
        depth += 1
        inner = [child for node in level for child in (node.values() if isinstance(node, dict) else node)]
        level = [child for child in inner if isinstance(child, dict | list)]
    return depth
