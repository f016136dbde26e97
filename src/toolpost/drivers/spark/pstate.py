"""P-states: the only lines that a Spark core sends (Spark serial protocol, lines up).

``tag [<] {key:value} [>]``: ``<`` opens a p-state, ``>`` delivers it, and a line with neither goes on with
one that is open. Lines of different tags may interleave. An error in a line drops the whole open p-state
of its tag, so that half a p-state is never taken for a whole one.
"""

import math
import re
import struct

import msgspec

from toolpost.core.report import Value

_MAX_OPEN = 64
_MAX_KEYS = 4096
_MAX_LENGTH = 262_144

_TAG = re.compile(r"\s*([^\s<>:\"]+)")
_TOKEN = re.compile(
    r"\s*(?:(?P<mark>[<>])"
    r'|(?P<key>[^\s:"<>]+):(?:"(?P<text>(?:[^"\\]|\\["\\])*)"|(?P<word>[^\s:"<>]+)))'
)
_NUMBER = re.compile(r"[+-]?(?P<mantissa>\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_HEX = re.compile(r"0[xX][0-9a-fA-F]{1,8}")
_NOT_FINITE = re.compile(r"[+-]?(?:nan|inf|infinity)", re.IGNORECASE)
_ESCAPE = re.compile(r"\\(.)")
_EXACT_DIGITS = 6
_SMALLEST_NORMAL = 2.0**-126
_MOST_WHOLE = 2.0**53


class PState(msgspec.Struct, frozen=True):
    """A delivered p-state: its tag and its flat map, keys in the order of arrival."""

    tag: str
    values: dict[str, Value]


class PStateError(ValueError):
    """A line is no valid p-state line."""


class PStateParser:
    """Builds p-states from lines."""

    def __init__(self) -> None:
        self._open: dict[str, tuple[dict[str, Value], int]] = {}

    def feed(self, line: str) -> list[PState]:
        """Return the p-states that a line delivers; a line that is no p-state line delivers none.

        What follows a p-state on its line and is none itself is left out.

        Raises:
            PStateError: the line breaks the syntax. What is open under its tag has been dropped.
        """
        delivered: list[PState] = []
        rest = line
        try:
            while rest:
                rest = self._feed_one(rest, delivered)
        except PStateError:
            if not delivered:
                raise
        return delivered

    def _feed_one(self, line: str, delivered: list[PState]) -> str:
        """Read one p-state line; return what follows the ``>`` that ends it."""
        match = _TAG.match(line)
        if match is None:
            if not line.strip():
                return ""
            raise PStateError("missing tag")
        tag, at = match[1], match.end()
        if tag not in self._open and not _looks_like_pstate(line, at):
            return ""
        try:
            return self._feed_body(tag, line, at, delivered)
        except PStateError:
            self._open.pop(tag, None)
            message = _message(line[at:]) if tag == "error" else ""
            if not message:
                raise
            # The firmware does not escape quotes in messages and cuts long lines; people need to see them.
            delivered.append(PState(tag, {"msg": message}))
            return ""

    def _feed_body(self, tag: str, line: str, at: int, delivered: list[PState]) -> str:
        values, size = self._open.pop(tag, (None, 0))
        bare = values is None and tag == "sys"
        length = len(line.rstrip())
        size += length
        while at < length:
            token = _TOKEN.match(line, at)
            if token is None:
                raise PStateError(f"unexpected text at column {at + 1}")
            at = token.end()
            if token["mark"] == "<":
                values, bare, size = {}, False, length
            elif values is None and (not bare or token["mark"]):
                raise PStateError("value or '>' without '<'")
            elif token["mark"] == ">":
                delivered.append(PState(tag, values or {}))
                return line[at:]
            else:
                values = {} if values is None else values
                if len(values) >= _MAX_KEYS or size > _MAX_LENGTH:
                    raise PStateError("too long")
                values[token["key"]] = _value(token)
        if bare and values:
            # One build of the firmware sends its boot event without any marks.
            delivered.append(PState(tag, values))
        elif values is not None:
            if len(self._open) >= _MAX_OPEN:
                self._open.pop(next(iter(self._open)))
            self._open[tag] = values, size
        return ""


def _looks_like_pstate(line: str, at: int) -> bool:
    """Whether a line whose tag is not open is meant as a p-state line, not as words for a person."""
    if at >= len(line.rstrip()):
        return False
    return "<" in line or ">" in line or _TOKEN.match(line, at) is not None


def _message(body: str) -> str:
    """Return the words of an error p-state that breaks the syntax."""
    _, found, text = body.partition('msg:"')
    if not found:
        return body.strip(" <>")
    return text.rstrip().removesuffix(">").rstrip().removesuffix('"')


def _value(token: re.Match[str]) -> Value:
    if token["text"] is not None:
        return _ESCAPE.sub(r"\1", token["text"])
    return parse_value(token["word"])


def parse_value(word: str) -> Value:
    """Return the value that an unquoted word stands for.

    Numbers are float32 on the wire: the result is the shortest decimal that means the same float32, an int
    where it is whole and a float64 would count it exactly. A number that is not finite is None.

    Raises:
        PStateError: the word is no value.
    """
    number = _NUMBER.fullmatch(word)
    if number is not None:
        return _float32(word, len(number["mantissa"]))
    if word == "true":
        return True
    if word == "false":
        return False
    if _HEX.fullmatch(word):
        return int(word, 16)
    if _NOT_FINITE.fullmatch(word):
        return None
    raise PStateError(f"invalid value {word!r}")


def _float32(word: str, digits: int) -> Value:
    value = float(word)
    if digits > _EXACT_DIGITS or "e" in word or "E" in word:
        try:
            packed = struct.pack("f", value)
        except OverflowError:
            return None
        exact = struct.unpack("f", packed)[0]
        if not math.isfinite(exact):
            return None
        for precision in range(_EXACT_DIGITS if abs(exact) >= _SMALLEST_NORMAL else 1, 10):
            value = float(f"{exact:.{precision}g}")
            if struct.pack("f", value) == packed:
                break
    if abs(value) >= _MOST_WHOLE or not value.is_integer() or (not value and word.startswith("-")):
        return value
    return int(value)
