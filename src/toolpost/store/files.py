"""The files that people see: names under one directory, and nothing outside it.

No path is ever put together from a name. Each part of a name is opened in the directory before it, and no
symbolic link is followed, so that neither a name nor a link that somebody swaps in meanwhile leads out.

What appears under a name is complete and on disk: it is written elsewhere, synced, and then renamed.
"""

import asyncio
import contextlib
import errno
import os
import secrets
import shutil
import stat
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, Self, TypeVar

from toolpost.errors import NotAcceptedError, StorageError
from toolpost.gcode import names
from toolpost.gcode.entries import Action, Change, Disk, Entry, Listing, PinnedFile
from toolpost.gcode.errors import ChecksumError, FileMissingError, FileTooLargeError
from toolpost.gcode.metadata import Metadata, read_metadata
from toolpost.gcode.thumbnails import Thumbnail, read_thumbnail
from toolpost.store.pins import PinStore
from toolpost.store.writing import FileWriter, copy_file, identity, sync

T = TypeVar("T")

PARTS: Final = ".parts"
"""Directory under the root where files are written before they get their name; no name begins with a dot."""

_DIRECTORY = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_BUFFERED = 1024 * 1024
_MAX_ENTRIES = 100_000
_MAX_METADATA = 1000

_NOT_A_DIRECTORY = "a part of the name is not a directory"
_REFUSALS = {
    errno.ENOTDIR: _NOT_A_DIRECTORY,
    errno.ELOOP: _NOT_A_DIRECTORY,
    errno.EISDIR: "there is a directory of that name",
    errno.EEXIST: "it is there already",
    errno.ENOTEMPTY: "the directory is not empty",
    errno.EINVAL: "a directory cannot be put into itself",
    errno.EXDEV: "it is on another file system",
    errno.EBUSY: "it is in use by the operating system",
    errno.EACCES: "the operating system does not permit it",
    errno.EPERM: "the operating system does not permit it",
}
