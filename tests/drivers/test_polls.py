import asyncio
import time

from toolpost.drivers.spark.polls import Polls


def run_for(seconds, lines, *, send=None, block=0.0, then=0.0):
    """Poll for a while; return (time, payload) of each line, how many at once and how many after `cancel`."""
    sent = []

    async def main():
        loop = asyncio.get_running_loop()
        start = loop.time()

        def take(payload):
            sent.append((loop.time() - start, payload))
            return True if send is None else send(polls, payload)

        polls = Polls(lines, take)
        polls.start()
        at_once = len(sent)
        loop.call_later(0.02, time.sleep, block)
        await asyncio.sleep(seconds)
        polls.cancel()
        before = len(sent)
        await asyncio.sleep(then)
        return at_once, before

    at_once, before = asyncio.run(main())
    return sent, at_once, len(sent) - before


def test_every_line_is_sent_at_once_and_then_at_its_interval():
    sent, at_once, _ = run_for(0.32, {"?pos": 0.05, "?edm": 0.1})
    assert at_once == 2
    assert [payload for _, payload in sent[:2]] == [b"?pos", b"?edm"]
    for payload, interval in ((b"?pos", 0.05), (b"?edm", 0.1)):
        times = [at for at, line in sent if line == payload]
        assert len(times) >= 2
        for index, at in enumerate(times):
            assert at >= index * interval - 0.005, "too early"


def test_a_late_loop_is_not_made_up_for_with_a_burst():
    sent, _, _ = run_for(0.3, {"?pos": 0.01}, block=0.2)
    assert sent[-1][0] > 0.2
    assert 2 <= len(sent) <= (sent[-1][0] - 0.2) / 0.01 + 3


def test_cancel_stops_all():
    sent, _, after = run_for(0.05, {"?pos": 0.01, "?edm": 0.01}, then=0.06)
    assert len(sent) >= 2
    assert after == 0


def test_a_line_that_cannot_be_sent_is_left_out():
    sent, _, _ = run_for(0.1, {"?pos": 0.01}, send=lambda *_: False)
    assert len(sent) >= 2


def test_cancel_from_within_the_first_send_stops_all():
    # The link breaks while a line is written: the driver hears of it, and cancels, within `send`.
    def broken(polls, _):
        polls.cancel()
        return False

    sent, _, _ = run_for(0.06, {"?pos": 0.01, "?edm": 0.01}, send=broken)
    assert [payload for _, payload in sent] == [b"?pos"]


def test_cancel_from_within_a_later_send_stops_all():
    calls = []

    def broken(polls, payload):
        calls.append(payload)
        if len(calls) == 4:
            polls.cancel()
        return True

    sent, _, _ = run_for(0.1, {"?pos": 0.01}, send=broken)
    assert len(sent) == 4


def test_cancel_twice_and_before_start():
    polls = Polls({"?pos": 1.0}, lambda _: True)
    polls.cancel()
    polls.cancel()


def test_no_lines():
    assert run_for(0.01, {}) == ([], 0, 0)
