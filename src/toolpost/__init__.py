"""Toolpost: a job server for G-code machines."""

from toolpost.version import VERSION as __version__

__all__ = ["__version__"]
