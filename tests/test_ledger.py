"""The jobs of a machine in memory and on disk: what was acknowledged is never missing."""

import asyncio
import contextlib
import threading
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from tests.store.storing import fill, free, run
from toolpost import ledger as module
from toolpost.core.job import JobState, Reason
from toolpost.core.program import Program
from toolpost.errors import StorageError
from toolpost.ledger import Ledger
from toolpost.store.database import Database
from toolpost.store.jobs import JobStore

S = JobState
PROGRAM = Program("p" * 64, 3, 30)
HUGE = {"?pos" + "x" * 20_000: 1.0}
LONG = "x" * 20_000


class Desk:
    """A ledger over a database, and what it told."""

    def __init__(self, path, *, load_on_startup=True, keep_shown=100, keep_stored=100):
        self.database = Database(path)
        self.told = []
        self.ledger = Ledger(
            "m",
            JobStore(self.database),
            keep_shown=keep_shown,
            keep_stored=keep_stored,
            changed=self.told.append,
        )
        self.ledger.load(load_on_startup=load_on_startup)

    def stored(self):
        """What another process would find."""
        return {job.seq: job for job in JobStore(self.database).load("m", 1000)}

    def new(self, *names):
        """New jobs that are to wait in the queue."""
        return [self.ledger.new(PROGRAM, {}, name=name, called=False) for name in names]

    async def add(self, signals=None, **values):
        """Add one job and return it as it is then."""
        job = self.ledger.new(PROGRAM, signals or {}, **values)
        await self.ledger.add([job], "me")
        return self.ledger.get(job.seq)

    async def queue(self, *names):
        """Add jobs to the queue and return them."""
        jobs = self.new(*names)
        await self.ledger.add(jobs, "me")
        return jobs

    async def settle(self):
        """Let all that is queued be written and told."""
        with contextlib.suppress(StorageError):
            await self.database.write(lambda _: None)
        await asyncio.sleep(0)

    def hold(self):
        """Hold the writer up; the result lets it go on."""
        go, started = threading.Event(), threading.Event()
        self.database.submit(lambda _: started.set() or go.wait(10))
        assert started.wait(10)
        return go.set

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.ledger.close()
        self.database.close()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "d.db"


@pytest.fixture(autouse=True)
def _soon(monkeypatch):
    monkeypatch.setattr(module, "_RETRY_AFTER", 0.01)


def started(job):
    return job.to(S.PROCESSING, Reason.RUNNING, 5)


def ended(job, detail=""):
    return job.to(S.CANCELED, Reason.CANCELED_BY_USER, 9, detail)


def moved(job, **values):
    return msgspec.structs.replace(job, **values)


async def until(condition):
    async with asyncio.timeout(10):
        while not condition():
            await asyncio.sleep(0.002)


# add


def test_an_added_job_is_on_disk_and_told(path):
    async def main():
        with Desk(path) as desk:
            job = await desk.add({"?pos": 0.5})
            assert desk.stored() == {1: job}
            assert (job.state, job.program, job.commands, job.signals) == (
                S.PENDING,
                "p" * 64,
                3,
                {"?pos": 0.5},
            )
            assert desk.told == [job]
            assert list(desk.ledger) == desk.ledger.open == [job]
            assert desk.ledger.next is job
            assert desk.ledger.active is None

    run(main)


def test_a_job_not_on_disk_yet_is_not_shown_and_not_started_but_holds_its_place(path):
    async def main():
        with Desk(path) as desk:
            let_go = desk.hold()
            adding = asyncio.create_task(desk.add())
            await asyncio.sleep(0)
            assert list(desk.ledger) == []
            assert desk.ledger.next is None
            assert len(desk.ledger.open) == 1
            let_go()
            assert await adding == desk.ledger.next

    run(main)


def test_ids_differ_and_order_is_that_of_adding(path):
    async def main():
        with Desk(path) as desk:
            jobs = await asyncio.gather(*(desk.add() for _ in range(20)))
            assert len({job.id for job in jobs}) == 20
            assert [job.seq for job in desk.ledger] == list(range(1, 21))

    run(main)


def test_a_job_the_disk_did_not_take_is_not_there(path):
    async def main():
        with Desk(path) as desk:
            await fill(desk.database)
            with pytest.raises(StorageError):
                await desk.add(HUGE)
            assert list(desk.ledger) == desk.ledger.open == desk.told == []
            assert desk.ledger.next is None
            await free(desk.database)
            job = await desk.add()
            assert job.seq == 2, "a number is not used again"

    run(main)


def test_who_added_may_go_away(path):
    async def main():
        with Desk(path) as desk:
            let_go = desk.hold()
            adding = asyncio.create_task(desk.add())
            await asyncio.sleep(0)
            adding.cancel()
            await asyncio.gather(adding, return_exceptions=True)
            assert desk.ledger.next is None, "not on disk yet"
            let_go()
            await desk.settle()
            assert desk.ledger.next in desk.told

    run(main)


def test_who_added_may_go_away_while_the_disk_is_full(path):
    async def main():
        with Desk(path) as desk:
            await fill(desk.database)
            let_go = desk.hold()
            adding = asyncio.create_task(desk.add(HUGE))
            await asyncio.sleep(0)
            adding.cancel()
            await asyncio.gather(adding, return_exceptions=True)
            let_go()
            await desk.settle()
            assert list(desk.ledger) == desk.ledger.open == desk.told == []

    run(main)


def test_a_job_canceled_while_it_is_being_added(path):
    async def main():
        with Desk(path) as desk:
            let_go = desk.hold()
            adding = asyncio.create_task(desk.add())
            await asyncio.sleep(0)
            records = desk.ledger.end_called(S.CANCELED, Reason.CANCELED_BY_USER, "you")
            let_go()
            job = await adding
            await asyncio.gather(*records)
            assert job.state is S.CANCELED
            assert desk.stored() == {1: job}
            assert desk.ledger.next is None

    run(main)


# change


def test_a_change_holds_at_once_and_is_on_disk_when_it_returns(path):
    async def main():
        with Desk(path) as desk:
            job = started(await desk.add())
            changing = asyncio.create_task(desk.ledger.change(job))
            await asyncio.sleep(0)
            assert desk.ledger.active is job
            assert job not in desk.told
            await changing
            assert desk.told[-1] is job
            assert desk.stored() == {1: job}

    run(main)


def test_a_change_the_disk_did_not_take_is_undone(path):
    async def main():
        with Desk(path) as desk:
            job = await desk.add()
            await fill(desk.database)
            with pytest.raises(StorageError):
                await desk.ledger.change(job.to(S.PROCESSING, Reason.RUNNING, 5, LONG))
            assert desk.ledger.get(1) is desk.ledger.next is job
            assert desk.ledger.active is None
            assert desk.stored() == {1: job}
            assert desk.told == [job]

    run(main)


def test_a_change_undone_does_not_undo_what_came_after_it(path):
    async def main():
        with Desk(path) as desk:
            job = await desk.add()
            await fill(desk.database)
            let_go = desk.hold()
            start = job.to(S.PROCESSING, Reason.RUNNING, 5, LONG)
            changing = asyncio.create_task(desk.ledger.change(start))
            await asyncio.sleep(0)
            done = desk.ledger.declare(ended(start))
            let_go()
            await asyncio.gather(changing, done, return_exceptions=True)
            assert isinstance(changing.exception(), StorageError)
            assert desk.ledger.get(1).state is S.CANCELED
            await until(lambda: desk.stored()[1].state is S.CANCELED)

    run(main)


# declare


def test_what_is_declared_holds_at_once(path):
    async def main():
        with Desk(path) as desk:
            job = ended(await desk.add())
            future = desk.ledger.declare(job, "me")
            assert desk.ledger.get(1) is job
            assert desk.ledger.open == []
            await future
            await desk.settle()
            assert desk.stored() == {1: job}
            assert desk.told[-1] is job

    run(main)


def test_what_is_declared_is_written_again_until_the_disk_takes_it(path):
    async def main():
        with Desk(path) as desk:
            job = ended(await desk.add(), LONG)
            await fill(desk.database)
            with pytest.raises(StorageError):
                await desk.ledger.declare(job)
            assert desk.ledger.get(1) is job, "it has happened all the same"
            await asyncio.sleep(0.05)
            assert desk.stored()[1].state is S.PENDING
            assert job not in desk.told
            await free(desk.database)
            await until(lambda: job in desk.told)
            assert desk.stored() == {1: job}

    run(main)


def test_what_is_owed_is_written_before_what_comes_later(path, monkeypatch):
    monkeypatch.setattr(module, "_RETRY_AFTER", 60)

    async def main():
        with Desk(path) as desk:
            job = ended(await desk.add(), LONG)
            await fill(desk.database)
            with pytest.raises(StorageError):
                await desk.ledger.declare(job)
            await free(desk.database)
            second = await desk.add()
            assert desk.stored() == {1: job, 2: second}

    run(main)


def test_a_late_retry_does_not_undo_a_later_transition(path):
    async def main():
        with Desk(path) as desk:
            job = started(await desk.add())
            await desk.ledger.change(job)
            await fill(desk.database)
            stopped = job.to(S.PROCESSING_STOPPED, Reason.LINK_LOST, 6, LONG)
            failed = threading.Event()
            commit = desk.database._commit
            desk.database._commit = lambda changes: (commit(changes), failed.set())
            first = desk.ledger.declare(stopped)
            # The disk has refused it, but the loop has not heard of it yet.
            assert failed.wait(10)
            second = desk.ledger.declare(ended(stopped))
            results = await asyncio.gather(first, second, return_exceptions=True)
            assert isinstance(results[0], StorageError)
            assert results[1] is None
            await free(desk.database)
            await asyncio.sleep(0.05)
            await desk.settle()
            assert desk.stored()[1] == desk.ledger.get(1)
            assert desk.ledger.get(1).state is S.CANCELED

    run(main)


def test_end_called_ends_all_that_have_not_ended_but_what_waits_in_the_queue(path):
    async def main():
        with Desk(path) as desk:
            jobs = [await desk.add() for _ in range(4)]
            await desk.ledger.change(started(jobs[0]))
            await desk.ledger.change(jobs[1].to(S.PENDING_HELD, Reason.MACHINE_BUSY, 3))
            await desk.ledger.declare(jobs[2].to(S.ABORTED, Reason.PROGRAM_MISSING, 3))
            queued = await desk.queue("a", "b")
            futures = desk.ledger.end_called(S.CANCELED, Reason.CANCELED_BY_USER, "you")
            assert len(futures) == 3
            await asyncio.gather(*futures)
            states = [job.state for job in desk.stored().values()]
            assert states == [S.CANCELED, S.CANCELED, S.ABORTED, S.CANCELED, S.PENDING, S.PENDING]
            assert desk.ledger.called == []
            assert desk.ledger.open == desk.ledger.queued == queued

    run(main)


# The queue.


def test_queued_jobs_wait_in_order_and_do_not_start(path):
    async def main():
        with Desk(path) as desk:
            jobs = await desk.queue("a", "b", "a")
            assert desk.ledger.queued == desk.told == jobs
            assert [(job.name, job.called, job.reason) for job in jobs] == [
                (name, False, Reason.QUEUE_POSITION) for name in "aba"
            ]
            assert desk.ledger.called == []
            assert desk.ledger.next is None
            assert list(desk.stored().values()) == jobs
            other = await desk.add()
            assert desk.ledger.queued == jobs, "a job that is called does not wait in the queue"
            assert desk.ledger.called == [other]
            assert desk.ledger.next is other
            assert desk.ledger.open == [*jobs, other]

    run(main)


def test_queued_is_ordered_by_position_then_by_adding(path):
    async def main():
        with Desk(path) as desk:
            positions = [7, -3, 7, 0]
            jobs = [
                moved(job, position=position)
                for job, position in zip(desk.new(*"abcd"), positions, strict=True)
            ]
            await desk.ledger.add(jobs, "me")
            assert [job.name for job in desk.ledger.queued] == ["b", "d", "a", "c"]
        with Desk(path) as desk:
            assert [job.name for job in desk.ledger.queued] == ["b", "d", "a", "c"]
            assert [job.name for job in desk.ledger] == ["a", "b", "c", "d"]

    run(main)


def test_a_jump_is_a_change_of_position_and_leaves_room(path):
    async def main():
        with Desk(path) as desk:
            await desk.queue("a", "b", "c")
            for name in ("c", "b", "a", "c"):
                queued = desk.ledger.queued
                job = next(job for job in queued if job.name == name)
                await desk.ledger.change(moved(job, position=queued[0].position - 1), actor="me")
                assert desk.ledger.queued[0].name == name
            await desk.queue("d")
            assert [job.name for job in desk.ledger.queued] == ["c", "a", "b", "d"]
        with Desk(path) as desk:
            assert [job.name for job in desk.ledger.queued] == ["c", "a", "b", "d"]

    run(main)


def test_what_is_not_on_disk_yet_is_left_out_of_the_queue(path):
    async def main():
        with Desk(path) as desk:
            first = await desk.queue("a")
            assert desk.ledger.queued == first
            let_go = desk.hold()
            jobs = desk.new("b", "c")
            adding = asyncio.create_task(desk.ledger.add(jobs, "me"))
            await asyncio.sleep(0)
            assert desk.ledger.queued == first
            assert desk.ledger.open == [*first, *jobs]
            let_go()
            await adding
            assert desk.ledger.queued == [*first, *jobs]

    run(main)


def test_queued_is_right_after_each_kind_of_change(path):
    async def main():
        with Desk(path) as desk:
            ledger = desk.ledger

            def names():
                return "".join(job.name for job in ledger.queued)

            assert names() == ""
            a, b, c, d, e = await desk.queue(*"abcde")
            assert names() == "abcde"

            let_go = desk.hold()
            calling = asyncio.create_task(ledger.change(moved(a, called=True)))
            await asyncio.sleep(0)
            assert names() == "bcde", "a change holds at once"
            let_go()
            await calling
            assert names() == "bcde"
            await ledger.change(moved(a, called=False))
            assert names() == "abcde"
            await ledger.change(moved(e, position=a.position - 1))
            assert names() == "eabcd"
            future = ledger.declare(ended(b))
            assert names() == "eacd"
            await future
            ledger.explain(c, Reason.MACHINE_OFFLINE)
            assert [job.reason for job in ledger.queued if job.name == "c"] == [Reason.MACHINE_OFFLINE]
            await ledger.change(ended(c), moved(d, position=e.position))
            assert names() == "ead"

            before = ledger.queued
            await fill(desk.database)
            with pytest.raises(StorageError):
                await ledger.change(ended(a), ended(d, LONG))
            assert ledger.queued == before, "a change undone"
            with pytest.raises(StorageError):
                await ledger.add([moved(job, detail=LONG) for job in desk.new("f", "g")], "me")
            assert ledger.queued == before, "an addition undone"

    run(main)


def test_jobs_changed_together_are_changed_and_told_together(path):
    async def main():
        with Desk(path) as desk:
            a, b, c = await desk.queue(*"abc")
            changed = [moved(c, position=1), moved(a, position=2), ended(b)]
            desk.told.clear()
            await desk.ledger.change(*changed, actor="you")
            assert desk.told == changed
            assert [job.name for job in desk.ledger.queued] == ["c", "a"]
            assert list(desk.stored().values()) == [changed[1], changed[2], changed[0]]

    run(main)


def test_many_jobs_added_in_one_call_are_all_there_after_a_restart(path):
    count = 10_000

    async def main():
        with Desk(path, keep_shown=10, keep_stored=10) as desk:
            jobs = await desk.queue(*(f"{n:05}" for n in range(count)))
            assert len({job.id for job in jobs}) == count
            assert desk.ledger.queued == desk.told == jobs
        with Desk(path, keep_shown=10, keep_stored=10) as desk:
            assert desk.ledger.queued == list(desk.ledger) == jobs
            await desk.settle()
            assert desk.told == [], "they are as they were"
            assert len(desk.stored()) == count, "not trimmed: they have not ended"

    run(main)


@pytest.mark.parametrize("canceled", [False, True])
def test_many_jobs_that_the_disk_does_not_take_are_not_there(path, canceled):
    async def main():
        with Desk(path) as desk:
            first = await desk.queue("a")
            await fill(desk.database)
            jobs = desk.new(*(f"{n:05}" for n in range(2000)))
            adding = asyncio.create_task(desk.ledger.add(jobs, "me"))
            await asyncio.sleep(0)
            if canceled:
                adding.cancel()
            results = await asyncio.gather(adding, return_exceptions=True)
            assert isinstance(results[0], asyncio.CancelledError if canceled else StorageError)
            await desk.settle()
            assert desk.ledger.queued == desk.ledger.open == list(desk.ledger) == desk.told == first
            await free(desk.database)
            last = await desk.queue("z")
            assert last[0].seq == 2002
        with Desk(path) as desk:
            assert desk.ledger.queued == first + last

    run(main)


def test_many_removed_at_once_of_which_few_are_shown_are_back_if_the_disk_does_not_take_it(path):
    async def main():
        with Desk(path, keep_shown=3) as desk:
            jobs = await desk.queue(*(f"{n:05}" for n in range(500)))
            await fill(desk.database)
            with pytest.raises(StorageError):
                await desk.ledger.change(*(ended(job, LONG) for job in jobs))
            assert desk.ledger.queued == list(desk.ledger) == jobs
            await free(desk.database)
            await desk.ledger.change(*(ended(job) for job in jobs))
            assert desk.ledger.queued == []
            assert [job.seq for job in desk.ledger] == [498, 499, 500]

    run(main)


def test_ends_that_may_be_undone_are_not_forgotten_for_another(path):
    async def main():
        with Desk(path, keep_shown=0) as desk:
            jobs = await desk.queue("a", "b")
            await fill(desk.database)
            let_go = desk.hold()
            changing = asyncio.create_task(desk.ledger.change(ended(jobs[0], LONG)))
            await asyncio.sleep(0)
            done = desk.ledger.declare(ended(jobs[1]))
            let_go()
            await asyncio.gather(changing, done, return_exceptions=True)
            assert isinstance(changing.exception(), StorageError)
            assert desk.ledger.queued == [jobs[0]]

    run(main)


@pytest.mark.parametrize("full", [False, True])
def test_who_changed_may_go_away(path, full):
    async def main():
        with Desk(path) as desk:
            (job,) = await desk.queue("a")
            if full:
                await fill(desk.database)
            let_go = desk.hold()
            gone = ended(job, LONG)
            changing = asyncio.create_task(desk.ledger.change(gone, actor="me"))
            await asyncio.sleep(0)
            changing.cancel()
            await asyncio.gather(changing, return_exceptions=True)
            let_go()
            await desk.settle()
            assert desk.ledger.get(1) is (job if full else gone)
            assert desk.told == ([job] if full else [job, gone])
            assert desk.stored() == {1: desk.ledger.get(1)}

    run(main)


def test_a_job_does_not_start_before_its_call_is_on_disk(path):
    async def main():
        with Desk(path) as desk:
            (job,) = await desk.queue("a")
            call = moved(job, called=True, reason=Reason.MACHINE_BUSY)
            let_go = desk.hold()
            calling = asyncio.create_task(desk.ledger.change(call))
            await asyncio.sleep(0)
            assert desk.ledger.called == [call]
            assert desk.ledger.next is None
            let_go()
            await calling
            assert desk.ledger.next is call
            assert call in desk.told

    run(main)


# load


@pytest.mark.parametrize(("load_on_startup", "pending"), [(True, S.PENDING), (False, S.PENDING_HELD)])
def test_load_after_a_crash(path, load_on_startup, pending):
    async def main():
        with Desk(path) as desk:
            for _ in range(3):
                await desk.add()
            await desk.ledger.declare(ended(desk.ledger.get(1)))
            await desk.ledger.change(started(desk.ledger.get(2)))
        with Desk(path, load_on_startup=load_on_startup) as desk:
            assert [job.state for job in desk.ledger] == [S.CANCELED, S.PROCESSING_STOPPED, pending]
            assert desk.ledger.active.reason is Reason.HOST_RESTARTED
            assert desk.ledger.next is None, "the stopped job holds the machine"
            await desk.settle()
            assert list(desk.stored().values()) == list(desk.ledger)
            assert len(desk.told) == (1 if load_on_startup else 2)
            job = await desk.add()
            assert job.seq == 4

    run(main)


@pytest.mark.parametrize("load_on_startup", [True, False])
def test_load_puts_a_called_job_back_into_the_queue(path, load_on_startup):
    async def main():
        with Desk(path) as desk:
            jobs = await desk.queue("a", "b")
            await desk.ledger.change(moved(jobs[0], called=True, reason=Reason.MACHINE_BUSY))
            assert desk.ledger.queued == jobs[1:]
        with Desk(path, load_on_startup=load_on_startup) as desk:
            assert desk.ledger.queued == jobs
            assert desk.ledger.called == []
            assert desk.ledger.next is None
            await desk.settle()
            assert desk.told == jobs[:1]
            assert list(desk.stored().values()) == jobs

    run(main)


def test_load_trims_the_store(path):
    async def main():
        with Desk(path) as desk:
            for _ in range(10):
                await desk.ledger.declare(ended(await desk.add()))
        with Desk(path, keep_stored=4) as desk:
            await desk.settle()
            assert list(desk.stored()) == [7, 8, 9, 10]

    run(main)


def test_ended_jobs_shown_are_bounded_and_open_ones_never_left_out(path):
    async def main():
        with Desk(path, keep_shown=3) as desk:
            held = await desk.add()
            for _ in range(10):
                await desk.ledger.declare(ended(await desk.add()))
            assert [job.seq for job in desk.ledger] == [held.seq, 9, 10, 11]
            assert len(desk.ledger._jobs) == 4
            assert len(desk.stored()) == 11
        with Desk(path, keep_shown=3) as desk:
            assert [job.seq for job in desk.ledger] == [held.seq, 9, 10, 11]

    run(main)


def test_close_gives_up_what_the_disk_did_not_take(path):
    async def main():
        with Desk(path) as desk:
            job = ended(await desk.add(), LONG)
            await fill(desk.database)
            with pytest.raises(StorageError):
                await desk.ledger.declare(job)
            desk.ledger.close()
            await free(desk.database)
            await asyncio.sleep(0.05)
            assert desk.stored()[1].state is S.PENDING

    run(main)


# Anything in any order, against a plain dict.


class Life(RuleBasedStateMachine):
    """A ledger that is used, starved of disk and reopened; `expected` is what was acknowledged."""

    @initialize(load_on_startup=st.booleans())
    def begin(self, load_on_startup):
        self.folder = TemporaryDirectory()
        self.runner = asyncio.Runner()
        self.load_on_startup = load_on_startup
        self.expected = {}
        self.owed = {}
        self.full = False
        self.seen = set()
        self.open()

    def open(self):
        async def opening():
            return Desk(
                Path(self.folder.name) / "d.db", load_on_startup=self.load_on_startup, keep_shown=1000
            )

        self.desk = self.runner.run(opening())

    def run(self, coroutine):
        return self.runner.run(coroutine)

    def job(self, data, *states):
        jobs = [job for job in self.desk.ledger if job.state in states]
        return data.draw(st.sampled_from(jobs)) if jobs else None

    @rule(signals=st.sampled_from([{}, HUGE]))
    def add(self, signals):
        async def adding():
            with contextlib.suppress(StorageError):
                job = await self.desk.add(signals)
                assert job.seq not in self.seen
                self.seen.add(job.seq)
                self.expected[job.seq] = job

        self.run(adding())

    @rule(names=st.lists(st.sampled_from("ab"), max_size=4), detail=st.sampled_from(["", LONG]))
    def queue(self, names, detail):
        async def queueing():
            jobs = [moved(job, detail=detail) for job in self.desk.new(*names)]
            with contextlib.suppress(StorageError):
                await self.desk.ledger.add(jobs, "me")
                assert self.seen.isdisjoint(job.seq for job in jobs)
                self.seen.update(job.seq for job in jobs)
                self.expected |= {job.seq: job for job in jobs}

        self.run(queueing())

    async def changing(self, *after):
        before = [self.desk.ledger.get(job.seq) for job in after]
        try:
            await self.desk.ledger.change(*after)
        except StorageError:
            for job in before:
                assert self.desk.ledger.get(job.seq) is job
        else:
            for job in after:
                self.expected[job.seq] = job
                self.owed.pop(job.seq, None)

    @rule(data=st.data(), detail=st.sampled_from(["", LONG]))
    def change(self, data, detail):
        job = self.job(data, S.PENDING, S.PROCESSING_STOPPED)
        if job is None or self.desk.ledger.active not in (None, job):
            return
        self.run(self.changing(job.to(S.PROCESSING, Reason.RUNNING, 5, detail)))

    @rule(data=st.data(), detail=st.sampled_from(["", LONG]), called=st.booleans())
    def call_or_put_back(self, data, detail, called):
        job = self.job(data, S.PENDING)
        if job is not None and job.name:
            self.run(self.changing(moved(job, called=called, detail=detail)))

    @rule(data=st.data(), detail=st.sampled_from(["", LONG]), removed=st.integers(0, 2))
    def rearrange(self, data, detail, removed):
        order = data.draw(st.permutations(self.desk.ledger.queued))
        after = [ended(job, detail) for job in order[:removed]]
        after += [moved(job, position=place, detail=detail) for place, job in enumerate(order[removed:])]
        self.run(self.changing(*after))

    @rule(data=st.data(), detail=st.sampled_from(["", LONG]))
    def declare(self, data, detail):
        job = self.job(data, S.PENDING, S.PENDING_HELD, S.PROCESSING, S.PROCESSING_STOPPED)
        if job is None:
            return

        async def declaring():
            after = job.to(S.ABORTED, Reason.LINK_LOST, 7, detail)
            try:
                await self.desk.ledger.declare(after)
            except StorageError:
                self.owed[job.seq] = after
            else:
                self.expected[job.seq] = after
                self.owed.pop(job.seq, None)

        self.run(declaring())

    @rule()
    def starve_or_feed(self):
        self.full = not self.full
        self.run((fill if self.full else free)(self.desk.database))

    @precondition(lambda self: not self.full)
    @rule()
    def wait(self):
        """Once there is room, what was owed is written without anyone asking."""

        async def waiting():
            self.desk.ledger._pay_debts()
            await self.desk.settle()

        self.run(waiting())
        self.expected |= self.owed
        self.owed = {}
        assert self.desk.stored() == self.expected

    @rule()
    def reopen(self):
        async def ending():
            await self.desk.settle()
            self.desk.__exit__()

        self.run(ending())
        owed, self.owed, self.full = self.owed, {}, False
        self.open()
        self.run(self.desk.settle())
        found = self.desk.stored()
        assert found.keys() == self.expected.keys()
        for seq, job in self.expected.items():
            # What was owed may have been written meanwhile.
            if seq in owed and found[seq] == owed[seq]:
                self.expected[seq] = found[seq]
            elif job.state is S.PROCESSING:
                assert (found[seq].state, found[seq].reason) == (S.PROCESSING_STOPPED, Reason.HOST_RESTARTED)
            elif job.state is S.PENDING and job.called and job.name:
                assert found[seq] == moved(job, called=False, reason=Reason.QUEUE_POSITION)
            elif job.state is S.PENDING and job.called and not self.load_on_startup:
                assert (found[seq].state, found[seq].reason) == (S.PENDING_HELD, Reason.HOST_RESTARTED)
            else:
                assert found[seq] == job
        self.expected = found

    @invariant()
    def what_was_acknowledged_is_on_disk(self):
        found = self.desk.stored()
        assert found.keys() == self.expected.keys()
        for seq, job in self.expected.items():
            assert found[seq] in (job, self.owed.get(seq))

    @invariant()
    def memory_is_as_the_disk_but_for_what_is_owed(self):
        assert {job.seq: job for job in self.desk.ledger} == self.expected | self.owed
        assert {job.seq for job in self.desk.ledger.open} == {
            job.seq for job in self.desk.ledger if not job.ended
        }

    @invariant()
    def the_queue_is_what_waits_in_order(self):
        waiting = [job for job in self.desk.ledger if job.state is S.PENDING and not job.called]
        assert self.desk.ledger.queued == sorted(waiting, key=lambda job: (job.position, job.seq))
        assert {job.seq for job in self.desk.ledger.called} == {
            job.seq for job in self.desk.ledger.open if job not in waiting
        }

    def teardown(self):
        if not hasattr(self, "folder"):
            return
        self.reopen()
        self.desk.__exit__()
        self.runner.close()
        self.folder.cleanup()


TestLife = Life.TestCase
TestLife.settings = settings(max_examples=25, stateful_step_count=25, deadline=None)
