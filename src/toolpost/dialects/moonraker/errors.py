"""The one error of the dialect, and how every other becomes one.

Moonraker's errors carry an HTTP status, which is the code in JSON-RPC too, but for a few that have codes of
the JSON-RPC 2.0 specification (dialects/moonraker.md 1.3).
"""

import logging
from typing import Final

from toolpost.errors import InvalidRequestError, LinkError, NotAcceptedError, ToolpostError

log = logging.getLogger(__name__)

PARSE_ERROR: Final = -32700
INVALID_REQUEST: Final = -32600
METHOD_NOT_FOUND: Final = -32601
INVALID_PARAMS: Final = -32602

_RPC_CODES: Final = {404: METHOD_NOT_FOUND, 401: INVALID_PARAMS}
_STATUSES: Final = {METHOD_NOT_FOUND: 404}


class RpcError(ToolpostError):
    """A call that fails; handlers raise it, and a client is shown it.

    Args:
        code: an HTTP status, or a code of JSON-RPC.
        message: words for a person; no byte of them may come from where the client must not look.
    """

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.message = message

    @property
    def status(self) -> int:
        """The status of the answer over HTTP."""
        return self.code if self.code > 0 else _STATUSES.get(self.code, 400)

    @property
    def rpc_code(self) -> int:
        """The code of the answer over JSON-RPC (1.3: 404 and 401 have codes of the specification)."""
        return _RPC_CODES.get(self.code, self.code)


def method_not_found() -> RpcError:
    """Return the error of a call that does not exist."""
    return RpcError(METHOD_NOT_FOUND, "Method not found")


def as_rpc_error(error: Exception, name: str) -> RpcError:
    """Return what a client is told of an error that a handler raised; logs those that are not its fault.

    Args:
        error: what was raised.
        name: the method's name, for the log.
    """
    if isinstance(error, RpcError):
        return error
    if isinstance(error, InvalidRequestError):
        return RpcError(400, str(error))
    if isinstance(error, NotAcceptedError):
        return RpcError(409, str(error))
    if isinstance(error, ToolpostError):
        log.error("%s: %s", name, error)
        return RpcError(503 if isinstance(error, LinkError) else 500, str(error))
    log.error("%s failed", name, exc_info=error)
    return RpcError(500, "Internal Server Error")
