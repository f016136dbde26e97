"""The socket: frames, methods, errors, life."""

import asyncio
import json
import time
from pathlib import Path

import pytest
from tests.sim.klippy.bench import Client, RefusedError, running, wait_until

from toolpost.sim.klippy import KlippyOptions


def test_startup_then_ready(tmp_path: Path):
    async def main():
        async with running(tmp_path, ready=False, startup_time=0.1) as bench:
            client = await bench.client()
            assert (await client.call("info", client_info={"program": "test"}))["state"] == "startup"
            with pytest.raises(RefusedError, match="Printer is not ready"):
                await client.run("G28")
            with pytest.raises(RefusedError, match="Printer is not ready"):
                await client.run("")
            await client.run("M105")
            assert "webhooks" in (await client.call("objects/list"))["objects"]
            await wait_until(lambda: "// Klipper state: Ready" in client.lines)
            info = await client.call("info")
            assert (info["state"], info["state_message"]) == ("ready", "Printer is ready")
            assert info["process_id"] > 0
            await client.run("G28")
        assert not (tmp_path / "klippy.sock").exists()

    asyncio.run(main())


def test_methods_are_listed(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            endpoints = (await client.call("list_endpoints"))["endpoints"]
            assert {
                "list_endpoints", "info", "emergency_stop", "register_remote_method", "gcode/help",
                "gcode/script", "gcode/restart", "gcode/firmware_restart", "gcode/subscribe_output",
                "objects/list", "objects/query", "objects/subscribe", "pause_resume/pause",
                "pause_resume/resume", "pause_resume/cancel", "query_endstops/status",
            } == set(endpoints)  # fmt: skip
            helps = await client.call("gcode/help")
            assert helps["PAUSE"] == "G-Code macro"
            assert "G1" not in helps
            assert set(await client.call("query_endstops/status")) == {
                "stepper_x",
                "stepper_y",
                "stepper_z",
            }

    asyncio.run(main())


@pytest.mark.parametrize(
    ("method", "params", "message"),
    [
        ("nope", {}, "webhooks: No registered callback for path 'nope'"),
        ("gcode/script", {}, "Missing Argument [script]"),
        ("gcode/script", {"script": 1}, "Invalid Argument Type [script]"),
        ("objects/query", {}, "Missing Argument [objects]"),
        ("objects/query", {"objects": {"toolhead": "x"}}, "Invalid argument"),
        ("objects/query", {"objects": {"toolhead": [1]}}, "Invalid argument"),
        ("register_remote_method", {}, "Missing Argument [response_template]"),
        ("info", {"client_info": 1}, "Invalid Argument Type [client_info]"),
    ],
)
def test_errors(tmp_path: Path, method: str, params: dict, message: str):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            with pytest.raises(RefusedError) as refused:
                await client.call(method, **params)
            assert str(refused.value) == message

    asyncio.run(main())


def test_what_is_no_request_gets_no_answer(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            for text in (
                b"nonsense", b"[]", b"", b"\xff", b'{"id":5}', b'{"id":6,"method":"info","params":null}',
                b'{"method":"info"}', b'{"id":null,"method":"info"}', b'{"method":"nope"}',
            ):  # fmt: skip
                client.raw(text + b"\x03")
            client.raw(b'{"id":[1],"method":"list_')
            await asyncio.sleep(0.01)
            client.raw(b'endpoints"}\x03')
            await client.call("info")
            assert [message["id"] for message in client.others] == [[1]]

    asyncio.run(main())


def test_requests_are_begun_in_order_and_answered_when_done(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client()
            done = []
            waits = [client.send("gcode/script", script=f"G4 P30\nM118 {number}") for number in range(3)]
            for index, answer in enumerate(waits):
                answer.add_done_callback(lambda _answer, index=index: done.append(index))
            await client.call("info")
            assert done == []
            await asyncio.gather(*waits)
            assert done == [0, 1, 2]
            assert client.lines == ["echo: 0", "echo: 1", "echo: 2"]

    asyncio.run(main())


def test_a_client_that_does_not_read_is_closed(tmp_path: Path):
    async def main():
        async with running(tmp_path, client_timeout=0.1) as bench:
            other = await bench.client()
            _, writer = await asyncio.open_unix_connection(bench.host.path, limit=1)
            await wait_until(lambda: bench.host.clients == 2)
            request = json.dumps({"id": 1, "method": "gcode/help"}).encode() + b"\x03"
            writer.write(request * 2000)
            await wait_until(lambda: bench.host.clients == 1)
            await other.call("info")
            writer.close()

    asyncio.run(main())


def test_shutdown_by_emergency_stop(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            client = await bench.client(webhooks=None)
            assert await client.call("emergency_stop") == {}
            assert client.lines == ["// Klipper state: Shutdown"]
            await wait_until(lambda: client.status["webhooks"]["state"] == "shutdown")
            assert client.status["webhooks"]["state_message"].startswith("Shutdown due to webhooks request\n")
            with pytest.raises(RefusedError, match="Shutdown due to webhooks request"):
                await client.run("G28")
            with pytest.raises(RefusedError, match="Printer is shutdown"):
                await client.call("pause_resume/cancel")
            assert (await client.call("info"))["state"] == "shutdown"
            assert await client.call("emergency_stop") == {}
            await client.run("M112")
            bench.host.inject("shutdown:second")
            assert (await client.call("info"))["state_message"].startswith("Shutdown due to webhooks")
            assert await client.call("gcode/firmware_restart") == {}
            await asyncio.wait_for(client.closed.wait(), 5)
            assert "// Klipper state: Disconnect" in client.lines
            again = await bench.reconnect()
            await wait_until(lambda: bench.host.state == "ready")
            await again.run("G28")
            assert bench.host.boots == 2

    asyncio.run(main())


@pytest.mark.parametrize("how", ["gcode/restart", "gcode/firmware_restart"])
def test_restart_forgets_everything(tmp_path: Path, how: str):
    async def main():
        async with running(tmp_path, restart_time=0.1) as bench:
            bench.file("long.gcode", "G4 P20\n" * 500)
            client = await bench.client()
            await client.print("long.gcode")
            await client.call(how)
            await asyncio.wait_for(client.closed.wait(), 5)
            with pytest.raises(ConnectionRefusedError):
                await Client().open(bench.host.path)
            await bench.reconnect()
            await wait_until(lambda: bench.host.state == "ready")
            assert bench.state() == "standby"
            assert bench.host.starts == ["long.gcode"]

    asyncio.run(main())


def test_remote_methods(tmp_path: Path):
    async def main():
        async with running(tmp_path) as bench:
            one, two = await bench.client(), await bench.client()
            assert bench.host.call_remote_method("start_job_queue") == 0
            for client, template in ((one, {"method": "go", "k": 2}), (two, {"params": {"mine": 1}})):
                await client.call(
                    "register_remote_method", remote_method="start_job_queue", response_template=template
                )
            assert bench.host.call_remote_method("start_job_queue", a=1) == 2
            await wait_until(lambda: one.others and two.others)
            assert one.others == [{"params": {"a": 1}, "method": "go", "k": 2}]
            assert two.others == [{"params": {"mine": 1}}]
            two.close()
            await wait_until(lambda: bench.host.clients == 1)
            await one.run("START_QUEUE\nPAUSE_QUEUE")
            assert one.others[1:] == [{"params": {}, "method": "go", "k": 2}]

    asyncio.run(main())


def test_answer_delay(tmp_path: Path):
    async def main():
        async with running(tmp_path, answer_delay=0.1) as bench:
            client = await bench.client()
            began = time.monotonic()
            await client.call("info")
            assert time.monotonic() - began >= 0.09

    asyncio.run(main())


@pytest.mark.parametrize("wrong", [{"line_time": -1}, {"tick": 0}, {"startup_time": float("nan")}])
def test_options_are_checked(wrong: dict):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        KlippyOptions(**wrong)
