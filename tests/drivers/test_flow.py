"""Flow control against a model of a core behind a slow wire in both directions."""

from collections import deque

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from toolpost.drivers.spark.flow import FILL, Flow

COMMAND, ASK, STOP = "command", "?queue", "!"
BAD, BOOT = "bad", "boot"
MOST_LATE = 20
FAULTS = ["stop", "give up", "reopen", "boot", "spoil", "noise"]


def fault(name):
    """Let a rule play in the runs that have this fault: too many at once hide what one of them does."""
    return precondition(lambda self: name in self.faults)


class Wire(RuleBasedStateMachine):
    """A host that keeps the rules, a core, and bytes that keep their order but take any time."""

    @initialize(capacity=st.integers(1, 12), faults=st.sets(st.sampled_from(FAULTS), max_size=3))
    def open(self, capacity, faults):
        self.capacity = capacity
        self.faults = faults
        self.flow = Flow()
        self.down = deque()
        self.up = deque()
        self.queue = 0

    # The host.

    def ask(self):
        self.flow.ask()
        self.down.append(ASK)

    def in_flight(self):
        return self.down.count(ASK) + sum(line != BOOT for line in self.up)

    def may_ask(self):
        # More than that cannot wait in the firmware's buffer.
        return not self.in_flight() or len(self.flow._asked) < MOST_LATE

    @precondition(may_ask)
    @rule()
    def asks(self):
        self.ask()

    @precondition(lambda self: self.flow.credit)
    @rule(data=st.data())
    def sends(self, data):
        count = self.flow.credit if data.draw(st.booleans()) else data.draw(st.integers(1, self.flow.credit))
        first = data.draw(st.sampled_from([0, count // 2, count]))
        self.flow.sent += first
        self.down.extend([COMMAND] * first)
        if self.may_ask():
            self.ask()
        self.flow.sent += count - first
        self.down.extend([COMMAND] * (count - first))

    @precondition(may_ask)
    @fault("stop")
    @rule(unwritten=st.integers(0, 5))
    def stops(self, unwritten):
        for _ in range(min(unwritten, len(self.down))):
            self.down.pop()
        self.down.append(STOP)
        self.flow.forget()
        self.ask()

    @fault("give up")
    @rule()
    def gives_up(self):
        """The host takes answers for lost, rightly or not."""
        self.flow.lose()

    @precondition(may_ask)
    @fault("reopen")
    @rule()
    def reopens_the_link(self):
        self.down.clear()
        self.up.clear()
        self.flow.reset()
        self.ask()

    # The core.

    @precondition(lambda self: self.queue)
    @rule(count=st.sampled_from([1, 12]))
    def executes(self, count):
        self.queue -= min(count, self.queue)

    @fault("boot")
    @rule(received=st.integers(0, 5))
    def boots(self, received):
        self.queue = 0
        for _ in range(min(received, len(self.down))):
            self.down.popleft()
        self.up.append(BOOT)

    # The wire.

    @precondition(lambda self: self.down)
    @rule(count=st.sampled_from([1, 1, 1, 2, 20]))
    def brings_down(self, count):
        for _ in range(min(count, len(self.down))):
            line = self.down.popleft()
            if line == COMMAND:
                self.queue += 1
                self.bounded()
            elif line == STOP:
                self.queue = 0
            else:
                self.up.append(self.queue)

    @precondition(lambda self: self.up)
    @rule(count=st.sampled_from([1, 1, 1, 2, 20]))
    def brings_up(self, count):
        for _ in range(min(count, len(self.up))):
            line = self.up.popleft()
            if line == BOOT:
                self.flow.reset()
                self.ask()
            elif line == BAD:
                self.flow.skip()
            else:
                self.flow.answer(self.capacity, line)
            self.idle_is_true()

    @precondition(lambda self: self.up)
    @fault("spoil")
    @rule(data=st.data(), garbled=st.booleans())
    def spoils_an_answer(self, data, garbled):
        at = data.draw(st.integers(0, len(self.up) - 1))
        if self.up[at] == BOOT:
            return
        if garbled:
            self.up[at] = BAD
        else:
            del self.up[at]

    @fault("noise")
    @rule()
    def makes_noise(self):
        if ASK in self.down:
            self.down.remove(ASK)
        else:
            self.flow.skip()

    # What must hold.

    def calms_down(self):
        """Whatever has been: once the wire is quiet, all credit comes back."""
        for _ in range(2 * MOST_LATE + 10):
            while self.down:
                self.brings_down(100)
            self.queue = 0
            while self.up:
                self.brings_up(100)
            if self.flow.idle and not self.down:
                break
            if self.flow.asking and not self.down:
                self.flow.lose()
            if not self.flow.asking:
                self.ask()
        assert self.flow.idle
        assert self.flow.credit == self.flow.window == max(1, int(self.capacity * FILL))

    @invariant()
    def bounded(self):
        assert self.queue <= max(1, self.capacity * FILL)

    @invariant()
    def idle_is_true(self):
        if self.flow.idle:
            assert self.queue == 0
            assert COMMAND not in self.down

    @invariant()
    def figures_are_sound(self):
        assert 0 <= self.flow.credit <= self.flow.window
        assert self.flow.outstanding >= 0
        assert len(self.flow._asked) <= 3 * MOST_LATE

    def teardown(self):
        if hasattr(self, "flow"):
            self.calms_down()


TestWire = Wire.TestCase
TestWire.settings = settings(max_examples=200, stateful_step_count=50, deadline=None)


def opened(capacity=64, num=0):
    flow = Flow()
    flow.ask()
    assert flow.answer(capacity, num)
    return flow


def test_nothing_is_known_at_first():
    flow = Flow()
    assert (flow.known, flow.idle, flow.credit, flow.capacity, flow.asking) == (False, False, 0, 0, False)
    flow.ask()
    assert flow.asking
    assert flow.answer(64, 0)
    assert (flow.known, flow.idle, flow.credit, flow.capacity, flow.asking) == (True, True, 48, 64, False)


@pytest.mark.parametrize(
    ("capacity", "window"), [(1, 1), (2, 1), (3, 2), (4, 3), (64, 48), (100, 75), (1000, 750)]
)
def test_window(capacity, window):
    flow = opened(capacity)
    assert flow.window == flow.credit == window


@pytest.mark.parametrize("capacity", [0, -1])
def test_a_core_without_a_queue_gets_nothing(capacity):
    assert opened(capacity).credit == 0


def test_more_in_the_core_than_it_can_hold():
    flow = opened(64, 66)
    assert flow.credit == 0
    assert flow.outstanding == 66


def test_an_answer_covers_what_was_sent_before_its_question_only():
    flow = opened()
    flow.sent += 24
    flow.ask()
    flow.sent += 24
    assert flow.answer(64, 20)
    assert (flow.outstanding, flow.credit, flow.waiting) == (44, 4, 20)
    flow.ask()
    assert flow.answer(64, 0)
    assert flow.idle


def test_an_answer_to_no_question_says_nothing():
    flow = opened()
    flow.sent += 10
    assert not flow.answer(64, 0)
    assert not flow.idle
    assert flow.outstanding == 10


def test_answers_from_before_a_stop_say_nothing():
    flow = opened()
    flow.sent += 10
    flow.ask()
    flow.forget()
    flow.ask()
    assert flow.credit == 0
    assert not flow.answer(64, 10)
    assert not flow.known


def test_a_question_dropped_with_the_stop_costs_one_more_question_and_no_silence():
    flow = opened()
    flow.sent += 10
    flow.ask()
    flow.forget()
    flow.ask()
    assert not flow.answer(64, 0)
    assert not flow.asking, "the driver asks again at once"
    flow.ask()
    assert flow.answer(64, 0)
    assert flow.idle


def test_a_late_answer_does_not_vouch_for_later_commands():
    flow = opened()
    flow.ask()
    flow.lose()
    flow.ask()
    assert flow.answer(64, 0)  # the one given up: it says what was so before
    flow.sent += flow.credit
    flow.ask()
    flow.answer(64, 0)  # that of the second question, which was before the commands
    assert not flow.idle
    assert flow.credit == 0


def test_an_answer_really_lost_holds_up_one_round_only():
    flow = opened()
    flow.sent += 24
    flow.ask()
    flow.lose()
    flow.ask()
    assert flow.credit == 0
    flow.answer(64, 20)
    flow.ask()
    assert flow.answer(64, 18)
    assert flow.outstanding == 18
    flow.sent += 30
    flow.ask()
    assert flow.answer(64, 45)  # more than there could be at the question before: in step again
    assert flow.outstanding == 45


def test_a_core_that_was_dead_for_long_is_in_step_at_once():
    flow = opened()
    for _ in range(3600):
        flow.ask()
        flow.lose()
    assert len(flow._asked) == MOST_LATE
    flow.ask()
    assert flow.answer(64, 0)
    assert flow.credit == 48
    flow.sent += 48
    flow.ask()
    assert flow.answer(64, 40)
    assert flow.outstanding == 40
    assert not flow._asked


def test_a_boot_empties_the_account():
    flow = opened()
    flow.sent += 48
    flow.reset()
    assert (flow.outstanding, flow.credit, flow.idle, flow.asking) == (0, 0, False, False)
    flow.ask()
    assert flow.answer(64, 0)
    assert flow.idle
