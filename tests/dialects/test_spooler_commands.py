"""Decoding in blocks gives what decoding at once gives (`decode_blocks`)."""

import json

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolpost.dialects.spooler.commands import decode_blocks
from toolpost.errors import InvalidRequestError

tricky = st.text(st.sampled_from('"\\, \n\tab[]{}é\U0001f600'), max_size=12)
quick = settings(max_examples=300, derandomize=True, database=None, deadline=None)


def decode(array: bytes, block: int) -> list[str]:
    return [line for lines in decode_blocks(memoryview(array), block) for line in lines]


@quick
@given(
    lines=st.lists(tricky | st.text(max_size=20), max_size=20),
    block=st.integers(1, 40),
    separator=st.sampled_from([",", ", ", " ,\n", "\t,\r\n "]),
    ascii_only=st.booleans(),
)
def test_equals_a_plain_decode(lines, block, separator, ascii_only):
    array = json.dumps(lines, separators=(separator, ":"), ensure_ascii=ascii_only)
    assert decode(array.encode(errors="surrogatepass"), block) == lines


@quick
@given(array=st.text(st.sampled_from('"\\,[] 5a{'), max_size=40), block=st.integers(1, 12))
def test_refuses_what_a_plain_decode_refuses(array, block):
    try:
        expected = msgspec.json.decode(array.encode(), type=list[str])
    except msgspec.DecodeError:
        with pytest.raises(InvalidRequestError, match=r"^commands: "):
            decode(array.encode(), block)
    else:
        assert decode(array.encode(), block) == expected


@pytest.mark.parametrize("block", [1, 2, 3, 7, 64, 10_000])
@pytest.mark.parametrize(
    "line",
    ['", "', '","', '\\", \\"', "a\\", '\\"', '["', '"]', '", "' * 20, '; say "hi", "ho"', "\\" * 9 + '"'],
)
def test_what_looks_like_a_border(line, block):
    lines = ["G0 X1", line, line, "G0 X2"] * 5
    assert decode(json.dumps(lines).encode(), block) == lines


@pytest.mark.parametrize("block", [1, 10, 10_000])
def test_index_of_what_is_no_string_is_named(block):
    array = json.dumps([*["G0 X1"] * 50, 5]).encode()
    with pytest.raises(InvalidRequestError, match=r"commands\[50\]"):
        decode(array, block)


def test_invalid_utf8_is_refused():
    with pytest.raises(InvalidRequestError, match=r"^commands: "):
        decode(b'["G0","\xff"]', 1)


def test_no_block_is_much_longer_than_asked_for():
    lines = [f"G1 X{i}" for i in range(10_000)]
    blocks = list(decode_blocks(memoryview(json.dumps(lines).encode()), 1000))
    assert [line for block in blocks for line in block] == lines
    assert max(map(len, blocks)) < 200
