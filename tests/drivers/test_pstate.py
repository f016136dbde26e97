import json
import math
import struct
import time
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from toolpost.drivers.spark.pstate import PState, PStateError, PStateParser, parse_value

VECTORS = json.loads((Path(__file__).parents[1] / "golden" / "pstate_vectors.json").read_text("utf-8"))
ERROR = "error"

# Where the recommendation is not simply "same as reference": what each line gives, and why.
DECIDED = {
    # A boot must not be missed, so the tag sys is understood without marks.
    "sys boot as one firmware version sent it: no < no >": [[("sys", {"ev": "boot"})]],
    # A value that no p-state was opened for belongs to nothing.
    "value without begin (pstate.md stg example)": [ERROR],
    # Nothing that was delivered is dropped.
    "two p-states on one line: only the first": [[("t", {"a": 1}), ("u", {"b": 2})]],
    # Words for a person are in the comm log; they are no error.
    "human text": [[]],
    # Half of a value is not taken for the value.
    "hex garbage suffix": [ERROR],
    "float garbage suffix": [ERROR],
    "underscore digits": [ERROR],
    # JSON has no word for it; the other values of the p-state still count.
    "nan": [[("t", {"a": None})]],
    "infinity": [[("t", {"a": None})]],
    # A person must see a message even if the firmware has cut it or did not escape its quotes.
    "string unclosed (line cut at 128 bytes)": [[("error", {"msg": "unknown key ver"})]],
    "string unescaped inner quote (firmware does not escape msg)": [[("error", {"msg": 'unknown key "x"'})]],
    # Nothing is ambiguous about it.
    "string without space after": [[("t", {"a": "x", "b": 1})]],
    # A key without its value is an error, and drops the p-state: the next line has none to go on with.
    "line ends after key": [ERROR, ERROR],
    # A new beginning drops what was begun before, on one line as on two.
    "begin twice on a line": [[("t", {"b": 2})]],
    # Spaces around marks are optional.
    "< glued to tag": [[("t", {"a": 1})]],
    "> glued to bool": [[("t", {"a": True})]],
    # Part of a p-state must not be taken for the whole: the error drops it, so what follows has no begin.
    "error mid-line keeps earlier keys open": [ERROR, ERROR],
    "error in continuation does not lose the open one": [None, ERROR, ERROR],
    "tokenizer error in continuation": [None, ERROR, ERROR],
    # Hex numbers are numbers.
    "queue with hex (flow control ignores it)": [[("queue", {"cap": 100, "num": 0})]],
}


def feed_all(lines):
    """Return for each line the list of (tag, values), or ERROR."""
    parser = PStateParser()
    results = []
    for line in lines:
        try:
            results.append([(p.tag, p.values) for p in parser.feed(line)])
        except PStateError:
            results.append(ERROR)
    return results


def one(line):
    (pstate,) = PStateParser().feed(line)
    return pstate.values


def same(a, b):
    """Equal by value, but a boolean is no number."""
    return a == b and isinstance(a, bool) == isinstance(b, bool)


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["name"])
def test_vectors(vector):
    got = feed_all(vector["lines"])
    if vector["recommended"] != "same as reference":
        expected = [[] if entry is None else entry for entry in DECIDED[vector["name"]]]
        assert got == expected
        return
    assert vector["name"] not in DECIDED
    for result, entry in zip(got, vector["reference"], strict=True):
        if entry is None:
            assert result == []
        elif "error" in entry:
            assert result == ERROR
        else:
            ((tag, values),) = result
            assert tag == entry["tag"]
            assert values.keys() == entry["kv"].keys()
            for key, value in entry["kv"].items():
                kind = entry["types"][key]
                want = float32(value) if kind == "float32" else value
                have = float32(values[key]) if kind == "float32" else values[key]
                assert same(have, want), key


def test_every_decision_is_about_a_vector():
    assert DECIDED.keys() == {v["name"] for v in VECTORS if v["recommended"] != "same as reference"}


def float32(value):
    return struct.unpack("f", struct.pack("f", value))[0]


# Round trip: any p-state in any legal layout.

tags = st.from_regex(r"[a-z][a-z0-9_]{0,6}", fullmatch=True).filter(lambda tag: tag not in {"error", "sys"})
keys = st.from_regex(r"[A-Za-z0-9_]{1,4}(\.[A-Za-z0-9_]{1,3}){0,2}", fullmatch=True)
strings = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=12)
whole = st.integers(-999_999, 999_999)
small = st.builds(lambda n, places: n / 10**places, whole, st.integers(1, 5))
values = st.one_of(st.booleans(), whole, small, strings)


def rendered(value, hexed):
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, int) and value >= 0 and hexed:
        return hex(value)
    return format(value, "f") if isinstance(value, float) else str(value)


@st.composite
def layouts(draw):
    """A p-state and the lines that it may come in."""
    tag = draw(tags)
    content = draw(st.dictionaries(keys, values, max_size=6))
    marked = ["<", *(f"{k}:{rendered(v, draw(st.booleans()))}" for k, v in content.items()), ">"]
    lines = [draw(st.sampled_from(["", " "])) + tag]
    before = tag
    for part in marked:
        first = lines[-1].strip() == tag
        # `<` must stand on the first line: nothing else opens.
        if part != "<" and draw(st.integers(0, 3)) == 0:
            lines.append(tag)
            before, first = tag, True
        glue = part in "<>" or before == "<" or (before.endswith('"') and not first)
        space = draw(st.sampled_from(["", " ", "   "] if glue else [" ", "  "]))
        lines[-1] += space + part
        before = part
    return tag, content, [line + draw(st.sampled_from(["", " "])) for line in lines]


@given(st.lists(layouts(), min_size=1, max_size=4, unique_by=lambda layout: layout[0]), st.randoms())
def test_any_layout_and_any_interleaving(pstates, random):
    left = {tag: list(lines) for tag, _, lines in pstates}
    parser, got = PStateParser(), {}
    while left:
        tag = random.choice(sorted(left))
        for pstate in parser.feed(left[tag].pop(0)):
            assert pstate.tag not in got
            got[pstate.tag] = pstate.values
        if not left[tag]:
            del left[tag]
    assert list(got) != []
    for tag, content, _ in pstates:
        assert list(got[tag]) == list(content)
        assert all(same(got[tag][key], content[key]) for key in content), (got[tag], content)
    assert parser._open == {}


@given(st.lists(layouts(), min_size=1, max_size=4))
def test_several_on_a_line(pstates):
    whole_line = " ".join(lines[0] for _, _, lines in pstates if len(lines) == 1)
    expected = [(tag, content) for tag, content, lines in pstates if len(lines) == 1]
    assert [(p.tag, p.values) for p in PStateParser().feed(whole_line)] == expected


# Anything at all may come.

alphabet = st.sampled_from(
    [*' <>:"\\', "a", "t", "sys", "error", "queue", "msg:", "1", ".5", "-", "0x", "é", "\n"]
)
soup = st.lists(st.one_of(alphabet, st.text(max_size=4)), max_size=30).map("".join)


@given(st.lists(soup, max_size=12))
def test_garbage_raises_nothing_else_and_values_stay_plain(lines):
    parser = PStateParser()
    for line in lines:
        try:
            delivered = parser.feed(line)
        except PStateError:
            continue
        for pstate in delivered:
            assert isinstance(pstate, PState)
            assert pstate.tag
            for value in pstate.values.values():
                assert value is None or isinstance(value, bool | int | float | str)
                assert not isinstance(value, float) or math.isfinite(value)
        assert len(parser._open) <= 64


@given(st.lists(soup, max_size=6), layouts())
def test_after_any_garbage_the_next_pstate_is_understood(lines, pstate):
    tag, content, layout = pstate
    parser = PStateParser()
    for line in lines:
        try:
            parser.feed(line)
        except PStateError:
            continue
    got = [p for line in layout for p in parser.feed(line)]
    assert [(p.tag, p.values) for p in got] == [(tag, content)]


def held(parser):
    return sum(
        len(tag) + sum(len(key) + len(str(value)) for key, value in found.items())
        for tag, (found, _) in parser._open.items()
    )


def test_what_is_open_is_bounded_in_tags():
    parser = PStateParser()
    for number in range(1000):
        parser.feed(f"t{number} < a:1")
    assert len(parser._open) == 64
    assert [p.tag for p in parser.feed("t999 >")] == ["t999"]
    with pytest.raises(PStateError):
        parser.feed("t0 >")


def test_what_is_open_is_bounded_in_keys():
    parser = PStateParser()
    parser.feed("t <")
    for number in range(4096):
        parser.feed(f"t k{number}:1")
    with pytest.raises(PStateError, match="too long"):
        parser.feed("t one_more:1")
    assert held(parser) == 0


def test_what_is_open_is_bounded_in_characters():
    parser = PStateParser()
    for tag in range(70):
        parser.feed(f"t{tag} <")
        for number in range(4):
            parser.feed(f't{tag} k{number}:"' + "x" * 60_000 + '"')
        with pytest.raises(PStateError, match="too long"):
            parser.feed(f't{tag} more:"' + "x" * 60_000 + '"')
        parser.feed(f"t{tag} <")
        for number in range(4):
            parser.feed(f't{tag} k{number}:"' + "x" * 60_000 + '"')
    assert held(parser) <= 64 * 262_144


def test_a_new_beginning_starts_the_count_of_characters_again():
    parser = PStateParser()
    for _ in range(20):
        parser.feed('t < k:"' + "x" * 60_000 + '"')
    assert [p.tag for p in parser.feed("t >")] == ["t"]


@pytest.mark.parametrize(
    "line",
    [
        'error < msg:"' + " " * 60_000 + "x",
        "error " + " <" * 30_000 + 'msg:"',
        "a <>" * 15_000,
        "t <" + " a:1" * 15_000,
        't < a:"' + '\\"' * 30_000,
        " " * 60_000 + "t",
        "t" + " " * 60_000 + "x y",
        "t < a:" + "1" * 60_000,
        "t < a:" + "1" * 60_000 + "e" + "9" * 4000 + " >",
        "t < a:0x" + "f" * 60_000,
    ],
    ids=lambda line: line[:14].strip(),
)
def test_no_line_takes_long(line):
    start = time.process_time()
    feed_all([line])
    assert time.process_time() - start < 2


# Errors drop what they spoil, and nothing else.


def test_an_error_drops_the_open_pstate_of_its_tag_only():
    parser = PStateParser()
    parser.feed("t < a:1")
    parser.feed("u < b:2")
    with pytest.raises(PStateError, match="zzz"):
        parser.feed("t b:zzz")
    assert [(p.tag, p.values) for p in parser.feed("u c:3 >")] == [("u", {"b": 2, "c": 3})]
    with pytest.raises(PStateError):
        parser.feed("t c:3 >")


@pytest.mark.parametrize("rest", [">", "> >", "u >", "u < b:zz >", "hello", '"', "t < c"])
def test_what_follows_a_delivered_pstate_does_not_take_it_back(rest):
    assert feed_all([f"t < a:1 > {rest}"]) == [[("t", {"a": 1})]]


def test_the_end_of_no_error_is_an_error_without_words():
    assert feed_all(['error < msg:"a "b""', "error >"]) == [[("error", {"msg": 'a "b"'})], ERROR]


def test_an_error_without_msg_shows_all_of_it():
    assert feed_all(["error < src:G1 X1 >"]) == [[("error", {"msg": "src:G1 X1"})]]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (["sys >"], [ERROR]),
        (['sys ev:"boot" >'], [[("sys", {"ev": "boot"})]]),
        (['sys < ev:"fault" >'], [[("sys", {"ev": "fault"})]]),
        (["sys <", 'sys ev:"boot"', "sys >"], [[], [], [("sys", {"ev": "boot"})]]),
        (["sys is ready"], [[]]),
        (["", "  ", "ok", "ack+ 12", "Hello: world"], [[], [], [], [], []]),
        (["edm <", "edm >"], [[], [("edm", {})]]),
    ],
)
def test_marks(lines, expected):
    assert feed_all(lines) == expected


# Numbers.


def shortest(number):
    """Return the shortest decimal that means the same float32, the nearest of those."""
    if number == 0:
        return "0"
    exact, packed = Fraction(number), struct.pack("f", number)
    for digits in range(1, 10):
        down = Fraction(f"{number:.{digits - 1}e}")
        step = Fraction(10) ** (math.floor(math.log10(abs(number))) - digits + 1)
        near = sorted((down - step, down, down + step), key=lambda decimal: abs(decimal - exact))
        for decimal in near:
            if abs(decimal) < Fraction(2) ** 128 and struct.pack("f", float(decimal)) == packed:
                return f"{float(decimal):.{digits - 1}e}"
    raise AssertionError(number)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
@example(1e-45)
@example(1.1754942e-38)
@example(3.4028234663852886e38)
@example(16777216.0)
@example(-0.0)
def test_the_shortest_decimal_of_a_float32_comes_back(number):
    text = shortest(number)
    for word in (text, text.replace("e", "E"), plain(text)):
        value = parse_value(word)
        assert value == float(text), word
        assert isinstance(value, int) == (float(text).is_integer() and abs(value) < 2**53)


def plain(text):
    """Write a decimal without an exponent."""
    sign = "-" if text.startswith("-") else ""
    mantissa, _, exponent = text.lstrip("-").partition("e")
    digits = mantissa.replace(".", "")
    point = 1 + int(exponent or 0)
    if point <= 0:
        return f"{sign}0.{'0' * -point}{digits}"
    digits = digits.ljust(point, "0")
    return f"{sign}{digits[:point]}.{digits[point:]}"


@pytest.mark.parametrize("exponent", range(-149, 128))
def test_the_shortest_decimal_of_a_power_of_two_means_that_float32(exponent):
    # Next to a power of two the shortest decimal need not be the nearest of its length.
    number = 2.0**exponent
    assert struct.pack("f", parse_value(shortest(number))) == struct.pack("f", number)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_float32_in_full_means_that_float32(number):
    value = parse_value(repr(number))
    assert struct.pack("f", value) == struct.pack("f", number)


@pytest.mark.parametrize(
    "word", ["nan", "NaN", "-nan", "inf", "+Inf", "-infinity", "1e999", "3.5e38", "-1e39"]
)
def test_numbers_that_are_not_finite(word):
    assert one(f"t < a:{word} b:1 >") == {"a": None, "b": 1}


def test_a_number_of_too_many_digits_is_not_finite():
    assert parse_value("1" + "0" * 400) is None


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("1", 1),
        ("+1", 1),
        ("-1", -1),
        (".5", 0.5),
        ("5.", 5),
        ("-.5", -0.5),
        ("1.0", 1),
        ("0.1", 0.1),
        ("0.10000000149011612", 0.1),
        ("16777217", 16777216),
        ("1e-50", 0),
        ("0xFFFFFFFF", 4294967295),
        ("0XaB", 171),
        ("true", True),
    ],
)
def test_words(word, value):
    assert same(parse_value(word), value)
    assert type(parse_value(word)) is type(value)


def test_minus_zero_keeps_its_sign():
    for word in ("-0", "-0.0", "-0.00000000", "-1e-60"):
        value = parse_value(word)
        assert value == 0
        assert math.copysign(1, value) == -1


def test_whole_numbers_beyond_float64_stay_floats():
    assert type(parse_value("9.1e15")) is float
    assert type(parse_value("1e30")) is float
    assert type(parse_value("1e15")) is int


@pytest.mark.parametrize(
    "word",
    [
        "",
        "-",
        ".",
        "1.2.3",
        "1e",
        "0x",
        "0x123456789",
        "True",
        "\u0661",
        "1_0",
        "0b1",
        "--1",
        "1-",
        "in",
        "x",
    ],
)
def test_words_that_are_no_values(word):
    with pytest.raises(PStateError, match="invalid value"):
        parse_value(word)
