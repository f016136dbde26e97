"""Bytes to lines, as the Spark core's line buffer does it."""

MAX_LINE = 128
"""Bytes that the firmware's line buffer holds (Spark serial protocol, line layer)."""

LF = b"\n"
BS = b"\x08"
DEL = b"\x7f"

_KEPT = bytes(range(0x20, 0x7F)) + LF + BS + DEL
_DROPPED = bytes(set(range(256)) - set(_KEPT))


class LineReader:
    """Collects bytes and gives whole lines (Spark serial protocol, line layer).

    LF ends a line; bytes 0x20-0x7e are content; BS and DEL take back the last byte; every other
    byte is dropped where it stands. A line that outgrows the buffer is dropped up to its LF,
    without an error.

    Attributes:
        edits: BS and DEL seen so far; the firmware answers each with an echo.
        overlong: lines dropped so far because they outgrew the buffer.
    """

    def __init__(self) -> None:
        self.edits = 0
        self.overlong = 0
        self._tail = b""
        self._skipping = False

    def reset(self) -> None:
        """Forget an unfinished line."""
        self._tail = b""
        self._skipping = False

    def feed(self, data: bytes) -> bytes:
        """Take bytes from the wire; return the lines that they complete, each with its LF.

        A line in the result may still be longer than ``MAX_LINE``: whoever splits the lines
        drops it and counts it. (That keeps this step free of a loop over lines.)
        """
        data = data.translate(None, _DROPPED)
        if self._skipping:
            end = data.find(LF)
            if end < 0:
                self._count_edits(data)
                return b""
            self._count_edits(data[:end])
            self._skipping = False
            data = data[end + 1 :]
        if BS in data or DEL in data:
            data = self._edit(data)
        elif self._tail:
            data = self._tail + data
        end = data.rfind(LF) + 1
        self._tail = data[end:]
        if len(self._tail) > MAX_LINE:
            self._skip()
        return data[:end]

    def _count_edits(self, data: bytes) -> None:
        self.edits += data.count(BS) + data.count(DEL)

    def _skip(self) -> None:
        self.overlong += 1
        self._tail = b""
        self._skipping = True

    def _edit(self, data: bytes) -> bytes:
        """Return the tail and ``data`` with BS and DEL carried out, over-long lines removed."""
        self._count_edits(data)
        *complete, rest = data.split(LF)
        result = bytearray()
        for part in complete:
            line = _edited(self._tail, part)
            self._tail = b""
            if line is None:
                self.overlong += 1
            else:
                result += line + LF
        last = _edited(self._tail, rest)
        if last is None:
            self._skip()
            return bytes(result)
        return bytes(result + last)


def _edited(buffer: bytes, part: bytes) -> bytes | None:
    """Return the line buffer after ``part`` was typed into it, None if it overflowed."""
    line = bytearray(buffer)
    for byte in part:
        if byte in (BS[0], DEL[0]):
            del line[-1:]
        else:
            line.append(byte)
            if len(line) > MAX_LINE:
                return None
    return bytes(line)
