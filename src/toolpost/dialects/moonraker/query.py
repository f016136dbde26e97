"""The arguments of an HTTP request: query string and form merged, then the JSON body over both.

Source: dialects/moonraker.md 1.2, and external_api/introduction.md of Moonraker's documentation. What cannot
be read is told instead of ignored, for a request that is half understood would be carried out.
"""

from collections.abc import Iterable, Iterator
from email.message import Message
from typing import Any, Final
from urllib.parse import parse_qsl

import msgspec

from toolpost.dialects.moonraker.arguments import convert_hinted, is_hint
from toolpost.dialects.moonraker.errors import RpcError

MAX_FIELDS: Final = 1000
"""Arguments of a query string, and of a form."""

_MAX_PART_HEAD: Final = 4096
_JSON: Final = "application/json"
_FORM: Final = "application/x-www-form-urlencoded"
_MULTIPART: Final = "multipart/form-data"


def decode_arguments(query: bytes, content_type: str, body: bytes | bytearray) -> dict[str, Any]:
    """Return the arguments of a request by name; of several of one name the last one counts.

    Args:
        query: the query string as it was sent.
        content_type: the body's, "" if there is none; a body of any other type than those of 1.2 is ignored.
        body: the body.

    Raises:
        RpcError: 400, they cannot be read.
    """
    arguments = _typed(_pairs(query)) if query else {}
    if not body:
        return arguments
    kind = content_type.lower().lstrip()
    if kind.startswith(_JSON):
        arguments.update(_json_object(body))
    elif kind.startswith(_FORM):
        arguments.update(_typed(_pairs(body)))
    elif kind.startswith(_MULTIPART):
        arguments.update(_typed(_multipart(content_type, bytes(body))))
    return arguments


def _typed(pairs: Iterable[tuple[str, str]]) -> dict[str, Any]:
    arguments: dict[str, Any] = {}
    for key, value in pairs:
        name, colon, hint = key.rpartition(":")
        if colon and is_hint(hint):
            arguments[name] = convert_hinted(name, hint, value)
        else:
            arguments[key] = value
    return arguments


def _pairs(encoded: bytes | bytearray) -> list[tuple[str, str]]:
    try:
        return parse_qsl(
            encoded.decode("ascii"), keep_blank_values=True, errors="strict", max_num_fields=MAX_FIELDS
        )
    except UnicodeDecodeError:
        raise RpcError(400, "Invalid arguments: they must be percent-encoded UTF-8") from None
    except ValueError:
        raise RpcError(400, f"Invalid arguments: there must be at most {MAX_FIELDS}") from None


def _json_object(body: bytes | bytearray) -> dict[str, Any]:
    if not body.strip():
        return {}
    try:
        decoded = msgspec.json.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RpcError(400, f"Invalid JSON in the body: {error}") from None
    if not isinstance(decoded, dict):
        raise RpcError(400, "Invalid JSON in the body: it must be an object")
    return decoded


def _multipart(content_type: str, body: bytes) -> Iterator[tuple[str, str]]:
    """Yield the fields of a form; files in it are left out (RFC 7578, RFC 2046 5.1.1)."""
    boundary = _header(content_type).get_boundary()
    if not boundary or not boundary.isascii():
        raise RpcError(400, "Invalid form: the Content-Type names no boundary")
    delimiter = b"\r\n--" + boundary.encode("ascii")
    # The first delimiter has no line before it, and what precedes it belongs to no part.
    parts = (b"\r\n" + body).split(delimiter, MAX_FIELDS + 1)[1:]
    if not parts or not parts[-1].startswith(b"--"):
        raise RpcError(400, f"Invalid form: it has no end, or more than {MAX_FIELDS} parts")
    for part in parts[:-1]:
        head, blank, value = part.partition(b"\r\n\r\n")
        if not blank or not head.lstrip(b" \t").startswith(b"\r\n") or len(head) > _MAX_PART_HEAD:
            raise RpcError(400, "Invalid form: a part has no head")
        disposition = _disposition(head)
        name = disposition.get_param("name")
        if not isinstance(name, str) or not name:
            raise RpcError(400, "Invalid form: a part has no name")
        if disposition.get_param("filename") is not None:
            continue
        try:
            yield name, value.decode("utf-8")
        except UnicodeDecodeError:
            raise RpcError(400, f"Invalid form: {name} is not UTF-8") from None


def _disposition(head: bytes) -> Message:
    for line in head.decode("utf-8", "replace").split("\r\n"):
        name, _, value = line.partition(":")
        if name.strip().lower() == "content-disposition":
            return _header(value.strip())
    return _header("")


def _header(value: str) -> Message:
    """Return a message whose Content-Type is `value`, for its parameters are read from there by default."""
    message = Message()
    message["Content-Type"] = value
    return message
