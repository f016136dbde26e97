"""The spooler's calls as HTTP routes: decoding, encoding, and how each error is answered.

The document knows three status codes: 200, 400 and 500, the last two with words for a person.
"""

import logging
from collections.abc import Awaitable, Callable
from typing import Any

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

_ENCODER = msgspec.json.Encoder()


def spooler_routes(api: SpoolerApi, bodies: BodyReader) -> list[Route]:
    """Return the routes of the nine calls.

    Args:
        api: does what is asked.
        bodies: reads the requests.
    """
    calls: dict[str, tuple[type[msgspec.Struct], Handler]] = {
        "/write-line": (words.WriteLineRequest, api.write_line),
        "/get-ps": (words.GetPsRequest, api.get_ps),
        "/status": (words.Empty, api.status),
        "/cancel": (words.Empty, api.cancel),
        "/set-init": (words.SetInitRequest, api.set_init),
        "/get-init": (words.Empty, api.get_init),
        "/add-job": (words.AddJobRequest, api.add_job),
        "/list-jobs": (words.Empty, api.list_jobs),
        "/query-ts": (words.QueryTsRequest, api.query_ts),
    }
    return [Route(path, Call(kind, handler, bodies)) for path, (kind, handler) in calls.items()]


class Call:
    """One call of the API as an ASGI application.

    Args:
        kind: type of the request.
        handler: does what is asked.
        bodies: reads the requests.
    """

    def __init__(self, kind: type[msgspec.Struct], handler: Handler, bodies: BodyReader) -> None:
        self._decoder = msgspec.json.Decoder(kind)
        self._handler = handler
        self._bodies = bodies

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["method"] != "POST":
            await send_text(send, 400, f"invalid request: use POST for {scope['path']}")
            return
        try:
            request = self._decode(await self._bodies.read(receive))
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
        except Exception:
            log.exception("%s failed", scope["path"])
            await send_text(send, 500, "internal error; the server's log says more")
        else:
            await send_answer(send, 200, _ENCODER.encode(answer) + b"\n", JSON)

    def _decode(self, body: bytes | bytearray) -> msgspec.Struct:
        if not body.strip():
            raise InvalidRequestError("the body is empty; send a JSON object")
        if body.strip() == b"null":
            body = b"{}"
        try:
            return self._decoder.decode(body)
        except msgspec.ValidationError as error:
            raise InvalidRequestError(_named(str(error))) from None
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise InvalidRequestError(f"invalid JSON: {error}") from None
        except RecursionError:
            raise InvalidRequestError("invalid JSON: it is nested too deeply") from None


def _named(message: str) -> str:
    """Turn a message of msgspec's into one that begins with the field's name."""
    text, _, path = message.partition(" - at `$")
    field = path.rstrip("`").lstrip(".")
    missing = text.removeprefix("Object missing required field `")
    if missing != text:
        return f"{missing.rstrip('`')}: must be given"
    return f"{field}: {text[:1].lower()}{text[1:]}" if field else f"invalid JSON: {text}"
