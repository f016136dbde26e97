"""Programs: immutable G-code content, named by its hash."""

import msgspec


class Program(msgspec.Struct, frozen=True):
    """One immutable program.

    Attributes:
        sha256: hash of the stored content, in hex; also its name.
        commands: number of lines, each one a command for the machine.
        size: length of the stored content in bytes.
    """

    sha256: str
    commands: int
    size: int
