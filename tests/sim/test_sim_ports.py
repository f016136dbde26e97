"""Cores on real descriptors. Times are real here, so every bound is generous."""

import asyncio
import contextlib
import errno
import os
import re
import socket
import time
import tty

import pytest

from toolpost.errors import StartError
from toolpost.sim.faults import Fault
from toolpost.sim.options import SparkOptions
from toolpost.sim.ports import PtyPort, SimulatedSpark
from toolpost.sim.stream import OUTPUT_LIMIT

INSTANT = SparkOptions(command_time=0)
BOOT = b'sys < ev:"boot" >\r\n'


async def until(condition, seconds=5.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        await asyncio.sleep(0.002)


def read(fd):
    with contextlib.suppress(BlockingIOError):
        return os.read(fd, 65536)
    return b""


async def answer(fd, end=b"\n"):
    """Read until ``end``."""
    got = bytearray()

    def complete():
        got.extend(read(fd))
        return got.endswith(end)

    await until(complete)
    return bytes(got)


@contextlib.contextmanager
def host(path):
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield fd
    finally:
        os.close(fd)


@contextlib.asynccontextmanager
async def pty_port(options=INSTANT, **kwargs):
    port = PtyPort(asyncio.get_running_loop(), options, **kwargs)
    port.start()
    try:
        yield port
    finally:
        port.close()


def test_a_host_on_the_pty(tmp_path):
    async def scenario():
        link = tmp_path / "spark"
        async with pty_port(link=link) as port:
            assert port.path == str(link)
            with host(link) as fd:
                os.write(fd, b"G1 X1\nG1 X2\n?queue\n")
                assert await answer(fd) == b"queue < cap:64 num:0 >\r\n"
            assert port.core.executed == 2
            device = str(link.readlink())
        assert not link.is_symlink()
        assert port.path == ""
        assert device.startswith("/dev/pts/")

    asyncio.run(scenario())


def test_the_pty_survives_its_host(tmp_path):
    async def scenario():
        async with pty_port(link=tmp_path / "spark") as port:
            for turn in range(3):
                with host(port.path) as fd:
                    os.write(fd, b"G1 X1\n?queue\n")
                    assert await answer(fd) == b"queue < cap:64 num:0 >\r\n"
                    assert port.core.executed == turn + 1
                await until(lambda: port._stream is None)
                port.core.inject(Fault.parse("error:nobody listens"))

    asyncio.run(scenario())


def test_a_pty_without_a_host_costs_nothing():
    async def scenario():
        async with pty_port() as port:
            with host(port.path):
                await asyncio.sleep(0.05)
            before = time.process_time()
            await asyncio.sleep(0.5)
            assert time.process_time() - before < 0.1

    asyncio.run(scenario())


def test_the_link_never_replaces_a_file(tmp_path):
    async def scenario():
        link = tmp_path / "spark"
        link.write_text("mine")
        port = PtyPort(asyncio.get_running_loop(), INSTANT, link=link)
        with pytest.raises(StartError, match="spark"):
            port.start()
        port.close()
        assert link.read_text() == "mine"

        link.unlink()
        link.symlink_to(tmp_path / "elsewhere")
        with pytest.raises(StartError):
            PtyPort(asyncio.get_running_loop(), INSTANT, link=link).start()
        assert link.readlink() == tmp_path / "elsewhere"

        link.unlink()
        link.symlink_to("/dev/pts/99999")
        async with pty_port(link=link) as port, asyncio.timeout(5):
            with host(link) as fd:
                os.write(fd, b"?queue\n")
                assert await answer(fd)
            other = tmp_path / "other"
            other.symlink_to("/dev/pts/99998")
            other.replace(link)
        assert str(link.readlink()) == "/dev/pts/99998"  # no longer ours to remove

    asyncio.run(scenario())


def test_unplugged_pty(tmp_path):
    async def scenario():
        link = tmp_path / "spark"
        async with pty_port(SparkOptions(command_time=0.01), link=link) as port:
            with host(link) as fd:
                os.write(fd, b"G1 X1\nG1 X2\n?queue\n")
                await answer(fd)
                port.core.inject(Fault.parse("unplug:0.1"))
                assert not link.is_symlink()
                assert port.path == ""
                with contextlib.suppress(OSError):  # EIO or the end, as the kernel likes
                    assert os.read(fd, 10) == b""
            await until(link.is_symlink)
            assert port.core.executed == 2
            with host(link) as fd:
                os.write(fd, b"?queue\n")
                assert await answer(fd) == b"queue < cap:64 num:0 >\r\n"

    asyncio.run(scenario())


def test_a_replug_waits_while_its_path_is_taken(tmp_path):
    async def scenario():
        link = tmp_path / "spark"
        async with pty_port(link=link) as port:
            port.core.inject(Fault.parse("unplug:0.02"))
            link.write_text("mine")
            await asyncio.sleep(0.1)
            assert link.read_text() == "mine"
            assert port.path == ""
            link.unlink()
            await until(link.is_symlink)

    asyncio.run(scenario())


def test_pacing_down():
    async def scenario():
        line = b"G1 X1.000 Y2.000 Z-0.5\n"
        async with pty_port(baud=115_200) as port:
            with host(port.path) as fd:
                tty.setraw(fd)
                await asyncio.sleep(0.05)
                sent, began = 0, time.monotonic()
                while time.monotonic() - began < 0.6:
                    with contextlib.suppress(BlockingIOError):
                        sent += os.write(fd, line * 20)
                    await asyncio.sleep(0.002)
                got, took = port.core.executed * len(line), time.monotonic() - began
            assert got <= 11_520 * took * 1.02 + 100
            assert got >= 11_520 * took * 0.6
            assert sent > got

    asyncio.run(scenario())


def test_pacing_up():
    async def scenario():
        async with pty_port(baud=115_200) as port:
            with host(port.path) as fd:
                os.write(fd, b"stat\n" * 6)
                await until(lambda: read(fd))
                got, began = 0, time.monotonic()
                while time.monotonic() - began < 0.5:
                    got += len(read(fd))
                    await asyncio.sleep(0.002)
                took = time.monotonic() - began
            assert 11_520 * took * 0.6 <= got <= 11_520 * took * 1.02 + 100

    asyncio.run(scenario())


def test_a_paced_answer_takes_its_time_on_the_wire():
    async def scenario():
        async with pty_port(baud=2400) as port:
            with host(port.path) as fd:
                await asyncio.sleep(0.05)
                began = time.monotonic()
                os.write(fd, b"?queue\n")
                await answer(fd)
                assert 31 / 240 * 0.95 <= time.monotonic() - began < 1

    asyncio.run(scenario())


def test_in_process():
    async def scenario():
        spark = SimulatedSpark(asyncio.get_running_loop(), INSTANT)
        with spark.connect() as sock:
            assert not sock.getblocking()
            assert await answer(sock.fileno()) == BOOT
            sock.send(b"G1 X4\n?pos\n")
            assert b"m.x:4.000" in await answer(sock.fileno())
        await until(lambda: spark._stream is None)
        with spark.connect() as sock:
            sock.send(b"?pos\n")
            assert b"m.x:4.000" in await answer(sock.fileno())  # the machine lives on
            with spark.connect() as second:
                assert sock.recv(10) == b""
                second.send(b"?queue\n")
                assert await answer(second.fileno())
        spark.close()
        assert spark.core.boots == 1

    asyncio.run(scenario())


def test_in_process_unplug():
    async def scenario():
        spark = SimulatedSpark(asyncio.get_running_loop(), INSTANT, faults=[Fault.parse("unplug:0.1@3")])
        with spark.connect() as sock:
            sock.send(b"G1 X1\n" * 5)
            assert await answer(sock.fileno()) == BOOT
            await until(lambda: spark._stream is None)
            assert sock.recv(10) == b""
            with pytest.raises(OSError, match="unplugged") as caught:
                spark.connect()
            assert caught.value.errno == errno.ENODEV
        await asyncio.sleep(0.12)
        with spark.connect() as sock:
            sock.send(b"?queue\n")
            assert await answer(sock.fileno()) == b"queue < cap:64 num:0 >\r\n"
        spark.close()

    asyncio.run(scenario())


def test_a_host_that_does_not_read_loses_the_oldest_answers():
    async def scenario():
        spark = SimulatedSpark(asyncio.get_running_loop(), INSTANT)
        with spark.connect() as sock:
            for _ in range(100):
                sock.send(b"stat\n" * 10)
                await asyncio.sleep(0)
            await until(lambda: spark.core.executed == 1000)
            assert spark.dropped > 0
            assert spark._stream._size <= OUTPUT_LIMIT
            got = bytearray()

            def drained():
                got.extend(read(sock.fileno()))
                return not spark._stream._size and not spark._stream._piece

            await until(drained)
            got.extend(read(sock.fileno()))
            sock.send(b"?queue\n")
            assert await answer(sock.fileno()) == b"queue < cap:64 num:0 >\r\n"
            text = got.decode()
            assert text.startswith(BOOT.decode())
            whole = re.findall(r"stat <[^<>]*>\r\n", text)
            assert len(whole) == 1000 - spark.dropped
        spark.close()

    asyncio.run(scenario())


def test_a_host_that_resets_its_socket_is_no_error():
    async def scenario():
        spark = SimulatedSpark(asyncio.get_running_loop(), SparkOptions(command_time=0.005))
        sock = spark.connect()
        sock.send(b"G1 X1\nstat\n")
        sock.close()
        await until(lambda: spark.core.executed == 2)
        spark.core.inject(Fault.parse("error:nobody"))
        assert spark._stream is None
        spark.close()
        assert isinstance(sock, socket.socket)

    asyncio.run(scenario())
