"""``toolpost demo``: a job on a simulated machine, from the request to its end."""

import asyncio
import logging
import tempfile
import time
from pathlib import Path

import click
import msgspec

from toolpost.cli.common import fail, run
from toolpost.config import Address, Config, MachineConfig
from toolpost.errors import ToolpostError
from toolpost.sim.options import SimulatedSparkOptions

_LOOK_EVERY = 0.1
_COMMAND_TIME = 0.001


@click.command()
@click.option(
    "--size", default=6000, show_default=True, type=click.IntRange(min=10), help="Commands, roughly."
)
def command(size: int) -> None:
    """Run a program as a CAM writes it on a simulated machine; status 0 means that it was completed."""
    logging.basicConfig(level=logging.ERROR)
    run(lambda: _demo(size))


async def _demo(size: int) -> None:
    from toolpost.app import App
    from toolpost.sim.sample import sample_program

    simulated = SimulatedSparkOptions(command_time=_COMMAND_TIME)
    config = Config(machines={"edm": MachineConfig(driver="spark", link="sim", sim=simulated)})
    with tempfile.TemporaryDirectory(prefix="toolpost-demo-") as data:
        app = App(config, Path(data), [Address("127.0.0.1", 0)])
        urls: asyncio.Queue[str] = asyncio.Queue()
        serving = asyncio.create_task(app.run(urls.put_nowait))
        serving.add_done_callback(lambda _: urls.put_nowait(""))
        url = await urls.get()
        try:
            status = await _run_job(url, sample_program(size)) if url else ""
        finally:
            app.stop()
            await serving
    if status != "COMPLETED":
        raise ToolpostError(f"the job ended as {status}")


async def _run_job(url: str, program: list[str]) -> str:
    """Add a job as any client does, show its progress, and return the status in which it ended."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    click.echo(f"toolpost: a simulated machine is served on {url}")
    request = {"commands": program, "signals": {"?pos": 1.0, "?edm": 0.5}}
    added = await asyncio.to_thread(_post, url, "/add-job", request)
    if not added["ok"]:
        fail("the job was not taken")
    began = time.monotonic()
    columns = (
        TextColumn("job {task.fields[job]} {task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} commands"),
        TimeElapsedColumn(),
    )
    with Progress(*columns) as progress:
        task = progress.add_task("WAITING", job=added["job_id"], total=len(program))
        while True:
            jobs = await asyncio.to_thread(_post, url, "/list-jobs", {})
            job = jobs["jobs"][-1]
            done = job.get("num_executed", 0)
            progress.update(task, description=job["status"], completed=done, total=job["num_commands"])
            if "time_ended" in job:
                break
            await asyncio.sleep(_LOOK_EVERY)
    click.echo(
        f"toolpost: job {job['job_id']} {job['status']}: {done} commands in {time.monotonic() - began:.1f} s"
    )
    return str(job["status"])


def _post(url: str, path: str, request: object) -> dict:  # type: ignore[type-arg]
    import http.client

    connection = http.client.HTTPConnection(url.removeprefix("http://"), timeout=10)
    try:
        body = msgspec.json.encode(request)
        connection.request("POST", path, body, {"Content-Type": "application/json"})
        response = connection.getresponse()
        text = response.read()
    finally:
        connection.close()
    if response.status != 200:
        fail(text.decode())
    return msgspec.json.decode(text, type=dict)
