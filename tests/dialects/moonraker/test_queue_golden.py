"""What the original answered (tests/golden/moonraker.jsonl), replayed on a server and its simulated machine.

Sections A and B record by record, each with its own queue before it; of C and F what needs no Klipper, each
part from its first record to its last. What deliberately differs stands in the tables, with the reason.
"""

import asyncio
import contextlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from tests.dialects.moonraker.live import config, ids, machine, names, site, write_files
from tests.dialects.moonraker.serving import Client, Site
from tests.harness import Server

GOLDEN = Path(__file__).parents[2] / "golden" / "moonraker.jsonl"
SECTIONS = {"A-http-idle", "B-rpc-ws", "B-rpc-http"}
RECORDS = [
    record
    for line in GOLDEN.read_text("utf-8").splitlines()
    if (record := json.loads(line))["section"] in SECTIONS
]
NO_BOOL = "Unable to convert argument [reset] to <class 'bool'>: value received: {}"
NO_STR = "Unable to convert argument [job_id] to <class 'str'>: value received: {}"
NO_GCODE = "{!r}: not a G-code file; its name must end with one of .gcode, .g, .gco"
NO_NAME = "'': a name must be given"
NO_DOTS = "'../config/printer.cfg': a name must not contain . or .. as a part"
UNKNOWN = "1.2: 'Unknown' was a fault of Tornado's with the status line"
TRAVERSAL = "1.6, 6: names that lead out of gcodes are refused when they are queued"
ONLY_GCODE = "1.6, 6: only G-code can be queued"
SAYS_MORE = "it is no name that a file could have, and the message says why"
NOT_OBJECT = "1.6, 7: JSON that is no object is a mistake of the client, not of the server"
UNHASHABLE = "1.6, 7: the same error over all transports, which names the argument"


class Differs(NamedTuple):
    """An error that deliberately differs from the original's answer."""

    code: int
    message: str
    why: str


class AtTheGate(NamedTuple):
    """An answer of what is in front of every dialect, in plain text."""

    status: int
    text: str
    why: str


DIFFERENT: dict[int, Differs | AtTheGate] = {
    6: AtTheGate(204, "", "a preflight is answered before it is known who asks what; it allows no origin"),
    18: AtTheGate(
        403,
        "pages of this origin may not call (Origin); see server.origins",
        "security.md: pages of other sites are not served at all, instead of served without a header",
    ),
    27: Differs(400, NO_NAME, SAYS_MORE),
    28: Differs(400, "'  ': a part of a name must not begin or end with a blank", SAYS_MORE),
    51: Differs(400, "'subdir/': a name must not have empty parts", SAYS_MORE),
    53: Differs(400, NO_GCODE.format("note.txt"), ONLY_GCODE),
    56: Differs(400, "'a.gcode ': a part of a name must not begin or end with a blank", SAYS_MORE),
    66: Differs(400, NO_GCODE.format("comma"), ONLY_GCODE),
    72: Differs(400, NO_BOOL.format("garbage"), UNKNOWN),
    73: Differs(400, NO_BOOL.format("1"), UNKNOWN),
    77: Differs(400, NO_GCODE.format('["a.gcode"]'), ONLY_GCODE),
    78: Differs(400, NO_GCODE.format('["a.gcode"'), ONLY_GCODE),
    85: Differs(
        400,
        "Invalid JSON in the body: Input data was truncated",
        "broken JSON is told, not taken for no body",
    ),
    87: Differs(400, "Invalid JSON in the body: it must be an object", NOT_OBJECT),
    89: Differs(400, "Invalid JSON in the body: it must be an object", NOT_OBJECT),
    96: Differs(400, NO_BOOL.format("yes"), UNKNOWN),
    102: Differs(400, NO_BOOL.format("None"), UNKNOWN),
    103: Differs(400, NO_BOOL.format("[]"), UNKNOWN),
    104: Differs(400, NO_BOOL.format("{}"), UNKNOWN),
    175: Differs(400, NO_NAME, SAYS_MORE),
    186: Differs(400, NO_DOTS, TRAVERSAL),
    193: Differs(400, NO_STR.format("['a']"), UNHASHABLE),
    226: Differs(400, "Invalid Request: it must be a JSON object or an array of them", NOT_OBJECT),
    228: Differs(400, "Invalid Request: it must be a JSON object or an array of them", NOT_OBJECT),
    247: Differs(400, NO_NAME, SAYS_MORE),
    258: Differs(400, NO_DOTS, TRAVERSAL),
    266: Differs(400, NO_STR.format("{}"), UNHASHABLE),
}
"""Answers that are not the recorded ones, by seq."""

STAND_INS = {"../config/printer.cfg": "tiny.gcode"}
"""What is in the queue in place of what cannot be any more (records 187 and 259)."""

NOTHING_ADDED = "nothing has changed, so nothing is told"
NOTHING_CHANGED = "1.6, 5: nothing is told when unknown ids are deleted"
JUMPED = "1.6, 5: a jump is told too, or others would keep a stale order"
NOTIFIED = {
    21: (0, NOTHING_ADDED),
    53: (0, NOTHING_ADDED),
    112: (0, NOTHING_CHANGED),
    117: (0, NOTHING_CHANGED),
    131: (1, JUMPED),
    132: (1, JUMPED),
    170: (0, NOTHING_ADDED),
    171: (0, NOTHING_ADDED),
    186: (0, NOTHING_ADDED),
    195: (1, JUMPED),
    198: (0, NOTHING_CHANGED),
    243: (0, NOTHING_ADDED),
    258: (0, NOTHING_ADDED),
    267: (1, JUMPED),
    270: (0, NOTHING_CHANGED),
}
"""How many notifications there are instead of the recorded ones, by seq."""


def loose(value: Any) -> Any:
    """Without what depends on the time and the ids."""
    if isinstance(value, list):
        return [loose(item) for item in value]
    if isinstance(value, dict):
        out = {"job_id", "time_added", "time_in_queue"}
        return {key: key if key in out else loose(item) for key, item in value.items()}
    return STAND_INS.get(value, value) if isinstance(value, str) else value


class Replay:
    """One record, with the ids that this queue gave in place of the recorded ones."""

    def __init__(self, record: dict[str, Any], where: Site) -> None:
        self._record = record
        self._where = where
        self._ids: dict[str, str] = {}

    async def prepare(self, client: Client) -> None:
        """Brings the queue into the state before the record."""
        before = self._record["queue_before"]
        await client.call("server.job_queue.delete_job", all=True)
        wanted = [STAND_INS.get(job["filename"], job["filename"]) for job in before["queued_jobs"]]
        queue = await client.call("server.job_queue.post_job", filenames=wanted)
        assert (queue["queue_state"], names(queue)) == (before["queue_state"], wanted)
        recorded = [job["job_id"] for job in before["queued_jobs"]]
        self._ids = dict(zip(recorded, ids(queue), strict=True))

    def own(self, text: str) -> str:
        for recorded, own in self._ids.items():
            text = text.replace(recorded, own)
        return text

    @property
    def body(self) -> bytes:
        text = self._record["request"]["body"]
        return b"" if text is None else b"\xff" if text == "ÿ" else self.own(text).encode()

    async def send(self, client: Client) -> tuple[Any, Any]:
        """Returns the answer's status, content type and ETag, where there are such, and what it holds."""
        request = self._record["request"]
        if self._record["transport"] == "jsonrpc-ws":
            await client.send(self.body.decode())
            await client.send('{"jsonrpc":"2.0","method":"server.websocket.id","id":"last"}')
            messages = []
            while (message := await client.message()).get("id") != "last":
                messages.append(message)
            answers = [message for message in messages if "method" not in message]
            assert len(answers) <= 1
            return None, answers[0] if answers else None
        if self._record["transport"] == "jsonrpc-http":
            answer = await self._where.rpc_http(self.body)
        else:
            path = self.own(request["path"])
            answer = await self._where.http(
                request["method"], path, self.body, request.get("headers") or {}
            )
        head = (answer.status, answer.headers.get("content-type"), "etag" in answer.headers)
        is_json = (head[1] or "").startswith("application/json")
        return head, answer.json if answer.body and is_json else answer.body.decode()

    def expected(self) -> tuple[Any, Any]:
        response = self._record["response"]
        content = response["json"] if "json" in response else response["raw"]
        different = DIFFERENT.get(self._record["seq"])
        transport = self._record["transport"]
        status, content_type = response.get("status"), response.get("content_type")
        if isinstance(different, AtTheGate):
            kind = "text/plain; charset=utf-8" if different.text else None
            return (different.status, kind, False), different.text
        if different is not None:
            error = {"code": different.code, "message": different.message}
            rpc = transport != "http" and status != 500
            content = {**content, "error": error} if rpc else {"error": error}
            content.pop("result", None)
            status = 200 if rpc else different.code
        if transport == "jsonrpc-ws":
            return None, content
        return (status, content_type, "etag" in response), content


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory):
    """A server, a client and one that only watches, for all records: starting each anew would take long."""
    server = Server(tmp_path_factory.mktemp("queue"), config(machine("edm", automatic_transition=True)))
    write_files(server.data)
    with server, asyncio.Runner() as runner:
        stack = contextlib.AsyncExitStack()
        where = site(server)

        async def start() -> tuple[Client, Client]:
            client = await stack.enter_async_context(where.client())
            return client, await stack.enter_async_context(where.client())

        client, watcher = runner.run(start())
        yield runner, where, client, watcher
        runner.run(stack.aclose())


@pytest.mark.parametrize("record", RECORDS, ids=lambda r: f"{r['section'][0]}{r['seq']}-{r['name']}")
def test_replayed(bench: tuple[asyncio.Runner, Site, Client, Client], record: dict[str, Any]) -> None:
    runner, where, client, watcher = bench

    async def replay() -> None:
        case = Replay(record, where)
        await case.prepare(client)
        await watcher.call("server.websocket.id")
        watcher.notifications.clear()
        head, content = await case.send(client)
        expected_head, expected = case.expected()
        assert loose(content) == loose(expected)
        assert head == expected_head
        await watcher.call("server.websocket.id")
        seen = [message["params"] for message in watcher.notifications]
        recorded = [message["params"] for message in record["notifications"]]
        if record["seq"] in NOTIFIED:
            assert len(seen) == NOTIFIED[record["seq"]][0] != len(recorded)
        else:
            assert loose(seen) == loose(recorded)

    runner.run(replay())


def test_the_differences_are_of_records_that_there_are() -> None:
    assert {*DIFFERENT, *NOTIFIED} <= {record["seq"] for record in RECORDS}
    assert len(RECORDS) == 169
