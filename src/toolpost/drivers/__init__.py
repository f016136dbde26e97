"""Drivers: one folder per protocol. A driver knows its machine's words and nothing of HTTP."""
