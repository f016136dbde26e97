"""``toolpost sim``: a simulated machine by itself."""

from pathlib import Path
from typing import Literal

import click

from toolpost.cli.common import fail, run
from toolpost.sim.faults import Fault
from toolpost.sim.options import SparkOptions
from toolpost.sim.run import run as run_spark


@click.group("sim")
def command() -> None:
    """Simulate a machine on a pty."""


@command.command()
@click.option("--link", type=click.Path(path_type=Path), help="A path for a symlink to the pty.")
@click.option("--capacity", default=64, show_default=True, help="Commands that its queue holds.")
@click.option("--command-time", default=0.05, show_default=True, help="Seconds that each command takes.")
@click.option("--realtime", is_flag=True, help="Moves take the time of their distance and feed.")
@click.option("--answer-delay", default=0.0, show_default=True, help="Seconds until an answer is sent.")
@click.option(
    "--hold-off", default=0.5, show_default=True, help="Seconds after ! in which commands are ignored."
)
@click.option(
    "--boot-message",
    type=click.Choice(["sys", "init", "none"]),
    default="sys",
    show_default=True,
    help="What it says when it boots: as newer firmware, as older, or nothing.",
)
@click.option("--baud", type=click.IntRange(min=50), help="Speed of the wire; without it, no limit.")
@click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="NAME[:ARG][@WHEN]",
    help="A fault to have, e.g. mute:2@100 (after 100 commands) or reboot@5s; more can be typed later.",
)
def spark(
    *,
    link: Path | None,
    capacity: int,
    command_time: float,
    realtime: bool,
    answer_delay: float,
    hold_off: float,
    boot_message: Literal["sys", "init", "none"],
    baud: int | None,
    faults: tuple[str, ...],
) -> None:
    """Simulate a Spark core."""
    try:
        options = SparkOptions(
            capacity=capacity,
            command_time=command_time,
            realtime_moves=realtime,
            answer_delay=answer_delay,
            hold_off=hold_off,
            boot_message=boot_message,
        )
        planned = [Fault.parse(text) for text in faults]
    except ValueError as error:
        fail(error)
    run(lambda: run_spark(options, link=link, baud=baud, faults=planned))
