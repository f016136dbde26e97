"""A wall clock that jumps: order, ends and telemetry do not rest on it."""

import asyncio
import time
from pathlib import Path

import pytest

from tests.harness import Client
from toolpost.app import App
from toolpost.config import Address, parse

YEAR = 365 * 86_400
CONFIG = {
    "machines": {
        "edm": {
            "driver": "spark",
            "link": "sim",
            "sim": {"command_time": 0.001, "hold_off": 0.0},
            "spark": {"hold_off": 0.01},
        }
    }
}


@pytest.mark.parametrize("jumps", [(-YEAR, -3), (YEAR, 2 * YEAR), (2, -2), (20 * YEAR, -20 * YEAR)])
def test_jobs_and_telemetry_survive_a_mad_clock(tmp_path: Path, monkeypatch, jumps):
    real = time.time_ns
    offset = 0
    monkeypatch.setattr("toolpost.clock.time.time_ns", lambda: real() + offset * 10**9)

    def work(url: str) -> None:
        nonlocal offset
        client = Client(url)
        for jump in (0, *jumps):
            offset += jump
            added = client.call("/add-job", commands=["G1 X1"] * 20, signals={"?pos": 0.02})
            assert added["ok"]
            while (job := client.call("/list-jobs")["jobs"][-1])["status"] in {"WAITING", "RUNNING"}:
                time.sleep(0.005)
            assert (job["job_id"], job["status"]) == (added["job_id"], "COMPLETED")
            assert client.call("/status")["time"] == pytest.approx(real() / 1e9 + offset, abs=5)
            now = int(client.call("/status")["time"])
            answer = client.call("/query-ts", start=now - 60, end=now, step=1, query=["pos.m.x"])
            assert len(answer["times"]) == 61
        jobs = client.call("/list-jobs")["jobs"]
        assert len({job["job_id"] for job in jobs}) == 3
        assert client.call("/get-ps", tag="queue", count=5)["pstates"]
        client.close()

    async def run() -> None:
        urls: asyncio.Queue[str] = asyncio.Queue()
        app = App(parse(CONFIG), tmp_path, [Address("127.0.0.1", 0)])
        serving = asyncio.create_task(app.run(urls.put_nowait))
        try:
            await asyncio.to_thread(work, await urls.get())
        finally:
            app.stop()
            await serving

    asyncio.run(run())
