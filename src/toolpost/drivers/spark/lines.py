"""Which lines may go down to a Spark core (Spark serial protocol, line layer and lines down).

A line is trimmed and stripped of its comment first and judged then, so that nothing hides behind a space.
"""

from collections.abc import Sequence

from toolpost.drivers.base import Line, LineKind
from toolpost.errors import InvalidLineError, InvalidRequestError

MAX_LINE = 100
"""Bytes of the longest valid line; the firmware drops what is longer than its buffer without a word."""

_BLANKS = " \t\r"

STOP = "!"
"""The signal that cancels everything in the core."""

QUEUE = "?queue"
"""The signal that asks for the state of the core's queue."""


def payload(line: str) -> str:
    """Return the part of a line that goes on the wire: no comment, no blanks around it.

    Raises:
        InvalidRequestError: the line is too long or holds bytes other than printable ASCII.
    """
    if "\n" in line:
        raise InvalidRequestError("must not contain a newline")
    text = line.partition(";")[0].strip(_BLANKS)
    if not (text.isascii() and text.isprintable()):
        raise InvalidRequestError("must be printable ASCII (0x20-0x7e)")
    if len(text) > MAX_LINE:
        raise InvalidRequestError(f"must be at most {MAX_LINE} bytes")
    return text


def is_signal(text: str) -> bool:
    """Whether the core acts on this payload at once instead of queueing it."""
    return text[:1] in {"?", STOP}


def is_queued(text: str) -> bool:
    """Whether the core puts this payload into its queue (``fset`` and signals are not)."""
    return not is_signal(text) and text.partition(" ")[0] != "fset"


def classify(line: str) -> Line:
    """Return what a line is to a core.

    Raises:
        InvalidRequestError: the line must not go on the wire.
    """
    text = payload(line)
    if not text:
        return Line(LineKind.NOTHING, b"")
    if text.startswith(STOP):
        return Line(LineKind.STOP, STOP.encode())
    kind = LineKind.SIGNAL if text.startswith("?") else LineKind.COMMAND
    return Line(kind, text.encode("ascii"))


def command(line: str) -> bytes:
    """Return a program's line as it goes on the wire; empty if it is only a comment or blank.

    Raises:
        InvalidRequestError: it is no valid command; a signal is none.
    """
    text = payload(line)
    if is_signal(text):
        raise InvalidRequestError("must be a command, and this is a signal")
    return text.encode("ascii")


def commands(lines: Sequence[str]) -> list[bytes]:
    """Return the commands of a program's lines, those that hold none left out.

    Raises:
        InvalidLineError: a line is no valid command.
    """
    block = "\n".join(lines)
    # One look at the whole block spares nearly all programs the look at each line.
    if block.count("\n") == len(lines) - 1 and _plain(block) and max(map(len, lines)) <= MAX_LINE:
        return [line for line in block.encode("ascii").split(b"\n") if line]
    result = []
    for index, line in enumerate(lines):
        try:
            text = command(line)
        except InvalidRequestError as error:
            raise InvalidLineError(index, str(error)) from None
        if text:
            result.append(text)
    return result


_ODD = str.maketrans("", "", "".join(map(chr, range(0x20, 0x7F))) + "\n")


def _plain(block: str) -> bool:
    """Whether no line of the block needs cleaning, and none is a signal or holds an odd byte."""
    return (
        block.isascii()
        and not any(mark in block for mark in (";", "!", "?", " \n", "\n "))
        and not block.startswith(" ")
        and not block.endswith(" ")
        and not block.translate(_ODD)
    )
