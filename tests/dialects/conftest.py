"""Fixtures of the dialects' tests."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from tests.harness import Client, Port, Server, spark_config, wait_until

from toolpost.sim.options import SparkOptions

ENDED = {"COMPLETED", "CANCELED", "FAILED"}


class Bench(NamedTuple):
    """A server, the core that it drives, and a client."""

    server: Server
    port: Port
    client: Client

    @property
    def last_job(self) -> dict[str, Any]:
        jobs: list[dict[str, Any]] = self.client.call("/list-jobs")["jobs"]
        return jobs[-1]

    def settle(self) -> None:
        """Returns when nothing waits or runs any more."""
        if self.client.call("/status")["busy"]:
            self.client.call("/cancel")
        wait_until(self.is_idle)

    def is_idle(self) -> bool:
        status = self.client.call("/status")
        jobs = self.client.call("/list-jobs")["jobs"]
        idle = status["device_alive"] and not status["busy"]
        return idle and all(job["status"] in ENDED for job in jobs)

    def run(self, **job: Any) -> dict[str, Any]:
        """Runs a job and returns what it ended as."""
        assert self.client.call("/add-job", **job)["ok"]
        wait_until(lambda: self.last_job["status"] in ENDED)
        return self.last_job

    def say(self, line: str) -> dict[str, Any]:
        """Has the core report, and returns the report."""
        tag = line.split()[0]

        def newest() -> list[dict[str, Any]]:
            return self.client.call("/get-ps", tag=tag)["pstates"]

        before = newest()
        self.port.say(line.encode() + b"\r\n")
        return wait_until(lambda: (now := newest()) != before and now)[0]


@pytest.fixture(scope="session")
def _bench(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("bench")
    options = SparkOptions(command_time=0.001, hold_off=0.1)
    with Port(options, traced=True) as port, Server(folder, spark_config(port.path)) as server:
        bench = Bench(server, port, server.client)
        wait_until(bench.is_idle)
        yield bench


@pytest.fixture
def bench(_bench: Bench):
    """A server on a simulated core, idle at the start of each test; commands take 1 ms, dwells their time."""
    _bench.settle()
    _bench.port.trace.clear()
    return _bench


@pytest.fixture
def received(bench: Bench) -> Callable[[], list[str]]:
    """What the core has received in this test, without ``?queue``."""

    def lines() -> list[str]:
        taken = [line.decode() for event, line in list(bench.port.trace) if event == "received"]
        return [line for line in taken if line != "?queue"]

    return lines
