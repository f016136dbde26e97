"""A simulated machine as a process of its own (``toolpost sim spark``)."""

import asyncio
import os
import signal
import sys
from pathlib import Path
from typing import TextIO

from toolpost.sim.faults import Fault
from toolpost.sim.options import SparkOptions
from toolpost.sim.ports import PtyPort

_STDIN = 0
_MAX_LINE = 4096


async def run(
    options: SparkOptions,
    *,
    link: Path | None = None,
    baud: int | None = None,
    faults: list[Fault] | None = None,
) -> None:
    """Run a simulated Spark core on a pty until SIGTERM or SIGINT.

    Prints one line, ``toolpost: simulated spark core on PATH``, when a host can open it. Lines
    on standard input are faults (``reboot``, ``mute:2``); its end ends nothing.

    Args:
        options: what the core is like.
        link: a path for a symlink to the pty.
        baud: speed of the wire, bits per second; None for no limit.
        faults: faults that the core shall have from the start.

    Raises:
        StartError: the symlink's path is taken, or no pty is to be had.
    """
    loop = asyncio.get_running_loop()
    stop = asyncio.Event()
    signals = (signal.SIGTERM, signal.SIGINT)
    for number in signals:
        loop.add_signal_handler(number, stop.set)
    port = PtyPort(loop, options, link=link, baud=baud, faults=faults or ())
    control = FaultInput(loop, port)
    try:
        port.start()
        _say(sys.stdout, f"toolpost: simulated spark core on {port.path}")
        control.start()
        await stop.wait()
    finally:
        control.stop()
        port.close()
        for number in signals:
            loop.remove_signal_handler(number)


class FaultInput:
    """Reads faults from standard input, one per line, and has the core have them.

    Args:
        loop: the loop that watches standard input.
        port: whose core shall have the faults.
        fd: the descriptor to read.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, port: PtyPort, fd: int = _STDIN) -> None:
        self._loop = loop
        self._port = port
        self._fd = fd
        self._tail = b""
        self._watching = False

    def start(self) -> None:
        """Begin to read, if standard input is open."""
        try:
            self._loop.add_reader(self._fd, self._read)
        except PermissionError:
            # A regular file or /dev/null cannot be watched, but reading it never waits.
            while self._read():
                pass
        except OSError:
            return
        else:
            self._watching = True

    def stop(self) -> None:
        """Read no more."""
        if self._watching:
            self._watching = False
            self._loop.remove_reader(self._fd)

    def _read(self) -> bool:
        """Take what is there; return False at the end of the input."""
        try:
            data = os.read(self._fd, _MAX_LINE)
        except BlockingIOError:
            return True
        except OSError:
            data = b""
        *lines, self._tail = (self._tail + (data or b"\n")).split(b"\n")
        self._tail = self._tail[:_MAX_LINE]
        for line in lines:
            text = line.decode(errors="replace").strip()
            if text:
                self._take(text)
        if not data:
            self.stop()
        return bool(data)

    def _take(self, text: str) -> None:
        try:
            self._port.core.inject(Fault.parse(text))
        except ValueError as error:
            _say(sys.stderr, f"toolpost: {error}")


def _say(stream: TextIO, text: str) -> None:
    print(text, file=stream, flush=True)
