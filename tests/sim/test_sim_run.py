"""The simulated machine as a process of its own."""

import os
import signal
import subprocess
import sys
import time

import pytest

SCRIPT = """
import asyncio, sys
from pathlib import Path
from toolpost.sim.run import run
from toolpost.sim.options import SparkOptions
link = Path(sys.argv[1]) if len(sys.argv) > 1 else None
asyncio.run(run(SparkOptions(), link=link, baud=None, faults=[]))
"""


@pytest.fixture
def start():
    started = []

    def start(*arguments, stdin=subprocess.PIPE):
        process = subprocess.Popen(
            [sys.executable, "-c", SCRIPT, *map(str, arguments)],
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process, process.stdout.readline()

    yield start
    for process in started:
        process.kill()
        process.communicate()


def end(process, number=signal.SIGTERM):
    process.send_signal(number)
    out, error = process.communicate(timeout=5)
    assert process.returncode == 0
    assert out == ""
    return error


def read_until(fd, text):
    got, deadline = b"", time.monotonic() + 5
    while text not in got:
        assert time.monotonic() < deadline, got
        got += os.read(fd, 4096)
    return got


def test_faults_from_standard_input(start, tmp_path):
    link = tmp_path / "spark"
    process, line = start(link)
    assert line == f"toolpost: simulated spark core on {link}\n"
    fd = os.open(link, os.O_RDWR | os.O_NOCTTY)
    os.write(fd, b"?queue\n")
    read_until(fd, b"num:0")
    process.stdin.write("explode\n\nreboot\nerr")
    process.stdin.flush()
    read_until(fd, b'ev:"boot"')
    process.stdin.write("or:hello")
    process.stdin.close()
    process.stdin = None
    read_until(fd, b"hello")
    os.write(fd, b"?queue\n")
    read_until(fd, b"num:0")
    os.close(fd)
    error = end(process)
    assert "unknown fault 'explode'; valid: mute" in error
    assert not link.is_symlink()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_standard_input_may_be_nothing(start, number):
    process, line = start(stdin=subprocess.DEVNULL)
    assert line.startswith("toolpost: simulated spark core on /dev/pts/")
    assert end(process, number) == ""


def test_standard_input_may_be_a_file(start, tmp_path):
    script = tmp_path / "faults"
    script.write_text("mute:1\nnonsense")
    with script.open() as stdin:
        process, _ = start(stdin=stdin)
    assert "nonsense" in end(process)
