"""Toolpost: a job server for G-code machines."""

__version__ = "0.1.0"
