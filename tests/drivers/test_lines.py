import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolpost.drivers.base import LineKind
from toolpost.drivers.spark.lines import (
    MAX_LINE,
    classify,
    command,
    commands,
    is_queued,
    is_signal,
    payload,
)
from toolpost.errors import InvalidLineError, InvalidRequestError


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("G1 X1", "G1 X1"),
        ("  G1  X1\t ", "G1  X1"),
        ("G1 X1\r", "G1 X1"),
        ("G1 X1 ; go", "G1 X1"),
        ("G1;a;b", "G1"),
        ("; only words", ""),
        (";", ""),
        ("", ""),
        ("  \t\r", ""),
        ("G1 ; é \x00 \x1b[2J are not sent", "G1"),
        ("x" * 100, "x" * 100),
        (" " * 50 + "x" * 100 + " ;" + "y" * 500, "x" * 100),
    ],
)
def test_payload(line, expected):
    assert payload(line) == expected


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("x" * 101, "at most 100 bytes"),
        ("G1\nM3", "newline"),
        ("G1 ; a\nM3", "newline"),
        ("\n", "newline"),
        ("G1\rM3", "printable ASCII"),
        ("G1\x00", "printable ASCII"),
        ("G1\x1b[A", "printable ASCII"),
        ("G1\x08\x08M3", "printable ASCII"),
        ("G1\x7f", "printable ASCII"),
        ("G1\tX1", "printable ASCII"),
        ("G1 Xé", "printable ASCII"),
        ("\u00a0!", "printable ASCII"),
        ("\u2028G1", "printable ASCII"),
        ("\x0b!", "printable ASCII"),
        ("\ud800", "printable ASCII"),
    ],
)
def test_what_must_not_go_on_the_wire(line, words):
    for check in (payload, classify, command):
        with pytest.raises(InvalidRequestError, match=words):
            check(line)


@given(st.text())
def test_a_payload_is_clean_or_refused(line):
    try:
        text = payload(line)
    except InvalidRequestError:
        return
    assert len(text) <= MAX_LINE
    assert all(0x20 <= ord(char) <= 0x7E for char in text)
    assert ";" not in text
    assert text == text.strip()
    assert text in line
    assert payload(text) == text


@pytest.mark.parametrize(
    ("line", "kind", "wire"),
    [
        ("", LineKind.NOTHING, b""),
        (" ; x", LineKind.NOTHING, b""),
        ("G1 X1 ; x", LineKind.COMMAND, b"G1 X1"),
        ("set a 1", LineKind.COMMAND, b"set a 1"),
        ("fset a 1", LineKind.COMMAND, b"fset a 1"),
        ("?pos", LineKind.SIGNAL, b"?pos"),
        (" \t?queue ", LineKind.SIGNAL, b"?queue"),
        ("?pos ; c", LineKind.SIGNAL, b"?pos"),
        ("!", LineKind.STOP, b"!"),
        ("  ! ", LineKind.STOP, b"!"),
        ("!;now", LineKind.STOP, b"!"),
        ("!!", LineKind.STOP, b"!"),
        ("! please", LineKind.STOP, b"!"),
        ("G1 ! ?pos", LineKind.COMMAND, b"G1 ! ?pos"),
    ],
)
def test_classify(line, kind, wire):
    result = classify(line)
    assert (result.kind, result.payload) == (kind, wire)


@pytest.mark.parametrize("line", ["!", " !", "\t!", "\r!", "?pos", "  ?queue", "?", "!x", " !;c"])
def test_no_signal_hides_in_a_program(line):
    with pytest.raises(InvalidRequestError, match="signal"):
        command(line)
    for before in ([], ["G1"], ["G1", ""]):
        with pytest.raises(InvalidLineError, match="signal") as caught:
            commands([*before, line, "G2"])
        assert caught.value.index == len(before)


def test_a_question_in_a_comment_is_no_signal():
    assert commands([";?pos", "; !", "G1 ;!"]) == [b"G1"]


@pytest.mark.parametrize(
    ("text", "signal", "queued"),
    [
        ("!", True, False),
        ("?pos", True, False),
        ("fset a 1", False, False),
        ("fset", False, False),
        ("fsets a", False, True),
        ("set a 1", False, True),
        ("G1", False, True),
        ("", False, True),
    ],
)
def test_signals_and_queued(text, signal, queued):
    assert is_signal(text) is signal
    assert is_queued(text) is queued


# The fast path of `commands` must not differ from a look at each line.


def line_by_line(lines):
    result = []
    for index, line in enumerate(lines):
        try:
            text = command(line)
        except InvalidRequestError as error:
            return index, str(error)
        if text:
            result.append(text)
    return result


def all_at_once(lines):
    try:
        return commands(lines)
    except InvalidLineError as error:
        return error.index, error.problem


plain = st.text(st.characters(min_codepoint=0x21, max_codepoint=0x7E, exclude_characters=";!?"), max_size=105)
odd = st.lists(
    st.sampled_from(
        ["G1", "X1", " ", ";", "!", "?", "\t", "\r", "\n", "\x00", "\x7f", "\x08", "é", "\x0b", "\x1f"]
    ),
    max_size=6,
).map("".join)


@given(st.lists(st.one_of(plain, plain, plain, odd, st.just("x" * 100), st.just("x" * 101)), max_size=8))
def test_all_at_once_is_as_line_by_line(lines):
    assert all_at_once(lines) == line_by_line(lines)


@given(st.lists(odd, max_size=4))
def test_all_at_once_is_as_line_by_line_for_odd_lines(lines):
    assert all_at_once(lines) == line_by_line(lines)


@pytest.mark.parametrize("place", range(3))
def test_every_byte_at_every_place(place):
    for char in map(chr, range(0x100)):
        for line in ("G" * place + char + "1" * (2 - place), char):
            lines = ["G1 X1", line, "G2"]
            assert all_at_once(lines) == line_by_line(lines), ascii(char)


def test_no_lines():
    assert commands([]) == []
    assert commands([""]) == []
    assert commands(["", "G1", ""]) == [b"G1"]


def test_a_newline_within_a_line_is_found():
    with pytest.raises(InvalidLineError) as caught:
        commands(["G1", "G2\nG3"])
    assert caught.value.index == 1
