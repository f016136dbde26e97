import asyncio
import socket
from types import SimpleNamespace

import pytest

from tests.links.test_stream import Listener
from toolpost.errors import LinkError
from toolpost.links import net


def exchange(opener, server):
    """Open a link to a listening socket and let a line go each way."""

    async def main():
        heard = Listener()
        link = await opener(heard)
        far, _ = server.accept()
        link.write(b"G1\n")
        assert far.recv(10) == b"G1\n"
        far.send(b"t <>\n")
        far.close()
        async with asyncio.timeout(5):
            while not heard.reasons:
                await asyncio.sleep(0.002)
        assert heard.data == b"t <>\n"
        link.close()

    with server:
        asyncio.run(main())


def refused(opener):
    async def main():
        with pytest.raises(LinkError) as caught:
            await opener(Listener())
        return str(caught.value)

    return asyncio.run(main())


def test_tcp():
    server = socket.create_server(("127.0.0.1", 0))
    exchange(net.tcp_opener("127.0.0.1", server.getsockname()[1]), server)


def test_unix(tmp_path):
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(tmp_path / "s"))
    server.listen()
    exchange(net.unix_opener(tmp_path / "s"), server)


def test_nobody_listens(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    assert refused(net.tcp_opener("127.0.0.1", port)) == f"tcp://127.0.0.1:{port}: Connection refused"
    assert refused(net.unix_opener(tmp_path / "s")) == f"unix:{tmp_path / 's'}: No such file or directory"


def test_nobody_answers(tmp_path, monkeypatch):
    monkeypatch.setattr(net, "_CONNECT_TIMEOUT", 0.01)

    async def never(*_):
        await asyncio.sleep(60)

    monkeypatch.setattr(net, "_connect", never)
    monkeypatch.setattr(net, "socket", SimpleNamespace(AF_UNIX=1, socket=lambda *_: None))
    assert refused(net.unix_opener(tmp_path / "s")) == f"unix:{tmp_path / 's'}: no answer"


def test_a_name_that_cannot_be_one():
    assert refused(net.tcp_opener("a" * 70 + ".example", 1)).endswith(":1: no valid host name")


def test_every_address_of_a_name_is_tried(monkeypatch):
    server = socket.create_server(("127.0.0.1", 0))
    with socket.create_server(("127.0.0.1", 0)) as other:
        dead = other.getsockname()

    async def both(*_, **__):
        kind = (socket.AF_INET, socket.SOCK_STREAM, 0, "")
        return [(*kind, dead), (*kind, server.getsockname())]

    monkeypatch.setattr(asyncio.BaseEventLoop, "getaddrinfo", both)
    exchange(net.tcp_opener("localhost", 1), server)
