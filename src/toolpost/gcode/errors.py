"""Why a file cannot be had or kept. The messages are safe to show."""

from toolpost.errors import InvalidRequestError, ToolpostError


class InvalidNameError(InvalidRequestError):
    """A text that no file may be called, or a file of which no job can be made."""


class FileMissingError(ToolpostError):
    """There is no such file or directory.

    Args:
        name: what was asked for.
    """

    def __init__(self, name: str) -> None:
        super().__init__(f"{name[:200]!r} does not exist")
        self.name = name


class FileTooLargeError(InvalidRequestError):
    """An upload is longer than allowed."""


class ChecksumError(InvalidRequestError):
    """What arrived is not what the client says it has sent."""
