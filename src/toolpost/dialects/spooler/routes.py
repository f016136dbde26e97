"""The spooler's calls as HTTP routes: decoding, encoding, and how each error is answered.

The document knows three status codes: 200, 400 and 500, the last two with words for a person.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Any, Final

import msgspec
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from toolpost.dialects.spooler import words
from toolpost.dialects.spooler.api import SpoolerApi
from toolpost.errors import InvalidRequestError, ToolpostError
from toolpost.http.answer import JSON, send_answer, send_text
from toolpost.http.body import BodyBusyError, BodyError, BodyReader, ClientGoneError

log = logging.getLogger(__name__)

Handler = Callable[[Any, str], Awaitable[msgspec.Struct]]

SMALL: Final = 64 * 1024
"""Longest body of most calls, in bytes: what is decoded at once must not hold up the rest."""

MAX_INIT_BODY: Final = 4 * 2**20
"""Longest body of ``/set-init``, in bytes."""

MAX_QUERY_BODY: Final = 2**20
"""Longest body of ``/query-ts``, in bytes."""

_ENCODER = msgspec.json.Encoder()


def spooler_routes(api: SpoolerApi, bodies: BodyReader) -> list[Route]:
    """Return the routes of the nine calls.

    Args:
        api: does what is asked.
        bodies: reads the requests.
    """

    def route(path: str, kind: type[msgspec.Struct], handler: Handler, most: int | None = SMALL) -> Route:
        return Route(path, Call(kind, handler, bodies, most))

    return [
        route("/write-line", words.WriteLineRequest, api.write_line),
        route("/get-ps", words.GetPsRequest, api.get_ps),
        route("/status", words.Empty, api.status),
        route("/cancel", words.Empty, api.cancel),
        route("/set-init", words.SetInitRequest, api.set_init, MAX_INIT_BODY),
        route("/get-init", words.Empty, api.get_init),
        route("/add-job", words.AddJobRequest, api.add_job, None),
        route("/list-jobs", words.Empty, api.list_jobs),
        route("/query-ts", words.QueryTsRequest, api.query_ts, MAX_QUERY_BODY),
    ]


class Call:
    """One call of the API as an ASGI application.

    Args:
        kind: type of the request.
        handler: does what is asked.
        bodies: reads the requests.
        most: longest body, in bytes; None for what the server takes.
    """

    def __init__(
        self, kind: type[msgspec.Struct], handler: Handler, bodies: BodyReader, most: int | None
    ) -> None:
        self._decoder = msgspec.json.Decoder(kind)
        self._handler = handler
        self._bodies = bodies
        self._most = most

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["method"] != "POST":
            await send_text(send, 400, f"invalid request: use POST for {scope['path']}")
            return
        try:
            request = self._decode(await self._bodies.read(receive, self._most))
            answer = await self._handler(request, scope.get("toolpost.actor", ""))
        except InvalidRequestError as error:
            await send_text(send, 400, f"invalid request: {error}")
        except ClientGoneError:
            await send_text(send, 400, "invalid request: the body did not come")
        except BodyBusyError as error:
            await send_text(send, 500, str(error))
        except BodyError as error:
            await send_text(send, 400, f"invalid request: {error}")
        except ToolpostError as error:
            log.error("%s: %s", scope["path"], error)
            await send_text(send, 500, str(error))
        except asyncio.CancelledError:
            await send_text(send, 500, "the server is stopping")
        except Exception:
            log.exception("%s failed", scope["path"])
            await send_text(send, 500, "internal error; the server's log says more")
        else:
            await send_answer(send, 200, _ENCODER.encode(answer) + b"\n", JSON)

    def _decode(self, body: bytes | bytearray) -> msgspec.Struct:
        if not body or body.isspace():
            raise InvalidRequestError("the body is empty; send a JSON object")
        if len(body) < SMALL and body.strip() == b"null":
            body = b"{}"
        try:
            return self._decoder.decode(body)
        except msgspec.ValidationError as error:
            raise InvalidRequestError(words.name_the_field(str(error))) from None
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise InvalidRequestError(f"invalid JSON: {error}") from None
        except RecursionError:
            raise InvalidRequestError("invalid JSON: it is nested too deeply") from None
