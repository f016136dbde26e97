"""Toolpost: a job server for G-code machines."""
