"""The driver for Spark's core: p-states up, G-code and signals down.

`framing` cuts bytes into lines, `pstate` gives lines a meaning, `lines` says what may go down, `flow` decides
how much, and `driver` puts them together.
"""
