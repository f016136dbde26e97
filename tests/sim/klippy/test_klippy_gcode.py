"""Single commands: what they change, what they put out, what they refuse."""

import asyncio
import time
from pathlib import Path

import pytest
from tests.sim.klippy.bench import RefusedError, running, wait_until

from toolpost.sim.klippy.errors import CommandError
from toolpost.sim.klippy.parsing import Command


@pytest.mark.parametrize(
    ("line", "name", "params"),
    [
        ("G1 X1.5 Y-2 F6000 ; go", "G1", {"X": "1.5", "Y": "-2", "F": "6000"}),
        ("g1x1y2", "G1", {"X": "1", "Y": "2"}),
        ("N12 G92 E0*71", "G92", {"E": "0"}),
        ("G92.1", "G92.1", {}),
        ('sdcard_print_file filename="a b;#\\".gcode"', "SDCARD_PRINT_FILE", {"FILENAME": 'a b;#".gcode'}),
        ("SET_X A=1 B='c d' # e", "SET_X", {"A": "1", "B": "c d"}),
        ("; nothing", "", {}),
        ("   ", "", {}),
        ("?", "?", {}),
    ],
)
def test_lines(line: str, name: str, params: dict):
    command = Command(line)
    assert command.name == name
    assert params == {} or {key: command.params[key] for key in params} == params


@pytest.mark.parametrize("line", ["SET_X FOO", 'SET_X A="b'])
def test_malformed_lines(line: str):
    with pytest.raises(CommandError, match="Malformed command"):
        Command(line).params  # noqa: B018


@pytest.mark.parametrize(
    ("script", "lines"),
    [
        ("FOO_BAR X=1", ['// Unknown command:"FOO_BAR"']),
        ("foo\nM999\nT0", [f'// Unknown command:"{name}"' for name in ("FOO", "M999", "T0")]),
        ("M118 hi there", ["echo: hi there"]),
        ("RESPOND MSG=hi", ["echo: hi"]),
        ('RESPOND TYPE=error MSG="a b"', ["!! a b"]),
        ("RESPOND TYPE=command MSG=action:x", ["// action:x"]),
        ("RESPOND PREFIX=tst: MSG=b", ["tst: b"]),
        ("M21", ["SD card ok"]),
        ("M27", ["Not SD printing."]),
        ("M105", ["B:22.0 /0.0 T0:22.0 /0.0"]),
        ("STATUS", ["// Klipper state: Ready"]),
        ("G1 X3 Y2\nG92 E5\nM114", ["X:3.000 Y:2.000 Z:0.000 E:5.000"]),
        ("G91\nG1 X3\nG1 X3 E1\nM114", ["X:6.000 Y:0.000 Z:0.000 E:1.000"]),
        ("M83\nG1 E1\nG1 E1\nM221 S200\nM114", ["X:0.000 Y:0.000 Z:0.000 E:2.000"]),
        ("G1 X5\nG28\nM114", ["X:0.000 Y:0.000 Z:0.000 E:0.000"]),
        ("SAVE_GCODE_STATE NAME=a\nG91\nRESTORE_GCODE_STATE NAME=a\nG1 X1\nG1 X1\nM114",
         ["X:1.000 Y:0.000 Z:0.000 E:0.000"]),
        ("M73 P50\nSET_DISPLAY_TEXT MSG=x\nM400\nM204 S1\nSET_VELOCITY_LIMIT\nM220 S50\nM84\nM107", []),
        ("PAUSE", ["// action:paused"]),
        ("PAUSE\nPAUSE\nRESUME\nRESUME", [
            "// action:paused", "// Print already paused", "// action:resumed",
            "// Print is not paused, resume aborted"]),
        ("CANCEL_PRINT", ["// action:cancel"]),
        ("M24\nM25\nSDCARD_RESET_FILE\nCLEAR_PAUSE", []),
        ("SET_IDLE_TIMEOUT TIMEOUT=700", ["// idle_timeout: Timeout set to 700.00 s"]),
        ("; only a comment\n\n", []),
    ],
)  # fmt: skip
def test_output(tmp_path: Path, script: str, lines: list[str]):
    async def main():
        async with running(tmp_path, line_time=0) as bench:
            client = await bench.client()
            assert await client.run(script) == {}
            assert client.lines == lines
            assert bench.host.scripts == [script]

    asyncio.run(main())


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("G20", "Machine does not support G20 (inches) command"),
        ("G1 X", "Unable to parse move 'G1 X'"),
        ("G1 F-1", "Invalid speed in 'G1 F-1'"),
        ("G4 P-1", "Error on 'G4 P-1': P must have minimum of 0.0"),
        ("M220 S0", "Error on 'M220 S0': S must be above 0.0"),
        ("M104 S1000", "Requested temperature (1000.0) out of range (0.0:300.0)"),
        ("M104 S1.2.3", "Error on 'M104 S1.2.3': unable to parse 1.2.3"),
        ("TEMPERATURE_WAIT SENSOR=extruder", "missing MINIMUM or MAXIMUM"),
        ("SET_HEATER_TEMPERATURE HEATER=x", "The value 'x' is not valid for HEATER"),
        ("RESPOND TYPE=x", "RESPOND TYPE 'x' is invalid"),
        ("RESTORE_GCODE_STATE NAME=q", "Unknown g-code state: q"),
        ("SDCARD_PRINT_FILE", "Error on 'SDCARD_PRINT_FILE': missing FILENAME"),
        ("G1 X500", "Must home axis first: 500.000 0.000 0.000 [0.000]"),
        ("G28\nG1 X500", "Move out of range: 500.000 0.000 0.000 [0.000]"),
        ("G1 E5", "Extrude below minimum temp\n"),
    ],
)
def test_refusals(tmp_path: Path, script: str, message: str):
    async def main():
        async with running(tmp_path, line_time=0, strict_motion=True) as bench:
            client = await bench.client()
            with pytest.raises(RefusedError) as refused:
                await client.run(f"{script}\nM118 never")
            assert message in str(refused.value)
            assert client.lines[-1] == f"!! {str(refused.value).splitlines()[0]}"
            assert bench.host.state == "ready"

    asyncio.run(main())


def test_times(tmp_path: Path):
    async def main():
        async with running(tmp_path, line_time=0.002) as bench:
            client = await bench.client()

            async def timed(script: str) -> float:
                began = time.monotonic()
                await client.run(script)
                return time.monotonic() - began

            assert 0.18 < await timed("G1 X1\n" * 100) < 0.4
            assert 0.09 < await timed("G4 P100") < 0.2
            assert 0.09 < await timed("G4 S0.1") < 0.2
            assert await timed("G92 E0\n" * 100) < 0.1

    asyncio.run(main())


def test_a_buffer_ends_lines_before_their_motion(tmp_path: Path):
    async def main():
        async with running(tmp_path, buffer_time=5) as bench:
            client = await bench.client()
            began = time.monotonic()
            await client.run("G4 P200")
            assert time.monotonic() - began < 0.1
            toolhead = bench.host.status("toolhead")
            assert toolhead["print_time"] > toolhead["estimated_print_time"]
            await client.run("M400")
            assert time.monotonic() - began > 0.19

    asyncio.run(main())


def test_heaters(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client(extruder=None, heater_bed=None)
            await client.run("M104 S200\nM140 S60")
            assert bench.host.status("extruder")["temperature"] < 200
            await client.run("M109 S200\nM190 S60")
            assert bench.host.status("extruder")["temperature"] > 197
            assert bench.host.status("extruder")["can_extrude"] is True
            assert bench.host.status("heater_bed")["temperature"] > 57
            await client.run("TURN_OFF_HEATERS\nTEMPERATURE_WAIT SENSOR=extruder MAXIMUM=40")
            assert bench.host.status("extruder")["temperature"] <= 40
            assert client.lines[0].startswith("B:")
            await wait_until(lambda: client.status["extruder"]["target"] == 0)
            await client.run("SET_HEATER_TEMPERATURE HEATER=heater_bed TARGET=50")
            waiting = client.send("gcode/script", script="TEMPERATURE_WAIT SENSOR=heater_bed MINIMUM=90")
            await client.call("emergency_stop")
            await waiting
            await wait_until(lambda: bench.host.status("heater_bed")["temperature"] < 30)

    asyncio.run(main())
