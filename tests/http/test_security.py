"""One test for each known fault of other servers that this one could have (security.md, section 1)."""

import hashlib
import re
import socket
from pathlib import Path

import pytest
from tests.harness import (
    JSON,
    Client,
    Port,
    Server,
    raw_connection,
    spark_config,
    wait_until,
)
from tests.harness import (
    toolpost as run_toolpost,
)

import toolpost
from toolpost.http.gate import FailureLimit
from toolpost.store import keys

ENDPOINTS = [
    "/write-line",
    "/get-ps",
    "/status",
    "/cancel",
    "/set-init",
    "/get-init",
    "/add-job",
    "/list-jobs",
]
ENDPOINTS += ["/query-ts"]
BODY_LIMIT = 2**20

LOCAL = f"""
[server]
listen = "127.0.0.1:0"
hosts = ["Workshop.example"]
origins = ["https://dash.example/"]
max_body_bytes = {BODY_LIMIT}
[machines.edm]
driver = "spark"
link = "sim"
"""


def exposed_config(more: str = "") -> str:
    listen = '["127.0.0.1:0", "0.0.0.0:0"]'
    return f'[server]\nlisten = {listen}\n{more}\n[machines.edm]\ndriver = "spark"\nlink = "sim"'


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    with Server(tmp_path_factory.mktemp("local"), LOCAL) as server:
        yield server


@pytest.fixture(scope="module")
def exposed(tmp_path_factory):
    """A server that listens on all addresses too, a key for it, and a client there, which has none."""
    with Server(tmp_path_factory.mktemp("exposed"), exposed_config(), listeners=2) as server:
        done = run_toolpost("key", "add", "phone", "--data", server.data)
        assert done.returncode == 0, done.stderr
        yield server, done.stdout.strip(), server.client_of(1)


# "Any web page the user visits can move the machine" (Spark spooler HEAD; CVE-2023-31061)


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:80",
        "localhost.evil.example",
        "127.0.0.1.evil.example",
        "evil-localhost",
        "workshop.example.evil",
        "",
        "[::1].evil.example",
        "[",
        "\xff",
    ],
)
@pytest.mark.parametrize("path", ["/status", "/nothing"])
def test_dns_rebinding(local, host, path):
    """A hostile name that points here is no name of this server."""
    answer = local.client.post(path, {}, {"Host": host})
    assert (answer.status, "Host" in answer.text) == (403, True)


def test_dns_rebinding_without_a_host(local):
    for head in ("POST /status HTTP/1.0", "POST /status HTTP/1.1"):
        with raw_connection(local) as connection:
            connection.sendall(f"{head}\r\nContent-Length: 2\r\n\r\n{{}}".encode())
            assert re.match(rb"HTTP/1\.[01] 40[03] ", connection.recv(1000))


def test_dns_rebinding_with_two_hosts(local):
    """RFC 9112, section 3.2: a request with more than one Host is refused, in whichever order they come."""
    for hosts in (["evil.example", "localhost"], ["localhost", "evil.example"]):
        with raw_connection(local) as connection:
            lines = "".join(f"Host: {host}\r\n" for host in hosts)
            connection.sendall(f"POST /status HTTP/1.1\r\n{lines}Content-Length: 2\r\n\r\n{{}}".encode())
            assert re.match(rb"HTTP/1\.1 40[03] ", connection.recv(1000))


@pytest.mark.parametrize(
    "host",
    [
        "localhost",
        "LOCALHOST:9000",
        "127.0.0.1",
        "[::1]:80",
        "192.168.1.5:7125",
        "workshop.example",
        "[fe80::1]",
        socket.gethostname(),
        socket.gethostname() + ".local",
    ],
)
def test_own_names_are_let_in(local, host):
    assert local.client.post("/status", {}, {"Host": host}).status == 200


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "https://evil.example:7125",
        "null",
        "",
        "file://",
        "http://localhost.evil.example",
        "http://127.0.0.1.evil.example",
        "http://localhost@evil.example",
        "http://localhost:80@evil.example",
        "http://dash.example",
        "https://dash.example:8443",
        "https://dash.example.evil",
        "ftp://localhost",
        "http://[",
        "http://[::1",
        "http://\xff",
        "localhost",
    ],
)
@pytest.mark.parametrize("method", ["POST", "OPTIONS"])
def test_page_of_another_origin(local, origin, method):
    answer = local.client.request(method, "/write-line", '{"line":"G0 X1"}', {**JSON, "Origin": origin})
    assert (answer.status, "Origin" in answer.text) == (403, True)
    assert not [name for name in answer.headers if name.startswith("access-control")]


@pytest.mark.parametrize(
    "origin",
    [
        "http://localhost",
        "http://localhost:5173",
        "https://localhost:1",
        "http://127.0.0.1:8080",
        "http://[::1]:3000",
        "HTTP://LOCALHOST:5173",
        "https://dash.example",
    ],
)
def test_allowed_origin_gets_cors_headers_for_itself_alone(local, origin):
    """The web client that exists is served from another port of localhost."""
    for answer in (
        local.client.post("/status", {}, {"Origin": origin}),
        local.client.post("/status", b"?", {"Origin": origin}),
        local.client.request("OPTIONS", "/status", None, {"Origin": origin}),
    ):
        assert answer.status in {200, 204, 400}
        assert answer.headers["access-control-allow-origin"] == origin
        assert answer.headers["vary"] == "Origin"
    assert "*" not in str(answer.headers)


def test_page_of_this_server_is_let_in(local):
    headers = {"Host": "workshop.example:7125", "Origin": "http://workshop.example:7125"}
    assert local.client.post("/status", {}, headers).status == 200
    headers["Origin"] = "http://workshop.example"
    assert local.client.post("/status", {}, headers).status == 403


def test_no_origin_gets_no_cors_headers(local):
    assert not [
        name for name in local.client.post("/status", {}).headers if name.startswith("access-control")
    ]


@pytest.mark.parametrize("endpoint", ENDPOINTS)
@pytest.mark.parametrize(
    "content_type",
    [
        "text/plain",
        "TEXT/PLAIN",
        "text/plain;charset=UTF-8",
        " text/plain ; application/json",
        "application/x-www-form-urlencoded",
        "multipart/form-data; boundary=x",
    ],
)
def test_csrf_by_a_simple_content_type(local, endpoint, content_type):
    """A form or ``fetch`` of any page sends these without a preflight."""
    for extra in ({}, {"Origin": "http://localhost"}, {"Sec-Fetch-Site": "cross-site"}):
        answer = local.client.request("POST", endpoint, b"{}", {"Content-Type": content_type, **extra})
        assert (answer.status, "Content-Type" in answer.text) == (400, True)


@pytest.mark.parametrize("header", ["Origin", "Sec-Fetch-Site", "Sec-Fetch-Mode"])
def test_csrf_without_a_content_type(local, header):
    """As ``sendBeacon`` does with a blob of no type; a program without one is let in."""
    value = "http://localhost" if header == "Origin" else "cors"
    assert local.client.request("POST", "/status", b"{}", {header: value}).status == 400
    assert local.client.request("POST", "/status", b"{}").status == 200


@pytest.mark.parametrize("endpoint", ENDPOINTS)
def test_csrf_by_a_link(local, endpoint):
    """A GET, such as that of an image, does nothing."""
    assert local.client.request("GET", endpoint + '?line=!&body={"line":"!"}').status == 400
    assert ("down", "!") not in local.comm_log()


# Keys


def test_cve_2026_23892_key_compared_in_constant_time(monkeypatch):
    compared = []

    def compare(one, other):
        compared.append((one, other))
        return one == other

    class Database:
        def changed_elsewhere(self):
            return False

        def read(self, _name):
            return [("a", hashlib.sha256(b"one").digest(), 0), ("b", hashlib.sha256(b"two").digest(), 0)]

    monkeypatch.setattr(keys.hmac, "compare_digest", compare)
    store = keys.KeyStore(Database())
    assert store.owner("one") == "a"
    assert len(compared) == 2, "the search must not end at the first match"
    assert store.owner("onf") is None
    assert store.owner("") is None
    assert all(len(one) == len(other) == 32 for one, other in compared)


def test_keys_are_hashed_on_disk(exposed):
    server, key, _ = exposed
    stored = b"".join(path.read_bytes() for path in server.data.rglob("*") if path.is_file())
    assert key.encode() not in stored
    assert hashlib.sha256(key.encode()).digest() in stored
    assert len(key) >= 43, "256 bits"


def test_key_is_in_no_log(exposed):
    server, key, outside = exposed
    outside.post("/status", {}, {"X-Api-Key": key})
    outside.post("/status", {}, {"X-Api-Key": key[:-1]})
    assert key[:-1] not in server.log


@pytest.mark.parametrize(
    "form", ["X-Api-Key: {}", "x-api-key: {}", "Authorization: Bearer {}", "Authorization: bearer {}"]
)
def test_key_lets_in(exposed, form):
    _, key, outside = exposed
    name, _, value = form.format(key).partition(": ")
    assert outside.post("/status", {}, {name: value}).status == 200


def test_key_is_taken_from_headers_only(exposed):
    """What stands in an address ends up in histories and logs."""
    _, key, outside = exposed
    for path in (f"/status?apikey={key}", f"/status?token={key}", f"/status?X-Api-Key={key}"):
        assert (
            outside.post(path, {"apikey": key, "X-Api-Key": key}, {"Cookie": f"X-Api-Key={key}"}).status
            == 401
        )


@pytest.mark.parametrize("wrong", ["", " ", "x", "\xff", "' OR 1=1 --", "*)(uid=*))(|(uid=*", "x" * 5000])
def test_ldap_and_sql_characters_in_a_key(exposed, wrong):
    """Moonraker CVE-2026-24130: what logs in is data."""
    _, _, outside = exposed
    assert outside.post("/status", {}, {"X-Api-Key": wrong}).status in {401, 429}


# Addresses are no identities


@pytest.mark.parametrize("method", ["GET", "POST", "PUT", "DELETE"])
@pytest.mark.parametrize(
    "path",
    [
        *ENDPOINTS,
        *(f"/machines/edm{path}" for path in ENDPOINTS),
        "/",
        "/nothing",
        "/machines/none/status",
        "//status",
        "/status/",
        "/api/version",
        "/server/info",
        "/?x",
    ],
)
def test_cve_2025_32788_deny_by_default(exposed, method, path):
    """Without a key nothing is answered on an open address, not even which paths there are."""
    _, _, outside = exposed
    answer = outside.request(method, path, b"{}", JSON)
    assert (answer.status, "key" in answer.text) == (401, True)


def test_sans_2018_fresh_install_lets_nobody_in(tmp_path):
    """3,759 OctoPrints without a login."""
    with Server(tmp_path, exposed_config(), listeners=2) as server:
        assert server.client_of(1).post("/status", {}).status == 401
        assert "nobody can come in" in server.log
        assert server.client.post("/status", {}).status == 200


def test_spaghetti_detective_2021_two_clients_behind_one_address(exposed):
    """The address of a client that has a key is not let in for that."""
    server, key, outside = exposed
    other = Client(server.urls[1])
    for _ in range(3):
        assert outside.post("/status", {}, {"X-Api-Key": key}).status == 200
        assert other.post("/status", {}).status == 401
        assert outside.post("/status", {}).status == 401, "nor is its connection"
    other.close()


@pytest.mark.parametrize(
    "header",
    [
        "X-Forwarded-For: 127.0.0.1",
        "X-Real-IP: 127.0.0.1",
        "Forwarded: for=127.0.0.1;host=localhost;proto=https",
        "X-Client-IP: 127.0.0.1",
        "True-Client-IP: 127.0.0.1",
        "X-Forwarded-Host: localhost",
        "X-Forwarded-Proto: https",
        "X-Scheme: https",
        "X-Script-Name: /x",
        "Via: 1.1 localhost",
    ],
)
def test_cve_2024_32977_forwarded_headers(exposed, local, header):
    _, _, outside = exposed
    name, _, value = header.partition(": ")
    assert outside.post("/status", {}, {name: value}).status == 401
    assert local.client.post("/status", {}, {name: value, "Host": "evil.example"}).status == 403


def test_forwarded_for_does_not_open_a_network(tmp_path):
    with Server(tmp_path, exposed_config('open_networks = ["10.0.0.0/8"]'), listeners=2) as server:
        outside = server.client_of(1)
        assert outside.post("/status", {}).status == 401
        assert outside.post("/status", {}, {"X-Forwarded-For": "10.1.2.3"}).status == 401


def test_open_network_is_open_and_said_so_loudly(tmp_path):
    config = exposed_config('open_networks = ["127.0.0.0/8", "fd00::/8"]')
    with Server(tmp_path, config, listeners=2) as server:
        outside = server.client_of(1)
        assert outside.post("/status", {}).status == 200
        assert outside.post("/status", {}, {"X-Api-Key": "wrong"}).status == 401, "a wrong key is still wrong"
        assert outside.post("/status", {}, {"Origin": "http://evil.example"}).status == 403
        for _ in range(2):
            warning = next(line for line in server.log.splitlines() if "WARNING" in line and "ANYONE" in line)
            assert "127.0.0.0/8, fd00::/8" in warning
            assert "server.open_networks" in warning
            server.stop()
            server.start()


def test_cve_2022_2822_guessing_keys(tmp_path):
    """Wrong keys are slowed down by address; right keys and the loopback listener are not."""
    with Server(tmp_path, exposed_config(), listeners=2) as server:
        key = run_toolpost("key", "add", "phone", "--data", server.data).stdout.strip()
        outside = server.client_of(1)
        answers = [outside.post("/status", {}, {"X-Api-Key": f"guess{n}"}).status for n in range(30)]
        assert answers == sorted(answers)
        assert set(answers) == {401, 429}
        assert outside.post("/status", {}, {"X-Api-Key": key}).status == 200
        assert outside.post("/status", {}, {"X-Api-Key": "guess"}).status == 429
        assert server.client.post("/status", {}).status == 200


def test_guesses_are_forgotten_after_a_minute_and_bounded():
    now = 0.0
    limit = FailureLimit(lambda: now)
    for _ in range(100):
        limit.add("attacker")
    assert limit.exceeded("attacker")
    assert not limit.exceeded("other")
    now = 61.0
    assert not limit.exceeded("attacker")
    limit.add("attacker")
    assert not limit.exceeded("attacker")
    for number in range(5000):
        limit.add(f"peer{number}")
    assert len(limit._failures) <= 1024


# Hostile content: CVE-2025-64187, CVE-2026-35163, CVE-2024-49377, CVE-2024-28237, CVE-2022-1430,
# CVE-2021-32561


def test_xss_from_the_machines_own_messages(tmp_path):
    with Port() as port, Server(tmp_path, spark_config(port.path)) as server:
        wait_until(lambda: server.client.call("/status")["device_alive"])
        port.say(b'error < msg:"<script>alert(1)</script>\x1b[2J\x00\xff\x07" >\r\n')
        port.say(b"<img src=x onerror=alert(1)>\x1b]0;owned\x07\r\n")
        port.say(b'evil < html:"<b>&amp;</b>" quote:"\\"" >\r\n')
        wait_until(lambda: server.client.call("/get-ps", tag="evil")["pstates"])
        for tag in ("error", "evil"):
            answer = server.client.post("/get-ps", {"tag": tag})
            assert answer.headers["content-type"] == "application/json"
            assert answer.headers["x-content-type-options"] == "nosniff"
            assert answer.json["pstates"], tag
            assert not re.search(rb"[\x00-\x09\x0b-\x1f\x7f-\xff]", answer.body)
        assert server.stop() == 0
        logged = b"".join(path.read_bytes() for path in server.data.glob("logs/*"))
        assert b"<script>alert(1)</script>\\x1b[2J\\x00\\xff\\x07" in logged
        assert not re.search(rb"[^\x20-\x7e\n]", logged)
        assert not re.search(r"[^\x20-\x7e\n]", server.log)


def test_error_texts_are_no_html(local):
    for body in (b'{"line":"\\u003cscript>\\n"}', b"<script>", b'{"<script>":NaN}'):
        answer = local.client.post("/write-line", body)
        assert answer.headers["content-type"] == "text/plain; charset=utf-8"
        assert answer.headers["x-content-type-options"] == "nosniff"
    answer = local.client.post("/<script>alert(1)</script>", {})
    assert answer.headers["content-type"].startswith("text/plain")
    assert b"<script>" not in answer.body


def test_cve_2025_58180_no_shell_anywhere():
    """What runs no program runs none by mistake."""
    shells = re.compile(
        r"\bsubprocess\b|os\.system|os\.popen|os\.exec|os\.spawn|\beval\(|\bexec\(|pickle|shell=True"
    )
    for path in Path(toolpost.__file__).parent.rglob("*.py"):
        assert not shells.search(path.read_text()), path


@pytest.mark.parametrize(
    "path",
    [
        "//status",
        "/status/",
        "/./status",
        "/x/../status",
        "/machines/../status",
        "/machines/edm/../../status",
        "/%2e%2e/status",
        "/%2e/status",
        "/..%5cstatus",
        "/..%2fstatus",
        "/status%00",
        "/status%00.html",
        "/status%20",
        "/%252e%252e/status",
        "/machines/..%2f..%2ftoolpost.db",
        "/toolpost.db",
        "/C:/status",
        "/\\status",
        "/status%ff",
        "/status;x=1",
    ],
)
def test_cve_2023_31059_path_traversal(local, path):
    answer = local.client.post(path, {})
    assert answer.status == 404, answer
    assert "location" not in answer.headers
