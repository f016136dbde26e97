"""The files that people see: names under one directory, and nothing outside it.

No path is ever put together from a name. Each part of a name is opened in the directory before it, and no
symbolic link is followed, so that neither a name nor a link that somebody swaps in meanwhile leads out.

What appears under a name is complete and on disk: it is written elsewhere, synced, and then renamed.
"""

import asyncio
import contextlib
import errno
import itertools
import os
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, Final

from toolpost.errors import NotAcceptedError, StorageError
from toolpost.gcode import names
from toolpost.gcode.content import ContentWriter, Identity, identity
from toolpost.gcode.entries import Action, Change, Disk, Entry, Listing, PinnedFile
from toolpost.gcode.errors import FileMissingError
from toolpost.gcode.metadata import Metadata, read_metadata
from toolpost.gcode.pins import PinStore
from toolpost.gcode.thumbnails import read_thumbnail
from toolpost.gcode.upload import Upload

PARTS: Final = ".parts"
"""Directory under the root where files are written before they get their name; no name begins with a dot."""
MAX_ENTRIES: Final = 100_000
"""Most files and directories of a list; those beyond are left out."""

_DIRECTORY = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_MAX_METADATA = 1000

_REFUSALS = {
    errno.ENOTDIR: "a part of the name is not a directory",
    errno.ELOOP: "a part of the name is a symbolic link",
    errno.EISDIR: "there is a directory of that name",
    errno.EEXIST: "it is there already",
    errno.ENOTEMPTY: "there is a directory of that name, and it is not empty",
    errno.EINVAL: "a directory cannot be put into itself",
    errno.EXDEV: "it is on another file system",
    errno.EBUSY: "the operating system is using it",
    errno.EACCES: "the operating system does not permit it",
    errno.EPERM: "the operating system does not permit it",
}


class Files:
    """The root ``gcodes``. Names are as `toolpost.gcode.names` demands.

    Changes are made one after the other and told in that order. Every method raises InvalidNameError for
    what is no name, FileMissingError for what is not there, NotAcceptedError for what the present state does
    not allow, and StorageError if the disk fails.

    Args:
        directory: the root; made if missing. It may be a symbolic link itself.
        pins: where content is kept for jobs; made if missing, and for nothing else.
        on_change: is told of each change, in the event loop, when it is on disk.
        max_bytes: longest upload.
        max_uploads: uploads at one time.
        keep_free: bytes of the disk that no upload or copy may take.
    """

    def __init__(
        self,
        directory: Path,
        pins: Path,
        on_change: Callable[[Change], None] = lambda _: None,
        *,
        max_bytes: int = 4 * 2**30,
        max_uploads: int = 8,
        keep_free: int = 64 * 2**20,
    ) -> None:
        self._root = directory
        self._parts = directory / PARTS
        self._on_change = on_change
        self._keep_free = keep_free
        self._uploads = asyncio.BoundedSemaphore(max_uploads)
        self._turn = asyncio.Lock()
        self._metadata: dict[Identity, Metadata] = {}
        self._pins = PinStore(pins, keep_free)
        self.max_bytes = max_bytes
        self._parts.mkdir(parents=True, exist_ok=True)
        for left_over in self._parts.iterdir():
            _remove(left_over)

    # Looking

    async def entries(self) -> list[Entry]:
        """Return all files, at any depth, sorted by name."""
        return await asyncio.to_thread(self._entries)

    async def listing(self, directory: str = "") -> Listing:
        """Return what is in one directory."""
        return await asyncio.to_thread(self._listing, directory)

    async def info(self, name: str) -> Entry:
        """Return one file or directory."""
        return await asyncio.to_thread(self._info, name)

    async def open(self, name: str) -> tuple[BinaryIO, Entry]:
        """Open a file for reading; the caller closes it. It keeps its content whatever the name gets."""
        return await asyncio.to_thread(self._open, name)

    async def metadata(self, name: str) -> Metadata:
        """Return what the slicer wrote into a file."""
        return await asyncio.to_thread(self._read_metadata, name)

    async def thumbnail(self, name: str, width: int, height: int) -> tuple[bytes, str]:
        """Return a picture of a file and its format, ``png`` or ``jpg``."""
        return await asyncio.to_thread(self._thumbnail, name, width, height)

    # Changing

    def upload(self) -> "Upload":
        """Return a new upload, to be used with ``async with``."""
        part = self._parts / f"{secrets.token_hex(8)}.part"
        return Upload(part, self._adopt_in_turn, self._uploads, self.max_bytes, self._keep_free)

    async def move(self, source: str, destination: str) -> Change:
        """Move a file or directory; into `destination` if that is a directory, else in place of it."""
        return await self._change(lambda: self._move(source, destination))

    async def copy(self, source: str, destination: str) -> Change:
        """Copy a file or directory; `destination` as in `move`."""
        return await self._change(lambda: self._copy(source, destination))

    async def delete(self, name: str) -> Change:
        """Delete a file."""
        return await self._change(lambda: self._delete(name))

    async def make_directory(self, name: str) -> Change:
        """Make a directory, in one that is there."""
        return await self._change(lambda: self._make_directory(name))

    async def delete_directory(self, name: str, *, force: bool = False) -> Change:
        """Delete a directory; one that is not empty only with `force`."""
        return await self._change(lambda: self._delete_directory(name, force=force))

    # Content for jobs

    async def pin(self, name: str) -> PinnedFile:
        """Keep what a G-code file holds now for a job, whatever happens to the name later."""
        return (await self.pin_all([name]))[0]

    async def pin_all(self, wanted: Sequence[str]) -> list[PinnedFile]:
        """Pin several files, in their order; if one cannot be pinned, the error names it and none counts."""
        return await asyncio.to_thread(self._pin_all, wanted)

    async def pinned(self, sha256: str) -> PinnedFile:
        """Return content that was pinned.

        Raises:
            StorageError: it is not there.
        """
        return await asyncio.to_thread(self._pins.get, sha256)

    async def trim(self, in_use: set[str], max_bytes: int) -> None:
        """Delete the oldest contents that are not `in_use`, if all together are larger than `max_bytes`."""
        await asyncio.to_thread(self._pins.trim, in_use, max_bytes)

    # What the methods above do, in a thread.

    def _entries(self) -> list[Entry]:
        with _refusing(""), self._within() as root:
            every = itertools.islice(_walk(root, ""), MAX_ENTRIES)
            found = [entry for entry in every if not entry.is_directory]
        return sorted(found, key=lambda entry: entry.path)

    def _listing(self, directory: str) -> Listing:
        parts = names.split_directory(directory)
        with _refusing(directory), self._within(parts) as fd:
            every = itertools.islice(_scan(fd, f"{directory}/" if parts else ""), MAX_ENTRIES)
            found = sorted(every, key=lambda entry: entry.path)
            disk = os.fstatvfs(fd)
        return Listing(
            [entry for entry in found if entry.is_directory],
            [entry for entry in found if not entry.is_directory],
            Disk(
                disk.f_blocks * disk.f_frsize,
                (disk.f_blocks - disk.f_bfree) * disk.f_frsize,
                disk.f_bavail * disk.f_frsize,
            ),
        )

    def _info(self, name: str) -> Entry:
        *parents, base = names.split_name(name)
        with _refusing(name), self._within(parents) as fd:
            return _entry(name, _status(base, fd, name))

    def _open(self, name: str) -> tuple[BinaryIO, Entry]:
        *parents, base = names.split_name(name)
        with _refusing(name), self._within(parents) as fd:
            file = os.fdopen(_open_file(base, fd, name), "rb")
        return file, _entry(name, os.fstat(file.fileno()))

    def _read_metadata(self, name: str) -> Metadata:
        file, _ = self._open(name)
        with file, _refusing(name):
            key = identity(os.fstat(file.fileno()))
            found = self._metadata.get(key)
            if found is None:
                found = read_metadata(file)
                if len(self._metadata) >= _MAX_METADATA:
                    self._metadata.clear()
                self._metadata[key] = found
        return found

    def _thumbnail(self, name: str, width: int, height: int) -> tuple[bytes, str]:
        metadata = self._read_metadata(name)
        file, _ = self._open(name)
        with file, _refusing(name):
            for thumbnail in metadata.thumbnails:
                if (thumbnail.width, thumbnail.height) == (width, height):
                    picture = read_thumbnail(file, thumbnail)
                    if picture:
                        return picture, thumbnail.format
        raise FileMissingError(name)

    def _move(self, source: str, destination: str) -> list[Change]:
        *parents, base = names.split_name(source)
        with _refusing(source), self._within(parents) as old:
            status = _status(base, old, source)
            with self._target(destination, base) as (new, final, path):
                os.rename(base, final, src_dir_fd=old, dst_dir_fd=new)
                os.fsync(new)
                os.fsync(old)
        action = Action.MOVE_DIR if stat.S_ISDIR(status.st_mode) else Action.MOVE_FILE
        return [Change(action, _entry(path, status), source)]

    def _copy(self, source: str, destination: str) -> list[Change]:
        *parents, base = names.split_name(source)
        part = self._parts / f"{secrets.token_hex(8)}.part"
        try:
            with _refusing(source), self._within(parents) as old:
                is_directory = stat.S_ISDIR(_status(base, old, source).st_mode)
                if is_directory:
                    self._copy_tree(old, base, part)
                else:
                    self._copy_file(old, base, part)
            with self._target(destination, base) as (new, final, path):
                os.rename(part, final, dst_dir_fd=new)
                os.fsync(new)
                status = _status(final, new, path)
        finally:
            _remove(part)
        return [Change(Action.CREATE_DIR if is_directory else Action.CREATE_FILE, _entry(path, status))]

    def _copy_file(self, directory: int, base: str, part: Path) -> None:
        source = _open_file(base, directory, base)
        try:
            writer = ContentWriter(part, self._keep_free)
            try:
                writer.copy(source)
                writer.finish(0o644)
            finally:
                writer.close()
        finally:
            os.close(source)

    def _copy_tree(self, directory: int, base: str, part: Path, depth: int = 1) -> None:
        if depth > names.MAX_DEPTH:
            raise NotAcceptedError(f"{base!r}: there are directories too deep in it")
        part.mkdir()
        inner = os.open(base, _DIRECTORY, dir_fd=directory)
        try:
            for entry in _scan(inner, ""):
                if entry.is_directory:
                    self._copy_tree(inner, entry.path, part / entry.path, depth + 1)
                else:
                    self._copy_file(inner, entry.path, part / entry.path)
        finally:
            os.close(inner)
        _sync(part)

    def _delete(self, name: str) -> list[Change]:
        *parents, base = names.split_name(name)
        with _refusing(name), self._within(parents) as fd:
            if stat.S_ISDIR(_status(base, fd, name).st_mode):
                raise NotAcceptedError(f"{name!r}: it is a directory")
            os.unlink(base, dir_fd=fd)
            os.fsync(fd)
        return [Change(Action.DELETE_FILE, Entry(name, 0, 0, ""))]

    def _make_directory(self, name: str) -> list[Change]:
        *parents, base = names.split_name(name)
        with _refusing(name), self._within(parents) as fd:
            os.mkdir(base, 0o755, dir_fd=fd)
            os.fsync(fd)
            return [Change(Action.CREATE_DIR, _entry(name, _status(base, fd, name)))]

    def _delete_directory(self, name: str, *, force: bool) -> list[Change]:
        *parents, base = names.split_name(name)
        with _refusing(name), self._within(parents) as fd:
            if not stat.S_ISDIR(_status(base, fd, name).st_mode):
                raise NotAcceptedError(f"{name!r}: it is a file")
            if force:
                # It is gone at once, and not in parts.
                part = self._parts / f"{secrets.token_hex(8)}.part"
                os.rename(base, part, src_dir_fd=fd)
                os.fsync(fd)
                _remove(part)
            else:
                os.rmdir(base, dir_fd=fd)
                os.fsync(fd)
        return [Change(Action.DELETE_DIR, Entry(name, 0, 0, "", is_directory=True))]

    def _pin_all(self, wanted: Sequence[str]) -> list[PinnedFile]:
        found: dict[str, PinnedFile] = {}
        by_directory: dict[tuple[str, ...], list[tuple[str, str]]] = {}
        for name in dict.fromkeys(wanted):
            *parents, base = names.split_gcode(name)
            by_directory.setdefault(tuple(parents), []).append((base, name))
        for directory, inside in by_directory.items():
            with _refusing(inside[0][1]), self._within(directory) as fd:
                for base, name in inside:
                    found[name] = self._pin(fd, base, name)
        return [found[name] for name in wanted]

    def _pin(self, directory: int, base: str, name: str) -> PinnedFile:
        with _refusing(name):
            known = self._pins.recall(_status(base, directory, name))
            if known is not None:
                return known
            fd = _open_file(base, directory, name)
            try:
                return self._pins.pin(fd)
            except NotAcceptedError as error:
                raise NotAcceptedError(f"{name!r}: {error}") from None
            finally:
                os.close(fd)

    async def _adopt_in_turn(self, part: Path, name: str, sha256: str) -> Change:
        return await self._change(lambda: self._adopt(part, name, sha256))

    def _adopt(self, part: Path, name: str, sha256: str) -> list[Change]:
        """Give a complete file that is on disk its name; directories that are missing are made."""
        *parents, base = names.split_name(name)
        made: list[str] = []
        with _refusing(name), self._within(parents, made) as fd:
            replaced = _exists(base, fd)
            os.rename(part, base, dst_dir_fd=fd)
            os.fsync(fd)
            status = _status(base, fd, name)
        self._pins.learn(status, sha256)
        before = [Change(Action.CREATE_DIR, self._info(directory)) for directory in made]
        action = Action.MODIFY_FILE if replaced else Action.CREATE_FILE
        return [*before, Change(action, _entry(name, status))]

    async def _change(self, work: Callable[[], list[Change]]) -> Change:
        """Do something that changes files, to its end even if nobody waits for it any more."""
        return await asyncio.shield(asyncio.ensure_future(self._in_turn(work)))

    async def _in_turn(self, work: Callable[[], list[Change]]) -> Change:
        async with self._turn:
            changes = await asyncio.to_thread(work)
            for change in changes:
                self._on_change(change)
        return changes[-1]

    @contextlib.contextmanager
    def _within(self, parts: Sequence[str] = (), made: list[str] | None = None) -> Iterator[int]:
        """Open the directory of these parts; make those that are missing if `made` is there to note them."""
        fd = os.open(self._root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            for depth, part in enumerate(parts, 1):
                if made is not None and not _exists(part, fd):
                    os.mkdir(part, 0o755, dir_fd=fd)
                    os.fsync(fd)
                    made.append("/".join(parts[:depth]))
                inner = os.open(part, _DIRECTORY, dir_fd=fd)
                os.close(fd)
                fd = inner
            yield fd
        finally:
            os.close(fd)

    @contextlib.contextmanager
    def _target(self, destination: str, base: str) -> Iterator[tuple[int, str, str]]:
        """Open the directory that something called `base` goes to; yield it, the name in it, and the path."""
        parts = names.split_directory(destination)
        with _refusing(destination):
            try:
                into = not parts or self._info(destination).is_directory
            except FileMissingError:
                into = False
            path = f"{destination}/{base}" if into and parts else base if into else destination
            *parents, final = names.split_name(path)
            with self._within(parents) as fd:
                yield fd, final, path


@contextlib.contextmanager
def _refusing(name: str) -> Iterator[None]:
    """Say what an error of the operating system means for this name."""
    try:
        yield
    except FileNotFoundError:
        raise FileMissingError(name) from None
    except OSError as error:
        if error.errno in _REFUSALS:
            raise NotAcceptedError(f"{name!r}: {_REFUSALS[error.errno]}") from None
        raise StorageError(f"{name!r}: {error.strerror}") from None


def _status(base: str, directory: int, name: str) -> os.stat_result:
    """Return the status of a file or directory; anything else counts as not there."""
    status = os.stat(base, dir_fd=directory, follow_symlinks=False)
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise FileMissingError(name)
    return status


def _exists(base: str, directory: int) -> bool:
    try:
        os.stat(base, dir_fd=directory, follow_symlinks=False)
    except FileNotFoundError:
        return False
    return True


def _open_file(base: str, directory: int, name: str) -> int:
    fd = os.open(base, _FILE, dir_fd=directory)
    mode = os.fstat(fd).st_mode
    if stat.S_ISREG(mode):
        return fd
    os.close(fd)
    if stat.S_ISDIR(mode):
        raise NotAcceptedError(f"{name!r}: it is a directory")
    raise FileMissingError(name)


def _entry(path: str, status: os.stat_result) -> Entry:
    is_directory = stat.S_ISDIR(status.st_mode)
    return Entry(path, status.st_size, status.st_mtime_ns // 1000, is_directory=is_directory)


def _scan(directory: int, prefix: str) -> Iterator[Entry]:
    """Yield the files and directories in a directory whose names are allowed."""
    with os.scandir(directory) as found:
        for item in found:
            if names.is_part(item.name):
                with contextlib.suppress(FileNotFoundError):
                    status = item.stat(follow_symlinks=False)
                    if stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode):
                        yield _entry(prefix + item.name, status)


def _walk(directory: int, prefix: str) -> Iterator[Entry]:
    """Yield all that is below a directory, at most as deep as names may be."""
    for entry in _scan(directory, prefix):
        if names.is_name(entry.path):
            yield entry
            if entry.is_directory:
                with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                    inner = os.open(entry.path.rpartition("/")[2], _DIRECTORY, dir_fd=directory)
                    try:
                        yield from _walk(inner, f"{entry.path}/")
                    finally:
                        os.close(inner)


def _sync(directory: Path) -> None:
    fd = os.open(directory, _DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _remove(path: Path) -> None:
    """Remove a file or directory of our own, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
