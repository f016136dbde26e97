"""What telemetry does when the disk, the clock, the machine or the process misbehaves."""

import asyncio
import errno
import logging
import os
import signal
import sqlite3
import subprocess
import sys
import time

import pytest

from toolpost.core.report import Report
from toolpost.errors import StorageError
from toolpost.telemetry import Limits, SampleGrid, Telemetry, store

START_US = 1_735_689_600_000_000
NOTHING = SampleGrid.from_seconds(0, 0, 1)


def report(at, /, tag="t", time_us=None, **values):
    return Report(START_US + at * 10_000 if time_us is None else time_us, tag, values or {"n": at})


async def flush(telemetry):
    await telemetry.query("m", [], NOTHING)


async def stored(telemetry, tag="t"):
    """Return the stored ``n``, oldest first."""
    reports = await telemetry._call(lambda: telemetry._store.history("m", tag, 10_000))
    return [r.values["n"] for r in reversed(reports)]


KILLED = """
import asyncio, os, sys
from pathlib import Path
from toolpost.core.report import Report
from toolpost.telemetry import SampleGrid, Telemetry, store
store.CHUNK_ROWS = 300

async def run():
    telemetry = Telemetry.open(Path(sys.argv[1]))
    for part in range(10):
        for n in range(part * 100, part * 100 + 100):
            telemetry.record("m", Report(1_735_689_600_000_000 + n * 1000, "t", {"n": n}))
        await telemetry.query("m", [], SampleGrid.from_seconds(0, 0, 1))
    print("written", flush=True)
    while True:
        n += 1
        telemetry.record("m", Report(1_735_689_600_000_000 + n * 1000, "t", {"n": n}))
        await asyncio.sleep(0)

asyncio.run(run())
"""


def test_kill_9_loses_nothing_that_was_written(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)], stdout=subprocess.PIPE)
    with process:
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)

    async def run():
        telemetry = Telemetry.open(tmp_path)
        numbers = await stored(telemetry)
        latest = telemetry.latest("m", "t")
        await telemetry.close()
        return numbers, latest

    numbers, latest = asyncio.run(run())
    assert len(numbers) >= 1_000
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert latest.values["n"] == numbers[-1]


def test_pending_reports_are_written_by_themselves(tmp_path, monkeypatch):
    monkeypatch.setattr("toolpost.telemetry.service.FLUSH_S", 0.01)

    async def run():
        telemetry = Telemetry.open(tmp_path)
        empty = (tmp_path / "telemetry.journal").stat().st_size
        telemetry.record("m", report(1))
        for _ in range(1_000):
            await asyncio.sleep(0.005)
            if (tmp_path / "telemetry.journal").stat().st_size > empty:
                break
        else:
            pytest.fail("nothing was written")
        assert telemetry._timer is None  # nothing runs while nothing comes in
        await telemetry.close()

    asyncio.run(run())


def test_full_journal_warns_once_counts_and_recovers(tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.INFO)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    async def run():
        telemetry = Telemetry.open(tmp_path)
        for n in range(3):
            telemetry.record("m", report(n))
        await flush(telemetry)
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", full)
            for n in range(3, 8):
                telemetry.record("m", report(n))
                await flush(telemetry)
        assert telemetry.dropped == 5
        assert telemetry.latest("m", "t").values["n"] == 7
        for n in range(8, 10):
            telemetry.record("m", report(n))
            await flush(telemetry)
        assert telemetry.dropped == 5
        await telemetry.close()
        telemetry = Telemetry.open(tmp_path)
        assert await stored(telemetry) == [0, 1, 2, 8, 9]
        await telemetry.close()

    asyncio.run(run())
    assert [r.levelname for r in caplog.records] == ["WARNING", "INFO"]


def test_full_database_keeps_rows_until_there_is_room(tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(store, "CHUNK_ROWS", 100)
    monkeypatch.setattr(store, "RETRY_S", 0)

    async def run():
        telemetry = Telemetry.open(tmp_path)
        chunks = telemetry._store._chunks
        database = chunks._db

        def limit(pages):
            database.execute(f"PRAGMA max_page_count = {pages}").fetchall()

        await telemetry._call(lambda: limit(1))
        for n in range(150):
            telemetry.record("m", report(n, n=n, text=f"{n:06}" * 40))
            await flush(telemetry)
        assert telemetry.dropped == 0
        for n in range(150, 400):
            telemetry.record("m", report(n, n=n, text=f"{n:06}" * 40))
            await flush(telemetry)
        assert telemetry.dropped == 200
        assert await stored(telemetry) == list(range(200))
        await telemetry._call(lambda: limit(10_000))
        for n in range(400, 450):
            telemetry.record("m", report(n, n=n, text="x"))
            await flush(telemetry)
        await telemetry.close()
        telemetry = Telemetry.open(tmp_path)
        assert await stored(telemetry) == [*range(200), *range(400, 450)]
        await telemetry.close()

    asyncio.run(run())
    assert [r.levelname for r in caplog.records] == ["WARNING", "INFO"]


def test_size_is_bounded_and_the_latest_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "CHUNK_ROWS", 2_000)
    limits = Limits(max_bytes=4 << 20)

    def size():
        return sum(file.stat().st_size for file in tmp_path.iterdir())

    async def run():
        telemetry = Telemetry.open(tmp_path, limits)
        largest = 0
        for part in range(60):
            for n in range(part * 2_000, part * 2_000 + 2_000):
                values = {f"k{k}": (n * 7_919 * (k + 1) % 1_000_003) / 1e3 for k in range(10)}
                telemetry.record("m", report(n, n=n, **values))
            await flush(telemetry)
            largest = max(largest, size())
        assert telemetry.dropped == 0
        kept = await stored(telemetry)
        await telemetry.close()
        telemetry = Telemetry.open(tmp_path, limits)
        assert await stored(telemetry) == kept
        await telemetry.close()
        return largest, kept

    largest, kept = asyncio.run(run())
    assert largest <= 4 << 20
    assert len(kept) > 8_000
    assert kept == list(range(120_000 - len(kept), 120_000))


def test_many_tails_stay_within_the_reserve(tmp_path):
    """Rows of many shapes, none of which fills a chunk by itself."""
    limits = Limits(max_bytes=4 << 20)

    async def run():
        telemetry = Telemetry.open(tmp_path, limits)
        for n in range(12_000):
            telemetry.record("m", report(n, tag=f"t{n % 40}", n=n, text="y" * 40))
            if n % 1_000 == 999:
                await flush(telemetry)
        assert telemetry.dropped == 0
        journal = (tmp_path / "telemetry.journal").stat().st_size
        assert await stored(telemetry, "t3") == list(range(3, 12_000, 40))
        await telemetry.close()
        telemetry = Telemetry.open(tmp_path, limits)
        assert await stored(telemetry, "t3") == list(range(3, 12_000, 40))
        await telemetry.close()
        return journal

    assert asyncio.run(run()) <= (4 << 20) // 8


def test_age(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "CHUNK_ROWS", 10)

    async def run():
        telemetry = Telemetry.open(tmp_path, Limits(max_age_s=60))
        now = int(time.time() * 1e6)
        for n in range(35):
            telemetry.record("m", report(n, time_us=now - 100_000_000 + n * 2_000_000))
        telemetry.record("m", report(0, tag="old", time_us=now - 100_000_000))
        inner = telemetry._store
        # Small frames, so that tails are sealed at every tenth row.
        monkeypatch.setattr(store, "FRAME_REPORTS", 1)
        await flush(telemetry)

        def retire(ahead):
            inner._retire(time.monotonic(), time.time() + ahead)

        await telemetry._call(lambda: retire(1e9))  # the clock was set: hands off
        assert len(await stored(telemetry)) == 35
        inner._retired_at = (time.monotonic(), time.time())
        await telemetry._call(lambda: retire(0))
        assert await stored(telemetry) == list(range(20, 35))
        assert await stored(telemetry, "old") == []
        await telemetry.close()

    asyncio.run(run())


@pytest.mark.parametrize("rows", [2, 8_000])
def test_clock_that_steps_back(tmp_path, monkeypatch, rows):
    monkeypatch.setattr(store, "CHUNK_ROWS", rows)
    second = 1_000_000
    times = [100, 101, 99, 96.5, 101, 102, 50, 51, 49, 101.5, 20, 21]
    kept = [0, 1, 4, 5, 6, 7, 9, 10, 11]

    async def run():
        for n, at in enumerate(times):
            telemetry = Telemetry.open(tmp_path)
            telemetry.record("m", report(n, time_us=int(at * second)))
            assert telemetry.latest("m", "t").values["n"] == n
            await telemetry.close()
        telemetry = Telemetry.open(tmp_path)
        assert await stored(telemetry) == kept
        grid = SampleGrid.from_seconds(20, 102, 1)
        result = await telemetry.query("m", ["t.n"], grid)
        await telemetry.close()
        return dict(zip(grid.seconds(), result["t.n"], strict=True))

    values = asyncio.run(run())
    found = {at: n for at, n in values.items() if n is not None}
    assert found == {20: 10, 21: 11, 22: 11, 50: 6, 51: 7, 52: 7, 100: 0, 101: 4, 102: 5}


def test_shapes_tags_keys_and_names_are_bounded(tmp_path):
    limits = Limits(tags_per_machine=3, shapes_per_tag=4, keys_per_report=5, name_chars=8)

    async def run():
        telemetry = Telemetry.open(tmp_path, limits)
        for n in range(10):
            telemetry.record("m", report(n, tag=f"tag{n}"))
        assert telemetry.dropped == 7
        for n in range(10, 20):
            telemetry.record("m", report(n, tag="tag0", **{f"k{n}": 1}))
        await flush(telemetry)
        assert telemetry.dropped == 7 + 7
        for values in ({f"k{n}": 1 for n in range(6)}, {"k" * 9: 1}, {"\ud800": 1}, {"k": [1]}):
            telemetry.record("m", report(30, tag="tag1", **values))
        telemetry.record("other", report(30, tag="t" * 9))
        telemetry.record("m", report(0, tag="tag1", time_us=-1))
        telemetry.record("m", report(0, tag="tag1", time_us=1 << 63))
        await flush(telemetry)
        assert telemetry.dropped == 14 + 7
        assert await stored(telemetry, "tag1") == [1]
        await telemetry.close()

    asyncio.run(run())


def test_changing_nulls_need_no_new_shape(tmp_path):
    async def run():
        telemetry = Telemetry.open(tmp_path, Limits(shapes_per_tag=1))
        for n in range(200):
            values = {f"k{k}": None if n >> k & 1 else n for k in range(7)}
            telemetry.record("m", report(n, n=n, **values))
        await flush(telemetry)
        assert telemetry.dropped == 0
        assert await stored(telemetry) == list(range(200))
        await telemetry.close()

    asyncio.run(run())


def test_pending_reports_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr("toolpost.telemetry.service.FLUSH_REPORTS", 10)

    async def run():
        telemetry = Telemetry.open(tmp_path, Limits(pending_reports=50))
        telemetry._is_idle = lambda: False  # a disk that hangs
        for n in range(80):
            telemetry.record("m", report(n))
        assert telemetry.dropped == 30
        assert await stored(telemetry) == list(range(50))
        await telemetry.close()

    asyncio.run(run())


def test_close_twice_and_record_after(tmp_path):
    async def run():
        telemetry = Telemetry.open(tmp_path)
        await telemetry.close()
        await telemetry.close()
        telemetry.record("m", report(1))
        assert telemetry.dropped == 1

    asyncio.run(run())


def test_damaged_database_is_put_aside(tmp_path, caplog):
    (tmp_path / "telemetry.db").write_bytes(b"no database at all" * 1_000)

    async def run():
        telemetry = Telemetry.open(tmp_path)
        telemetry.record("m", report(1))
        assert await stored(telemetry) == [1]
        await telemetry.close()

    asyncio.run(run())
    assert (tmp_path / "telemetry.db.damaged").exists()
    assert len(caplog.records) == 1


def test_directory_that_cannot_be_used(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError):
        Telemetry.open(tmp_path / "file")
    (tmp_path / "telemetry.journal").mkdir()
    with pytest.raises(StorageError):
        Telemetry.open(tmp_path)


def test_defect_in_the_store_does_not_reach_the_caller(tmp_path, caplog):
    async def run():
        telemetry = Telemetry.open(tmp_path)
        telemetry.record("m", Report("soon", "t", {}))
        await flush(telemetry)
        telemetry.record("m", report(1))
        assert await stored(telemetry) == [1]
        await telemetry.close()

    asyncio.run(run())
    assert len(caplog.records) == 1


def test_power_loss_after_a_seal_replays_the_journal(tmp_path, monkeypatch):
    """The database lost its last chunks, as synchronous=NORMAL allows; the journal has them."""
    monkeypatch.setattr(store, "CHUNK_ROWS", 10)

    async def fill():
        telemetry = Telemetry.open(tmp_path)
        for n in range(35):
            telemetry.record("m", report(n))
            await flush(telemetry)
        await telemetry.close()

    asyncio.run(fill())
    with sqlite3.connect(tmp_path / "telemetry.db") as database:
        database.execute("DELETE FROM chunk WHERE id > 1")
        database.execute("DELETE FROM body WHERE id > 1")
        database.execute("UPDATE shape SET sealed = 10")
    database.close()

    async def read():
        telemetry = Telemetry.open(tmp_path)
        numbers = await stored(telemetry)
        await telemetry.close()
        return numbers

    assert asyncio.run(read()) == list(range(35))


def test_import_is_light():
    code = "import sys, toolpost.telemetry; print('numpy' in sys.modules, 'uvicorn' in sys.modules)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.split() == ["False", "False"]
