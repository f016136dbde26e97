"""Which lines a simulated Spark core takes for commands, and what is wrong with the others."""

import re

_NUMBER = rb"[-+]?(?:[0-9]++(?:\.[0-9]*+)?+|\.[0-9]++)"  # possessive, or a bad line would take for ever
_COMMAND = re.compile(rb"[GM][0-9]{1,4}+(?:\.[0-9])?+(?: *[A-Z]%b)*+ *+" % _NUMBER)
_HOME = re.compile(rb"G28(?: *[XYZC])* *")
_SET = re.compile(rb"f?set +([A-Za-z0-9_]+(?:\.[A-Za-z0-9_]+)*) +([-+]?[0-9]{1,9}(?:\.[0-9]{0,9})?) *")


def is_command(line: bytes) -> bool:
    """Return whether a line would be counted as a command."""
    return bool(line.strip()) and line[:1] != b"?" and line != b"!" and line[:5] != b"fset "


def problem(line: bytes) -> str | None:
    """Return what is wrong with a command, None when nothing is."""
    if line[:1] in (b"G", b"M"):
        known = _COMMAND.fullmatch(line) or _HOME.fullmatch(line)
        return None if known else "invalid command"
    word = line.split(None, 1)[0]
    if word == b"set":
        return None if _SET.fullmatch(line) else "invalid set"
    if line.rstrip() in (b"get", b"stat"):
        return None
    return "unknown command"


def assignment(line: bytes) -> tuple[str, float] | None:
    """Return the key and the value of a ``set`` or ``fset``, None when the line is none."""
    match = _SET.fullmatch(line)
    return (match[1].decode(), float(match[2])) if match else None
