"""What a Spark driver makes of a machine's bad days."""

import asyncio

import pytest

from tests.drivers.driving import QUICK, driving, moves
from toolpost.core.job import Reason
from toolpost.core.machine import LinkState
from toolpost.drivers.base import Outcome
from toolpost.drivers.spark.options import SparkOptions
from toolpost.sim.options import SparkOptions as CoreOptions

SLOWISH = CoreOptions(command_time=0.005, hold_off=0.05)


def test_a_reboot_in_mid_job_fails_it_and_the_next_one_runs(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            sessions = bench.sessions
            run = asyncio.create_task(bench.run(moves(200)))
            await bench.until(lambda: len(bench.executed) > 20)
            bench.inject("reboot")
            ending = await run
            assert (ending.outcome, ending.reason) == (Outcome.FAILED, Reason.MACHINE_RESET)
            assert bench.sessions == sessions + 1
            await bench.ready()
            bench.executed.clear()
            assert (await bench.run(moves(5))).outcome is Outcome.COMPLETED
            assert bench.executed == moves(5)

    asyncio.run(run())


def test_a_reboot_while_idle_is_a_new_session_and_nothing_else(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            sessions = bench.sessions
            bench.inject("reboot")
            await bench.until(lambda: bench.sessions == sessions + 1)
            await bench.ready()

    asyncio.run(run())


def test_a_fault_fails_the_job_and_refuses_commands_until_the_power_is_cycled(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            run = asyncio.create_task(bench.run(moves(200)))
            await bench.until(lambda: bench.executed)
            bench.inject("fault")
            ending = await run
            assert (ending.outcome, ending.reason) == (Outcome.FAILED, Reason.MACHINE_FAULT)
            assert bench.driver.state.link is LinkState.FAULT
            assert not bench.driver.ready
            assert not bench.driver.accepting
            assert not bench.driver.enqueue(b"G1 X1")
            assert bench.driver.send_now(b"?pos"), "signals still work"
            bench.inject("reboot")
            await bench.ready()

    asyncio.run(run())


def test_a_pulled_cable_fails_the_job_and_the_port_is_reopened_with_a_stop(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            run = asyncio.create_task(bench.run(moves(200)))
            await bench.until(lambda: len(bench.executed) > 5)
            bench.received.clear()
            bench.inject("unplug:0.3")
            ending = await run
            assert (ending.outcome, ending.reason) == (Outcome.FAILED, Reason.LINK_LOST)
            assert bench.driver.state.link is LinkState.OFFLINE
            assert not bench.driver.enqueue(b"G1 X1")
            assert not bench.driver.send_now(b"?pos")
            await bench.ready()
            assert b"!" in bench.received, "what the core still held was stopped"
            assert (await bench.run(moves(3))).outcome is Outcome.COMPLETED

    asyncio.run(run())
    log = next(tmp_path.glob("*.log")).read_text()
    assert "note link lost" in log
    assert log.count("note link open") == 2


def test_a_short_silence_costs_nothing(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            run = asyncio.create_task(bench.run(moves(150)))
            await bench.until(lambda: len(bench.executed) > 5)
            bench.inject("mute:0.5")
            await bench.until(lambda: not bench.driver.state.alive)
            assert (await run).outcome is Outcome.COMPLETED
            assert bench.driver.state.alive
            assert bench.executed == moves(150)

    asyncio.run(run())


def test_a_long_silence_fails_the_job_and_stops_the_core(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            run = asyncio.create_task(bench.run(moves(2000)))
            await bench.until(lambda: len(bench.executed) > 5)
            bench.inject("mute:3")
            ending = await run
            assert (ending.outcome, ending.reason) == (Outcome.FAILED, Reason.MACHINE_SILENT)
            await bench.until(lambda: b"!" in bench.received)
            assert not bench.driver.ready
            await bench.ready()

    asyncio.run(run())


def test_a_lost_command_fails_the_job_and_stops_the_core(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            run = asyncio.create_task(bench.run(moves(300)))
            await bench.until(lambda: len(bench.executed) > 5)
            bench.inject("queue-full")
            ending = await run
            assert (ending.outcome, ending.reason) == (Outcome.FAILED, Reason.QUEUE_FULL)
            await bench.until(lambda: b"!" in bench.received)

    asyncio.run(run())


@pytest.mark.parametrize("when", [1, 20, 79])
def test_a_lost_answer_loses_no_command_and_ends_no_job_early(tmp_path, when):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            run = asyncio.create_task(bench.run(moves(80)))
            await bench.until(lambda: len(bench.executed) >= when)
            bench.inject("drop-answer")
            assert (await run).outcome is Outcome.COMPLETED
            assert bench.executed == moves(80)
            assert bench.core.lost == 0

    asyncio.run(run())


@pytest.mark.parametrize("delay", [0.05, 0.25, 0.5])
def test_late_answers_end_no_job_early_and_overrun_no_queue(tmp_path, delay):
    async def run():
        options = CoreOptions(capacity=8, command_time=0.01, hold_off=0.05)
        patient = SparkOptions(hold_off=0.05, answer_timeout=0.3, silence_limit=5)
        async with driving(tmp_path, options, patient) as bench:
            run = asyncio.create_task(bench.run(moves(20)))
            await bench.until(lambda: bench.executed)
            bench.inject(f"slow:{delay}")
            ending = await run
            assert ending.outcome is Outcome.COMPLETED
            assert bench.executed == moves(20), "completed means completed"
            assert bench.core.lost == 0

    asyncio.run(run())


def test_line_noise_hurts_no_command(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            run = asyncio.create_task(bench.run(moves(150)))
            for _ in range(8):
                await asyncio.sleep(0.05)
                bench.inject("garbage:200")
            assert (await run).outcome is Outcome.COMPLETED
            assert bench.executed == moves(150)

    asyncio.run(run())


def test_an_error_of_the_machine_is_reported_and_does_not_end_the_job(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            run = asyncio.create_task(bench.run(moves(30)))
            bench.inject("error:short circuit")
            assert (await run).outcome is Outcome.COMPLETED
            assert bench.tagged("error")[0].values["msg"] == "short circuit"

    asyncio.run(run())


def test_a_core_that_is_silent_from_the_start_is_offline_after_a_moment(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            bench.inject("mute")
            await bench.until(lambda: bench.driver.state.link is LinkState.OFFLINE)
            assert not bench.driver.accepting
            assert not bench.driver.enqueue(b"G1 X1")

    asyncio.run(run())


def test_a_stop_is_sent_at_connection_if_so_configured(tmp_path):
    async def run():
        options = SparkOptions(hold_off=0.05, stop_on_connect=True)
        async with driving(tmp_path, SLOWISH, options) as bench:
            assert bench.received[0] == b"!"

    asyncio.run(run())


def test_a_stop_while_offline_is_sent_when_the_link_is_back(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH, QUICK) as bench:
            bench.inject("unplug:0.2")
            await bench.until(lambda: bench.driver.state.link is LinkState.OFFLINE)
            bench.received.clear()
            bench.driver.stop()
            await bench.ready()
            assert bench.received[0] == b"!"

    asyncio.run(run())


def test_a_link_that_breaks_at_the_start_leaves_nothing_to_be_sent_later(tmp_path):
    """The first line sent finds the link broken: the run has failed, and is not taken up by the next link."""

    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            bench.simulated._disconnect()
            ending = await bench.run(moves(100), {"?pos": 1.0})
            assert (ending.outcome, ending.reason) == (Outcome.FAILED, Reason.LINK_LOST)
            await bench.ready()
            await asyncio.sleep(0.2)
            assert bench.executed == []

    asyncio.run(run())


def test_a_stop_is_owed_until_the_core_has_answered_it(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(command_time=0.05, hold_off=0.0)) as bench:
            bench.driver.enqueue(b"G4 P5")
            bench.inject("unplug:0.1")
            await bench.until(lambda: not bench.driver.state.alive)
            bench.driver.stop()
            await bench.until(lambda: bench.driver._link is not None)
            bench.simulated._disconnect()  # The stop has been written, and is lost with the link.
            bench.received.clear()
            await bench.ready()
            assert bench.received[0] == b"!"

    asyncio.run(run())


def test_a_core_that_fell_silent_is_noticed_although_clients_go_on_asking(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            run = asyncio.create_task(bench.run(moves(2000), {"?queue": 0.05}))
            await bench.until(lambda: bench.executed)
            bench.inject("mute:3")
            assert (await run).reason is Reason.MACHINE_SILENT

    asyncio.run(run())


def test_a_fault_outlasts_the_link(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            bench.inject("fault")
            await bench.until(lambda: bench.driver.state.link is LinkState.FAULT)
            bench.inject("unplug:0.1")
            await bench.until(lambda: bench.driver.state.link is LinkState.OFFLINE)
            await bench.until(lambda: bench.driver.state.link is LinkState.FAULT)
            assert not bench.driver.ready
            bench.inject("reboot")
            await bench.ready()

    asyncio.run(run())


def test_an_urgent_command_is_refused_while_it_would_be_lost(tmp_path):
    async def run():
        async with driving(tmp_path, CoreOptions(capacity=8, command_time=0.05, hold_off=0.1)) as bench:
            run = asyncio.create_task(bench.run(moves(100)))
            await bench.until(lambda: bench.executed)
            taken = [bench.driver.send_now(b"G4 P0.001") for _ in range(30)]
            assert not all(taken)
            await asyncio.sleep(0.2)
            assert bench.core.lost == 0
            bench.driver.stop()
            assert not bench.driver.send_now(b"G1 X1"), "within the hold-off"
            await run

    asyncio.run(run())


def test_commands_sent_right_after_a_cores_hold_off_are_executed(tmp_path):
    """The core counts from the arrival of the stop, so the driver must not count from its sending."""

    async def run():
        async with driving(tmp_path, CoreOptions(command_time=0.0, hold_off=0.05)) as bench:
            for number in range(10):
                bench.driver.stop()
                await bench.ready()
                bench.executed.clear()
                ending = await bench.run([b"G1 X%d" % number])
                assert ending.outcome is Outcome.COMPLETED
                assert bench.executed == [b"G1 X%d" % number], "completed means executed"

    asyncio.run(run())


def test_init_lines_can_be_sent_after_a_long_power_off(tmp_path):
    async def run():
        async with driving(tmp_path, SLOWISH) as bench:
            bench.inject("mute:0.6")
            await bench.until(lambda: bench.driver.state.link is LinkState.OFFLINE)
            taken = []
            bench.session_started = lambda: taken.append(bench.driver.enqueue(b"set a.b 1"))
            await asyncio.sleep(0.6)
            bench.inject("reboot")
            await bench.until(lambda: bench.executed == [b"set a.b 1"], 2.0)
            assert taken == [True]

    asyncio.run(run())
