"""One measured figure and how it is shown."""

from collections.abc import Callable

import msgspec


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """One figure.

    Attributes:
        what: what was measured.
        value: the figure.
        unit: its unit.
        goal: the goal in words, e.g. ``>= 50000``.
        ok: whether the goal is reached.
        limit: what could be reached at best, or what an earlier program reaches, in words.
    """

    what: str
    value: float
    unit: str
    goal: str
    ok: bool
    limit: str = ""


def at_least(what: str, value: float, unit: str, goal: float, limit: str = "") -> Result:
    """Return a figure that must not be below its goal."""
    return Result(what=what, value=value, unit=unit, goal=f">= {goal:,g}", ok=value >= goal, limit=limit)


def at_most(what: str, value: float, unit: str, goal: float, limit: str = "") -> Result:
    """Return a figure that must not be above its goal."""
    return Result(what=what, value=value, unit=unit, goal=f"<= {goal:,g}", ok=value <= goal, limit=limit)


def percentile(values: list[float], part: float) -> float:
    """Return the value below which `part` (0 to 1) of the values lie."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(len(ordered) * part))]


def show(results: list[Result], write: Callable[[str], None]) -> None:
    """Write the figures as a Markdown table."""
    write("| what | measured | unit | goal | | limit |")
    write("|---|---:|---|---:|---|---|")
    for result in results:
        mark = "ok" if result.ok else "**missed**"
        value = f"{result.value:,.0f}" if abs(result.value) >= 100 else f"{result.value:.3g}"
        write(f"| {result.what} | {value} | {result.unit} | {result.goal} | {mark} | {result.limit} |")
