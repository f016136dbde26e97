"""Samples are written by hand, in the words of each slicer."""

import base64
import io
import re
import time
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolpost.gcode import metadata as module
from toolpost.gcode.metadata import Metadata, parse_metadata, read_metadata
from toolpost.gcode.thumbnails import (
    Thumbnail,
    find_thumbnails,
    parse_thumbnail_path,
    read_thumbnail,
    thumbnail_path,
)

PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(200))
JPG = b"\xff\xd8\xff\xe0" + bytes(range(100))


def block(picture, size="32x32", kind=""):
    text = base64.b64encode(picture).decode()
    lines = [f"; thumbnail{kind} begin {size} {len(text)}"]
    lines += [f"; {text[at : at + 78]}" for at in range(0, len(text), 78)]
    return "\n".join([*lines, f"; thumbnail{kind} end", ";", ""])


MOVES = "G1 X10 Y10 E1 F1800\n" * 5

SAMPLES = Path(__file__).parent / "samples"


def sample(name):
    """A sample with its pictures and its moves put in."""
    text = (SAMPLES / f"{name}.txt").read_text("utf-8").replace("@MOVES\n", MOVES)
    text = re.sub("@PNG (.*)\n", lambda match: block(PNG, match[1]), text)
    text = re.sub("@JPG (.*)\n", lambda match: block(JPG, match[1], "_JPG"), text)
    return text.replace("\n", "\r\n") if name == "bambustudio" else text


EXPECTED = {
    "prusaslicer": Metadata(
        slicer="PrusaSlicer",
        slicer_version="2.7.1+linux-x64-GTK3",
        estimated_time=94751,
        filament_total=1605.0,
        filament_weight_total=4.74,
        filament_weights=(4.49, 0.25),
        filament_name="Prusament PLA;Generic PETG",
        filament_type="PLA;PETG",
        filament_colors=("#FF8000", ""),
        extruder_colors=("#FF8000", "#000000"),
        filament_temps=(210, 225),
        layer_height=0.15,
        first_layer_height=0.2,
        object_height=10.4,
        nozzle_diameter=0.4,
        first_layer_extr_temp=215,
        first_layer_bed_temp=60,
    ),
    "superslicer": Metadata(
        slicer="SuperSlicer",
        slicer_version="2.5.59",
        estimated_time=7569,
        filament_total=4056.4,
        filament_weight_total=12.1,
        filament_weights=(12.1,),
        filament_type="ABS",
        layer_height=0.15,
        object_height=48.05,
        layer_count=319,
        first_layer_extr_temp=245,
        chamber_temp=50,
    ),
    "orcaslicer": Metadata(
        slicer="OrcaSlicer",
        slicer_version="2.3.0-dev",
        estimated_time=903,
        filament_total=2345.67,
        filament_weight_total=7.0,
        filament_weights=(7.0,),
        filament_name="Generic PLA @System",
        filament_type="PLA",
        filament_temps=(220,),
        layer_height=0.2,
        first_layer_height=0.25,
        object_height=10.0,
        layer_count=50,
        nozzle_diameter=0.6,
        first_layer_extr_temp=225,
        first_layer_bed_temp=55,
    ),
    "bambustudio": Metadata(
        slicer="BambuStudio",
        slicer_version="02.00.03.54",
        estimated_time=647,
        filament_total=200.0,
        filament_weight_total=0.6,
        filament_name="Bambu PLA Basic @BBL X1C",
        filament_type="PLA",
        layer_height=0.2,
        first_layer_height=0.2,
        object_height=5.2,
        layer_count=26,
        nozzle_diameter=0.4,
        first_layer_extr_temp=220,
        first_layer_bed_temp=60,
    ),
    "cura": Metadata(
        slicer="Cura",
        slicer_version="5.2.1",
        estimated_time=2588,
        filament_total=1608.57,
        layer_height=0.16,
        first_layer_height=0.3,
        object_height=10.06,
        layer_count=62,
        first_layer_extr_temp=195,
        first_layer_bed_temp=60,
    ),
    "cura-griffin": Metadata(
        slicer="Cura",
        slicer_version="5.8.1",
        estimated_time=1234,
        object_height=12.5,
        nozzle_diameter=0.4,
        first_layer_extr_temp=205,
        first_layer_bed_temp=60,
    ),
    "simplify3d": Metadata(
        slicer="Simplify3D",
        slicer_version="4.1.2",
        estimated_time=9900,
        filament_total=3542.7,
        filament_weight_total=10.65,
        layer_height=0.2,
        first_layer_height=0.3,
        object_height=11.5,
        layer_count=57,
        nozzle_diameter=0.4,
        first_layer_extr_temp=210,
        first_layer_bed_temp=60,
    ),
    "ideamaker": Metadata(
        slicer="IdeaMaker",
        slicer_version="4.2.3.5428",
        estimated_time=4321,
        filament_total=1000.0,
        filament_weight_total=2.983,
        filament_name="[Raise3D] PLA",
        filament_type="PLA",
        layer_height=0.2,
        first_layer_height=0.3,
        object_height=30.2,
        layer_count=151,
        nozzle_diameter=0.4,
        first_layer_extr_temp=205,
        first_layer_bed_temp=60,
    ),
}


def filled(text):
    """The same file with so many moves that beginning and end are read apart."""
    head, found, rest = text.partition(MOVES)
    return head + found + "G1 X1.234 Y5.678 E0.1\n" * 60_000 + rest


@pytest.mark.parametrize("slicer", EXPECTED)
@pytest.mark.parametrize("size", ["short", "long"])
def test_what_a_slicer_writes(slicer, size):
    text, expected = sample(slicer), EXPECTED[slicer]
    if size == "long":
        if MOVES not in text:
            return
        text = filled(text)
        assert len(text) > module.HEAD + module.TAIL
    data = text.encode()
    found = read_metadata(io.BytesIO(data))
    known = {"gcode_start_byte", "gcode_end_byte", "thumbnails"}
    values = {name: value for name, value in msgspec.structs.asdict(found).items() if name not in known}
    assert values == {
        name: value for name, value in msgspec.structs.asdict(expected).items() if name not in known
    }
    # The commands' place: what is before and behind holds none.
    start, end = found.gcode_start_byte, found.gcode_end_byte
    lines = data[start:end].splitlines()
    assert lines[0][:1] in b"GMT"
    assert lines[-1][:1] in b"GMT"
    for line in data[:start].splitlines() + data[end:].splitlines():
        assert not line or line.startswith(b";")


def test_only_what_is_known_is_told():
    assert msgspec.to_builtins(parse_metadata(b"hello\n")) == {}
    data = b"; generated by PrusaSlicer 2.7.0 on 2026-01-01\nG4 P1000\nM400\n"
    assert msgspec.to_builtins(parse_metadata(data)) == {
        "slicer": "PrusaSlicer",
        "slicer_version": "2.7.0",
        "gcode_start_byte": 47,
        "gcode_end_byte": len(data),
    }


def test_a_fork_is_called_as_it_calls_itself():
    found = parse_metadata(b"; generated by Foo-Slicer 1.2 on today\n; layer_height = 0.3\n")
    assert (found.slicer, found.slicer_version, found.layer_height) == ("Foo-Slicer", "1.2", 0.3)


# Thumbnails


def test_thumbnails():
    data = sample("prusaslicer").encode()
    small, large = read_metadata(io.BytesIO(data)).thumbnails
    assert (small.width, small.height, small.size, small.format) == (16, 16, len(PNG), "png")
    assert (large.width, large.height) == (220, 124)
    assert read_thumbnail(io.BytesIO(data), large) == PNG
    (jpg,) = find_thumbnails(sample("superslicer").encode())
    assert (jpg.format, jpg.size, jpg.width, jpg.height) == ("jpg", len(JPG), 64, 48)
    assert read_thumbnail(io.BytesIO(sample("superslicer").encode()), jpg) == JPG
    assert [
        t.width
        for t in find_thumbnails(
            sample("orcaslicer").encode() + sample("cura").replace("\n", "\r\n").encode()
        )
    ] == [
        48,
        300,
    ]
    # Found by an earlier look, but the file is another one now.
    assert read_thumbnail(io.BytesIO(b"x" * 10_000), large) == b""


@pytest.mark.parametrize(
    "text",
    [
        block(b"<svg onload=alert(1)>"),
        block(PNG, kind="_QOI"),
        block(PNG, "0x32"),
        block(PNG, "9999x9999"),
        block(PNG, "99999x1"),
        block(PNG).replace("; thumbnail end", ""),
        block(PNG).replace("; iVBOR", "; iV*OR"),
        "; thumbnail begin 32x32 99999999999\n",
        "; thumbnail begin 32x32 10\n; thumbnail end\n",
    ],
)
def test_what_is_no_thumbnail_is_left_out(text):
    assert find_thumbnails(text.encode()) == ()


def test_thumbnails_are_bounded():
    assert len(find_thumbnails(block(PNG).encode() * 100)) == 8
    whole = (block(PNG + b"x" * module.HEAD) + "G1 X1\n").encode()
    assert read_metadata(io.BytesIO(whole)).thumbnails == ()


def test_the_path_of_a_thumbnail_and_back():
    picture = Thumbnail(32, 24, 100, "png", 0, 0)
    assert thumbnail_path("sub/a-1x1.gcode", picture) == ".thumbs/a-1x1.gcode-32x24.png"
    for name in ("a.gcode", "sub/dir/a-1x1.gcode", "x.thumbs/.thumbs-2x2.g"):
        directory = name.rpartition("/")[0]
        path = f"{directory}/{thumbnail_path(name, picture)}" if directory else thumbnail_path(name, picture)
        assert parse_thumbnail_path(path) == (name, 32, 24)
    for path in ("a.gcode", ".thumbs/a.gcode", ".thumbs/a-1x1.gif", ".thumbs/sub/a-1x1.png", "a-1x1.png"):
        assert parse_thumbnail_path(path) is None


# Hostile files


def test_a_file_that_prints_html():
    """CVE-2025-64187 and others: texts of files are data; whoever shows them escapes them."""
    evil = "<script>alert(1)</script>"
    data = (
        f"; generated by {evil} 1.0 on today\n; filament_type = {evil}\n"
        f'; filament_settings_id = "{evil}\x1b[2J\x07"\n; filament_colour = {evil}\n'
        f"; layer_height = {evil}\n; estimated printing time (normal mode) = {evil}\n"
        f"M117 {evil}\n"
    ).encode()
    assert parse_metadata(data) == Metadata(
        filament_type=evil,
        filament_name=evil + " [2J",
        gcode_start_byte=data.index(b"M117"),
        gcode_end_byte=len(data),
    )
    assert parse_metadata(b"<html><body>G1 is nice</body></html>\n") == Metadata()


@pytest.mark.parametrize(
    "line",
    [
        "; layer_height = -1",
        "; layer_height = 1e999",
        "; layer_height = nan",
        "; layer_height = " + "9" * 400_000,
        "; nozzle_diameter = 0",
        "; total layer number: 99999999999999",
        "; max_z_height: 2.14748e+06",
        "; filament used [mm] = " + "1e308," * 50,
        "; filament used [g] = " + "9" * 5_000,
        ";TIME:999999999999999999999",
        "; estimated printing time (normal mode) = " + "99999999d " * 9,
        ";Filament used: " + "9" * 400 + "m",
        ";TIME:-5",
        ";MINZ:2.14748e+06",
    ],
)
def test_numbers_that_cannot_be_are_left_out(line):
    found = parse_metadata(f"{line}\nG1 X1\n".encode())
    assert found.gcode_start_byte == len(line) + 1
    assert msgspec.to_builtins(found).keys() <= {"gcode_start_byte", "gcode_end_byte"}


def test_texts_are_short():
    found = parse_metadata(
        b"; filament_type = " + b"x" * 100_000 + b"\n; filament_settings_id = " + b"\xff;" * 999
    )
    assert len(found.filament_type) == module.MAX_TEXT
    assert len(found.filament_name) <= module.MAX_TEXT
    assert len(parse_metadata(b"; generated by A " + b"1" * 500).slicer_version) == 48


def test_many_remarks_hide_nothing_at_the_ends():
    remarks = "; layer\n" * (module._MAX_COMMENTS + 5)
    data = f"; generated by PrusaSlicer 2.7.0 on x\n{remarks}G1 X1\n{remarks}; layer_height = 0.2\n".encode()
    assert len(data) < module.HEAD
    found = parse_metadata(data)
    assert (found.slicer, found.layer_height) == ("PrusaSlicer", 0.2)


def test_empty_files():
    assert read_metadata(io.BytesIO(b"")) == Metadata()
    assert read_metadata(io.BytesIO(b"\n" * 10)) == Metadata()
    assert read_metadata(io.BytesIO(b"\0" * 3_000_000)) == Metadata()


WORDS = st.sampled_from([line.encode() for slicer in EXPECTED for line in sample(slicer).split("\n")])


@given(
    st.lists(WORDS | st.binary(max_size=30) | st.just(b"; thumbnail begin 1x1 4"), max_size=40),
    st.integers(0, 99),
)
@settings(max_examples=300)
def test_no_file_breaks_the_parser(lines, cut):
    data = b"\n".join(lines)
    head, tail = data[: len(data) * cut // 99], data[len(data) * cut // 99 :]
    found = parse_metadata(head, tail, len(head))
    assert msgspec.json.decode(msgspec.json.encode(found), type=Metadata) == found
    for value in (found.gcode_start_byte, found.gcode_end_byte):
        assert value is None or 0 <= value <= len(data)


LIMIT = 0.25
"""Seconds of processor time that a hostile file may take; the samples take a hundredth of it."""


@pytest.mark.parametrize(
    "pattern",
    [
        b"G1 X100.123 Y50.456 E0.01234\n",
        b";TYPE:External perimeter\n",
        b"; layer_height = 0.2\n",
        b"\n",
        b";",
        b"; ",
        b" ",
        b"; a",
        b";a ",
        b"; thumbnail begin 32x32 10\n",
        b"; thumbnail begin 32x32 10\n; thumbnail end\n",
        b"; generated by A ",
        b"M109 ",
        b"M109 T0 ",
        b";LAYER:0\n",
        b";Z:1",
        b"; filament used [mm] = 1,",
        b"total estimated time:1d ",
        b"\0",
    ],
)
@pytest.mark.parametrize("start", [b"", b";Sliced by ideaMaker 1,\n", b"; "])
def test_no_file_takes_long(pattern, start):
    data = start + pattern * (3_000_000 // len(pattern))
    file = io.BytesIO(data)
    best = min(timed(file) for _ in range(2))
    assert best < LIMIT, best


def timed(file):
    started = time.process_time()
    read_metadata(file)
    return time.process_time() - started
