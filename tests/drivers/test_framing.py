import itertools

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from toolpost.drivers.spark import framing
from toolpost.drivers.spark.framing import MAX_LINE, LineFramer, content

SHORT = 50
pieces = st.one_of(
    st.binary(max_size=20),
    st.sampled_from([b"\n", b"\r\n", b"queue < cap:100 num:5 >\n", b"\x08 \x08", b"x" * SHORT, b"y" * 10]),
)
wire = st.lists(pieces, max_size=12).map(b"".join)


@pytest.fixture
def _short(monkeypatch):
    monkeypatch.setattr(framing, "MAX_LINE", SHORT)


short = pytest.mark.usefixtures("_short")
shared = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@short
@shared
@given(wire, st.lists(st.integers(0, 5 * SHORT), max_size=12))
def test_chunks_do_not_matter(data, cuts):
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    whole = LineFramer().feed(data + b"\n")
    framer = LineFramer()
    parts = [line for a, b in itertools.pairwise(edges) for line in framer.feed(data[a:b])]
    assert parts + framer.feed(b"\n") == whole


@short
@shared
@given(wire)
def test_every_line_arrives_cut_at_the_most(data):
    assert LineFramer().feed(data + b"\n") == [line[:SHORT] for line in data.split(b"\n")]


@short
@shared
@given(wire)
def test_a_line_without_an_end_waits(data):
    lines = LineFramer().feed(data)
    assert len(lines) - data.count(b"\n") in {0, 1}
    if len(lines) > data.count(b"\n"):
        assert len(lines[-1]) == SHORT


def test_an_endless_line_is_bounded_and_ends_at_lf():
    framer = LineFramer()
    lines = []
    for _ in range(200):
        lines += framer.feed(b"x" * 10_000)
        assert len(framer._rest) <= MAX_LINE
    assert lines == [b"x" * MAX_LINE]
    assert framer.feed(b"tail\nnext\nb") == [b"next"]
    assert framer.feed(b"egun\n") == [b"begun"]


def test_two_endless_lines_in_a_row():
    framer = LineFramer()
    assert framer.feed(b"x" * (MAX_LINE + 1)) == [b"x" * MAX_LINE]
    assert framer.feed(b"\n" + b"y" * (MAX_LINE + 1)) == [b"y" * MAX_LINE]
    assert framer.feed(b"\nok\n") == [b"ok"]


def test_the_longest_line_is_whole():
    line = b"x" * MAX_LINE
    framer = LineFramer()
    assert framer.feed(line) == []
    assert framer.feed(b"\n") == [line]
    assert framer.feed(line + b"z\nok\n") == [line, b"ok"]


@given(st.binary(max_size=300))
def test_content_is_the_printable_bytes(line):
    text = content(line)
    assert text == "".join(chr(byte) for byte in line if 0x20 <= byte <= 0x7E)


def test_noise_around_a_line():
    (line,) = LineFramer().feed(b"\x08 \x00\xffqueue \x1b< cap:1\t num:0 >\r\n")
    assert content(line) == " queue < cap:1 num:0 >"
