"""Telemetry: the latest reports of every machine, and every series on disk.

The rows of a *shape* (machine, tag, ordered keys, kinds of values) share one column of times.
They collect in RAM (`shape`), and a journal holds them until 8,000 rows are sealed into one
chunk (`journal`, `chunks`). A chunk's columns are packed so that any row can be read without
decoding the others (`columns`), which is why one lookup in the times serves every key asked for
(`reader`). One thread does all of it (`store`), `Telemetry` is its face on the event loop.

Choices, with the reason:

* Fixed-width columns instead of zlib: 2 bytes per point either way for machine data, but a query
  that touches 40 of 4,000 rows decodes 40 values, not 4,000.
* SQLite for chunks: page reuse after deletion, atomic commits and recovery come with it.
* A journal beside SQLite: rows in a table would be written twice (WAL, then page) and deleted
  again; on an SD card that is most of the wear.
* Times are whole microseconds from the door on, and sample times are integers: truncated floats
  give wrong answers at small steps.
* No sample is ever left out because it repeats: the window rule of `/query-ts` needs it, and
  a column that does not change takes no space.
* A number that is null now and then makes no new shape: it is a NaN in a column of floats.
* Two reports of one tag in the same microsecond, but of different shapes: the later one is stored
  one microsecond later, so that merged shapes have one order.
* A clock that steps back by 5 s or more begins a new *epoch* of its tag: times ascend within an
  epoch, and order of reception is order of epoch, then of time.
* `mmap` is not used: an I/O error of an SD card would end the process by SIGBUS.
"""

from toolpost.core.grid import SampleGrid
from toolpost.telemetry.limits import Limits
from toolpost.telemetry.service import Telemetry

__all__ = ["Limits", "SampleGrid", "Telemetry"]
