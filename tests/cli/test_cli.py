"""The command line as it is run (`toolpost.cli`)."""

import os
import re
import signal
import subprocess
import sys
import time

import pytest
from click.testing import CliRunner
from tests.harness import Client, Server, free_port, spark_config, toolpost, wait_until

from toolpost.cli import main

COMMANDS = [
    (),
    ("serve",),
    ("demo",),
    ("sim",),
    ("sim", "spark"),
    ("key",),
    ("key", "add"),
    ("key", "list"),
    ("key", "delete"),
]


def assert_one_line(done: subprocess.CompletedProcess[str], *words: str) -> None:
    """It ended with a failure and one line that says why."""
    assert done.returncode not in {0, None}
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("toolpost: ")
    assert [word for word in words if word not in done.stderr] == [], done.stderr
    assert "ready on" not in done.stdout


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help(command):
    done = CliRunner().invoke(main, [*command, "--help"], prog_name="toolpost")
    assert done.exit_code == 0
    assert done.stdout.startswith("Usage: toolpost")
    assert done.stderr == ""


def test_version():
    assert re.fullmatch(r"toolpost, version \d+\.\d+\.\d+\n", toolpost("--version").stdout)


@pytest.mark.parametrize(
    "command", [("nothing",), ("serve", "--nothing"), ("sim", "nothing"), ("key", "add")]
)
def test_wrong_usage(command):
    done = CliRunner().invoke(main, command, prog_name="toolpost")
    assert done.exit_code == 2
    assert "Usage:" in done.stderr


# serve


def test_one_ready_line_for_each_listener(tmp_path):
    config = """
    [server]
    listen = ["127.0.0.1:0", "[::1]:0"]
    [machines.edm]
    driver = "spark"
    link = "sim"
    listen = ["127.0.0.1:0"]
    """
    with Server(tmp_path, config, listeners=3) as server:
        lines = server.output.splitlines()
        assert len(lines) == 3
        assert all(
            re.fullmatch(r"toolpost: ready on http://(127\.0\.0\.1|\[::1\]):\d+", line) for line in lines
        )
        for listener in range(3):
            assert server.client_of(listener).post("/status", {}).status == 200


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_stops_with_status_0(tmp_path, number):
    with Server(tmp_path, spark_config()) as server:
        assert server.client.post("/status", {}).status == 200
        began = time.monotonic()
        assert server.stop(number) == 0
        assert time.monotonic() - began < 4
        assert "Traceback" not in server.log
        assert "ERROR" not in server.log


def test_start_is_quick_and_says_little(tmp_path):
    began = time.monotonic()
    with Server(tmp_path, spark_config()) as server:
        assert time.monotonic() - began < 5
        assert len(server.log.splitlines()) < 10


def test_default_configuration_serves_a_simulated_machine(tmp_path):
    port = free_port()
    command = [sys.executable, "-m", "toolpost", "serve", "--listen", f"127.0.0.1:{port}", "--data", tmp_path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout.readline() == f"toolpost: ready on http://127.0.0.1:{port}\n"
            client = Client(f"http://127.0.0.1:{port}")
            wait_until(lambda: client.call("/status")["device_alive"])
            client.close()
            process.send_signal(signal.SIGTERM)
            assert process.wait(10) == 0
        finally:
            process.kill()


def test_data_directory_of_a_user_who_names_none(tmp_path):
    environment = {**os.environ, "XDG_DATA_HOME": str(tmp_path)}
    command = [sys.executable, "-m", "toolpost", "key", "list"]
    subprocess.run(command, env=environment, check=True, timeout=20)
    assert (tmp_path / "toolpost").is_dir()


def test_listen_overrides_the_configuration(tmp_path):
    port = free_port()
    config = spark_config(listen="127.0.0.1:1")
    with Server(
        tmp_path, config, "--listen", f"127.0.0.1:{port}", "--listen", "[::1]:0", listeners=2
    ) as server:
        assert server.urls[0] == f"http://127.0.0.1:{port}"
        assert server.urls[1].startswith("http://[::1]:")


def test_second_server_on_a_data_directory(tmp_path):
    with Server(tmp_path, spark_config()) as server:
        pid = server.pid
        done = toolpost("serve", "--data", server.data, "--listen", "127.0.0.1:0")
        assert_one_line(done, str(server.data), f"process {pid}", "another Toolpost")
        assert server.client.post("/status", {}).status == 200


def test_second_server_on_an_address(tmp_path):
    with Server(tmp_path, spark_config()) as server:
        address = server.urls[0].removeprefix("http://")
        done = toolpost("serve", "--data", tmp_path / "other", "--listen", address)
        assert_one_line(done, f"cannot listen on {address}", "in use")
        assert server.client.post("/status", {}).status == 200


def test_start_after_a_refused_start(tmp_path):
    """A refused start leaves nothing behind that refuses the next."""
    with Server(tmp_path / "one", spark_config()) as server:
        address = server.urls[0].removeprefix("http://")
        other = tmp_path / "other"
        assert toolpost("serve", "--data", other, "--listen", address).returncode != 0
    with Server(tmp_path / "two", spark_config(), "--data", str(other)):
        pass


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["machines"]),
        ("[machines.edm]\ndriver = 'sprak'\nlink = 'sim'", ["machines.edm.driver", "sprak"]),
        ("[server]\nlistn = 1\n[machines.edm]\ndriver = 'spark'\nlink = 'sim'", ["server.listn", "listen"]),
        ("[server", ["toolpost.toml"]),
        (
            "[server]\nopen_networks = ['x']\n[machines.edm]\ndriver = 'spark'\nlink = 'sim'",
            ["server.open_networks"],
        ),
    ],
)
def test_wrong_configuration_is_one_line(tmp_path, text, words):
    path = tmp_path / "toolpost.toml"
    path.write_text(text)
    assert_one_line(toolpost("serve", "--config", path, "--data", tmp_path / "data"), *words)


@pytest.mark.parametrize("address", ["nowhere.invalid:1", "192.0.2.1:1"])
def test_address_that_is_not_to_be_had(tmp_path, address):
    done = toolpost("serve", "--listen", address, "--data", tmp_path)
    assert done.returncode == 1
    *warnings, last = done.stderr.splitlines()
    assert last.startswith(f"toolpost: cannot listen on {address}: ")
    assert all("WARNING" in line for line in warnings)


def test_configuration_that_is_not_there(tmp_path):
    assert_one_line(toolpost("serve", "--config", tmp_path / "none.toml", "--data", tmp_path), "none.toml")


@pytest.mark.parametrize("listen", ["nonsense", "127.0.0.1", "127.0.0.1:99999", ""])
def test_wrong_listen_option(tmp_path, listen):
    assert_one_line(toolpost("serve", "--listen", listen, "--data", tmp_path), "--listen", "HOST:PORT")


def test_data_directory_that_is_none(tmp_path):
    (tmp_path / "file").write_text("")
    assert_one_line(toolpost("serve", "--data", tmp_path / "file" / "data"), "data directory")
    assert_one_line(toolpost("key", "list", "--data", tmp_path / "file" / "data"), "data directory")


def test_damaged_database(tmp_path):
    (tmp_path / "toolpost.db").write_bytes(b"this is no database " * 100)
    assert_one_line(toolpost("serve", "--data", tmp_path, "--listen", "127.0.0.1:0"), "toolpost.db")


def test_machine_that_is_not_there_does_not_keep_the_server_from_starting(tmp_path):
    with Server(tmp_path, spark_config("/dev/no-such-device")) as server:
        assert server.client.call("/status")["device_alive"] is False
        wait_until(lambda: "/dev/no-such-device: no such device" in server.log)
        assert server.stop() == 0


# demo


def test_demo_ends_with_status_0():
    done = toolpost("demo", "--size", "200", timeout=60)
    assert done.returncode == 0, done.stderr
    assert "COMPLETED" in done.stdout
    assert done.stderr == ""


def test_demo_of_no_size_is_refused():
    assert toolpost("demo", "--size", "0").returncode == 2


# sim


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_simulated_core_starts_and_ends(tmp_path, number):
    link = tmp_path / "core"
    command = [sys.executable, "-m", "toolpost", "sim", "spark", "--link", link, "--command-time", "0"]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == f"toolpost: simulated spark core on {link}\n"
            with Server(tmp_path / "server", spark_config(str(link))) as server:
                wait_until(lambda: server.client.call("/status")["device_alive"])
            process.send_signal(number)
            assert process.wait(10) == 0
        finally:
            process.kill()
    assert not link.is_symlink()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--capacity", "0"), "capacity"),
        (("--command-time", "-1"), "command_time"),
        (("--fault", "explode"), "explode"),
    ],
)
def test_simulated_core_that_cannot_be(options, word):
    assert_one_line(toolpost("sim", "spark", *options), word)


def test_simulated_core_at_a_path_that_is_taken(tmp_path):
    (tmp_path / "core").write_text("mine")
    assert_one_line(toolpost("sim", "spark", "--link", tmp_path / "core"), "core")
    assert (tmp_path / "core").read_text() == "mine"


# key


def test_keys_of_a_running_server(tmp_path):
    config = spark_config(listen="0.0.0.0:0")
    with Server(tmp_path, config) as server:

        def status(key: str) -> int:
            return server.client.post("/status", {}, {"X-Api-Key": key}).status

        key = toolpost("key", "add", "phone", "--data", server.data).stdout.strip()
        other = toolpost("key", "add", "slicer", "--data", server.data).stdout.strip()
        assert re.fullmatch(r"[A-Za-z0-9_-]{43}", key)
        assert key != other
        assert (status(key), status(other)) == (200, 200)
        assert toolpost("key", "list", "--data", server.data).stdout.split() == ["phone", "slicer"]
        assert toolpost("key", "delete", "phone", "--data", server.data).returncode == 0
        assert (status(key), status(other)) == (401, 200), "at once"
        assert toolpost("key", "list", "--data", server.data).stdout.split() == ["slicer"]
        assert server.stop() == 0
        server.start()
        assert (status(key), status(other)) == (401, 200)


def test_name_of_a_key_that_is_taken_or_unknown(tmp_path):
    assert toolpost("key", "add", "phone", "--data", tmp_path).returncode == 0
    assert_one_line(toolpost("key", "add", "phone", "--data", tmp_path), "phone", "already")
    assert_one_line(toolpost("key", "delete", "fridge", "--data", tmp_path), "fridge", "no key")
