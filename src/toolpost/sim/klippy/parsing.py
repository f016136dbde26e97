"""G-code lines as Klipper reads them."""

import math
import re
import shlex
from functools import cached_property

from toolpost.sim.klippy.errors import CommandError

_NUMBERED = re.compile(r"N[0-9]+\s*")
_NAME = re.compile(r"[^A-Z_\s]*[A-Z_]+[^A-Z_\s*]*")
_WORD = re.compile(r"([A-Z_]+)([^A-Z_*]*)")
_CLASSIC = re.compile(r"[A-Z][0-9]+(?:\.[0-9]+)?")


class Command:
    """One line of G-code.

    Args:
        line: the line, with or without a comment.

    Attributes:
        line: the line without the spaces around it.
        name: the command in capitals, ``G1`` or ``SDCARD_PRINT_FILE``; empty when there is none.
    """

    def __init__(self, line: str) -> None:
        self.line = line.strip()
        self._code = self.line.partition(";")[0].upper()
        numbered = _NUMBERED.match(self._code)
        start = numbered.end() if numbered else 0
        match = _NAME.match(self._code, start)
        self.name = match[0] if match else self._code[start:].strip()
        self._end = match.end() if match else len(self._code)

    @property
    def text(self) -> str:
        """What follows the name, as it was written."""
        return self.line[self._end :].removeprefix(" ")

    @cached_property
    def params(self) -> dict[str, str]:
        """The parameters: letters of a classic command, ``NAME=value`` words of any other.

        Raises:
            CommandError: a word is no ``NAME=value``, or a quote is not closed.
        """
        if _CLASSIC.fullmatch(self.name):
            return {key: value.strip() for key, value in _WORD.findall(self._code[self._end :])}
        params = {}
        for word in self._words():
            key, equals, value = word.partition("=")
            if not equals:
                raise CommandError(f"Malformed command '{self.line}'")
            params[key.upper()] = value
        return params

    def _words(self) -> list[str]:
        lexer = shlex.shlex(self.text, posix=True, punctuation_chars=False)
        lexer.commenters = "#;"
        lexer.whitespace_split = True
        try:
            return list(lexer)
        except ValueError:
            raise CommandError(f"Malformed command '{self.line}'") from None

    def get(self, name: str, default: str | None = None) -> str:
        """Return a parameter.

        Raises:
            CommandError: it is missing and there is no ``default``.
        """
        value = self.params.get(name, default)
        if value is None:
            raise CommandError(f"Error on '{self.line}': missing {name}")
        return value

    def number(
        self,
        name: str,
        default: float | None = None,
        *,
        least: float = -math.inf,
        above: float = -math.inf,
    ) -> float:
        """Return a parameter as a number.

        Raises:
            CommandError: it is missing and there is no ``default``, is no number or is too small.
        """
        if default is not None and name not in self.params:
            return default
        text = self.get(name)
        try:
            value = float(text)
        except ValueError:
            raise CommandError(f"Error on '{self.line}': unable to parse {text}") from None
        if value < least:
            raise CommandError(f"Error on '{self.line}': {name} must have minimum of {least}")
        if value <= above:
            raise CommandError(f"Error on '{self.line}': {name} must be above {above}")
        return value
