"""A Spark driver runs programs: all of them, in order, once, and tells the end at the right moment."""

import asyncio
import random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.drivers.driving import QUICK, driving, moves
from toolpost.core.machine import Execution, LinkState
from toolpost.drivers.base import Outcome
from toolpost.drivers.spark.flow import FILL
from toolpost.sim.options import SparkOptions as CoreOptions


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    capacity=st.sampled_from([1, 2, 3, 7, 64, 1000]),
    command_time=st.sampled_from([0.0, 0.0002, 0.001]),
    count=st.integers(0, 300),
    delay=st.sampled_from([0.0, 0.002]),
)
def test_every_command_is_executed_once_and_in_order(tmp_path, capacity, command_time, count, delay):
    async def run():
        options = CoreOptions(capacity=capacity, command_time=command_time, answer_delay=delay)
        async with driving(tmp_path, options) as bench:
            ending = await bench.run(moves(count))
            assert ending.outcome is Outcome.COMPLETED
            assert bench.executed == moves(count)
            assert bench.core.lost == 0

    asyncio.run(run())


@pytest.mark.parametrize("command_time", [0.0, 0.0003, 0.004])
def test_completed_is_never_early(tmp_path, command_time):
    async def run():
        async with driving(tmp_path, CoreOptions(command_time=command_time)) as bench:
            total = 0
            for count in random.Random(1).choices(range(1, 60), k=40):
                ending = await bench.run(moves(count))
                total += count
                assert ending.outcome is Outcome.COMPLETED
                assert bench.core.executed == total
                assert bench.core.queue_length == 0

    asyncio.run(run())


def test_the_cores_queue_is_kept_full_but_never_over_three_quarters(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(capacity=40, command_time=0.001)) as bench:
            run = asyncio.create_task(bench.run(moves(400)))
            lengths = []
            while not run.done():
                lengths.append(bench.core.queue_length)
                await asyncio.sleep(0.002)
            assert max(lengths) <= 40 * FILL
            middle = lengths[len(lengths) // 4 : len(lengths) // 2]
            assert min(middle) > 0, "the core was starved"

    asyncio.run(run())


def test_nothing_arrives_after_a_stop(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(command_time=0.0, hold_off=0.0)) as bench:
            for moment in random.Random(2).choices(range(1, 40), k=60):
                run = asyncio.create_task(bench.run(moves(100_000)))
                for _ in range(moment):
                    await asyncio.sleep(0)
                bench.driver.stop()
                assert (await run).outcome is Outcome.STOPPED
                await bench.ready()
                bangs = [i for i, line in enumerate(bench.received) if line == b"!"]
                assert all(line[:1] in b"?!" for line in bench.received[bangs[-1] :])
                bench.received.clear()

    asyncio.run(run())


def test_commands_wait_until_the_hold_off_is_over(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(command_time=0.0, hold_off=0.05)) as bench:
            bench.driver.stop()
            assert not bench.driver.ready
            assert bench.driver.enqueue(b"G1 X1")
            await bench.until(lambda: bench.executed == [b"G1 X1"])
            assert bench.core.ignored == 0

    asyncio.run(run())


def test_signals_overtake_commands(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(command_time=0.01)) as bench:
            run = asyncio.create_task(bench.run(moves(100)))
            await bench.until(lambda: bench.executed)
            assert bench.driver.send_now(b"?pos")
            await bench.until(lambda: bench.tagged("pos"))
            assert len(bench.executed) < 50
            bench.driver.stop()
            await run

    asyncio.run(run())


def test_a_jobs_signals_are_sent_at_the_start_and_at_their_interval_and_end_with_it(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(command_time=0.005)) as bench:
            await bench.run(moves(60), {"?pos": 0.05, "?edm": 10.0})
            positions, edms = bench.received.count(b"?pos"), bench.received.count(b"?edm")
            assert edms == 1
            assert 5 <= positions <= 9
            await asyncio.sleep(0.12)
            assert bench.received.count(b"?pos") == positions

    asyncio.run(run())


def test_a_flood_of_queue_questions_by_clients_confuses_no_account(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(capacity=8, command_time=0.0005)) as bench:
            run = asyncio.create_task(bench.run(moves(400)))
            while not run.done():
                for _ in range(5):
                    bench.driver.send_now(b"?queue")
                await asyncio.sleep(0.002)
            assert (await run).outcome is Outcome.COMPLETED
            assert bench.executed == moves(400)
            assert bench.core.lost == 0

    asyncio.run(run())


def test_urgent_commands_are_counted(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(capacity=8, command_time=0.001)) as bench:
            run = asyncio.create_task(bench.run(moves(100)))
            await bench.until(lambda: bench.executed)
            bench.driver.send_now(b"G4 P0.05")
            assert (await run).outcome is Outcome.COMPLETED
            assert bench.core.lost == 0
            assert b"G4 P0.05" in bench.executed
            assert len(bench.executed) == 101

    asyncio.run(run())


def test_the_state_tells_what_goes_on(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(command_time=0.01)) as bench:
            assert bench.driver.state.link is LinkState.ONLINE
            assert bench.driver.state.execution is Execution.READY
            bench.driver.enqueue(b"G4 P0.1")
            state = bench.driver.state
            assert state.execution is Execution.ACTIVE
            assert state.waiting_commands + state.machine_commands == 1
            assert not bench.driver.ready
            await bench.ready()
            assert bench.driver.state.machine_commands == 0

    asyncio.run(run())


def test_idle_is_asked_four_times_a_second(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(), QUICK) as bench:
            before = len(bench.tagged("queue"))
            await asyncio.sleep(1.0)
            assert 2 <= len(bench.tagged("queue")) - before <= 5

    asyncio.run(run())
