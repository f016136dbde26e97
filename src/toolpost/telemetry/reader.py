"""Answers queries from chunks and tails. Nothing here changes anything."""

import heapq
from array import array
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from itertools import islice, repeat
from operator import sub
from typing import NamedTuple, Protocol

from toolpost.core.grid import SampleGrid
from toolpost.core.report import Report, Value
from toolpost.telemetry.chunks import ChunkFile
from toolpost.telemetry.columns import Column, live_column, picker
from toolpost.telemetry.shape import Run, Shape


class Rows(Protocol):
    """Rows with ascending times: a chunk's (`columns.PackedRows`) or a tail's."""

    rows: int
    first_us: int
    offsets: "array[int]"

    def column(self, place: int) -> Column:
        """Return the column at ``place``."""
        ...


class _TailRows:
    """The rows of a shape that are in RAM."""

    def __init__(self, shape: Shape) -> None:
        self._shape = shape
        self.rows = len(shape.times)
        self.first_us = 0
        self.offsets = shape.times

    def column(self, place: int) -> Column:
        return live_column(self._shape.columns[place])


class Track(NamedTuple):
    """What a shape has in one epoch: its chunks, then its tail. Times ascend throughout."""

    shape: Shape
    run: Run
    with_tail: bool

    @classmethod
    def of(cls, shape: Shape) -> "list[Track]":
        """Return the tracks of a shape by ascending epoch."""
        tracks = [cls(shape, run, with_tail=False) for run in shape.runs if run.ids]
        if shape.times:
            run = Run(shape.epoch)
            if tracks and tracks[-1].run.epoch == shape.epoch:
                run = tracks.pop().run
            tracks.append(cls(shape, run, with_tail=True))
        return tracks

    def bounds(self) -> tuple["array[int]", "array[int]"]:
        """Return the first and the last time of every piece (chunks, tail), Unix microseconds."""
        if not self.with_tail:
            return self.run.firsts, self.run.lasts
        times = self.shape.times
        return self.run.firsts + times[:1], self.run.lasts + times[-1:]

    def is_tail(self, piece: int) -> bool:
        """Say whether the piece with this number is the tail."""
        return piece == len(self.run.ids)


def query(
    shapes_of: Callable[[str], Iterable[Shape]],
    keys: Sequence[str],
    grid: SampleGrid,
    chunks: ChunkFile,
) -> dict[str, list[Value]]:
    """Sample series.

    Args:
        shapes_of: returns the shapes of a tag.
        keys: ``<tag>.<key>`` each; a key may contain dots.
        grid: the samples.
        chunks: where the sealed rows are.

    Returns:
        For every key one value per sample: the latest in the sample's window, None where there
        is none. Keys without any data share one list.
    """
    nothing: list[Value] = [None] * grid.count
    result = dict.fromkeys(keys, nothing)
    by_tag: dict[str, list[tuple[str, str]]] = {}
    for key in result:
        tag, dot, name = key.partition(".")
        if dot:
            by_tag.setdefault(tag, []).append((key, name))
    sampler = _Sampler(grid, chunks)
    for tag, names in by_tag.items():
        tracks = [
            (track, [(key, shape.places[name]) for key, name in names if name in shape.places])
            for shape in shapes_of(tag)
            for track in Track.of(shape)
            if sampler.touches(track)
        ]
        # On equal times the later epoch is the later reception, so it has to come last.
        tracks.sort(key=lambda item: item[0].run.epoch)
        result.update(sampler.sample(tracks))
    return result


class _Sampler:
    """Looks up the rows for every sample of a grid."""

    def __init__(self, grid: SampleGrid, chunks: ChunkFile) -> None:
        self._times = grid.times_us()
        self._window = grid.window_us
        self._chunks = chunks

    def touches(self, track: Track) -> bool:
        """Say whether any row can be in any window."""
        firsts, lasts = track.bounds()
        return firsts[0] <= self._times[-1] and lasts[-1] >= self._times[0] - self._window

    def sample(self, tracks: Sequence[tuple[Track, list[tuple[str, int]]]]) -> dict[str, list[Value]]:
        """Return the values per key; ``tracks`` come with the keys and columns wanted."""
        count = len(self._times)
        sources = Counter(key for _, places in tracks for key, _ in places)
        values: dict[str, list[Value]] = {key: [None] * count for key in sources}
        # Only a key that has several sources needs the times of what it has so far.
        stamps = {key: [-1] * count for key, number in sources.items() if number > 1}
        for track, places in tracks:
            if not places:
                continue
            shape, width = track.shape, len(track.shape.columns)
            for piece, start, stop in self._spans(track):
                if track.is_tail(piece):
                    self._take(_TailRows(shape), start, stop, places, values, stamps)
                    continue
                chunk = track.run.ids[piece]
                with closing(self._chunks.open_rows(chunk, width)) as rows:
                    self._take(rows, start, stop, places, values, stamps)
        return values

    def _spans(self, track: Track) -> Iterator[tuple[int, int, int]]:
        """Yield pieces with the range of samples whose latest row is in them."""
        times, window = self._times, self._window
        firsts, lasts = track.bounds()
        sample, count = 0, len(times)
        while sample < count:
            piece = bisect_right(firsts, times[sample]) - 1
            if piece < 0:
                sample = bisect_left(times, firsts[0], sample)
                continue
            after = count
            if piece + 1 < len(firsts):
                after = bisect_left(times, firsts[piece + 1], sample)
            stop = bisect_right(times, lasts[piece] + window, sample, after)
            if stop > sample:
                yield piece, sample, stop
            sample = after

    def _take(
        self,
        rows: Rows,
        start: int,
        stop: int,
        places: list[tuple[str, int]],
        values: dict[str, list[Value]],
        stamps: dict[str, list[int]],
    ) -> None:
        """Fill in the samples ``start`` to ``stop``, all of which are at or after the first row."""
        first, window = rows.first_us, self._window
        offsets = rows.offsets
        sought = [time - first for time in self._times[start:stop]]
        found = [after - 1 for after in map(bisect_right, repeat(offsets), sought)]
        samples: Sequence[int] = range(start, stop)
        hits = picker(found)(offsets)
        if max(map(sub, sought, hits)) > window:
            kept = [n for n, hit in enumerate(hits) if sought[n] - hit <= window]
            if not kept:
                return
            samples = [start + n for n in kept]
            found = [found[n] for n in kept]
        getter = picker(found)
        for key, place in places:
            taken = rows.column(place).pick(getter, len(found))
            target = values[key]
            if key in stamps:
                latest = stamps[key]
                for sample, hit, value in zip(samples, getter(offsets), taken, strict=True):
                    if hit + first >= latest[sample]:
                        latest[sample] = hit + first
                        target[sample] = value
            elif isinstance(samples, range):
                target[start:stop] = taken
            else:
                for sample, value in zip(samples, taken, strict=True):
                    target[sample] = value


def history(shapes: Iterable[Shape], count: int, chunks: ChunkFile) -> list[Report]:
    """Return the latest ``count`` reports of a tag's shapes, latest reception first."""
    by_epoch: dict[int, list[Track]] = {}
    for shape in shapes:
        for track in Track.of(shape):
            by_epoch.setdefault(track.run.epoch, []).append(track)
    reports: list[Report] = []
    for epoch in sorted(by_epoch, reverse=True):
        streams = [_backwards(track, count, chunks) for track in by_epoch[epoch]]
        merged = heapq.merge(*streams, key=_time_us, reverse=True)
        reports += islice(merged, count - len(reports))
        if len(reports) == count:
            break
    return reports


def _time_us(report: Report) -> int:
    return report.time_us


def _backwards(track: Track, count: int, chunks: ChunkFile) -> Iterator[Report]:
    """Yield up to ``count`` reports of a track, latest first."""
    shape = track.shape
    for piece in reversed(range(len(track.run.ids) + track.with_tail)):
        if track.is_tail(piece):
            reports = _reports(_TailRows(shape), shape, count)
        else:
            chunk = track.run.ids[piece]
            with closing(chunks.open_rows(chunk, len(shape.columns))) as rows:
                reports = _reports(rows, shape, count)
        yield from reversed(reports)
        count -= len(reports)
        if not count:
            return


def _reports(rows: Rows, shape: Shape, count: int) -> list[Report]:
    """Return the last ``count`` rows as reports, in the order of their times."""
    tag, keys = shape.definition.tag, shape.definition.keys
    start, stop = max(0, rows.rows - count), rows.rows
    first = rows.first_us
    times = rows.offsets[start:stop]
    columns = [rows.column(place).values(start, stop) for place in range(len(keys))]
    values = zip(*columns, strict=True) if columns else repeat((), len(times))
    return [
        Report(first + offset, tag, dict(zip(keys, row, strict=True)))
        for offset, row in zip(times, values, strict=True)
    ]
