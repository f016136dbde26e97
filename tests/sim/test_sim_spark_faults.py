"""Each fault, and that the machine behaves as before when it is over."""

import pytest
from sim_bench import Bench


@pytest.mark.parametrize("forever", [False, True])
def test_mute(forever):
    bench = Bench(command_time=0.1)
    bench.inject("mute" if forever else "mute:2")
    assert bench.ask("G1 X1", "?queue", "bad", "?edm", "?pos") == []
    bench.loop.sleep(1)
    assert bench.core.executed == 1
    bench.loop.sleep(1.5)
    assert len(bench.ask("?queue")) == (0 if forever else 1)


def test_stall_keeps_what_was_left_of_a_command():
    bench = Bench(command_time=1)
    bench.send("G1 X10", "G1 X20")
    bench.loop.sleep(0.25)
    bench.inject("stall:5")
    bench.loop.sleep(4)
    assert bench.num() == 2
    assert bench.core.position["x"] == pytest.approx(2.5)
    bench.loop.sleep(1.5)
    assert bench.core.position["x"] == pytest.approx(7.5)
    bench.loop.sleep(0.3)
    assert bench.num() == 1
    bench.loop.sleep(1)
    assert bench.num() == 0


def test_stall_of_an_instant_core_fills_its_queue():
    bench = Bench(command_time=0, capacity=3)
    bench.inject("stall")
    said = bench.ask(*["G1 X1"] * 5)
    assert len(said) == 2
    assert bench.num() == 3
    bench.send("!")
    assert bench.num() == 0
    bench.inject("stall:1")
    bench.loop.sleep(0.6)
    bench.send("G1 X7", "G1 X8")
    bench.loop.sleep(1)
    assert bench.executed() == ["G1 X7", "G1 X8"]
    bench.balance()


@pytest.mark.parametrize(("name", "said"), [("reboot", ['sys < ev:"boot" >']), ("silent-reboot", [])])
def test_reboot_in_the_middle(name, said):
    bench = Bench(command_time=0.1)
    bench.inject(f"{name}@3")
    bench.send("set a 1", *["G1 X1"] * 10)
    bench.loop.sleep(5)
    assert bench.lines() == said
    assert bench.core.executed == 3
    assert bench.num() == 0
    assert bench.core.boots == 2
    assert "a" not in bench.core.settings
    bench.balance()


def test_reboot_discards_the_rest_of_what_arrived():
    bench = Bench(command_time=0)
    bench.inject("reboot@3")
    said = bench.ask(*["G1 X1"] * 10, "?queue")
    assert said == ['sys < ev:"boot" >']
    assert bench.core.executed == 3
    assert bench.core.ignored == 7
    bench.balance()


def test_fault_mode():
    bench = Bench(command_time=1)
    bench.send("G1 X1", "G1 X2")
    bench.inject("fault@0.5s")
    bench.loop.sleep(0.6)
    assert bench.lines() == ['sys < ev:"fault" >']
    assert bench.ask("G1 X9", "set a 1", "fset a 1", "nonsense", "!") == []
    assert bench.num() == 0
    assert bench.core.position["x"] == pytest.approx(0.5)
    assert bench.core.last_bang_at is None
    assert bench.ask("?pos")
    assert bench.ask("?edm")
    assert bench.ask("get")
    assert bench.ask("stat")
    assert "a" not in bench.core.settings
    bench.inject("reboot")
    bench.send("G1 X3")
    bench.loop.sleep(2)
    assert bench.executed()[-1] == "G1 X3"
    bench.balance()


def test_garbage_is_noise_and_repeatable():
    noises = []
    for _ in range(2):
        bench = Bench()
        bench.inject("garbage:200")
        assert len(bench.said) == 200
        assert b"\xff" in bench.said
        noises.append(bytes(bench.said))
    assert noises[0] == noises[1]
    bench = Bench(faults=["garbage"])
    assert len(bench.said) == 64


def test_queue_full_though_there_is_room():
    bench = Bench(command_time=0)
    bench.inject("queue-full")
    assert bench.ask("G1 X1", "G1 X2") == ['error < msg:"queue full" src:"G1 X1" >']
    assert bench.core.lost == 1
    assert bench.executed() == ["G1 X2"]
    bench.balance()


def test_slow():
    bench = Bench()
    bench.inject("slow:2")
    assert bench.ask("?queue") == []
    bench.loop.sleep(1.9)
    assert bench.lines() == []
    bench.loop.sleep(0.2)
    assert len(bench.lines()) == 1
    bench.inject("slow:0")
    assert len(bench.ask("?queue")) == 1


def test_drop_answer():
    bench = Bench()
    bench.inject("drop-answer")
    assert [line.split()[0] for line in bench.ask("?queue", "?pos", "?queue")] == ["pos", "queue"]


def test_error():
    bench = Bench()
    bench.inject('error:gap "too" wide')
    bench.inject("error")
    assert bench.lines() == ['error < msg:"gap "too" wide" >', 'error < msg:"simulated error" >']


def test_unplug_asks_the_port():
    bench, seconds = Bench(), []
    bench.core.unplug = seconds.append
    bench.inject("unplug")
    bench.inject("unplug:3")
    assert seconds == [1.0, 3.0]


def test_a_counted_fault_comes_after_exactly_that_many_commands():
    bench = Bench(trace=False, command_time=0)
    bench.inject("error:first@10")
    bench.inject("stall@25")
    bench.send(*["G1 X1"] * 40)
    assert bench.lines() == ['error < msg:"first" >']
    assert bench.core.executed == 25
    assert bench.num() == 15
    bench.balance()


def test_a_late_loop_does_not_overshoot_a_counted_stall():
    bench = Bench(command_time=0.01, faults=["stall@3"])
    bench.send(*["G1 X1"] * 20)
    bench.loop.oversleep(5)
    assert bench.core.executed == 3
