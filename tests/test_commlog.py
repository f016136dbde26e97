"""The comm log: complete, bounded, greppable, and no reason to stop a machine (`toolpost.commlog`)."""

import asyncio
import contextlib
import errno
import logging
import os
import re
import time
from pathlib import Path

import pytest

from tests.harness import Port, Server, spark_config, wait_until
from toolpost import commlog
from toolpost.commlog import CommLog, CommLogLimits
from toolpost.sim.options import SparkOptions

LINE = re.compile(rb"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3}\+00:00 (up|down|note) [\x20-\x7e]*")


@contextlib.contextmanager
def opened(directory, **limits):
    """A log inside a running loop; closed and so written at the end."""

    async def run(use):
        log = CommLog(directory, "edm", CommLogLimits(**limits))
        try:
            await use(log)
        finally:
            log.close()

    yield lambda use: asyncio.run(run(use))


def written(directory, **limits):
    """Runs a function of a log and returns all lines of its files."""

    def run(use):
        with opened(directory, **limits) as start:
            start(use)
        return lines_of(directory)

    return run


def files_of(directory):
    return sorted(directory.glob("*.log"))


def lines_of(directory):
    data = b"".join(path.read_bytes() for path in files_of(directory))
    assert data.endswith(b"\n")
    return data.splitlines()


def test_every_line_has_time_direction_and_payload(tmp_path):
    async def use(log):
        log.note("link open")
        log.down(b"?queue\nG0 X1\n")
        log.up([b"queue < cap:64 num:1 >", b"pos < x:1 >"])

    before = time.time()
    lines = written(tmp_path)(use)
    assert all(LINE.fullmatch(line) for line in lines)
    assert [line.split(b" ", 2)[2] for line in lines] == [
        b"note link open",
        b"down ?queue",
        b"down G0 X1",
        b"up queue < cap:64 num:1 >",
        b"up pos < x:1 >",
    ]
    for line in lines:
        stamp = time.strptime(line[:19].decode(), "%Y-%m-%d %H:%M:%S")
        seconds = time.mktime(stamp) - time.timezone + int(line[20:23]) / 1000
        assert before - 0.001 <= seconds <= time.time()


@pytest.mark.parametrize(
    ("payload", "escaped"),
    [
        (b"\x1b[2J", rb"\x1b[2J"),
        (b"a\x00b", rb"a\x00b"),
        (b"\xff\xfe", rb"\xff\xfe"),
        ("é".encode(), rb"\xc3\xa9"),
        (b"a\rb\tc\x7f", rb"a\rb\tc\x7f"),
        (b"", b""),
        (b'<b>"&', b'<b>"&'),
    ],
)
def test_bytes_from_the_machine_are_escaped(tmp_path, payload, escaped):
    async def use(log):
        log.up([b"before", payload, b"after"])
        log.note(payload.decode("latin-1") + "\n")

    lines = written(tmp_path)(use)
    assert all(LINE.fullmatch(line) for line in lines)
    assert [line.split(b" ", 3)[3] for line in lines] == [
        b"before",
        escaped,
        b"after",
        lines[-1].split(b" ", 3)[3],
    ]


def test_a_backslash_cannot_be_mistaken_for_an_escape(tmp_path):
    async def use(log):
        log.up([b"\\x1b", b"\x1b"])

    plain, escape = (line.split(b" ", 3)[3] for line in written(tmp_path)(use))
    assert plain != escape


def test_files_are_readable_by_owner_and_group_only(tmp_path):
    async def use(log):
        log.note("x")

    written(tmp_path)(use)
    assert files_of(tmp_path)[0].stat().st_mode & 0o007 == 0


def test_new_file_at_the_size(tmp_path):
    async def use(log):
        for _ in range(10):
            log.down(b"x" * 50 + b"\n")
            await asyncio.sleep(0.03)

    assert len(written(tmp_path, file_bytes=200)(use)) == 10
    files = files_of(tmp_path)
    assert len(files) > 2
    assert [re.fullmatch(r"edm-\d{4}-\d\d-\d\d-(\d{4})\.log", path.name)[1] for path in files] == [
        f"{number:04}" for number in range(1, len(files) + 1)
    ]
    assert all(path.stat().st_size < 500 for path in files)


def test_all_files_together_are_bounded_and_the_oldest_go(tmp_path):
    async def use(log):
        for number in range(60):
            log.note(f"number {number} " + "x" * 60)
            await asyncio.sleep(0.022)

    lines = written(tmp_path, file_bytes=300, total_bytes=1500)(use)
    assert sum(path.stat().st_size for path in files_of(tmp_path)) <= 1500
    numbers = [int(line.split()[4]) for line in lines]
    assert numbers == list(range(numbers[0], 60)), "the newest are there, without a gap"
    assert numbers[0] > 0


def test_a_burst_does_not_go_far_beyond_the_size(tmp_path):
    async def use(log):
        for _ in range(1000):
            log.down(b"x" * 90 + b"\n")

    assert len(written(tmp_path, file_bytes=1000)(use)) == 1000


def test_old_files_and_only_those_of_this_machine_are_deleted(tmp_path):
    names = ["edm-2020-01-01-0001.log", "edm2-2020-01-01-0001.log", "other.log", "edm-2020-01-02-0001.log"]
    for name in names:
        (tmp_path / name).write_text("old\n")
        os.utime(tmp_path / name, (1e9, 1e9))
    os.utime(tmp_path / names[3])

    async def use(log):
        log.note("new")

    written(tmp_path, max_age_days=1)(use)
    left = {path.name for path in tmp_path.iterdir()}
    assert names[0] not in left
    assert left >= set(names[1:])


def test_a_machine_whose_name_begins_like_another_keeps_its_files(tmp_path):
    """The files of ``edm-2`` are no files of ``edm``."""
    other = tmp_path / "edm-2-2020-01-01-0001.log"
    other.write_text("x\n" * 1000)
    os.utime(other, (1e9, 1e9))

    async def use(log):
        log.note("new")

    written(tmp_path, max_age_days=1, total_bytes=10)(use)
    assert other.exists()


def test_new_file_on_a_new_day(tmp_path, monkeypatch):
    day = iter(["2026-01-01"] * 2 + ["2026-01-02"] * 50)

    class Clock:
        def __getattr__(self, name):
            return getattr(time, name)

        def strftime(self, form, *arguments):
            return next(day) if form == "%Y-%m-%d" else time.strftime(form, *arguments)

    monkeypatch.setattr(commlog, "time", Clock())

    async def use(log):
        for _ in range(4):
            log.note("x")
            await asyncio.sleep(0.04)

    written(tmp_path)(use)
    assert [path.name for path in files_of(tmp_path)] == [
        "edm-2026-01-01-0001.log",
        "edm-2026-01-02-0001.log",
    ]


def test_next_start_goes_on_in_the_same_file(tmp_path):
    async def use(log):
        log.note("x")

    written(tmp_path)(use)
    assert len(written(tmp_path)(use)) == 2
    assert len(files_of(tmp_path)) == 1


def test_line_torn_by_a_crash_gets_its_end(tmp_path):
    async def use(log):
        log.note("x")

    written(tmp_path)(use)
    with files_of(tmp_path)[0].open("ab") as file:
        file.write(b"2026-01-01 00:00:00.000+00:00 up queue < ca")
    lines = written(tmp_path)(use)
    assert [line.split(b" ", 2)[2] for line in lines] == [b"note x", b"up queue < ca", b"note x"]


class Disk:
    """``os.write`` to a disk that is full while `full`; counts the attempts that are over."""

    def __init__(self, monkeypatch):
        self.full = False
        self.attempts = 0
        self._write = os.write
        monkeypatch.setattr(commlog.os, "write", self.write)

    def write(self, fd, data):
        if Path(f"/proc/self/fd/{fd}").readlink().suffix != ".log":
            return self._write(fd, data)  # Some other thread of the process writes too.
        try:
            if self.full:
                raise OSError(errno.ENOSPC, "No space left on device")
            return self._write(fd, data)
        finally:
            self.attempts += 1


def test_full_disk_warns_once_and_recovers(tmp_path, monkeypatch, caplog):
    disk = Disk(monkeypatch)
    caplog.set_level(logging.WARNING)

    async def attempt(log, text):
        before = disk.attempts
        log.note(text)
        while disk.attempts == before:
            await asyncio.sleep(0.005)

    async def use(log):
        await attempt(log, "one")
        disk.full = True
        for _ in range(3):
            await attempt(log, "lost")
        disk.full = False
        await attempt(log, "two")

    lines = written(tmp_path)(use)
    assert [line.split()[-1] for line in lines] == [b"one", b"two"]
    messages = [record.getMessage() for record in caplog.records]
    assert messages == [
        "edm: the comm log cannot be written: No space left on device",
        "edm: the comm log is written again",
    ]


def test_partial_write_is_continued(tmp_path, monkeypatch):
    write = os.write
    monkeypatch.setattr(commlog.os, "write", lambda fd, data: write(fd, bytes(data[:7])))

    async def use(log):
        log.down(b"G0 X1\nG0 X2\n")

    assert [LINE.fullmatch(line) is not None for line in written(tmp_path)(use)] == [True, True]


def test_directory_that_vanishes_is_a_warning(tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    directory = tmp_path / "logs"

    async def use(log):
        directory.rmdir()
        log.note("lost")
        await asyncio.sleep(0.1)
        directory.mkdir()
        log.note("kept")

    assert [line.split()[-1] for line in written(directory)(use)] == [b"kept"]
    assert "cannot be written" in caplog.text


def test_slow_disk_drops_lines_and_says_how_many(tmp_path, monkeypatch):
    """The machine is never held up, and memory stays bounded."""
    import threading

    gate = threading.Event()
    write = os.write

    def slow(fd, data):
        gate.wait(5)
        return write(fd, data)

    monkeypatch.setattr(commlog.os, "write", slow)

    async def use(log):
        began = time.monotonic()
        for _ in range(1000):
            log.down(b"x" * 60 + b"\n")
        await asyncio.sleep(0.05)
        assert time.monotonic() - began < 1
        gate.set()
        await asyncio.sleep(0.1)
        log.note("after")

    lines = written(tmp_path, backlog_bytes=5000)(use)
    kept = sum(b" down " in line for line in lines)
    assert 50 <= kept < 70
    drops = [line for line in lines if b"were not logged" in line]
    assert len(drops) == 1
    assert int(drops[0].split()[3]) == 1000 - kept
    assert lines[-1].endswith(b"note after")


def test_lines_of_the_last_moment_are_on_disk_after_kill_9(tmp_path):
    """What was on the wire a moment before a crash is what one wants to read."""
    with Port(SparkOptions(command_time=0)) as port, Server(tmp_path, spark_config(port.path)) as server:
        wait_until(lambda: server.client.call("/status")["device_alive"])
        assert server.client.call("/write-line", line="G0 X42")["ok"]
        time.sleep(0.1)
        server.kill()
        assert ("down", "G0 X42") in server.comm_log()
        server.start()
        assert server.stop() == 0
        assert all(direction in {"up", "down", "note"} for direction, _ in server.comm_log())


def test_boot_messages_before_the_first_request_are_in_it(tmp_path):
    config = '[server]\nlisten = "127.0.0.1:0"\n[machines.edm]\ndriver = "spark"\nlink = "sim"\n'
    config += '[machines.edm.sim]\nboot_message = "init"\n'
    with Server(tmp_path, config) as server:
        wait_until(lambda: ("up", "queue < cap:64 num:0 >") in server.comm_log())
        assert server.stop() == 0
        lines = server.comm_log()
    assert lines[0] == ("note", "link open")
    assert any(direction == "up" and payload.startswith("init < ok:true") for direction, payload in lines[:5])
    assert any(direction == "down" and payload == "?queue" for direction, payload in lines[:5])


def test_unplugged_machine_is_noted(tmp_path):
    link = tmp_path / "port"
    with Port(link=link) as port, Server(tmp_path / "server", spark_config(str(link))) as server:
        wait_until(lambda: server.client.call("/status")["device_alive"])
        port.inject("unplug:0.3")
        wait_until(lambda: any("link lost" in text for kind, text in server.comm_log() if kind == "note"))
        wait_until(
            lambda: [text for kind, text in server.comm_log() if kind == "note"].count("link open") == 2
        )
