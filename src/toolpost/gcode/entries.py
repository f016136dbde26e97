"""Files as other parts of Toolpost see them."""

from enum import StrEnum

import msgspec


class Entry(msgspec.Struct, frozen=True):
    """A file or a directory.

    Attributes:
        path: its name, relative to the root.
        size: bytes.
        modified_us: Unix time of the last change, microseconds.
        permissions: ``rw``; empty for what is gone.
        is_directory: whether it is a directory.
    """

    path: str
    size: int
    modified_us: int
    permissions: str = "rw"
    is_directory: bool = False


class Disk(msgspec.Struct, frozen=True):
    """The disk that the files are on, in bytes; `free` is what can still be written."""

    total: int
    used: int
    free: int


class Listing(msgspec.Struct, frozen=True):
    """What is in one directory, sorted by name, and the disk that it is on."""

    directories: list[Entry]
    files: list[Entry]
    disk: Disk


class Action(StrEnum):
    """What has happened to a file or a directory, in Moonraker's words (notify_filelist_changed)."""

    CREATE_FILE = "create_file"
    MODIFY_FILE = "modify_file"
    MOVE_FILE = "move_file"
    DELETE_FILE = "delete_file"
    CREATE_DIR = "create_dir"
    MOVE_DIR = "move_dir"
    DELETE_DIR = "delete_dir"


class Change(msgspec.Struct, frozen=True):
    """Something that has happened, and is on disk.

    Attributes:
        action: what.
        item: the file or directory as it is now.
        source: where it has been, if it was moved.
    """

    action: Action
    item: Entry
    source: str | None = None


class PinnedFile(msgspec.Struct, frozen=True):
    """Content that stays as it is for as long as a job needs it.

    Attributes:
        sha256: hash of the content, in hex.
        size: bytes.
        path: where to read it, as an absolute path that ends with ``.gcode``.
    """

    sha256: str
    size: int
    path: str
