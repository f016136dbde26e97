import pytest
from sim_bench import ManualLoop

from toolpost.sim.faults import KINDS, Fault, FaultSchedule


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("mute", Fault("mute")),
        ("mute:2", Fault("mute", 2.0)),
        ("mute:0.5@100", Fault("mute", 0.5, after_commands=100)),
        ("stall@2.5s", Fault("stall", after_seconds=2.5)),
        (" reboot@3s\n", Fault("reboot", after_seconds=3.0)),
        ("silent-reboot@0", Fault("silent-reboot", after_commands=0)),
        ("garbage:300", Fault("garbage", 300.0)),
        ("error:gap: too wide@7", Fault("error", text="gap: too wide", after_commands=7)),
        ("error:mail me@home", Fault("error", text="mail me@home")),
        ("error:", Fault("error", text="")),
    ],
)
def test_parse(text, fault):
    assert Fault.parse(text) == fault


@pytest.mark.parametrize("name", KINDS)
def test_every_name_parses_alone(name):
    assert Fault.parse(name).name == name


@pytest.mark.parametrize(
    "text",
    [
        "reboot:1",
        "mute:x",
        "mute:-1",
        "mute:nan",
        "mute:inf",
        "mute:",
        "mute@x",
        "mute@1.5",
        "mute@-1",
        "garbage:1.5",
        "garbage:99999999",
    ],
)
def test_bad_arguments_are_refused(text):
    with pytest.raises(ValueError):
        Fault.parse(text)


def test_an_unknown_name_is_answered_with_all_names():
    with pytest.raises(ValueError, match="explode") as caught:
        Fault.parse("explode:3")
    assert all(name in str(caught.value) for name in KINDS)


def test_schedule_orders_by_count_and_time():
    loop, seen = ManualLoop(), []
    schedule = FaultSchedule(loop, lambda fault: seen.append(fault.name), loop.time)
    for text in ("error@5", "garbage@3", "mute@2s", "reboot@1s", "slow"):
        schedule.add(Fault.parse(text), 0)
    assert seen == ["slow"]
    loop.sleep(10)
    assert seen == ["slow"]  # the clock has not started
    schedule.start()
    schedule.start()
    loop.sleep(1.5)
    schedule.on_executed(4)
    loop.sleep(1)
    schedule.on_executed(5)
    assert seen == ["slow", "reboot", "garbage", "mute", "error"]
    schedule.add(Fault.parse("fault@5"), 5)
    assert seen[-1] == "fault"
    schedule.add(Fault.parse("fault@99s"), 5)
    schedule.add(Fault.parse("fault@99"), 5)
    schedule.close()
    assert not loop.pending
    assert not schedule.counting
