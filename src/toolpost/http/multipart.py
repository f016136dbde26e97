"""Uploads as multipart/form-data (RFC 7578): one file, which is streamed, beside a few short fields.

What the file holds comes from the body and from nowhere else. Fields are texts; none of them, and no query
parameter, can stand for a file of the server's (CVE-2025-48067, CVE-2026-54134). What is not well formed is
refused as soon as it is seen, and everything but the file is bounded (CVE-2025-48879).
"""

import asyncio
import contextlib
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Final
from urllib.parse import unquote_to_bytes

import msgspec
from starlette.types import Receive

from toolpost.http.body import READ_TIMEOUT, BodyError, BodyTooLargeError, ClientGoneError

MAX_FIELDS: Final = 32
"""Most parts beside the file."""
MAX_FIELD: Final = 4096
"""Longest value of a field, bytes."""
MAX_HEADERS: Final = 4096
"""Longest headers of a part, bytes."""
SLOW_AFTER: Final = 60.0
"""Seconds after which a body has to have come with MIN_RATE."""
MIN_RATE: Final = 512
"""Slowest upload, bytes per second on the average."""

Sink = Callable[[bytes], Awaitable[None]]

_TYPE = re.compile(
    r"""multipart/form-data\s*;\s*boundary=(?:"([^"]{1,70})"|([^\s";,]{1,70}))\s*;?""", re.IGNORECASE
)
_BOUNDARY = re.compile(r"[0-9A-Za-z'()+_,./:=? -]*[0-9A-Za-z'()+_,./:=?-]")
_WORD = r"[!#$%&'*+.^_`|~0-9A-Za-z-]+"
_HEADER = re.compile(rf"({_WORD}):[ \t]*([^\x00-\x08\x0a-\x1f\x7f]*)")
_PARAMETER = re.compile(rf""";[ \t]*({_WORD})[ \t]*=[ \t]*(?:"((?:[^"\\]|\\.)*)"|({_WORD}))[ \t]*""")
_ESCAPED = re.compile(r"""\\(["\\])""")
_FIELD_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_PLAIN_ENCODINGS = {"", "7bit", "8bit", "binary"}


class MultipartError(BodyError):
    """A body that is not the upload of one file. The message is safe to show."""


class Part(msgspec.Struct, frozen=True):
    """The beginning of a part.

    Attributes:
        name: name of the field.
        filename: name of the file as the client gives it; None if it is no file.
    """

    name: str
    filename: str | None


Event = Part | bytes | None
"""The beginning of a part, some of its data, or (None) its end."""


class UploadForm(msgspec.Struct, frozen=True):
    """What came beside the file's content.

    Attributes:
        filename: the client's name of the file, not checked.
        size: length of the file in bytes.
        fields: values of the other fields by their names.
    """

    filename: str
    size: int
    fields: dict[str, str]


def parse_boundary(content_type: str) -> bytes:
    """Return the boundary that a Content-Type names.

    Raises:
        MultipartError: it is no multipart/form-data, or the boundary is none (RFC 2046, 5.1.1).
    """
    match = _TYPE.fullmatch(content_type.strip())
    boundary = (match[1] or match[2]) if match else ""
    if not _BOUNDARY.fullmatch(boundary):
        raise MultipartError("the body must be multipart/form-data with a boundary")
    return boundary.encode("ascii")


class MultipartParser:
    """Takes a body apart, whatever the pieces it comes in. Does no I/O, and keeps a few kilobytes at most.

    There must be nothing before the first part and nothing but a line end after the last: no client sends
    it, and it could be endless.

    Args:
        boundary: the boundary, without the hyphens before it.
    """

    def __init__(self, boundary: bytes) -> None:
        self._delimiter = b"\r\n--" + boundary
        # Only the first delimiter has no line end before it; with one, it is like all others.
        self._buffer = bytearray(b"\r\n")
        self._state: Callable[[list[Event]], bool] = self._begin
        self._ended = False

    def feed(self, data: bytes) -> list[Event]:
        """Go on with the next piece of the body and return what it brought.

        Raises:
            MultipartError: the body is broken.
        """
        self._buffer += data
        events: list[Event] = []
        while self._state(events):
            pass
        return events

    def close(self) -> None:
        """Tell that the body has ended.

        Raises:
            MultipartError: it ended too early.
        """
        if not self._ended:
            raise MultipartError("the body ended before its last boundary")

    # The states. Each takes what it can from the buffer and returns whether there is more to be done now.

    def _begin(self, events: list[Event]) -> bool:  # noqa: ARG002
        size = len(self._delimiter)
        if not self._delimiter.startswith(self._buffer[:size]):
            raise MultipartError("the body does not begin with its boundary")
        if len(self._buffer) < size:
            return False
        del self._buffer[:size]
        self._state = self._after_delimiter
        return True

    def _after_delimiter(self, events: list[Event]) -> bool:  # noqa: ARG002
        if len(self._buffer) < len(b"--"):
            return False
        following = bytes(self._buffer[:2])
        if following == b"\r\n":
            self._state = self._headers
        elif following == b"--":
            self._ended = True
            self._state = self._epilogue
            del self._buffer[:2]
        else:
            raise MultipartError("there is something other than a line end after a boundary")
        return True

    def _headers(self, events: list[Event]) -> bool:
        # The buffer still begins with the line end of the delimiter: a part without headers ends at once.
        end = self._buffer.find(b"\r\n\r\n", 0, MAX_HEADERS)
        if end < 0:
            if len(self._buffer) >= MAX_HEADERS:
                raise MultipartError(f"the headers of a part must be at most {MAX_HEADERS} bytes")
            return False
        events.append(_parse_part(bytes(self._buffer[2:end])))
        del self._buffer[: end + 4]
        # As before the first part: an empty part's delimiter is to be like all others.
        self._state = self._first_data
        return True

    def _first_data(self, events: list[Event]) -> bool:
        """An empty part: its delimiter's line end is also that of the headers."""
        bare = self._delimiter[2:]
        if len(self._buffer) < len(bare) and bare.startswith(self._buffer):
            return False
        if self._buffer.startswith(bare):
            del self._buffer[: len(bare)]
            events.append(None)
            self._state = self._after_delimiter
        else:
            self._state = self._data
        return True

    def _data(self, events: list[Event]) -> bool:
        end = self._buffer.find(self._delimiter)
        found = end >= 0
        if not found:
            end = max(0, len(self._buffer) - len(self._delimiter) + 1)
        if end:
            events.append(bytes(memoryview(self._buffer)[:end]))
            del self._buffer[:end]
        if found:
            del self._buffer[: len(self._delimiter)]
            events.append(None)
            self._state = self._after_delimiter
        return found

    def _epilogue(self, events: list[Event]) -> bool:  # noqa: ARG002
        if not b"\r\n".startswith(self._buffer):
            raise MultipartError("there is something after the last boundary")
        return False


async def read_upload(
    receive: Receive, content_type: str, sink: Sink, max_bytes: int, file_field: str = "file"
) -> UploadForm:
    """Read a body and hand its file to `sink`, a piece at a time; the next is read when the last was taken.

    Whoever calls must drop what `sink` has taken if this raises.

    Args:
        receive: where the body comes from.
        content_type: the request's Content-Type.
        sink: takes the file's content; what it raises ends the reading.
        max_bytes: longest file.
        file_field: name of the field that the file must be in.

    Raises:
        MultipartError: the body is not well formed, or not the upload of exactly one file.
        BodyTooLargeError: the file is too long.
        ClientGoneError: the client went away, sends nothing, or too slowly.
    """
    parser = MultipartParser(parse_boundary(content_type))
    form = _Form(sink, max_bytes, file_field)
    async for piece in _pieces(receive):
        for event in parser.feed(piece):
            await form.take(event)
    parser.close()
    return form.finish()


class _Form:
    """Gathers the fields and passes the file on."""

    def __init__(self, sink: Sink, max_bytes: int, file_field: str) -> None:
        self._sink = sink
        self._max_bytes = max_bytes
        self._file_field = file_field
        self._fields: dict[str, str] = {}
        self._filename: str | None = None
        self._size = 0
        self._part: Part | None = None
        self._value = bytearray()

    async def take(self, event: Event) -> None:
        if isinstance(event, Part):
            self._begin(event)
        elif event is None:
            self._end()
        elif self._part is not None and self._part.filename is not None:
            self._size += len(event)
            if self._size > self._max_bytes:
                raise BodyTooLargeError(f"the file must be at most {self._max_bytes} bytes")
            await self._sink(event)
        else:
            self._value += event
            if len(self._value) > MAX_FIELD:
                raise MultipartError(f"{self._name}: must be at most {MAX_FIELD} bytes")

    def finish(self) -> UploadForm:
        if self._filename is None:
            raise MultipartError(f"{self._file_field}: a file must be given")
        return UploadForm(self._filename, self._size, self._fields)

    @property
    def _name(self) -> str:
        return self._part.name if self._part is not None else ""

    def _begin(self, part: Part) -> None:
        if part.name in self._fields or (self._filename is not None and part.name == self._file_field):
            raise MultipartError(f"{part.name}: must be given only once")
        if part.name == self._file_field:
            if part.filename is None:
                raise MultipartError(f"{part.name}: must be a file, with its name")
            self._filename = part.filename
        elif part.filename is not None:
            raise MultipartError(f"{part.name}: must not be a file; the file is the field {self._file_field}")
        elif len(self._fields) >= MAX_FIELDS:
            raise MultipartError(f"there must be at most {MAX_FIELDS} fields")
        self._part = part
        self._value.clear()

    def _end(self) -> None:
        if self._part is not None and self._part.filename is None:
            try:
                self._fields[self._name] = self._value.decode("utf-8")
            except UnicodeDecodeError:
                raise MultipartError(f"{self._name}: must be UTF-8") from None
        self._part = None


async def _pieces(receive: Receive) -> AsyncIterator[bytes]:
    """Yield a body as it comes. How long it may be follows from the bounds of its parts."""
    started = time.monotonic()
    total, more = 0, True
    while more:
        try:
            async with asyncio.timeout(READ_TIMEOUT):
                message = await receive()
        except TimeoutError:
            raise ClientGoneError("the body did not come") from None
        if message["type"] != "http.request":
            raise ClientGoneError("the client went away")
        piece: bytes = message.get("body", b"")
        more = message.get("more_body", False)
        total += len(piece)
        elapsed = time.monotonic() - started
        if more and elapsed > SLOW_AFTER and total < elapsed * MIN_RATE:
            raise ClientGoneError("the body comes too slowly")
        yield piece


def _parse_part(lines: bytes) -> Part:
    """Return what the headers of a part say.

    Raises:
        MultipartError: they are broken, or ask for what is not supported (RFC 7578, 4.7).
    """
    headers = {}
    for line in lines.split(b"\r\n"):
        try:
            match = _HEADER.fullmatch(line.decode("utf-8"))
        except UnicodeDecodeError:
            raise MultipartError("the headers of a part must be UTF-8") from None
        if match is None or match[1].lower() in headers:
            raise MultipartError("the headers of a part are broken")
        headers[match[1].lower()] = match[2]
    if headers.get("content-transfer-encoding", "").strip().lower() not in _PLAIN_ENCODINGS:
        raise MultipartError("Content-Transfer-Encoding: only binary is supported")
    return _parse_disposition(headers.get("content-disposition", ""))


def _parse_disposition(value: str) -> Part:
    kind, semicolon, rest = value.partition(";")
    if kind.strip().lower() != "form-data":
        raise MultipartError("a part must have a Content-Disposition: form-data with a name")
    rest = semicolon + rest
    parameters: dict[str, str] = {}
    at = 0
    while at < len(rest):
        match = _PARAMETER.match(rest, at)
        if match is None or match[1].lower() in parameters:
            raise MultipartError("the Content-Disposition of a part is broken")
        quoted, token = match[2], match[3]
        text = token if quoted is None else _ESCAPED.sub(r"\1", quoted)
        parameters[match[1].lower()] = text
        at = match.end()
    name = parameters.get("name", "")
    if not _FIELD_NAME.fullmatch(name):
        raise MultipartError("a field's name must be 1 to 64 letters, digits, '-' and '_'")
    extended = parameters.get("filename*")
    filename = parameters.get("filename") if extended is None else _decode_extended(extended)
    return Part(name, filename)


def _decode_extended(value: str) -> str:
    """Return the text of a ``filename*`` (RFC 8187), which some clients send for names beyond ASCII."""
    charset, _, rest = value.partition("'")
    _, quote, text = rest.partition("'")
    if charset.lower() == "utf-8" and quote:
        with contextlib.suppress(UnicodeDecodeError):
            return unquote_to_bytes(text).decode("utf-8")
    raise MultipartError("filename*: must be UTF-8''...")
