"""From bytes to lines.

Spark serial protocol, line layer: LF ends a line, bytes 0x20-0x7e are content, all others are to be
ignored. A line without an end is cut at `MAX_LINE` and what follows is dropped up to the next LF.
"""

MAX_LINE = 65536
"""Bytes kept of one line; the firmware's longest is 2,000."""

_CONTENT = bytes(range(0x20, 0x7F))
_NOISE = bytes(byte for byte in range(256) if byte not in _CONTENT)


class LineFramer:
    """Collects bytes into lines."""

    def __init__(self) -> None:
        self._rest = b""
        self._overlong = False

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that `data` completes, as they came, without LF."""
        block = self._rest + data
        lines = block.split(b"\n")
        self._rest = lines.pop()
        if len(block) > MAX_LINE:
            lines = [line[:MAX_LINE] for line in lines]
        if self._overlong and lines:
            self._overlong = False
            del lines[0]
        if len(self._rest) > MAX_LINE:
            if not self._overlong:
                self._overlong = True
                lines.append(self._rest[:MAX_LINE])
            self._rest = b""
        return lines


def content(line: bytes) -> str:
    """Return what counts of a line: its bytes 0x20-0x7e."""
    return line.translate(None, _NOISE).decode("ascii")
