"""``toolpost key``: API keys."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TypeVar

import click

from toolpost.cli.common import data_option, fail
from toolpost.errors import ToolpostError
from toolpost.store.database import Database
from toolpost.store.keys import KeyStore

T = TypeVar("T")


@click.group("key")
def command() -> None:
    """Make, list and delete API keys; a running server knows of it at once."""


@command.command()
@click.argument("name")
@data_option
def add(name: str, data: Path) -> None:
    """Make a key for NAME and print it, this once."""
    secret = _with_keys(data, lambda keys: keys.add(name))
    if secret is None:
        fail(f"there is a key named {name!r} already")
    click.echo(secret)


@command.command("list")
@data_option
def list_keys(data: Path) -> None:
    """Print the names of all keys."""

    async def names(keys: KeyStore) -> list[str]:
        return keys.names()

    for name in _with_keys(data, names):
        click.echo(name)


@command.command()
@click.argument("name")
@data_option
def delete(name: str, data: Path) -> None:
    """Delete the key of NAME."""
    if not _with_keys(data, lambda keys: keys.delete(name)):
        fail(f"there is no key named {name!r}")


def _with_keys(data: Path, call: Callable[[KeyStore], Awaitable[T]]) -> T:
    async def run() -> T:
        database = Database(data / "toolpost.db")
        try:
            return await call(KeyStore(database))
        finally:
            database.close()

    try:
        data.mkdir(parents=True, exist_ok=True)
        return asyncio.run(run())
    except OSError as error:
        fail(f"data directory {data}: {error.strerror}")
    except ToolpostError as error:
        fail(error)
