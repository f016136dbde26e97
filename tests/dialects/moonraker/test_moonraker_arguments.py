"""Arguments: from what is on the wire to the struct of a call, without a server."""

import json
from collections.abc import Callable
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlencode

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolpost.dialects.moonraker.arguments import compile_params
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.query import MAX_FIELDS, decode_arguments

JSON = "application/json"
FORM = "application/x-www-form-urlencoded"
MULTIPART = "multipart/form-data; boundary=X"


class Params(msgspec.Struct):
    filenames: list[str]
    reset: bool = False
    count: int = 1
    speed: float | None = None
    name: str = ""
    numbers: list[int] = []
    objects: dict[str, Any] = {}
    anything: Any = None
    kind: Literal["web", "other"] = "web"
    few: Annotated[int, msgspec.Meta(ge=0, le=10)] = 0
    either: int | bool | None = None
    all_of_it: bool | msgspec.UnsetType = msgspec.field(name="all", default=msgspec.UNSET)


convert = compile_params(Params)


def refused(**params: Any) -> str:
    with pytest.raises(RpcError) as caught:
        convert({"filenames": [], **params})
    assert caught.value.status == caught.value.rpc_code == 400
    return caught.value.message


def outcome(call: Callable[[], Any]) -> tuple[RpcError | None, Any]:
    try:
        return None, call()
    except RpcError as error:
        return error, None


def test_missing() -> None:
    with pytest.raises(RpcError, match=r"^No data for argument: filenames$"):
        convert({"filename": "a"})
    assert convert({"filenames": [], "unknown": 1}) == Params([])


@pytest.mark.parametrize(
    ("sent", "taken"),
    [
        ("a.gcode", ["a.gcode"]),
        ("a.gcode, b c.gcode ,", ["a.gcode", "b c.gcode"]),
        ("", []),
        (" , ,", []),
        ([], []),
        (["a,b"], ["a,b"]),
        (["", "  "], ["", "  "]),
    ],
)
def test_lists(sent: Any, taken: list[str]) -> None:
    assert convert({"filenames": sent}).filenames == taken


@pytest.mark.parametrize(
    ("sent", "found"), [(None, "NoneType"), (5, "int"), (True, "bool"), ({}, "dict"), (1.5, "float")]
)
def test_what_is_no_list(sent: Any, found: str) -> None:
    expected = f"Invalid value received for argument 'filenames'.  Expected List type, received {found}"
    assert refused(filenames=sent) == expected


@pytest.mark.parametrize("sent", [[1], [None], [["a.gcode"]], ["a", 1]])
def test_lists_of_something_else(sent: list[Any]) -> None:
    kind = "Invalid list format for argument 'filenames', expected all values to be of type str."
    assert refused(filenames=sent) == kind


def test_lists_of_numbers() -> None:
    assert convert({"filenames": [], "numbers": "1, 2,3"}).numbers == [1, 2, 3]
    assert convert({"filenames": [], "numbers": [1, 2]}).numbers == [1, 2]
    assert "[numbers] to <class 'int'>: value received: x" in refused(numbers="1,x")
    assert "of type int" in refused(numbers=[True])


@pytest.mark.parametrize("sent", [True, "true", "True", "TRUE"])
def test_true(sent: Any) -> None:
    assert convert({"filenames": [], "reset": sent, "all": sent}) == Params([], reset=True, all_of_it=True)


@pytest.mark.parametrize("sent", [1, 0, None, "yes", "1", "", [], 1.5, {}, "true "])
def test_what_is_no_bool(sent: Any) -> None:
    assert refused(reset=sent) == (
        f"Unable to convert argument [reset] to <class 'bool'>: value received: {sent}"
    )
    assert refused(all=sent).startswith("Unable to convert argument [all] to")


@pytest.mark.parametrize(("sent", "taken"), [(5, 5), ("5", 5), (" -5 ", -5), (5.0, 5)])
def test_ints(sent: Any, taken: int) -> None:
    assert convert({"filenames": [], "count": sent}).count == taken


@pytest.mark.parametrize("sent", [True, None, 5.5, "5.5", "", "1_000", "9" * 5000, "0x5", [], float("inf")])
def test_what_is_no_int(sent: Any) -> None:
    message = refused(count=sent)
    assert message.startswith("Unable to convert argument [count] to <class 'int'>: value received: ")
    assert len(message) < 300


@pytest.mark.parametrize("sent", ["nan", "inf", "1e999", True, "1_0.0", [], "x", 10**400])
def test_what_is_no_float(sent: Any) -> None:
    assert "[speed] to <class 'float'>" in refused(speed=sent)


def test_floats_strings_and_null() -> None:
    taken = convert({"filenames": [], "speed": "1e3", "name": 5})
    assert (taken.speed, taken.name) == (1000.0, "5")
    assert convert({"filenames": [], "speed": None, "either": None}).speed is None
    for sent in (None, True, [], {}):
        assert "[name] to <class 'str'>" in refused(name=sent)


def test_other_types() -> None:
    taken = convert({"filenames": [], "objects": {"a": None}, "anything": [1], "kind": "other", "few": "7"})
    assert (taken.objects, taken.anything, taken.kind, taken.few) == ({"a": None}, [1], "other", 7)
    assert "[objects] to <class 'dict'>" in refused(objects="x")
    assert refused(kind="x").startswith("Invalid value received for argument 'kind'.  ")
    assert refused(few=11) == "Invalid value received for argument 'few'.  Expected `int` <= 10"
    assert "argument 'either'" in refused(either=[])


NAMES = [field.encode_name for field in msgspec.structs.fields(Params)]
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
VALUES = SCALARS | st.lists(SCALARS, max_size=3) | st.dictionaries(st.text(), SCALARS, max_size=2)


@given(st.dictionaries(st.sampled_from(NAMES), VALUES))
def test_whatever_is_sent_is_taken_or_refused_by_name(params: dict[str, Any]) -> None:
    error, taken = outcome(lambda: convert(params))
    if error is not None:
        assert error.code == 400
        assert any(name in error.message for name in ["filenames", *params])
        msgspec.json.encode(error.message)
    else:
        assert all(isinstance(name, str) for name in taken.filenames)
        assert isinstance(taken.reset, bool)
        assert type(taken.count) is int
        assert 0 <= taken.few <= 10


# From HTTP


@pytest.mark.parametrize(
    ("query", "arguments"),
    [
        ("", {}),
        ("filenames=a&filenames=b", {"filenames": "b"}),
        ("a=x+y%20z", {"a": "x y z"}),
        ("a=%C3%BC%2C", {"a": "ü,"}),
        ("toolhead&print_stats=state,filename", {"toolhead": "", "print_stats": "state,filename"}),
        ("a=", {"a": ""}),
        ("filenames:json=%5B%22a.gcode%22%5D", {"filenames": ["a.gcode"]}),
        ("filenames=%5B%22a.gcode%22%5D", {"filenames": '["a.gcode"]'}),
        ("a:int=5&b:float=5&c:bool=True&d:str=5", {"a": 5, "b": 5.0, "c": True, "d": "5"}),
        ("a:array_int=1,2&b:array_str=x, y", {"a": [1, 2], "b": ["x", "y"]}),
        ("a:=5&b:what=5&c:array_=1", {"a:": "5", "b:what": "5", "c:array_": "1"}),
        ("a:json=null", {"a": None}),
    ],
)
def test_queries(query: str, arguments: dict[str, Any]) -> None:
    query = query.replace(" ", "%20")
    assert decode_arguments(query.encode(), "", b"") == arguments
    assert decode_arguments(b"", FORM, query.encode()) == arguments


@pytest.mark.parametrize(
    "query",
    [b"a=%ff", b"a=\xff", b"a:int=x", b"a:bool=1", b"a:json=[", b"a:array_int=x", b"a:json=" + b"[" * 9000,
     b"&".join([b"a=1"] * (MAX_FIELDS + 1))],
)  # fmt: skip
def test_queries_that_are_refused(query: bytes) -> None:
    with pytest.raises(RpcError) as caught:
        decode_arguments(query, "", b"")
    assert caught.value.code == 400
    assert len(caught.value.message) < 300


@pytest.mark.parametrize("kind", [JSON, "application/json; charset=UTF-8", "Application/JSON"])
def test_json_goes_over_the_query(kind: str) -> None:
    assert decode_arguments(b"a=1&b=2", kind, b'{"b": [3], "c": null}') == {"a": "1", "b": [3], "c": None}
    assert decode_arguments(b"a=1", kind, b" \n") == {"a": "1"}


@pytest.mark.parametrize("kind", ["", "text/plain", "application/octet-stream"])
def test_bodies_of_other_types_are_ignored(kind: str) -> None:
    assert decode_arguments(b"a=1", kind, b'{"a": 2}') == {"a": "1"}


@pytest.mark.parametrize(
    "body", [b"[]", b'"a"', b"null", b"5", b"{", b"\xff", b'{"a": NaN}', b"[" * 9000, b'{"a": 1e999}']
)
def test_json_that_is_refused(body: bytes) -> None:
    with pytest.raises(RpcError, match=r"^Invalid JSON in the body: ") as caught:
        decode_arguments(b"filenames=a", JSON, body)
    assert caught.value.code == 400


def part(name: str, value: str, more: str = "") -> str:
    return f'--X\r\nContent-Disposition: form-data; name="{name}"{more}\r\n\r\n{value}\r\n'


def test_multipart() -> None:
    body = part("a", "x,y") + part("b", "ü\r\n--Y") + part("f", "content", '; filename="f.gcode"')
    body += part("a", "last") + part("n:int", "5") + "--X--\r\nwhatever"
    expected = {"a": "last", "b": "ü\r\n--Y", "n": 5, "q": "1"}
    assert decode_arguments(b"q=1&a=2", MULTIPART, body.encode()) == expected


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("multipart/form-data", part("a", "x") + "--X--"),
        (MULTIPART, "nothing of the kind"),
        (MULTIPART, part("a", "x")),
        (MULTIPART, "--X\r\n\r\nx\r\n--X--"),
        (MULTIPART, '--X\r\nContent-Disposition: form-data; name=""\r\n\r\nx\r\n--X--'),
        (MULTIPART, "--X\r\nContent-Disposition: form-data\r\n--X--"),
        (MULTIPART, "--Xtra" + part("a", "x")[3:] + "--X--"),
        (MULTIPART, part("a" * 5000, "x") + "--X--"),
        (MULTIPART, part("a", "x") * (MAX_FIELDS + 1) + "--X--"),
        ('multipart/form-data; boundary="ü"', part("a", "x")),
    ],
)
def test_multipart_that_is_refused(kind: str, body: str) -> None:
    with pytest.raises(RpcError, match=r"^Invalid form: "):
        decode_arguments(b"", kind, body.encode())


@given(st.dictionaries(st.text(min_size=1).filter(lambda name: ":" not in name), st.text()))
def test_what_is_encoded_comes_out(arguments: dict[str, str]) -> None:
    encoded = urlencode(arguments, quote_via=quote).encode()
    assert decode_arguments(encoded, "", b"") == arguments
    assert decode_arguments(b"", FORM, encoded) == arguments
    assert decode_arguments(b"", JSON, json.dumps(arguments).encode()) == arguments


@given(st.binary(), st.sampled_from(["", JSON, FORM, MULTIPART]), st.binary())
def test_hostile_bytes(query: bytes, kind: str, body: bytes) -> None:
    for content in (body, b'--X\r\nContent-Disposition: form-data; name="' + body + b"\r\n--X--"):
        error, arguments = outcome(lambda content=content: decode_arguments(query, kind, content))
        if error is not None:
            assert error.code == 400
        else:
            msgspec.json.encode(arguments)
