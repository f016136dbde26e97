"""Flow control: how many commands may be sent, and what the core still holds.

Spark serial protocol, flow control: the answer to ``?queue`` is the only acknowledgement. Bytes keep their
order, so an answer covers every command written before the ``?queue`` that it answers; commands written after
it must be counted as still on their way. Nothing here does I/O or reads a clock.
"""

from collections import deque

FILL = 0.75
"""Part of the core's queue that is filled."""


class Flow:
    """The account of commands sent, confirmed and still in the core.

    Attributes:
        sent: commands written since the account was opened.
        known: whether the core's queue is known: no answer is owed from before the last `forget`.
    """

    __slots__ = ("_asked", "_capacity", "_covered", "_doubt", "_num", "_stale", "known", "sent")

    def __init__(self) -> None:
        self.sent = 0
        self.known = False
        self._covered = 0
        self._num = 0
        self._capacity = 0
        self._asked: deque[int] = deque()
        self._stale = 0
        self._doubt = 0

    @property
    def asking(self) -> bool:
        """Whether an answer is awaited."""
        return bool(self._asked)

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

    def answer(self, capacity: int, num: int) -> bool:
        """Take an answer; return whether it says something about the present account."""
        covered = self._asked.popleft() if self._asked else None
        if self._doubt:
            self._doubt -= 1
            return False
        if self._stale:
            self._stale -= 1
            return False
        if covered is None:
            return False
        self._capacity, self._num, self._covered = capacity, num, covered
        self.known = True
        return True

    def skip(self) -> None:
        """Note that an answer has come that could not be understood."""
        if self._asked:
            self._asked.popleft()
            self._stale = max(0, self._stale - 1)

    def forget(self) -> None:
        """Note that what the core held is void (``!`` was written): answers asked for before say nothing."""
        self._stale = len(self._asked)
        self.known = False

    def lose(self) -> None:
        """Give up the answers awaited.

        As many answers as were awaited may still come late, so that many are not trusted. No command is sent
        until one is, and by then every question asked since covers all that was sent.
        """
        self._doubt = max(self._doubt, len(self._asked))
        self._asked.clear()
        self._stale = 0
        self.known = False

    def reset(self) -> None:
        """Open a new account: the core has booted or the link is new, so its queue is empty."""
        self.lose()
        self._doubt = 0
        self._covered = self.sent
        self._num = 0
