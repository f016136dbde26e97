import asyncio
import contextlib
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolpost.http import multipart as module
from toolpost.http.body import BodyError, BodyTooLargeError, ClientGoneError
from toolpost.http.multipart import MultipartError, MultipartParser, Part, parse_boundary, read_upload

TYPE = "multipart/form-data; boundary=XX"


def part(disposition, value, *headers):
    lines = [f"Content-Disposition: form-data; {disposition}", *headers]
    return b"--XX\r\n" + "\r\n".join(lines).encode() + b"\r\n\r\n" + value + b"\r\n"


def body(*parts):
    return b"".join(parts) + b"--XX--\r\n"


FILE = part('name="file"; filename="a.gcode"', b"G28\n", "Content-Type: application/octet-stream")


def pieces_of(data, size):
    return [data[at : at + size] for at in range(0, len(data), size)] or [b""]


class Client:
    """Gives a body piece by piece and notes how far it has got."""

    def __init__(self, pieces, gone=False):
        self.pieces, self.given, self.gone = list(pieces), 0, gone

    async def receive(self):
        if self.given == len(self.pieces):
            if self.gone:
                return {"type": "http.disconnect"}
            await asyncio.sleep(3600)
        self.given += 1
        more = self.given < len(self.pieces) or self.gone
        return {"type": "http.request", "body": self.pieces[self.given - 1], "more_body": more}


def read(data, size=7, max_bytes=10_000, content_type=TYPE, **more):
    got = bytearray()

    async def sink(piece):
        got.extend(piece)

    client = Client(pieces_of(data, size), **more)
    form = asyncio.run(read_upload(client.receive, content_type, sink, max_bytes))
    assert form.size == len(got)
    return form, bytes(got)


@pytest.mark.parametrize("size", [1, 2, 3, 7, 64, 10_000])
def test_an_upload(size):
    data = body(part('name="root"', b"gcodes"), FILE, part('name="print"', "öffnen".encode()))
    form, content = read(data, size)
    assert (form.filename, content) == ("a.gcode", b"G28\n")
    assert form.fields == {"root": "gcodes", "print": "öffnen"}


def test_empty_parts():
    form, content = read(body(part('name="path"', b""), part('name="file"; filename="e.gcode"', b"")), 1)
    assert (form.fields, content) == ({"path": ""}, b"")
    # A client may leave out the line end of no data.
    data = b'--XX\r\nContent-Disposition: form-data; name="file"; filename="e"\r\n\r\n--XX--'
    for size in (1, 5, 999):
        assert read(data, size)[1] == b""


def test_data_that_looks_like_a_boundary():
    for near in (
        b"\r\n--X",
        b"x--XX",
        b"\r\n-",
        b"\r\n--XY\r\n",
        b"\r\r\n--X\r\n--X",
        b"\n--XX\n",
        b"\r\n\r\n--",
    ):
        for size in (1, 2, 3, 999):
            assert read(body(part('name="file"; filename="a"', near)), size)[1] == near


FORMS = st.dictionaries(st.from_regex("[a-z_]{1,9}", fullmatch=True), st.binary(max_size=60), max_size=4)


@given(FORMS, st.binary(max_size=500), st.lists(st.integers(1, 60), min_size=1), st.data())
def test_whatever_is_sent_arrives(fields, content, sizes, data):
    values = [*fields.values(), content]
    boundary = data.draw(st.from_regex("[A-Za-z0-9'()+_,./:=?-]{1,70}", fullmatch=True))
    delimiter = b"--" + boundary.encode()
    if any(delimiter in b"\r\n" + value for value in values):
        return
    message = b""
    for name, value in [*fields.items(), ("file", content)]:
        message += delimiter + f'\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n'.encode()
        message += value + b"\r\n"
    message += delimiter + b"--\r\n"
    parser, events, at, turn = MultipartParser(boundary.encode()), [], 0, 0
    while at < len(message):
        events += parser.feed(message[at : at + sizes[turn % len(sizes)]])
        at += sizes[turn % len(sizes)]
        turn += 1
    parser.close()
    got, names = [], []
    for event in events:
        if isinstance(event, Part):
            names.append(event.name)
            got.append(b"")
        elif event is not None:
            assert event
            got[-1] += event
    assert (names, got) == ([*fields, "file"], values)


@given(
    st.lists(
        st.sampled_from(
            [b"--XX", b"\r\n", b"--", b"\r", b"\n", FILE, b'name="file"', b":", b";", b'"', b"\\"]
        )
        | st.binary(max_size=12),
        max_size=25,
    ),
    st.integers(1, 40),
)
@settings(max_examples=300)
def test_any_bytes_are_an_upload_or_refused(junk, size):
    with contextlib.suppress(MultipartError):
        assert read(b"".join(junk), size)[0].filename is not None


@given(st.data())
def test_an_upload_that_breaks_off_is_refused(data):
    whole = body(part('name="root"', b"gcodes"), FILE)
    end = data.draw(st.integers(0, len(whole) - len(b"--\r\n") + 1))
    with pytest.raises(MultipartError):
        read(whole[:end], 9)
    with pytest.raises(ClientGoneError, match="went away"):
        read(whole[:end] or b"-", 9, gone=True)


@given(st.data())
def test_an_upload_with_a_changed_byte_never_breaks_the_reader(data):
    whole = bytearray(body(part('name="root"', b"gcodes"), FILE))
    whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(MultipartError):
        read(bytes(whole), data.draw(st.integers(1, 50)))


BROKEN = [
    (b"", "ended"),
    (b"--XX--\r\n", "a file must be given"),
    (b"preamble\r\n" + body(FILE), "begin with its boundary"),
    (b"\r\n" + body(FILE), "begin with its boundary"),
    (body(FILE) + b"epilogue", "after the last"),
    (body(FILE) + b"\r\n", "after the last"),
    (body(FILE).replace(b"--XX--", b"--XXX-"), "other than a line end"),
    (FILE + b"--XX \r\n" + FILE[6:], "other than a line end"),
    (body(FILE, FILE), "only once"),
    (body(FILE, part('name="file"', b"x")), "only once"),
    (body(FILE, part('name="root"', b"a"), part('name="root"', b"b")), "only once"),
    (body(FILE, part('name="other"; filename="b.gcode"', b"x")), "must not be a file"),
    (body(part('name="file"', b"/etc/passwd")), "must be a file"),
    (body(part('name=""; filename="a"', b"")), "name must be"),
    (body(part('filename="a"', b"")), "name must be"),
    (body(part('name="a b"', b"")), "name must be"),
    (body(part('name="' + "x" * 65 + '"', b"")), "name must be"),
    (body(part('name="file"; name="b"', b"")), "broken"),
    (body(part('name="file', b"")), "broken"),
    (body(part('name="file" filename="a"', b"")), "broken"),
    (body(part('name=file; filename="a\\"', b"")), "broken"),
    (body(part('name="x"', b"", "Content-Disposition: form-data; name=y")), "headers of a part are broken"),
    (body(part('name="x"', b"", " folded")), "headers of a part are broken"),
    (body(part('name="x"', b"", "No colon")), "headers of a part are broken"),
    (body(part('name="x\x00"', b"")), "headers of a part are broken"),
    (body(part('name="x"', b"", "Content-Transfer-Encoding: base64")), "only binary"),
    (body(part('name="x"', b"\xff")), "must be UTF-8"),
    (b'--XX\r\nContent-Disposition: form-data; name="\xff"\r\n\r\n\r\n--XX--', "must be UTF-8"),
    (b"--XX\r\n\r\nno headers\r\n--XX--", "broken"),
    (b"--XX\r\nContent-Type: text/plain\r\n\r\nx\r\n--XX--", "form-data"),
    (body(part("name=file; filename*=latin-1''%e9", b"")), r"filename\*"),
    (body(part("name=file; filename*=utf-8''%e9", b"")), r"filename\*"),
    (body(FILE, part('name="x"', b"v" * (module.MAX_FIELD + 1))), "at most 4096 bytes"),
    (body(*(part(f'name="f{n}"', b"") for n in range(module.MAX_FIELDS + 1))), "at most 32 fields"),
    (b"--XX\r\n" + b"A: b\r\n" * 1000, "headers of a part must be at most"),
    (b"--XX\r\nA: " + b"b" * 100_000, "headers of a part must be at most"),
]


@pytest.mark.parametrize("size", [1, 50, 200_000])
@pytest.mark.parametrize(("data", "why"), BROKEN)
def test_what_is_broken_is_refused(data, why, size):
    if size == 1 and len(data) > 20_000:
        size = 100
    with pytest.raises(MultipartError, match=why):
        read(data, size)


@pytest.mark.parametrize(
    ("disposition", "filename"),
    [
        ('name="file"; filename="a b.gcode"', "a b.gcode"),
        ("name=file; filename=a.gcode", "a.gcode"),
        ('NAME="file";FILENAME="a.gcode"', "a.gcode"),
        (r'name="file"; filename="a\"b\\c.gcode"', 'a"b\\c.gcode'),
        (r'name="file"; filename="C:\dir\a.gcode"', r"C:\dir\a.gcode"),
        ('name="file"; filename="日本.gcode"', "日本.gcode"),
        ('name="file"; filename="%2e%2e%22.gcode"', "%2e%2e%22.gcode"),
        ('name="file"; filename="x.gcode"; filename*=UTF-8\'\'%E6%97%A5.gcode', "日.gcode"),
        ("name=\"file\"; filename*=utf-8'de'a%2Fb.gcode", "a/b.gcode"),
        ('name="file"; filename=""', ""),
        ('name="file"; filename="../../etc/passwd"', "../../etc/passwd"),
    ],
)
def test_the_name_of_the_file_is_what_the_client_says(disposition, filename):
    # Whether a file may be called so is for others to say (gcode/names.py).
    assert read(body(part(disposition, b"x")))[0].filename == filename


@pytest.mark.parametrize(
    ("content_type", "boundary"),
    [
        ("multipart/form-data; boundary=abc", b"abc"),
        ('multipart/form-data; boundary="a b:c"', b"a b:c"),
        ("Multipart/Form-Data;BOUNDARY=----WebKitFormBoundary7MA4", b"----WebKitFormBoundary7MA4"),
    ],
)
def test_boundaries(content_type, boundary):
    assert parse_boundary(content_type) == boundary


@pytest.mark.parametrize(
    "content_type",
    [
        "",
        "application/json",
        "multipart/form-data",
        "multipart/form-data; boundary=",
        'multipart/form-data; boundary=""',
        'multipart/form-data; boundary="ends with blank "',
        "multipart/form-data; boundary=" + "x" * 71,
        "multipart/form-data; boundary=é",
        "multipart/form-data; boundary=a; boundary=b",
        "multipart/mixed; boundary=a",
    ],
)
def test_what_is_no_boundary(content_type):
    with pytest.raises(MultipartError, match="multipart/form-data with a boundary"):
        parse_boundary(content_type)


def test_a_boundary_is_looked_for_in_no_time():
    parse_boundary('multipart/form-data; boundary="' + "a" * 70 + '"')
    with pytest.raises(MultipartError):
        parse_boundary("multipart/form-data" + " " * 5_000 + ";" + " " * 5_000)


# CVE-2025-48067 and CVE-2026-54134: OctoPrint took the place of the uploaded file from fields, then from the
# query. Here no field and no parameter has such a meaning: the file is the stream.


@pytest.mark.parametrize("name", ["file.path", "file.name", "file.content_type", "file.size", "file[path]"])
def test_no_field_can_name_a_file_of_the_server(name):
    with pytest.raises(MultipartError, match="name must be"):
        read(body(part(f'name="{name}"', b"/etc/passwd")))
    with pytest.raises(MultipartError, match="name must be"):
        read(body(FILE, part(f'name="{name}"', b"/etc/passwd")))


@pytest.mark.parametrize("name", ["path", "filename", "file_path", "filepath", "tmp", "upload"])
def test_a_field_with_a_path_is_a_text(name):
    form, content = read(body(part(f'name="{name}"', b"/etc/passwd"), FILE))
    assert (content, form.fields) == (b"G28\n", {name: "/etc/passwd"})
    with pytest.raises(MultipartError, match="a file must be given"):
        read(body(part(f'name="{name}"', b"/etc/passwd")))


def test_a_form_in_another_encoding_is_no_upload():
    for content_type in ("application/x-www-form-urlencoded", "application/json"):
        with pytest.raises(MultipartError):
            read(b"file=x&file.path=/etc/passwd", content_type=content_type)


def test_the_query_is_not_looked_at():
    # The reader is given nothing but the body and its type: that is what keeps it so.
    names = read_upload.__code__.co_varnames[: read_upload.__code__.co_argcount]
    assert names == ("receive", "content_type", "sink", "max_bytes", "file_field")
    assert not re.search(
        r"open\(|Path|query", (module.__spec__.loader.get_source(module.__name__)).split('"""', 2)[2]
    )


# Bounds


def test_a_file_that_is_too_long():
    assert read(body(part('name="file"; filename="a"', b"x" * 100)), max_bytes=100)[1] == b"x" * 100
    with pytest.raises(BodyTooLargeError, match="file must be at most 100 bytes"):
        read(body(part('name="file"; filename="a"', b"x" * 101)), max_bytes=100)


def test_a_body_that_never_ends_is_given_up():
    async def main():
        given = 0

        async def receive():
            nonlocal given
            given += 65536
            return {"type": "http.request", "body": b"x" * 65536, "more_body": True}

        async def sink(_):
            pass

        start, field = FILE[: -len(b"G28\n\r\n")], part('name="x"', b"")[:-2]
        for first, limit in ((start, 1_100_000), (field, 65536), (b"", 65536), (b"--XX\r\n", 65536)):
            given = 0
            pieces = iter([first] if first else [])

            async def feed(pieces=pieces):
                piece = next(pieces, None)
                if piece is not None:
                    return {"type": "http.request", "body": piece, "more_body": True}
                return await receive()

            with pytest.raises(BodyError):
                await read_upload(feed, TYPE, sink, 1_000_000)
            assert given <= limit

    asyncio.run(main())


def test_empty_pieces_for_ever_are_given_up(monkeypatch):
    monkeypatch.setattr(module, "SLOW_AFTER", 0.05)

    async def receive():
        await asyncio.sleep(0.001)
        return {"type": "http.request", "body": b"", "more_body": True}

    with pytest.raises(ClientGoneError, match="too slowly"):
        asyncio.run(read_upload(receive, TYPE, None, 100))


def test_a_client_that_sends_nothing_is_given_up(monkeypatch):
    monkeypatch.setattr(module, "READ_TIMEOUT", 0.02)
    client = Client([], gone=False)
    with pytest.raises(ClientGoneError, match="did not come"):
        asyncio.run(read_upload(client.receive, TYPE, None, 100))


def test_the_next_piece_is_read_when_the_last_was_taken():
    content = b"x" * 5_000
    data = body(part('name="file"; filename="a"', content))
    client = Client(pieces_of(data, 100))

    async def main():
        ahead, taken = [], 0

        async def sink(piece):
            nonlocal taken
            assert len(piece) <= 200
            given = client.given
            await asyncio.sleep(0)
            taken += len(piece)
            ahead.append(client.given * 100 - taken)
            assert client.given == given

        await read_upload(client.receive, TYPE, sink, 10_000)
        assert max(ahead) < 300

    asyncio.run(main())


def test_what_the_sink_raises_ends_the_reading():
    async def sink(_):
        raise OSError("disk full")

    client = Client(pieces_of(FILE + FILE, 20))
    with pytest.raises(OSError, match="disk full"):
        asyncio.run(read_upload(client.receive, TYPE, sink, 1000))
    assert client.given < len(client.pieces)
