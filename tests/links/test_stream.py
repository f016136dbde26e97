import asyncio
import os
import socket

import pytest

from toolpost.links.net import socket_link
from toolpost.links.stream import StreamLink


class Listener:
    def __init__(self):
        self.data = b""
        self.reasons = []
        self.drains = 0

    def received(self, data):
        self.data += data

    def drained(self):
        self.drains += 1

    def lost(self, reason):
        self.reasons.append(reason)


class Pair:
    """A link over a socket pair whose buffers are as small as the kernel makes them."""

    def __init__(self):
        ours, self.far = socket.socketpair()
        for sock in (ours, self.far):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
        self.far.setblocking(False)
        self.heard = Listener()
        self.link = socket_link(ours, self.heard)
        self.got = b""

    def fill(self):
        """Write lines until the kernel takes no more; return them and how much of them it took."""
        sent = b""
        number = 0
        while not self.link.unwritten:
            # One write of many lines: the kernel takes what it has room for, in the middle of one of them.
            block = b"".join(b"G1 X%d Y%d\n" % (n, n * 7) for n in range(number, number + 900))
            number += 900
            self.link.write(block)
            sent += block
        return sent, len(sent) - self.link.unwritten

    async def read(self, *, until=None):
        """Read at the far end until nothing more comes, or until `until` bytes are there."""
        idle = 0
        while idle < 5:
            try:
                part = self.far.recv(4096)
                if not part:
                    return self.got
                self.got += part
                idle = 0
            except BlockingIOError:
                idle += 1
            if until is not None and len(self.got) >= until:
                return self.got
            await asyncio.sleep(0.001)
        return self.got

    def close(self):
        self.link.close()
        self.far.close()


def with_pair(main):
    async def running():
        pair = Pair()
        try:
            await main(pair)
        finally:
            pair.close()

    asyncio.run(running())


def begun(sent, taken):
    """The bytes up to the end of the line that had been begun when the kernel took no more."""
    if taken and sent[taken - 1] != 0x0A:
        return sent[: sent.index(b"\n", taken) + 1]
    return sent[:taken]


def test_bytes_go_both_ways():
    async def main(pair):
        pair.link.write(b"G1\n")
        assert pair.link.unwritten == 0
        pair.far.send(b"queue <")
        assert await pair.read() == b"G1\n"
        assert pair.heard.data == b"queue <"
        assert (pair.heard.drains, pair.heard.reasons) == (0, [])

    with_pair(main)


def test_a_full_kernel_takes_the_rest_later_and_in_order():
    async def main(pair):
        sent, taken = pair.fill()
        assert 0 < taken < len(sent)
        pair.link.write(b"M2\n")
        assert pair.link.unwritten == len(sent) - taken + 3
        assert await pair.read() == sent + b"M2\n"
        assert (pair.link.unwritten, pair.heard.drains) == (0, 1)

    with_pair(main)


def test_a_stop_overtakes_whole_lines_only():
    async def main(pair):
        sent, taken = pair.fill()
        first = begun(sent, taken)
        pair.link.write_now(b"!\n")
        assert pair.link.unwritten == len(sent) - taken + 2
        assert await pair.read() == first + b"!\n" + sent[len(first) :]

    with_pair(main)


def test_a_stop_drops_whole_lines_and_the_begun_one_is_finished():
    async def main(pair):
        sent, taken = pair.fill()
        first = begun(sent, taken)
        assert pair.link.discard() == sent[len(first) :]
        assert pair.link.unwritten == len(first) - taken
        pair.link.write_now(b"!\n")
        pair.link.write(b"?queue\n")
        assert await pair.read() == first + b"!\n?queue\n"

    with_pair(main)


@pytest.mark.parametrize("cut", range(1, 14))
def test_wherever_the_kernel_stops_in_a_line(cut, monkeypatch):
    lines = b"G1 X1\nG2 Y2\nG3 Z3\n"
    write = os.write

    async def main(pair):
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", lambda fd, data: write(fd, bytes(data[:cut])))
            pair.link.write(lines)
        first = begun(lines, cut)
        assert pair.link.discard() == lines[len(first) :]
        pair.link.write(b"M2\n")
        pair.link.write_now(b"!\n")
        # With nothing left of a begun line there is no whole line to overtake but M2, if that had to wait.
        order = b"!\nM2\n" if len(first) > cut else b"M2\n!\n"
        assert await pair.read() == first + order

    with_pair(main)


@pytest.mark.parametrize("cut", range(1, 13))
def test_wherever_the_kernel_stops_when_it_goes_on(cut, monkeypatch):
    lines = b"G1 X1\nG2 Y2\nG3 Z3\n"
    write = os.write
    steps = [0, cut]

    def some(fd, data):
        if not steps:
            raise BlockingIOError
        taken = steps.pop(0)
        if not taken:
            raise BlockingIOError
        return write(fd, bytes(data[:taken]))

    async def main(pair):
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", some)
            pair.link.write(lines)
            assert pair.link.unwritten == len(lines)
            await asyncio.sleep(0.005)
            assert pair.link.unwritten == len(lines) - cut
            pair.link.write_now(b"!\n")
        first = begun(lines, cut)
        assert await pair.read() == first + b"!\n" + lines[len(first) :]

    with_pair(main)


def test_a_stop_goes_ahead_of_all_when_no_line_is_begun(monkeypatch):
    def full(*_):
        raise BlockingIOError

    async def main(pair):
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", full)
            pair.link.write(b"G1\nG2\n")
        pair.link.write_now(b"!\n")
        assert await pair.read() == b"!\nG1\nG2\n"

    with_pair(main)


def test_discard_of_all_leaves_nothing_to_write(monkeypatch):
    def full(*_):
        raise BlockingIOError

    async def main(pair):
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", full)
            pair.link.write(b"G1\nG2\n")
        assert pair.link.discard() == b"G1\nG2\n"
        assert pair.link.discard() == b""
        assert pair.link.unwritten == 0
        pair.link.write(b"G3\n")
        assert await pair.read() == b"G3\n"

    with_pair(main)


def test_the_other_end_going_is_said_once():
    async def main(pair):
        pair.far.close()
        await asyncio.sleep(0.01)
        assert pair.heard.reasons == ["the other end is gone"]
        pair.link.write(b"G1\n")
        pair.link.write_now(b"!\n")
        assert pair.link.discard() == b""
        assert pair.link.unwritten == 0
        pair.link.close()
        await asyncio.sleep(0.01)
        assert len(pair.heard.reasons) == 1

    with_pair(main)


def test_a_write_that_fails_is_a_loss_said_once():
    async def main(pair):
        pair.far.close()
        pair.link.write(b"G1\n")
        assert pair.heard.reasons == ["write failed: Broken pipe"]
        pair.link.write(b"G1\n")
        await asyncio.sleep(0.01)
        assert len(pair.heard.reasons) == 1

    with_pair(main)


def test_a_loss_with_bytes_unwritten_drops_them():
    async def main(pair):
        pair.fill()
        pair.far.close()
        await asyncio.sleep(0.01)
        assert len(pair.heard.reasons) == 1
        assert pair.link.unwritten == 0

    with_pair(main)


def test_a_closed_link_says_nothing_and_lets_go():
    async def main(pair):
        released = []
        ours, far = socket.socketpair()
        ours.setblocking(False)
        link = StreamLink(ours.fileno(), pair.heard, lambda: released.append(1) or ours.close())
        link.close()
        link.close()
        assert released == [1]
        assert far.recv(1) == b""
        far.close()
        await asyncio.sleep(0.01)
        assert (pair.heard.reasons, pair.heard.data) == ([], b"")

    with_pair(main)
