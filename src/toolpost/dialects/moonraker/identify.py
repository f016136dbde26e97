"""The methods that belong to connections themselves (external_api/server.md, "Identify Connection")."""

from typing import Literal

import msgspec

from toolpost.dialects.moonraker.connections import Connection, Identity
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.rpc import Method, NoParams


class IdentifyParams(msgspec.Struct, frozen=True):
    """Who a client is; it may send a key too, but has been let in already, or would not be here."""

    client_name: str
    version: str
    type: Literal["web", "mobile", "desktop", "display", "bot", "agent", "other"]
    url: str


class Identified(msgspec.Struct, frozen=True):
    """The answer."""

    connection_id: int


class WebsocketId(msgspec.Struct, frozen=True):
    """The answer to older clients."""

    websocket_id: int


async def identify(params: IdentifyParams, connection: Connection) -> Identified:
    """``server.connection.identify``: once for each connection."""
    if connection.identity is not None:
        known = msgspec.json.encode(connection.identity).decode()
        raise RpcError(400, f"Connection already identified: {known}")
    connection.identity = Identity(params.client_name, params.version, params.type, params.url)
    return Identified(connection.number)


async def websocket_id(params: NoParams, connection: Connection) -> WebsocketId:  # noqa: ARG001
    """``server.websocket.id``: what clients asked before they could identify themselves."""
    return WebsocketId(connection.number)


CONNECTION_METHODS = (
    Method("server.connection.identify", None, IdentifyParams, identify, persistent=True),
    Method("server.websocket.id", None, NoParams, websocket_id, persistent=True),
)
"""The methods of connections, to be added to the others."""
