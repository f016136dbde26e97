"""The object ``virtual_sdcard``: prints a file from a directory of the host."""

import asyncio
import codecs
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import msgspec

from toolpost.sim.klippy.errors import CommandError, InternalError
from toolpost.sim.klippy.files import find, listing
from toolpost.sim.klippy.gcode import GCode
from toolpost.sim.klippy.parsing import Command
from toolpost.sim.klippy.print_stats import PrintStats

YIELD = 0.05
"""A file waits this long, in seconds, whenever another script runs or waits."""

_PIECE = 8192
_LET_OTHERS = 100  # lines after which other tasks get their turn, however fast the lines are


class Run(msgspec.Struct):
    """One start of a file, for tests.

    Attributes:
        filename: as it was asked for.
        lines: commands that were carried out to their end; blank lines and comments are none.
    """

    filename: str
    lines: int = 0


class VirtualSdCard:
    """Prints files.

    Args:
        gcode: where the commands are registered and the lines run.
        stats: is told what becomes of the file.
        directory: where the files are.
        runs: gets an entry for every file that is started.
        on_error: called when a line of the file was refused; turns the heaters off.
        on_reset: called when a file is put away.

    Attributes:
        error: the next line of the file fails with this text; None for no such fault.
    """

    def __init__(
        self,
        gcode: GCode,
        stats: PrintStats,
        directory: Path,
        runs: list[Run],
        on_error: Callable[[], None],
        on_reset: Callable[[], None],
    ) -> None:
        self.error: str | None = None
        self._gcode = gcode
        self._stats = stats
        self._directory = directory
        self._runs = runs
        self._on_error = on_error
        self._on_reset = on_reset
        self._file: BinaryIO | None = None
        self._path: Path | None = None
        self._run: Run | None = None
        self._position = 0
        self._size = 0
        self._task: asyncio.Task[None] | None = None
        self._resting = asyncio.Event()
        self._resting.set()
        self._must_pause = False
        self._in_line = False
        gcode.register("SDCARD_PRINT_FILE", self._print, "FILENAME: prints a file")
        gcode.register("SDCARD_RESET_FILE", self._put_away, "Puts the file away")
        gcode.register("M20", self._list)
        gcode.register("M21", lambda _command: gcode.respond("SD card ok"), always=True)
        gcode.register("M23", self._select)
        gcode.register("M24", lambda _command: self.resume())
        gcode.register("M25", lambda _command: self.pause())
        gcode.register("M26", self._seek)
        gcode.register("M27", self._report)

    # -- for the other parts

    @property
    def active(self) -> bool:
        """Whether lines of a file are being run."""
        return self._task is not None

    def progress(self) -> float:
        """Return how much of the file was read, 0 to 1."""
        return self._position / self._size if self._size else 0.0

    async def pause(self) -> None:
        """Stop after the present line, and wait for its end unless it is the caller."""
        if self._task is None:
            return
        self._must_pause = True
        if not self._in_line:
            await self._resting.wait()

    def resume(self) -> None:
        """Go on; without effect when there is no file.

        Raises:
            CommandError: a file is being printed.
        """
        if self._task is not None:
            raise CommandError("SD busy")
        if self._file is None:
            return
        if self._run is None:
            self._run = Run(self._stats.filename)
            self._runs.append(self._run)
        self._must_pause = False
        self._resting.clear()
        self._task = asyncio.create_task(self._work(self._file, self._run))

    async def cancel(self) -> None:
        """Give the file up."""
        if self._file is not None:
            await self.pause()
            self._close()
            self._stats.note_end("cancelled")
        self._position = self._size = 0

    def halt(self) -> None:
        """Stop after the present line, as in a shutdown."""
        self._must_pause = True

    def stop(self) -> asyncio.Task[None] | None:
        """End at once, as with the process; return the task that ends, if there is one."""
        if self._task is not None:
            self._task.cancel()
        self._close()
        return self._task

    # -- commands

    async def _print(self, command: Command) -> None:
        if self._task is not None:
            raise CommandError("SD busy")
        await self._reset()
        name = command.get("FILENAME")
        if not name:
            raise InternalError("string index out of range")  # a real host shuts down (measured)
        self._load(name)
        self.resume()

    async def _put_away(self, _command: Command) -> None:
        if self._in_line:
            raise CommandError("SDCARD_RESET_FILE cannot be run from the sdcard")
        await self._reset()

    def _list(self, _command: Command) -> None:
        self._gcode.respond("Begin file list")
        for name, size in listing(self._directory):
            if "/" not in name:
                self._gcode.respond(f"{name} {size}")
        self._gcode.respond("End file list")

    async def _select(self, command: Command) -> None:
        if self._task is not None:
            raise CommandError("SD busy")
        await self._reset()
        self._load(command.text.strip())

    def _seek(self, command: Command) -> None:
        if self._task is not None:
            raise CommandError("SD busy")
        self._position = int(command.number("S", least=0))

    def _report(self, _command: Command) -> None:
        if self._file is None:
            self._gcode.respond("Not SD printing.")
        else:
            self._gcode.respond(f"SD printing byte {self._position}/{self._size}")

    async def _reset(self) -> None:
        if self._file is not None:
            await self.pause()
            self._close()
        self._position = self._size = 0
        self._stats.reset()
        self._on_reset()

    def _load(self, name: str) -> None:
        name = name.removeprefix("/")
        path = find(self._directory, name)
        if path is None:
            raise CommandError("Unable to open file")
        try:
            self._file = path.open("rb")
        except OSError:
            raise CommandError("Unable to open file") from None
        self._path = path
        self._run = None
        self._position = 0
        self._size = path.stat().st_size
        self._gcode.respond(f"File opened:{name} Size:{self._size}")
        self._gcode.respond("File selected")
        self._stats.select(name)

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None
        self._path = None

    # -- the file's lines

    async def _work(self, file: BinaryIO, run: Run) -> None:
        """Run the file from the present position on until its end, a pause or an error."""
        self._stats.note_start()
        error: str | None = None
        try:
            await self._run_lines(file, run)
        except CommandError as refused:
            error = str(refused)
            self._on_error()
        except UnicodeDecodeError:
            pass  # a real host stops without a word, and the state is "paused" (measured)
        finally:
            self._task = None
            self._in_line = False
            self._resting.set()
        if error is not None:
            self._stats.note_end("error", error)
        elif self._file is not None:
            self._stats.note_pause()
        else:
            self._stats.note_end("complete")

    async def _run_lines(self, file: BinaryIO, run: Run) -> None:
        file.seek(self._position)
        decoder = codecs.getincrementaldecoder("utf-8")()
        lines: deque[str] = deque()
        rest = ""
        fast = 0
        while not self._must_pause:
            if not lines:
                data = file.read(_PIECE)
                text = decoder.decode(data, final=not data)
                if not data:
                    # What stands after the last line end is never run (measured).
                    self._close()
                    self._gcode.respond("Done printing file")
                    return
                *whole, rest = (rest + text).split("\n")
                lines.extend(whole)
                continue
            if self._gcode.mutex.busy:
                await asyncio.sleep(YIELD)
                continue
            line = lines.popleft()
            await self._run_line(line, run)
            self._position += len(line.encode()) + 1
            fast += 1
            if fast % _LET_OTHERS == 0:
                await asyncio.sleep(0)

    async def _run_line(self, line: str, run: Run) -> None:
        async with self._gcode.mutex:
            self._in_line = True
            try:
                if self.error is not None:
                    text, self.error = self.error, None
                    self._gcode.complain(text)
                    raise CommandError(text)
                run.lines += await self._gcode.run_line(line)
            finally:
                self._in_line = False

    def status(self) -> dict[str, object]:
        """Return the object's fields; position and size in bytes."""
        return {
            "file_path": None if self._path is None else str(self._path),
            "progress": self.progress(),
            "is_active": self.active,
            "file_position": self._position,
            "file_size": self._size,
        }
