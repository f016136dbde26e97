"""The clients' database over HTTP and JSON-RPC, in a server that is killed."""

import asyncio
import json
from collections.abc import Iterator
from typing import Any
from urllib.parse import quote

import pytest
from tests.dialects.moonraker.live import config, machine, site
from tests.harness import Server

ITEM = "/server/database/item"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("database")
    with Server(folder, config(machine("edm"), machine("mill"))) as server:
        yield server


@pytest.fixture(autouse=True)
def _empty(server: Server) -> None:
    for name in server.client.request("GET", "/server/database/list").json["result"]["namespaces"]:
        for key in rpc(server, "get_item", namespace=name)["value"]:
            rpc(server, "delete_item", namespace=name, key=[key])


def answer(server: Server, method: str, /, **params: Any) -> Any:
    call = {"jsonrpc": "2.0", "method": f"server.database.{method}", "params": params, "id": 1}
    return server.client.call("/server/jsonrpc", **call)


def rpc(server: Server, method: str, /, **params: Any) -> Any:
    return answer(server, method, **params)["result"]


def test_items_over_http(server: Server) -> None:
    client = server.client
    assert client.request("GET", "/server/database/list").json == {
        "result": {"namespaces": [], "backups": []}
    }
    item = {"namespace": "ui", "key": "settings.console", "value": {"on": True}}
    assert client.call(ITEM, **item) == {"result": item}
    assert client.request("GET", f"{ITEM}?namespace=ui&key=settings.console").json == {"result": item}
    whole = {"namespace": "ui", "key": None, "value": {"settings": {"console": {"on": True}}}}
    assert client.request("GET", f"{ITEM}?namespace=ui").json == {"result": whole}
    typed = client.request("POST", f"{ITEM}?namespace=ui&key=count&value:int=5").json
    assert typed == {"result": {"namespace": "ui", "key": "count", "value": 5}}
    deleted = client.request("DELETE", f"{ITEM}?namespace=ui&key=settings").json
    assert deleted["result"]["value"] == {"console": {"on": True}}
    assert client.request("GET", f"{ITEM}?namespace=ui").json["result"]["value"] == {"count": 5}


def test_a_key_may_be_a_list_so_that_its_parts_may_have_dots(server: Server) -> None:
    item = {"namespace": "ui", "key": ["files", "a.gcode"], "value": [1, None]}
    assert rpc(server, "post_item", **item) == item
    assert rpc(server, "get_item", namespace="ui", key=["files", "a.gcode"]) == item
    assert rpc(server, "get_item", namespace="ui")["value"] == {"files": {"a.gcode": [1, None]}}
    hinted = f"{ITEM}?namespace=ui&key:json={quote(json.dumps(item['key']))}"
    assert server.client.request("GET", hinted).json["result"] == item
    assert rpc(server, "delete_item", namespace="ui", key=["files", "a.gcode"]) == item
    assert rpc(server, "list") == {"namespaces": ["ui"], "backups": []}
    rpc(server, "delete_item", namespace="ui", key="files")
    assert rpc(server, "list") == {"namespaces": [], "backups": []}


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"namespace": "nope"}, "Namespace nope not found"),
        ({"namespace": "nope", "key": "a"}, "Namespace nope not found"),
        ({"namespace": "ui", "key": "x"}, "Key 'x' in namespace 'ui' not found"),
        ({"namespace": "ui", "key": "a.x"}, "Key 'a.x' in namespace 'ui' not found"),
        ({"namespace": "ui", "key": ["a", "x"]}, "Key 'a.x' in namespace 'ui' not found"),
    ],
)
def test_what_is_not_there(server: Server, params: dict[str, Any], message: str) -> None:
    rpc(server, "post_item", namespace="ui", key="a", value=1)
    methods = ["get_item", "delete_item"] if "key" in params else ["get_item"]
    for method in methods:
        assert answer(server, method, **params)["error"] == {"code": -32601, "message": message}
    found = server.client.request("GET", ITEM, params, {"Content-Type": "application/json"})
    assert (found.status, found.json) == (404, {"error": {"code": 404, "message": message}})


@pytest.mark.parametrize(
    ("method", "params", "message"),
    [
        ("get_item", {}, "No data for argument: namespace"),
        ("get_item", {"namespace": "ui", "key": ""}, "key: must not be empty"),
        ("get_item", {"namespace": "ui", "key": []}, "key: must not be empty"),
        ("get_item", {"namespace": "ui", "key": "a..b"}, "key: must have no empty part"),
        ("get_item", {"namespace": "ui", "key": 5}, "Invalid value received for argument 'key'.  Expected"),
        ("get_item", {"namespace": "ui", "key": ["a", 5]}, "Invalid value received for argument 'key'."),
        ("get_item", {"namespace": ["ui"]}, "Unable to convert argument [namespace] to <class 'str'>"),
        ("post_item", {"namespace": "ui", "key": "a"}, "No data for argument: value"),
        ("post_item", {"namespace": "ui", "value": 1}, "No data for argument: key"),
        ("post_item", {"namespace": "ui", "key": None, "value": 1}, "Invalid value received for"),
        ("post_item", {"namespace": "", "key": "a", "value": 1}, "namespace: must have 1 to 128"),
        ("post_item", {"namespace": "ui", "key": "k" * 2000, "value": 1}, "key: must have at most 1024"),
        (
            "post_item",
            {"namespace": "ui", "key": "a", "value": "x" * 2**20},
            "value: must be at most 1048576",
        ),
        ("delete_item", {"namespace": "ui"}, "No data for argument: key"),
    ],
)
def test_bad_input(server: Server, method: str, params: dict[str, Any], message: str) -> None:
    error = answer(server, method, **params)["error"]
    assert (error["code"], error["message"][: len(message)]) == (400, message)
    verb = {"get_item": "GET", "post_item": "POST", "delete_item": "DELETE"}[method]
    refused = server.client.request(verb, ITEM, params, {"Content-Type": "application/json"})
    assert (refused.status, refused.json["error"]) == (400, error)
    assert rpc(server, "list")["namespaces"] == []


def test_long_numbers_are_kept_exactly(server: Server) -> None:
    server.client.request("POST", f"{ITEM}?namespace=ui&key=a.b&value:int={10**30}")
    rpc(server, "post_item", namespace="ui", key="a.c", value=-(10**30) - 1)
    assert rpc(server, "get_item", namespace="ui", key="a")["value"] == {"b": 10**30, "c": -(10**30) - 1}


def test_what_a_value_holds_is_not_overwritten_by_a_key_through_it(server: Server) -> None:
    rpc(server, "post_item", namespace="ui", key="a", value=[1])
    error = answer(server, "post_item", namespace="ui", key="a.b", value=1)["error"]
    assert error == {"code": 400, "message": "key: what is at 'a' is no object"}


def test_backups_are_no_method(server: Server) -> None:
    for method in ("compact", "post_backup", "restore"):
        assert answer(server, method)["error"] == {"code": -32601, "message": "Method not found"}
    assert server.client.request("POST", "/server/database/backup").status == 404


def test_all_machines_share_it(server: Server) -> None:
    async def run() -> None:
        async with site(server, "mill").client() as mill, site(server).client() as edm:
            await mill.call("server.database.post_item", namespace="ui", key="a", value=1)
            found = await edm.call("server.database.get_item", namespace="ui", key="a")
            assert found == {"namespace": "ui", "key": "a", "value": 1}

    asyncio.run(run())


def test_a_batch_is_worked_off_in_order(server: Server) -> None:
    posts = [
        {"jsonrpc": "2.0", "method": "server.database.post_item", "id": number,
         "params": {"namespace": "ui", "key": f"list.k{number}", "value": number}}
        for number in range(20)
    ]  # fmt: skip
    answers = server.client.post("/server/jsonrpc", posts).json
    assert [one["result"]["value"] for one in answers] == list(range(20))
    value = rpc(server, "get_item", namespace="ui", key="list")["value"]
    assert value == {f"k{number}": number for number in range(20)}


def test_what_was_answered_is_there_after_a_kill(tmp_path_factory: pytest.TempPathFactory) -> None:
    with Server(tmp_path_factory.mktemp("killed"), config(machine("edm"))) as server:
        for number in range(3):
            server.client.call(ITEM, namespace="ui", key=f"a.k{number}", value=number)
            server.kill()
            server.start()
            value = rpc(server, "get_item", namespace="ui", key="a")["value"]
            assert value == {f"k{before}": before for before in range(number + 1)}
        rpc(server, "delete_item", namespace="ui", key="a")
        server.kill()
        server.start()
        assert rpc(server, "list")["namespaces"] == []
