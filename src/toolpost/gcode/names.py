"""Which names files may have. Pure rules: nothing here looks at a disk.

A name is relative to the root ``gcodes``, its parts are separated by ``/``, and the transport has decoded it
once: ``%2e%2e`` in it is a name like any other, and so is a first part ``gcodes``.

What is refused is what means more than a name somewhere: on this system, on the Windows computers that
files are downloaded to, or to the eye of the person who chooses a file to run.
"""

import re
from typing import Final

from toolpost.gcode.errors import InvalidNameError

MAX_PART: Final = 255
"""Longest part of a name in bytes of UTF-8, as file systems have it."""
MAX_NAME: Final = 1024
"""Longest name in bytes of UTF-8."""
MAX_DEPTH: Final = 32
"""Most parts of a name."""
GCODE_SUFFIXES: Final = (".gcode", ".g", ".gco")
"""Endings of the files that a job can be made of, in any case; Klipper lists no others."""

# C0, DEL and C1; line and paragraph separators; what turns the direction of text; what takes no room.
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u200b\u2028-\u202e\u2060\u2066-\u2069\ufeff]")
_SURROGATE = re.compile(r"[\ud800-\udfff]")
_DRIVE = re.compile(r"[A-Za-z]:")
_DEVICE = re.compile(r"(?:con|prn|aux|nul|conin\$|conout\$|(?:com|lpt)[0-9¹²³])[ ]*(?:\..*)?", re.IGNORECASE)


def split_name(name: str) -> tuple[str, ...]:
    """Return the parts of a file's name.

    Raises:
        InvalidNameError: no file may be called so; the message says why.
    """
    problem = _problem(name)
    if problem is not None:
        raise InvalidNameError(f"{name[:200]!r}: {problem}")
    return tuple(name.split("/"))


def split_directory(name: str) -> tuple[str, ...]:
    """Return the parts of a directory's name, none for the root, which is the empty text.

    Raises:
        InvalidNameError: as `split_name`.
    """
    return split_name(name) if name else ()


def split_gcode(name: str) -> tuple[str, ...]:
    """Return the parts of the name of a file that a job can be made of.

    Raises:
        InvalidNameError: as `split_name`, or the name does not end as that of a G-code file.
    """
    parts = split_name(name)
    if not is_gcode(name):
        known = ", ".join(GCODE_SUFFIXES)
        raise InvalidNameError(f"{name[:200]!r}: not a G-code file; its name must end with one of {known}")
    return parts


def is_gcode(name: str) -> bool:
    """Return whether a name ends as that of a G-code file."""
    return name.lower().endswith(GCODE_SUFFIXES)


def is_name(name: str) -> bool:
    """Return whether a file or directory may be called so."""
    return _problem(name) is None


def is_part(text: str) -> bool:
    """Return whether a file or directory may be called so within its directory."""
    return "/" not in text and _problem(text) is None


def _problem(name: str) -> str | None:
    """Return what is wrong with a name."""
    if not name:
        return "a name must be given"
    if len(name) > MAX_NAME:
        return f"a name must be at most {MAX_NAME} bytes"
    if "\0" in name:
        return "a name must not contain NUL"
    if "\\" in name:
        return "a name must not contain a backslash"
    if _CONTROL.search(name):
        return "a name must not contain control characters"
    if _SURROGATE.search(name):
        return "a name must be Unicode text"
    if name.startswith("/"):
        return "a name must be relative to gcodes: without / at its beginning"
    if not name.isascii() and len(name.encode()) > MAX_NAME:
        return f"a name must be at most {MAX_NAME} bytes"
    parts = name.split("/")
    if len(parts) > MAX_DEPTH:
        return f"a name must have at most {MAX_DEPTH} parts"
    for part in parts:
        problem = _part_problem(part)
        if problem is not None:
            return problem
    return None


def _part_problem(part: str) -> str | None:
    if not part:
        return "a name must not have empty parts"
    if part in {".", ".."}:
        return "a name must not contain . or .. as a part"
    if part.startswith("."):
        return "a part of a name must not begin with a dot"
    if part.endswith("."):
        return "a part of a name must not end with a dot"
    if part != part.strip():
        return "a part of a name must not begin or end with a blank"
    if len(part) > MAX_PART or (not part.isascii() and len(part.encode()) > MAX_PART):
        return f"a part of a name must be at most {MAX_PART} bytes"
    if _DRIVE.match(part):
        return "a name must not begin with a drive letter"
    if _DEVICE.fullmatch(part):
        return "a name must not be that of a device"
    return None
