"""The driver of one Spark core: its link, what it says, and the run of a program."""

import asyncio
import contextlib
import logging
import re
from collections.abc import Sequence

from toolpost.clock import now_us
from toolpost.commlog import CommLog
from toolpost.core.job import Reason
from toolpost.core.machine import Execution, LinkState, MachineState
from toolpost.core.report import Report, Value, number
from toolpost.drivers.base import DriverListener, Ending, Line, LineSource, Outcome
from toolpost.drivers.spark import lines
from toolpost.drivers.spark.framing import LineFramer, content
from toolpost.drivers.spark.options import SparkOptions
from toolpost.drivers.spark.pacing import HEARTBEAT
from toolpost.drivers.spark.polls import Polls
from toolpost.drivers.spark.pstate import PStateError, PStateParser
from toolpost.drivers.spark.sender import Sender
from toolpost.errors import LinkError
from toolpost.links.base import Link, Opener

log = logging.getLogger(__name__)

_QUEUE_ANSWER = re.compile(rb"queue < cap:(\d{1,6}) num:(\d{1,6}) >")
_QUEUE_FULL = "queue full"
_STALL = 3 * HEARTBEAT
_BACK_OFF_FIRST, _BACK_OFF_MOST = 0.1, 5.0


class SparkDriver:
    """Drives one Spark core.

    Args:
        name: name of the machine, for messages.
        opener: opens the link.
        comm: the machine's comm log.
        listener: who is told of reports and changes.
        options: see `SparkOptions`.
    """

    def __init__(
        self,
        name: str,
        opener: Opener,
        comm: CommLog,
        listener: DriverListener,
        options: SparkOptions,
    ) -> None:
        self._name = name
        self._opener = opener
        self._comm = comm
        self._listener = listener
        self._options = options
        self._loop = asyncio.get_running_loop()
        self._sender = Sender(comm, options, listener.changed, self._source_broken)
        self._link: Link | None = None
        self._lost = asyncio.Event()
        self._answered = asyncio.Event()
        self._framer = LineFramer()
        self._parser = PStateParser()
        self._ending: asyncio.Future[Ending] | None = None
        self._polls: Polls | None = None
        self._connected_at = self._loop.time()
        self._link_gone = False
        self._silent_since: float | None = None
        self._alive = False
        self._fault = False
        self._ticker: asyncio.TimerHandle | None = None
        self._ticked_at = 0.0

    # The machine as seen from above.

    @property
    def state(self) -> MachineState:
        """The machine as it is known now."""
        sender = self._sender
        link = self._link_state()
        if link is LinkState.ONLINE:
            busy = sender.outstanding or sender.waiting or sender.running
            execution = Execution.ACTIVE if busy else Execution.READY
        else:
            execution = Execution.ALARM if self._fault else Execution.UNAVAILABLE
        return MachineState(
            link=link,
            execution=execution,
            waiting_commands=sender.waiting,
            machine_commands=sender.outstanding,
            job_sent=sender.taken,
        )

    @property
    def ready(self) -> bool:
        """Whether a job may start: the core answers, is idle, and no hold-off is on."""
        return self._link is not None and self._alive and not self._fault and self._sender.idle

    @property
    def accepting(self) -> bool:
        """Whether the core would take commands: it answers, or has had no time to answer yet."""
        if self._fault or self._link_gone:
            return False
        return self._alive or self._loop.time() - self._connected_at < self._options.answer_timeout

    def _link_state(self) -> LinkState:
        if self._link is None:
            return LinkState.OFFLINE
        if self._fault:
            return LinkState.FAULT
        if self._alive:
            return LinkState.ONLINE
        return LinkState.CONNECTING if self.accepting else LinkState.OFFLINE

    # What may be asked of the machine.

    def line(self, text: str) -> Line:
        """Return what a line is to a core; InvalidRequestError if it must not go on the wire."""
        return lines.classify(text)

    def commands(self, program: Sequence[str]) -> list[bytes]:
        """Return the commands in a program's lines; InvalidLineError if a line is none."""
        return lines.commands(program)

    def enqueue(self, line: bytes) -> bool:
        """Send a command behind all earlier ones; False if the core cannot take it."""
        if self._link is None or not self.accepting or self._sender.running:
            return False
        return self._sender.enqueue(line)

    def send_now(self, line: bytes) -> bool:
        """Send a line ahead of all unsent commands; False if it cannot be sent."""
        return self._sender.send_now(line)

    async def execute(self, source: LineSource, signals: dict[str, float]) -> Ending:
        """Run a program to its end; the machine must be `ready`."""
        if self._link is None or self._fault:
            return Ending(Outcome.FAILED, Reason.LINK_LOST, "the machine went away before the start")
        self._ending = self._loop.create_future()
        self._polls = Polls(signals, self._sender.send_now)
        # Each of these may find the link broken, which ends the run at once.
        self._sender.run(source)
        if self._polls is not None:
            self._polls.start()
        try:
            return await self._ending
        finally:
            self._ending = None
            self._sender.end_run()

    def stop(self) -> None:
        """Stop the sender, drop what is unsent, then write ``!``; never the other way round."""
        self._end_work(Ending(Outcome.STOPPED))
        self._sender.stop()
        self._listener.changed()

    async def stopped(self, timeout: float) -> None:
        """Return when the core has answered after a `stop`, or after `timeout` seconds."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                while self._link is not None and not self._sender.known:
                    self._answered.clear()
                    await self._answered.wait()

    def _end_work(self, ending: Ending) -> None:
        """Forget all unsent commands and end the run, if there is one."""
        self._sender.drop()
        if self._polls is not None:
            self._polls.cancel()
            self._polls = None
        if self._ending is not None and not self._ending.done():
            self._ending.set_result(ending)

    # The link.

    async def run(self) -> None:
        """Keep the link up until canceled: reopen it with a growing delay when it goes."""
        delay = _BACK_OFF_FIRST
        failure = ""
        while True:
            try:
                self._lost.clear()
                self._link = await self._opener(self)
            except LinkError as error:
                self._link_gone = True
                if str(error) != failure:
                    failure = str(error)
                    log.warning("%s: %s; trying again", self._name, failure)
                    self._comm.note(failure)
                    self._listener.changed()
                await asyncio.sleep(delay)
                delay = min(delay * 2, _BACK_OFF_MOST)
                continue
            delay, failure = _BACK_OFF_FIRST, ""
            self._connected(self._link)
            await self._lost.wait()
            await asyncio.sleep(delay)

    def close(self) -> None:
        """Close the link."""
        self._cancel_ticker()
        self._sender.close()
        if self._polls is not None:
            self._polls.cancel()
        self._link_gone = True
        if self._link is not None:
            self._link.close()
            self._link = None

    def _connected(self, link: Link) -> None:
        log.info("%s: link open", self._name)
        self._comm.note("link open")
        self._framer = LineFramer()
        self._parser = PStateParser()
        self._connected_at = self._loop.time()
        self._silent_since = None
        # A fault lasts until the power is cycled, which a boot tells, not a plug.
        self._link_gone = False
        self._sender.attach(link)
        self._listener.session_started()
        self._listener.changed()
        self._tick()

    def lost(self, reason: str) -> None:
        """The link is gone (`LinkListener`)."""
        log.warning("%s: link lost: %s; it will be reopened", self._name, reason)
        self._comm.note(f"link lost: {reason}")
        self._link = None
        self._link_gone = True
        self._alive = False
        self._sender.detach()
        self._cancel_ticker()
        self._end_work(Ending(Outcome.FAILED, Reason.LINK_LOST, reason))
        self._lost.set()
        self._listener.changed()

    def drained(self) -> None:
        """All that was written has left (`LinkListener`)."""
        self._sender.pump()

    # Lines from the core.

    def received(self, data: bytes) -> None:
        """Bytes have come from the core (`LinkListener`)."""
        # The firmware echoes an empty line for each LF that it gets when idle.
        arrived = [line for raw in self._framer.feed(data) if (line := raw.rstrip(b"\r"))]
        if not arrived:
            return
        self._comm.up(arrived)
        time_us = now_us()
        for line in arrived:
            answer = _QUEUE_ANSWER.fullmatch(line)
            if answer is not None:
                queue: dict[str, Value] = {"cap": int(answer[1]), "num": int(answer[2])}
                self._listener.reported(Report(time_us, "queue", queue))
                self._queue_reported(queue)
            else:
                self._line_received(content(line), time_us)

    def _line_received(self, line: str, time_us: int) -> None:
        try:
            pstates = self._parser.feed(line)
        except PStateError as error:
            self._comm.note(f"not understood: {error}")
            if line.startswith("queue"):
                self._sender.answered_nonsense()
            return
        for pstate in pstates:
            self._listener.reported(Report(time_us, pstate.tag, pstate.values))
            if pstate.tag == "queue":
                self._queue_reported(pstate.values)
            elif pstate.tag == "init" or (pstate.tag == "sys" and pstate.values.get("ev") == "boot"):
                self._booted()
            elif pstate.tag == "sys" and pstate.values.get("ev") == "fault":
                self._faulted()
            elif pstate.tag == "error" and pstate.values.get("msg") == _QUEUE_FULL:
                self._overran()

    def _queue_reported(self, values: dict[str, Value]) -> None:
        capacity, num = number(values.get("cap")), number(values.get("num"))
        if capacity is None or num is None or capacity < 1 or num < 0:
            self._sender.answered_nonsense()
        else:
            self._queue_answered(int(capacity), int(num))

    def _queue_answered(self, capacity: int, num: int) -> None:
        self._silent_since = None
        self._answered.set()
        was_ready = self.ready
        if not self._alive:
            self._alive = True
            log.info("%s: the core answers", self._name)
        self._sender.answered(capacity, num)
        if self._sender.finished:
            self._end_work(Ending(Outcome.COMPLETED))
        if self.ready and not was_ready:
            self._listener.changed()

    def _booted(self) -> None:
        working = self._sender.running or self._sender.outstanding
        log.log(logging.WARNING if working else logging.INFO, "%s: the core has booted", self._name)
        self._comm.note("the core has booted: what it held is gone")
        self._fault = False
        if working:
            # What was on its way when the core booted would be executed by the fresh one.
            self._sender.stop_owed = True
        self._connected_at = self._loop.time()
        self._end_work(Ending(Outcome.FAILED, Reason.MACHINE_RESET, "the core has booted"))
        self._sender.reset()
        self._listener.session_started()
        self._listener.changed()

    def _faulted(self) -> None:
        log.error("%s: the core reports a fault; it needs a power cycle", self._name)
        self._fault = True
        self._end_work(Ending(Outcome.FAILED, Reason.MACHINE_FAULT, "the core reports a fault"))
        self._listener.changed()

    def _overran(self) -> None:
        log.error("%s: the core's queue was full and a command is lost", self._name)
        if self._sender.running:
            self._fail_and_stop(Reason.QUEUE_FULL, "the core's queue was full and a command is lost")

    def _source_broken(self, detail: str) -> None:
        if self._sender.running:
            log.error("%s: %s", self._name, detail)
            self._fail_and_stop(Reason.PROGRAM_MISSING, detail)

    def _fail_and_stop(self, reason: Reason, detail: str) -> None:
        self._end_work(Ending(Outcome.FAILED, reason, detail))
        self._sender.stop()
        self._listener.changed()

    # Time.

    def _tick(self) -> None:
        """Four times a second: the heartbeat question, and whether the last one was answered."""
        if self._link is None:
            return
        self._ticker = self._loop.call_later(HEARTBEAT, self._tick)
        now = self._loop.time()
        if now - self._ticked_at > _STALL:
            # This process was not run for a while: what the core has said meanwhile is read after this.
            self._sender.excuse(now)
            self._silent_since = None
        self._ticked_at = now
        if self._sender.overdue(now):
            self._silent(now)
        self._sender.beat(now)

    def _silent(self, now: float) -> None:
        """The last question was not answered in time."""
        if self._silent_since is None:
            self._silent_since = self._sender.asked_at
        if self._alive:
            self._alive = False
            log.warning("%s: the core does not answer", self._name)
            self._comm.note("no answer to ?queue")
            self._listener.changed()
        limit = self._options.silence_limit
        if self._sender.running and now - self._silent_since > limit:
            self._fail_and_stop(Reason.MACHINE_SILENT, f"no answer for {limit:g} s")

    def _cancel_ticker(self) -> None:
        if self._ticker is not None:
            self._ticker.cancel()
