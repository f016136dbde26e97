"""kill -9 at random instants: nothing acknowledged is missing, no job runs twice, the state shown is true."""

import contextlib
import http.client
import random
import threading
import time
from collections import Counter

import pytest

from tests.harness import Client, Port, Server, spark_config, wait_until
from toolpost.sim.options import SparkOptions

QUICK_KILLS = 60
SOAK_KILLS = 500
WORST_MOMENT = 0.06
UNREACHABLE = (OSError, http.client.HTTPException)


class Workshop:
    """What a person did and was told, beside what the core was sent and did."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.acknowledged: dict[str, int] = {}  # job id -> the number in its commands
        self.canceled: set[str] = set()
        self.init_acknowledged: list[str] = []
        self.init_in_doubt: list[list[str]] = []
        self.jobs_sent = 0

    def work(self, url: str) -> None:
        """Adds jobs, cancels and sets init lines until the server is gone."""
        client = Client(url)
        with contextlib.suppress(*UNREACHABLE):
            while True:
                action = self.random.choice([self.add, self.add, self.add, self.cancel, self.set_init])
                action(client)
                time.sleep(self.random.choice([0, 0, 0.003, 0.02]))
        client.close()

    def add(self, client: Client) -> None:
        self.jobs_sent += 1
        number = self.jobs_sent
        commands = [f"G1 X{number} Y{line}" for line in range(self.random.choice([1, 3, 40, 400]))]
        answer = client.call("/add-job", commands=commands)
        if answer["ok"]:
            self.acknowledged[answer["job_id"]] = number

    def cancel(self, client: Client) -> None:
        running = {job["job_id"] for job in client.call("/list-jobs")["jobs"] if "time_ended" not in job}
        client.call("/cancel")
        ended = {job["job_id"] for job in client.call("/list-jobs")["jobs"] if job["status"] == "CANCELED"}
        self.canceled |= running & ended

    def set_init(self, client: Client) -> None:
        lines = [f"set a.b {self.random.randrange(1000)}"]
        self.init_in_doubt.append(lines)
        client.call("/set-init", lines=lines)
        self.init_acknowledged = lines
        self.init_in_doubt.clear()

    def check(self, server: Server, port: Port) -> None:
        """Holds what the server says after its restart against what is known."""
        client = server.client
        listed = client.call("/list-jobs")["jobs"]
        jobs = {job["job_id"]: job for job in listed}
        assert len(jobs) == len(listed)
        assert self.acknowledged.keys() <= jobs.keys(), "an acknowledged job is missing"

        received = Counter(line for event, line in port.trace if event == "received")
        executed = Counter(line for event, line in port.trace if event == "executed")
        twice = [line for line, count in received.items() if line[:1] == b"G" and count > 1]
        assert not twice, "a command was sent twice"
        arrived = Counter(int(line.split()[1][1:]) for line in received if line[:1] == b"G")
        done = Counter(int(line.split()[1][1:]) for line in executed if line[:1] == b"G")
        for job_id, number in self.acknowledged.items():
            job = jobs[job_id]
            if job["status"] == "COMPLETED":
                assert done[number] == job["num_commands"], "completed means completed"
            if job["status"] == "WAITING" or "time_started" not in job:
                assert arrived[number] == 0, "a job that never started was sent"
            if arrived[number]:
                assert "time_started" in job, "a start was forgotten"
            if job_id in self.canceled:
                assert job["status"] == "CANCELED", "a cancel was forgotten"
            if job["status"] == "RUNNING":
                assert job["reason"] == "host-restarted"

        stored = client.call("/get-init")["lines"]
        assert stored in [self.init_acknowledged, *self.init_in_doubt]
        self.init_acknowledged = stored
        self.init_in_doubt.clear()


@pytest.mark.parametrize(
    "kills",
    [
        pytest.param(QUICK_KILLS, id="quick"),
        pytest.param(SOAK_KILLS, id="soak", marks=[pytest.mark.soak, pytest.mark.timeout(3600)]),
    ],
)
def test_kill_9_at_any_instant(tmp_path, kills):
    workshop = Workshop(seed=kills)
    core = SparkOptions(command_time=0.0005, hold_off=0.0)
    more = "[machines.edm.history]\nshown = 100000"
    config = spark_config(str(tmp_path / "core"), more=more).replace("hold_off = 0.05", "hold_off = 0.001")
    with Port(core, link=tmp_path / "core", traced=True) as port, Server(tmp_path, config) as server:
        for _ in range(kills):
            worker = threading.Thread(target=workshop.work, args=(server.urls[0],))
            worker.start()
            time.sleep(workshop.random.random() * WORST_MOMENT)
            server.kill()
            worker.join()
            server.start()
            workshop.check(server, port)
            wait_until(lambda: server.client.call("/status")["device_alive"])
            server.client.call("/cancel")
    assert workshop.acknowledged
    assert len(workshop.acknowledged) > kills / 4


def test_after_a_crash_a_started_job_waits_for_a_person_and_cancel_abandons_it(tmp_path):
    core = SparkOptions(command_time=0.01, hold_off=0.0)
    with Port(core, link=tmp_path / "core") as port, Server(tmp_path, spark_config(port.path)) as server:
        wait_until(lambda: server.client.call("/status")["device_alive"])
        added = server.client.call("/add-job", commands=[f"G1 X{i}" for i in range(5000)])
        wait_until(lambda: port.core.executed > 10)
        server.kill()
        server.start()
        job = server.client.call("/list-jobs")["jobs"][0]
        assert (job["job_id"], job["status"]) == (added["job_id"], "RUNNING")
        assert job["reason"] == "host-restarted"
        assert server.client.call("/status")["running_job"] == added["job_id"]
        assert not server.client.call("/add-job", commands=["G1 X1"])["ok"]
        wait_until(lambda: port.core.queue_length == 0)
        sent = port.core.received
        time.sleep(0.3)
        assert port.core.received == sent, "it went on by itself"
        server.client.call("/cancel")
        assert server.client.call("/list-jobs")["jobs"][0]["status"] == "CANCELED"
        assert wait_until(lambda: server.client.call("/add-job", commands=["G1 X1"])["ok"])


def test_a_job_that_had_not_started_is_held_after_a_crash(tmp_path):
    core = SparkOptions(command_time=0.05, hold_off=0.0)
    with Port(core, link=tmp_path / "core") as port, Server(tmp_path, spark_config(port.path)) as server:
        wait_until(lambda: server.client.call("/status")["device_alive"])
        server.client.call("/write-line", line="G4 P3")
        assert server.client.call("/add-job", commands=["G1 X7"])["ok"]
        server.kill()
        server.start()
        job = server.client.call("/list-jobs")["jobs"][0]
        assert (job["status"], job["reason"]) == ("WAITING", "host-restarted")
        assert "time_started" not in job


def test_a_job_that_had_not_started_goes_on_waiting_where_the_queue_loads_on_startup(tmp_path):
    core = SparkOptions(command_time=0.05, hold_off=0.0)
    more = "[machines.edm.queue]\nload_on_startup = true"
    config = spark_config(str(tmp_path / "core"), more=more)
    with Port(core, link=tmp_path / "core") as port, Server(tmp_path, config) as server:
        wait_until(lambda: server.client.call("/status")["device_alive"])
        server.client.call("/write-line", line="G4 P1")
        assert server.client.call("/add-job", commands=["G1 X7"])["ok"]
        server.kill()
        server.start()
        wait_until(lambda: server.client.call("/list-jobs")["jobs"][0]["status"] == "COMPLETED")
        assert port.core.executed == 2


def test_sigterm_stops_the_core_and_the_job_is_aborted(tmp_path):
    core = SparkOptions(command_time=0.01, hold_off=0.0)
    with Port(core, link=tmp_path / "core") as port, Server(tmp_path, spark_config(port.path)) as server:
        wait_until(lambda: server.client.call("/status")["device_alive"])
        server.client.call("/add-job", commands=[f"G1 X{i}" for i in range(5000)])
        wait_until(lambda: port.core.executed > 10)
        assert server.stop() == 0
        assert port.core.last_bang_at is not None
        assert port.core.commands_after_bang == 0
        assert port.core.queue_length == 0
        server.start()
        job = server.client.call("/list-jobs")["jobs"][0]
        assert (job["status"], job["reason"]) == ("FAILED", "host-stopped")
