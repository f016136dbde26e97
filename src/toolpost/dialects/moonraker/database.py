"""The database in which clients keep what is theirs (external_api/database.md). All machines share it."""

from typing import Any

import msgspec
from msgspec import UNSET

from toolpost.dialects.moonraker.connections import Connection
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.rpc import Method, NoParams
from toolpost.events import Event
from toolpost.shop import Shop


class GetItemParams(msgspec.Struct, frozen=True):
    """A value, or a whole namespace; dots in a key, or the places in a list, lead into objects."""

    namespace: str
    key: str | list[str] | None = None


class PostItemParams(msgspec.Struct, frozen=True):
    """A value to be set."""

    namespace: str
    key: str | list[str]
    value: Any


class DeleteItemParams(msgspec.Struct, frozen=True):
    """A value to be deleted."""

    namespace: str
    key: str | list[str]


class Item(msgspec.Struct, frozen=True):
    """The answer: what was asked for, and the value that is or was there."""

    namespace: str
    key: str | list[str] | None
    value: Any


class DatabaseMethods:
    """The namespaces.

    Args:
        shop: has them.
    """

    def __init__(self, shop: Shop) -> None:
        self._namespaces = shop.namespaces

    def methods(self) -> list[Method]:
        """Return the methods."""
        name, path = "server.database", "/server/database"
        item = f"{path}/item"
        return [
            Method(f"{name}.list", ("GET", f"{path}/list"), NoParams, self.list_namespaces),
            Method(f"{name}.get_item", ("GET", item), GetItemParams, self.get_item),
            Method(f"{name}.post_item", ("POST", item), PostItemParams, self.post_item),
            Method(f"{name}.delete_item", ("DELETE", item), DeleteItemParams, self.delete_item),
        ]

    async def list_namespaces(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.database.list``. Backups are not made over this API, so there are none."""
        return {"namespaces": self._namespaces.names(), "backups": []}

    async def get_item(self, params: GetItemParams, connection: Connection) -> Item:  # noqa: ARG002
        """``server.database.get_item``."""
        path = [] if params.key is None else _path(params.key)
        return self._item(params, path, self._namespaces.get(params.namespace, path))

    async def post_item(self, params: PostItemParams, connection: Connection) -> Item:  # noqa: ARG002
        """``server.database.post_item``: on disk when it is answered."""
        await self._namespaces.put(params.namespace, _path(params.key), params.value)
        return Item(params.namespace, params.key, params.value)

    async def delete_item(self, params: DeleteItemParams, connection: Connection) -> Item:  # noqa: ARG002
        """``server.database.delete_item``."""
        path = _path(params.key)
        return self._item(params, path, await self._namespaces.delete(params.namespace, path))

    def event(self, event: Event) -> None:
        """Nothing that happens is told here."""

    def _item(self, params: GetItemParams | DeleteItemParams, path: list[str], value: object) -> Item:
        if value is not UNSET:
            return Item(params.namespace, params.key, value)
        if not path or params.namespace not in self._namespaces.names():
            raise RpcError(404, f"Namespace {params.namespace} not found")
        raise RpcError(404, f"Key '{'.'.join(path)}' in namespace '{params.namespace}' not found")


def _path(key: str | list[str]) -> list[str]:
    if not key:
        raise RpcError(400, "key: must not be empty")
    return key.split(".") if isinstance(key, str) else key
