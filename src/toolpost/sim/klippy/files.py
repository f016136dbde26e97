"""The G-code files below one directory, found by name as ``virtual_sdcard`` does it."""

import os
from pathlib import Path

SUFFIXES = (".gcode", ".g", ".gco")
"""Files that can be printed; in small letters only."""


def listing(directory: Path) -> list[tuple[str, int]]:
    """Return each printable file in the tree, with its size in bytes, by name."""
    found = []
    for folder, _, names in os.walk(directory, followlinks=True):
        for name in names:
            if name.endswith(SUFFIXES):
                path = Path(folder, name)
                if path.is_file():
                    found.append((path.relative_to(directory).as_posix(), path.stat().st_size))
    return sorted(found, key=lambda entry: entry[0].lower())


def find(directory: Path, name: str) -> Path | None:
    """Return the file called ``name``, or one whose name differs in capitals only.

    A name that leads out of the directory is the name of no file.
    """
    names = [entry for entry, _ in listing(directory)]
    if name in names:
        return directory / name
    for entry in reversed(names):
        if entry.lower() == name.lower():
            return directory / entry
    return None
