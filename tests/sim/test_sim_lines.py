import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolpost.sim.lines import MAX_LINE, LineReader


def lines_of(*chunks):
    reader = LineReader()
    out = b"".join(reader.feed(chunk) for chunk in chunks)
    return [line for line in out.split(b"\n")[:-1] if len(line) <= MAX_LINE], reader


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"G1 X1\n", [b"G1 X1"]),
        (b"G1 X1\r\n", [b"G1 X1"]),
        (b"G1\t X\xff1\x00\x1b\n", [b"G1 X1"]),
        (b"\xc3\xa9G1\n", [b"G1"]),
        (b"\n\n", [b"", b""]),
        (b"G1 X1", []),
        (b"G1 X12\x08\n", [b"G1 X1"]),
        (b"G1 X12\x7f\x7f3\n", [b"G1 X3"]),
        (b"\x08\x08G1\n", [b"G1"]),
        (b"A" * 128 + b"\n", [b"A" * 128]),
        (b"A" * 129 + b"\nG1\n", [b"G1"]),
        (b"A" * 129 + b"\x08\x08\nG1\n", [b"G1"]),
        (b"A" * 5000 + b"\nG1\n", [b"G1"]),
    ],
)
def test_lines(data, expected):
    assert lines_of(data)[0] == expected


def test_an_overlong_line_is_counted_and_forgotten_until_its_end():
    lines, reader = lines_of(b"A" * 200, b"B" * 70_000, b"\x08C\nG1\n")
    assert lines == [b"G1"]
    assert reader.overlong == 1


def test_the_tail_stays_small():
    reader = LineReader()
    for _ in range(1000):
        reader.feed(b"\x08" * 500 + b"x")
    assert len(reader._tail) <= MAX_LINE


wire = st.lists(
    st.one_of(
        st.binary(max_size=20),
        st.sampled_from([b"\n", b"\x08", b"\x7f", b"G1 X1\n", b"A" * 127, b"B" * 129]),
    ),
    max_size=20,
).map(b"".join)


@given(wire, st.lists(st.integers(0, 400), max_size=10))
def test_chunks_do_not_matter(data, cuts):
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    chunks = [data[a:b] for a, b in itertools.pairwise(edges)]
    whole, one = lines_of(data)
    parts, many = lines_of(*chunks)
    assert whole == parts
    assert one.edits == many.edits
