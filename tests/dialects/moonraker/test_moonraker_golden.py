"""What the original answered (tests/golden/moonraker.jsonl, A and B), replayed on a queue in memory."""

import asyncio
import contextlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from tests.dialects.moonraker.serving import Client, Service, serving

GOLDEN = Path(__file__).parents[2] / "golden" / "moonraker.jsonl"
SECTIONS = {"A-http-idle", "B-rpc-ws", "B-rpc-http"}
RECORDS = [
    record
    for line in GOLDEN.read_text("utf-8").splitlines()
    if (record := json.loads(line))["section"] in SECTIONS
]
NO_BOOL = "Unable to convert argument [reset] to <class 'bool'>: value received: {}"
NO_STR = "Unable to convert argument [job_id] to <class 'str'>: value received: {}"
UNKNOWN = "1.2: 'Unknown' was a fault of Tornado's with the status line"
TRAVERSAL = "1.6, 6: names that lead out of gcodes are refused when they are queued"
NOT_OBJECT = "1.6, 7: JSON that is no object is a mistake of the client, not of the server"
UNHASHABLE = "1.6, 7: the same error over all transports, which names the argument"


class Differs(NamedTuple):
    """An error that deliberately differs from the original's answer."""

    code: int
    message: str
    why: str


DIFFERENT = {
    53: Differs(400, "G-Code File note.txt does not exist", "1.6, 6: only G-code can be queued"),
    72: Differs(400, NO_BOOL.format("garbage"), UNKNOWN),
    73: Differs(400, NO_BOOL.format("1"), UNKNOWN),
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
    186: Differs(400, "G-Code File ../config/printer.cfg does not exist", TRAVERSAL),
    193: Differs(400, NO_STR.format("['a']"), UNHASHABLE),
    226: Differs(400, "Invalid Request: it must be a JSON object or an array of them", NOT_OBJECT),
    228: Differs(400, "Invalid Request: it must be a JSON object or an array of them", NOT_OBJECT),
    258: Differs(400, "G-Code File ../config/printer.cfg does not exist", TRAVERSAL),
    266: Differs(400, NO_STR.format("{}"), UNHASHABLE),
}

NOTHING_CHANGED = "1.6, 5: nothing is told when unknown ids are deleted"
JUMPED = "1.6, 5: a jump is told too, or others would keep a stale order"
NOTIFIED = {
    53: (0, "nothing was queued"),
    112: (0, NOTHING_CHANGED),
    117: (0, NOTHING_CHANGED),
    131: (1, JUMPED),
    132: (1, JUMPED),
    186: (0, "nothing was queued"),
    195: (1, JUMPED),
    198: (0, NOTHING_CHANGED),
    258: (0, "nothing was queued"),
    267: (1, JUMPED),
    270: (0, NOTHING_CHANGED),
}


def loose(value: Any) -> Any:
    """Without what depends on the time and the ids."""
    if isinstance(value, list):
        return [loose(item) for item in value]
    if isinstance(value, dict):
        out = {"job_id", "time_added", "time_in_queue"}
        return {key: key if key in out else loose(item) for key, item in value.items()}
    return value


class Replay:
    """One record, with the ids that this queue gave in place of the recorded ones."""

    def __init__(self, record: dict[str, Any], service: Service) -> None:
        self._record = record
        self._service = service
        jobs = record["queue_before"]["queued_jobs"]
        ids = service.queue.add([job["filename"] for job in jobs])
        self._ids = {job["job_id"]: own for job, own in zip(jobs, ids, strict=True)}

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
            answer = await self._service.rpc_http(self.body)
        else:
            path = self.own(request["path"])
            answer = await self._service.http(
                request["method"], path, self.body, request.get("headers") or {}
            )
        head = (answer.status, answer.headers["content-type"], "etag" in answer.headers)
        return head, answer.json if answer.body else ""

    def expected(self) -> tuple[Any, Any]:
        response = self._record["response"]
        content = response["json"] if "json" in response else response["raw"]
        different = DIFFERENT.get(self._record["seq"])
        transport = self._record["transport"]
        status = response.get("status")
        if different is not None:
            error = {"code": different.code, "message": different.message}
            rpc = transport != "http" and status != 500
            content = {**content, "error": error} if rpc else {"error": error}
            content.pop("result", None)
            status = 200 if rpc else different.code
        if transport == "jsonrpc-ws":
            return None, content
        return (status, response["content_type"], "etag" in response), content


@pytest.fixture(scope="module")
def bench():
    """A server, a client and one that only watches, for all records: starting each anew would take long."""
    with asyncio.Runner() as runner:
        stack = contextlib.AsyncExitStack()

        async def start() -> tuple[Service, Client, Client]:
            service = await stack.enter_async_context(serving())
            client = await stack.enter_async_context(service.client())
            return service, client, await stack.enter_async_context(service.client())

        yield runner, *runner.run(start())
        runner.run(stack.aclose())


@pytest.mark.parametrize("record", RECORDS, ids=lambda r: f"{r['section'][0]}{r['seq']}-{r['name']}")
def test_replayed(bench: tuple[asyncio.Runner, Service, Client, Client], record: dict[str, Any]) -> None:
    runner, service, client, watcher = bench

    async def replay() -> None:
        service.queue.jobs.clear()
        case = Replay(record, service)
        head, content = await case.send(client)
        expected_head, expected = case.expected()
        assert head == expected_head
        assert loose(content) == loose(expected)
        watcher.notifications.clear()
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
