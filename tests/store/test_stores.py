"""Jobs, settings, keys and the lock of the directory."""

import hashlib
import os
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.store.storing import fill, free, job, opened, run
from toolpost.core.job import Job, JobState, Reason
from toolpost.errors import StartError, StorageError
from toolpost.store.jobs import JobStore, _job, _row
from toolpost.store.keys import KeyStore
from toolpost.store.lock import DirectoryLock
from toolpost.store.settings import SettingStore

ENDED = [JobState.CANCELED, JobState.ABORTED, JobState.COMPLETED]
OPEN = [state for state in JobState if state not in ENDED]

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
times = st.integers(0, 2**62)
jobs = st.builds(
    Job,
    seq=st.integers(1, 2**62),
    id=texts,
    machine=texts,
    program=texts,
    commands=st.integers(0, 2**40),
    name=texts,
    position=st.integers(-(2**62), 2**62),
    called=st.booleans(),
    signals=st.dictionaries(texts, st.floats(0.01, 1e6), max_size=3),
    state=st.sampled_from(JobState),
    reason=st.sampled_from(Reason),
    detail=texts,
    created_us=times,
    started_us=st.none() | times,
    ended_us=st.none() | times,
)


@given(jobs)
def test_a_row_holds_all_of_a_job(given_job):
    assert _job(tuple(_row(given_job)[name] for name in Job.__struct_fields__)) == given_job


def test_jobs_round_trip_and_their_events(tmp_path):
    path = tmp_path / "d.db"
    first = job(
        1, name="ä b/c.gcode", position=-5, called=False, signals={"?pos": 0.5}, detail="über 'x' \"y\""
    )

    async def main():
        with opened(path) as database:
            store = JobStore(database)
            await store.add([first], "me")
            started = first.to(JobState.PROCESSING, Reason.RUNNING, 20)
            await store.update([started], 21, "system")
            found = store.load("m", 10)
            assert found == [started]
            assert found[0].called is False
            assert store.load("other", 10) == []
            started = msgspec.structs.replace(started, position=2**60, called=True)
            ended = started.to(JobState.ABORTED, Reason.LINK_LOST, 30, "gone")
            await store.update([ended], 31, "system")
        with opened(path) as database:
            assert JobStore(database).load("m", 10) == [ended]

    run(main)
    connection = sqlite3.connect(path)
    events = connection.execute(
        "SELECT job, time_us, actor, state, reason, detail FROM job_event ORDER BY seq"
    )
    assert connection.execute("SELECT actor, created_us FROM job").fetchall() == [("me", 10)]
    assert events.fetchall() == [
        (1, 21, "system", "processing", "running", ""),
        (1, 31, "system", "aborted", "link-lost", "gone"),
    ]
    connection.close()


def test_numbers_are_never_used_again(tmp_path):
    path = tmp_path / "d.db"

    async def main():
        used = []
        for _ in range(3):
            with opened(path) as database:
                store = JobStore(database)
                for _ in range(3):
                    seq = store.next_seq()
                    used.append(seq)
                    await store.add([job(seq, state=JobState.COMPLETED)], "me")
                await store.trim("m", 1)
                await database.write(lambda connection: connection.execute("DELETE FROM job"))
        assert used == list(range(1, 10))

    run(main)


def test_load_has_the_newest_and_all_that_have_not_ended(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            store = JobStore(database)
            for seq in range(1, 31):
                state = OPEN[seq % 4] if seq in {2, 3, 8, 9, 29} else ENDED[seq % 3]
                await store.add([job(seq, state=state, machine="m" if seq != 9 else "n")], "me")
            assert [found.seq for found in store.load("m", 4)] == [2, 3, 8, 27, 28, 29, 30]
            assert [found.seq for found in store.load("n", 4)] == [9]

    run(main)


def test_programs_in_use_are_those_of_jobs_not_ended(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            store = JobStore(database)
            for seq, state in enumerate(JobState, start=1):
                await store.add([job(seq, state=state, program=state.value, machine=f"m{seq}")], "me")
            assert store.programs_in_use() == {state.value for state in OPEN}

    run(main)


def test_trim_keeps_the_newest_and_what_has_not_ended(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            store = JobStore(database)
            jobs = [
                job(seq, state=JobState.PENDING_HELD if seq == 2 else JobState.COMPLETED)
                for seq in range(1, 11)
            ]
            jobs.append(job(11, machine="other", state=JobState.COMPLETED))
            await store.add(jobs, "me")
            await store.update(jobs, 5, "me")
            await store.trim("m", 100)
            assert len(store.load("m", 100)) == 10
            await store.trim("m", 3)
            assert [found.seq for found in store.load("m", 100)] == [2, 8, 9, 10]
            assert len(store.load("other", 100)) == 1
            events = await database.write(
                lambda c: c.execute("SELECT DISTINCT job FROM job_event").fetchall()
            )
            assert sorted(events) == [(2,), (8,), (9,), (10,), (11,)]

    run(main)


def test_a_job_the_disk_does_not_take_is_not_there(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            store = JobStore(database)
            await store.add([job(1)], "me")
            await fill(database)
            with pytest.raises(StorageError):
                await store.add([job(2, detail="x" * 10_000)], "me")
            with pytest.raises(StorageError):
                await store.update([job(1, detail="x" * 10_000)], 5, "me")
            assert store.load("m", 10) == [job(1)]
            await free(database)
            await store.add([job(3)], "me")
            assert [found.seq for found in store.load("m", 10)] == [1, 3]

    run(main)


def test_jobs_added_or_changed_together_are_all_stored_or_none(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            store = JobStore(database)
            first = [job(1), job(2)]
            await store.add(first, "me")
            await store.add([], "me")
            with pytest.raises(sqlite3.IntegrityError):
                await store.add([job(3), job(4), job(2)], "me")
            await fill(database)
            with pytest.raises(StorageError):
                await store.add([job(5), job(6, detail="x" * 20_000), job(7)], "me")
            with pytest.raises(StorageError):
                await store.update([job(1, position=9), job(2, detail="x" * 20_000)], 5, "me")
            assert store.load("m", 10) == first
            await free(database)
            events = await database.write(lambda c: c.execute("SELECT job FROM job_event").fetchall())
            assert events == [], "no event of what was not stored"
            changed = [job(1, position=9), job(2, called=False)]
            await store.update(changed, 5, "me")
            assert store.load("m", 10) == changed
            events = await database.write(lambda c: c.execute("SELECT job FROM job_event").fetchall())
            assert sorted(events) == [(1,), (2,)]

    run(main)


# Settings.


def test_settings(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            settings = SettingStore(database)
            assert settings.get("m", "init") is None
            await settings.set("m", "init", ["G1", "ü"])
            await settings.set("n", "init", {"a": [None, 1.5]})
            await settings.set("m", "init", [])
            await settings.set("m", "other", 1)
        with opened(tmp_path / "d.db") as database:
            settings = SettingStore(database)
            assert settings.get("m", "init") == []
            assert settings.get("n", "init") == {"a": [None, 1.5]}
            assert settings.get("m", "other") == 1
            await fill(database)
            with pytest.raises(StorageError):
                await settings.set("m", "init", ["x" * 20_000])
            assert settings.get("m", "init") == []

    run(main)


# Keys.


def test_only_the_hash_of_a_key_is_on_disk(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            keys = KeyStore(database)
            secret = await keys.add("phone")
            assert keys.owner(secret) == "phone"
            written = b"".join(file.read_bytes() for file in tmp_path.iterdir())
            assert hashlib.sha256(secret.encode()).digest() in written
            assert secret.encode() not in written
            return secret

    secret = run(main)
    assert len(secret) >= 43
    assert secret.encode() not in (tmp_path / "d.db").read_bytes()


def test_what_is_no_key_has_no_owner(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            keys = KeyStore(database)
            secret = await keys.add("phone")
            wrong = ["", secret[:-1], secret + " ", secret.swapcase(), "phone", "\ud800", "é"]
            wrong.append(hashlib.sha256(secret.encode()).hexdigest())
            assert [keys.owner(text) for text in wrong] == [None] * len(wrong)

    run(main)


def test_keys_are_made_and_deleted(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as database:
            keys = KeyStore(database)
            a, b = await keys.add("a"), await keys.add("b")
            assert a != b
            assert await keys.add("a") is None
            assert (keys.owner(a), keys.owner(b), keys.names()) == ("a", "b", ["a", "b"])
            assert await keys.delete("a") is True
            assert await keys.delete("a") is False
            assert (keys.owner(a), keys.owner(b), keys.names()) == (None, "b", ["b"])
        with opened(tmp_path / "d.db") as database:
            assert KeyStore(database).owner(b) == "b"

    run(main)


def test_what_another_process_does_to_keys_holds_at_once(tmp_path):
    async def main():
        with opened(tmp_path / "d.db") as here, opened(tmp_path / "d.db") as there:
            server, command = KeyStore(here), KeyStore(there)
            assert server.owner("x") is None
            secret = await command.add("phone")
            assert server.owner(secret) == "phone"
            await here.write(lambda connection: connection.execute("DELETE FROM job"))
            assert server.owner(secret) == "phone"
            await command.delete("phone")
            assert server.owner(secret) is None

    run(main)


# The lock.

HOLD = """
import sys, time
from pathlib import Path
from toolpost.store.lock import DirectoryLock
lock = DirectoryLock(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(60)
"""


def test_a_directory_held_by_another_process_is_refused_until_that_is_killed(tmp_path):
    directory = tmp_path / "new" / "data"
    holder = subprocess.Popen([sys.executable, "-c", HOLD, directory], stdout=subprocess.PIPE)
    try:
        assert holder.stdout.readline() == b"held\n"
        for _ in range(2):
            with pytest.raises(StartError) as caught:
                DirectoryLock(directory)
            assert (
                str(caught.value)
                == f"data directory {directory}: another Toolpost (process {holder.pid}) uses it"
            )
        holder.send_signal(signal.SIGKILL)
        holder.wait(10)
        lock = DirectoryLock(directory)
        assert (directory / "toolpost.lock").read_text() == f"{os.getpid()}\n"
        lock.close()
    finally:
        holder.kill()
        holder.wait(10)
        holder.stdout.close()


def test_a_refusal_leaks_no_descriptor(tmp_path):
    lock = DirectoryLock(tmp_path)
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        with pytest.raises(StartError):
            DirectoryLock(tmp_path)
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    lock.close()
    DirectoryLock(tmp_path).close()


def test_a_child_does_not_inherit_the_lock(tmp_path):
    lock = DirectoryLock(tmp_path)
    child = subprocess.Popen(["sleep", "60"], close_fds=False)
    try:
        lock.close()
        DirectoryLock(tmp_path).close()
    finally:
        child.kill()
        child.wait(10)


def test_a_directory_that_cannot_be_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StartError, match="data directory"):
        DirectoryLock(tmp_path / "file" / "data")


def test_a_full_disk_does_not_stop_the_lock(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    lock = DirectoryLock(tmp_path)
    with pytest.raises(StartError, match="another Toolpost"):
        DirectoryLock(tmp_path)
    lock.close()
