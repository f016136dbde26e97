"""The table of methods: what can be called, over whichever transport, and the one way to call it."""

import enum
from collections.abc import Awaitable, Callable, Iterable, Iterator
from typing import Any, TypeAlias

import msgspec

from toolpost.dialects.moonraker.arguments import Params, compile_params
from toolpost.dialects.moonraker.connections import Connection
from toolpost.dialects.moonraker.errors import INVALID_PARAMS, RpcError, as_rpc_error, method_not_found

Handler: TypeAlias = Callable[[Any, Connection], Awaitable[object]]
HttpPair: TypeAlias = tuple[str, str]


class NoParams(msgspec.Struct, frozen=True):
    """Of a method that takes none; whatever is sent is ignored."""


class Order(enum.Enum):
    """When a call runs, among the calls of its connection."""

    IN_TURN = "after those that came before it"
    BESIDE = "at once: it may take long, as what waits for a machine does"
    URGENT = "at once, and it is never refused for there being too many: an emergency stop"


class Method(msgspec.Struct, frozen=True):
    """One method.

    Attributes:
        name: in JSON-RPC.
        http: verb and path over HTTP, or None.
        params: what the arguments are made into; ``dict`` to be given them as they are.
        handler: does it; is given the params and the connection, and raises any ToolpostError.
        order: when it runs on a connection that stays.
        persistent: only for connections that stay; "Method not found" over HTTP.
        more_http: further verbs and paths.
        from_http: makes params of arguments that HTTP has in another shape (``?toolhead&print_stats=state``).
    """

    name: str
    http: HttpPair | None
    params: type[msgspec.Struct] | type[dict[str, Any]]
    handler: Handler
    order: Order = Order.IN_TURN
    persistent: bool = False
    more_http: tuple[HttpPair, ...] = ()
    from_http: Callable[[dict[str, Any]], dict[str, Any]] | None = None

    @property
    def http_pairs(self) -> tuple[HttpPair, ...]:
        """Verb and path of each way to call it over HTTP."""
        return (*((self.http,) if self.http is not None else ()), *self.more_http)


class Methods:
    """All methods, by name.

    Args:
        methods: those there are; a name, or a verb and path, may not be there twice.
    """

    def __init__(self, methods: Iterable[Method] = ()) -> None:
        self._methods: dict[str, tuple[Method, Callable[[Params], Any]]] = {}
        self._pairs: set[HttpPair] = set()
        self.add(*methods)

    def __iter__(self) -> Iterator[Method]:
        return (method for method, _ in self._methods.values())

    def add(self, *methods: Method) -> None:
        """Add methods.

        Raises:
            ValueError: one is there already.
        """
        for method in methods:
            if method.name in self._methods or not self._pairs.isdisjoint(method.http_pairs):
                raise ValueError(f"{method.name}: there already, by its name or by its path")
            convert = compile_params(method.params) if issubclass(method.params, msgspec.Struct) else dict
            self._methods[method.name] = method, convert
            self._pairs.update(method.http_pairs)

    def order(self, name: object) -> Order:
        """Return when a method is to run; what does not exist is refused in turn."""
        found = self._methods.get(name) if isinstance(name, str) else None
        return Order.IN_TURN if found is None else found[0].order

    async def dispatch(self, name: str, params: object, connection: Connection) -> object:
        """Call a method and return its result.

        Args:
            name: of the method.
            params: its arguments, or None (dialects/moonraker.md 3.1: clients send ``{}``, null or nothing).
            connection: who calls.

        Raises:
            RpcError: there is no such method, the arguments are wrong, or it fails.
        """
        found = self._methods.get(name)
        if found is None or (found[0].persistent and not connection.persistent):
            raise method_not_found()
        if params is None:
            params = {}
        elif not isinstance(params, dict):
            raise RpcError(INVALID_PARAMS, "Invalid params:")
        method, convert = found
        try:
            return await method.handler(convert(params), connection)
        except Exception as error:  # noqa: BLE001  # the one place that routes them
            raise as_rpc_error(error, name) from None
