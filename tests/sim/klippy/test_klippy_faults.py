"""Faults on demand."""

import asyncio
import time
from pathlib import Path

import pytest
from tests.sim.klippy.bench import Client, RefusedError, running, wait_until

from toolpost.sim.klippy.faults import Fault


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nope", "unknown fault 'nope'; valid: shutdown, disconnect"),
        ("die:1", "fault die takes no argument"),
        ("slow:x", "fault slow needs seconds"),
        ("mute:-1", "fault mute needs seconds"),
        ("garbage:1.5", "whole number of bytes"),
    ],
)
def test_wrong_faults(text: str, message: str):
    with pytest.raises(ValueError, match=message):
        Fault.parse(text)


def test_shutdown_during_a_line(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            bench.file("job.gcode", "G1 X1\nG4 P300\nG1 X2\n")
            client = await bench.client(webhooks=["state"], print_stats=["state"])
            await client.print("job.gcode")
            await wait_until(lambda: bench.host.executed == [("job.gcode", 1)])
            bench.host.inject("shutdown:Lost communication with MCU 'mcu'")
            await wait_until(lambda: client.status["webhooks"]["state"] == "shutdown")
            assert client.status["print_stats"]["state"] == "printing"  # the line runs on
            with pytest.raises(RefusedError, match="Lost communication"):
                await client.run("M117")
            await wait_until(lambda: bench.state() == "paused")
            assert bench.host.executed == [("job.gcode", 2)]

    asyncio.run(main())


def test_disconnect_leaves_the_machine_running(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            bench.file("job.gcode", "G4 P20\n" * 20)
            client = await bench.client()
            await client.print("job.gcode")
            bench.host.inject("disconnect:0.1")
            await asyncio.wait_for(client.closed.wait(), 1)
            with pytest.raises(ConnectionRefusedError):
                await Client().open(bench.host.path)
            again = await bench.reconnect()
            assert bench.state() == "printing"
            await wait_until(lambda: again.lines == ["Done printing file"])
            assert bench.host.executed == [("job.gcode", 20)]
            assert bench.host.boots == 1

    asyncio.run(main())


@pytest.mark.parametrize("fault", ["restart", "firmware-restart"])
def test_restart_out_of_the_blue(tmp_path: Path, fault: str):
    async def main():
        async with running(tmp_path) as bench:
            bench.file("job.gcode", "G4 P1000\nG1 X1\n")
            client = await bench.client()
            await client.print("job.gcode")
            waiting = client.send("gcode/script", script="M117 never")
            bench.host.inject(fault)
            await asyncio.wait_for(client.closed.wait(), 1)
            assert waiting.cancelled()
            await bench.reconnect()
            await wait_until(lambda: bench.host.state == "ready")
            assert bench.state() == "standby"
            assert bench.host.executed == [("job.gcode", 0)]

    asyncio.run(main())


def test_die_and_revive(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            bench.file("job.gcode", "G4 P1000\n")
            client = await bench.client()
            await client.print("job.gcode")
            bench.host.inject("disconnect:5")
            bench.host.inject("die")
            assert bench.host.state == "dead"
            await asyncio.wait_for(client.closed.wait(), 1)
            with pytest.raises(ConnectionRefusedError):
                await Client().open(bench.host.path)
            bench.host.inject("shutdown")
            assert bench.host.call_remote_method("x") == 0
            await bench.host.revive()
            await bench.host.revive()
            await bench.client()
            await wait_until(lambda: bench.host.state == "ready")
            assert bench.host.boots == 2

    asyncio.run(main())


def test_slow(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            bench.host.inject("slow:0.1")
            for _ in range(2):
                began = time.monotonic()
                await client.call("info")
                assert 0.09 < time.monotonic() - began < 0.5
                client = await bench.client()  # it holds for new clients, too

    asyncio.run(main())


def test_mute(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            bench.host.inject("mute:0.1")
            lost = client.send("gcode/script", script="M117 heard")
            await wait_until(lambda: bench.host.status("display_status")["message"] == "heard")
            await asyncio.sleep(0.15)
            assert not lost.done()
            await client.call("info")
            bench.host.inject("mute")
            unheard = client.send("info")
            await asyncio.sleep(0.05)
            assert not unheard.done()

    asyncio.run(main())


def test_error_in_the_running_file(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            bench.file("job.gcode", "G4 P20\n" * 50)
            client = await bench.client(print_stats=None)
            await client.print("job.gcode")
            bench.host.inject("error:Nozzle is gone")
            await wait_until(lambda: client.status["print_stats"]["state"] == "error")
            assert client.status["print_stats"]["message"] == "Nozzle is gone"
            assert client.lines[-1] == "!! Nozzle is gone"

    asyncio.run(main())


def test_garbage(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            bench.host.inject("garbage:100")
            await client.call("info")
            assert client.others

    asyncio.run(main())


def test_close_at_any_time(tmp_path: Path):
    async def main():
        for fault in ("restart", "disconnect:9", "die", "mute:9", "slow:9"):
            async with running(tmp_path) as bench:
                bench.file("job.gcode", "G4 P1000\n")
                client = await bench.client(print_stats=None)
                await client.print("job.gcode")
                client.send("gcode/script", script="M400")
                client.send("objects/query", objects={"toolhead": None})
                bench.host.inject(fault)
                await asyncio.sleep(0.03)
        assert len(asyncio.all_tasks()) == 1

    asyncio.run(main())
