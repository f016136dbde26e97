"""A core on a clock that only the test moves."""

import heapq
import itertools
import re

from toolpost.sim.faults import Fault
from toolpost.sim.options import SparkOptions
from toolpost.sim.spark import SparkCore


class Timer:
    def __init__(self, call):
        self.call = call
        self.cancelled = False

    def cancel(self):
        self.cancelled = True


class ManualLoop:
    """As much of a loop as a core uses."""

    def __init__(self):
        self.now = 1000.0
        self._timers = []
        self._order = itertools.count()

    def time(self):
        return self.now

    def call_later(self, delay, call):
        timer = Timer(call)
        heapq.heappush(self._timers, (self.now + delay, next(self._order), timer))
        return timer

    def sleep(self, seconds):
        """Let time pass; timers fire on time."""
        end = self.now + seconds
        while self._timers and self._timers[0][0] <= end:
            due, _, timer = heapq.heappop(self._timers)
            self.now = max(self.now, due)
            if not timer.cancelled:
                timer.call()
        self.now = end

    def oversleep(self, seconds):
        """Let time pass while the loop is stuck; timers fire late, all at the end."""
        self.now += seconds
        self.sleep(0)

    @property
    def pending(self):
        return [entry for entry in self._timers if not entry[2].cancelled]


class Bench:
    """A core, what it said, and what it traced."""

    def __init__(self, *, trace=True, boot=True, faults=(), **options):
        self.loop = ManualLoop()
        self.said = bytearray()
        self.events = []
        self.core = SparkCore(
            self.said.extend,
            self.loop,
            SparkOptions(**options),
            (lambda event, line: self.events.append((event, line))) if trace else None,
            self.loop.time,
        )
        if boot:
            self.core.boot()
            self.said.clear()
        for fault in faults:
            self.inject(fault)

    def inject(self, text):
        self.core.inject(Fault.parse(text))

    def send(self, *lines):
        self.core.receive(b"".join(line.encode() + b"\n" for line in lines))

    def ask(self, *lines):
        """Send lines; return what was said in answer, as lines of text."""
        self.said.clear()
        self.send(*lines)
        return self.lines()

    def lines(self):
        said = self.said.decode("latin-1").split("\r\n")
        self.said.clear()
        assert said.pop() == ""
        return said

    def num(self):
        (answer,) = self.ask("?queue")
        return int(re.fullmatch(r"queue < cap:\d+ num:(\d+) >", answer)[1])

    def executed(self):
        return [line.decode() for event, line in self.events if event == "executed"]

    def balance(self):
        """Every command that arrived ended in exactly one place."""
        core = self.core
        ended = core.executed + core.lost + core.ignored + core.rejected + core.canceled
        assert core.received == ended + core.queue_length


def parse(lines, tag):
    """Return the values of a report that may be spread over lines."""
    words = " ".join(line.removeprefix(tag) for line in lines if line.startswith(tag + " "))
    assert words.strip().startswith("<")
    assert words.strip().endswith(">")
    return dict(word.split(":", 1) for word in words.split() if ":" in word)
