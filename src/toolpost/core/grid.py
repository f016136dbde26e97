"""The sample times of a query, in whole microseconds and without drift."""

import math

import msgspec

_PS_PER_US = 1_000_000


class SampleGrid(msgspec.Struct, frozen=True):
    """Times ``start + k * step`` for ``k`` in ``range(count)``, each with a window before it.

    Attributes:
        start_us: Unix time of the first sample, microseconds.
        step_ps: distance of samples, picoseconds; 0 for a step below half a picosecond.
        count: number of samples, at least 1.
    """

    start_us: int
    step_ps: int
    count: int

    @classmethod
    def from_seconds(cls, start: float, end: float, step: float, most: int = 10_001) -> "SampleGrid":
        """Make the grid of `spark_spooler.md /query-ts`.

        Args:
            start: Unix time of the first sample, seconds.
            end: Unix time that no sample exceeds, seconds; included if it is
                ``start + k * step`` within the rounding of floats.
            step: distance of samples and length of their windows, seconds.
            most: greatest number of samples that is allowed.

        Raises:
            ValueError: a value is out of range; the text begins with the field's name.
        """
        for name, value in (("start", start), ("end", end), ("step", step)):
            if not math.isfinite(value):
                raise ValueError(f"{name}: must be finite")
        if start < 0:
            raise ValueError("start: must be >= 0")
        if end < 0:
            raise ValueError("end: must be >= 0")
        if end < start:
            raise ValueError("end: must be >= start")
        if step <= 0:
            raise ValueError("step: must be > 0")
        ratio = (end - start) / step if end > start else 0.0
        if ratio > most - 1:
            raise ValueError("too many steps")
        last = math.floor(ratio)
        if end > start and last + 1 < most:
            noise = 2 * math.ulp(end) + (last + 1) * math.ulp(step)
            short = (last + 1 - ratio) * step
            last += short <= min(noise, step / 4)
        return cls(_rounded(start, 1_000_000), _rounded(step, 10**12), last + 1)

    @property
    def window_us(self) -> int:
        """Length of a sample's window, microseconds: both ``T - window_us`` and ``T`` belong."""
        return self.step_ps // _PS_PER_US

    def times_us(self) -> list[int]:
        """Return the sample times, Unix microseconds, ascending."""
        start, step, half = self.start_us, self.step_ps, _PS_PER_US // 2
        whole, rest = divmod(step, _PS_PER_US)
        if whole and not rest:  # the same times, ten times faster
            return list(range(start, start + self.count * whole, whole))
        return [start + (k * step + half) // _PS_PER_US for k in range(self.count)]

    def seconds(self) -> list[float]:
        """Return the sample times, Unix seconds."""
        # A division of integers cannot overflow here: every time is near a finite float.
        return [time / 1_000_000 for time in self.times_us()]


def _rounded(value: float, unit: int) -> int:
    """Return ``value * unit`` rounded to an integer, exact for every finite float >= 0."""
    numerator, denominator = value.as_integer_ratio()
    return (2 * numerator * unit + denominator) // (2 * denominator)
