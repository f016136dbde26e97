"""Queries, subscriptions and their tick."""

import asyncio
import time
from pathlib import Path

from tests.sim.klippy.bench import TICK, running, wait_until


def test_only_changes_are_sent(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client(display_status=None, gcode_move=["absolute_coordinates"])
            assert client.status == {
                "display_status": {"progress": 0.0, "message": None},
                "gcode_move": {"absolute_coordinates": True},
            }
            await asyncio.sleep(3 * TICK)
            assert client.updates == []
            await client.run("M117 hello")
            await wait_until(lambda: client.updates)
            await client.run("G91")
            await wait_until(lambda: len(client.updates) == 2)
            assert client.updates == [
                {"display_status": {"message": "hello"}},
                {"gcode_move": {"absolute_coordinates": False}},
            ]

    asyncio.run(main())


def test_a_subscription_replaces_the_one_before(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client(display_status=None)
            await client.listen(gcode_move=["absolute_extrude"])
            await client.run("M117 hello\nM83")
            await wait_until(lambda: client.updates)
            await asyncio.sleep(2 * TICK)
            assert client.updates == [{"gcode_move": {"absolute_extrude": False}}]

    asyncio.run(main())


def test_each_connection_has_its_own(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            one = await bench.client(display_status=["message"])
            two = await bench.client(display_status=None, fan=None)
            await one.run("M117 hello\nM106 S255")
            await wait_until(lambda: one.updates and two.updates)
            assert one.updates == [{"display_status": {"message": "hello"}}]
            assert two.updates == [{"display_status": {"message": "hello"}, "fan": {"speed": 1.0}}]

    asyncio.run(main())


def test_what_does_not_exist(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            answer = await client.call("objects/query", objects={"x": None, "y": ["a"], "fan": ["b"]})
            assert answer["status"] == {"x": {}, "y": {"a": None}, "fan": {"b": None}}

    asyncio.run(main())


def test_queries_wait_for_the_common_tick(tmp_path: Path):
    async def main():
        async with running(tmp_path, tick=0.1) as bench:
            client = await bench.client()

            async def timed() -> float:
                began = time.monotonic()
                await client.call("objects/query", objects={"webhooks": None})
                return time.monotonic() - began

            assert await timed() < 0.05  # nothing else asks: at once
            await asyncio.sleep(0.25)
            assert await timed() < 0.05
            other = await bench.client(webhooks=None)
            await timed()
            waits = [await timed() for _ in range(3)]
            assert all(0.08 < wait < 0.2 for wait in waits)
            together = await asyncio.gather(*(timed() for _ in range(4)))
            assert max(together) - min(together) < 0.05
            other.close()

    asyncio.run(main())


def test_every_listed_object_answers(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            names = (await client.call("objects/list"))["objects"]
            found = (await client.call("objects/query", objects=dict.fromkeys(names)))["status"]
            assert set(names) == set(found)
            assert {
                "webhooks", "print_stats", "virtual_sdcard", "pause_resume", "idle_timeout", "display_status",
                "toolhead", "gcode_move", "motion_report", "extruder", "heater_bed", "heaters", "configfile",
                "fan", "mcu", "system_stats", "gcode",
            } <= set(names)  # fmt: skip
            settings = found["configfile"]["settings"]
            macros = {f"gcode_macro {name}" for name in ("pause", "resume", "cancel_print")}
            assert {"virtual_sdcard", "pause_resume", "display_status", *macros} <= set(settings)
            assert settings["virtual_sdcard"]["path"] == str(bench.host.gcodes)
            assert found["heaters"]["available_heaters"] == ["heater_bed", "extruder"]
            assert "G1" in found["gcode"]["commands"]

    asyncio.run(main())


def test_idle_timeout(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client(idle_timeout=["state"], extruder=["target"])
            assert client.status["idle_timeout"]["state"] == "Idle"
            await client.run("M104 S50\nG1 X1")
            await wait_until(lambda: client.status["idle_timeout"]["state"] == "Printing")
            await wait_until(lambda: client.status["idle_timeout"]["state"] == "Ready")
            assert client.status["extruder"]["target"] == 50
            await client.run("SET_IDLE_TIMEOUT TIMEOUT=0.01")
            await wait_until(lambda: client.status["idle_timeout"]["state"] == "Idle")
            await wait_until(lambda: client.status["extruder"]["target"] == 0)

    asyncio.run(main())
