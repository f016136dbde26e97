"""A full disk: what needs the disk is refused with words, and what runs goes on."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.harness import Port, Server, spark_config, wait_until
from toolpost.sim.options import SparkOptions


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 8 MB; only root may mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("a file system can be mounted by root only")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(folder: Path) -> Path:
    path = folder / "ballast"
    with path.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(b"x" * 4096)
        except OSError:
            pass
    return path


def test_a_full_disk_refuses_what_needs_it_and_the_running_job_goes_on(small_disk, tmp_path):
    core = SparkOptions(command_time=0.002, hold_off=0.0)
    with Port(core, link=tmp_path / "core") as port, Server(small_disk, spark_config(port.path)) as server:
        wait_until(lambda: server.client.call("/status")["device_alive"])
        server.client.call("/set-init", lines=["set a.b 1"])
        assert server.client.call("/add-job", commands=["G1 X1"] * 500)["ok"]
        wait_until(lambda: port.core.executed > 5)
        ballast = fill(small_disk)

        # What is in the database's log may still fit into space that it has already.
        answers = [server.client.post("/set-init", {"lines": ["set a.b 2"] * 20_000}) for _ in range(3)]
        assert answers[-1].status == 500
        assert "stored" in answers[-1].text
        assert server.client.call("/get-init")["lines"] == ["set a.b 1"]

        wait_until(lambda: port.core.executed == 500)
        wait_until(lambda: server.client.call("/list-jobs")["jobs"][0]["status"] == "COMPLETED")

        answer = server.client.post("/add-job", {"commands": ["G1 X2"] * 100_000})
        assert answer.status == 500
        assert "stored" in answer.text
        assert len(server.client.call("/list-jobs")["jobs"]) == 1
        assert server.client.call("/status")["device_alive"]

        ballast.unlink()
        assert wait_until(lambda: server.client.call("/add-job", commands=["G1 X3"])["ok"])
        wait_until(lambda: server.client.call("/list-jobs")["jobs"][-1]["status"] == "COMPLETED")
        server.kill()
        server.start()
        assert [job["status"] for job in server.client.call("/list-jobs")["jobs"]] == ["COMPLETED"] * 2


def test_a_cancel_on_a_full_disk_stops_the_machine_all_the_same(small_disk, tmp_path):
    core = SparkOptions(command_time=0.002, hold_off=0.0)
    with Port(core, link=tmp_path / "core") as port, Server(small_disk, spark_config(port.path)) as server:
        wait_until(lambda: server.client.call("/status")["device_alive"])
        assert server.client.call("/add-job", commands=["G1 X1"] * 5000)["ok"]
        wait_until(lambda: port.core.executed > 5)
        ballast = fill(small_disk)
        answer = server.client.post("/cancel", {})
        assert answer.status in {200, 500}
        wait_until(lambda: port.core.last_bang_at is not None)
        assert port.core.commands_after_bang == 0
        assert server.client.call("/list-jobs")["jobs"][0]["status"] == "CANCELED"
        ballast.unlink()
        wait_until(lambda: server.client.post("/set-init", {"lines": ["set a.b 1"]}).status == 200)
