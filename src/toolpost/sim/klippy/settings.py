"""The machine's configuration as clients read it (the object ``configfile``)."""

from pathlib import Path

from toolpost.sim.klippy.motion import MAX_ACCEL, MAX_VELOCITY, RANGE
from toolpost.sim.klippy.pausing import MACRO

MACROS = {
    "PAUSE": "PAUSE_BASE",
    "RESUME": "RESUME_BASE",
    "CANCEL_PRINT": "TURN_OFF_HEATERS\nCANCEL_PRINT_BASE",
    "PAUSE_QUEUE": '{action_call_remote_method("pause_job_queue")}',
    "START_QUEUE": '{action_call_remote_method("start_job_queue")}',
}
"""The macros, each with its G-code."""


def settings(directory: Path) -> dict[str, dict[str, object]]:
    """Return every section with its values.

    Mainsail warns without ``virtual_sdcard``, ``pause_resume``, ``display_status`` and the macros
    for pause, resume and cancel.

    Args:
        directory: where the files are.
    """
    low, high = RANGE
    axis = {"position_min": low, "position_max": high, "position_endstop": low, "homing_speed": 5.0}
    heater = {"sensor_type": "simulated", "control": "watermark", "min_temp": 0.0}
    sections: dict[str, dict[str, object]] = {
        "mcu": {"serial": "simulated", "baud": 250_000, "restart_method": "command"},
        "printer": {
            "kinematics": "cartesian",
            "max_velocity": MAX_VELOCITY,
            "max_accel": MAX_ACCEL,
            "minimum_cruise_ratio": 0.5,
            "square_corner_velocity": 5.0,
        },
        **{f"stepper_{name}": dict[str, object](axis) for name in "xyz"},
        "extruder": {
            **heater,
            "max_temp": 300.0,
            "min_extrude_temp": 170.0,
            "nozzle_diameter": 0.4,
            "filament_diameter": 1.75,
            "max_extrude_only_distance": 50.0,
        },
        "heater_bed": {**heater, "max_temp": 130.0},
        "fan": {"max_power": 1.0},
        "virtual_sdcard": {"path": str(directory)},
        "pause_resume": {"recover_velocity": 50.0},
        "display_status": {},
        "respond": {"default_type": "echo", "default_prefix": "echo:"},
        "idle_timeout": {"timeout": 600.0},
    }
    for name, gcode in MACROS.items():
        sections[f"gcode_macro {name.lower()}"] = {"gcode": gcode, "description": MACRO}
    return sections


def configfile(directory: Path) -> dict[str, object]:
    """Return the object ``configfile``: settings as numbers, and the same as the file's text."""
    values = settings(directory)
    text = {
        section: {key: str(value) for key, value in entries.items()} for section, entries in values.items()
    }
    return {
        "config": text,
        "settings": values,
        "warnings": [],
        "save_config_pending": False,
        "save_config_pending_items": {},
    }
