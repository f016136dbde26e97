"""Printing files: start, end, pause, cancel, errors, names."""

import asyncio
import time
from pathlib import Path

import pytest
from tests.sim.klippy.bench import TICK, Bench, Client, RefusedError, running, wait_until

WATCHED = {
    "print_stats": ["state", "filename", "message"],
    "virtual_sdcard": None,
    "pause_resume": None,
    "webhooks": ["state"],
}
DONE = "Done printing file"


async def start(bench: Bench, text: str, name: str = "job.gcode") -> Client:
    """Print a file of this text; return a client that watches."""
    bench.file(name, text)
    client = await bench.client(**WATCHED)
    await client.print(name)
    return client


def test_a_file_from_start_to_end(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await start(bench, "; head\nG28\nM83\n\nG1 X1 E5\nG4 P150\nM400\n")
            assert client.lines == ["File opened:job.gcode Size:38", "File selected"]
            await wait_until(lambda: client.status["print_stats"]["state"] == "printing")
            card = client.status["virtual_sdcard"]
            assert card["is_active"] is True
            assert card["file_path"] == str(bench.host.gcodes / "job.gcode")
            assert 0 < card["progress"] < 1
            await wait_until(lambda: client.lines[-1] == DONE)
            assert bench.state() == "complete"
            await wait_until(lambda: client.status["print_stats"]["state"] == "complete")
            assert card == {
                "file_path": None, "progress": 1.0, "is_active": False, "file_position": 38, "file_size": 38,
            }  # fmt: skip
            assert bench.host.starts == ["job.gcode"]
            assert bench.host.executed == [("job.gcode", 5)]
            stats = bench.host.status("print_stats")
            assert stats["filament_used"] == 5
            assert 0.1 < stats["print_duration"] <= stats["total_duration"] < 2

    asyncio.run(main())


def test_only_the_output_tells_of_a_job_shorter_than_a_tick(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await start(bench, "G92 E0\n")
            await wait_until(lambda: client.status["print_stats"]["state"] == "complete")
            client.updates.clear()
            for _ in range(3):
                await client.print("job.gcode")
                await wait_until(lambda: client.lines[-1] == DONE)
            await asyncio.sleep(3 * TICK)
            assert [update for update in client.updates if "print_stats" in update] == []
            assert client.lines.count(DONE) == 4
            assert bench.host.executed == [("job.gcode", 1)] * 4

    asyncio.run(main())


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ("Sub/Part One.gcode", True),
        ("/Sub/Part One.gcode", True),
        ("sub/PART one.GCODE", True),
        ('a\\"b.gcode', True),
        ("Part One.gcode", False),
        ("../secret.gcode", False),
        ("./Sub/Part One.gcode", False),
        ("note.txt", False),
        ("/", False),
    ],
)
def test_names(tmp_path: Path, asked: str, found: bool):
    async def main():
        (tmp_path / "secret.gcode").write_text("G28\n")
        async with running(tmp_path) as bench:
            for name in ("Sub/Part One.gcode", 'a"b.gcode', "note.txt"):
                bench.file(name, "G92 E0\n")
            client = await bench.client()
            if found:
                await client.print(asked)
                name = asked.removeprefix("/").replace("\\", "")
                assert client.lines[0] == f"File opened:{name} Size:7"
                assert bench.host.starts == [name]
                return
            with pytest.raises(RefusedError, match="Unable to open file"):
                await client.print(asked)
            assert client.lines == ["!! Unable to open file"]
            assert bench.host.starts == []
            assert bench.state() == "standby"

    asyncio.run(main())


def test_an_empty_name_brings_the_host_down(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            with pytest.raises(RefusedError, match="string index out of range"):
                await client.print("")
            assert bench.host.state == "shutdown"
            assert client.lines[-1] == '!! Internal error on command:"SDCARD_PRINT_FILE"'

    asyncio.run(main())


@pytest.mark.parametrize(
    ("content", "commands", "position", "state"),
    [
        (b"", 0, 0, "complete"),
        (b"G92 E0\nM117 lost", 1, 7, "complete"),  # the last line has no end and is never run
        (b"G92 E0\r\nM117 x\r\n", 2, 16, "complete"),
        (b"G92 E0\n\xff\n", 0, 0, "paused"),  # no UTF-8: it stops without a word
    ],
)
def test_odd_files(tmp_path: Path, content: bytes, commands: int, position: int, state: str):
    async def main():
        async with running(tmp_path) as bench:
            bench.file("odd.gcode", content)
            client = await bench.client()
            await client.print("odd.gcode")
            await wait_until(lambda: bench.state() == state)
            assert (client.lines[-1] == DONE) is (state == "complete")
            assert bench.host.executed == [("odd.gcode", commands)]
            assert bench.host.status("virtual_sdcard")["file_position"] == position

    asyncio.run(main())


def test_busy_and_waiting_scripts(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await start(bench, "G4 P200\nG4 P50\n")
            await asyncio.sleep(0.02)
            began = time.monotonic()
            await client.run("M117 between")
            assert 0.1 < time.monotonic() - began < 0.3  # it waited for the line that ran
            assert bench.host.executed == [("job.gcode", 1)]
            for script in ("SDCARD_PRINT_FILE FILENAME=job.gcode", "M24", "M23 job.gcode", "M26 S0"):
                with pytest.raises(RefusedError, match="SD busy"):
                    await client.run(script)
            await wait_until(lambda: client.lines[-1] == DONE)

    asyncio.run(main())


def test_pause_and_resume_wait_for_the_line(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await start(bench, "G4 P150\nG4 P150\nM117 end\n")
            await wait_until(lambda: client.status["print_stats"]["state"] == "printing")
            began = time.monotonic()
            assert await client.call("pause_resume/pause") == {}
            assert 0.03 < time.monotonic() - began < 0.4
            assert bench.state() == "paused"
            assert bench.host.executed == [("job.gcode", 1)]
            await wait_until(lambda: client.status["pause_resume"]["is_paused"])
            assert client.status["virtual_sdcard"]["is_active"] is False
            await client.run("M27")
            assert client.lines[-1] == "SD printing byte 8/25"
            await client.call("pause_resume/pause")
            assert client.lines[-1] == "// Print already paused"
            assert await client.call("pause_resume/resume") == {}
            await wait_until(lambda: client.lines[-1] == DONE)
            assert bench.host.executed == [("job.gcode", 3)]
            assert bench.host.status("pause_resume") == {"is_paused": False}

    asyncio.run(main())


@pytest.mark.parametrize("paused", [False, True])
def test_cancel(tmp_path: Path, paused: bool):
    async def main():
        async with running(tmp_path) as bench:
            client = await start(bench, "M104 S50\n" + "G4 P50\n" * 100)
            await wait_until(lambda: client.status["print_stats"]["state"] == "printing")
            if paused:
                await client.call("pause_resume/pause")
            assert await client.call("pause_resume/cancel") == {}
            assert bench.state() == "cancelled"
            assert bench.host.status("extruder")["target"] == 0
            executed = bench.host.executed
            await wait_until(lambda: client.status["print_stats"]["state"] == "cancelled")
            assert client.status["pause_resume"]["is_paused"] is False
            assert client.status["virtual_sdcard"]["file_path"] is None
            assert DONE not in client.lines
            await asyncio.sleep(0.1)
            assert bench.host.executed == executed

    asyncio.run(main())


@pytest.mark.parametrize(
    ("script", "state"), [("PAUSE", "paused"), ("M25", "paused"), ("CANCEL_PRINT", "cancelled")]
)
def test_a_file_may_stop_itself(tmp_path: Path, script: str, state: str):
    async def main():
        async with running(tmp_path) as bench:
            client = await start(bench, f"G1 X1\n{script}\nG1 X2\n")
            await wait_until(lambda: bench.state() == state)
            assert bench.host.executed == [("job.gcode", 2)]
            if script == "PAUSE":
                await client.run("RESUME")
            elif script == "M25":
                await client.run("M24")
            else:
                assert DONE not in client.lines
                return
            await wait_until(lambda: client.lines[-1] == DONE)
            assert bench.host.executed == [("job.gcode", 3)]

    asyncio.run(main())


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("G20", "Machine does not support G20 (inches) command"),
        ("SDCARD_PRINT_FILE FILENAME=job.gcode", "SD busy"),
        ("SDCARD_RESET_FILE", "SDCARD_RESET_FILE cannot be run from the sdcard"),
    ],
)
def test_an_error_ends_the_file(tmp_path: Path, line: str, message: str):
    async def main():
        async with running(tmp_path) as bench:
            client = await start(bench, f"M104 S50\nFOO\n{line}\nG1 X1\n")
            await wait_until(lambda: client.status["print_stats"]["state"] == "error")
            assert client.status["print_stats"]["message"] == message
            assert client.lines[-2:] == ['// Unknown command:"FOO"', f"!! {message}"]
            assert bench.host.status("extruder")["target"] == 0
            assert bench.host.executed == [("job.gcode", 2)]
            bench.file("next.gcode", "G1 X1\n")
            await client.print("next.gcode")
            await wait_until(lambda: bench.state() == "complete")
            assert bench.host.status("print_stats")["message"] == ""

    asyncio.run(main())


def test_another_file_may_replace_a_paused_one(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await start(bench, "G1 X1\nPAUSE\nG1 X2\n")
            await wait_until(lambda: bench.state() == "paused")
            bench.file("next.gcode", "G1 X1\n")
            await client.print("next.gcode")
            await wait_until(lambda: bench.state() == "complete")
            assert bench.host.starts == ["job.gcode", "next.gcode"]
            assert bench.host.status("pause_resume") == {"is_paused": True}  # as in a real host

    asyncio.run(main())


def test_select_then_start(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            bench.file("a.gcode", "G1 X1\n")
            client = await bench.client()
            await client.run("M20")
            assert client.lines == ["Begin file list", "a.gcode 6", "End file list"]
            await client.run("M23 a.gcode")
            assert bench.host.starts == []
            assert bench.state() == "standby"
            await client.run("M24")
            await wait_until(lambda: bench.state() == "complete")
            assert bench.host.starts == ["a.gcode"]

    asyncio.run(main())


def test_layers(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            await client.run("SET_PRINT_STATS_INFO TOTAL_LAYER=5 CURRENT_LAYER=9")
            info = {"total_layer": 5, "current_layer": 5}
            assert bench.host.status("print_stats")["info"] == info

    asyncio.run(main())


def test_lines_are_run_in_time(tmp_path: Path):
    async def main():
        async with running(tmp_path, line_time=0.002) as bench:
            began = time.monotonic()
            client = await start(bench, "G1 X1\n" * 200)
            await wait_until(lambda: client.lines[-1] == DONE)
            assert 0.38 < time.monotonic() - began < 0.8

    asyncio.run(main())
