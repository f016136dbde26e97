"""Reading a G-code file in blocks of lines."""

from collections.abc import Iterator
from pathlib import Path

_BLOCK = 256 * 1024


def read_lines(path: str | Path) -> Iterator[list[str]]:
    """Yield a file's lines, without their ends, a list for each part of the file. Blocks.

    Bytes that are not UTF-8 are replaced: they can only stand in comments of a program that a machine takes.
    """
    cut = b""
    with Path(path).open("rb") as file:
        while data := file.read(_BLOCK):
            lines = (cut + data).split(b"\n")
            cut = lines.pop()
            yield [line.decode("utf-8", "replace") for line in lines]
    if cut:
        yield [cut.decode("utf-8", "replace")]
