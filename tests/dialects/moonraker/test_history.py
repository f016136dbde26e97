"""The history of a real server, over HTTP."""

import asyncio
import json
import time
from collections.abc import Iterator
from typing import Any

import pytest
from tests.dialects.moonraker.live import config, machine, site, write_files
from tests.harness import Answer, Server, wait_until

HISTORY = "/server/history"
FILES = {"a.gcode": ["G28"], "b.gcode": ["G1 X1"], "gone.gcode": ["G1 X2"], "long.gcode": ["G4 P5"] * 20}


class Shop:
    """A server with one fast machine, which has jobs."""

    def __init__(self, server: Server) -> None:
        self.server = server

    def get(self, path: str) -> Answer:
        return self.server.client.request("GET", path)

    def list(self, query: str = "") -> list[dict[str, Any]]:
        answer = self.get(f"{HISTORY}/list{query}")
        assert answer.status == 200, answer
        return answer.json["result"]["jobs"]

    def print(self, name: str, status: str = "completed") -> str:
        """Prints a file and returns the job's id."""
        known = {job["job_id"] for job in self.list("?limit=0")}
        wait_until(self._free)
        answer = self.server.client.post(f"/printer/print/start?filename={name}")
        assert answer.status == 200, answer
        if status == "cancelled":
            wait_until(lambda: self.list("?limit=1")[0]["status"] == "in_progress")
            assert self.server.client.post("/printer/print/cancel").status == 200

        def ended() -> list[str]:
            return [
                job["job_id"] for job in self.list() if job["job_id"] not in known and job["status"] == status
            ]

        return wait_until(ended)[0]

    def _free(self) -> bool:
        status = self.get("/printer/objects/query?idle_timeout").json["result"]["status"]
        return status["idle_timeout"]["state"] == "Ready"


@pytest.fixture
def shop(tmp_path) -> Iterator[Shop]:
    write_files(tmp_path / "data", FILES)
    with Server(tmp_path, config(machine("edm", command_time=0.001))) as server:
        yield Shop(server)


def test_the_history(shop: Shop):
    assert shop.list() == []
    before = time.time()
    first, second = shop.print("a.gcode"), shop.print("gone.gcode")
    canceled = shop.print("long.gcode", "cancelled")
    shop.server.client.request("DELETE", "/server/files/gcodes/gone.gcode")

    jobs = shop.list()
    assert [job["job_id"] for job in jobs] == [canceled, second, first]
    assert [job["status"] for job in jobs] == ["cancelled", "completed", "completed"]
    assert [job["exists"] for job in jobs] == [True, False, True]
    job = jobs[-1]
    assert before < job["start_time"] <= job["end_time"] < time.time()
    assert (
        job["total_duration"]
        == job["print_duration"]
        == pytest.approx(job["end_time"] - job["start_time"], abs=2e-6)
    )
    fixed = {"user": None, "filename": "a.gcode", "filament_used": 0.0, "metadata": {}, "auxiliary_data": []}
    assert fixed.items() <= job.items()
    assert shop.get(f"{HISTORY}/job?uid={first}").json == {"result": {"job": job}}

    assert [job["job_id"] for job in shop.list("?order=asc&limit=1&start=1")] == [second]
    assert shop.list("?start=3") == []
    assert shop.get(f"{HISTORY}/list?limit=1").json["result"]["count"] == 3
    assert len(shop.list("?limit=0&start=-5")) == 3
    start = jobs[1]["start_time"]
    assert [job["job_id"] for job in shop.list(f"?since={start!r}")] == [canceled]
    assert [job["job_id"] for job in shop.list(f"?before={start!r}")] == [first]
    assert shop.get(f"{HISTORY}/list?order=up").status == 400

    totals = shop.get(f"{HISTORY}/totals").json["result"]
    assert totals["job_totals"]["total_jobs"] == 3
    assert totals["job_totals"]["total_time"] == pytest.approx(sum(job["total_duration"] for job in jobs))
    assert totals["job_totals"]["longest_job"] == max(job["total_duration"] for job in jobs)
    assert totals["auxiliary_totals"] == []

    # It is the same after a restart; what has been deleted is gone, and no id comes again.
    assert shop.get(f"{HISTORY}/job?uid=nope").status == 404
    delete = shop.server.client.request("DELETE", f"{HISTORY}/job?uid={canceled}")
    assert delete.json == {"result": {"deleted_jobs": [canceled]}}
    assert shop.server.client.request("DELETE", f"{HISTORY}/job?uid={canceled}").status == 404
    assert shop.server.client.request("DELETE", f"{HISTORY}/job").status == 400
    assert shop.server.stop() == 0
    shop.server.start()
    assert shop.list() == jobs[1:]
    third = shop.print("a.gcode")
    assert third[:6] > canceled[:6]
    deleted = shop.server.client.request("DELETE", f"{HISTORY}/job?all=true").json["result"]["deleted_jobs"]
    assert set(deleted) == {first, second, third}
    assert shop.list() == []
    assert shop.get(f"{HISTORY}/totals").json["result"]["job_totals"]["longest_job"] == 0.0


def test_jobs_of_every_api(shop: Shop):
    async def test() -> None:
        where = site(shop.server)
        wait_until(shop._free)
        async with where.client() as client:
            await client.call("server.info")

            async def told(action: str) -> Any:
                while True:
                    waiting = client.notifications
                    message = waiting.pop(0) if waiting else await client.message()
                    if message["method"] == "notify_history_changed":
                        assert message["params"][0]["action"] == action
                        return message["params"][0]["job"]

            wait_until(lambda: shop.server.client.post("/add-job", {"commands": ["G1 X1"] * 3}).json["ok"])
            added, finished = await told("added"), await told("finished")
            assert (added["status"], added["end_time"], added["filename"]) == ("in_progress", None, "")
            assert (finished["status"], finished["exists"]) == ("completed", False)
            assert added["job_id"] == finished["job_id"]

            wait_until(shop._free)
            queued = await client.call("server.job_queue.post_job", filenames=["a.gcode", "b.gcode"])
            ids = [job["job_id"] for job in queued["queued_jobs"]]
            # What only waited in the queue is no history.
            await client.call("server.job_queue.delete_job", job_ids=ids[1:])
            await client.call("server.job_queue.start")
            added = await told("added")
            assert (added["job_id"], added["filename"], added["exists"]) == (ids[0], "a.gcode", True)
            finished = await told("finished")
            assert finished["job_id"] == ids[0]
            jobs = (await client.call("server.history.list"))["jobs"]
            assert [job["job_id"] for job in jobs] == [ids[0], jobs[1]["job_id"]]
            assert (await client.call("server.history.get_job", uid=ids[1]))["code"] == -32601

            # A job that runs cannot be deleted.
            wait_until(shop._free)
            await client.call("printer.print.start", filename="long.gcode")
            await told("added")
            running = (await client.call("server.history.list", limit=1))["jobs"][0]
            refused = await client.call("server.history.delete_job", uid=running["job_id"])
            assert refused["code"] == 409
            await client.call("server.history.delete_job", all=True)
            left = (await client.call("server.history.list"))["jobs"]
            assert [job["job_id"] for job in left] == [running["job_id"]]
            assert "history" in json.dumps((await client.call("server.info"))["components"])

    asyncio.run(test())
