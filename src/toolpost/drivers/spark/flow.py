"""Flow control: how many commands may be sent, and what the core still holds.

Spark serial protocol, flow control: the answer to ``?queue`` is the only acknowledgement. Bytes keep their
order, so an answer covers every command written before the ``?queue`` that it answers; commands written after
it must be counted as still on their way. Nothing here does I/O or reads a clock.
"""

from collections import deque

FILL = 0.75
"""Part of the core's queue that is filled."""

_MOST_LATE = 20
"""Answers given up that may still come: the firmware's buffer of 128 bytes holds 18 questions."""


class Flow:
    """The account of commands sent, confirmed and still in the core.

    An answer does not say which question it belongs to. Questions whose answers were given up stay in line,
    and an answer is taken for that of the earliest question that it can belong to: this counts commands as
    still on their way that may have arrived, never the other way round.

    Attributes:
        sent: commands written since the account was opened.
        known: whether the core's queue is known: no answer is owed from before the last `forget`.
    """

    __slots__ = ("_asked", "_capacity", "_covered", "_given_up", "_num", "known", "sent")

    def __init__(self) -> None:
        self.sent = 0
        self.known = False
        self._covered = 0
        self._num = 0
        self._capacity = 0
        self._asked: deque[int | None] = deque()
        self._given_up = 0

    @property
    def asking(self) -> bool:
        """Whether an answer is awaited."""
        return len(self._asked) > self._given_up

    @property
    def capacity(self) -> int:
        """Length of the core's queue, 0 while it is not known."""
        return self._capacity

    @property
    def waiting(self) -> int:
        """Commands in the core's queue at the last answer."""
        return self._num

    @property
    def outstanding(self) -> int:
        """Commands sent that are not known to be executed."""
        return self._num + self.sent - self._covered

    @property
    def idle(self) -> bool:
        """Whether the last answer says that every command sent so far has been executed."""
        return self.known and self._num == 0 and self._covered == self.sent

    @property
    def window(self) -> int:
        """Commands that may be outstanding at most."""
        return max(1, int(self._capacity * FILL)) if self._capacity > 0 else 0

    @property
    def credit(self) -> int:
        """Commands that may be sent now."""
        return max(0, self.window - self.outstanding) if self.known else 0

    def ask(self) -> None:
        """Note that a ``?queue`` has been written."""
        self._asked.append(self.sent)

    def retract(self, questions: int) -> None:
        """Note that the last questions were not written after all."""
        for _ in range(min(questions, len(self._asked))):
            self._asked.pop()
        self._given_up = min(self._given_up, len(self._asked))

    def answer(self, capacity: int, num: int) -> bool:
        """Take an answer; return whether it says something about the present account."""
        covered = self._question(num)
        if covered is None:
            return False
        self._capacity, self._num, self._covered = capacity, num, covered
        self.known = True
        return True

    def skip(self) -> None:
        """Note that something has come that may have been an answer, and could not be understood."""
        self._given_up = min(self._given_up + 1, len(self._asked))

    def forget(self) -> None:
        """Note that what the core held is void (``!`` was written): answers asked for before say nothing."""
        self._asked = deque([None] * len(self._asked))
        self.lose()

    def lose(self) -> None:
        """Give up the answers awaited, though they may still come. No command is sent until one has come."""
        while len(self._asked) > _MOST_LATE:
            self._asked.popleft()
        self._given_up = len(self._asked)
        self.known = False

    def reset(self) -> None:
        """Open a new account: the core has booted or the link is new, so its queue is empty."""
        self.forget()
        self._covered = self.sent
        self._num = 0

    def _question(self, num: int) -> int | None:
        """Take the question out of line that an answer belongs to.

        Returns:
            The commands that the answer covers; None if it says nothing.
        """
        asked = self._asked
        while self._given_up and self.known and asked[0] is not None:
            if num <= self._num + asked[0] - self._covered:
                break
            # The core cannot have held so many commands then: that question will not be answered any more.
            asked.popleft()
            self._given_up -= 1
        if not asked:
            return None
        covered = asked.popleft()
        self._given_up = min(self._given_up, len(asked))
        return covered
