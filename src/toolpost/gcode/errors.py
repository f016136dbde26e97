"""Why a file cannot be had or kept. The messages are safe to show."""

from toolpost.errors import FileMissingError, InvalidRequestError


class InvalidNameError(InvalidRequestError):
    """A text that no file may be called, or a file of which no job can be made."""


class FileTooLargeError(InvalidRequestError):
    """An upload is longer than allowed."""


class ChecksumError(InvalidRequestError):
    """What arrived is not what the client says it has sent."""


__all__ = ["ChecksumError", "FileMissingError", "FileTooLargeError", "InvalidNameError"]
