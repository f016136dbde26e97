"""The command line; each command is imported when it is called."""

import importlib

import click

from toolpost.version import VERSION

_COMMANDS = ("demo", "key", "serve", "sim")


class _Commands(click.Group):
    """Finds a command in the module of its name."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  # as the base class has it
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002  # as above
        if cmd_name not in _COMMANDS:
            return None
        module = importlib.import_module(f"toolpost.cli.{cmd_name}")
        command: click.Command = module.command
        return command


@click.group(cls=_Commands)
@click.version_option(VERSION, prog_name="toolpost")
def main() -> None:
    """Toolpost: a job server for G-code machines."""
