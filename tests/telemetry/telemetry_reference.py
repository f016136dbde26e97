"""The rule of /query-ts in the simplest words, with integers only."""

from toolpost.core.report import Report, Value
from toolpost.telemetry import SampleGrid


def sample(reports: list[Report], keys: list[str], grid: SampleGrid) -> dict[str, list[Value]]:
    result: dict[str, list[Value]] = {}
    for key in keys:
        tag, _, name = key.partition(".")
        points = [(r.time_us, r.values[name]) for r in reports if r.tag == tag and name in r.values]
        row: list[Value] = []
        for k in range(grid.count):
            at = grid.start_us + (k * grid.step_ps + 500_000) // 1_000_000
            value: Value = None
            for time_us, point in points:
                if at * 1_000_000 - grid.step_ps <= time_us * 1_000_000 and time_us <= at:
                    value = point
            row.append(value)
        result[key] = row
    return result
