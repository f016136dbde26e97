import asyncio
import contextlib
import errno
import hashlib
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.store.storing import run
from toolpost.errors import NotAcceptedError, StorageError, ToolpostError
from toolpost.gcode import content as content_module
from toolpost.gcode import pins as pins_module
from toolpost.gcode.content import BLOCK
from toolpost.gcode.entries import Action, Entry
from toolpost.gcode.errors import ChecksumError, FileMissingError, FileTooLargeError, InvalidNameError
from toolpost.store import files as module
from toolpost.store.files import PARTS, Files


class Bench:
    """Files in a temporary directory, and the changes that they tell."""

    def __init__(self, path, **options):
        self.root, self.raw = path / "gcodes", path / "raw"
        self.changes = []
        self.files = Files(self.root, self.raw, self.changes.append, **{"keep_free": 0} | options)

    @property
    def told(self):
        told = [(change.action.value, change.item.path, change.source) for change in self.changes]
        self.changes.clear()
        return told

    def put(self, name, data=b"G28\n"):
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        return path

    def names(self):
        """All there is but what is hidden, and nothing left over there."""
        assert list((self.root / PARTS).iterdir()) == []
        found = (path.relative_to(self.root).as_posix() for path in self.root.rglob("*"))
        return sorted(name for name in found if not name.startswith(PARTS))

    def pinned(self):
        return sorted(path.name for path in self.raw.iterdir())


@pytest.fixture
def bench(tmp_path):
    return Bench(tmp_path)


async def upload(files, name, data=b"G28\n", size=70_000, checksum=None):
    async with files.upload() as arriving:
        for at in range(0, len(data), size):
            await arriving.write(data[at : at + size])
        return await arriving.commit(name, checksum)


def sha(data):
    return hashlib.sha256(data).hexdigest()


# Looking


def test_lists(bench):
    bench.put("b.gcode", b"12345")
    bench.put("sub/a.gcode")
    bench.put("sub/deep/note.txt")
    os.utime(bench.root / "b.gcode", ns=(0, 1_234_567_890_123_456_789))

    async def main():
        entries = await bench.files.entries()
        assert [entry.path for entry in entries] == ["b.gcode", "sub/a.gcode", "sub/deep/note.txt"]
        assert (
            entries[0]
            == Entry("b.gcode", 5, 1_234_567_890_123_456, "rw")
            == await bench.files.info("b.gcode")
        )
        root = await bench.files.listing()
        assert [entry.path for entry in root.files] == ["b.gcode"]
        assert [entry.path for entry in root.directories] == ["sub"]
        assert root.directories[0].is_directory
        assert root.disk.total >= root.disk.used > 0 < root.disk.free
        sub = await bench.files.listing("sub")
        assert [entry.path for entry in sub.files] == ["sub/a.gcode"]
        assert [entry.path for entry in sub.directories] == ["sub/deep"]
        assert (await bench.files.info("sub")).is_directory

    run(main)


def test_lists_have_only_what_can_be_asked_for(bench, tmp_path):
    bench.put("a.gcode")
    for name in (".hidden", "a\\b.gcode", "c\n.gcode", "blank .gcode ", "nul.gcode"):
        bench.put(name)
    (bench.root / os.fsdecode(b"\xff.gcode")).write_bytes(b"")
    os.mkfifo(bench.root / "pipe.gcode")
    (bench.root / "link.gcode").symlink_to("a.gcode")
    (bench.root / "out").symlink_to(tmp_path)
    deep = bench.root
    for _ in range(40):
        deep /= "d" * 40
        deep.mkdir()

    async def main():
        entries = await bench.files.entries()
        assert [entry.path for entry in entries] == ["a.gcode"]
        for entry in (await bench.files.listing()).files:
            await bench.files.info(entry.path)
        assert [entry.path for entry in (await bench.files.listing()).directories] == ["d" * 40]

    run(main)


def test_lists_end_somewhere(bench, monkeypatch):
    monkeypatch.setattr(module, "MAX_ENTRIES", 3)
    for n in range(5):
        bench.put(f"{n}.gcode")

    async def main():
        assert len(await bench.files.entries()) == 3
        assert len((await bench.files.listing()).files) == 3

    run(main)


def test_an_open_file_keeps_its_content(bench):
    async def main():
        await upload(bench.files, "a.gcode", b"old")
        file, entry = await bench.files.open("a.gcode")
        with file:
            await upload(bench.files, "a.gcode", b"newer")
            assert (file.read(), entry.size) == (b"old", 3)

    run(main)


@pytest.mark.parametrize("name", ["gone.gcode", "gone/a.gcode", "pipe.gcode", "link.gcode", "out/a.gcode"])
def test_what_is_not_there(bench, tmp_path, name):
    os.mkfifo(bench.root / "pipe.gcode")
    (tmp_path / "a.gcode").write_bytes(b"secret")
    (bench.root / "link.gcode").symlink_to(tmp_path / "a.gcode")
    (bench.root / "out").symlink_to(tmp_path)

    async def main():
        for call in (bench.files.open, bench.files.pin, bench.files.metadata, bench.files.delete):
            if (call, name) == (bench.files.delete, "link.gcode"):
                continue
            with pytest.raises((FileMissingError, NotAcceptedError)) as raised:
                await call(name)
            assert name in str(raised.value)

    run(main)
    assert bench.pinned() == []
    assert (tmp_path / "a.gcode").read_bytes() == b"secret"


def test_a_directory_is_no_file(bench):
    bench.put("sub.gcode/a.gcode")

    async def main():
        for call in (bench.files.open, bench.files.pin, bench.files.metadata, bench.files.delete):
            with pytest.raises(NotAcceptedError, match="it is a directory"):
                await call("sub.gcode")
        with pytest.raises(NotAcceptedError, match="it is a file"):
            await bench.files.delete_directory("sub.gcode/a.gcode")
        with pytest.raises(NotAcceptedError, match="not a directory"):
            await bench.files.listing("sub.gcode/a.gcode")
        with pytest.raises(NotAcceptedError, match="not a directory"):
            await bench.files.info("sub.gcode/a.gcode/b.gcode")

    run(main)


# Changing


def test_moves(bench):
    bench.put("a.gcode", b"a")
    bench.put("b.gcode", b"b")
    bench.put("sub/deep/c.gcode")

    async def main():
        change = await bench.files.move("a.gcode", "x.gcode")
        assert (change.item.size, change.item.permissions) == (1, "rw")
        assert bench.told == [("move_file", "x.gcode", "a.gcode")]
        await bench.files.move("x.gcode", "sub")
        assert bench.told == [("move_file", "sub/x.gcode", "x.gcode")]
        await bench.files.move("sub/x.gcode", "b.gcode")
        assert (bench.root / "b.gcode").read_bytes() == b"a"
        await bench.files.move("sub/deep", "")
        await bench.files.move("deep", "renamed")
        assert bench.told[1:] == [("move_dir", "deep", "sub/deep"), ("move_dir", "renamed", "deep")]
        assert bench.names() == ["b.gcode", "renamed", "renamed/c.gcode", "sub"]
        for source, destination, why in (
            ("renamed", "renamed", "into itself"),
            ("renamed", "renamed/c.gcode/d", "not a directory"),
            ("renamed", "b.gcode", "not a directory"),
            ("b.gcode", "gone/b.gcode", "does not exist"),
            ("gone.gcode", "b.gcode", "does not exist"),
            ("b.gcode", "../b.gcode", "must not contain"),
        ):
            with pytest.raises(ToolpostError, match=why):
                await bench.files.move(source, destination)
        assert bench.told == []

    run(main)


def test_copies(bench):
    bench.put("a.gcode", b"a" * 100)
    bench.put("sub/deep/c.gcode", b"c")

    async def main():
        await bench.files.copy("a.gcode", "sub")
        await bench.files.copy("a.gcode", "b.gcode")
        await bench.files.copy("sub", "other")
        await bench.files.copy("a.gcode", "other/deep/c.gcode")
        assert bench.told == [
            ("create_file", "sub/a.gcode", None),
            ("create_file", "b.gcode", None),
            ("create_dir", "other", None),
            ("create_file", "other/deep/c.gcode", None),
        ]
        assert (bench.root / "other/deep/c.gcode").read_bytes() == b"a" * 100
        assert (bench.root / "sub/deep/c.gcode").read_bytes() == b"c"
        with pytest.raises(NotAcceptedError, match="not empty"):
            await bench.files.copy("other/deep", "sub")
        with pytest.raises(FileMissingError):
            await bench.files.copy("a.gcode", "gone/a.gcode")
        assert bench.told == []

    run(main)
    bench.names()


def test_a_copy_of_a_directory_has_no_links_and_an_end(bench, tmp_path):
    (tmp_path / "secret").write_bytes(b"secret")
    bench.put("sub/a.gcode")
    (bench.root / "sub/link.gcode").symlink_to(tmp_path / "secret")
    deep = bench.root / "deep"
    for _ in range(40):
        deep.mkdir()
        deep /= "d"

    async def main():
        await bench.files.copy("sub", "copy")
        assert sorted(path.name for path in (bench.root / "copy").iterdir()) == ["a.gcode"]
        with pytest.raises(NotAcceptedError, match="too deep"):
            await bench.files.copy("deep", "deep2")
        await bench.files.delete_directory("deep", force=True)

    run(main)
    assert "deep2" not in bench.names()


def test_directories(bench):
    async def main():
        await bench.files.make_directory("sub")
        await bench.files.make_directory("sub/deep")
        with pytest.raises(NotAcceptedError, match="there already"):
            await bench.files.make_directory("sub")
        with pytest.raises(FileMissingError):
            await bench.files.make_directory("gone/deep")
        with pytest.raises(NotAcceptedError, match="not empty"):
            await bench.files.delete_directory("sub")
        await bench.files.delete_directory("sub/deep")
        bench.put("sub/a/b.gcode")
        await bench.files.delete_directory("sub", force=True)
        assert bench.told == [
            ("create_dir", "sub", None),
            ("create_dir", "sub/deep", None),
            ("delete_dir", "sub/deep", None),
            ("delete_dir", "sub", None),
        ]
        with pytest.raises(InvalidNameError):
            await bench.files.delete_directory("", force=True)
        with pytest.raises(FileMissingError):
            await bench.files.delete_directory("sub", force=True)

    run(main)
    assert bench.names() == []


def test_a_deleted_file_is_told_as_moonraker_does(bench):
    bench.put("a.gcode")
    change = asyncio.run(bench.files.delete("a.gcode"))
    assert change.item == Entry("a.gcode", 0, 0, "")
    assert bench.told == [("delete_file", "a.gcode", None)]


def test_a_change_is_told_even_if_nobody_waits(bench):
    async def main():
        bench.put("a.gcode")
        moving = asyncio.create_task(bench.files.move("a.gcode", "b.gcode"))
        await asyncio.sleep(0)
        moving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await moving
        await bench.files.make_directory("later")
        assert bench.told == [("move_file", "b.gcode", "a.gcode"), ("create_dir", "later", None)]

    run(main)


# Nothing leads out

NAMES = st.one_of(
    st.text(max_size=20),
    st.lists(
        st.sampled_from(
            ["..", ".", "", "a", "sub", "out", "link.gcode", "secret", "a.gcode", "~", "\\", "C:", "gcodes"]
        )
        | st.text(max_size=4),
        max_size=6,
    ).map("/".join),
    st.sampled_from(
        ["/etc/passwd", "out/secret", "sub/out/secret", "link.gcode", "%2e%2e/secret", "..%5csecret"]
    ),
)


@pytest.fixture(scope="module")
def fenced(tmp_path_factory):
    """A root with links that lead out of it, and what is outside."""
    path = tmp_path_factory.mktemp("fenced")
    (path / "outside").mkdir()
    (path / "outside/secret").write_bytes(b"secret")
    return path


def outside(path):
    found = {}
    for item in path.rglob("*"):
        if not {"gcodes", "raw"} & set(item.relative_to(path).parts):
            found[item] = item.read_bytes() if item.is_file() else None
    return found


@given(NAMES, NAMES, st.sampled_from(range(9)))
@settings(max_examples=250, deadline=None)
def test_no_name_leads_out(fenced, name, other, call):
    bench = Bench(fenced)
    bench.put("a/a.gcode", b"inside")
    for link in (bench.root / "out", bench.root / "sub", bench.root / "a" / "out"):
        with contextlib.suppress(FileExistsError):
            link.symlink_to(fenced / "outside")
    with contextlib.suppress(FileExistsError):
        (bench.root / "link.gcode").symlink_to(fenced / "outside/secret")
    before = outside(fenced)

    async def main():
        files = bench.files
        if call == 0:
            file, _ = await files.open(name)
            with file:
                assert file.read() != b"secret"
        elif call == 1:
            await upload(files, name)
        elif call == 8:
            assert await files.pin(name)
            assert sha(b"secret") + ".gcode" not in bench.pinned()
        else:
            calls = {
                2: lambda: files.move(name, other),
                3: lambda: files.copy(name, other),
                4: lambda: files.delete(name),
                5: lambda: files.make_directory(name),
                6: lambda: files.delete_directory(name, force=True),
                7: lambda: files.listing(name),
            }
            await calls[call]()

    with contextlib.suppress(ToolpostError):
        asyncio.run(main())
    assert outside(fenced) == before


def test_a_link_that_is_swapped_in_leads_nowhere(bench, tmp_path):
    """Somebody on this computer swaps a directory for a link while files are read and written."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/a.gcode").write_bytes(b"secret")
    bench.put("sub/a.gcode", b"inside")
    (bench.root / ".link").symlink_to(tmp_path / "outside")
    stop = threading.Event()

    def swap():
        while not stop.is_set():
            with contextlib.suppress(OSError):
                (bench.root / "sub").rename(bench.root / ".kept")
                (bench.root / ".link").rename(bench.root / "sub")
                (bench.root / "sub").rename(bench.root / ".link")
                (bench.root / ".kept").rename(bench.root / "sub")

    swapping = threading.Thread(target=swap)
    swapping.start()

    async def main():
        until = time.monotonic() + 0.7
        seen = 0
        while time.monotonic() < until:
            with contextlib.suppress(ToolpostError):
                file, _ = await bench.files.open("sub/a.gcode")
                with file:
                    assert file.read() == b"inside"
                seen += 1
            with contextlib.suppress(ToolpostError):
                await bench.files.copy("sub/a.gcode", "sub/b.gcode")
        assert seen

    try:
        run(main)
    finally:
        stop.set()
        swapping.join()
    assert [path.name for path in (tmp_path / "outside").iterdir()] == ["a.gcode"]


# Uploads


@pytest.mark.parametrize("size", [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 17])
def test_an_upload(bench, size):
    data = random.Random(size).randbytes(size)

    async def main():
        change = await upload(bench.files, "sub/deep/a.gcode", data, checksum=f" {sha(data).upper()} ")
        assert (change.action, change.item.size, change.item.path) == (
            Action.CREATE_FILE,
            size,
            "sub/deep/a.gcode",
        )
        assert bench.told == [
            ("create_dir", "sub", None),
            ("create_dir", "sub/deep", None),
            ("create_file", "sub/deep/a.gcode", None),
        ]
        await upload(bench.files, "sub/deep/a.gcode", data)
        assert bench.told == [("modify_file", "sub/deep/a.gcode", None)]

    run(main)
    assert (bench.root / "sub/deep/a.gcode").read_bytes() == data
    assert bench.names() == ["sub", "sub/deep", "sub/deep/a.gcode"]
    assert (bench.root / "sub/deep/a.gcode").stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize(
    ("name", "error"),
    [("../a.gcode", InvalidNameError), ("d", NotAcceptedError), ("f/a.gcode", NotAcceptedError)],
)
def test_an_upload_that_can_have_no_such_name(bench, name, error):
    bench.put("d/x.gcode")
    bench.put("f", b"file")
    before = bench.names()

    async def main():
        with pytest.raises(error):
            await upload(bench.files, name)

    run(main)
    assert (bench.names(), bench.told) == (before, [])


def test_an_upload_replaces_a_link_and_not_what_it_leads_to(bench, tmp_path):
    (tmp_path / "secret").write_bytes(b"secret")
    (bench.root / "a.gcode").symlink_to(tmp_path / "secret")
    asyncio.run(upload(bench.files, "a.gcode", b"new"))
    assert (tmp_path / "secret").read_bytes() == b"secret"
    assert not (bench.root / "a.gcode").is_symlink()


def test_an_upload_that_is_not_what_was_sent(bench):
    bench.put("a.gcode", b"old")

    async def main():
        for checksum in (sha(b"other"), "", "x"):
            with pytest.raises(ChecksumError):
                await upload(bench.files, "a.gcode", b"new", checksum=checksum)

    run(main)
    assert (bench.root / "a.gcode").read_bytes() == b"old"
    assert bench.names() == ["a.gcode"]


def test_an_upload_that_is_too_long(tmp_path):
    bench = Bench(tmp_path, max_bytes=1000)

    async def main():
        await upload(bench.files, "a.gcode", b"x" * 1000)
        with pytest.raises(FileTooLargeError, match="at most 1000 bytes"):
            await upload(bench.files, "b.gcode", b"x" * 1001)

    run(main)
    assert bench.names() == ["a.gcode"]


def test_too_many_uploads(tmp_path):
    bench = Bench(tmp_path, max_uploads=2)

    async def main():
        for _ in range(3):
            async with bench.files.upload(), bench.files.upload():
                with pytest.raises(NotAcceptedError, match="too many uploads"):
                    await upload(bench.files, "c.gcode")
        await upload(bench.files, "c.gcode")

    run(main)
    assert bench.names() == ["c.gcode"]


@given(st.integers(0, 400), st.sampled_from(["cancel", "raise"]))
@settings(max_examples=40, deadline=None)
def test_an_upload_that_is_interrupted_leaves_all_or_nothing(tmp_path_factory, turns, how):
    bench = Bench(tmp_path_factory.mktemp("interrupted"))
    bench.put("a.gcode", b"old")
    data = b"new" * 700_000

    async def main():
        async def uploading():
            async with bench.files.upload() as arriving:
                for n in range(20):
                    if how == "raise" and n == turns % 25:
                        raise ConnectionError
                    await arriving.write(data[n * 105_000 : (n + 1) * 105_000])
                await arriving.commit("a.gcode")

        task = asyncio.create_task(uploading())
        for _ in range(turns):
            await asyncio.sleep(0)
        if how == "cancel":
            task.cancel()
        with contextlib.suppress(asyncio.CancelledError, ConnectionError):
            await task
        # Behind whatever still goes on.
        await bench.files.make_directory("later")
        await upload(bench.files, "b.gcode")

    run(main)
    assert (bench.root / "a.gcode").read_bytes() in (b"old", data)
    assert bench.names() == ["a.gcode", "b.gcode", "later"]


def test_an_upload_that_was_given_up_takes_no_more(bench):
    async def main():
        async with bench.files.upload() as arriving:
            await arriving.write(b"x" * BLOCK)
        with pytest.raises(StorageError, match="given up"):
            await arriving.write(b"x" * BLOCK)
        with pytest.raises(StorageError, match="given up"):
            await arriving.commit("a.gcode")

    run(main)
    assert bench.names() == []


def test_uploads_of_one_name_at_the_same_time(bench):
    contents = [bytes([65 + n]) * (BLOCK + n * 1000) for n in range(6)]

    async def main():
        changes = await asyncio.gather(*(upload(bench.files, "sub/a.gcode", data) for data in contents))
        assert sorted(change.action for change in changes) == ["create_file"] + ["modify_file"] * 5
        told = bench.told
        assert told[:2] == [("create_dir", "sub", None), ("create_file", "sub/a.gcode", None)]
        last = (bench.root / "sub/a.gcode").read_bytes()
        assert last in contents
        assert (await bench.files.pin("sub/a.gcode")).sha256 == sha(last)

    run(main)
    assert bench.names() == ["sub", "sub/a.gcode"]


KILLED = """
import asyncio, sys
from pathlib import Path
from toolpost.store.files import Files

async def main():
    files = Files(Path(sys.argv[1]), Path(sys.argv[2]), keep_free=0)
    for n in range(10**6):
        async with files.upload() as arriving:
            for _ in range(6):
                await arriving.write(b"%09d\\n" % n * 50_000)
            await arriving.commit("a.gcode")
        pinned = await files.pin("a.gcode")
        print(n, pinned.sha256, flush=True)

asyncio.run(main())
"""


@pytest.mark.parametrize("after", [0.0, 0.037, 0.111])
def test_kill_9_leaves_whole_files_only(tmp_path, after):
    root, raw = tmp_path / "gcodes", tmp_path / "raw"
    process = subprocess.Popen([sys.executable, "-c", KILLED, root, raw], stdout=subprocess.PIPE, text=True)
    lines = [process.stdout.readline()]
    time.sleep(after)
    process.send_signal(signal.SIGKILL)
    lines += process.stdout.read().splitlines()
    process.stdout.close()
    process.wait()
    for path in [*root.rglob("*"), *raw.iterdir()]:
        assert path.is_dir() or path.suffix == ".part" or len(path.read_bytes()) == 3_000_000
    bench = Bench(tmp_path)
    assert bench.names() == ["a.gcode"]
    # What was told before the kill is there, whole.
    content = (root / "a.gcode").read_bytes()
    assert len(set(content.split())) == 1
    told = [line.split() for line in lines if len(line.split()) == 2 and len(line.split()[1]) == 64]
    assert int(content[:9]) >= int(told[-1][0])
    for _, sha256 in told:
        pinned = asyncio.run(bench.files.pinned(sha256))
        assert sha(Path(pinned.path).read_bytes()) == sha256
    assert all(name.endswith(".gcode") for name in bench.pinned())


def test_what_a_crash_left_over_is_removed(tmp_path):
    bench = Bench(tmp_path)
    bench.put("a.gcode")
    (bench.root / PARTS / "0123.part").write_bytes(b"half")
    (bench.root / PARTS / "4567.part/sub").mkdir(parents=True)
    (bench.raw / "89ab.part").write_bytes(b"half")
    bench = Bench(tmp_path)
    assert (bench.names(), bench.pinned()) == (["a.gcode"], [])


# A disk that is full or fails


@contextmanager
def small_disk(size):
    """The kernel itself refuses to let a file grow beyond this."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk_leaves_nothing(bench):
    bench.put("a.gcode", b"x" * 3_000_000)
    bench.put("sub/b.gcode", b"x" * 3_000_000)

    async def main():
        for call in (
            lambda: upload(bench.files, "new.gcode", b"x" * 3_000_000),
            lambda: bench.files.copy("a.gcode", "copy.gcode"),
            lambda: bench.files.copy("sub", "copy"),
            lambda: bench.files.pin("a.gcode"),
        ):
            with small_disk(2_000_000), pytest.raises(StorageError):
                await call()
            assert bench.names() == ["a.gcode", "sub", "sub/b.gcode"]
            assert bench.pinned() == []
            await call()
            assert len(bench.pinned()) <= 1
            for name in ("new.gcode", "copy.gcode"):
                (bench.root / name).unlink(missing_ok=True)
            if (bench.root / "copy").exists():
                await bench.files.delete_directory("copy", force=True)

    run(main)


@pytest.mark.parametrize("call", ["write", "fsync", "rename", "fdatasync", "fchmod", "copy_file_range"])
def test_a_disk_that_fails_leaves_nothing(bench, monkeypatch, call):
    monkeypatch.setattr(content_module, "_SYNC_EVERY", 100_000)
    bench.put("a.gcode", b"x" * 3_000_000)

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    async def main():
        for act in (
            lambda: upload(bench.files, "new.gcode", b"x" * 3_000_000),
            lambda: bench.files.copy("a.gcode", "copy.gcode"),
            lambda: bench.files.pin("a.gcode"),
        ):
            with monkeypatch.context() as patch:
                patch.setattr(os, call, full)
                failed = False
                try:
                    await act()
                except StorageError as error:
                    failed = True
                    assert "No space left on device" in str(error)  # noqa: PT017
            left = {"new.gcode", "copy.gcode"} & set(bench.names())
            assert not (failed and left) or call == "fsync"
            for name in left:
                (bench.root / name).unlink()
            assert not failed or bench.pinned() == []

    run(main)


def test_room_is_kept_for_the_database(tmp_path):
    free = os.statvfs(tmp_path)
    bench = Bench(tmp_path, keep_free=free.f_bavail * free.f_frsize + 10**9)
    bench.put("a.gcode")

    async def main():
        for call in (
            lambda: upload(bench.files, "b.gcode"),
            lambda: bench.files.copy("a.gcode", "b.gcode"),
            lambda: bench.files.pin("a.gcode"),
        ):
            for _ in range(10):
                with pytest.raises(StorageError, match="No space left"):
                    await call()

    run(main)
    assert (bench.names(), bench.pinned(), bench.told) == (["a.gcode"], [], [])


def test_what_is_told_is_on_disk(bench, monkeypatch):
    steps = []
    for call in ("fsync", "rename"):
        real = getattr(os, call)
        monkeypatch.setattr(
            os, call, lambda *a, real=real, call=call, **k: (steps.append(call), real(*a, **k))[1]
        )
    bench.files._on_change = lambda change: steps.append(change.action.value)

    async def main():
        await upload(bench.files, "a.gcode")
        assert steps == ["fsync", "rename", "fsync", "create_file"]
        steps.clear()
        await bench.files.move("a.gcode", "b.gcode")
        assert steps == ["rename", "fsync", "fsync", "move_file"]
        steps.clear()
        await bench.files.delete("b.gcode")
        assert steps == ["fsync", "delete_file"]

    run(main)


# Content for jobs


def content(pinned):
    data = Path(pinned.path).read_bytes()
    assert (sha(data), len(data)) == (pinned.sha256, pinned.size)
    return data


def test_pinned_content_stays_whatever_happens_to_the_name(bench):
    async def main():
        await upload(bench.files, "sub/a.gcode", b"first")
        first = await bench.files.pin("sub/a.gcode")
        assert first.path.endswith(f"{sha(b'first')}.gcode")
        assert Path(first.path).is_absolute()
        with Path(first.path).open("rb") as running:
            await upload(bench.files, "sub/a.gcode", b"second")
            second = await bench.files.pin("sub/a.gcode")
            (bench.root / "sub/a.gcode").write_bytes(b"in place")
            third = await bench.files.pin("sub/a.gcode")
            with (bench.root / "sub/a.gcode").open("ab") as file:
                file.write(b" and more")
            fourth = await bench.files.pin("sub/a.gcode")
            await bench.files.move("sub/a.gcode", "b.gcode")
            await bench.files.delete_directory("sub", force=True)
            await bench.files.delete("b.gcode")
            contents = [content(pinned) for pinned in (first, second, third, fourth)]
            assert contents == [b"first", b"second", b"in place", b"in place and more"]
            assert running.read() == b"first"
        assert await bench.files.pinned(first.sha256) == first
        assert oct(Path(first.path).stat().st_mode)[-3:] == "444"

    run(main)
    assert len(bench.pinned()) == 4


def test_pins_are_there_after_a_restart(tmp_path):
    bench = Bench(tmp_path)
    bench.put("a.gcode", b"content")
    pinned = asyncio.run(bench.files.pin("a.gcode"))
    bench = Bench(tmp_path)
    assert asyncio.run(bench.files.pinned(pinned.sha256)) == pinned
    assert asyncio.run(bench.files.pin("a.gcode")) == pinned
    assert content(pinned) == b"content"


@pytest.mark.parametrize("sha256", ["0" * 64, "../../gcodes/a", "", "x" * 300, "\0"])
def test_content_that_is_not_there(bench, sha256):
    with pytest.raises(StorageError):
        asyncio.run(bench.files.pinned(sha256))


class Counted:
    """Counts what reads whole files, and in which threads."""

    def __init__(self, monkeypatch):
        self.hashed = self.copied = 0
        self.threads = set()
        real_hash, real_copy = pins_module.hash_content, content_module.ContentWriter.copy

        def hash_content(fd):
            self.hashed += 1
            self.threads.add(threading.current_thread())
            return real_hash(fd)

        def copy(writer, source):
            self.copied += 1
            self.threads.add(threading.current_thread())
            return real_copy(writer, source)

        monkeypatch.setattr(pins_module, "hash_content", hash_content)
        monkeypatch.setattr(content_module, "hash_content", hash_content)
        monkeypatch.setattr(content_module.ContentWriter, "copy", copy)

    @property
    def both(self):
        both, self.hashed, self.copied = (self.hashed, self.copied), 0, 0
        return both


def settle(path):
    """As if it had not been touched for a while."""
    os.utime(path, (1000, 1000))
    time.sleep(content_module._SETTLED + 0.02)


def test_a_file_is_read_once(tmp_path, monkeypatch):
    bench, counted = Bench(tmp_path), Counted(monkeypatch)

    async def main():
        path = bench.put("a.gcode", b"content")
        settle(path)
        first = await bench.files.pin("a.gcode")
        assert counted.both == (1, 1)
        for _ in range(3):
            assert await bench.files.pin("a.gcode") == first
        assert counted.both == (0, 0)
        # The clocks of files are coarse: one that has just been changed is read again.
        bench.put("just.gcode", b"CONTENT")
        for _ in range(2):
            await bench.files.pin("just.gcode")
            assert counted.both > (0, 0)
        # Of the same size, and its times put back.
        path.write_bytes(b"CONTENT")
        settle(path)
        assert content(await bench.files.pin("a.gcode")) == b"CONTENT"
        counted.both  # noqa: B018
        # The same content under another name is not written again.
        settle(bench.put("b.gcode", b"CONTENT"))
        await bench.files.pin("b.gcode")
        assert counted.both == (1, 0)
        # What was uploaded is known already.
        await upload(bench.files, "b.gcode", b"content")
        assert await bench.files.pin("b.gcode") == first
        assert counted.both == (0, 0)
        assert threading.main_thread() not in counted.threads

    run(main)


def test_a_change_right_after_the_pin_is_seen(bench):
    async def main():
        path = bench.put("a.gcode", b"0000")
        for n in range(1, 60):
            with path.open("r+b") as file:
                file.write(b"%04d" % n)
            assert content(await bench.files.pin("a.gcode")) == b"%04d" % n

    run(main)


def test_a_file_that_is_being_written_is_not_taken(bench, monkeypatch):
    path = bench.put("a.gcode", b"x" * 1000)
    real = content_module.ContentWriter.copy

    def copy(writer, source):
        real(writer, source)
        with path.open("ab") as file:
            file.write(b"more")

    async def main():
        with monkeypatch.context() as patch:
            patch.setattr(content_module.ContentWriter, "copy", copy)
            with pytest.raises(NotAcceptedError, match=r"a\.gcode.*being written"):
                await bench.files.pin("a.gcode")
        assert bench.pinned() == []
        assert len(content(await bench.files.pin("a.gcode"))) == 1012

    run(main)


def test_a_disk_without_copies_in_the_kernel(bench, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr(os, "copy_file_range", refuse)
    data = random.Random(1).randbytes(2 * BLOCK + 5)
    bench.put("a.gcode", data)
    assert content(asyncio.run(bench.files.pin("a.gcode"))) == data


def test_many_files_at_once(bench):
    for n in range(30):
        bench.put(f"{n % 3}/{n}.gcode", b"%d" % (n % 10))
    wanted = [f"{n % 3}/{n}.gcode" for n in range(30)] * 2

    async def main():
        pinned = await bench.files.pin_all(wanted)
        assert [content(one) for one in pinned] == [b"%d" % (n % 10) for n in range(30)] * 2
        assert len(bench.pinned()) == 10
        assert await bench.files.pin_all([]) == []
        for name, error in (
            ("0/gone.gcode", FileMissingError),
            ("gone/0.gcode", FileMissingError),
            ("0/note.txt", InvalidNameError),
            ("../a.gcode", InvalidNameError),
        ):
            with pytest.raises(error) as raised:
                await bench.files.pin_all([*wanted, name])
            assert name in str(raised.value)
        assert len(bench.pinned()) == 10

    run(main)


def test_pins_of_one_file_at_the_same_time(bench):
    bench.put("a.gcode", b"x" * 3_000_000)

    async def main():
        pinned = await asyncio.gather(*(bench.files.pin("a.gcode") for _ in range(8)))
        assert len(set(pinned)) == 1

    run(main)
    assert len(bench.pinned()) == 1


def test_trim_deletes_the_oldest_that_no_job_needs(tmp_path):
    bench = Bench(tmp_path)

    async def main():
        pinned = []
        for n in range(10):
            bench.put(f"{n}.gcode", b"%d" % n * 100)
            pinned.append(await bench.files.pin(f"{n}.gcode"))
            await asyncio.sleep(0.005)
        keep = {pinned[0].sha256, pinned[2].sha256}
        await bench.files.trim(keep, 1000)
        assert len(bench.pinned()) == 10, "no more than allowed"
        again = Bench(tmp_path)
        await again.files.trim(keep, 600)
        left = {pinned[n].sha256 for n in (0, 2, 7, 8, 9)}
        assert {name.removesuffix(".gcode") for name in again.pinned()} == left
        await again.files.trim(left, 1)
        assert len(again.pinned()) == 5
        # What was trimmed is pinned anew.
        assert content(await again.files.pin("3.gcode")) == b"3" * 100
        assert content(await bench.files.pin("4.gcode")) == b"4" * 100

    run(main)


# What slicers wrote

PICTURE = "iVBORw0KGgoAAAANSUhEUg=="


def test_metadata_and_thumbnails(bench):
    text = "; generated by PrusaSlicer 2.7.0 on x\n; thumbnail begin 16x12 24\n; {}\n; thumbnail end\nG1 X1\n"
    bench.put("a.gcode", text.format(PICTURE).encode())

    async def main():
        found = await bench.files.metadata("a.gcode")
        assert found.slicer == "PrusaSlicer"
        assert await bench.files.metadata("a.gcode") is found
        picture, kind = await bench.files.thumbnail("a.gcode", 16, 12)
        assert (picture[:4], kind) == (b"\x89PNG", "png")
        with pytest.raises(FileMissingError):
            await bench.files.thumbnail("a.gcode", 16, 13)
        await upload(bench.files, "a.gcode", b"G28\n")
        assert (await bench.files.metadata("a.gcode")).slicer is None
        with pytest.raises(FileMissingError):
            await bench.files.thumbnail("a.gcode", 16, 12)

    run(main)


def test_little_metadata_is_kept(bench, monkeypatch):
    monkeypatch.setattr(module, "_MAX_METADATA", 5)
    for n in range(12):
        bench.put(f"{n}.gcode")

    async def main():
        for n in range(12):
            await bench.files.metadata(f"{n}.gcode")

    run(main)
    assert len(bench.files._metadata) <= 5
