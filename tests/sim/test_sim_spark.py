"""The protocol: Spark serial protocol, lines down, flow control, cancel, boot and fault."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sim_bench import Bench, parse

from toolpost.sim.options import SparkOptions


def test_queue_counts_waiting_and_running():
    bench = Bench(command_time=1)
    assert bench.ask("?queue") == ["queue < cap:64 num:0 >"]
    bench.send("G1 X1", "G1 X2", "M3 P1")
    assert bench.num() == 3
    bench.loop.sleep(1.001)
    assert bench.num() == 2
    bench.loop.sleep(2)
    assert bench.num() == 0
    assert bench.executed() == ["G1 X1", "G1 X2", "M3 P1"]
    bench.balance()


def test_a_command_beyond_the_capacity_is_lost():
    bench = Bench(command_time=1, capacity=3)
    said = bench.ask("G1 X1", "G1 X2", "G1 X3", "G1 X4", "?queue")
    assert said == ['error < msg:"queue full" src:"G1 X4" >', "queue < cap:3 num:3 >"]
    assert bench.core.lost == 1
    bench.loop.sleep(10)
    assert bench.executed() == ["G1 X1", "G1 X2", "G1 X3"]
    bench.balance()


def test_execution_does_not_drift_when_the_loop_is_late():
    bench = Bench(command_time=0.003, capacity=10_000)
    bench.send(*["G1 X1"] * 1000)
    for _ in range(20):
        bench.loop.oversleep(0.05)
    assert bench.core.executed == 333
    bench.loop.oversleep(10)
    assert bench.core.last_executed_at == pytest.approx(1003.0)


def test_dwell_takes_its_own_time():
    bench = Bench(command_time=0.01)
    bench.send("G4 P2.5", "G4")
    bench.loop.sleep(2.4)
    assert bench.num() == 2
    bench.loop.sleep(0.2)
    assert bench.num() == 0


def test_realtime_moves():
    bench = Bench(command_time=0, realtime_moves=True)
    bench.send("G1 X3 Y4 F60", "M3 P1", "G0 X3 Y4 Z-20")
    bench.loop.sleep(2.5)
    assert bench.core.position == pytest.approx({"x": 1.5, "y": 2, "z": 0, "c": 0})
    bench.loop.sleep(3.0)  # 5 s for the cut; then 20 mm at 1200 mm/min
    assert bench.core.position["z"] == pytest.approx(-10)
    bench.loop.sleep(1)
    assert bench.num() == 0


def test_zero_time_commands_are_done_at_once():
    bench = Bench(command_time=0, capacity=1)
    assert bench.ask("G1 X1", "G1 X2", "?queue") == ["queue < cap:1 num:0 >"]
    assert not bench.loop.pending


@pytest.mark.parametrize("line", ["?queue ", "?pos ; c", "?bogus", "?", "?QUEUE"])
def test_unknown_signals_are_ignored(line):
    bench = Bench()
    assert bench.ask(line) == []
    assert bench.core.received == 0


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("g1 x1", "unknown command"),
        ("hello", "unknown command"),
        (" G1 X1", "unknown command"),
        ("! ", "unknown command"),
        ("get all", "unknown command"),
        ("G1 X1 ; c", "invalid command"),
        ("G1 X", "invalid command"),
        ("Gx", "invalid command"),
        ("set a", "invalid set"),
        ("set a b", "invalid set"),
        ("set a..b 1", "invalid set"),
        ("set a 1e5", "invalid set"),
        ("fset a", "invalid set"),
    ],
)
def test_bad_lines_are_answered_with_an_error(line, message):
    bench = Bench()
    assert bench.ask(line) == [f'error < msg:"{message}" src:"{line}" >']
    bench.balance()


@pytest.mark.timeout(5)
@pytest.mark.parametrize("end", [";", " X", "x"])
def test_a_bad_line_costs_no_more_than_a_good_one(end):
    bench = Bench(trace=False, command_time=0)
    bench.send(*["G1" + " X111111" * 15 + end] * 100, *["set a." + "a." * 50 + end] * 100)
    assert bench.core.rejected == 200


def test_an_error_quotes_fifty_bytes():
    bench = Bench()
    assert bench.ask('x"\\' + "y" * 100) == ['error < msg:"unknown command" src:"x\\"\\\\' + "y" * 47 + '" >']


def test_blank_lines_and_edits_are_echoed():
    bench = Bench(command_time=0)
    assert bench.ask("", "  ") == ["", ""]
    bench.core.receive(b"G1 X12\x08\x7f5\n")
    assert bench.said == b" \b \b"
    assert bench.executed() == ["G1 X5"]
    assert bench.core.position["x"] == 5


def test_an_overlong_line_is_dropped_without_an_error():
    bench = Bench()
    assert bench.ask("G1 " + "X" * 126) == []
    assert bench.core.overlong == 1
    assert bench.core.received == 0


def test_settings():
    bench = Bench(command_time=0)
    said = bench.ask("set my.own.key -1.5", "set m.0.microstep 16", "get")
    values = parse(said, "stg")
    assert len(said) > 3
    assert all(len(line) <= 100 for line in said)
    assert values["my.own.key"] == "-1.5"
    assert values["m.0.microstep"] == "16"
    assert all(float(value) == bench.core.settings[key] for key, value in values.items())
    assert bench.core.executed == 3
    assert bench.ask("fset quick 2") == []
    assert bench.core.settings["quick"] == 2
    assert bench.core.received == 3


def test_settings_are_bounded():
    bench = Bench(command_time=0)
    said = bench.ask(*(f"set k{number} 1" for number in range(1000)))
    assert len(bench.core.settings) == 512
    assert "too many settings" in said[0]


def test_set_waits_its_turn():
    bench = Bench(command_time=1)
    bench.send("G1 X1", "set a 5", "G1 X2")
    assert "a" not in bench.core.settings
    bench.loop.sleep(1.01)
    assert bench.core.settings["a"] == 5
    assert bench.num() == 1


def test_stat_has_hex_values():
    values = parse(Bench().ask("stat"), "stat")
    registers = [value for value in values.values() if value.startswith("0x")]
    assert len(registers) > 20
    assert all(0 <= int(value, 16) < 2**32 for value in registers)


def test_position_in_every_coordinate_system():
    bench = Bench(command_time=0)
    assert bench.ask("?pos") == ['pos < sys:"machine" m.x:0.000 m.y:0.000 m.z:0.000 m.c:0.000 >']
    for command, name, letter in (
        ("G54", "grinder", "g"),
        ("G55", "work", "w"),
        ("G56", "toolsupply", "t"),
    ):
        bench.send(f"set cs.{letter}.x 100", command, "G0 X-1.5 Y2", "G38.3 Z-3")
        values = parse(bench.ask("?pos"), "pos")
        assert values["sys"] == f'"{name}"'
        assert (values["m.x"], values["m.y"], values["m.z"]) == ("98.500", "2.000", "-3.000")
        assert (values[f"{letter}.x"], values[f"{letter}.c"]) == ("-1.500", "0.000")
    bench.send("G28 X")
    assert bench.core.position == {"x": 0, "y": 2, "z": -3, "c": 0}
    bench.send("G28", "G53")
    assert bench.core.position == {"x": 0, "y": 0, "z": 0, "c": 0}


def test_edm_changes_while_cutting_and_is_interleaved():
    bench = Bench(command_time=10)
    idle = parse(bench.ask("?edm"), "edm")
    assert idle["open"] == "1.000"
    bench.send("G1 X1")
    said = bench.ask("?edm", "?queue")
    assert [line.split()[0] for line in said] == ["edm", "edm", "queue", "edm", "edm"]
    cutting = parse(said, "edm")
    assert set(cutting) == {"eff_duty", "open", "short", "pb_f", "pb_b", "dist", "dist_max"}
    bench.loop.sleep(1)
    assert parse(bench.ask("?edm"), "edm") != cutting
    bench.send("?edm")
    assert b"edm >" not in bench.said
    bench.loop.sleep(0.1)
    assert bench.said.endswith(b"edm >\r\n")


def test_cancel_leaves_a_report_unfinished():
    bench = Bench()
    said = bench.ask("?edm", "?edm", "!")
    bench.loop.sleep(1)
    assert said[-2:] != ["edm >"]
    assert bench.lines() == []


def test_cancel():
    bench = Bench(command_time=1)
    bench.send("G1 X10", "G1 X20", "G1 X30")
    bench.loop.sleep(1.5)
    bench.send("!", "G1 X99", "garbage", "set a 1", "fset a 1", "!", "get")
    assert bench.num() == 0
    assert bench.core.position["x"] == pytest.approx(15)
    assert bench.core.commands_after_bang == 4
    assert bench.core.last_bang_at == 1001.5
    assert bench.lines() == []
    bench.loop.sleep(0.49)
    bench.send("G1 X99")
    assert bench.core.commands_after_bang == 5
    bench.loop.sleep(0.02)
    bench.core.mark()
    bench.send("G1 X17")
    bench.loop.sleep(2)
    assert bench.executed() == ["G1 X10", "G1 X17"]
    assert bench.core.commands_after_bang == 0
    assert "a" not in bench.core.settings
    bench.balance()


def test_old_firmware_has_no_hold_off():
    bench = Bench(command_time=0, hold_off=0)
    bench.send("!", "G1 X1")
    assert bench.executed() == ["G1 X1"]
    assert bench.core.commands_after_bang == 1


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ("sys", ['sys < ev:"boot" >']),
        (
            "init",
            [
                "init < ok:true motor.ok:true",
                'init pulser.ok:true pulser.msg:"simulated" toolsupply.ok:true >',
            ],
        ),
        ("none", []),
    ],
)
def test_boot_message(message, said):
    bench = Bench(boot=False, boot_message=message)
    bench.core.boot()
    assert bench.lines() == said


def test_a_boot_makes_everything_fresh():
    bench = Bench(command_time=1, boot_time=0.5, boot=False)
    bench.core.boot()
    bench.loop.sleep(1)
    bench.send("G1 X5", "set a 1")
    bench.loop.sleep(2)
    bench.send("G1 X6", "G1 X7")
    bench.core.receive(b"G1 X")
    bench.said.clear()
    bench.core.boot()
    assert bench.ask("G1 X8", "?queue", "set b 1") == []
    bench.core.receive(b"G1 X")
    bench.loop.sleep(0.6)
    assert bench.lines() == ['sys < ev:"boot" >']
    assert bench.num() == 0
    assert bench.core.position["x"] == 0
    assert not {"a", "b"} & set(bench.core.settings)
    assert bench.core.ignored == 2
    bench.send("G1 X9")
    bench.loop.sleep(2)
    assert bench.executed()[-1] == "G1 X9"
    bench.balance()


def test_answers_are_delayed_in_order():
    bench = Bench(command_time=0, answer_delay=0.2)
    assert bench.ask("?queue") == []
    bench.loop.sleep(0.1)
    bench.send("?pos", "nonsense")
    assert [line.split()[0] for line in bench.lines()] == ["error"]
    bench.loop.sleep(0.15)
    assert [line.split()[0] for line in bench.lines()] == ["queue"]
    bench.loop.sleep(0.1)
    assert [line.split()[0] for line in bench.lines()] == ["pos"]


def test_close_leaves_no_timer():
    bench = Bench(faults=["mute:5", "stall:5", "fault@9s"])
    bench.send("G1 X1", "?edm", "?edm")
    bench.core.close()
    assert not bench.loop.pending
    bench.said.clear()
    assert bench.ask("?queue") == []


def test_times():
    bench = Bench(command_time=1)
    assert bench.core.first_command_at is None
    assert bench.core.last_executed_at is None
    bench.send("?pos")
    assert bench.core.first_command_at is None
    bench.send("G1 X1")
    bench.loop.sleep(5)
    assert bench.core.first_command_at == 1000
    assert bench.core.last_executed_at == 1001


@pytest.mark.parametrize("options", [{"capacity": 0}, {"command_time": -1}, {"hold_off": float("nan")}])
def test_bad_options_are_refused(options):
    with pytest.raises(ValueError):
        SparkOptions(**options)


# -- the straight path gives what the careful one gives

number = st.decimals(-999, 999, places=3).map(str)
words = st.lists(st.tuples(st.sampled_from("XYZCFEP"), number), max_size=4).map(
    lambda pairs: "".join(f" {letter}{value}" for letter, value in pairs)
)
line = st.one_of(
    st.builds(lambda head, tail: head + tail, st.sampled_from(["G0", "G1", "M3", "G38.3"]), words),
    st.sampled_from(
        ["G28", "G54", "G53", "set cs.g.x 10", "?queue", "?pos", "", "g1", "get", "?nope", "G4 P1"]
    ),
    st.sampled_from(["G1 X1.", "G1  X3", "G1X2Y3", "G01 X4", "G1 X5 ", "M3\x08", "x" * 129, "!"]),
)


@given(st.lists(line, max_size=30), st.lists(st.integers(0, 600), max_size=6), st.booleans())
def test_paths_and_chunks_agree(lines, cuts, held):
    data = "".join(text + "\n" for text in lines).encode()
    hold_off = 0.5 if held else 0.0
    straight = Bench(trace=False, command_time=0, hold_off=hold_off)
    straight.core.receive(data)
    careful = Bench(trace=True, command_time=0, hold_off=hold_off)
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    for start, stop in itertools.pairwise(edges):
        careful.core.receive(data[start:stop])
    assert straight.core.executed == careful.core.executed == len(careful.executed())
    assert straight.core.received == careful.core.received
    assert straight.core.rejected == careful.core.rejected
    assert straight.core.commands_after_bang == careful.core.commands_after_bang
    assert straight.core.position == pytest.approx(careful.core.position)
    echoes = b" \b"  # an echo comes with its chunk, ahead of or after the lines of that chunk
    assert straight.said.replace(echoes, b"") == careful.said.replace(echoes, b"")
    straight.balance()
    careful.balance()


@given(st.lists(line, max_size=30))
def test_timed_execution_does_what_instant_execution_does(lines):
    instant = Bench(command_time=0, hold_off=0)
    timed = Bench(command_time=0.01, hold_off=0)
    lines = [text for text in lines if text != "!"]
    instant.send(*lines)
    timed.send(*lines)
    timed.loop.sleep(100)
    assert instant.executed() == timed.executed()
    assert instant.core.position == pytest.approx(timed.core.position)
    timed.balance()
