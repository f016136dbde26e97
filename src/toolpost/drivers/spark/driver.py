"""The driver of one Spark core."""

import asyncio
import contextlib
import logging
import re
from collections import deque
from collections.abc import Sequence

from toolpost.clock import now_us
from toolpost.commlog import CommLog
from toolpost.core.job import Reason
from toolpost.core.machine import Execution, LinkState, MachineState
from toolpost.core.report import Report, Value, number
from toolpost.drivers.base import DriverListener, Ending, Line, LineSource, Outcome
from toolpost.drivers.spark import lines
from toolpost.drivers.spark.flow import Flow
from toolpost.drivers.spark.framing import LineFramer, content
from toolpost.drivers.spark.options import SparkOptions
from toolpost.drivers.spark.pacing import HEARTBEAT, drain_delay, refill_delay
from toolpost.drivers.spark.polls import Polls
from toolpost.drivers.spark.pstate import PStateError, PStateParser
from toolpost.errors import LinkError
from toolpost.links.base import Link, Opener

log = logging.getLogger(__name__)

_ASK = b"?queue\n"
_STOP = b"!\n"
_QUEUE_ANSWER = re.compile(rb"queue < cap:(\d{1,6}) num:(\d{1,6}) >")
_QUEUE_FULL = "queue full"
_IDLE_ANSWERS = 2
_MAX_WAITING = 10_000
_MAX_UNWRITTEN = 65_536
_PATIENCE_MOST = 10.0
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
        self._link: Link | None = None
        self._lost = asyncio.Event()
        self._answered = asyncio.Event()
        self._framer = LineFramer()
        self._parser = PStateParser()
        self._flow = Flow()
        self._direct: deque[bytes] = deque()
        self._source: LineSource | None = None
        self._ending: asyncio.Future[Ending] | None = None
        self._polls: Polls | None = None
        self._job_sent = 0
        self._idle_answers = 0
        self._connected_at = 0.0
        self._asked_at = 0.0
        self._hold_until = 0.0
        self._alive = False
        self._fault = False
        self._stop_owed = options.stop_on_connect
        self._unanswered_at: float | None = None
        self._patience = options.answer_timeout
        self._executed_at = (0.0, 0)
        self._ticker: asyncio.TimerHandle | None = None
        self._ask_timer: asyncio.TimerHandle | None = None

    # The machine as seen from above.

    @property
    def state(self) -> MachineState:
        """The machine as it is known now."""
        if self._link is None:
            link = LinkState.OFFLINE
        elif self._fault:
            link = LinkState.FAULT
        elif self._alive:
            link = LinkState.ONLINE
        else:
            link = LinkState.CONNECTING if self.accepting else LinkState.OFFLINE
        busy = self._flow.outstanding or self._direct or self._source is not None
        execution = Execution.ACTIVE if busy else Execution.READY
        if link is not LinkState.ONLINE:
            execution = Execution.ALARM if self._fault else Execution.UNAVAILABLE
        return MachineState(
            link=link,
            execution=execution,
            waiting_commands=len(self._direct),
            machine_commands=self._flow.outstanding,
            job_sent=self._job_sent,
        )

    @property
    def ready(self) -> bool:
        """Whether a job may start: the core answers, is idle, and no hold-off is on."""
        return (
            self._link is not None
            and self._alive
            and not self._fault
            and self._source is None
            and not self._direct
            and self._flow.idle
            and self._loop.time() >= self._hold_until
        )

    @property
    def accepting(self) -> bool:
        """Whether the core would take commands: it answers, or has had no time to answer yet."""
        if self._link is None or self._fault:
            return False
        return self._alive or self._loop.time() - self._connected_at < self._options.answer_timeout

    def line(self, text: str) -> Line:
        """Return what a line is to a core; InvalidRequestError if it must not go on the wire."""
        return lines.classify(text)

    def commands(self, program: Sequence[str]) -> list[bytes]:
        """Return the commands in a program's lines; InvalidLineError if a line is none."""
        return lines.commands(program)

    # What may be asked of the machine.

    def enqueue(self, line: bytes) -> bool:
        """Send a command behind all earlier ones; False if the core cannot take it."""
        if not self.accepting or self._source is not None or len(self._direct) >= _MAX_WAITING:
            return False
        self._direct.append(line)
        self._pump()
        return True

    def send_now(self, line: bytes) -> bool:
        """Send a line ahead of all unsent commands; False if it cannot be sent."""
        link = self._link
        if link is None or link.unwritten > _MAX_UNWRITTEN:
            return False
        text = line.decode("ascii")
        if text == lines.QUEUE:
            self._ask()
        elif lines.is_queued(text):
            # Behind what is written already: an overtaken `?queue` would vouch for it too early.
            self._flow.sent += 1
            self._idle_answers = 0
            self._write(line + b"\n")
            self._ask_if_none()
        else:
            self._comm.down(line + b"\n")
            link.write_now(line + b"\n")
        return True

    async def execute(self, source: LineSource, signals: dict[str, float]) -> Ending:
        """Run a program to its end; the machine must be `ready`."""
        if not self.ready:
            return Ending(Outcome.FAILED, Reason.LINK_LOST, "the machine went away before the start")
        self._ending = self._loop.create_future()
        self._source = source
        self._job_sent = 0
        self._idle_answers = 0
        self._polls = Polls(signals, self.send_now)
        self._polls.start()
        self._pump()
        self._ask_if_none()
        try:
            return await self._ending
        finally:
            self._ending = None

    def stop(self) -> None:
        """Stop the sender, drop what is unsent, then write ``!``; never the other way round."""
        self._drop_work(Ending(Outcome.STOPPED))
        self._send_stop()
        self._listener.changed()

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
                if str(error) != failure:
                    failure = str(error)
                    log.warning("%s: %s; trying again", self._name, failure)
                    self._comm.note(failure)
                    self._listener.changed()
                await asyncio.sleep(delay)
                delay = min(delay * 2, _BACK_OFF_MOST)
                continue
            delay, failure = _BACK_OFF_FIRST, ""
            self._connected()
            await self._lost.wait()
            await asyncio.sleep(delay)

    async def stopped(self, timeout: float) -> None:
        """Return when the core has answered after a `stop`, or after `timeout` seconds."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                while self._link is not None and not self._flow.known:
                    self._answered.clear()
                    await self._answered.wait()

    def close(self) -> None:
        """Close the link."""
        self._cancel_timers()
        if self._polls is not None:
            self._polls.cancel()
        if self._link is not None:
            self._link.close()
            self._link = None

    def _connected(self) -> None:
        log.info("%s: link open", self._name)
        self._comm.note("link open")
        self._framer = LineFramer()
        self._parser = PStateParser()
        self._flow.reset()
        self._connected_at = self._loop.time()
        self._unanswered_at = None
        self._fault = False
        if self._stop_owed:
            self._send_stop()
        else:
            self._ask()
        self._listener.session_started()
        self._listener.changed()
        self._tick()

    def lost(self, reason: str) -> None:
        """The link is gone (`LinkListener`)."""
        log.warning("%s: link lost: %s; it will be reopened", self._name, reason)
        self._comm.note(f"link lost: {reason}")
        self._link = None
        self._alive = False
        self._stop_owed = self._options.stop_on_connect or self._flow.outstanding > 0
        self._flow.reset()
        self._cancel_timers()
        self._drop_work(Ending(Outcome.FAILED, Reason.LINK_LOST, reason))
        self._lost.set()
        self._listener.changed()

    def drained(self) -> None:
        """All that was written has left (`LinkListener`)."""
        self._pump()

    # Up: lines from the core.

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
                capacity, num = int(answer[1]), int(answer[2])
                self._listener.reported(Report(time_us, "queue", {"cap": capacity, "num": num}))
                self._queue_answered(capacity, num)
            else:
                self._line_received(content(line), time_us)

    def _line_received(self, line: str, time_us: int) -> None:
        try:
            pstates = self._parser.feed(line)
        except PStateError as error:
            self._comm.note(f"not understood: {error}")
            if line.startswith("queue"):
                self._flow.skip()
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
            self._flow.skip()
        else:
            self._queue_answered(int(capacity), int(num))

    def _queue_answered(self, capacity: int, num: int) -> None:
        flow = self._flow
        now = self._loop.time()
        self._unanswered_at = None
        self._answered.set()
        if not self._alive:
            self._alive = True
            log.info("%s: the core answers", self._name)
            self._listener.changed()
        if not flow.answer(capacity, num):
            self._ask_if_none()
            return
        # A core that always answers late must not be given up again and again.
        self._patience = max(self._options.answer_timeout, 2 * (now - self._asked_at))
        if flow.idle:
            self._idle()
        else:
            self._idle_answers = 0
        self._pump()
        self._ask_again(now)

    def _idle(self) -> None:
        """The core has answered that it has executed all that was sent."""
        self._idle_answers += 1
        if self._source is None:
            if self._idle_answers == 1:
                self._listener.changed()
        elif self._source.exhausted:
            # Two answers in a row: some firmware reports idle a moment before its planner is empty.
            if self._idle_answers >= _IDLE_ANSWERS:
                self._drop_work(Ending(Outcome.COMPLETED))
                self._listener.changed()
            elif not self._flow.asking:
                self._ask()

    def _booted(self) -> None:
        level = logging.WARNING if self._flow.outstanding or self._source else logging.INFO
        log.log(level, "%s: the core has booted", self._name)
        self._comm.note("the core has booted: what it held is gone")
        self._fault = False
        self._hold_until = 0.0
        self._flow.reset()
        self._drop_work(Ending(Outcome.FAILED, Reason.MACHINE_RESET, "the core has booted"))
        self._listener.session_started()
        self._listener.changed()
        self._ask()

    def _faulted(self) -> None:
        log.error("%s: the core reports a fault; it needs a power cycle", self._name)
        self._fault = True
        self._drop_work(Ending(Outcome.FAILED, Reason.MACHINE_FAULT, "the core reports a fault"))
        self._listener.changed()

    def _overran(self) -> None:
        log.error("%s: the core's queue was full and a command is lost", self._name)
        if self._source is not None:
            detail = "the core's queue was full and a command is lost"
            self._drop_work(Ending(Outcome.FAILED, Reason.QUEUE_FULL, detail))
            self._send_stop()
            self._listener.changed()

    # Down: lines to the core.

    def _pump(self) -> None:
        """Send as many commands as the core has room for."""
        link, flow = self._link, self._flow
        if link is None or link.unwritten or not (self._direct or self._source is not None):
            return
        credit = flow.credit
        if not credit or self._loop.time() < self._hold_until:
            return
        batch: list[bytes] = []
        while self._direct and len(batch) < credit:
            batch.append(self._direct.popleft())
        if self._source is not None:
            taken = self._source.take(credit - len(batch))
            self._job_sent += len(taken)
            batch += taken
        if not batch:
            return
        self._idle_answers = 0
        if flow.asking:
            flow.sent += len(batch)
            self._write(b"\n".join(batch) + b"\n")
            return
        # The question goes before the last half window: its answer comes while that is on the wire.
        first = max(0, len(batch) - flow.window // 2)
        flow.sent += first
        flow.ask()
        self._asked_at = self._loop.time()
        flow.sent += len(batch) - first
        batch.insert(first, _ASK[:-1])
        self._write(b"\n".join(batch) + b"\n")

    def _write(self, block: bytes) -> None:
        if self._link is not None:
            self._comm.down(block)
            self._link.write(block)

    def _ask(self) -> None:
        self._asked_at = self._loop.time()
        self._flow.ask()
        self._write(_ASK)

    def _ask_if_none(self) -> None:
        if self._link is not None and not self._flow.asking:
            self._ask()

    def _ask_again(self, now: float) -> None:
        """Arrange for the next question, by what is still to come."""
        flow = self._flow
        if flow.asking:
            return
        since, before = self._executed_at
        total = flow.sent - flow.outstanding
        executed, elapsed = total - before, now - since
        self._executed_at = (now, total)
        unsent = bool(self._direct) or (self._source is not None and not self._source.exhausted)
        if unsent:
            self._ask_in(refill_delay(flow.waiting, executed, elapsed))
        elif not flow.idle or self._source is not None:
            self._ask_in(drain_delay(flow.waiting, executed, elapsed))

    def _ask_in(self, delay: float) -> None:
        if delay <= 0:
            self._ask()
            return
        if self._ask_timer is not None:
            self._ask_timer.cancel()
        self._ask_timer = self._loop.call_later(delay, self._ask_if_none)

    def _send_stop(self) -> None:
        link = self._link
        if link is None:
            self._stop_owed = True
            return
        self._stop_owed = False
        dropped = link.discard()
        link.write_now(_STOP)
        if dropped:
            count = dropped.count(b"\n")
            self._comm.note(f"{count} lines logged before were not written")
        self._comm.down(_STOP)
        self._flow.forget()
        self._idle_answers = 0
        self._hold_until = self._loop.time() + self._options.hold_off
        self._loop.call_later(self._options.hold_off, self._hold_over)
        self._ask()

    def _hold_over(self) -> None:
        self._pump()
        self._listener.changed()

    def _drop_work(self, ending: Ending) -> None:
        """Forget all unsent commands and end the run, if there is one."""
        self._direct.clear()
        self._source = None
        if self._polls is not None:
            self._polls.cancel()
            self._polls = None
        if self._ending is not None and not self._ending.done():
            self._ending.set_result(ending)

    # Time.

    def _tick(self) -> None:
        """Four times a second: the heartbeat question, and whether the last one was answered."""
        if self._link is None:
            return
        self._ticker = self._loop.call_later(HEARTBEAT, self._tick)
        now = self._loop.time()
        if self._flow.asking and now - self._asked_at > self._options.answer_timeout:
            self._silent(now)
        if self._flow.asking and now - self._asked_at > self._patience:
            self._patience = min(2 * self._patience, _PATIENCE_MOST)
            self._flow.lose()
            self._asked_at = now
        if now - self._asked_at >= HEARTBEAT * 0.9 and not self._flow.asking:
            self._ask()

    def _silent(self, now: float) -> None:
        """The last question was not answered in time."""
        self._unanswered_at = self._unanswered_at or self._asked_at
        if self._alive:
            self._alive = False
            log.warning("%s: the core does not answer", self._name)
            self._comm.note("no answer to ?queue")
            self._listener.changed()
        if self._source is not None and now - self._unanswered_at > self._options.silence_limit:
            detail = f"no answer for {self._options.silence_limit:g} s"
            self._drop_work(Ending(Outcome.FAILED, Reason.MACHINE_SILENT, detail))
            self._send_stop()
            self._listener.changed()

    def _cancel_timers(self) -> None:
        for timer in (self._ticker, self._ask_timer):
            if timer is not None:
                timer.cancel()
