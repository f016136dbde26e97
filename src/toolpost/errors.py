"""The errors that cross module borders. One tree, so that one place can route them."""


class ToolpostError(Exception):
    """Toolpost could not do what was asked."""


class InvalidRequestError(ToolpostError):
    """The request is malformed. The message names the field and is safe to show."""


class InvalidLineError(InvalidRequestError):
    """One of several lines must not go to the machine.

    Args:
        index: which line, from 0.
        problem: what is wrong with it; goes on from the line's name, e.g. "must be ...".
    """

    def __init__(self, index: int, problem: str) -> None:
        super().__init__(f"[{index}]: {problem}")
        self.index = index
        self.problem = problem


class FileMissingError(ToolpostError):
    """There is no such file or directory.

    Args:
        name: what was asked for.
    """

    def __init__(self, name: str) -> None:
        super().__init__(f"{name[:200]!r} does not exist")
        self.name = name


class NotAcceptedError(ToolpostError):
    """The request is well formed, but the machine's present state does not allow it."""


class StorageError(ToolpostError):
    """The disk did not take what had to be stored. Nothing of the request was kept."""


class ProgramError(StorageError):
    """A stored program is missing or is not what it was."""


class ConfigError(ToolpostError):
    """The configuration is wrong. The message names the key and the fix."""


class StartError(ToolpostError):
    """The server cannot start: an address, a port or the data directory is not to be had."""


class LinkError(ToolpostError):
    """The link to a machine could not be opened or has broken."""
