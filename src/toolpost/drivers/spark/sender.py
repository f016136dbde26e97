"""What goes down to a core: commands as fast as it takes them, questions about its queue, and the stop.

Two lanes: lines sent with `send_now` overtake all commands that are not written yet. ``?queue`` never does,
because its answer vouches for the commands written before it.
"""

import asyncio
from collections import deque
from collections.abc import Callable

from toolpost.commlog import CommLog
from toolpost.drivers.base import LineSource
from toolpost.drivers.spark import lines
from toolpost.drivers.spark.flow import Flow
from toolpost.drivers.spark.options import SparkOptions
from toolpost.drivers.spark.pacing import HEARTBEAT, drain_delay, refill_delay
from toolpost.errors import StorageError
from toolpost.links.base import Link

_ASK = b"?queue\n"
_STOP = b"!\n"
_IDLE_ANSWERS = 2
_MAX_WAITING = 100_000
_MAX_UNWRITTEN = 65_536
_PATIENCE_MOST = 10.0
_HOLD_MARGIN = 1.1


class Sender:
    """Sends to one core.

    Args:
        comm: logs what is sent.
        options: see `SparkOptions`.
        free: called when the hold-off after a stop is over.
        broken: called, with words for a person, when the source cannot be read.

    Attributes:
        taken: commands of the present run that have been sent; 0 between two runs.
        asked_at: since when an answer is awaited, or when the last one came (loop time).
        stop_owed: whether a stop has to be sent as soon as there is a link.
    """

    def __init__(
        self,
        comm: CommLog,
        options: SparkOptions,
        free: Callable[[], None],
        broken: Callable[[str], None],
    ) -> None:
        self.taken = 0
        self.asked_at = 0.0
        self.stop_owed = options.stop_on_connect
        self._comm = comm
        self._options = options
        self._free = free
        self._broken = broken
        self._loop = asyncio.get_running_loop()
        self._link: Link | None = None
        self._flow = Flow()
        self._direct: deque[bytes] = deque()
        self._source: LineSource | None = None
        self._idle_answers = 0
        self._patience = options.answer_timeout
        self._executed_at = (0.0, 0)
        self._holding = False
        self._hold_timer: asyncio.TimerHandle | None = None
        self._ask_timer: asyncio.TimerHandle | None = None

    @property
    def waiting(self) -> int:
        """Direct commands that have not been sent."""
        return len(self._direct)

    @property
    def outstanding(self) -> int:
        """Commands sent that are not known to be executed."""
        return self._flow.outstanding

    @property
    def running(self) -> bool:
        """Whether there is a source."""
        return self._source is not None

    @property
    def known(self) -> bool:
        """Whether the state of the core's queue is known."""
        return self._flow.known

    @property
    def idle(self) -> bool:
        """Whether nothing is to be sent or executed, and no stop holds the next command back."""
        return self._source is None and not self._direct and not self._holding and self._flow.idle

    @property
    def finished(self) -> bool:
        """Whether all of the source has been executed.

        Two answers in a row must say so: some firmware reports idle a moment before its planner is empty.
        """
        return self._source is not None and self._source.exhausted and self._idle_answers >= _IDLE_ANSWERS

    # The link.

    def attach(self, link: Link) -> None:
        """Send over a new link, whose core's queue is empty or will be stopped."""
        self._link = link
        self.reset()

    def detach(self) -> None:
        """The link is gone; what the core still held must be stopped when there is one again."""
        self._link = None
        if self._options.stop_on_connect or self._flow.outstanding > 0:
            self.stop_owed = True
        self._flow.reset()
        self.close()

    def reset(self) -> None:
        """The core's queue is empty and its state fresh: open a new account and ask."""
        self._flow.reset()
        self._idle_answers = 0
        self._end_hold()
        if self.stop_owed:
            self.stop()
        else:
            self._ask()

    def close(self) -> None:
        """Send nothing more and cancel the timers."""
        self._link = None
        self._end_hold()
        if self._ask_timer is not None:
            self._ask_timer.cancel()

    # What is to be sent.

    def enqueue(self, line: bytes) -> bool:
        """Send a direct command behind all others; False if there are too many."""
        if len(self._direct) >= _MAX_WAITING:
            return False
        self._direct.append(line)
        self.pump()
        return True

    def run(self, source: LineSource) -> None:
        """Send all commands of a source."""
        self._source = source
        self._idle_answers = 0
        self.pump()
        self._ask_if_none()

    def end_run(self) -> None:
        """Forget the source of a run that is over."""
        self._source = None
        self.taken = 0

    def drop(self) -> None:
        """Forget all commands that have not been sent."""
        self._direct.clear()
        self._source = None

    def send_now(self, line: bytes) -> bool:
        """Send a line ahead of all unsent commands; False if it cannot be sent."""
        link = self._link
        if link is None or link.unwritten > _MAX_UNWRITTEN:
            return False
        text = line.decode("ascii")
        if text == lines.QUEUE:
            # A question that is under way already is answered later than now, so it serves this one too.
            self._ask_if_none()
        elif lines.is_queued(text):
            if self._holding or self._flow.outstanding >= self._flow.capacity:
                return False
            # Behind what is written already: an overtaken `?queue` would vouch for it too early.
            self._flow.sent += 1
            self._idle_answers = 0
            self._write(line + b"\n")
            self._ask_if_none()
        else:
            self._comm.down(line + b"\n")
            link.write_now(line + b"\n")
        return True

    def stop(self) -> None:
        """Drop what is unwritten, then write ``!``; without a link, as soon as there is one."""
        link = self._link
        if link is None:
            self.stop_owed = True
            return
        # Owed until the core has answered: the link may be lost before `!` is through.
        self.stop_owed = True
        dropped = link.discard()
        link.write_now(_STOP)
        if dropped:
            unsent = dropped.split(b"\n")
            self._flow.retract(unsent.count(_ASK[:-1]))
            count = len(unsent) - 1
            self._comm.note(f"{count} lines logged before were not written")
        self._comm.down(_STOP)
        self._flow.forget()
        self._idle_answers = 0
        self._end_hold()
        self._holding = True
        self._ask()

    def pump(self) -> None:
        """Send as many commands as the core has room for."""
        link, flow = self._link, self._flow
        if link is None or link.unwritten or not (self._direct or self._source is not None):
            return
        credit = flow.credit
        if not credit or self._holding:
            return
        batch: list[bytes] = []
        while self._direct and len(batch) < credit:
            batch.append(self._direct.popleft())
        if self._source is not None:
            batch += self._take(self._source, credit - len(batch))
        if not batch:
            return
        self._idle_answers = 0
        if flow.asking:
            flow.sent += len(batch)
        else:
            # The question goes before the last half window: its answer comes while that is on the wire.
            first = max(0, len(batch) - flow.window // 2)
            flow.sent += first
            flow.ask()
            self.asked_at = self._loop.time()
            flow.sent += len(batch) - first
            batch.insert(first, _ASK[:-1])
        self._write(b"\n".join(batch) + b"\n")

    def _take(self, source: LineSource, most: int) -> list[bytes]:
        try:
            commands = source.take(most)
        except StorageError as error:
            self._loop.call_soon(self._broken, str(error))
            return []
        self.taken += len(commands)
        return commands

    # Questions and answers.

    def answered(self, capacity: int, num: int) -> None:
        """Take an answer to ``?queue`` and send what it gives room for."""
        flow = self._flow
        now = self._loop.time()
        asked_at, self.asked_at = self.asked_at, now
        if not flow.answer(capacity, num):
            self._ask_if_none()
            return
        self.stop_owed = False
        if self._holding and self._hold_timer is None:
            # The core's own hold-off began when `!` arrived, and this answer is the first word of that.
            hold_off = self._options.hold_off * _HOLD_MARGIN
            self._hold_timer = self._loop.call_later(hold_off, self._hold_over)
        # A core that always answers late must not be given up again and again.
        self._patience = max(self._options.answer_timeout, 2 * (now - asked_at))
        self._idle_answers = self._idle_answers + 1 if flow.idle else 0
        self.pump()
        if not flow.asking and not self.finished:
            self._ask_again(now)

    def answered_nonsense(self) -> None:
        """Take an answer that says nothing."""
        self._flow.skip()

    def beat(self, now: float) -> None:
        """Ask, if it was not done lately; give up an answer that is long overdue."""
        if self._flow.asking and now - self.asked_at > self._patience:
            self._patience = min(2 * self._patience, _PATIENCE_MOST)
            self._flow.lose()
            self.asked_at = now
        if now - self.asked_at >= HEARTBEAT * 0.9 and not self._flow.asking:
            self._ask()

    def excuse(self, now: float) -> None:
        """Count the time to the next answer from now."""
        self.asked_at = now

    def overdue(self, now: float) -> bool:
        """Whether the last question has not been answered in time."""
        return self._flow.asking and now - self.asked_at > self._options.answer_timeout

    def _ask(self) -> None:
        if not self._flow.asking:
            self.asked_at = self._loop.time()
        self._flow.ask()
        self._write(_ASK)

    def _ask_if_none(self) -> None:
        if self._link is not None and not self._flow.asking:
            self._ask()

    def _ask_again(self, now: float) -> None:
        """Arrange for the next question, by what is still to come."""
        flow = self._flow
        since, before = self._executed_at
        total = flow.sent - flow.outstanding
        executed, elapsed = total - before, now - since
        self._executed_at = (now, total)
        if self._direct or (self._source is not None and not self._source.exhausted):
            self._ask_in(refill_delay(flow.waiting, executed, elapsed))
        elif self._source is not None and flow.idle:
            self._ask()
        elif not flow.idle:
            self._ask_in(drain_delay(flow.waiting, executed, elapsed))

    def _ask_in(self, delay: float) -> None:
        if delay <= 0:
            self._ask()
            return
        if self._ask_timer is not None:
            self._ask_timer.cancel()
        self._ask_timer = self._loop.call_later(delay, self._ask_if_none)

    def _write(self, block: bytes) -> None:
        if self._link is not None:
            self._comm.down(block)
            self._link.write(block)

    def _hold_over(self) -> None:
        self._end_hold()
        self.pump()
        self._free()

    def _end_hold(self) -> None:
        self._holding = False
        if self._hold_timer is not None:
            self._hold_timer.cancel()
            self._hold_timer = None
