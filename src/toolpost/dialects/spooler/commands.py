"""Decoding the commands of a job in blocks.

A job may have a million commands, and a decoder that makes them all at once would hold up everything else
meanwhile. So the JSON array is cut between two of its strings every so often.
"""

import re
from collections.abc import Iterator

import msgspec

from toolpost.errors import InvalidRequestError

BLOCK = 64 * 1024
"""Bytes of JSON that are decoded at a time."""

_BORDER = re.compile(rb'"\s*,\s*(?=")')
_DECODER = msgspec.json.Decoder(list[str])
_ERRORS = (msgspec.DecodeError, UnicodeDecodeError)


def decode_blocks(array: memoryview, block: int = BLOCK) -> Iterator[list[str]]:
    """Yield the strings of a JSON array, a list for each part of about `block` bytes.

    A cut is made at what looks like ``", "`` between two strings. If that was inside of a string, an odd
    number of quotes is left before it and the part cannot be decoded; the array is then decoded whole.

    Raises:
        InvalidRequestError: it is no array of strings; the message begins with where.
    """
    done = 0
    start = 0
    while len(array) - start > block:
        border = _BORDER.search(array, start + block)
        if border is None:
            break
        part = (b"[" if start else b"") + array[start : border.start() + 1] + b"]"
        try:
            lines = _DECODER.decode(part)
        except _ERRORS:
            yield _decode(array)[done:]
            return
        yield lines
        done += len(lines)
        start = border.end()
    rest = (b"[" + array[start:]) if start else array
    try:
        lines = _DECODER.decode(rest)
    except _ERRORS:
        lines = _decode(array)[done:]
    yield lines


def _decode(array: memoryview) -> list[str]:
    try:
        return _DECODER.decode(array)
    except _ERRORS as error:
        text = str(error).replace(" - at `$", " - at `commands")
        raise InvalidRequestError(f"commands: {text}") from None
