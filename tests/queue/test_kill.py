"""kill -9 of a server with jobs queued, loading, starting and running: the queue that is back is true."""

import contextlib
import http.client
import random
import threading
import time
from collections import Counter

import pytest

from tests.harness import Client, Port, Server, spark_config, wait_until
from toolpost.sim.options import SparkOptions

QUICK_KILLS = 30
SOAK_KILLS = 300
WORST_MOMENT = 0.12
UNREACHABLE = (OSError, http.client.HTTPException)
QUEUE = """
[machines.edm.queue]
automatic_transition = {auto}
job_transition_delay = 0.003
job_transition_gcode = "M5"
[machines.edm.history]
shown = 100000
"""


def config(tmp_path, *, auto):
    more = QUEUE.format(auto="true" if auto else "false")
    return spark_config(str(tmp_path / "core"), more=more).replace("hold_off = 0.125", "hold_off = 0.001")


def status(client):
    answer = client.request("GET", "/server/job_queue/status")
    assert answer.status == 200, answer
    return answer.json["result"]


class Person:
    """Who uses the queue over Moonraker's API, and remembers what was acknowledged."""

    def __init__(self, server: Server, port: Port, seed: int) -> None:
        self.server, self.port = server, port
        self.random = random.Random(seed)
        self.files = 0
        self.order: list[str] = []  # ids that were acknowledged and not removed, in the queue's order
        self.orders: list[list[str]] = []  # what it may be too, if the last call was not answered
        self.numbers: dict[str, int] = {}  # id -> the number in its commands
        self.removed: set[str] = set()
        self.doubtful: set[str] = set()
        self.paused = False
        self.answers: Counter[str] = Counter()
        self.seen: Counter[str] = Counter()

    def work(self, url: str) -> None:
        """Uses the queue until the server is gone."""
        client = Client(url)
        actions = [
            self.post,
            self.post,
            self.post,
            self.start,
            self.start,
            self.pause,
            self.jump,
            self.remove,
        ]
        with contextlib.suppress(*UNREACHABLE):
            while True:
                self.random.choice(actions)(client)
                time.sleep(self.random.choice([0, 0, 0.002, 0.01]))
        client.close()

    def call(self, client, method, path, body=None):
        answer = client.post(path, body) if method == "POST" else client.request(method, path)
        result = answer.json.get("result")
        if answer.status == 200:
            self.answers[result["queue_state"]] += 1
        return result

    def post(self, client):
        names = {}
        for _ in range(self.random.choice([1, 1, 3])):
            self.files += 1
            names[f"{self.files}.gcode"] = self.files
            lines = range(self.random.choice([1, 3, 40]))
            text = "".join(f"G1 X{self.files} Y{line}\n" for line in lines)
            (self.server.data / "gcodes" / f"{self.files}.gcode").write_text(text)
        result = self.call(client, "POST", "/server/job_queue/job", {"filenames": list(names)})
        # Those that have left it already are not counted: nobody knows their ids.
        for job in result["queued_jobs"]:
            if job["filename"] in names:
                self.numbers[job["job_id"]] = names[job["filename"]]
                self.order.append(job["job_id"])

    def start(self, client):
        self.paused = False
        self.call(client, "POST", "/server/job_queue/start")

    def pause(self, client):
        result = self.call(client, "POST", "/server/job_queue/pause")
        assert result["queue_state"] == "paused"
        self.paused = True

    def jump(self, client):
        if not self.order:
            return
        job_id = self.random.choice(self.order[-5:])
        jumped = [job_id, *(other for other in self.order if other != job_id)]
        self.orders = [jumped]
        if self.call(client, "POST", f"/server/job_queue/jump?job_id={job_id}") is not None:
            self.order = jumped
        self.orders = []

    def remove(self, client):
        if not self.order:
            return
        job_id = self.random.choice(self.order[-5:])
        listed = job_id in [job["job_id"] for job in status(client)["queued_jobs"]]
        self.doubtful.add(job_id)
        result = self.call(client, "DELETE", f"/server/job_queue/job?job_ids={job_id}")
        assert job_id not in [job["job_id"] for job in result["queued_jobs"]]
        self.doubtful.discard(job_id)
        if listed:
            self.removed.add(job_id)

    def check(self, before: int) -> None:
        """Holds what the server says after its restart against what is known."""
        client = self.server.client
        queue = status(client)
        waiting = [job["job_id"] for job in queue["queued_jobs"]]
        listed = client.call("/list-jobs")["jobs"]
        jobs = {job["job_id"]: job for job in listed}
        assert len(jobs) == len(listed)
        assert set(self.numbers) <= set(jobs), "an acknowledged job is missing"
        assert set(waiting) <= set(jobs), "the same id from the queue to the history"
        self.seen.update(job["status"] for job in listed)

        known = [job_id for job_id in waiting if job_id in self.numbers]
        orders = [self.order, *self.orders]
        assert known in [[job_id for job_id in order if job_id in known] for order in orders], "order"
        assert not self.removed & set(waiting), "a removal was forgotten"
        assert queue["queue_state"] in {"ready", "paused"}
        if self.paused or not waiting:
            assert queue["queue_state"] == "paused"
        for job_id in set(self.numbers) - set(waiting) - self.removed - self.doubtful:
            assert "time_started" in jobs[job_id], "a job left the queue without being started"

        received = Counter(line for event, line in self.port.trace if event == "received")
        assert not [line for line, count in received.items() if line[:1] == b"G" and count > 1], "sent twice"
        arrived = Counter(int(line.split()[1][1:]) for line in received if line[:1] == b"G")
        for job_id, number in self.numbers.items():
            job = jobs[job_id]
            if "time_started" not in job:
                assert arrived[number] == 0, "a job that never started was sent"
            if job["status"] == "COMPLETED":
                assert arrived[number] == job["num_commands"]
            if job["status"] == "RUNNING":
                assert job["reason"] == "host-restarted"
        running = [job for job in listed if job["status"] == "RUNNING"]
        assert len(running) <= 1
        assert self.commands == before, "something started by itself"
        self.order, self.orders = waiting, []
        for job in queue["queued_jobs"]:
            self.numbers.setdefault(job["job_id"], int(job["filename"].split(".")[0]))
        self.removed |= {job_id for job_id in self.doubtful if job_id not in waiting}
        self.doubtful.clear()

    @property
    def commands(self) -> int:
        return self.port.core.received


@pytest.mark.parametrize(
    "kills",
    [
        pytest.param(QUICK_KILLS, id="quick"),
        pytest.param(SOAK_KILLS, id="soak", marks=[pytest.mark.soak, pytest.mark.timeout(3600)]),
    ],
)
def test_kill_9_with_a_queue_at_work(tmp_path, kills):
    core = SparkOptions(command_time=0.0005, hold_off=0.0)
    link = tmp_path / "core"
    with Port(core, link=link, traced=True) as port, Server(tmp_path, config(tmp_path, auto=True)) as server:
        person = Person(server, port, seed=kills)
        for _ in range(kills):
            wait_until(lambda: server.client.call("/status")["device_alive"])
            worker = threading.Thread(target=person.work, args=(server.urls[0],))
            worker.start()
            time.sleep(person.random.random() * WORST_MOMENT)
            server.kill()
            worker.join()
            # What had left the server arrives and is executed.
            before = -1
            while before != port.core.received or port.core.queue_length:
                before = port.core.received
                time.sleep(0.02)
            server.start()
            person.check(before)
            assert server.client.call("/cancel") is not None
            person.paused = False
    assert len(person.numbers) > kills
    assert {"ready", "paused", "loading"} <= set(person.answers), person.answers
    assert person.seen["COMPLETED"], person.seen
    assert person.seen["RUNNING"], person.seen


@pytest.mark.parametrize("auto", [True, False])
def test_state_order_and_ids_are_back_after_a_kill(tmp_path, auto):
    core = SparkOptions(command_time=0.02, hold_off=0.0)
    link = tmp_path / "core"
    with Port(core, link=link) as port, Server(tmp_path, config(tmp_path, auto=auto)) as server:
        for name in "abcd":
            (server.data / "gcodes" / f"{name}.gcode").write_text("G1 X1\n" * 50)

        def post(path, body=None):
            answer = server.client.post(f"/server/job_queue/{path}", body)
            assert answer.status == 200, answer
            return answer.json["result"]

        wait_until(lambda: server.client.call("/status")["device_alive"])
        listed = post("job", {"filenames": ["a.gcode", "b.gcode", "c.gcode", "d.gcode"]})["queued_jobs"]
        post("start")
        wait_until(lambda: server.client.call("/status").get("running_job"))
        post(f"jump?job_id={listed[3]['job_id']}")
        ready = post("start")
        assert ready["queue_state"] == "ready"
        server.kill()
        server.start()
        back = status(server.client)
        assert back["queue_state"] == "ready"
        assert [job["filename"] for job in back["queued_jobs"]] == ["d.gcode", "b.gcode", "c.gcode"]
        for old, new in zip(ready["queued_jobs"], back["queued_jobs"], strict=True):
            assert old | {"time_in_queue": 0} == new | {"time_in_queue": 0}
        assert post("pause")["queue_state"] == "paused"
        server.kill()
        server.start()
        assert status(server.client) | {"queued_jobs": 0} == {"queue_state": "paused", "queued_jobs": 0}
        wait_until(lambda: port.core.queue_length == 0)
        sent = port.core.received
        time.sleep(0.2)
        assert port.core.received == sent
