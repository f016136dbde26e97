import pytest

from toolpost.core.job import Job, JobState, Reason
from toolpost.core.machine import Execution, LinkState, MachineState
from toolpost.core.report import Report, Value
from toolpost.dialects.moonraker.status import (
    SYSTEM,
    Span,
    View,
    changes,
    duration,
    outcome,
    print_state,
    printer_objects,
    select,
)

S, R = JobState, Reason
START = 1_000_000_000
READY = MachineState(link=LinkState.ONLINE, execution=Execution.READY)
ACTIVE = MachineState(link=LinkState.ONLINE, execution=Execution.ACTIVE)
AWAY = MachineState(link=LinkState.OFFLINE, execution=Execution.UNAVAILABLE)


def job(state: JobState = S.PROCESSING, reason: Reason = R.RUNNING, detail: str = "", name: str = "a.gcode"):
    ended = START + 5_000_000 if state in {S.CANCELED, S.ABORTED, S.COMPLETED} else None
    return Job(
        seq=1, id="1", machine="edm", program="", commands=200, name=name, state=state, reason=reason,
        detail=detail, created_us=START - 9, started_us=START, ended_us=ended,
    )  # fmt: skip


def objects(machine: MachineState = READY, state: str = "ready", **view):
    given = {"now_us": START + 2_000_000, "state": state, "message": "words", "machine": machine, **view}
    return printer_objects(View(**given))


def pos(**values: Value) -> Report:
    return Report(START, "pos", {name.replace("_", "."): value for name, value in values.items()})


@pytest.mark.parametrize(
    ("state", "reason", "printing", "told"),
    [
        (S.PROCESSING, R.RUNNING, "printing", "in_progress"),
        (S.PROCESSING_STOPPED, R.HOST_RESTARTED, "error", "in_progress"),
        (S.COMPLETED, R.DONE, "complete", "completed"),
        (S.CANCELED, R.CANCELED_BY_USER, "cancelled", "cancelled"),
        (S.ABORTED, R.HOST_STOPPED, "error", "server_exit"),
        (S.ABORTED, R.HOST_RESTARTED, "error", "interrupted"),
        (S.ABORTED, R.LINK_LOST, "error", "klippy_disconnect"),
        (S.ABORTED, R.MACHINE_SILENT, "error", "klippy_disconnect"),
        (S.ABORTED, R.MACHINE_FAULT, "error", "klippy_shutdown"),
        (S.ABORTED, R.MACHINE_RESET, "error", "klippy_shutdown"),
        (S.ABORTED, R.PROGRAM_MISSING, "error", "error"),
        (S.ABORTED, R.QUEUE_FULL, "error", "error"),
    ],
)
def test_the_state_of_a_job(state: JobState, reason: Reason, printing: str, told: str):
    assert print_state(job(state, reason)) == printing
    assert outcome(job(state, reason)) == told


def test_a_machine_without_a_job():
    found = objects()
    assert found["print_stats"] == {
        "filename": "",
        "total_duration": 0.0,
        "print_duration": 0.0,
        "filament_used": 0.0,
        "state": "standby",
        "message": "",
        "info": {"total_layer": None, "current_layer": None},
    }
    assert found["virtual_sdcard"] == {
        "file_path": None, "progress": 0.0, "is_active": False, "file_position": 0, "file_size": 0,
    }  # fmt: skip
    assert found["display_status"] == {"progress": 0.0, "message": None}
    assert found["idle_timeout"] == {"state": "Ready", "printing_time": 0.0}
    assert found["webhooks"] == {"state": "ready", "state_message": "words"}
    assert not any("heater" in name for name in found)


def test_a_running_job():
    found = objects(ACTIVE, job=job(), executed=50, span=Span(1000, 3000, 4000))
    assert found["print_stats"]["state"] == "printing"
    assert found["print_stats"]["filename"] == "a.gcode"
    assert found["print_stats"]["total_duration"] == found["print_stats"]["print_duration"] == 2.0
    assert found["virtual_sdcard"] == {
        "file_path": "a.gcode", "progress": 0.25, "is_active": True, "file_position": 1500, "file_size": 4000,
    }  # fmt: skip
    assert found["display_status"]["progress"] == 0.25
    assert found["idle_timeout"] == {"state": "Printing", "printing_time": 2.0}


@pytest.mark.parametrize(("executed", "position"), [(0, 0), (1, 1010), (200, 4000), (999, 4000), (None, 0)])
def test_the_position_in_the_file(executed: int | None, position: int):
    found = objects(job=job(), executed=executed, span=Span(1000, 3000, 4000))["virtual_sdcard"]
    assert found["file_position"] == position
    assert 0.0 <= found["progress"] <= 1.0


def test_a_program_that_is_no_file_is_measured_in_commands():
    found = objects(job=job(name=""), executed=50)
    assert found["print_stats"]["filename"] == ""
    card = found["virtual_sdcard"]
    assert (card["file_path"], card["file_position"], card["file_size"]) == (None, 50, 200)


def test_jobs_that_have_ended():
    done = objects(job=job(S.COMPLETED, R.DONE), executed=200, span=Span(10, 20, 30))
    assert done["print_stats"]["total_duration"] == 5.0
    assert done["virtual_sdcard"] == {
        "file_path": None, "progress": 1.0, "is_active": False, "file_position": 30, "file_size": 30,
    }  # fmt: skip
    lost = objects(AWAY, "disconnected", job=job(S.ABORTED, R.LINK_LOST, "cable pulled"))
    assert lost["print_stats"]["message"] == lost["display_status"]["message"] == "cable pulled"
    assert lost["webhooks"]["state"] == "error"
    assert lost["idle_timeout"]["state"] == "Idle"
    held = objects(job=job(S.PROCESSING_STOPPED, R.HOST_RESTARTED))
    assert held["print_stats"]["message"] == "host-restarted"
    assert held["print_stats"]["total_duration"] == 0.0
    assert objects(job=job(S.CANCELED, R.CANCELED_BY_USER, "x"))["print_stats"]["message"] == ""


def test_durations_never_go_back():
    assert duration(job(), START - 1) == 0.0
    assert duration(job(S.COMPLETED), START) == 5.0
    waiting = Job(seq=1, id="1", machine="edm", program="", commands=1, created_us=1)
    assert duration(waiting, START) == 0.0


def test_where_the_machine_is():
    found = objects(position=pos(sys="machine", m_x=1.5, m_y=2, m_z=-3, m_c=90))
    assert found["toolhead"]["position"] == found["motion_report"]["live_position"] == (1.5, 2, -3, 0.0)
    assert found["gcode_move"]["gcode_position"] == (1.5, 2, -3, 0.0)
    found = objects(position=pos(sys="work", m_x=1.5, m_y=2, m_z=-3, w_x=0.5, w_y=1, w_z=2))
    assert found["toolhead"]["position"] == (1.5, 2, -3, 0.0)
    assert found["gcode_move"]["gcode_position"] == (0.5, 1, 2, 0.0)
    assert found["toolhead"]["homed_axes"] == ""
    for broken in (pos(), pos(m_x=1, m_y=2), pos(m_x=1, m_y=None, m_z="3"), pos(m_x=1, m_y=2, m_z=True)):
        assert objects(position=broken)["toolhead"]["position"] == (0.0, 0.0, 0.0, 0.0)


def test_only_what_works_is_claimed():
    settings = objects()["configfile"]["settings"]
    assert {"virtual_sdcard", "display_status", "gcode_macro cancel_print"} == set(settings)
    assert objects()["pause_resume"] == {"is_paused": False}


def test_select():
    found = select(objects(), {"print_stats": ("state", "nope"), "nope": None, "nobody": ("x",)})
    assert found == {"print_stats": {"state": "standby", "nope": None}, "nope": {}, "nobody": {}}
    assert select(objects(), {"webhooks": None}) == {"webhooks": objects()["webhooks"]}


def test_changes():
    before = objects(system={"sysload": 1.0})
    after = objects(ACTIVE, job=job(), executed=50, system={"sysload": 2.0})
    every = dict.fromkeys(before)
    found = changes(before, after, every)
    assert found["idle_timeout"]["state"] == "Printing"
    assert found["print_stats"].keys() == {"filename", "total_duration", "print_duration", "state"}
    assert found[SYSTEM] == {"sysload": 2.0}
    assert "toolhead" not in found
    assert changes(before, after, {"print_stats": ("state",)}) == {"print_stats": {"state": "printing"}}
    assert changes(before, after, {"toolhead": None, "webhooks": ("state",), "pause_resume": ()}) == {}
    # What changes all the time is told with the rest only.
    assert changes(before, objects(system={"sysload": 3.0}), every) == {}
