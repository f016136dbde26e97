"""``toolpost serve``: the server."""

import gc
import os
import resource
from pathlib import Path

import click

from toolpost.cli.common import data_option, fail, on_stop_signals, read_config, run, set_up_logging
from toolpost.config import Address, parse_address
from toolpost.errors import ConfigError


@click.command()
@click.option(
    "--config",
    type=click.Path(path_type=Path, dir_okay=False),
    help="The configuration; without it, one simulated machine is served.",
)
@data_option
@click.option("--listen", multiple=True, metavar="HOST:PORT", help="Listen here instead.")
@click.option("--verbose", is_flag=True, help="Log more.")
def command(config: Path | None, data: Path, listen: tuple[str, ...], *, verbose: bool) -> None:
    """Drive the machines and answer requests until SIGTERM."""
    os.umask(os.umask(0o027) | 0o027)
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    set_up_logging(verbose=verbose)
    settings = read_config(config)
    addresses = _addresses(listen)

    async def serve() -> None:
        from toolpost.app import App

        app = App(settings, data, addresses)
        on_stop_signals(app.stop)
        # What is alive after the start stays so: the collector need not look at it again.
        gc.freeze()
        await app.run(lambda url: click.echo(f"toolpost: ready on {url}"))

    run(serve)


def _addresses(listen: tuple[str, ...]) -> list[Address] | None:
    try:
        return [parse_address(text, "--listen") for text in listen] or None
    except ConfigError as error:
        fail(error)
