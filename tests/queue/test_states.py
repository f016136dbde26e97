"""The queue's states as the table of moonraker_job_queue.md has them, on a machine that executes."""

import asyncio
import time
from collections import Counter

import pytest

from tests.queue.floor import floor
from toolpost.errors import InvalidRequestError, StorageError

AUTO = {"automatic_transition": True}
GCODE = {"job_transition_gcode": "G4 P1\n; a comment\nM5"}
BOTH = pytest.mark.parametrize("auto", [True, False], ids=["auto", "manual"])


def run(tmp_path, body, **options):
    """Runs a coroutine function with a floor whose queue has these options."""

    async def main():
        async with floor(tmp_path, **options) as shop_floor:
            await body(shop_floor)

    asyncio.run(main())


def queue_test(**options):
    """Makes a test of a coroutine function, as `run`."""

    def decorate(body):
        def test(tmp_path):
            run(tmp_path, body, **options)

        test.__name__ = body.__name__
        test.__doc__ = body.__doc__
        return test

    return decorate


# paused


@BOTH
def test_a_queue_begins_paused_and_jobs_on_an_idle_machine_only_wait(tmp_path, auto):
    async def body(shop):
        assert shop.state == "paused"
        ids = await shop.post("a", "b", "a")
        assert (shop.state, shop.names, shop.ids) == ("paused", "a b a", ids)
        await asyncio.sleep(0.05)
        assert (shop.state, shop.received) == ("paused", [])
        assert set(shop.history.values()) == {"pending queue-position"}

    run(tmp_path, body, automatic_transition=auto)


@BOTH
def test_starting_an_empty_queue_leaves_it_paused(tmp_path, auto):
    async def body(shop):
        await shop.start()
        assert shop.state == "paused"
        await shop.busy()
        await shop.start()
        assert shop.state == "paused"

    run(tmp_path, body, automatic_transition=auto)


@queue_test()
async def test_a_paused_queue_loads_nothing_when_a_job_is_completed(shop):
    await shop.busy()
    await shop.post("a")
    shop.permit(1)
    await shop.until(lambda: shop.outcomes["completed"])
    await asyncio.sleep(0.05)
    assert (shop.state, shop.names, shop.received) == ("paused", "a", ["G1 X99"])


@queue_test(**AUTO)
async def test_a_pause_while_ready_holds_at_completion(shop):
    await shop.busy()
    await shop.post("a")
    assert shop.state == "ready"
    await shop.pause()
    assert shop.state == "paused"
    shop.permit(1)
    await shop.until(lambda: shop.outcomes["completed"])
    await asyncio.sleep(0.05)
    assert (shop.state, shop.names) == ("paused", "a")


# ready


@BOTH
def test_ready_is_taken_at_its_word(tmp_path, auto):
    """A start while the machine is busy loads the next job when that is completed, whoever started it."""

    async def body(shop):
        await shop.busy()
        a, b, c = await shop.post("a", "bb", "ccc")
        await shop.pause()
        await shop.start()
        assert shop.state == "ready"
        shop.permit(1)
        await shop.until(lambda: shop.received[1:] == ["G1 X1"])
        await shop.settled()
        assert (shop.running, shop.names) == (a, "bb ccc")
        assert shop.state == ("ready" if auto else "paused")
        shop.permit(1)
        if auto:
            await shop.until(lambda: shop.running == b)
            shop.permit(2)
            await shop.until(lambda: shop.outcomes["completed"] == 4)
            assert shop.received == ["G1 X99", "G1 X1", "G1 X2", "G1 X3"]
        else:
            await shop.until(lambda: shop.outcomes["completed"] == 2)
            await asyncio.sleep(0.05)
            assert (shop.running, shop.ids) == (None, [b, c])
        await shop.settled()
        assert shop.state == "paused"

    run(tmp_path, body, automatic_transition=auto)


@BOTH
def test_after_a_load_the_queue_is_ready_only_if_it_will_load_another_by_itself(tmp_path, auto):
    async def body(shop):
        shop.permit(0)
        await shop.post("a", "b")
        await shop.start()
        await shop.until(lambda: shop.running)
        await shop.settled()
        assert shop.state == ("ready" if auto else "paused")
        assert shop.states == ["paused", "loading", "starting", shop.state]
        assert shop.told == ["jobs_added", "state_changed", "state_changed", "job_loaded"]

    run(tmp_path, body, automatic_transition=auto)


@BOTH
def test_the_last_job_leaves_the_queue_paused(tmp_path, auto):
    async def body(shop):
        shop.permit(0)
        await shop.post("a")
        await shop.start()
        await shop.until(lambda: shop.running)
        await shop.settled()
        assert (shop.state, shop.names) == ("paused", "")

    run(tmp_path, body, automatic_transition=auto)


@BOTH
def test_a_post_while_busy_goes_on_by_itself_with_automatic_transition(tmp_path, auto):
    async def body(shop):
        await shop.busy()
        await shop.post("a")
        assert shop.state == ("ready" if auto else "paused")
        shop.permit(2)
        await shop.until(lambda: shop.outcomes["completed"] == (2 if auto else 1))

    run(tmp_path, body, automatic_transition=auto)


@queue_test(**AUTO)
async def test_a_pause_that_was_asked_for_outlasts_posts_until_the_next_start(shop):
    await shop.busy()
    await shop.pause()
    await shop.post("a")
    assert shop.state == "paused"
    await shop.start()
    assert shop.state == "ready"
    await shop.remove_all()
    assert shop.state == "paused", "an empty queue is paused"
    await shop.post("b")
    assert shop.state == "ready"


@queue_test(**AUTO)
async def test_a_pause_that_was_asked_for_outlasts_a_crash(shop):
    await shop.pause()
    await shop.crash()
    shop.open()
    await shop.busy()
    await shop.post("a")
    assert shop.state == "paused"
    await shop.start()
    await shop.crash()
    shop.open()
    assert shop.state == "ready"


@queue_test(**AUTO)
async def test_a_queue_that_becomes_empty_is_paused(shop):
    await shop.busy()
    for empty in (shop.remove_all, lambda: shop.remove(*shop.ids), lambda: shop.post(replace=True)):
        await shop.post("a", "b")
        assert shop.state == "ready"
        await empty()
        assert (shop.state, shop.names) == ("paused", "")
    assert shop.outcomes == Counter(canceled=6, processing=1)


# What ends a job badly pauses.


@queue_test(**AUTO)
async def test_cancel_ends_what_runs_pauses_and_leaves_what_waits(shop):
    shop.permit(0)
    a, b = await shop.post("a", "b")
    await shop.start()
    await shop.until(lambda: shop.running == a)
    await shop.settled()
    assert shop.state == "ready"
    await shop.cancel()
    assert (shop.state, shop.ids, shop.running) == ("paused", [b], None)
    assert shop.history == {a: "canceled canceled-by-user", b: "pending queue-position"}
    shop.permit(9)
    await asyncio.sleep(0.05)
    assert (shop.state, shop.executed) == ("paused", [])


@pytest.mark.parametrize("fault", ["reboot", "fault", "unplug:0.05"])
def test_an_aborted_job_pauses_the_queue(tmp_path, fault):
    async def body(shop):
        shop.permit(0)
        a, b = await shop.post("a", "b")
        await shop.start()
        await shop.until(lambda: shop.running == a and shop.state == "ready")
        shop.inject(fault)
        await shop.until(lambda: shop.outcomes["aborted"])
        await asyncio.sleep(0.15)
        assert (shop.state, shop.ids, shop.running) == ("paused", [b], None)

    run(tmp_path, body, **AUTO)


@queue_test(**AUTO)
async def test_a_job_whose_program_is_gone_pauses_the_queue_and_is_in_the_history(shop):
    a, b = await shop.post("a", "bb")
    for program in (shop.directory / "programs").glob("[0-9a-f]*"):
        if program.is_file():
            program.unlink()
    await shop.start()
    await shop.until(lambda: shop.outcomes["aborted"])
    await shop.settled()
    assert (shop.state, shop.ids) == ("paused", [b])
    assert shop.history[a] == "aborted program-missing"
    assert shop.told[-1] in {"jobs_removed", "job_loaded"}, "nobody was told that it left the list"


# loading: first the delay, then the G-code, then the job


@queue_test(**AUTO, **GCODE, job_transition_delay=0.15)
async def test_between_two_jobs_there_are_the_delay_and_then_the_gcode(shop):
    await shop.post("a", "bb")
    await shop.start()
    shop.permit(1)
    await shop.until(lambda: shop.outcomes["completed"])
    ended = time.monotonic()
    await shop.until(lambda: shop.state == "loading")
    await shop.until(lambda: len(shop.received) == 3)
    assert time.monotonic() - ended >= 0.14
    assert (shop.received, shop.state) == (["G1 X1", "G4 P1", "M5"], "loading")
    shop.permit(1)
    await asyncio.sleep(0.05)
    assert shop.state == "loading", "the G-code has not been executed to its end"
    shop.permit(float("inf"))
    await shop.until(lambda: shop.outcomes["completed"] == 2)
    assert shop.received == shop.executed == ["G1 X1", "G4 P1", "M5", "G1 X2"]
    steps = ["loading", "starting"]
    assert shop.states == ["paused", *steps, "ready", *steps, "paused"]


@queue_test(**GCODE, job_transition_delay=20)
async def test_a_manual_start_needs_no_delay_and_no_gcode(shop):
    await shop.post("a")
    began = time.monotonic()
    await shop.start()
    await shop.until(lambda: shop.outcomes["completed"])
    assert time.monotonic() - began < 2
    assert shop.received == ["G1 X1"]


@queue_test(**GCODE)
async def test_a_start_while_busy_has_the_gcode_run_between(shop):
    await shop.busy()
    await shop.post("a")
    await shop.start()
    shop.permit(9)
    await shop.until(lambda: shop.outcomes["completed"] == 2)
    assert shop.received == ["G1 X99", "G4 P1", "M5", "G1 X1"]


async def load_after_a_job(shop, *names):
    """Post jobs behind one that runs, and have that completed."""
    job = await shop.busy()
    ids = await shop.post(*names)
    await shop.start()
    shop.permit(1)
    await shop.until(lambda: "loading" in shop.states)
    assert shop.history[job.id] == "completed done"
    return ids


@BOTH
@pytest.mark.parametrize("fault", ["reboot", "fault", "unplug:0.05"])
def test_gcode_that_fails_pauses_the_queue_and_the_job_is_kept(tmp_path, fault, auto):
    async def body(shop):
        ids = await load_after_a_job(shop, "a")
        await shop.until(lambda: len(shop.received) == 3)
        shop.inject(fault)
        await shop.until(lambda: shop.state == "paused")
        shop.permit(99)
        await asyncio.sleep(0.15)
        assert (shop.state, shop.ids) == ("paused", ids)
        assert "G1 X1" not in shop.received

    run(tmp_path, body, automatic_transition=auto, **GCODE)


@pytest.mark.parametrize("fault", ["fault", "unplug:0.1"])
def test_a_machine_that_goes_away_in_the_delay_starts_nothing_when_it_is_back(tmp_path, fault):
    async def body(shop):
        ids = await load_after_a_job(shop, "a")
        shop.permit(99)
        shop.inject(fault)
        await shop.until(lambda: shop.state == "paused")
        await asyncio.sleep(0.1)
        if fault == "fault":
            shop.inject("reboot")
        await shop.ready()
        await asyncio.sleep(0.2)
        assert (shop.state, shop.ids, shop.received) == ("paused", ids, ["G1 X99"])

    run(tmp_path, body, job_transition_delay=0.2)


@queue_test(**AUTO, job_transition_gcode="M5\n?pos")
async def test_gcode_that_is_no_gcode_pauses_the_queue(shop):
    ids = await load_after_a_job(shop, "a")
    await shop.until(lambda: shop.state == "paused")
    assert (shop.ids, shop.received) == (ids, ["G1 X99"])


@queue_test(**GCODE, job_transition_delay=0.1)
async def test_a_pause_in_the_delay_aborts_the_load_at_once(shop):
    ids = await load_after_a_job(shop, "a")
    await shop.pause()
    assert (shop.state, shop.ids) == ("paused", ids)
    shop.permit(99)
    await asyncio.sleep(0.2)
    assert (shop.state, shop.ids, shop.received) == ("paused", ids, ["G1 X99"])
    assert shop.core.last_bang_at is None, "there was nothing to stop"


@queue_test(**GCODE)
async def test_a_pause_in_the_gcode_stops_it_at_once(shop):
    ids = await load_after_a_job(shop, "a")
    await shop.until(lambda: len(shop.received) == 3)
    began = time.monotonic()
    await shop.pause()
    assert time.monotonic() - began < 0.5
    assert (shop.state, shop.ids) == ("paused", ids)
    await shop.until(lambda: shop.core.last_bang_at is not None)
    shop.permit(99)
    await shop.ready()
    await asyncio.sleep(0.1)
    assert (shop.ids, shop.executed) == (ids, ["G1 X99"])
    await shop.start()
    await shop.until(lambda: shop.history[ids[0]] == "completed done")


@queue_test(**GCODE)
async def test_a_cancel_in_the_gcode_stops_it_and_the_job_is_kept(shop):
    ids = await load_after_a_job(shop, "a")
    await shop.until(lambda: len(shop.received) == 3)
    await shop.cancel()
    assert (shop.state, shop.ids) == ("paused", ids)
    await shop.until(lambda: shop.core.last_bang_at is not None)
    shop.permit(99)
    await shop.ready()
    await asyncio.sleep(0.05)
    assert (shop.ids, shop.executed) == (ids, ["G1 X99"])


@queue_test(job_transition_delay=0.1)
async def test_a_jump_in_loading_is_honoured(shop):
    a, b = await load_after_a_job(shop, "a", "bb")
    await shop.jump(b)
    assert (shop.state, shop.ids) == ("loading", [b, a])
    await shop.until(lambda: shop.running == b)
    await shop.settled()
    assert shop.ids == [a]


@queue_test(job_transition_delay=0.1)
async def test_removing_the_head_in_loading_loads_the_next(shop):
    a, b = await load_after_a_job(shop, "a", "bb")
    await shop.remove(a)
    assert shop.ids == [b]
    await shop.until(lambda: shop.running == b)
    assert shop.history[a] == "canceled canceled-by-user"


@queue_test(**GCODE, job_transition_delay=0.1)
async def test_removing_all_in_loading_pauses_and_runs_no_gcode(shop):
    await load_after_a_job(shop, "a", "bb")
    await shop.remove_all()
    await shop.until(lambda: shop.state == "paused")
    shop.permit(99)
    await asyncio.sleep(0.15)
    assert (shop.state, shop.received) == ("paused", ["G1 X99"])
    await shop.post("c")
    await shop.start()
    await shop.until(lambda: shop.outcomes["completed"] == 2)


@queue_test(**GCODE, job_transition_delay=0.1)
async def test_a_job_from_elsewhere_in_the_delay_is_not_disturbed(shop):
    ids = await load_after_a_job(shop, "a")
    other = await shop.submit("G1 X50", "G1 X51")
    await shop.until(lambda: "G1 X51" in shop.received)
    await shop.until(lambda: shop.state == "paused")
    assert shop.running == other.id
    shop.permit(9)
    await shop.until(lambda: shop.history[other.id] == "completed done")
    await asyncio.sleep(0.05)
    assert (shop.ids, shop.received) == (ids, ["G1 X99", "G1 X50", "G1 X51"])


@queue_test(**GCODE, job_transition_delay=20)
async def test_a_pause_in_the_delay_stops_no_job_from_elsewhere(shop):
    ids = await load_after_a_job(shop, "a")
    other = await shop.submit("G1 X50")
    await shop.until(lambda: shop.running == other.id and "G1 X50" in shop.received)
    await shop.pause()
    shop.permit(9)
    await shop.until(lambda: shop.history[other.id] != "processing running")
    assert shop.history[other.id] == "completed done"
    assert (shop.state, shop.ids) == ("paused", ids)


@queue_test(**GCODE)
async def test_a_job_from_elsewhere_waits_for_the_end_of_the_gcode(shop):
    ids = await load_after_a_job(shop, "a")
    await shop.until(lambda: len(shop.received) == 3)
    other = await shop.submit("G1 X50")
    shop.permit(9)
    await shop.until(lambda: shop.history[other.id] == "completed done")
    await shop.settled()
    assert (shop.state, shop.ids) == ("paused", ids)
    assert shop.executed == ["G1 X99", "G4 P1", "M5", "G1 X50"]


# starting


def slow_programs(shop, seconds):
    """Have programs open slowly, so that the queue stays in starting."""
    programs = shop.machine.runner._programs
    real = programs.open
    store = shop.store

    def slow(sha256):
        time.sleep(seconds)
        if shop.store is not store:
            raise StorageError("the server is not there any more")
        return real(sha256)

    programs.open = slow


async def starting(shop, *names):
    slow_programs(shop, 0.15)
    ids = await shop.post(*names)
    await shop.start()
    await shop.until(lambda: shop.state == "starting")
    assert shop.ids == ids, "a job that is being started is still shown"
    await asyncio.sleep(0.02)
    return ids


@BOTH
def test_a_pause_in_starting_keeps_the_job_first_in_the_queue(tmp_path, auto):
    async def body(shop):
        ids = await starting(shop, "a", "bb")
        await shop.pause()
        assert (shop.state, shop.ids) == ("paused", ids)
        await asyncio.sleep(0.25)
        assert (shop.state, shop.ids, shop.received) == ("paused", ids, [])
        assert set(shop.history.values()) == {"pending queue-position"}
        await shop.start()
        await shop.until(lambda: shop.history[ids[0]] == "completed done")
        assert shop.received[0] == "G1 X1"
        assert Counter(shop.received)["G1 X1"] == 1

    run(tmp_path, body, automatic_transition=auto)


@queue_test(**AUTO)
async def test_removing_the_job_that_is_being_started_pauses_the_queue(shop):
    a, b = await starting(shop, "a", "bb")
    await shop.remove(a)
    assert (shop.state, shop.ids) == ("paused", [b])
    await asyncio.sleep(0.25)
    assert (shop.state, shop.received) == ("paused", [])
    assert shop.history[a] == "canceled canceled-by-user"
    await shop.start()
    await shop.until(lambda: shop.history[b] == "completed done")
    assert shop.received == ["G1 X2"]


@queue_test()
async def test_removing_all_in_starting_pauses_the_queue(shop):
    await starting(shop, "a", "bb")
    await shop.remove_all()
    assert (shop.state, shop.ids) == ("paused", [])
    await asyncio.sleep(0.25)
    assert (shop.state, shop.received, shop.outcomes) == ("paused", [], Counter(canceled=2))


@queue_test()
async def test_jumps_in_starting_keep_the_order_that_is_shown(shop):
    a, b, c = await starting(shop, "a", "bb", "ccc")
    await shop.jump(a)
    assert shop.ids == [a, b, c]
    await shop.jump(c)
    shown = shop.ids
    assert shown.index(c) < shown.index(b)
    await shop.pause()
    assert shop.ids == shown
    await shop.crash()
    shop.open()
    assert shop.ids == shown


@queue_test()
async def test_a_list_posted_in_starting_doubles_nothing(shop):
    a, b = await starting(shop, "a", "bb")
    shown = frozenset(shop.ids)
    assert await shop.post("bb", "a", replace=True, shown=shown) == []
    assert sorted(shop.ids) == sorted([a, b])
    shop.permit(0)
    await shop.until(lambda: shop.running == a)
    await shop.settled()
    assert shop.ids == [b]


@queue_test()
async def test_a_list_posted_in_starting_without_the_job_removes_it(shop):
    a, b = await starting(shop, "a", "bb")
    await shop.post("bb", replace=True, shown=frozenset(shop.ids))
    assert (shop.state, shop.ids, shop.history[a]) == ("paused", [b], "canceled canceled-by-user")
    await asyncio.sleep(0.2)
    assert shop.received == []


@queue_test(**AUTO)
async def test_a_cancel_in_starting_ends_the_job_that_is_called(shop):
    a, b = await starting(shop, "a", "bb")
    await shop.cancel()
    assert (shop.state, shop.ids, shop.history[a]) == ("paused", [b], "canceled canceled-by-user")
    await asyncio.sleep(0.2)
    assert shop.received == []


@queue_test()
async def test_a_machine_that_goes_away_in_starting_starts_nothing_when_it_is_back(shop):
    ids = await starting(shop, "a")
    shop.inject("unplug:0.3")
    await shop.until(lambda: shop.state == "paused")
    assert shop.ids == ids
    await shop.ready()
    await asyncio.sleep(0.2)
    assert (shop.state, shop.ids, shop.received) == ("paused", ids, [])


@queue_test(**AUTO)
async def test_a_pause_at_any_instant_starts_the_job_or_keeps_it(shop):
    """However far the load is, the queue is paused, clients are told, and no job is lost or started twice."""
    for turns in range(40):
        a, b = await shop.post("a", "bb")
        shop.permit(0)
        await shop.start()
        for _ in range(turns):
            await asyncio.sleep(0)
        if turns > 30:
            await asyncio.sleep((turns - 30) / 1000)
        shop.told.clear()
        await shop.pause()
        assert shop.state == "paused"
        await asyncio.sleep(0.01)
        await shop.settled()
        assert shop.state == "paused"
        if shop.running is None:
            assert shop.ids == [a, b]
        else:
            assert (shop.running, shop.ids) == (a, [b])
            shop.permit(1)
            await shop.until(lambda a=a: shop.history[a] == "completed done")
        await shop.remove_all()
        await shop.ready()


# start


@BOTH
def test_concurrent_starts_load_once(tmp_path, auto):
    async def body(shop):
        shop.permit(0)
        a, b = await shop.post("a", "bb")
        await asyncio.gather(*(shop.start() for _ in range(5)))
        await shop.until(lambda: shop.running)
        await shop.settled()
        assert (shop.running, shop.ids, shop.told.count("job_loaded")) == (a, [b], 1)
        assert shop.received == ["G1 X1"]

    run(tmp_path, body, automatic_transition=auto)


@queue_test()
async def test_a_start_while_single_commands_are_executed_loads_when_they_are(shop):
    shop.permit(0)
    assert await shop.shop.write_line("edm", "G1 X70", urgent=None, actor="me")
    await shop.until(lambda: shop.received)
    await shop.post("a")
    await shop.start()
    assert shop.state == "ready"
    shop.permit(99)
    await shop.until(lambda: shop.outcomes["completed"])
    assert shop.received == ["G1 X70", "G1 X1"]


@queue_test()
async def test_a_start_right_after_a_cancel_loads_when_the_machine_is_ready(shop):
    await shop.busy()
    await shop.post("a")
    await shop.cancel()
    await shop.start()
    shop.permit(99)
    await shop.until(lambda: shop.outcomes["completed"])
    assert shop.executed == ["G1 X1"]


@queue_test()
async def test_a_pause_revokes_a_start_that_waits_for_the_machine(shop):
    await shop.busy()
    await shop.post("a")
    await shop.cancel()
    await shop.start()
    await shop.pause()
    shop.permit(99)
    await shop.ready()
    await asyncio.sleep(0.05)
    assert (shop.state, shop.names, shop.executed) == ("paused", "a", [])


# Many


@BOTH
def test_ten_jobs_of_one_command_that_takes_no_time_all_run(tmp_path, auto):
    async def body(shop):
        for number in range(10):
            shop.write(f"{number}.gcode", f"G1 X{number}")
        ids = await shop.post(*map(str, range(10)))
        while shop.outcomes["completed"] < 10:
            if shop.state == "paused" and shop.running is None:
                await shop.start()
            await asyncio.sleep(0.001)
        assert [job.id for job in shop.jobs] == ids
        assert shop.received == [f"G1 X{number}" for number in range(10)]
        assert (shop.state, shop.ids) == ("paused", [])

    run(tmp_path, body, automatic_transition=auto)


@queue_test(**AUTO, **GCODE)
async def test_ten_jobs_of_one_file_run_with_the_gcode_between_each(shop):
    await shop.post(*["a"] * 10)
    await shop.start()
    await shop.until(lambda: shop.outcomes["completed"] == 10)
    assert shop.received == ["G1 X1"] + ["G4 P1", "M5", "G1 X1"] * 9


# What is queued is what runs.


@queue_test(**AUTO)
async def test_what_was_queued_runs_whatever_becomes_of_the_file(shop):
    shop.write("f.gcode", "G1 X11")
    await shop.post("f")
    shop.write("f.gcode", "G1 X12")
    await shop.post("f", "f")
    shop.write("f.gcode", "G1 X13")
    await shop.post("f")
    (shop.directory / "gcodes" / "f.gcode").rename(shop.directory / "gcodes" / "g.gcode")
    shop.write("f.gcode", "G1 X14")
    (shop.directory / "gcodes" / "f.gcode").unlink()
    await shop.crash()
    shop.open()
    await shop.ready()
    await shop.start()
    await shop.until(lambda: shop.outcomes["completed"] == 4)
    assert shop.received == ["G1 X11", "G1 X12", "G1 X12", "G1 X13"]


# Order


@queue_test()
async def test_a_jump_puts_a_job_first_and_an_unknown_one_is_refused(shop):
    a, b, c = await shop.post("a", "bb", "ccc")
    for job_id, order in [(c, [c, a, b]), (b, [b, c, a]), (b, [b, c, a]), (a, [a, b, c])]:
        await shop.jump(job_id)
        assert shop.ids == order
    with pytest.raises(InvalidRequestError):
        await shop.jump("000000")
    await shop.remove(a)
    with pytest.raises(InvalidRequestError):
        await shop.jump(a)
    assert shop.ids == [b, c]


@queue_test()
async def test_removed_jobs_are_in_the_history_and_unknown_ids_are_ignored(shop):
    a, b, c = await shop.post("a", "bb", "ccc")
    shop.told.clear()
    await shop.remove("000000", b, "nonsense", b)
    assert (shop.ids, shop.told) == ([a, c], ["jobs_removed"])
    await shop.remove(b)
    assert (shop.ids, shop.told) == ([a, c], ["jobs_removed"])
    await shop.remove_all()
    assert shop.history == dict.fromkeys([a, b, c], "canceled canceled-by-user")


# Restarts


@BOTH
def test_order_ids_and_state_outlast_a_crash_and_nothing_starts_by_itself(tmp_path, auto):
    async def body(shop):
        shop.permit(0)
        a, b, c, d = await shop.post("a", "b", "c", "d")
        await shop.jump(d)
        await shop.remove(b)
        await shop.start()
        await shop.until(lambda: shop.running == d)
        await shop.settled()
        await shop.start()
        assert (shop.state, shop.ids) == ("ready", [a, c])
        await shop.crash()
        shop.open()
        assert (shop.state, shop.ids) == ("ready", [a, c])
        assert shop.history[d] == "processing-stopped host-restarted"
        shop.permit(99)
        await shop.ready()
        await asyncio.sleep(0.1)
        assert (shop.state, shop.ids, shop.received) == ("ready", [a, c], ["G1 X1"])
        await shop.cancel()
        assert (shop.state, shop.ids) == ("paused", [a, c])
        e = await shop.post("e")
        assert shop.ids == [a, c, *e]
        assert len(set(shop.history)) == 5

    run(tmp_path, body, automatic_transition=auto)


@queue_test(job_transition_delay=20)
async def test_a_job_that_was_being_loaded_at_the_crash_is_back_in_the_queue(shop):
    ids = await load_after_a_job(shop, "a", "bb")
    await shop.crash()
    shop.open()
    assert shop.ids == ids
    assert shop.state in {"ready", "paused"}
    shop.permit(99)
    await shop.ready()
    await asyncio.sleep(0.1)
    assert (shop.ids, shop.received) == (ids, ["G1 X99"])


@queue_test()
async def test_a_job_that_was_being_started_at_the_crash_is_back_in_the_queue(shop):
    ids = await starting(shop, "a", "bb")
    await shop.crash()
    shop.open()
    assert (shop.ids, set(shop.history.values())) == (ids, {"pending queue-position"})
    await shop.ready()
    await asyncio.sleep(0.1)
    assert (shop.state, shop.ids, shop.received) == ("paused", ids, [])


@queue_test(**AUTO)
async def test_a_queue_that_was_emptied_while_ready_is_not_ready_after_two_crashes(shop):
    await shop.busy()
    await shop.post("a")
    await shop.remove_all()
    await shop.cancel()
    for _ in range(2):
        await shop.crash()
        shop.open()
        assert shop.state == "paused"
        await shop.post("b")


@pytest.mark.parametrize("gone", [True, False], ids=["paused meanwhile", "left alone"])
def test_a_queue_may_load_on_startup_once(tmp_path, gone):
    async def body(shop):
        a, b = await shop.post("a", "bb")
        await shop.crash()
        shop.inject("unplug:0.1")
        shop.open()
        if gone:
            await shop.pause()
        await shop.ready()
        await asyncio.sleep(0.1)
        await shop.settled()
        assert shop.ids == ([a, b] if gone else [b])
        assert shop.received == ([] if gone else ["G1 X1"])
        await shop.remove_all()
        await shop.post("ccc")
        await asyncio.sleep(0.05)
        assert "G1 X3" not in shop.received

    run(tmp_path, body, load_on_startup=True, job_transition_gcode="M5")


# A disk that does not take it


def failing_disk(shop):
    """Have every commit fail from now on; the result lets them pass again."""
    database = shop.store._database
    real = database._commit

    def fail(changes):
        for change in changes:
            change.error = StorageError("the disk is full")

    database._commit = fail

    def heal():
        database._commit = real

    return heal


@queue_test()
async def test_a_pause_in_starting_holds_even_if_the_disk_does_not_take_it(shop):
    ids = await starting(shop, "a")
    heal = failing_disk(shop)
    with pytest.raises(StorageError):
        await shop.pause()
    assert (shop.state, shop.ids) == ("paused", ids)
    heal()
    await asyncio.sleep(0.25)
    shop.machine.runner.wake()
    await asyncio.sleep(0.05)
    assert (shop.state, shop.ids, shop.received) == ("paused", ids, [])


@queue_test()
async def test_a_load_that_the_disk_does_not_take_pauses_the_queue(shop):
    ids = await shop.post("a")
    heal = failing_disk(shop)
    await shop.start()
    await shop.until(lambda: shop.state == "paused")
    heal()
    await asyncio.sleep(0.05)
    assert (shop.state, shop.ids, shop.received) == ("paused", ids, [])
    await shop.start()
    await shop.until(lambda: shop.outcomes["completed"])
