"""Whatever is sent, the answer is quick, bounded and, if the request is malformed, names the field."""

import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from toolpost.dialects.spooler.api import MAX_VALUES

ENDPOINTS = [
    "/write-line",
    "/get-ps",
    "/status",
    "/cancel",
    "/set-init",
    "/get-init",
    "/add-job",
    "/list-jobs",
    "/query-ts",
]

GOOD = {
    "/write-line": {"line": '"?pos"'},
    "/get-ps": {"tag": '"queue"'},
    "/set-init": {"lines": '["set a 1"]'},
    "/add-job": {"commands": '["G0 X1"]'},
    "/query-ts": {"query": '["queue.num"]', "start": "1000", "end": "1001", "step": "1"},
}

NO_TEXT = ["5", "1.5", "true", "[]", "{}", "null", '["x"]', '"\\ud800"', '"\\x"', "NaN", "x"]
NO_FLAG = ["1", "0", '"true"', "[]", "{}", "TRUE"]
NO_COUNT = ['"1"', "1.5", "true", "[]", "{}", "0", "-1", "10001", "9" * 20, "9" * 400, "1e400", "NaN"]
NO_LINES = [
    '"G0"',
    "5",
    "{}",
    "true",
    "[1]",
    "[null]",
    '[["G0"]]',
    "[{}]",
    '["G0",5]',
    "[NaN]",
    '["G0"',
    "[,]",
]
NO_COMMANDS = [
    *NO_LINES,
    '["?pos"]',
    '["!"]',
    '[" !"]',
    '["\\t?pos"]',
    '["G0\\nG1"]',
    '["G0\\rG1"]',
    '["G0\\u0000"]',
    '["G0\\u001b"]',
    '["G0\\u007f"]',
    '["G0 \\u00e9"]',
    '["G0 \\ud83d\\ude00"]',
    f'["{"G" * 101}"]',
]
NO_INTERVALS = [
    "[]",
    "5",
    '"?pos"',
    "true",
    '{"?pos":"1"}',
    '{"?pos":null}',
    '{"?pos":true}',
    '{"?pos":[]}',
    '{"?pos":0}',
    '{"?pos":-1}',
    '{"?pos":1e-6}',
    '{"?pos":0.019}',
    '{"?pos":1e9}',
    '{"?pos":1e400}',
    '{"?pos":NaN}',
    '{"!":1}',
    '{" ! ":1}',
    '{"":1}',
    '{"; ?pos":1}',
    '{"?pos\\n":1}',
    '{"?\\u00e9":1}',
    json.dumps({"?" * 101: 1}),
    json.dumps({f"?p{i}": 1 for i in range(65)}),
]
NO_TIME = ['"1"', "true", "null", "[]", "{}", "-1", "-1e-9", "NaN", "Infinity", "-Infinity", "1e400", "0x10"]

BAD = [
    *[("/write-line", "line", text) for text in NO_TEXT],
    *[("/write-line", "line", json.dumps(text)) for text in ("G0\nG1", "G0\n", "G0\0", "é", "G" * 101)],
    *[
        ("/write-line", "line", json.dumps(text))
        for text in ("G0 ;" + "c" * 97, "\x1b[2J", "G0\x08", "G0 \x7f")
    ],
    *[("/write-line", "high_prio", text) for text in NO_FLAG],
    *[("/get-ps", "tag", text) for text in [*NO_TEXT, '""']],
    *[("/get-ps", "count", text) for text in NO_COUNT],
    *[("/set-init", "lines", text) for text in NO_COMMANDS],
    *[("/set-init", "content", text) for text in NO_COMMANDS],
    *[("/add-job", "commands", text) for text in [*NO_COMMANDS, "null"]],
    *[("/add-job", "signals", text) for text in [*NO_INTERVALS, '{"G0":1}', '{"get":1}']],
    *[("/add-job", "polls", text) for text in NO_INTERVALS],
    *[("/query-ts", field, text) for field in ("start", "end", "step") for text in NO_TIME],
    ("/query-ts", "step", "0"),
    ("/query-ts", "step", "1e-5"),
    ("/query-ts", "end", "999"),
    ("/query-ts", "end", "1e300"),
    *[("/query-ts", "query", text) for text in [*NO_LINES, "[]", "null"]],
    ("/query-ts", "query", json.dumps([f"a.k{i}" for i in range(1001)])),
]
LITERALS_THAT_ARE_NO_JSON = ("NaN", "Infinity", "x", "TRUE", "0x10", "[,]", '["G0"', '"\\x"', '"\\ud800"')


def body(endpoint: str, field: str, literal: str) -> str:
    fields = {**GOOD[endpoint], field: literal}
    if field == "content":
        del fields["lines"]
    return "{" + ",".join(f'"{name}":{text}' for name, text in fields.items()) + "}"


@pytest.mark.parametrize(("endpoint", "field", "literal"), BAD, ids=lambda value: str(value)[:30])
def test_wrong_value_is_400_and_names_the_field(bench, received, endpoint, field, literal):
    answer = bench.client.post(endpoint, body(endpoint, field, literal))
    assert answer.status == 400, answer
    assert answer.headers["content-type"] == "text/plain; charset=utf-8"
    assert answer.text.startswith("invalid request: ")
    assert len(answer.text) < 400
    is_json = not any(text in literal for text in LITERALS_THAT_ARE_NO_JSON)
    named = {"step", "steps"} if field in {"start", "end", "step"} else {field}
    assert any(name in answer.text for name in named | ({field} if is_json else {"invalid JSON"})), (
        answer.text
    )
    assert received() == []


@pytest.mark.parametrize(
    ("endpoint", "field"),
    [
        ("/write-line", "line"),
        ("/get-ps", "tag"),
        ("/set-init", "lines"),
        ("/add-job", "commands"),
        ("/query-ts", "query"),
        ("/query-ts", "step"),
    ],
)
def test_missing_field_is_named(bench, endpoint, field):
    request = {name: json.loads(text) for name, text in GOOD[endpoint].items() if name != field}
    answer = bench.client.post(endpoint, request)
    assert (answer.status, field in answer.text) == (400, True), answer


def test_index_of_a_bad_line_is_named(bench):
    answer = bench.client.post("/add-job", {"commands": ["G0 X1"] * 20_000 + ["G0 \x07"] + ["G0"] * 5})
    assert answer.text == "invalid request: commands[20000]: must be printable ASCII (0x20-0x7e)"
    answer = bench.client.post("/set-init", {"content": ["set a 1", "!"]})
    assert answer.text.startswith("invalid request: content[1]: ")
    commands = ["G0 X1"] * 20_000
    answer = bench.client.post("/add-job", {"commands": [*commands, 5]})
    assert answer.text.startswith("invalid request: commands")
    assert "[20000]" in answer.text


MALFORMED = {
    "empty": b"",
    "blank": b" \r\n",
    "no JSON": b"hello",
    "array": b"[]",
    "array of objects": b"[{}]",
    "string": b'"x"',
    "number": b"5",
    "true": b"true",
    "unclosed": b'{"a":',
    "single quotes": b"{'a':1}",
    "trailing comma": b'{"a":1,}',
    "trailing garbage": b"{} xyz",
    "two objects": b"{}{}",
    "BOM": b"\xef\xbb\xbf{}",
    "UTF-16": '{"a":1}'.encode("utf-16"),
    "invalid UTF-8": b'{"line":"\xff","tag":"\xff","lines":["\xff"],"commands":["\xff"],"query":["\xff"]}',
    "overlong UTF-8": b'{"line":"\xc0\x80","tag":"\xc0\x80","commands":["\xc0\x80"],"query":["\xc0\x80"]}',
    "NUL": b'{"a":\x00}',
    "NUL after": b"{}\x00",
    "100,000 arrays": b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "100,000 objects": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "100,000 open arrays": b"[" * 100_000,
}
for name in ("line", "tag", "lines", "commands", "query", "signals", "start"):
    MALFORMED[f"100,000 arrays in {name}"] = b'{"%s":%s%s}' % (name.encode(), b"[" * 100_000, b"]" * 100_000)


@pytest.mark.parametrize("endpoint", ENDPOINTS)
@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_body_is_400(bench, endpoint, name):
    answer = bench.client.post(endpoint, MALFORMED[name])
    # Calls that take nothing ignore unknown fields, what they hold included.
    unread = MALFORMED[name].startswith(b'{"') and name not in {"unclosed", "trailing comma"}
    assert answer.status in ({200, 400} if unread else {400}), answer
    if answer.status == 400:
        assert answer.text.startswith("invalid request: ")
        assert len(answer.text) < 400


@pytest.mark.parametrize("endpoint", ENDPOINTS)
@pytest.mark.parametrize("method", ["GET", "PUT", "DELETE", "PATCH"])
def test_other_methods_are_400(bench, endpoint, method):
    answer = bench.client.request(method, endpoint, b"{}", {"Content-Type": "application/json"})
    assert answer.status == 400
    assert "POST" in answer.text


@pytest.mark.parametrize("endpoint", ENDPOINTS)
def test_megabyte_string_in_every_field(bench, endpoint):
    big = "x" * 1_000_000
    names = ["line", "tag", "count", "lines", "commands", "signals", "query", "start", "other"]
    answer = bench.client.post(endpoint, dict.fromkeys(names, big))
    assert answer.status in {200, 400}
    assert len(answer.body) < 10_000


def test_megabyte_names_are_not_echoed(bench):
    big = "x" * 1_000_000
    for endpoint, request in [
        ("/add-job", {"commands": ["G0"], "signals": {big: 1}}),
        ("/add-job", {"commands": ["G0"], "signals": {"?" + big: 0}}),
        ("/add-job", {"commands": ["G0"], "signals": {big: "x"}}),
        ("/add-job", {"commands": ["G0"], "polls": {big: 1}}),
        ("/add-job", {"commands": [big]}),
        ("/set-init", {"lines": [big]}),
        ("/write-line", {"line": big}),
    ]:
        answer = bench.client.post(endpoint, request)
        assert answer.status == 400, endpoint
        assert len(answer.body) < 1000, endpoint


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)
plausible = st.sampled_from(["?pos", "get", "set a 1", "queue.num", "queue", "G0 X1", "! ; x", "", " "])
values = json_values | plausible | st.lists(plausible) | st.dictionaries(plausible, st.floats(0, 100))
names = st.sampled_from(
    ["line", "high_prio", "tag", "count", "lines", "content", "commands", "signals", "polls"]
)
names |= st.sampled_from(["start", "end", "step", "query"])
requests = st.dictionaries(names | st.text(max_size=5), values, max_size=6) | json_values


@pytest.mark.parametrize("endpoint", ENDPOINTS)
@settings(
    max_examples=60,
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(request=requests)
def test_no_json_body_is_a_5xx(bench, endpoint, request):
    answer = bench.client.post(endpoint, json.dumps(request).encode())
    assert answer.status in {200, 400}, answer
    if answer.status == 200:
        assert isinstance(answer.json, dict)


@pytest.mark.parametrize("endpoint", ENDPOINTS)
@settings(
    max_examples=40,
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(request=st.binary(max_size=64))
def test_no_bytes_are_a_5xx(bench, endpoint, request):
    assert bench.client.post(endpoint, request).status in {200, 400}


KILLERS = [
    {"start": 1000, "end": 1000, "step": 1e-10},
    {"start": 0, "end": 100, "step": 1e30},
    {"start": 0, "end": 0, "step": 5e-324},
    {"start": 1e300, "end": 1e300, "step": 1e-300},
    {"start": 1.7e308, "end": 1.7e308, "step": 1.7e308},
    {"start": 1795328391.5, "end": 1795328391.5, "step": 1e-10},
]


@pytest.mark.parametrize("times", KILLERS, ids=str)
def test_queries_that_killed_the_original_have_one_sample(bench, times):
    """docs/reference/spooler-api.md B1."""
    answer = bench.client.call("/query-ts", query=["a", "queue.num"], **times)
    assert answer["times"] == pytest.approx([times["start"]])
    assert [len(series) for series in answer["values"].values()] == [1, 1]


def test_query_is_bounded_in_keys_times_steps(bench):
    keys = [f"a.k{i}" for i in range(1000)]
    steps = MAX_VALUES // len(keys)
    request = {"query": keys, "start": 0, "end": steps - 1, "step": 1}
    assert bench.client.post("/query-ts", request).status == 200
    answer = bench.client.post("/query-ts", {**request, "end": steps})
    assert (answer.status, "query" in answer.text) == (400, True)
    assert bench.client.post("/query-ts", {"query": keys, "start": 0, "end": 1e9, "step": 1}).status == 400
