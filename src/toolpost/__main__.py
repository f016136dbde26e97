"""``python -m toolpost``: the same as the command ``toolpost``."""

from toolpost.cli import main

main(prog_name="toolpost")
