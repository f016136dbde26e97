"""Uploads and downloads (external_api/file_manager.md). A file comes from the request's body alone."""

import asyncio
import contextlib
import re
from typing import Any, BinaryIO, Final

import msgspec
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from toolpost.dialects.moonraker.arguments import compile_params
from toolpost.dialects.moonraker.errors import RpcError, as_rpc_error
from toolpost.dialects.moonraker.files import ROOT, THUMBNAILS, FileMethods, told_item
from toolpost.dialects.moonraker.http import send_error, send_result
from toolpost.errors import FileMissingError
from toolpost.http.multipart import read_upload
from toolpost.shop import Shop

_BLOCK: Final = 256 * 1024
_RANGE: Final = re.compile(rb"bytes=(\d*)-(\d*)")
_THUMBNAIL: Final = re.compile(
    rf"(?P<directory>(?:.*/)?){re.escape(THUMBNAILS)}/(?P<base>.+)-(\d+)x(\d+)\.(?:png|jpg)"
)


class UploadFields(msgspec.Struct, frozen=True):
    """What comes beside the file. `path` is a directory inside of the root."""

    root: str = ROOT
    path: str = ""
    checksum: str | None = None
    start: bool = msgspec.field(default=False, name="print")


_convert = compile_params(UploadFields)


class Transfer:
    """Uploads to, and downloads from, the files of one machine.

    Args:
        shop: has the files, and the queue that an upload may be put into.
        machine: name of the machine.
        methods: delete files.
    """

    def __init__(self, shop: Shop, machine: str, methods: FileMethods) -> None:
        self._shop = shop
        self._machine = machine
        self._methods = methods

    def routes(self) -> list[Route]:
        """Return the routes."""
        return [
            Route("/server/files/upload", _Endpoint(self.upload, {"POST"})),
            Route(f"/server/files/{ROOT}/{{name:path}}", _Endpoint(self.file, {"GET", "HEAD", "DELETE"})),
        ]

    async def upload(self, scope: Scope, receive: Receive, send: Send) -> None:
        """``POST /server/files/upload``: 201 when the file is on disk."""
        async with self._shop.files.upload() as upload:
            content_type = _header(scope, b"content-type")
            most = self._shop.files.max_bytes
            form = await read_upload(receive, content_type, upload.write, most)
            fields = _convert(dict(form.fields))
            if fields.root != ROOT:
                raise RpcError(400, f"Invalid root request: {fields.root}")
            directory = fields.path.strip("/")
            name = f"{directory}/{form.filename}" if directory else form.filename
            change = await upload.commit(name, fields.checksum)
        started, queued = await self._start(change.item.path, scope) if fields.start else (False, False)
        body = {
            "item": told_item(change.item),
            "action": "create_file",
            "print_started": started,
            "print_queued": queued,
        }
        await _send_created(scope, send, body, change.item.path)

    async def _start(self, name: str, scope: Scope) -> tuple[bool, bool]:
        """Queue a file, first if the machine is free; return whether it starts, and whether it waits."""
        actor = scope.get("toolpost.actor", "")
        await self._shop.enqueue(self._machine, [name], replace=False, shown=None, actor=actor)
        jobs = self._shop.queue(self._machine).jobs
        if self._shop.status(self._machine).running_job is not None or len(jobs) != 1:
            return False, True
        await self._shop.start_queue(self._machine)
        return True, False

    async def file(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: ARG002
        """``GET`` or ``DELETE /server/files/gcodes/NAME``."""
        name = scope["path_params"]["name"]
        if scope["method"] == "DELETE":
            result = await self._methods.delete(name)
            await send_result(scope, send, msgspec.json.encode({"result": result}))
            return
        picture = _THUMBNAIL.fullmatch(name)
        if picture is not None:
            path = f"{picture['directory']}{picture['base']}"
            data, kind = await self._shop.files.thumbnail(path, int(picture[3]), int(picture[4]))
            await _send_whole(scope, send, data, b"image/png" if kind == "png" else b"image/jpeg")
            return
        file, entry = await self._shop.files.open(name)
        with contextlib.closing(file):
            await _send_file(scope, send, file, entry.size)


class _Endpoint:
    """An ASGI application whose errors are Moonraker's."""

    def __init__(self, call: Any, verbs: set[str]) -> None:  # noqa: ANN401  # an ASGI call
        self._call = call
        self._verbs = verbs

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["method"] not in self._verbs:
            await send_error(scope, send, RpcError(405, "Method Not Allowed"))
            return
        try:
            await self._call(scope, receive, send)
        except FileMissingError:
            await send_error(scope, send, RpcError(404, "Not Found"))
        except Exception as error:  # noqa: BLE001  # the one place that routes them
            await send_error(scope, send, as_rpc_error(error, scope["path"]))


async def _send_created(scope: Scope, send: Send, body: dict[str, Any], path: str) -> None:
    host = _header(scope, b"host")
    headers = [
        (b"content-type", b"application/json; charset=UTF-8"),
        (b"location", f"http://{host}/server/files/{ROOT}/{path}".encode("utf-8", "replace")),
    ]
    await send({"type": "http.response.start", "status": 201, "headers": headers})
    await send({"type": "http.response.body", "body": msgspec.json.encode(body)})


async def _send_whole(scope: Scope, send: Send, data: bytes, content_type: bytes) -> None:
    headers = [
        (b"content-type", content_type),
        (b"content-length", b"%d" % len(data)),
        (b"x-content-type-options", b"nosniff"),
    ]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else data})


async def _send_file(scope: Scope, send: Send, file: BinaryIO, size: int) -> None:
    """Send a file, or the one range of it that is asked for (RFC 9110, section 14)."""
    first, last = _range(_header(scope, b"range").encode(), size)
    whole = (first, last) == (0, size - 1) or size == 0
    headers = [
        # Never as a page: a file may hold anything.
        (b"content-type", b"application/octet-stream"),
        (b"content-disposition", b"attachment"),
        (b"x-content-type-options", b"nosniff"),
        (b"accept-ranges", b"bytes"),
        (b"content-length", b"%d" % (last - first + 1)),
    ]
    if not whole:
        headers.append((b"content-range", b"bytes %d-%d/%d" % (first, last, size)))
    await send({"type": "http.response.start", "status": 200 if whole else 206, "headers": headers})
    left = 0 if scope["method"] == "HEAD" else last - first + 1
    file.seek(first)
    while left > 0:
        data = await asyncio.to_thread(file.read, min(left, _BLOCK))
        if not data:
            break
        left -= len(data)
        await send({"type": "http.response.body", "body": data, "more_body": left > 0})
    if left or scope["method"] == "HEAD" or size == 0:
        await send({"type": "http.response.body", "body": b""})


def _range(header: bytes, size: int) -> tuple[int, int]:
    """Return the first and the last byte to send; a range that makes no sense is left out of account."""
    match = _RANGE.fullmatch(header.strip())
    if match is None or match[0] == b"bytes=-":
        return 0, size - 1
    if not match[1]:
        return max(0, size - int(match[2])), size - 1
    first = int(match[1])
    last = min(int(match[2]), size - 1) if match[2] else size - 1
    return (first, last) if first <= last else (0, size - 1)


def _header(scope: Scope, name: bytes) -> str:
    return next((value.decode("latin-1") for key, value in scope["headers"] if key == name), "")
