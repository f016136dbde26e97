"""Commands by name, carried out one after the other, and the lines that they put out."""

import asyncio
from collections.abc import Awaitable, Callable
from types import TracebackType

from toolpost.sim.klippy.errors import CommandError, InternalError
from toolpost.sim.klippy.parsing import Command

Handler = Callable[[Command], Awaitable[None] | None]


class Mutex:
    """Lets one script run at a time, first come, first served."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._waiting = 0

    @property
    def busy(self) -> bool:
        """Whether a script runs or waits."""
        return self._waiting > 0 or self._lock.locked()

    async def __aenter__(self) -> None:
        self._waiting += 1
        try:
            await self._lock.acquire()
        finally:
            self._waiting -= 1

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._lock.release()


class GCode:
    """The dispatcher of commands.

    Args:
        problem: says why commands cannot be taken now; None if they can.
        shutdown: called with a text when a command brings the host down.

    Attributes:
        mutex: held while a script runs.
        outputs: called with every line that is put out.
    """

    def __init__(self, problem: Callable[[], str | None], shutdown: Callable[[str], None]) -> None:
        self.mutex = Mutex()
        self.outputs: list[Callable[[str], None]] = []
        self._problem = problem
        self._shutdown = shutdown
        self._handlers: dict[str, Handler] = {}
        self._helps: dict[str, str] = {}
        self._always: set[str] = {"M105", "M21"}

    def register(
        self, name: str, handler: Handler, help_text: str | None = None, *, always: bool = False
    ) -> None:
        """Add a command.

        Args:
            name: in capitals.
            handler: carries it out; may return an awaitable that ends when it is done.
            help_text: what ``gcode/help`` says.
            always: it works before the machine is ready and after a shutdown, too.
        """
        self._handlers[name] = handler
        if help_text is not None:
            self._helps[name] = help_text
        if always:
            self._always.add(name)

    def helps(self) -> dict[str, str]:
        """Return the commands that have a help text, each with it."""
        return dict(self._helps)

    def status(self) -> dict[str, object]:
        """Return the object ``gcode``."""
        helps = self._helps
        return {"commands": {name: {"help": helps[name]} if name in helps else {} for name in self._handlers}}

    async def run_script(self, script: str) -> None:
        """Run lines when all earlier scripts are done.

        Raises:
            CommandError: a line was refused; those after it were not run.
        """
        async with self.mutex:
            for line in script.split("\n"):
                await self.run_line(line)

    async def run_line(self, line: str) -> bool:
        """Run one line; the caller holds the mutex.

        Returns:
            Whether there was a command in it.

        Raises:
            CommandError: it was refused, and the output said so.
        """
        command = Command(line)
        try:
            waiting = self._dispatch(command)
            if waiting is not None:
                await waiting
        except CommandError as error:
            self.complain(str(error))
            raise
        except InternalError as error:
            text = f'Internal error on command:"{command.name}"'
            self._shutdown(text)
            self.complain(text)
            raise CommandError(str(error)) from error
        return bool(command.name)

    def _dispatch(self, command: Command) -> Awaitable[None] | None:
        problem = self._problem()
        if problem is not None and command.name not in self._always:
            raise CommandError(problem)
        handler = self._handlers.get(command.name)
        if handler is not None:
            return handler(command)
        if command.name:
            self.inform(f'Unknown command:"{command.name}"')
        return None

    def respond(self, line: str) -> None:
        """Put out a line."""
        for output in tuple(self.outputs):
            output(line)

    def inform(self, text: str) -> None:
        """Put out a text as comment lines, in one message."""
        self.respond("\n".join(f"// {line.strip()}" for line in text.strip().split("\n")))

    def complain(self, text: str) -> None:
        """Put out an error: ``!!`` and its first line, after the whole text if there is more."""
        lines = text.strip().split("\n")
        if len(lines) > 1:
            self.inform(text)
        self.respond(f"!! {lines[0].strip()}")
