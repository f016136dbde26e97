"""What the original answered (tests/golden/moonraker.jsonl), replayed on a server and its simulated machine.

Sections A and B record by record, each with its own queue before it; of C and F what needs no Klipper, each
part from its first record to its last. What deliberately differs stands in the tables, with the reason.
"""

import asyncio
import contextlib
import itertools
import json
import signal
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from tests.dialects.moonraker.live import (
    FILES,
    NOTIFICATION,
    QUEUE,
    Watcher,
    brief,
    config,
    ids,
    machine,
    names,
    shop_idle,
    site,
    until,
    watching,
    write_files,
)
from tests.dialects.moonraker.serving import Client, Site
from tests.harness import JSON, Port, Server

from toolpost.sim.options import SparkOptions

GOLDEN = Path(__file__).parents[2] / "golden" / "moonraker.jsonl"
ALL = [json.loads(line) for line in GOLDEN.read_text("utf-8").splitlines()]
RECORDS = [record for record in ALL if record["section"].startswith(("A-", "B-"))]
DYNAMIC = {record["seq"]: record for record in ALL if record["section"].startswith(("C-", "F-"))}
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
            answer = await self._where.http(request["method"], path, self.body, request.get("headers") or {})
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
        seen = [note["params"] for note in watcher.notifications if note["method"] == NOTIFICATION]
        recorded = [message["params"] for message in record["notifications"]]
        if record["seq"] in NOTIFIED:
            assert len(seen) == NOTIFIED[record["seq"]][0] != len(recorded)
        else:
            assert loose(seen) == loose(recorded)

    runner.run(replay())


class Part(NamedTuple):
    """Some records of C in their order, on a queue that is empty before.

    Attributes:
        first, last: of the records.
        answers: what is answered to some of them instead, as ``state [names]``; several are possible where
            the recorded one shows how long the original took.
        events: what is told instead of the recorded notifications.
        why: of each difference.
    """

    first: int
    last: int
    answers: dict[int, tuple[str, ...]] = {}  # noqa: RUF012  # a tuple cannot be changed
    events: list[str] | None = None
    why: tuple[str, ...] = ()


NO_READY_BEFORE = "the original was left 'ready' with an empty queue by what came before (1.5)"
NO_TICK = "what waited for a tick of Klipper's has happened already"
CONTENT_KEPT = "1.6, 6: a job runs what its file held when it was queued, whatever happens to the file"
NOTHING_LEFT = "1.7: 'ready' with nothing left to load becomes 'paused', so that it means what it says"

PARTS = {
    "two jobs": Part(
        290,
        294,
        {
            290: ("paused [a.gcode b.gcode]",),
            292: ("loading [a.gcode b.gcode]", "starting [a.gcode b.gcode]", "ready [b.gcode]"),
        },
        [
            "jobs_added paused [a.gcode b.gcode]",
            "state_changed loading",
            "state_changed starting",
            "job_loaded ready [b.gcode]",
            "state_changed loading",
            "state_changed starting",
            "job_loaded paused []",
        ],
        (NO_READY_BEFORE, NO_TICK),
    ),
    "a direct job": Part(295, 301),
    "no start by itself": Part(302, 303),
    "cancel": Part(304, 311),
    "a job fails": Part(312, 318),
    "the last job fails": Part(319, 322),
    "a file is deleted": Part(
        323,
        328,
        {328: ("paused []",)},
        [
            "jobs_added paused [gone.gcode a.gcode]",
            "state_changed loading",
            "state_changed starting",
            "job_loaded ready [a.gcode]",
            "state_changed loading",
            "state_changed starting",
            "job_loaded paused []",
        ],
        (CONTENT_KEPT,),
    ),
    "delete all while a job runs": Part(
        346,
        351,
        dict.fromkeys([348, 349, 351], ("paused []",)),
        [
            "jobs_added paused [mid.gcode a.gcode]",
            "state_changed loading",
            "state_changed starting",
            "job_loaded ready [a.gcode]",
            "state_changed paused",
            "jobs_removed paused []",
        ],
        (NOTHING_LEFT,),
    ),
    "five starts at once": Part(
        352,
        359,
        {
            352: ("paused [a.gcode b.gcode a.gcode]",),
            **dict.fromkeys(
                range(353, 358),
                (
                    "loading [a.gcode b.gcode a.gcode]",
                    "starting [a.gcode b.gcode a.gcode]",
                    "ready [b.gcode a.gcode]",
                ),
            ),
        },
        [
            "jobs_added paused [a.gcode b.gcode a.gcode]",
            "state_changed loading",
            "state_changed starting",
            "job_loaded ready [b.gcode a.gcode]",
            "state_changed loading",
            "state_changed starting",
            "job_loaded ready [a.gcode]",
            "state_changed loading",
            "state_changed starting",
            "job_loaded paused []",
        ],
        (NO_READY_BEFORE, NO_TICK),
    ),
    "shutdown": Part(365, 378),
}

NOT_REPLAYED = {
    range(286, 290): "test_names_that_are_missing",
    range(329, 333): "a traversal is refused when it is queued: records 186 and 258",
    range(333, 341): "PAUSE is Klipper's: a job of a Spark core is not paused",
    range(341, 346): "remote methods are Klipper's; test_queue_clients.py pauses a load in other ways",
    range(360, 365): "print/start of a file that is missing or while the machine is busy: not the queue",
    range(413, 428): "test_without_automatic_transition",
}
"""Records of C and F that are replayed elsewhere or nowhere."""

HOLD_OFF = 0.05
FAULTS = {"err.gcode": "reboot", "range.gcode": "reboot"}
"""How a job fails that Klipper ends with an error: the machine loses it."""


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory):
    """A server on a core that can have faults; each command takes 50 ms."""
    folder = tmp_path_factory.mktemp("workshop")
    with Port(SparkOptions(command_time=0.05, hold_off=HOLD_OFF)) as port:
        server = Server(
            folder, config(machine("edm", port.path, hold_off=HOLD_OFF, automatic_transition=True))
        )
        write_files(server.data)
        with server:
            yield server, port


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS)
def test_replayed_part(workshop: tuple[Server, Port], part: Part) -> None:
    async def run() -> None:
        server, port = workshop
        where = site(server)
        write_files(server.data)
        await where.http("DELETE", f"{QUEUE}/job?all=true")
        await idle(where)
        # Nothing is started, but a pause that was asked for before is forgotten.
        await where.http("POST", f"{QUEUE}/start")
        records = [DYNAMIC[seq] for seq in range(part.first, part.last + 1)]
        async with watching(where) as watcher:
            replay = PartReplay(part, server, port, where, watcher)
            for _, group in itertools.groupby(records, key=lambda record: record["name"]):
                # Those of one name were sent at the same moment.
                await asyncio.gather(*map(replay.step, group))
            told = [brief(event) for record in records for event in events(record)]
            expected = part.events or told
            await until(lambda: len(watcher.events) >= len(expected))
            await asyncio.sleep(0.05)
            assert watcher.brief == expected
            assert part.events is None or part.why

    asyncio.run(run())


class PartReplay:
    """Does what a record did, in the words of a Spark core where they are Klipper's, and compares."""

    def __init__(self, part: Part, server: Server, port: Port, where: Site, watcher: Watcher) -> None:
        self._part = part
        self._data = server.data
        self._port = port
        self._where = where
        self._watcher = watcher
        self._ids: dict[str, str] = {}
        self._running = ""
        self._failed = False

    async def step(self, record: dict[str, Any]) -> None:
        request = record["request"]
        path, _, query = (request.get("path") or "").partition("?")
        loaded = self._watcher.count("job_loaded")
        if request["method"] == "WATCH":
            await self._watch()
        elif path.startswith(QUEUE):
            await self._queue(record)
        elif path == "/printer/print/start":
            job = {"commands": FILES[query.removeprefix("filename=")][:-1] * 2}
            answer = await self._where.http("POST", "/add-job", json.dumps(job).encode(), JSON)
            assert answer.json["ok"] == (record["response"]["status"] == 200)
        elif path == "/printer/print/cancel":
            assert (await self._where.http("POST", "/cancel", b"{}", JSON)).status == 200
            # The core takes nothing for a moment; with Klipper, a cancel is answered after that.
            await asyncio.sleep(2 * HOLD_OFF)
        elif path == "/printer/emergency_stop":
            self._port.inject("fault")
            await until(lambda: "notify_klippy_shutdown" in self._watcher.others)
            await until(lambda: self._watcher.events[-1]["queue_state"] == "paused")
        elif path == "/printer/firmware_restart":
            self._port.inject("reboot")
            await until(lambda: "notify_klippy_ready" in self._watcher.others)
            await asyncio.sleep(2 * HOLD_OFF)
        elif path in {"/printer/info", "/server/info"}:
            answer = (await self._where.http("GET", path)).json["result"]
            recorded = record["response"]["json"]["result"]
            for key in recorded.keys() & {"state", "klippy_state", "klippy_connected", "api_version"}:
                assert answer[key] == recorded[key], key
        elif request["method"] == "DELETE":
            (self._data / "gcodes" / path.rpartition("/")[2]).unlink()
        else:
            assert path == "/printer/objects/query", path
        if any(event["action"] == "job_loaded" for event in events(record)):
            await until(lambda: self._watcher.count("job_loaded") > loaded)

    async def _queue(self, record: dict[str, Any]) -> None:
        request, response = record["request"], record["response"]
        body = (request["body"] or "").encode()
        answer = await self._where.http(request["method"], request["path"], body, JSON if body else {})
        assert answer.status == response["status"]
        queue = answer.json["result"]
        recorded = response["json"]["result"]
        expected = self._part.answers.get(record["seq"], (shown(recorded), *further(shown(recorded))))
        assert shown(queue) in expected, record["seq"]
        if shown(queue).partition(" ")[2] == shown(recorded).partition(" ")[2]:
            for own, other in zip(ids(queue), ids(recorded), strict=True):
                assert self._ids.setdefault(other, own) == own
        if names(queue):
            self._running = names(queue)[0]

    async def _watch(self) -> None:
        """Waits until nothing happens any more; a job that failed does so here."""
        fault = FAULTS.get(self._running)
        if fault is not None and not self._failed:
            await until(lambda: self._watcher.count("job_loaded") > 0)
            self._failed = True
            self._port.inject(fault)
            await until(lambda: not self._port.core.queue_length)
            await idle(self._where)
            await asyncio.sleep(2 * HOLD_OFF)
        await idle(self._where)


async def idle(where: Site) -> None:
    """Returns when the machine does nothing and its queue goes on no more."""
    async with asyncio.timeout(20):
        while True:
            queue = (await where.http("GET", f"{QUEUE}/status")).json["result"]
            still = queue["queue_state"] == "paused" or (queue["queue_state"] == "ready" and not names(queue))
            if still and await shop_idle(where):
                return
            await asyncio.sleep(0.01)


def further(shown: str) -> list[str]:
    """What a load that has begun may be in the answer already: it is answered when it is on disk."""
    return [shown.replace("loading", "starting", 1)] if shown.startswith("loading") else []


def events(record: dict[str, Any]) -> list[dict[str, Any]]:
    """What was told of the queue after a recorded request."""
    return [
        event
        for notification in record["notifications"]
        if notification["method"] == NOTIFICATION
        for event in notification["params"]
    ]


def shown(queue: dict[str, Any]) -> str:
    """An answer as ``state [names]``."""
    return f"{queue['queue_state']} [{' '.join(names(queue))}]"


def test_names_that_are_missing(bench: tuple[asyncio.Runner, Site, Client, Client]) -> None:
    """Records 286 to 289; the message was "Unknown" of three (1.2)."""
    runner, where, _, _ = bench

    async def run() -> None:
        for seq in range(286, 290):
            body = DYNAMIC[seq]["request"]["body"]
            name = json.loads(body)["filenames"][0]
            answer = await where.http("POST", f"{QUEUE}/job", body.encode(), JSON)
            message = f"G-Code File {name} does not exist"
            if "\n" in name:
                message = f"{name!r}: a name must not contain control characters"
            assert (answer.status, answer.json) == (400, {"error": {"code": 400, "message": message}})

    runner.run(run())


def test_without_automatic_transition(tmp_path: Path) -> None:
    """Section F: `ready` is taken at its word where the original said `paused` (the document says `ready`).

    Its Klipper was restarted, and with load_on_startup the first job ran each time. Here it is Toolpost that
    is restarted, and the queue is still there.
    """
    options = {"command_time": 0.05, "load_on_startup": True}
    server = Server(tmp_path, config(machine("edm", **options)))
    write_files(server.data)

    async def call(where: Site, seq: int) -> str:
        request = DYNAMIC[seq]["request"]
        body = (request["body"] or "").encode()
        answer = await where.http(request["method"], request["path"], body, JSON if body else {})
        return shown(answer.json["result"])

    async def first() -> None:
        where = site(server)
        async with watching(where) as watcher:
            assert await call(where, 413) == recorded(413) == "paused []"
            assert await call(where, 414) == recorded(414) == "paused [mid.gcode b.gcode]"
            assert await call(where, 415) in (recorded(415), *further(recorded(415)))
            await until(lambda: watcher.count("job_loaded") == 1)
            assert watcher.brief == [*map(brief, [*events(DYNAMIC[414]), *events(DYNAMIC[415])])]
            assert await call(where, 416) == recorded(416) == "paused [b.gcode]"
            assert await call(where, 417) == "ready [b.gcode]" != recorded(417)
            assert await call(where, 418) == "ready [b.gcode a.gcode]" != recorded(418)
            await until(lambda: watcher.count("job_loaded") == 2)
            await idle(where)
            assert await call(where, 420) == "paused [a.gcode]" != recorded(420)
            assert watcher.brief[4:] == [
                "state_changed ready",
                "jobs_added ready [b.gcode a.gcode]",
                "state_changed loading",
                "state_changed starting",
                "job_loaded paused [a.gcode]",
            ]
            assert await call(where, 424) == recorded(424) == "paused [a.gcode b.gcode]"

    async def second() -> None:
        where = site(server)
        async with watching(where):
            await idle(where)
            await until_loaded(where, "paused [b.gcode]")
            assert await call(where, 427) == recorded(427) == "paused [b.gcode]"

    async def until_loaded(where: Site, state: str) -> None:
        async with asyncio.timeout(10):
            while await call(where, 427) != state:
                await asyncio.sleep(0.01)

    with server:
        asyncio.run(first())
        assert server.stop(signal.SIGKILL) != 0
        server.start()
        asyncio.run(second())


def recorded(seq: int) -> str:
    return shown(DYNAMIC[seq]["response"]["json"]["result"])


def test_every_record_has_its_place() -> None:
    assert {*DIFFERENT, *NOTIFIED} <= {record["seq"] for record in RECORDS}
    assert len(RECORDS) == 169
    replayed = [*NOT_REPLAYED, *(range(part.first, part.last + 1) for part in PARTS.values())]
    assert sorted(seq for part in replayed for seq in part) == sorted(DYNAMIC)
