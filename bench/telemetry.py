"""Measures telemetry: disk, memory, CPU and the time of queries after a restart.

Usage: python bench/telemetry.py [--points N] [--json FILE]
"""

import argparse
import asyncio
import gc
import json
import math
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from toolpost.core.report import Report, Value
from toolpost.telemetry import SampleGrid, Telemetry

MACHINE, TAG = "edm", "pos"
KEYS = ("m.x", "m.y", "m.z", "duty", "open", "short", "temp", "count", "touch", "state")
START_US = 1_735_689_600_000_000
PERIOD_US = 10_000  # 100 Hz
REPEATS = 21


def reports(count: int) -> Iterator[Report]:
    """Yield reports of a machine that cuts: slow moves, noisy ratios, some states."""
    rng = random.Random(1)
    noise = [rng.random() for _ in range(7_919)]
    states = ("cutting", "retract", "approach", "idle")
    for n in range(count):
        a, b = noise[n % 7_919], noise[(n * 31) % 7_919]
        time_us = START_US + n * PERIOD_US + int(a * 800)
        values: dict[str, Value] = {
            "m.x": round(40 + 35 * math.sin(n / 90_000), 3),
            "m.y": round(25 + 20 * math.cos(n / 70_000), 3),
            "m.z": round(-12.5 + (n % 60_000) / 12_000 + 0.05 * a, 3),
            "duty": round(0.2 + 0.3 * a, 3),
            "open": round(0.1 * b, 3),
            "short": round(0.05 * a * b, 3),
            "temp": round(24 + 3 * math.sin(n / 200_000) + 0.1 * b, 1),
            "count": n // 3,
            "touch": n % 977 < 12,
            "state": states[(n // 700) % 4] if n % 9_000 > 500 else states[3],
        }
        yield Report(time_us, TAG, values)


def rss_bytes() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    return 0


def disk_bytes(directory: Path) -> int:
    return sum(file.stat().st_size for file in directory.iterdir())


async def write(directory: Path, count: int) -> dict[str, float]:
    generating = time.process_time()
    for _ in reports(count // 10):
        pass
    generating = (time.process_time() - generating) * 10
    telemetry = Telemetry.open(directory)
    nothing = SampleGrid.from_seconds(0, 0, 1)
    gc.collect()
    rss = rss_bytes()
    spent = time.process_time()
    recording = 0.0
    batch: list[Report] = []
    for report in reports(count):
        batch.append(report)
        if len(batch) == 2_000:
            began = time.perf_counter()
            for item in batch:
                telemetry.record(MACHINE, item)
            recording += time.perf_counter() - began
            await telemetry.query(MACHINE, [], nothing)
            batch.clear()
    for item in batch:
        telemetry.record(MACHINE, item)
    await telemetry.query(MACHINE, [], nothing)
    spent = time.process_time() - spent - generating
    grown = rss_bytes() - rss
    dropped = telemetry.dropped
    await telemetry.close()
    assert not dropped
    return {
        "cpu_us": spent / count * 1e6,
        "record_us": recording / count * 1e6,
        "rss": grown,
        "disk": disk_bytes(directory),
    }


async def read(directory: Path, count: int) -> dict[str, float]:
    began = time.perf_counter()
    telemetry = Telemetry.open(directory)
    figures = {"open_ms": (time.perf_counter() - began) * 1e3}
    first = START_US / 1e6
    last = first + count * PERIOD_US / 1e6
    keys = [f"{TAG}.{key}" for key in KEYS]
    recent = max(first, last - 600)
    for name, wanted, steps, start in (
        ("1x1000", keys[:1], 1_000, first),
        ("10x10000", keys, 10_000, first),
        ("1x1000 recent", keys[:1], 1_000, recent),
        ("10x10000 recent", keys, 10_000, recent),
    ):
        grid = SampleGrid.from_seconds(start, last, (last - start) / (steps - 1) * 1.000001)
        taken = []
        for _ in range(REPEATS):
            began = time.perf_counter()
            result = await telemetry.query(MACHINE, wanted, grid)
            taken.append((time.perf_counter() - began) * 1e3)
            assert sum(value is None for value in result[wanted[0]]) < 10
        figures[name] = statistics.median(taken)
        figures[f"{name} first"] = taken[0]
    taken = []
    for _ in range(5):
        began = time.perf_counter()
        assert len(await telemetry.history(MACHINE, TAG, 10_000)) == min(count, 10_000)
        taken.append((time.perf_counter() - began) * 1e3)
    figures["history"] = statistics.median(taken)
    figures["rss"] = rss_bytes()
    await telemetry.close()
    return figures


async def idle(directory: Path) -> dict[str, float]:
    """A day of a machine that only reports its queue, four times a second."""
    telemetry = Telemetry.open(directory)
    nothing = SampleGrid.from_seconds(0, 0, 1)
    gc.collect()
    rss = rss_bytes()
    written = _written()
    rng = random.Random(1)
    for n in range(4 * 86_400):
        time_us = START_US + n * 250_000 + rng.randrange(2_000)
        telemetry.record(MACHINE, Report(time_us, "queue", {"cap": 64, "num": 0}))
        if n % 4 == 3:  # the live path writes once a second
            await telemetry.query(MACHINE, [], nothing)
    grown = rss_bytes() - rss
    await telemetry.close()
    return {
        "rss": grown,
        "disk": disk_bytes(directory),
        "written": _written() - written,
    }


def _written() -> int:
    """Return the bytes that this process has handed to write()."""
    for line in Path("/proc/self/io").read_text().splitlines():
        if line.startswith("wchar:"):
            return int(line.split()[1])
    return 0


def _child(phase: str, directory: Path, count: int) -> dict[str, float]:
    """Run a phase in a process of its own."""
    command = [sys.executable, __file__, "--phase", phase, str(directory), str(count)]
    answer = subprocess.run(command, check=True, stdout=subprocess.PIPE, env=os.environ)
    figures: dict[str, float] = json.loads(answer.stdout)
    return figures


def measure(points: int = 10_000_000) -> list[dict[str, Any]]:
    """Return the figures of a store with so many points, ten to a report."""
    count = points // len(KEYS)
    millions = points / 1e6
    results: list[dict[str, Any]] = []

    def add(what: str, value: float, unit: str, goal: float | None = None) -> None:
        ok = goal is None or value <= goal
        results.append(
            {
                "what": what,
                "value": round(value, 4),
                "unit": unit,
                "goal": "" if goal is None else f"<= {goal:g}",
                "ok": ok,
            }
        )

    with tempfile.TemporaryDirectory(prefix="toolpost-bench-") as name:
        wrote = _child("write", Path(name), count)
        got = _child("read", Path(name), count)
    with tempfile.TemporaryDirectory(prefix="toolpost-bench-") as name:
        day = _child("idle", Path(name), 0)
    add("disk per million points", wrote["disk"] / millions / 1e6, "MB", 3)
    add("memory growth per million points", wrote["rss"] / millions / 1e6, "MB", 6)
    add("memory growth", wrote["rss"] / 1e6, "MB")
    add("CPU per point stored", wrote["cpu_us"] / len(KEYS), "us")
    add("record() per report", wrote["record_us"], "us", 1)
    add("open", got["open_ms"], "ms", 50)
    add("query 1 key x 1,000 steps, whole range, p50", got["1x1000"], "ms", 4)
    add("query 10 keys x 10,000 steps, whole range, p50", got["10x10000"], "ms", 60)
    add("query 1 key x 1,000 steps, last 10 min, p50", got["1x1000 recent"], "ms", 4)
    add("query 10 keys x 10,000 steps, last 10 min, p50", got["10x10000 recent"], "ms", 60)
    add("query 1 key x 1,000 steps, first of process", got["1x1000 first"], "ms")
    add("latest 10,000 reports from disk, p50", got["history"], "ms")
    add("memory of the process that reads", got["rss"] / 1e6, "MB")
    add("idle day: disk", day["disk"] / 1e6, "MB", 5)
    add("idle day: memory growth", day["rss"] / 1e6, "MB", 10)
    add("idle day: bytes written per second", day["written"] / 86_400, "B/s")
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--phase", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.phase:
        phase, directory, count = options.phase
        runs = {
            "write": lambda: write(Path(directory), int(count)),
            "read": lambda: read(Path(directory), int(count)),
            "idle": lambda: idle(Path(directory)),
        }
        print(json.dumps(asyncio.run(runs[phase]())))
        return
    results = measure(options.points)
    for row in results:
        goal = row["goal"]
        mark = "" if row["ok"] else "MISSED"
        print(f"{row['what']:<52}{row['value']:>10.3f} {row['unit']:<5}{goal:<10}{mark}")
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
