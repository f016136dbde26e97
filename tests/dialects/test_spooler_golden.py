"""Every recorded request of the original spooler, sent to a real server (tests/golden/spooler.jsonl)."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from tests.harness import Port, Server, spark_config, wait_until

from toolpost.sim.options import SparkOptions

GOLDEN = Path(__file__).parents[1] / "golden" / "spooler.jsonl"
RECORDS = [
    record for line in GOLDEN.read_text("utf-8").splitlines() if "request" in (record := json.loads(line))
]
ENDED = {"COMPLETED", "CANCELED", "FAILED"}
LOOSE = {"time", "now", "job_id", "time_added", "time_started", "time_ended", "kv"}


class Differs(NamedTuple):
    """An answer that deliberately differs from the original's.

    ``S`` and ``B`` numbers are those of the comparison in docs/reference/spooler-api.md.
    """

    status: int
    why: str
    body: Any = None  # what a 200 holds at least; None: not looked at


NOT_APPLICABLE = {
    "get-init.handmade": "there is no file to edit by hand: init lines are in the database",
    "get-init.isdir": "the same",
}

NO_COMMANDS = "a job without commands is a mistake; the schema requires them"
NO_LINES = "S3, B17: it would empty the init lines"
GARBAGE = "trailing garbage is a malformed request"
BYTES = "S7, B16: only 0x20-0x7e goes to the wire"
NOTHING = {"values": {f"t.{key}": [None] for key in ("f", "h", "s", "b", "z", "big")}}
THIRTY_SIX_THOUSAND = {
    "times": [0.0, 3600.1, 7200.2, 10800.3, 14400.4, 18000.5, 21600.6, 25200.7, 28800.8, 32400.9, 36001.0],
    "values": {"queue.num": [None] * 11},
}

DIFFERENT = {
    "*.GET": Differs(400, "S13: the document knows no 405"),
    "*.PUT": Differs(400, "S13: the document knows no 405"),
    "*.OPTIONS": Differs(403, "B13: http://evil.example is no allowed Origin"),
    "*.text-plain": Differs(400, "B13: a page of any site can send it without a preflight"),
    "*.trailing-garbage": Differs(400, GARBAGE),
    "status.job-waiting": Differs(200, "S11: a waiting job counts", {"busy": True}),
    "status.job-running": Differs(200, "B3: it is not completed yet", {"busy": True}),
    "status.after-cancel": Differs(200, "no stale count of what was dropped", {"num_pending_commands": 0}),
    "write-line.empty": Differs(200, "the web client sends comment-only lines so", {"ok": True}),
    "write-line.cr": Differs(400, BYTES),
    "write-line.nonascii": Differs(400, BYTES),
    "write-line.emoji": Differs(400, BYTES),
    "write-line.surrogate": Differs(400, BYTES),
    "write-line.cmd-while-running": Differs(200, "B3: the job still runs", {"ok": False}),
    "write-line.comment-while-running": Differs(200, "B3: the job still runs", {"ok": False}),
    "set-init.null": Differs(400, NO_LINES),
    "set-init.no-ctype": Differs(400, NO_LINES),
    "set-init.missing": Differs(400, NO_LINES),
    "set-init.signal": Differs(400, "B15: a signal is no command, and '!' would cancel what runs"),
    "set-init.nonascii": Differs(400, BYTES),
    "get-init.null": Differs(200, "S4: an array, as the schema says", {"lines": []}),
    "get-init.unknown-field": Differs(200, "S4: an array, as the schema says", {"lines": []}),
    "get-ps.after-restart": Differs(200, "B11: reports survive a restart"),
    "get-ps.odd-all": Differs(200, "B2: never a 200 without a body"),
    "add-job.null": Differs(400, NO_COMMANDS),
    "add-job.unknown-field": Differs(400, NO_COMMANDS),
    "add-job.commands-null": Differs(400, NO_COMMANDS),
    "add-job.missing-commands": Differs(400, NO_COMMANDS),
    "add-job.empty-cmd": Differs(200, "blank lines and comments are skipped alike", {"ok": True}),
    "add-job.101-byte": Differs(400, "B15: the firmware drops long lines without a word"),
    "add-job.nonascii": Differs(400, BYTES),
    "add-job.cr": Differs(400, BYTES),
    "add-job.lead-space-signal": Differs(400, "B15: trimmed first, validated then"),
    "add-job.while-commands-pending": Differs(200, "S9: it waits for them", {"ok": True}),
    "query-ts.1e300": Differs(200, "no overflow", {"times": [1e300], "values": {"a": [None]}}),
    "query-ts.step-1e-10": Differs(200, "B1: one sample", {"times": [1000.0], "values": {"a": [None]}}),
    "query-ts.step-huge": Differs(200, "B1: one sample", {"times": [0.0], "values": {"a": [None]}}),
    "query-ts.step-3600.1": Differs(200, "S15: a float64 step, so that the end is met", THIRTY_SIX_THOUSAND),
    "query-ts.odd0": Differs(200, "B2: NaN is null", NOTHING),
    "query-ts.odd1": Differs(200, "B2: Inf is null", NOTHING),
}


class Rig:
    """A server with the core of the recording, and ways to bring both into a state."""

    def __init__(self, port: Port, server: Server) -> None:
        self.port = port
        self.server = server

    def call(self, path: str, **request: Any) -> Any:
        return self.server.client.call(path, **request)

    def idle(self) -> None:
        self.call("/cancel") if self._busy() else None
        wait_until(lambda: not self._busy() and self.call("/status")["device_alive"])

    def _busy(self) -> bool:
        jobs = self.call("/list-jobs")["jobs"]
        return self.call("/status")["busy"] or any(job["status"] not in ENDED for job in jobs)

    def finished(self) -> None:
        wait_until(lambda: not self._busy())

    def completed_job(self) -> None:
        self.idle()
        assert self.call("/add-job", commands=["G0 X1"])["ok"]
        self.finished()

    def waiting_job(self) -> None:
        self.idle()
        self.call("/write-line", line="G4 P0.3")
        assert self.call("/add-job", commands=["G0 X1"])["ok"]
        assert self.call("/list-jobs")["jobs"][-1]["status"] == "WAITING"

    def running_job(self) -> None:
        self.idle()
        assert self.call("/add-job", commands=["G4 P0.3"] * 8, signals={"?edm": 0.1})["ok"]
        wait_until(lambda: "running_job" in self.call("/status"))

    def canceled_waiting(self) -> None:
        self.waiting_job()
        self.call("/cancel")

    def canceled_running(self) -> None:
        self.running_job()
        self.call("/cancel")

    def three_commands(self) -> None:
        self.idle()
        for _ in range(3):
            assert self.call("/write-line", line="G4 P0.5")["ok"]

    def reports(self) -> None:
        """One of each report that is asked for, and an error."""
        self.idle()
        for line in ("?pos", "?edm", "get", "nonsense"):
            assert self.call("/write-line", line=line)["ok"]
        for tag in ("pos", "edm", "stg", "error"):
            wait_until(lambda tag=tag: self.call("/get-ps", tag=tag)["pstates"])
        self.finished()

    def init(self, *lines: str) -> Callable[[], None]:
        return lambda: self.call("/set-init", lines=lines)

    def restarted(self) -> None:
        self.reports()
        self.call("/set-init", lines=["set m.0.current 42", "; keep", "  set m.1.current 43 "])
        assert self.server.stop() == 0
        self.server.start()
        wait_until(lambda: self.call("/status")["device_alive"])

    def odd(self, line: str) -> None:
        self.idle()
        before = self.call("/get-ps", tag="t")["pstates"]
        self.port.say(line.encode() + b"\r\n")
        wait_until(lambda: self.call("/get-ps", tag="t")["pstates"] != before)

    def dead(self) -> None:
        self.idle()
        self.port.inject("mute")
        wait_until(lambda: not self.call("/status")["device_alive"])

    def prepare(self, record: dict[str, Any]) -> None:
        ways: dict[str, Callable[[], None]] = {
            "status.job-waiting": self.waiting_job,
            "list-jobs.waiting": self.waiting_job,
            "status.job-running": self.running_job,
            "write-line.cmd-while-running": self.running_job,
            "write-line.comment-while-running": self.running_job,
            "get-ps.edm-while-running": self.running_job,
            "cancel.waiting": self.waiting_job,
            "list-jobs.cancel-waiting": self.canceled_waiting,
            "list-jobs.cancel-running": self.canceled_running,
            "add-job.right-after-cancel": self.canceled_waiting,
            "status.after-cancel": self.canceled_running,
            "status.3-queued-300ms": self.three_commands,
            "add-job.while-commands-pending": self.three_commands,
            "cancel.commands": self.three_commands,
            "get-init.unknown-field": self.init(),
            "get-init.null": self.init(),
            "get-init.0": self.init("set a 1"),
            "get-init.1": self.init("set cs.g.pos.x 1", "set cs.g.pos.x 2"),
            "get-init.blank": self.init("a", "", "  b  ", "; c"),
            "get-ps.stg": self.reports,
            "get-ps.error": self.reports,
            "wire.after-writes": self.reports,
            "get-ps.odd-all": lambda: self.odd("t < f:nan >"),
        }
        phases: dict[str, Callable[[], None]] = {
            "restart": self.restarted,
            "dead-core": self.dead,
            "pstate": lambda: self.odd(record["note"]),
        }
        name = record["id"]
        if name.startswith("list-jobs"):
            ways.setdefault(name, self.completed_job)
        ways.get(name, phases.get(record["phase"], self.idle))()


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("golden")
    options = SparkOptions(capacity=100, command_time=0.05, boot_message="init", hold_off=0.05)
    with Port(options) as port, Server(folder, spark_config(port.path)) as server:
        yield Rig(port, server)


def body_of(record: dict[str, Any]) -> str:
    """The request's body, with times that were "now" moved to the present."""
    if record["id"] == "set-init.big":
        return json.dumps({"lines": [f"set a.b {i}" for i in range(20_000)]})
    return record["request"]["body"] or ""


def moved(body: str, record: dict[str, Any], rig: Rig) -> tuple[str, float]:
    """A query's times moved to the present, and by how much."""
    if record["phase"] == "pstate" and record["id"].startswith("query-ts"):
        request = json.loads(body)
        offset = rig.call("/get-ps", tag="t")["pstates"][0]["time"] + 0.1 - request["start"]
    elif '"start": 17953' in body:
        request = json.loads(body)
        offset = time.time() - 1795328391.7144787
    else:
        return body, 0.0
    for name in ("start", "end"):
        if name in request and not isinstance(request[name], str):
            request[name] += offset
    return json.dumps(request), offset


def assert_like(got: Any, recorded: Any, offset: float, where: str = "$") -> None:
    """The same shape and values; times and ids only by type, and more keys are welcome."""
    if isinstance(recorded, dict):
        assert isinstance(got, dict), where
        for key, value in recorded.items():
            assert key in got, f"{where}.{key}"
            if key == "jobs":
                assert_like_jobs(got[key], value)
            elif key == "times":
                assert got[key] == pytest.approx([t + offset for t in value], abs=0.01)
            elif key in LOOSE:
                assert type(got[key]) is type(value) or {type(got[key]), type(value)} <= {int, float}
            elif key == "values" and offset and "t.f" not in value:
                assert {k: len(v) for k, v in got[key].items()} == {k: len(v) for k, v in value.items()}
            else:
                assert_like(got[key], value, offset, f"{where}.{key}")
    elif isinstance(recorded, list) and where.endswith("pstates"):
        assert bool(got) == bool(recorded), where
        for item in got:
            assert_like(item, recorded[0], offset, f"{where}[]")
    else:
        assert got == recorded, where


def assert_like_jobs(got: list[dict[str, Any]], recorded: list[dict[str, Any]]) -> None:
    for job in got:
        assert job.keys() >= {"job_id", "status", "time_added"}
        assert ("time_ended" in job) == (job["status"] in ENDED)
        if job["status"] in {"RUNNING", "COMPLETED"}:
            assert "time_started" in job
        times = [job[name] for name in ("time_added", "time_started", "time_ended") if name in job]
        assert times == sorted(times)
    assert got[-1]["status"] == (recorded[-1]["status"] if len(recorded) > 1 else "COMPLETED")
    assert len({job["job_id"] for job in got}) == len(got)


def difference(name: str) -> Differs | None:
    return DIFFERENT.get(name) or DIFFERENT.get("*." + name.partition(".")[2])


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: f"{record['seq']}-{record['id']}")
def test_recorded_request(rig, record):
    name, request, response = record["id"], record["request"], record["response"]
    if name in NOT_APPLICABLE:
        pytest.skip(NOT_APPLICABLE[name])
    rig.prepare(record)
    body, offset = moved(body_of(record), record, rig)
    answer = rig.server.client.request(request["method"], request["path"], body, request["headers"])

    differs = difference(name)
    assert answer.status == (differs.status if differs else response["status"]), answer
    assert "access-control-allow-origin" not in answer.headers
    if answer.status != 200:
        assert answer.headers["content-type"] == "text/plain; charset=utf-8"
        assert len(answer.text) > 3
        return
    assert answer.headers["content-type"] == "application/json"
    assert answer.text.endswith("}\n")
    if differs is None:
        if not response.get("body_full_bytes"):
            assert_like(answer.json, json.loads(response["body"]), offset)
    elif differs.body is not None:
        assert {key: answer.json[key] for key in differs.body} == differs.body


def test_every_difference_is_in_the_recording():
    """A table that names what no longer exists would hide that a check is gone."""
    names = {record["id"] for record in RECORDS}
    for name in [*DIFFERENT, *NOT_APPLICABLE]:
        assert any(difference(n) is DIFFERENT.get(name) for n in names), name


@pytest.mark.parametrize("path", ["/status", "/add-job", "/write-line"])
def test_preflight_of_an_allowed_origin_is_answered_like_the_original(rig, path):
    headers = {"Origin": "http://localhost:8080", "Access-Control-Request-Method": "POST"}
    answer = rig.server.client.request("OPTIONS", path, None, headers)
    assert (answer.status, answer.body) == (204, b"")
    assert answer.headers["access-control-allow-origin"] == "http://localhost:8080"
    assert "POST" in answer.headers["access-control-allow-methods"]
    assert "content-type" in answer.headers["access-control-allow-headers"].lower()


def test_ten_thousand_and_one_samples(rig):
    """query-ts.steps-10000: the recorded body is shortened, so its length is checked here."""
    got = rig.call("/query-ts", start=1000, end=11000, step=1, query=["queue.num"])
    assert got == {"times": [float(t) for t in range(1000, 11001)], "values": {"queue.num": [None] * 10_001}}
