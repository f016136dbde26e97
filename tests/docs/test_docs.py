"""The documentation agrees with the code."""

import inspect
import json
import re
import shlex
import time
import tomllib
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import msgspec
import pytest

from tests.docs.pages import PAGES, ROOT, Block, anchors, blocks, name, prose, rows, sections, words_in_code
from tests.harness import Client, Server, wait_until
from toolpost import commlog, shop
from toolpost.cli import main
from toolpost.config import Config, parse
from toolpost.core.job import _NEXT, Job, JobState, Reason
from toolpost.dialects.spooler import api
from toolpost.dialects.spooler.routes import spooler_routes
from toolpost.drivers.spark import driver, flow, framing, lines, pacing, pstate, sender
from toolpost.http import body, gate, server
from toolpost.http.body import BodyReader
from toolpost.links import net
from toolpost.sim import execution as sim_execution
from toolpost.sim import faults
from toolpost.sim import lines as sim_lines
from toolpost.sim import spark as sim_spark
from toolpost.telemetry import service, store

REFERENCE = ROOT / "docs" / "reference"
EXAMPLES = sorted((ROOT / "docs" / "examples").glob("*.toml"))


# Configuration


def tables(kind: type, path: str = "") -> Iterator[tuple[str, msgspec.structs.FieldInfo]]:
    """Every key of the configuration with the path of its table; machines are called NAME."""
    for field in msgspec.structs.fields(kind):
        inner, where = field.type, field.name
        if typing.get_origin(inner) is dict:
            inner, where = typing.get_args(inner)[1], f"{field.name}.NAME"
        if isinstance(inner, type) and issubclass(inner, msgspec.Struct):
            yield from tables(inner, f"{path}.{where}".strip("."))
        else:
            yield path, field


KEYS = list(tables(Config))


def documented_keys() -> dict[str, dict[str, list[str]]]:
    found = {}
    for heading, text in sections(REFERENCE / "configuration.md").items():
        keys = {cells[0].strip("`"): cells for cells in rows(text) if len(cells) == 5}
        if keys:
            found[heading] = keys
    return found


def shown(field: msgspec.structs.FieldInfo) -> str:
    """A key's default as the table writes it."""
    if field.required:
        return "required"
    value = field.default
    if value is None:
        return "none"
    return f"`{json.dumps(list(value) if isinstance(value, tuple) else value)}`"


@pytest.mark.parametrize(("table", "field"), KEYS, ids=lambda value: getattr(value, "name", value))
def test_each_key_has_its_row_and_default(table: str, field: msgspec.structs.FieldInfo):
    cells = documented_keys()[table][field.name]
    assert cells[2] == shown(field)
    kinds = {bool: "boolean", int: "integer", float: "number", str: "string"}
    kind = next((word for word in (kinds.get(part) for part in plain_types(field.type)) if word), None)
    if typing.get_origin(field.type) is not tuple and kind:
        assert cells[1].startswith(kind)
    if typing.get_origin(field.type) is typing.Literal:
        for choice in typing.get_args(field.type):
            assert f"`{choice}`" in cells[3]


def plain_types(kind: Any) -> Iterator[Any]:
    """The types in a union or behind an annotation."""
    if typing.get_origin(kind) in {types.UnionType, typing.Union, typing.Annotated}:
        for part in typing.get_args(kind):
            yield from plain_types(part)
    else:
        yield kind


def test_no_other_key_is_documented():
    known = {(table, field.name) for table, field in KEYS}
    assert {(table, key) for table, keys in documented_keys().items() for key in keys} == known


def as_whole(tree: dict[str, Any]) -> dict[str, Any]:
    """A fragment with the least that makes a configuration of it."""
    machines = tree.setdefault("machines", {"edm": {}})
    for machine in machines.values():
        machine.setdefault("driver", "spark")
        machine.setdefault("link", "sim")
    return tree


@pytest.mark.parametrize("block", blocks("toml"), ids=lambda block: name(block.page))
def test_each_toml_block_is_a_configuration(block: Block):
    tree = tomllib.loads(block.text)
    parse(as_whole(tree) if block.info == "toml fragment" else tree)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_each_example_is_a_configuration(path: Path):
    parse(tomllib.loads(path.read_text("utf-8")))


# Command line


def commands(group: click.Group, path: str = "toolpost") -> Iterator[tuple[str, click.Command]]:
    context = click.Context(group)
    yield path, group
    for word in group.list_commands(context):
        command = group.get_command(context, word)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, f"{path} {word}")
        else:
            yield f"{path} {word}", command


COMMANDS = dict(commands(main))


@pytest.mark.parametrize("path", COMMANDS)
def test_each_command_and_option_is_documented(path: str):
    text = sections(REFERENCE / "command-line.md")[path]
    table = {cells[0].strip("`"): cells for cells in rows(text)}
    for parameter in COMMANDS[path].params:
        if isinstance(parameter, click.Argument):
            assert f"{path} {parameter.name.upper()}" in text
            continue
        if parameter.name == "help":
            continue
        cells = table[parameter.opts[0]]
        default = parameter.default
        if isinstance(default, int | float) and not isinstance(default, bool):
            assert cells[1] == f"`{default}`"


def test_no_other_option_is_documented():
    for path, command in COMMANDS.items():
        known = {option for parameter in command.params for option in parameter.opts} | {"--help"}
        text = sections(REFERENCE / "command-line.md")[path]
        shown_options = {cells[0].strip("`") for cells in rows(text)}
        assert {option for option in shown_options if option.startswith("--")} <= known


def shell_lines() -> list[tuple[str, str]]:
    return [
        (name(block.page), line.strip())
        for block in blocks("sh")
        for line in block.text.replace("\\\n", " ").splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]


COMMAND_LINE = re.compile(r"(?:sudo (?:-u \w+ )?)?(?:[\w./-]*/)?toolpost (?P<arguments>.+)")


def invocations() -> Iterator[tuple[str, tuple[str, ...]]]:
    """The arguments of every ``toolpost ...`` that a page shows, in a block or between backticks, by page."""
    for page, line in shell_lines():
        if match := COMMAND_LINE.fullmatch(line):
            yield page, tuple(shlex.split(match["arguments"]))
    for block in blocks("ini"):
        for line in block.text.splitlines():
            if line.startswith("ExecStart=") and (
                match := COMMAND_LINE.fullmatch(line.removeprefix("ExecStart="))
            ):
                yield name(block.page), tuple(shlex.split(match["arguments"]))
    for page in PAGES:
        for word in words_in_code(prose(page)):
            if word.startswith("toolpost ") and "..." not in word:
                yield name(page), tuple(shlex.split(word)[1:])


INVOCATIONS = sorted(set(invocations()))


@pytest.mark.parametrize(
    ("page", "arguments"),
    INVOCATIONS,
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else value,
)
def test_each_command_line_is_understood(
    page: str, arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
):
    assert page
    for command in COMMANDS.values():
        if not isinstance(command, click.Group):
            monkeypatch.setattr(command, "callback", lambda **_: None)
    if " ".join(["toolpost", *arguments]) in COMMANDS:
        return  # the name of a command or group, in running text
    main.main(list(arguments), prog_name="toolpost", standalone_mode=False)


def test_shell_blocks_show_command_lines():
    assert len(INVOCATIONS) > 10
    assert any(page.endswith("run-as-a-service.md") and "--config" in line for page, line in INVOCATIONS)


MAKE_TARGETS = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))


def test_each_make_target_exists_and_is_documented():
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    assert set(re.findall(r"`make (\w+)`", text)) == MAKE_TARGETS
    for _, line in shell_lines():
        if line.startswith("make "):
            assert line.split()[1] in MAKE_TARGETS


# The API

ENDPOINTS = {
    route.path: route
    for route in spooler_routes(api.SpoolerApi(typing.cast("Any", None), "edm", "FAILED"), BodyReader(1, 1))
}


@pytest.mark.parametrize("path", ENDPOINTS)
def test_each_endpoint_and_field_is_documented(path: str):
    text = sections(REFERENCE / "spooler-api.md")[f"POST {path}"]
    documented = {word for cells in rows(text) for word in words_in_code(cells[0])}
    handler = getattr(api.SpoolerApi, path.strip("/").replace("-", "_"))
    hints = typing.get_type_hints(handler)
    known = fields(hints["request"]) | fields(hints["return"])
    if path == "/get-ps":
        known |= {"time", "kv"}
    assert documented == known - {"spooler", "core"}


def fields(kind: Any) -> set[str]:
    """The names in a request or answer, and in the structs that it lists."""
    found = set()
    for field in msgspec.structs.fields(kind):
        found.add(field.name)
        for part in [field.type, *typing.get_args(field.type)]:
            if isinstance(part, type) and issubclass(part, msgspec.Struct):
                found |= fields(part)
    return found


def test_no_other_endpoint_is_documented():
    headings = sections(REFERENCE / "spooler-api.md")
    assert {heading.removeprefix("POST ") for heading in headings if heading.startswith("POST ")} == set(
        ENDPOINTS
    )


@pytest.mark.parametrize("block", blocks("json"), ids=lambda block: name(block.page))
def test_each_json_block_is_json(block: Block):
    json.loads(block.text)


# Job states


def test_job_states_and_their_names_are_documented():
    text = sections(REFERENCE / "job-states.md")["States"]
    documented = {cells[0].strip("`"): cells[2] for cells in rows(text)}
    assert set(documented) == {state.value for state in JobState}
    names = {**api._STATUS, JobState.ABORTED: "FAILED"}
    for state in JobState:
        assert documented[state.value].startswith(f"`{names[state]}`")


def test_reasons_are_documented():
    text = sections(REFERENCE / "job-states.md")["Reasons"]
    assert sorted(cells[0].strip("`") for cells in rows(text)) == sorted(Reason)
    given = {reason for reason in Reason if is_given(reason)}
    for cells in rows(text):
        assert ("is not given by this version" in cells[2]) == (Reason(cells[0].strip("`")) not in given), (
            cells
        )


def is_given(reason: Reason) -> bool:
    """Whether a job can have this reason: it begins with it, or a module gives it."""
    if reason is next(field.default for field in msgspec.structs.fields(Job) if field.name == "reason"):
        return True
    use = re.compile(rf"\bReason\.{reason.name}\b")
    return any(use.search(path.read_text("utf-8")) for path in (ROOT / "src").rglob("*.py"))


def test_documented_transitions_are_allowed():
    text = sections(REFERENCE / "job-states.md")["Transitions"]
    for before, after, _ in rows(text):
        target = JobState(after.strip("`"))
        if before:
            assert target in _NEXT[JobState(before.strip("`"))]
        else:
            assert target is JobState.PENDING


# Limits

LIMITS: list[tuple[str, float, str]] = [
    ("pause within a body", body.READ_TIMEOUT, "s"),
    ("head of a request", server.MAX_HEAD / 1024, "KiB"),
    ("time for the head of a request, once begun", server.HEAD_TIMEOUT, "s"),
    ("answers that a client leaves unread", server.STALL_TIMEOUT, "s"),
    ("unread answers of all clients together", server.MAX_UNREAD / 2**20, "MiB"),
    ("reads of telemetry at one time", shop._READERS, ""),
    ("text of one unfinished report", pstate._MAX_LENGTH, ""),
    ("questions without an answer that stay in line", flow._MOST_LATE, ""),
    ("idle connection", server._KEEP_ALIVE, "s"),
    ("requests under way at the stop", server._GRACE, "s"),
    ("wrong keys of one address in 60 s", gate._FAILURES, ""),
    ("addresses whose wrong keys are counted", gate._FAILURES_KEPT, ""),
    ("a line", lines.MAX_LINE, "bytes"),
    ("a line", api.MAX_LINE, "bytes"),
    ("signals and polls of a job", api.MAX_SIGNALS, ""),
    ("shortest interval", api.MIN_INTERVAL, "s"),
    ("longest interval", api.MAX_INTERVAL, "s"),
    ("`count` of `/get-ps`", api.MAX_COUNT, ""),
    ("`count` of `/get-ps`", service.MAX_COUNT, ""),
    ("keys of `/query-ts`", api.MAX_KEYS, ""),
    ("keys times samples of `/query-ts`", api.MAX_VALUES, ""),
    ("single commands that wait", sender._MAX_WAITING, ""),
    ("part of the machine's queue that is filled", flow.FILL, ""),
    ("interval of `?queue` when idle", pacing.HEARTBEAT, "s"),
    ("longest wait for `?queue` while commands are unsent", pacing.REFILL_MOST, "s"),
    ("longest wait for `?queue` while the last ones are executed", pacing.DRAIN_MOST, "s"),
    ("one line from the machine", framing.MAX_LINE, "bytes"),
    ("keys of one report, as it is parsed", pstate._MAX_KEYS, ""),
    ("unfinished reports at one time", pstate._MAX_OPEN, ""),
    ("unsent bytes beyond which signals are refused", sender._MAX_UNWRITTEN, ""),
    ("time for a TCP connection", net._CONNECT_TIMEOUT, "s"),
    ("rows of a chunk", store.CHUNK_ROWS, ""),
    ("time until a report is on disk", service.FLUSH_S, "s"),
    ("time until it survives a power cut", store.SYNC_S, "s"),
    ("a line to it", sim_lines.MAX_LINE, "bytes"),
    ("settings", sim_spark.MAX_SETTINGS, ""),
    ("dwell", sim_execution.MAX_DWELL, "s"),
    ("garbage of one fault", faults.MAX_GARBAGE, "bytes"),
]


def documented_limits() -> dict[str, list[str]]:
    text = (REFERENCE / "limits.md").read_text("utf-8")
    return {cells[0]: cells for cells in rows(text)}


@pytest.mark.parametrize(("what", "value", "unit"), LIMITS, ids=lambda value: str(value)[:40])
def test_each_fixed_limit_is_documented(what: str, value: float, unit: str):
    number = f"{value:,.10g}"
    assert documented_limits()[what][1] == f"{number} {unit}".strip()
    assert documented_limits()[what][3] == "fixed"


def test_samples_and_back_off_are_documented():
    from toolpost.core.grid import SampleGrid

    most = inspect.signature(SampleGrid.from_seconds).parameters["most"].default
    assert documented_limits()["samples of `/query-ts`"][1] == f"{most:,}"
    wait = documented_limits()["delay between attempts to open a link"][1]
    assert wait == f"{driver._BACK_OFF_FIRST:g} to {driver._BACK_OFF_MOST:g} s"


def test_limits_name_real_keys():
    known = {f"{table}.{field.name}" for table, field in KEYS}
    for cells in documented_limits().values():
        assert cells[3] == "fixed" or cells[3].strip("`") in known, cells


@pytest.mark.parametrize("kind", faults.KINDS)
def test_each_fault_is_documented(kind: str):
    text = sections(ROOT / "docs" / "how-to" / "simulate-faults.md")["The faults"]
    argument = faults.KINDS[kind]
    expected = kind if argument is None else f"{kind}[:{argument}]"
    assert expected in {cells[0].strip("`") for cells in rows(text)}


def test_comm_log_is_synced_as_documented():
    assert commlog._SYNC_EVERY == 1.0
    assert commlog._FLUSH_AFTER == 0.02
    text = (REFERENCE / "files.md").read_text("utf-8")
    assert "within 20 ms and are synced once a second" in text


# Links and references


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_resolve(page: Path):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if target.startswith(("http://", "https://")):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), target
        if anchor:
            assert anchor in anchors(file), target


def test_the_index_names_every_page():
    index = ROOT / "docs" / "README.md"
    linked = {
        (index.parent / target.partition("#")[0]).resolve()
        for target in re.findall(r"\]\(([^)\s]+)\)", index.read_text("utf-8"))
    }
    assert {page for page in PAGES if page.is_relative_to(ROOT / "docs")} - {index} <= linked


MADE = {"toolpost.toml", "drivers/NAME/options.py"}
"""Files that pages tell the reader to make."""


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_named_files_exist(page: Path):
    for word in words_in_code(prose(page)):
        if (
            re.fullmatch(r"[\w./-]+\.(py|toml|md|sql|svg|jsonl|txt)|[\w.-]+(/[\w.-]+)*/", word)
            and word not in MADE
        ):
            places = [ROOT / word, ROOT / "src" / "toolpost" / word, page.parent / word]
            if not word.startswith(("logs/", "programs/")):
                assert "NAME" in word or any(place.exists() for place in places), word


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_pages_are_about_the_project_alone(page: Path):
    text = page.read_text("utf-8")
    assert str(ROOT) not in text
    assert "\t" not in text
    assert not re.search(r"\[[ x]\] |TODO|FIXME", text)


# First steps


FIRST_STEPS = ROOT / "docs" / "start" / "first-steps.md"


def run_curl(line: str, client: Client) -> Any:
    """Do what ``curl --json BODY URL`` does."""
    words = shlex.split(line)
    assert words[:2] == ["curl", "--json"]
    url = words[3]
    assert url.startswith("http://127.0.0.1:7125/")
    answer = client.post(url.removeprefix("http://127.0.0.1:7125"), words[2])
    assert answer.status == 200, answer
    return answer.json


def test_curl_examples_of_the_first_steps_work(tmp_path: Path):
    config = '[machines.sim]\ndriver = "spark"\nlink = "sim"\n'
    answers: list[tuple[str, Any]] = []
    with Server(tmp_path, config, "--listen", "127.0.0.1:0") as running:
        client = running.client
        wait_until(lambda: client.call("/status")["device_alive"])
        now = int(time.time())
        for block in blocks("sh", [FIRST_STEPS]):
            for line in block.text.splitlines():
                if line.startswith("curl"):
                    text = line.replace("$((now - 60))", str(now - 60)).replace("$now", str(now))
                    answers.append((text.rpartition("/")[2], run_curl(text, client)))
                    if text.endswith("/add-job") and "G4" not in text:
                        wait_until(lambda: "time_ended" in client.call("/list-jobs")["jobs"][-1])
        jobs = client.call("/list-jobs")["jobs"]
        wait_until(lambda: any(line == ("down", "?pos") for line in running.comm_log()))
    assert [call for call, _ in answers] == [
        "add-job", "list-jobs", "status", "get-ps", "write-line", "query-ts", "add-job", "cancel",
    ]  # fmt: skip
    results = [answer for _, answer in answers]
    assert results[0]["ok"]
    assert results[1]["jobs"][0]["status"] == "COMPLETED"
    assert results[3]["pstates"][0]["kv"]["sys"] == "machine"
    assert results[4]["ok"]
    assert len(results[5]["times"]) == 7
    assert [job["status"] for job in jobs] == ["COMPLETED", "CANCELED"]
