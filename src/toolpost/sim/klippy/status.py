"""Queries and subscriptions, all answered on one common tick."""

import asyncio
import time
from collections.abc import Callable

from toolpost.sim.klippy.printer import Printer

Wanted = dict[str, list[str] | None]
"""Fields by object; None for all."""

Statuses = dict[str, dict[str, object]]


class Subscription:
    """What one connection is sent.

    Args:
        wanted: which fields.
        push: takes the fields that changed, with the time.
    """

    def __init__(self, wanted: Wanted, push: Callable[[dict[str, object]], None]) -> None:
        self.wanted = wanted
        self.push = push


class StatusTicker:
    """Answers queries and feeds subscriptions.

    The tick runs while anything asks for something. The first query therefore is answered at
    once, the next one up to a tick later; with a subscription every query waits (measured).

    Args:
        printer: whose objects these are.
        tick: seconds.
    """

    def __init__(self, printer: Printer, tick: float) -> None:
        self._printer = printer
        self._tick = tick
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | asyncio.Handle | None = None
        self._queries: list[tuple[Wanted, asyncio.Future[dict[str, object]]]] = []
        self._subscriptions: dict[object, Subscription] = {}
        self._last: Statuses = {}

    def stop(self) -> None:
        """End, as with the process."""
        if self._timer is not None:
            self._timer.cancel()
        self._subscriptions.clear()
        for _, answer in self._queries:
            answer.cancel()
        self._queries.clear()

    async def query(self, wanted: Wanted) -> dict[str, object]:
        """Return ``eventtime`` (seconds) and the ``status`` of all that is wanted."""
        answer: asyncio.Future[dict[str, object]] = self._loop.create_future()
        self._queries.append((dict(wanted), answer))
        if self._timer is None:
            self._timer = self._loop.call_soon(self._run)
        return await answer

    def subscribe(self, key: object, wanted: Wanted, push: Callable[[dict[str, object]], None]) -> None:
        """Send changes from the next tick on, instead of what ``key`` was sent before."""
        self._subscriptions[key] = Subscription(dict(wanted), push)

    def unsubscribe(self, key: object) -> None:
        """Send ``key`` nothing more."""
        self._subscriptions.pop(key, None)

    def _run(self) -> None:
        now = time.monotonic()
        seen: Statuses = {}
        queries, self._queries = self._queries, []
        for wanted, answer in queries:
            if not answer.done():
                answer.set_result({"eventtime": now, "status": self._pick(wanted, seen, now, None)})
        for subscription in tuple(self._subscriptions.values()):
            changed = self._pick(subscription.wanted, seen, now, self._last)
            if changed:
                subscription.push({"eventtime": now, "status": changed})
        self._last = seen
        self._timer = self._loop.call_later(self._tick, self._run) if seen else None

    def _pick(self, wanted: Wanted, seen: Statuses, now: float, last: Statuses | None) -> Statuses:
        """Return the wanted fields; only those that are not as in ``last``, if that is given."""
        picked: Statuses = {}
        for name, fields in wanted.items():
            if name not in seen:
                seen[name] = self._printer.status(name, now)
            found = seen[name]
            before = None if last is None else last.get(name, {})
            chosen = {
                field: found.get(field)
                for field in (found if fields is None else fields)
                if before is None or found.get(field) != before.get(field)
            }
            if chosen or before is None:
                picked[name] = chosen
        return picked
