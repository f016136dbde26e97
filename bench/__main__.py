"""Run the benchmarks and print one table, and JSON with ``--json FILE``."""

import datetime as dt
import platform
from pathlib import Path

import click
import msgspec
import uvloop

from bench import job_queue, latency, load, stream, telemetry
from bench.result import Result, show

_PARTS = ("stream", "latency", "load", "queue", "telemetry")


@click.command()
@click.argument("parts", nargs=-1, type=click.Choice(_PARTS))
@click.option("--scale", default=1.0, help="Shorten the runs, e.g. 0.1.")
@click.option("--json", "file", type=click.Path(path_type=Path), help="Write the figures here as JSON.")
def main(parts: tuple[str, ...], scale: float, file: Path | None) -> None:
    """Measure PARTS (default: all)."""
    parts = parts or _PARTS
    results: list[Result] = []
    if "stream" in parts:
        results += uvloop.run(stream.measure(scale))
    if "latency" in parts:
        results += uvloop.run(latency.measure(scale))
    if "load" in parts:
        results += uvloop.run(load.measure(scale))
    if "queue" in parts:
        results += uvloop.run(job_queue.measure(scale))
    if "telemetry" in parts:
        results += msgspec.convert(telemetry.measure(int(10_000_000 * scale)), list[Result])
    when = dt.datetime.now(dt.UTC).strftime("%Y-%m-%d")
    machine = f"{platform.machine()}, {_processor()}, Python {platform.python_version()}"
    click.echo(f"\nMeasured {when} on {machine}\n")
    show(results, click.echo)
    if file is not None:
        data = {"date": when, "machine": machine, "results": results}
        file.write_bytes(msgspec.json.format(msgspec.json.encode(data)) + b"\n")


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return "processor unknown"


if __name__ == "__main__":
    main()
