"""The methods for files (external_api/file_manager.md). There is one root, ``gcodes``."""

from typing import Any

import msgspec

from toolpost.clock import seconds
from toolpost.dialects.moonraker.connections import Connection, Connections
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.rpc import Method, NoParams
from toolpost.errors import FileMissingError, InvalidRequestError
from toolpost.events import Event, FileChanged
from toolpost.gcode.entries import Change, Entry
from toolpost.shop import Shop

ROOT = "gcodes"
NOTIFICATION = "notify_filelist_changed"
THUMBNAILS = ".thumbs"


class ListParams(msgspec.Struct, frozen=True):
    """The root to list."""

    root: str = ROOT


class DirectoryParams(msgspec.Struct, frozen=True):
    """A directory, beginning with its root; `extended` adds what the slicers wrote."""

    path: str = ROOT
    extended: bool = False
    force: bool = False


class MetadataParams(msgspec.Struct, frozen=True):
    """A file, relative to the root."""

    filename: str


class MoveParams(msgspec.Struct, frozen=True):
    """Two paths, each beginning with its root."""

    source: str
    dest: str


class PathParams(msgspec.Struct, frozen=True):
    """A path that begins with its root."""

    path: str


class FileMethods:
    """The files, for the clients of one machine.

    Args:
        shop: has them.
        connections: are told of changes.
    """

    def __init__(self, shop: Shop, connections: Connections) -> None:
        self._files = shop.files
        self._connections = connections

    def methods(self) -> list[Method]:
        """Return the methods."""
        path, name = "/server/files", "server.files"
        directory = f"{path}/directory"
        return [
            Method(f"{name}.list", ("GET", f"{path}/list"), ListParams, self.list_files),
            Method(f"{name}.roots", ("GET", f"{path}/roots"), NoParams, self.roots),
            Method(f"{name}.metadata", ("GET", f"{path}/metadata"), MetadataParams, self.metadata),
            Method(f"{name}.metascan", ("POST", f"{path}/metascan"), MetadataParams, self.metadata),
            Method(f"{name}.thumbnails", ("GET", f"{path}/thumbnails"), MetadataParams, self.thumbnails),
            Method(f"{name}.get_directory", ("GET", directory), DirectoryParams, self.get_directory),
            Method(f"{name}.post_directory", ("POST", directory), PathParams, self.post_directory),
            Method(f"{name}.delete_directory", ("DELETE", directory), DirectoryParams, self.delete_directory),
            Method(f"{name}.move", ("POST", f"{path}/move"), MoveParams, self.move),
            Method(f"{name}.copy", ("POST", f"{path}/copy"), MoveParams, self.copy),
            Method(f"{name}.delete_file", None, PathParams, self.delete_file),
        ]

    async def list_files(self, params: ListParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.files.list``: all files at any depth."""
        _check_root(params.root)
        return [_item("path", entry.path, entry) for entry in await self._files.entries()]

    async def roots(self, params: NoParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.files.roots``. Where it is on this computer is nobody's business."""
        return [{"name": ROOT, "path": ROOT, "permissions": "rw"}]

    async def metadata(self, params: MetadataParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.files.metadata``: what the slicer wrote into a file."""
        return await self._metadata(_relative(params.filename))

    async def thumbnails(self, params: MetadataParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.files.thumbnails``: the pictures in a file."""
        found = (await self._metadata(_relative(params.filename))).get("thumbnails", [])
        return [{**picture, "thumbnail_path": picture["relative_path"]} for picture in found]

    async def get_directory(self, params: DirectoryParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.files.get_directory``: what is in one directory."""
        listing = await self._files.listing(_inside(params.path))
        files = []
        for entry in listing.files:
            item = _item("filename", _base(entry.path), entry)
            if params.extended:
                item = {**await self._metadata(entry.path), **item}
            files.append(item)
        return {
            "dirs": [_item("dirname", _base(entry.path), entry) for entry in listing.directories],
            "files": files,
            "disk_usage": listing.disk,
            "root_info": {"name": ROOT, "permissions": "rw"},
        }

    async def post_directory(self, params: PathParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.files.post_directory``: make a directory."""
        return _told(await self._files.make_directory(_inside(params.path)))

    async def delete_directory(self, params: DirectoryParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.files.delete_directory``; one that is not empty only with `force`."""
        return _told(await self._files.delete_directory(_inside(params.path), force=params.force))

    async def move(self, params: MoveParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.files.move``."""
        return _told(await self._files.move(_inside(params.source), _inside(params.dest)))

    async def copy(self, params: MoveParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.files.copy``."""
        return _told(await self._files.copy(_inside(params.source), _inside(params.dest)))

    async def delete_file(self, params: PathParams, connection: Connection) -> object:  # noqa: ARG002
        """``server.files.delete_file``."""
        return await self.delete(_inside(params.path))

    async def delete(self, name: str) -> object:
        """Delete a file by its name."""
        return _told(await self._files.delete(name))

    def event(self, event: Event) -> None:
        """Tell all connections of a change."""
        if isinstance(event, FileChanged):
            self._connections.notify(NOTIFICATION, _told(event.change))

    async def _metadata(self, name: str) -> dict[str, Any]:
        try:
            entry = await self._files.info(name)
            known = msgspec.to_builtins(await self._files.metadata(name))
        except FileMissingError:
            raise RpcError(404, f"Metadata not available for <{name}>") from None
        pictures = known.pop("thumbnails", [])
        if pictures:
            known["thumbnails"] = [_picture(name, picture) for picture in pictures]
        return {**_item("filename", name, entry), **known}


def _picture(name: str, picture: dict[str, Any]) -> dict[str, Any]:
    width, height, kind = picture["width"], picture["height"], picture["format"]
    directory, _, base = name.rpartition("/")
    path = f"{THUMBNAILS}/{base}-{width}x{height}.{kind}"
    return {
        "width": width,
        "height": height,
        "size": picture["size"],
        "relative_path": path,
        "thumbnail_path": f"{directory}/{path}" if directory else path,
    }


def _item(field: str, name: str, entry: Entry) -> dict[str, Any]:
    return {
        field: name,
        "modified": seconds(entry.modified_us),
        "size": entry.size,
        "permissions": entry.permissions,
    }


def told_item(entry: Entry) -> dict[str, Any]:
    """Return a file or directory as answers and notifications about changes name it."""
    return {**_item("path", entry.path, entry), "root": ROOT}


def _told(change: Change) -> dict[str, Any]:
    told: dict[str, Any] = {"action": change.action.value, "item": told_item(change.item)}
    if change.source is not None:
        told["source_item"] = {"path": change.source, "root": ROOT}
    return told


def _check_root(root: str) -> None:
    if root != ROOT:
        raise RpcError(400, f"Invalid root path ({root})")


def _inside(path: str) -> str:
    """Return a path that begins with its root relative to it."""
    root, _, name = path.strip("/").partition("/")
    _check_root(root)
    return name


def _relative(filename: str) -> str:
    if not filename:
        raise InvalidRequestError("filename: must not be empty")
    return filename.removeprefix(f"{ROOT}/")


def _base(path: str) -> str:
    return path.rpartition("/")[2]
