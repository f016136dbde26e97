"""What the nine calls do to the machine, for clients of both generations."""

import re
import time

import pytest
from tests.harness import Port, Server, wait_until

from toolpost.sim.options import SparkOptions

# /write-line


@pytest.mark.parametrize(
    ("line", "sent"),
    [
        ("G0 X1", "G0 X1"),
        ("  G0 X1\t", "G0 X1"),
        ("G0 X2 ; move", "G0 X2"),
        ("?pos", "?pos"),
        (" ?pos", "?pos"),
        ("?pos ; c", "?pos"),
        ("get", "get"),
        ("set a 1", "set a 1"),
        ("fset a 1", "fset a 1"),
        ("G" * 100, "G" * 100),
    ],
)
def test_line_is_trimmed_and_its_comment_stays_here(bench, received, line, sent):
    assert bench.client.call("/write-line", line=line)["ok"] is True
    wait_until(received)
    assert received() == [sent]


@pytest.mark.parametrize("line", ["", " ", ";", "; comment", "\t"])
def test_line_without_a_payload_is_taken_and_not_sent(bench, received, line):
    """docs/reference/spooler-api.md: the web client sends ``""`` for a line that was only a comment."""
    assert bench.client.call("/write-line", line=line)["ok"] is True
    bench.client.call("/write-line", line="?pos")
    wait_until(received)
    assert received() == ["?pos"]


def test_write_line_time_is_that_of_the_receipt(bench):
    before = time.time()
    answer = bench.client.call("/write-line", line="?pos")
    assert before - 0.001 <= answer["time"] <= time.time()
    assert answer["now"] == answer["time"]
    report = wait_until(lambda: bench.client.call("/get-ps", tag="pos")["pstates"])[0]
    assert wait_until(lambda: bench.client.call("/get-ps", tag="pos")["pstates"][0]["time"] > answer["time"])
    assert report.keys() == {"time", "kv"}


@pytest.mark.parametrize(
    ("request_", "ok"),
    [
        ({"line": "?pos"}, True),
        ({"line": "?pos", "high_prio": True}, True),
        ({"line": "?pos", "high_prio": None}, True),
        ({"line": "fset a 1", "high_prio": True}, True),
        ({"line": "G0 X5"}, False),
        ({"line": "G0 X5", "high_prio": False}, False),
        ({"line": "?pos", "high_prio": False}, False),
        ({"line": "; comment"}, False),
    ],
)
def test_while_a_job_runs_only_urgent_lines_are_taken(bench, received, request_, ok):
    assert bench.client.call("/add-job", commands=["G4 P5"])["ok"]
    wait_until(received)
    bench.port.trace.clear()
    assert bench.client.call("/write-line", **request_)["ok"] is ok
    if ok:
        wait_until(received)
    assert received() == ([request_["line"]] if ok else [])


@pytest.mark.parametrize("line", ["!", " ! ", "! ; stop"])
def test_bang_is_a_cancel(bench, received, line):
    """docs/reference/spooler-api.md S18: sent alone, the rest of the job would go on."""
    assert bench.client.call("/add-job", commands=["G4 P0.2"] * 200)["ok"]
    wait_until(received)
    assert bench.client.call("/write-line", line=line)["ok"] is True
    assert bench.last_job["status"] == "CANCELED"
    wait_until(lambda: "!" in received())
    time.sleep(0.2)
    assert received()[-1] == "!"


# /add-job, /list-jobs, /status, /cancel


def test_job_runs_to_completed(bench, received):
    commands = ["; header", "G0 X1 ; c", "", "  G0 X2", ";", "set a 1"]
    answer = bench.client.call("/add-job", commands=commands, signals={})
    assert answer["ok"] is True
    wait_until(lambda: bench.last_job["status"] == "COMPLETED")
    job = bench.last_job
    assert job["job_id"] == answer["job_id"]
    assert job["time_added"] <= job["time_started"] <= job["time_ended"] <= time.time()
    assert (job["num_commands"], job["num_sent"], job["num_executed"]) == (3, 3, 3)
    assert received() == ["G0 X1", "G0 X2", "set a 1"]
    assert "running_job" not in bench.client.call("/status")


def test_running_job_is_in_status_and_list(bench):
    job_id = bench.client.call("/add-job", commands=["G4 P5"] * 3)["job_id"]
    status = wait_until(lambda: (s := bench.client.call("/status")).get("running_job") and s)
    assert status["running_job"] == job_id
    assert status["busy"] is True
    assert status["num_pending_commands"] == 3 == sum(status["command_queue"].values())
    assert status["device_alive"] is True
    job = bench.last_job
    assert job["status"] == "RUNNING"
    assert "time_started" in job
    assert "time_ended" not in job


def test_only_one_job_at_a_time(bench):
    assert bench.client.call("/add-job", commands=["G4 P5"])["ok"]
    assert bench.client.call("/add-job", commands=["G0 X1"]) == {"ok": False}


def test_job_waits_for_direct_commands(bench, received):
    """docs/reference/spooler-api.md S9, B6: it is accepted, and never mixed with them."""
    assert bench.client.call("/write-line", line="G4 P0.2")["ok"]
    status = bench.client.call("/status")
    assert (status["busy"], status["num_pending_commands"]) == (True, 1)
    assert bench.client.call("/add-job", commands=["G0 X1", "G0 X2"])["ok"]
    job = bench.last_job
    assert job["status"] == "WAITING"
    assert not {"time_started", "time_ended"} & job.keys()
    assert bench.client.call("/status")["num_pending_commands"] == 3
    assert "running_job" not in bench.client.call("/status")
    wait_until(lambda: bench.last_job["status"] == "COMPLETED")
    assert received() == ["G4 P0.2", "G0 X1", "G0 X2"]


def test_job_without_commands_completes(bench):
    assert bench.run(commands=[])["status"] == "COMPLETED"
    assert bench.run(commands=["; nothing", ""])["status"] == "COMPLETED"


def test_cancel_of_a_running_job(bench, received):
    assert bench.client.call("/add-job", commands=["G4 P0.1"] * 500)["ok"]
    wait_until(received)
    assert bench.client.call("/cancel") == {}
    job = bench.last_job
    assert job["status"] == "CANCELED"
    assert job.keys() >= {"time_started", "time_ended"}
    status = bench.client.call("/status")
    assert (status["busy"], status["num_pending_commands"]) == (False, 0)
    wait_until(lambda: "!" in received())
    time.sleep(0.2)
    assert received()[-1] == "!"


def test_cancel_of_a_waiting_job(bench):
    bench.client.call("/write-line", line="G4 P5")
    bench.client.call("/add-job", commands=["G0 X1"])
    assert bench.client.call("/cancel") == {}
    assert bench.last_job["status"] == "CANCELED"
    assert "time_started" not in bench.last_job


def test_cancel_of_nothing_sends_bang(bench, received):
    assert bench.client.call("/cancel") == {}
    wait_until(received)
    assert received() == ["!"]


def test_job_added_right_after_a_cancel_runs(bench):
    """It waits for the end of the hold-off, and is not forgotten there."""
    for _ in range(5):
        bench.client.call("/cancel")
        assert bench.run(commands=["G0 X1"])["status"] == "COMPLETED"


def test_ids_are_unique(bench):
    for _ in range(5):
        bench.run(commands=["G0 X1"])
    ids = [job["job_id"] for job in bench.client.call("/list-jobs")["jobs"]]
    assert len(set(ids)) == len(ids) >= 5


def test_jobs_are_listed_in_the_order_of_adding(bench):
    bench.run(commands=["G0 X1"])
    bench.run(commands=["G0 X2"])
    times = [job["time_added"] for job in bench.client.call("/list-jobs")["jobs"]]
    assert times == sorted(times)


@pytest.mark.parametrize("field", ["signals", "polls"])
def test_signals_are_sent_at_the_start_and_at_their_interval(bench, received, field):
    bench.run(commands=["G4 P0.25"], **{field: {"?pos": 0.1, "?edm ; c": 10.0}})
    taken = received()
    assert 2 <= taken.count("?pos") <= 4
    assert taken.count("?edm") == 1


def test_signals_and_polls_together(bench, received):
    bench.run(commands=["G4 P0.05"], signals={"?pos": 9}, polls={"?edm": 9, "fset a 1": 9})
    assert sorted(received()) == ["?edm", "?pos", "G4 P0.05", "fset a 1"]


def test_signals_end_with_the_job(bench, received):
    bench.run(commands=["G4 P0.05"], signals={"?pos": 0.02})
    bench.port.trace.clear()
    time.sleep(0.1)
    assert received() == []


# /set-init, /get-init


@pytest.mark.parametrize("field", ["lines", "content"])
def test_init_lines_under_both_names(bench, received, field):
    """docs/reference/spooler-api.md S3, S4."""
    assert bench.client.call("/set-init", **{field: ["set a.b 1", "", " set c 2 ", "; kept"]}) == {}
    kept = ["set a.b 1", "set c 2", "; kept"]
    assert bench.client.call("/get-init") == {"lines": kept, "content": kept}
    assert received() == []


def test_no_init_lines_are_an_array(bench):
    assert bench.client.call("/set-init", lines=[]) == {}
    assert bench.client.call("/get-init") == {"lines": [], "content": []}


def test_refused_init_lines_leave_the_old_ones(bench):
    bench.client.call("/set-init", lines=["set a 1"])
    for request in ({}, {"lines": None}, {"lines": ["set a 2", "!"]}, {"content": ["a\nb"]}):
        assert bench.client.post("/set-init", request).status == 400
    assert bench.client.call("/get-init")["lines"] == ["set a 1"]


# /get-ps


def test_latest_reports_come_first(bench):
    for number in range(3):
        bench.say(f"gp < n:{number} >")
    got = bench.client.call("/get-ps", tag="gp", count=2)["pstates"]
    assert [report["kv"] for report in got] == [{"n": 2}, {"n": 1}]
    assert got[0]["time"] > got[1]["time"]
    assert len(bench.client.call("/get-ps", tag="gp")["pstates"]) == 1
    assert len(bench.client.call("/get-ps", tag="gp", count=None)["pstates"]) == 1
    assert len(bench.client.call("/get-ps", tag="gp", count=10_000)["pstates"]) == 3


def test_values_of_a_report(bench):
    report = bench.say('vals < f:0.1 h:0xffffffff s:"a\\"b" t:true u:false m.x:-2.5 nan:nan inf:inf >')
    expected = {"f": 0.1, "h": 0xFFFFFFFF, "s": 'a"b', "t": True, "u": False, "m.x": -2.5}
    assert {key: report["kv"][key] for key in expected} == expected
    assert report["kv"]["nan"] is None
    assert report["kv"]["inf"] is None


@pytest.mark.parametrize("tag", ["nothing", " queue", "queue ", "QUEUE", "é", "a.b"])
def test_unknown_tag_has_no_reports(bench, tag):
    assert bench.client.call("/get-ps", tag=tag) == {"pstates": []}


# /query-ts


def series(bench, start, end, step, *keys):
    answer = bench.client.call("/query-ts", start=start, end=end, step=step, query=list(keys))
    assert all(len(values) == len(answer["times"]) for values in answer["values"].values())
    return answer["times"], answer["values"]


def test_window_includes_both_of_its_ends(bench):
    at = bench.say("win < n:7 >")["time"]
    for start, expected in [(at, 7), (at + 0.5, 7), (at - 2e-6, None), (at + 0.500002, None), (at + 0.25, 7)]:
        assert series(bench, start, start, 0.5, "win.n") == ([pytest.approx(start)], {"win.n": [expected]})


def test_latest_in_the_window_is_taken_and_nothing_is_made_up(bench):
    first = bench.say("res < n:1 >")["time"]
    time.sleep(0.05)
    second = bench.say("res < n:2 >")["time"]
    assert series(bench, second, second, 10, "res.n")[1] == {"res.n": [2]}
    middle = (first + second) / 2
    assert series(bench, middle, middle, 10, "res.n")[1] == {"res.n": [1]}
    step = (second - first) / 4
    times, values = series(bench, first, first + 8 * step, step, "res.n")
    assert len(times) == 9
    assert values["res.n"][0] == 1
    assert set(values["res.n"]) == {1, 2, None}
    assert values["res.n"][-2:] == [None, None]


def test_every_kind_of_value_and_unknown_keys(bench):
    at = bench.say('kinds < f:0.5 s:"on" b:true h:0x10 nan:nan >')["time"]
    keys = [
        "kinds.f",
        "kinds.s",
        "kinds.b",
        "kinds.h",
        "kinds.nan",
        "kinds.x",
        "kinds",
        "x",
        "",
        ".",
        "a.b.c",
    ]
    values = series(bench, at, at, 1, *keys)[1]
    assert [values[key] for key in keys] == [[v] for v in [0.5, "on", True, 16, None] + [None] * 6]


def test_a_key_may_be_asked_for_twice(bench):
    at = bench.say("dup < n:1 >")["time"]
    assert series(bench, at, at, 1, "dup.n", "dup.n")[1] == {"dup.n": [1]}


def test_position_that_the_core_reports(bench):
    bench.run(commands=["G0 X5"])
    written = bench.client.call("/write-line", line="?pos")["time"]
    report = wait_until(
        lambda: (p := bench.client.call("/get-ps", tag="pos")["pstates"]) and p[0]["time"] > written and p[0]
    )
    assert report["kv"]["m.x"] == 5.0
    _, values = series(bench, report["time"], report["time"], 1, "pos.m.x", "pos.sys")
    assert values == {"pos.m.x": [5.0], "pos.sys": [report["kv"]["sys"]]}


@pytest.mark.parametrize(
    ("start", "end", "step", "count"),
    [
        (0, 0, 1, 1),
        (0, 1, 2, 1),
        (0, 1, 1, 2),
        (0, 0.3, 0.1, 4),
        (1735689600, 1735689601, 0.3, 4),
        (5, 6, 0.999, 2),
    ],
)
def test_times_go_from_start_to_end(bench, start, end, step, count):
    times, values = series(bench, start, end, step, "queue.num")
    assert times == pytest.approx([start + k * step for k in range(count)], abs=1e-6)
    assert values == {"queue.num": [None] * count}


# More than one machine, and machines that fail

TWO_MACHINES = """
[server]
listen = "127.0.0.1:0"
[machines.edm]
driver = "spark"
link = "{edm}"
[machines.edm.spark]
hold_off = 0.125
[machines.mill]
driver = "spark"
link = "{mill}"
listen = ["127.0.0.1:0"]
[machines.mill.spark]
hold_off = 0.125
[machines.mill.spooler]
failed = "CANCELED"
"""


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two")
    options = SparkOptions(command_time=0.001, hold_off=0.1)
    with (
        Port(options, traced=True) as edm,
        Port(options, traced=True) as mill,
        Server(folder, TWO_MACHINES.format(edm=edm.path, mill=mill.path), listeners=2) as server,
    ):
        for prefix in ("", "/machines/mill"):
            wait_until(lambda prefix=prefix: server.client.call(f"{prefix}/status")["device_alive"])
        yield server, edm, mill


def executed(port):
    return [line.decode() for event, line in list(port.trace) if event == "executed"]


def test_each_machine_has_its_paths(two):
    server, edm, mill = two
    main, own = server.client, server.client_of(1)
    for port in (edm, mill):
        port.trace.clear()
    for client, path, number in [
        (main, "", 1),
        (main, "/machines/edm", 2),
        (main, "/machines/mill", 3),
        (own, "", 4),
    ]:
        assert client.call(f"{path}/add-job", commands=[f"G0 X{number}"])["ok"]
        wait_until(lambda c=client, p=path: c.call(f"{p}/list-jobs")["jobs"][-1]["status"] == "COMPLETED")
    assert (executed(edm), executed(mill)) == (["G0 X1", "G0 X2"], ["G0 X3", "G0 X4"])
    for path in ("/list-jobs", "/get-init"):
        assert main.call(path) == main.call(f"/machines/edm{path}") != {}
        assert own.call(path) == main.call(f"/machines/mill{path}")
    assert main.call("/list-jobs") != own.call("/list-jobs")


def test_reports_and_init_lines_belong_to_one_machine(two):
    server, _edm, mill = two
    main, own = server.client, server.client_of(1)
    own.call("/set-init", lines=["set mill 1"])
    assert main.call("/get-init")["lines"] == []
    mill.say(b"only < n:1 >\r\n")
    wait_until(lambda: own.call("/get-ps", tag="only")["pstates"])
    assert main.call("/get-ps", tag="only")["pstates"] == []


@pytest.mark.parametrize("path", ["/machines/mill/status", "/machines/edm/status"])
def test_a_machines_own_listener_serves_it_alone(two, path):
    assert two[0].client_of(1).post(path, {}).status == 404


@pytest.mark.parametrize(
    "path",
    ["/machines/none/status", "/machines/", "/machines", "/machines/mill", "/machines/mill/", "/Status"],
)
def test_unknown_paths_are_404(two, path):
    answer = two[0].client.post(path, {})
    assert answer.status == 404
    assert answer.headers["content-type"].startswith("text/plain")


def test_failed_job_is_called_as_the_machine_is_configured(two):
    server, edm, mill = two
    for port, client, word in ((edm, server.client, "FAILED"), (mill, server.client_of(1), "CANCELED")):
        assert client.call("/add-job", commands=["G4 P10"])["ok"]
        wait_until(lambda p=port: p.core.queue_length)
        port.inject("reboot")
        wait_until(lambda c=client: "time_ended" in c.call("/list-jobs")["jobs"][-1])
        job = client.call("/list-jobs")["jobs"][-1]
        assert job["status"] == word
        assert job["reason"] == "machine-reset"
        assert re.search("boot", job["detail"])


def test_dead_core_is_seen_and_gets_nothing(two):
    """docs/reference/spooler-api.md B21. The last test of this machine: it stays mute."""
    server, edm, _mill = two
    client = server.client
    wait_until(lambda: client.call("/status")["device_alive"])
    edm.inject("mute")
    wait_until(lambda: client.call("/status")["device_alive"] is False)
    assert client.call("/add-job", commands=["G0 X1"]) == {"ok": False}
    assert client.call("/write-line", line="G0 X1")["ok"] is False
    assert client.call("/status")["busy"] is False
    assert client.call("/cancel") == {}
    assert server.client_of(1).call("/status")["device_alive"] is True
