import asyncio
import os
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest

from tests.links.test_stream import Listener
from toolpost.errors import LinkError
from toolpost.links.serial import serial_opener

LOCK = """
import fcntl, os, sys
fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
fcntl.flock(fd, fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def pty():
    """The far end of a pty, and the path of the near one."""
    far, near = os.openpty()
    path = os.ttyname(near)
    os.set_blocking(far, False)
    yield far, path
    os.close(near)
    os.close(far)


def open_link(path, listener=None, baud=115200):
    return serial_opener(path, baud)(listener or Listener())


async def soon(condition):
    async with asyncio.timeout(5):
        while not condition():
            await asyncio.sleep(0.002)


def refused(path):
    async def main():
        with pytest.raises(LinkError) as caught:
            await open_link(path)
        return str(caught.value)

    return asyncio.run(main())


def descriptors():
    return len(list(Path("/proc/self/fd").iterdir()))


def test_bytes_go_both_ways_unchanged(pty):
    far, path = pty
    every = bytes(range(256)) * 4

    async def main():
        heard = Listener()
        link = await open_link(path, heard)
        os.write(far, every)
        await soon(lambda: len(heard.data) >= len(every))
        assert heard.data == every
        link.write(b"G1 X1\n?queue\n")
        await asyncio.sleep(0.01)
        assert os.read(far, 100) == b"G1 X1\n?queue\n"
        link.close()
        assert heard.reasons == []

    asyncio.run(main())


def test_raw_without_flow_control(pty):
    far, path = pty

    async def main():
        link = await open_link(path)
        iflag, oflag, cflag, lflag, _, speed, _ = termios.tcgetattr(far)
        link.close()
        assert not iflag & (termios.IXON | termios.IXOFF | termios.ICRNL | termios.INLCR | termios.ISTRIP)
        assert not oflag & termios.OPOST
        assert not lflag & (termios.ECHO | termios.ICANON | termios.ISIG)
        assert not cflag & termios.CRTSCTS
        assert cflag & termios.CLOCAL
        assert speed == termios.B115200

    asyncio.run(main())


def test_a_second_open_is_refused_and_leaks_nothing(pty):
    far, path = pty

    async def main():
        heard = Listener()
        link = await open_link(path, heard)
        before = descriptors()
        for _ in range(3):
            with pytest.raises(LinkError) as caught:
                await open_link(path)
            assert path in str(caught.value)
            assert "lock" in str(caught.value) or "uses this device" in str(caught.value)
        assert descriptors() == before
        os.write(far, b"still here\n")
        await soon(lambda: heard.data)
        assert heard.data == b"still here\n"
        link.close()
        (await open_link(path)).close()

    asyncio.run(main())


def test_a_device_locked_by_another_program_is_refused(pty):
    _, path = pty
    holder = subprocess.Popen(
        [sys.executable, "-c", LOCK, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with holder:
        assert holder.stdout.readline() == b"held\n"
        message = refused(path)
        holder.stdin.close()
    assert path in message
    assert "another p" in message
    asyncio.run(open_and_close(path))


async def open_and_close(path):
    (await open_link(path)).close()


def test_a_missing_device(tmp_path):
    before = descriptors()
    assert refused(tmp_path / "ttyUSB9") == f"{tmp_path / 'ttyUSB9'}: no such device"
    assert descriptors() == before


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_is_no_serial_device(tmp_path, kind):
    path = tmp_path / "thing"
    if kind == "file":
        path.write_text("hello")
    else:
        path.mkdir()
    before = descriptors()
    message = refused(path)
    assert message.startswith(f"{path}: ")
    assert len(message) > len(f"{path}: ") + 5
    assert descriptors() == before


def test_an_odd_baud_rate_is_no_crash(pty):
    _, path = pty

    async def main():
        for baud in (250_000, 1_234_567):
            try:
                link = await open_link(path, baud=baud)
            except LinkError as error:
                assert path in str(error)  # noqa: PT017  # either is right, nothing else is
            else:
                link.close()

    asyncio.run(main())


def test_the_far_end_going_is_a_loss_said_once():
    far, near = os.openpty()
    path = os.ttyname(near)

    async def main():
        heard = Listener()
        link = await open_link(path, heard)
        os.close(near)
        os.close(far)
        await soon(lambda: heard.reasons)
        await asyncio.sleep(0.01)
        assert len(heard.reasons) == 1
        link.write(b"G1\n")
        link.close()
        assert len(heard.reasons) == 1

    asyncio.run(main())


def test_close_does_not_wait_for_a_device_that_takes_nothing(pty):
    _, path = pty

    async def main():
        link = await open_link(path)
        while not link.unwritten:
            link.write(b"G1 X1\n" * 1000)
        start = time.monotonic()
        link.close()
        assert time.monotonic() - start < 2

    asyncio.run(main())
