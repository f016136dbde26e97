"""What several commands share."""

import asyncio
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, NoReturn

import click

from toolpost.config import DEFAULT, Config, load
from toolpost.errors import ToolpostError

STOP_TIMEOUT = 20.0
"""Seconds within which a server must have stopped; a disk that hangs does not hold it up for longer."""


def default_data_directory() -> Path:
    """Return the data directory of a user who names none (XDG Base Directory)."""
    home = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(home) / "toolpost"


def data_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the option ``--data``."""
    return click.option(
        "--data",
        type=click.Path(path_type=Path, file_okay=False),
        default=default_data_directory,
        show_default="~/.local/share/toolpost",
        help="The data directory.",
    )(function)


def read_config(path: Path | None) -> Config:
    """Return the configuration of a file, or the default one; ends the program if it is wrong."""
    if path is None:
        return DEFAULT
    try:
        return load(path)
    except ToolpostError as error:
        fail(error)


def set_up_logging(*, verbose: bool) -> None:
    """Log to standard error, one line a message."""
    logging.basicConfig(
        stream=sys.stderr,
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(asctime)s %(levelname)-7s %(message)s",
    )
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    logging.getLogger("asyncio").setLevel(logging.WARNING)


def run(main: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a coroutine on a fast loop; a `ToolpostError` ends the program with one line."""
    import uvloop

    try:
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(main())
    except ToolpostError as error:
        fail(error)


def on_stop_signals(stop: Callable[[], None]) -> None:
    """Call `stop` on SIGTERM and SIGINT; a second one, or `STOP_TIMEOUT` seconds, end the program at once."""
    stopping = False

    def handle() -> None:
        nonlocal stopping
        if stopping:
            _exit_at_once("stopped again")
        stopping = True
        watchdog = threading.Timer(STOP_TIMEOUT, _exit_at_once, ["could not stop in time"])
        watchdog.daemon = True
        watchdog.start()
        stop()

    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, handle)


def _exit_at_once(reason: str) -> None:
    sys.stderr.write(f"toolpost: {reason}; ending without more ado\n")
    sys.stderr.flush()
    os._exit(1)


def fail(error: object) -> NoReturn:
    """End the program with one line on standard error and status 1."""
    click.echo(f"toolpost: {error}", err=True)
    sys.exit(1)
