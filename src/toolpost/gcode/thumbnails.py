"""Pictures that slicers put into a file as comments.

    ; thumbnail begin 32x32 1234
    ; iVBORw0KGgo...
    ; thumbnail end

PrusaSlicer, SuperSlicer, OrcaSlicer, Bambu Studio and a script of Cura's write them so: width, height, and
the number of characters of base64. ``thumbnail_JPG`` is a JPEG. Other formats are no use to a browser.
"""

import base64
import binascii
import re
from typing import BinaryIO, Final

import msgspec

MAX_THUMBNAILS: Final = 8
"""Most pictures of a file that are looked at."""
MAX_SIDE: Final = 2048
"""Largest width and height, pixels."""

_BEGIN = re.compile(
    rb"^; thumbnail(?:_JPG|_PNG)? begin[ \t]+(\d{1,4})[x \t](\d{1,4})[ \t]+\d{1,7}[ \t]*\r?\n", re.MULTILINE
)
_END = re.compile(rb"^; thumbnail(?:_\w{1,8})? end", re.MULTILINE)
_MARK = b"; thumbnail"
_FORMATS = {"png": b"\x89PNG\r\n\x1a\n", "jpg": b"\xff\xd8\xff"}
_PATH = re.compile(r"(?:(.*)/)?\.thumbs/([^/]+)-(\d{1,4})x(\d{1,4})\.(png|jpg)", re.DOTALL)


class Thumbnail(msgspec.Struct, frozen=True):
    """A picture in a file.

    Attributes:
        width: pixels.
        height: pixels.
        size: bytes of the picture.
        format: ``png`` or ``jpg``.
        offset: where in the file its text begins.
        length: bytes of its text.
    """

    width: int
    height: int
    size: int
    format: str
    offset: int
    length: int


def find_thumbnails(head: bytes) -> tuple[Thumbnail, ...]:
    """Return the pictures in the beginning of a file; broken ones are left out."""
    found = []
    at = 0
    for _ in range(MAX_THUMBNAILS):
        # The plain search is many times faster, and most of a file are commands.
        at = head.find(_MARK, at)
        begin = _BEGIN.search(head, at) if at >= 0 else None
        end = _END.search(head, begin.end()) if begin else None
        if begin is None or end is None:
            break
        at = end.end()
        width, height = int(begin[1]), int(begin[2])
        picture = _decode(head[begin.end() : end.start()])
        kind = next((name for name, magic in _FORMATS.items() if picture.startswith(magic)), None)
        if kind is not None and 0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE:
            length = end.start() - begin.end()
            found.append(Thumbnail(width, height, len(picture), kind, begin.end(), length))
    return tuple(found)


def read_thumbnail(file: BinaryIO, thumbnail: Thumbnail) -> bytes:
    """Return a picture; empty if it is not there any more. Blocks; for a thread.

    Raises:
        OSError: the file cannot be read.
    """
    file.seek(thumbnail.offset)
    picture = _decode(file.read(thumbnail.length))
    return picture if picture.startswith(_FORMATS[thumbnail.format]) else b""


def thumbnail_path(name: str, thumbnail: Thumbnail) -> str:
    """Return how a picture of a file is called, relative to the file's directory.

    No file has this name: its first part begins with a dot. `parse_thumbnail_path` is the way back.
    """
    base = name.rpartition("/")[2]
    return f".thumbs/{base}-{thumbnail.width}x{thumbnail.height}.{thumbnail.format}"


def parse_thumbnail_path(path: str) -> tuple[str, int, int] | None:
    """Return the name of the file, the width and the height that a path of a picture stands for.

    Args:
        path: relative to the root; the name that it stands for has still to be checked.
    """
    match = _PATH.fullmatch(path)
    if match is None:
        return None
    directory, base, width, height, _ = match.groups()
    return f"{directory}/{base}" if directory else base, int(width), int(height)


def _decode(text: bytes) -> bytes:
    """Return the bytes that lines of base64 stand for; empty if they stand for none."""
    try:
        return base64.b64decode(text.translate(None, b"; \t\r\n"), validate=True)
    except binascii.Error:
        return b""
