"""How fast commands reach the core."""

import asyncio
import os
import time
import tty

from bench.result import Result, at_least
from bench.rig import Rig, rig
from toolpost.sim.options import SparkOptions


def moves(count: int) -> list[str]:
    """Return commands of about 18 bytes, as a CAM writes them."""
    return [f"G1 X{i % 1000 / 100:05.2f} Y{i % 777 / 100:05.2f}" for i in range(count)]


async def measure(scale: float) -> list[Result]:
    """Measure the streaming goals; `scale` shortens the runs."""
    pty_rate = await asyncio.to_thread(raw_pty_rate)
    limit = f"raw pty, a write per line: {pty_rate:,.0f}/s"
    results = []
    for capacity, goal in ((64, 50_000), (1000, 70_000)):
        rate = await _stream(SparkOptions(capacity=capacity, command_time=0.0), int(400_000 * scale))
        results.append(
            at_least(f"streaming, zero-time commands, cap {capacity}", rate, "commands/s", goal, limit)
        )
    count = max(1000, int(6_000 * scale))
    wire = 11_520 / (sum(map(len, moves(count))) / count + 1)
    rate = await _stream(SparkOptions(command_time=0.0), count, baud=115_200)
    results.append(
        at_least(
            "streaming on a wire of 115,200 baud",
            100 * rate / wire,
            "% of the wire",
            95,
            f"wire: {wire:.0f}/s",
        )
    )
    rate = await _stream(SparkOptions(command_time=0.003), max(600, int(3000 * scale)))
    results.append(at_least("core with 3 ms commands, cap 64", rate, "commands/s", 330, "core: 333/s"))
    return results


async def _stream(options: SparkOptions, count: int, baud: int | None = None) -> float:
    """Return the commands per second of one job, from the first command's arrival to the last's execution."""
    async with rig(options, baud=baud) as bench:
        await bench.run_job(moves(count))
        await _executed(bench, count)
        core = bench.core
        assert core.first_command_at is not None
        assert core.last_executed_at is not None
        await bench.until_idle()
        assert (core.executed, core.lost) == (count, 0), (core.executed, core.lost)
        return (count - 1) / (core.last_executed_at - core.first_command_at)


async def _executed(bench: Rig, count: int) -> None:
    async with asyncio.timeout(600):
        while bench.core.executed < count:
            await asyncio.sleep(0.05)


def raw_pty_rate(count: int = 200_000) -> float:
    """Return lines per second through a pty, one write per line, to a reader in another process."""
    master, slave = os.openpty()
    tty.setraw(slave)
    line = b"G1 X10.00 Y20.00\n"
    if os.fork() == 0:
        left = count * len(line)
        while left:
            left -= len(os.read(master, 65_536))
        os._exit(0)
    start = time.monotonic()
    for _ in range(count):
        os.write(slave, line)
    os.wait()
    rate = count / (time.monotonic() - start)
    os.close(master)
    os.close(slave)
    return rate
