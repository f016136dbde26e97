"""How soon what is asked happens, and that nothing happens too early or after a cancel."""

import asyncio
import time

from bench.result import Result, at_most, percentile
from bench.rig import Rig, rig, wall
from bench.stream import moves
from toolpost.sim.options import SparkOptions

_FEW_COMMANDS = 10


async def measure(scale: float) -> list[Result]:
    """Measure the latency goals; `scale` shortens the runs."""
    return [
        *await start_latency(max(20, int(200 * scale))),
        *await completion_latency(max(20, int(1000 * scale))),
        *await cancel_latency(max(20, int(1000 * scale))),
    ]


async def start_latency(jobs: int) -> list[Result]:
    """Measure from the answer to add-job to the first command on the wire."""
    waits = []
    async with rig(SparkOptions(command_time=0.0)) as bench:
        for _ in range(jobs):
            bench.core.mark()
            await bench.run_job(moves(_FEW_COMMANDS))
            answered = time.monotonic()
            await bench.until_idle()
            assert bench.core.first_command_at is not None
            waits.append(max(0.0, bench.core.first_command_at - answered) * 1000)
    return [at_most(f"add-job answered to first command, p50 of {jobs}", percentile(waits, 0.5), "ms", 5)]


async def completion_latency(jobs: int) -> list[Result]:
    """Measure from the execution of a job's last command to its state COMPLETED, and count the early ones."""
    waits: list[float] = []
    early = 0
    async with rig(SparkOptions(command_time=0.002)) as bench:
        for number in range(jobs):
            await bench.run_job(moves(_FEW_COMMANDS + number % 40))
            before = bench.core.executed
            await bench.until_idle()
            del before
            job = (await bench.client.post("/list-jobs", {}))["jobs"][-1]
            assert job["status"] == "COMPLETED", job
            assert bench.core.last_executed_at is not None
            wait = job["time_ended"] - wall(bench.core.last_executed_at)
            early += wait < -0.0005 or bench.core.queue_length > 0
            waits.append(wait * 1000)
    return [
        at_most(f"last command executed to COMPLETED, p99 of {jobs}", percentile(waits, 0.99), "ms", 20),
        at_most(f"jobs COMPLETED too early, of {jobs}", early, "jobs", 0),
    ]


async def cancel_latency(cancels: int) -> list[Result]:
    """Measure from the request to cancel to ``!`` on the wire, and count the commands that come after it."""
    waits: list[float] = []
    leaked = 0
    async with rig(SparkOptions(command_time=0.0, hold_off=0.0), hold_off=0.01) as bench:
        for _ in range(cancels):
            await bench.run_job(moves(20_000))
            await _streaming(bench)
            asked = time.monotonic()
            await bench.client.post("/cancel", {})
            await asyncio.sleep(0.02)
            assert bench.core.last_bang_at is not None
            waits.append((bench.core.last_bang_at - asked) * 1000)
            leaked += bench.core.commands_after_bang
    return [
        at_most(
            f"cancel while streaming to ! on the wire, p50 of {cancels}", percentile(waits, 0.5), "ms", 2
        ),
        at_most(f"commands after !, in {cancels} cancels", leaked, "commands", 0),
    ]


async def _streaming(bench: Rig) -> None:
    """Return in the midst of a job's stream."""
    bench.core.mark()
    seen = bench.core.received
    while bench.core.received < seen + 500:
        await asyncio.sleep(0)
