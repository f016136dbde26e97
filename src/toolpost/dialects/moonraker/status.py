"""Printer objects, as the clients of Klipper know them, made of what Toolpost knows of any machine.

Pure. What is not known is left out; a client that asks for it is told null. Names and meanings of the fields
are those of Klipper's documentation (Status_Reference.md); the states are mapped as ``states.md`` 5 says.
"""

from collections.abc import Mapping
from typing import Any, Final, TypeAlias

import msgspec

from toolpost.clock import seconds
from toolpost.core.job import Job, JobState, Reason
from toolpost.core.machine import Execution, MachineState
from toolpost.core.report import Report, number

Objects: TypeAlias = dict[str, dict[str, Any]]
"""The fields of each object."""

Wanted: TypeAlias = Mapping[str, tuple[str, ...] | None]
"""The fields that a client wants of each object, None for all."""

SYSTEM: Final = "system_stats"
"""The object that changes all the time: it is told with other changes, and is no reason to tell anything."""

MACROS: Final = {
    "CANCEL_PRINT": "Stop the machine and cancel the job",
    "M112": "Stop the machine at once",
    "SDCARD_RESET_FILE": "Forget the outcome of the last job",
}
"""Words of a script that Toolpost itself carries out, and never sends to the machine."""

_PRINT_STATES: Final = {
    JobState.PROCESSING: "printing",
    JobState.PROCESSING_STOPPED: "error",
    JobState.COMPLETED: "complete",
    JobState.CANCELED: "cancelled",
    JobState.ABORTED: "error",
}
_OUTCOMES: Final = {
    Reason.HOST_STOPPED: "server_exit",
    Reason.HOST_RESTARTED: "interrupted",
    Reason.LINK_LOST: "klippy_disconnect",
    Reason.MACHINE_SILENT: "klippy_disconnect",
    Reason.MACHINE_FAULT: "klippy_shutdown",
    Reason.MACHINE_RESET: "klippy_shutdown",
}
_PAUSED: Final = "paused-by-user"
_AXES: Final = ("x", "y", "z")
_MACHINE: Final = "m"
_SYSTEMS: Final = ("w", "g", "t")
_ORIGIN: Final = (0.0, 0.0, 0.0, 0.0)


class Span(msgspec.Struct, frozen=True):
    """Where in a file its commands are: offset of the first, offset behind the last, and bytes in all."""

    start: int
    end: int
    size: int


class View(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a machine at one moment.

    Attributes:
        now_us: Unix time in microseconds.
        state, message: the machine's state, as ``webhooks`` has it.
        machine: the machine itself.
        job: the job that runs or was the last to run, or None.
        executed: commands of it that the machine has executed; None if that is not known.
        span: its commands in the file it was made from; None if that is not known.
        position: the latest report ``pos``.
        system: figures of this computer.
    """

    now_us: int
    state: str
    message: str
    machine: MachineState
    job: Job | None = None
    executed: int | None = None
    span: Span | None = None
    position: Report | None = None
    system: dict[str, Any] = {}


def print_state(job: Job | None) -> str:
    """Return a job's state as ``print_stats`` names it."""
    if job is None:
        return "standby"
    if job.state is JobState.PROCESSING_STOPPED and job.reason.value == _PAUSED:
        return "paused"
    return _PRINT_STATES.get(job.state, "standby")


def outcome(job: Job) -> str:
    """Return a job's state as the history names it."""
    if job.state is JobState.COMPLETED:
        return "completed"
    if job.state is JobState.CANCELED:
        return "cancelled"
    return _OUTCOMES.get(job.reason, "error") if job.ended else "in_progress"


def duration(job: Job, now_us: int) -> float:
    """Return the seconds that a job has run; 0 for one that is held, for since when is not known."""
    if job.started_us is None or job.state is JobState.PROCESSING_STOPPED:
        return 0.0
    return seconds(max(0, (now_us if job.ended_us is None else job.ended_us) - job.started_us))


def printer_objects(view: View) -> Objects:
    """Return all objects of a machine."""
    state = print_state(view.job)
    ran = duration(view.job, view.now_us) if view.job is not None else 0.0
    name = view.job.name if view.job is not None else ""
    message = _message(view.job) if state == "error" else ""
    progress = _progress(view)
    live = _place(view.position, _MACHINE) or _ORIGIN
    busy = state == "printing" or view.machine.execution is Execution.ACTIVE
    settings: dict[str, Any] = {
        "display_status": {},
        "gcode_macro cancel_print": {},
        "virtual_sdcard": {},
    }
    return {
        "webhooks": {"state": _webhooks(view.state), "state_message": view.message},
        "configfile": {
            "config": settings,
            "settings": settings,
            "warnings": [],
            "save_config_pending": False,
            "save_config_pending_items": {},
        },
        "gcode": {"commands": {word: {"help": text} for word, text in MACROS.items()}},
        "gcode_move": {
            "speed_factor": 1.0,
            "extrude_factor": 1.0,
            "absolute_coordinates": True,
            "absolute_extrude": True,
            "homing_origin": _ORIGIN,
            "position": live,
            "gcode_position": _selected(view.position) or live,
        },
        "print_stats": {
            "filename": name,
            "total_duration": ran,
            "print_duration": ran,
            "filament_used": 0.0,
            "state": state,
            "message": message,
            "info": {"total_layer": None, "current_layer": None},
        },
        "virtual_sdcard": {
            "file_path": name if name and view.job is not None and not view.job.ended else None,
            "progress": progress,
            "is_active": state == "printing",
            **_file(view, progress),
        },
        "pause_resume": {"is_paused": state == "paused"},
        "display_status": {"progress": progress, "message": message or None},
        "motion_report": {"live_position": live},
        # A position without homed axes stands for none, to clients of Klipper.
        "toolhead": {"homed_axes": "", "position": live},
        "idle_timeout": {
            "state": "Printing" if busy else "Ready" if view.machine.alive else "Idle",
            "printing_time": ran if state == "printing" else 0.0,
        },
        SYSTEM: view.system,
    }


def select(objects: Objects, wanted: Wanted) -> Objects:
    """Return what a client wants: null for a field, and nothing for an object, that there is not."""
    found: Objects = {}
    for name, fields in wanted.items():
        known = objects.get(name, {})
        found[name] = known if fields is None or not known else {field: known.get(field) for field in fields}
    return found


def changes(before: Objects, now: Objects, wanted: Wanted) -> Objects:
    """Return the fields a client wants that have changed; nothing if only the system's have."""
    found: Objects = {}
    for name, fields in wanted.items():
        old, new = before.get(name, {}), now.get(name, {})
        changed = {
            field: value
            for field, value in new.items()
            if (fields is None or field in fields) and (field not in old or old[field] != value)
        }
        if changed:
            found[name] = changed
    return {} if found.keys() <= {SYSTEM} else found


def _webhooks(state: str) -> str:
    """Return a state that there is in ``webhooks``: a machine that is away is an error to its host."""
    return "error" if state == "disconnected" else state


def _message(job: Job | None) -> str:
    return "" if job is None else job.detail or job.reason.value


def _progress(view: View) -> float:
    job = view.job
    if job is None or view.executed is None:
        return 0.0
    if job.state is JobState.COMPLETED:
        return 1.0
    return min(1.0, view.executed / job.commands) if job.commands else 0.0


def _file(view: View, progress: float) -> dict[str, int]:
    """Return where in the file the job is: in bytes, or in commands where the file is not known."""
    if view.job is None:
        return {"file_position": 0, "file_size": 0}
    span = view.span or Span(0, view.job.commands, view.job.commands)
    if progress >= 1.0:
        position = span.size
    elif progress <= 0.0:
        position = 0
    else:
        position = span.start + int(progress * (span.end - span.start))
    return {"file_position": position, "file_size": span.size}


def _place(report: Report | None, system: str) -> tuple[float, ...] | None:
    """Return a position in one coordinate system, with a fourth axis that is none."""
    if report is None:
        return None
    found = [number(report.values.get(f"{system}.{axis}")) for axis in _AXES]
    known = [value for value in found if value is not None]
    return (*known, 0.0) if len(known) == len(_AXES) else None


def _selected(report: Report | None) -> tuple[float, ...] | None:
    """Return the position in the coordinate system that commands are in, if that is not the machine's."""
    return next((place for system in _SYSTEMS if (place := _place(report, system)) is not None), None)
