"""JSON-RPC (dialects/moonraker.md 1.3) over HTTP and the WebSocket, and the routes of HTTP (1.1)."""

import asyncio
import json
import logging
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec
import pytest
from tests.dialects.moonraker.serving import MAX_BODY, Service, serving

from toolpost.dialects.moonraker.connections import Connection
from toolpost.dialects.moonraker.errors import RpcError
from toolpost.dialects.moonraker.http import MAX_TAGGED
from toolpost.dialects.moonraker.jsonrpc import MAX_BATCH
from toolpost.dialects.moonraker.rpc import Method, Methods, NoParams
from toolpost.errors import InvalidRequestError, LinkError, NotAcceptedError, StorageError

Exchange = Callable[[str], Awaitable[Any]]
STATUS = {"queued_jobs": [], "queue_state": "paused"}
SILENCE = object()


class FailParams(msgspec.Struct):
    how: str


FAILURES = {
    "400": RpcError(400, "no <b>good</b>\nat all"),
    "404": RpcError(404, "Namespace nope not found"),
    "401": RpcError(401, "Unauthorized"),
    "503": RpcError(503, "Klippy Host not connected"),
    "invalid": InvalidRequestError("job_id: must be known"),
    "state": NotAcceptedError("a job has not ended"),
    "disk": StorageError("the disk is full"),
    "link": LinkError("the cable is out"),
    "bug": TypeError("/srv/secret.py is broken"),
}


async def fail(params: FailParams, _: Connection) -> object:
    if params.how == "result":
        return object()
    raise FAILURES[params.how]


async def echo(params: dict[str, Any], connection: Connection) -> object:
    return {"params": params, "actor": connection.actor}


async def big(params: dict[str, Any], _: Connection) -> object:
    return "x" * params.get("size", MAX_TAGGED)


EXTRA = (
    Method("test.fail", ("GET", "/test/fail"), FailParams, fail),
    Method(
        "test.echo",
        ("GET", "/test/echo"),
        dict,
        echo,
        more_http=(("POST", "/test/echo"),),
        from_http=lambda arguments: {"objects": arguments},
    ),
    Method("test.big", ("GET", "/test/big"), dict, big),
)


def over_both(case: Callable[[Exchange], Awaitable[None]]) -> None:
    """Runs a case over the WebSocket and over HTTP."""

    async def run() -> None:
        async with serving(*EXTRA) as service, service.client() as client:
            last = {"jsonrpc": "2.0", "result": {"websocket_id": 1}, "id": "last"}

            async def over_websocket(text: str) -> Any:
                await client.send(text)
                await client.send('{"jsonrpc":"2.0","method":"server.websocket.id","id":"last"}')
                answers = []
                while (answer := await client.message()) != last:
                    if isinstance(answer, list) or "id" in answer:
                        answers.append(answer)
                assert len(answers) <= 1
                return answers[0] if answers else SILENCE

            async def over_http(text: str) -> Any:
                answer = await service.rpc_http(text.encode())
                assert answer.status == 200
                if not answer.body:
                    assert answer.headers["content-type"] == "text/html; charset=UTF-8"
                    return SILENCE
                assert answer.headers["content-type"] == "application/json; charset=UTF-8"
                return answer.json

            await case(over_websocket)
            await case(over_http)

    asyncio.run(run())


def error(code: int, message: str, identity: Any = None) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "error": {"code": code, "message": message}, "id": identity}


def status(identity: Any) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "result": STATUS, "id": identity}


def call(method: Any = "server.job_queue.status", **more: Any) -> str:
    return json.dumps({"jsonrpc": "2.0", "method": method, **more})


def test_each_row_of_the_table() -> None:
    async def case(exchange: Exchange) -> None:
        assert await exchange(call("nope", id=1)) == error(-32601, "Method not found", 1)
        assert await exchange(call("nope", params=[], id=1)) == error(-32601, "Method not found", 1)
        for broken in ('{"jsonrpc":', "", "{]", "tru", '{"method":1e999}', '{"id":"\\ud800"}', "[" * 9000):
            assert await exchange(broken) == error(-32700, "Parse error"), broken
        for wrong in ({"id": 1}, {"id": 1, "jsonrpc": "1.0"}, {"id": 1, "jsonrpc": 2.0}):
            text = json.dumps({"method": "server.job_queue.status", **wrong})
            assert await exchange(text) == error(-32600, "Invalid Request", 1), wrong
        for method in (5, None, [], {}):
            assert await exchange(call(method, id=1)) == error(-32600, "Invalid Request", 1), method
        for params in ([], [1], "x", 5, True):
            assert await exchange(call(params=params, id=1)) == error(-32602, "Invalid params:", 1), params
        for params in ({}, None, {"more": 1}):
            assert await exchange(call(params=params, id=1)) == status(1), params
        for response in ({"id": 1}, {"jsonrpc": "2.0", "id": 1, "result": {}}, {}):
            assert await exchange(json.dumps(response)) is SILENCE, response

    over_both(case)


def test_ids() -> None:
    async def case(exchange: Exchange) -> None:
        for identity in (0, "abc", "ü\n", 1.5, {"a": 1}, [1], True, 10**30):
            assert await exchange(call(id=identity)) == status(identity)
        assert await exchange(call()) is SILENCE
        assert await exchange(call(id=None)) is SILENCE
        assert await exchange(call("nope")) == error(-32601, "Method not found")
        missing = error(400, "No data for argument: filenames")
        assert await exchange(call("server.job_queue.post_job", id=None)) == missing

    over_both(case)


def test_batches() -> None:
    async def case(exchange: Exchange) -> None:
        assert await exchange("[]") is SILENCE
        assert await exchange(f"[{call()}, {call(id=None)}]") is SILENCE
        assert await exchange(f" [{call(id=1)} , {call()}, {call('nope', id=2)}]") == [
            status(1),
            error(-32601, "Method not found", 2),
        ]
        assert await exchange(f"[1, {call(id=1)}, [], {{}}]") == [
            error(-32600, "Invalid Request"),
            status(1),
            error(-32600, "Invalid Request"),
        ]
        post = call("server.job_queue.post_job", params={"filenames": "a.gcode", "reset": True}, id=1)
        clear = call("server.job_queue.delete_job", params={"all": True}, id=2)
        done = await exchange(f"[{post},{clear},{post},{clear}]")
        assert [len(answer["result"]["queued_jobs"]) for answer in done] == [1, 0, 1, 0]
        many = await exchange(f"[{','.join(['{}'] * (MAX_BATCH + 1))}]")
        assert [answer["error"]["code"] for answer in many] == [-32600]
        huge = await exchange(f"[{','.join([call('test.big', params={'size': 2**22}, id=1)] * 6)}]")
        assert ["result" in answer for answer in huge] == [True] * 4 + [False] * 2
        assert huge[5]["error"]["code"] == 413

    over_both(case)


def test_non_objects_are_silence_on_the_websocket_and_an_error_over_http() -> None:
    async def run() -> None:
        async with serving() as service, service.client() as client:
            for text in ("5", '"x"', "null", "true"):
                await client.send(text)
                answer = await service.rpc_http(text.encode())
                assert (answer.status, answer.json["error"]["code"]) == (400, 400)
            assert await client.call("server.job_queue.status") == STATUS

    asyncio.run(run())


def test_errors_of_handlers(caplog: pytest.LogCaptureFixture) -> None:
    expected = {
        "400": (400, 400, "no <b>good</b>\nat all"),
        "404": (404, -32601, "Namespace nope not found"),
        "401": (401, -32602, "Unauthorized"),
        "503": (503, 503, "Klippy Host not connected"),
        "invalid": (400, 400, "job_id: must be known"),
        "state": (409, 409, "a job has not ended"),
        "disk": (500, 500, "the disk is full"),
        "link": (503, 503, "the cable is out"),
        "bug": (500, 500, "Internal Server Error"),
        "result": (500, 500, "Internal Server Error"),
    }

    async def case(exchange: Exchange) -> None:
        for how, (_, code, message) in expected.items():
            answer = await exchange(call("test.fail", params={"how": how}, id=1))
            assert answer == error(code, message, 1)

    over_both(case)

    async def over_http() -> None:
        async with serving(*EXTRA) as service:
            for how, (code, _, message) in expected.items():
                answer = await service.http("GET", f"/test/fail?how={how}")
                assert (answer.status, answer.json) == (code, {"error": {"code": code, "message": message}})

    asyncio.run(over_http())
    assert "test.fail failed" in caplog.text
    assert "secret.py" in caplog.text


def test_methods_of_connections_are_not_to_be_had_over_http() -> None:
    async def run() -> None:
        async with serving() as service, service.client() as client:
            answer = await service.rpc_http(call("server.connection.identify", id=1).encode())
            assert answer.json == error(-32601, "Method not found", 1)
            assert await client.call("server.connection.identify") == {
                "code": 400,
                "message": "No data for argument: client_name",
            }
            who = {"client_name": "x", "version": "1", "type": "web", "url": "http://x", "api_key": "k"}
            wrong = await client.call("server.connection.identify", **{**who, "type": "toaster"})
            assert wrong["code"] == 400
            number = (await client.call("server.connection.identify", **who))["connection_id"]
            assert (await client.call("server.websocket.id"))["websocket_id"] == number
            again = await client.call("server.connection.identify", **who)
            assert again["message"].startswith('Connection already identified: {"client_name":"x",')
            assert [connection.identity.client_name for connection in service.connections] == ["x"]

    asyncio.run(run())


def test_routes() -> None:
    async def run() -> None:
        async with serving(*EXTRA) as service:
            path = "/server/job_queue"
            for verb, known, allowed in (
                ("GET", f"{path}/job", "DELETE, POST"),
                ("POST", f"{path}/status", "GET"),
                ("OPTIONS", f"{path}/status", "GET"),
                ("GET", "/server/jsonrpc", "POST"),
            ):
                answer = await service.http(verb, known)
                assert (answer.status, answer.headers["allow"]) == (405, allowed)
                assert answer.json == {"error": {"code": 405, "message": "Method Not Allowed"}}
            for unknown in (path, f"{path}/status/", "/server/job_queue/nope", "/", "/websocketx"):
                answer = await service.http("GET", unknown)
                assert (answer.status, answer.json) == (
                    404,
                    {"error": {"code": 404, "message": "Not Found"}},
                )
            head = await service.http("HEAD", f"{path}/status")
            assert (head.status, head.body, head.headers["content-length"]) == (405, b"", "0")
            assert (await service.http("GET", f"/machines/edm{path}/status")).json == {"result": STATUS}
            assert (await service.http("GET", "/test/echo?toolhead&a=b")).json["result"]["params"] == {
                "objects": {"toolhead": "", "a": "b"}
            }
            assert (await service.http("POST", "/test/echo")).json["result"]["params"] == {"objects": {}}

    asyncio.run(run())


def test_etags() -> None:
    async def run() -> None:
        async with serving(*EXTRA) as service:
            path = "/server/job_queue/status"
            tag = (await service.http("GET", path)).headers["etag"]
            for seen in (tag, f'"x", W/{tag}', "*"):
                answer = await service.http("GET", path, headers={"If-None-Match": seen})
                assert (answer.status, answer.body, answer.headers["etag"]) == (304, b"", tag)
            answer = await service.http("GET", path, headers={"If-None-Match": '"other"'})
            assert (answer.status, answer.json) == (200, {"result": STATUS})
            for verb, other in (("POST", "/server/job_queue/pause"), ("GET", "/nope"), ("GET", "/test/big")):
                assert "etag" not in (await service.http(verb, other)).headers

    asyncio.run(run())


def test_bodies_that_are_too_long() -> None:
    async def run() -> None:
        async with serving() as service:
            for path in ("/server/job_queue/job", "/server/jsonrpc"):
                answer = await service.http("POST", path, b" " * (MAX_BODY + 1))
                assert (answer.status, answer.json["error"]["code"]) == (413, 413)
            assert await chunks(service) == 200

    async def chunks(service: Service) -> int:
        reader, writer = await asyncio.open_connection("127.0.0.1", service.port)
        head = "POST /server/job_queue/job HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
        writer.write(f"{head}Transfer-Encoding: chunked\r\nConnection: close\r\n\r\n".encode())
        writer.write(b'e\r\n{"filenames":"\r\nb\r\na.gcode"}  \r\n0\r\n\r\n')
        answer = await reader.read()
        writer.close()
        return int(answer.split(b" ")[1])

    asyncio.run(run())


def test_methods_are_there_once() -> None:
    methods = Methods(EXTRA)
    assert [method.name for method in methods] == ["test.fail", "test.echo", "test.big"]
    with pytest.raises(ValueError, match="there already"):
        methods.add(Method("test.fail", None, NoParams, fail))
    with pytest.raises(ValueError, match="there already"):
        methods.add(Method("test.other", ("POST", "/test/echo"), NoParams, fail))


@pytest.fixture(autouse=True)
def _quiet(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
