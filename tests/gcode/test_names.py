import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolpost.gcode import names
from toolpost.gcode.errors import InvalidNameError
from toolpost.gcode.names import is_gcode, is_name, is_part, split_directory, split_gcode, split_name

GOOD = [
    "a.gcode",
    "sub/dir/a.GCODE",
    "é 日本 (copy) [2].g",
    "comma,name.gco",
    "%2e%2e%2fetc%2fpasswd.gcode",
    "gcodes/a.gcode",
    "<b>bold</b>.gcode",
    "a;b'c\"d$(reboot)`x`.gcode",
    "12:30 o'clock.gcode",
    "nullable.gcode",
    "console.g",
    "a..b.gcode",
    "no suffix",
    "x" * 255,
    "/".join(["d" * 31] * 32),
]


@pytest.mark.parametrize("name", GOOD)
def test_names_that_are_allowed(name):
    assert split_name(name) == tuple(name.split("/"))
    assert is_name(name)


BAD = [
    ("", "must be given"),
    ("../a.gcode", r"\. or \.\."),
    ("a/../../b.gcode", r"\. or \.\."),
    ("./a.gcode", r"\. or \.\."),
    ("a/..", r"\. or \.\."),
    ("/etc/passwd", "relative"),
    ("//host/share.gcode", "relative"),
    ("a\0.gcode", "NUL"),
    ("a\\b.gcode", "backslash"),
    ("..\\..\\boot.gcode", "backslash"),
    ("a\nb.gcode", "control"),
    ("a\x7f.gcode", "control"),
    ("a\x9b2J.gcode", "control"),
    ("edocg.\u202egcode", "control"),
    ("a\u200b.gcode", "control"),
    ("a\u2028b.gcode", "control"),
    ("\ufeffa.gcode", "control"),
    ("a\udcff.gcode", "Unicode"),
    ("C:a.gcode", "drive"),
    ("sub/c:/a.gcode", "drive"),
    ("nul", "device"),
    ("CON.gcode", "device"),
    ("sub/Com1.tar.gcode", "device"),
    ("lpt¹.gcode", "device"),
    ("aux/a.gcode", "device"),
    ("prn .gcode", "device"),
    ("a//b.gcode", "empty"),
    ("a/", "empty"),
    (" a.gcode", "blank"),
    ("a.gcode ", "blank"),
    ("a.gcode\u00a0", "blank"),
    ("dir /a.gcode", "blank"),
    (".hidden.gcode", "begin with a dot"),
    (".parts/x.part", "begin with a dot"),
    ("...", "begin with a dot"),
    ("a.gcode.", "end with a dot"),
    ("x" * 256, "255 bytes"),
    ("é" * 128, "255 bytes"),
    ("x" * 2000, "1024 bytes"),
    ("/".join(["é" * 100] * 8), "1024 bytes"),
    ("/".join("a" * 33), "32 parts"),
]


@pytest.mark.parametrize(("name", "why"), BAD)
def test_names_that_are_refused(name, why):
    with pytest.raises(InvalidNameError, match=why) as raised:
        split_name(name)
    assert str(raised.value).isprintable()
    assert not is_name(name)
    assert not is_part(name)


@pytest.mark.parametrize("name", ["a.gcode", "A.GCODE", "a.g", "b.Gco", "sub/x.y.gcode"])
def test_g_code(name):
    assert is_gcode(name)
    assert split_gcode(name)[-1] == name.rpartition("/")[2]


@pytest.mark.parametrize("name", ["noext", "note.txt", "a.bgcode", "a.gcode.txt", "gcode", "a.3mf"])
def test_what_is_no_g_code_is_refused_for_jobs(name):
    assert split_name(name)
    with pytest.raises(InvalidNameError, match="not a G-code file"):
        split_gcode(name)


def test_the_root_is_a_directory():
    assert split_directory("") == ()
    assert split_directory("a/b") == ("a", "b")
    with pytest.raises(InvalidNameError):
        split_directory("/")


@given(st.text(max_size=60) | st.from_regex(re.compile(r"[./\\a \x00:]{0,12}(gcode)?"), fullmatch=True))
def test_whatever_is_allowed_stays_inside(name):
    try:
        parts = split_name(name)
    except InvalidNameError:
        assert not is_name(name)
        return
    assert "/".join(parts) == name
    assert 0 < len(parts) <= names.MAX_DEPTH
    for part in parts:
        assert is_part(part)
        assert part not in {"", ".", ".."}
        assert not set(part) & {"/", "\\", "\0"}
        assert part.isascii() or part.encode()
