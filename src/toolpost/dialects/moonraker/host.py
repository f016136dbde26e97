"""The computer that Toolpost runs on: what it is, and how busy it is. All of it blocks; for a thread."""

import os
import platform
import sys
import time
from pathlib import Path
from typing import Any, Final

import msgspec

PROC: Final = Path("/proc")
TEMPERATURE: Final = Path("/sys/class/thermal/thermal_zone0/temp")

_CPU_TIMES: Final = 8
_NETWORK: Final = {
    "rx_bytes": 0,
    "tx_bytes": 8,
    "rx_packets": 1,
    "tx_packets": 9,
    "rx_errs": 2,
    "tx_errs": 10,
    "rx_drop": 3,
    "tx_drop": 11,
}
_NETWORK_COLUMNS: Final = 16


class Reading(msgspec.Struct, frozen=True):
    """The counters of one moment.

    Attributes:
        time: Unix time, seconds.
        clock: monotonic time, seconds.
        used: processor time of this process, seconds.
        rss: resident memory of this process, kB; None if it is not known, as all that may be None.
        processors: for all together (``cpu``) and for each, the ticks spent at work and all ticks.
        network: counters of each interface.
        memory: of the computer, kB.
        uptime: of the computer, seconds.
        temperature: of the processor, °C.
    """

    time: float
    clock: float
    used: float
    rss: int | None
    processors: dict[str, tuple[int, int]]
    network: dict[str, dict[str, int]]
    memory: dict[str, int]
    uptime: float | None
    temperature: float | None


def read_host(proc: Path = PROC, temperature: Path = TEMPERATURE) -> Reading:
    """Return the counters of now; what cannot be read is left out."""
    statm = _text(proc / "self" / "statm").split()
    uptime = _text(proc / "uptime").split()
    degrees = _text(temperature).strip()
    return Reading(
        time=time.time(),
        clock=time.monotonic(),
        used=time.process_time(),
        rss=int(statm[1]) * os.sysconf("SC_PAGE_SIZE") // 1024 if len(statm) > 1 else None,
        processors=_processors(_text(proc / "stat")),
        network=_network(_text(proc / "net" / "dev")),
        memory=_memory(_text(proc / "meminfo")),
        uptime=float(uptime[0]) if uptime else None,
        temperature=int(degrees) / 1000 if degrees.lstrip("-").isdigit() else None,
    )


def describe_host(proc: Path = PROC) -> dict[str, Any]:
    """Return what the computer and its system are, as ``machine.system_info`` tells it."""
    return {
        "python": {"version": list(sys.version_info), "version_string": " ".join(sys.version.split())},
        "cpu_info": _cpu_info(proc),
        "distribution": _distribution(),
    }


def _cpu_info(proc: Path) -> dict[str, Any]:
    known: dict[str, str] = {}
    for line in _text(proc / "cpuinfo").splitlines():
        name, _, value = line.partition(":")
        known.setdefault(name.strip(), value.strip())
    total = _memory(_text(proc / "meminfo")).get("total")
    return {
        "cpu_count": os.cpu_count(),
        "bits": platform.architecture()[0],
        "processor": platform.machine(),
        "cpu_desc": known.get("model name", ""),
        "serial_number": known.get("Serial", ""),
        "hardware_desc": known.get("Hardware", ""),
        "model": known.get("Model", ""),
        "total_memory": total,
        "memory_units": "kB" if total is not None else "",
    }


def _distribution() -> dict[str, Any]:
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        release = {}
    version = release.get("VERSION_ID", "")
    major, _, rest = version.partition(".")
    minor, _, build = rest.partition(".")
    return {
        "name": release.get("PRETTY_NAME", ""),
        "id": release.get("ID", ""),
        "version": version,
        "version_parts": {"major": major, "minor": minor, "build_number": build},
        "like": release.get("ID_LIKE", ""),
        "codename": release.get("VERSION_CODENAME", ""),
        "release_info": release,
        "kernel_version": platform.release(),
    }


def _processors(text: str) -> dict[str, tuple[int, int]]:
    """Return the ticks of proc(5) ``stat``; idle and iowait, the fourth and fifth, are no work."""
    found = {}
    for line in text.splitlines():
        name, *ticks = line.split()
        if not name.startswith("cpu"):
            break
        # Guest time, behind these, is in user time already.
        times = [int(tick) for tick in ticks[:_CPU_TIMES]]
        found[name] = (sum(times) - sum(times[3:5]), sum(times))
    return found


def _network(text: str) -> dict[str, dict[str, int]]:
    found = {}
    for line in text.splitlines():
        name, colon, counters = line.partition(":")
        columns = counters.split()
        if colon and len(columns) >= _NETWORK_COLUMNS:
            found[name.strip()] = {key: int(columns[place]) for key, place in _NETWORK.items()}
    return found


def _memory(text: str) -> dict[str, int]:
    sizes = {}
    for line in text.splitlines():
        name, _, size = line.partition(":")
        sizes[name] = size
    if "MemTotal" not in sizes or "MemAvailable" not in sizes:
        return {}
    total, available = (int(sizes[name].split()[0]) for name in ("MemTotal", "MemAvailable"))
    return {"total": total, "available": available, "used": total - available}


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace")
    except OSError:
        return ""
