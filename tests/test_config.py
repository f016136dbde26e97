"""The configuration: read strictly; every message names the key and the fix (`toolpost.config`)."""

import re
import tomllib
from pathlib import Path

import pytest

from tests.harness import Server, spark_config
from toolpost.config import DEFAULT, Address, load, main_addresses, parse, parse_address
from toolpost.errors import ConfigError
from toolpost.http.server import is_loopback

DOCS = Path(__file__).parents[1] / "docs"
MACHINE = '[machines.edm]\ndriver = "spark"\nlink = "sim"\n'

SURFACE = """
[server]
listen = "127.0.0.1:7125"

[machines.edm]                 # the first machine is the default one
driver = "spark"               # spark | marlin | klipper | …
link = "sim"                   # sim | a serial device or pty path | tcp://host:port | unix:/path
listen = ["127.0.0.1:9000"]    # optional: this machine alone, at the root of its own port

[machines.edm.queue]           # the seed's options, with the seed's defaults
automatic_transition = false
load_on_startup = false
job_transition_delay = 0.01    # seconds
job_transition_gcode = ""
bed = "assume-clear"           # assume-clear | confirm | after-gcode | timer (states.md)
"""


def config_of(text: str):
    return parse(tomllib.loads(text))


def test_surface_of_the_design_parses():
    config = config_of(SURFACE)
    edm = config.machines["edm"]
    assert main_addresses(config.server) == [Address("127.0.0.1", 7125)]
    assert (edm.driver, edm.link, edm.listen) == ("spark", "sim", ("127.0.0.1:9000",))
    assert edm.queue == DEFAULT.machines["sim"].queue, "the seed's defaults are the defaults"


def test_default_is_closed():
    """Moonraker listens on 0.0.0.0 by default and trusts by address (security.md)."""
    assert all(is_loopback(address) for address in main_addresses(DEFAULT.server))
    assert DEFAULT.server.open_networks == DEFAULT.server.origins == DEFAULT.server.hosts == ()


@pytest.mark.parametrize("path", sorted(DOCS.rglob("*.toml")), ids=lambda path: path.name)
def test_example_configurations_parse(path):
    assert load(path).machines


def test_there_are_example_configurations():
    assert list(DOCS.rglob("*.toml"))


def blocks(path: Path) -> list[str]:
    return re.findall(r"^```toml\n(.*?)^```", path.read_text("utf-8"), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("path", sorted(DOCS.rglob("*.md")), ids=lambda path: path.name)
def test_configurations_in_the_documentation_parse(path):
    for block in blocks(path):
        tree = tomllib.loads(block)
        for machine in tree.setdefault("machines", {"edm": {}}).values():
            machine.setdefault("driver", "spark")
            machine.setdefault("link", "sim")
        assert parse(tree)


@pytest.mark.parametrize(
    "link",
    [
        "sim",
        "/dev/ttyACM0",
        "/dev/serial/by-id/usb-x",
        "tcp://spark.local:23",
        "tcp://[::1]:23",
        "unix:/run/x",
    ],
)
def test_links(link):
    assert config_of(f'[machines.edm]\ndriver = "spark"\nlink = "{link}"').machines["edm"].link == link


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("127.0.0.1:7125", Address("127.0.0.1", 7125)),
        ("[::1]:0", Address("::1", 0)),
        ("localhost:80", Address("localhost", 80)),
    ],
)
def test_addresses(text, address):
    assert parse_address(text, "key") == address
    assert str(address) == text


def test_several_listeners():
    config = config_of(f'[server]\nlisten = ["127.0.0.1:1", "[::1]:2"]\n{MACHINE}')
    assert [address.port for address in main_addresses(config.server)] == [1, 2]


WRONG = [
    # unknown keys, at each level
    ("[servr]\n" + MACHINE, ["servr", "did you mean server"]),
    ("[nothing_like_it]\n" + MACHINE, ["nothing_like_it", "known are", "machines"]),
    ("[server]\nlistn = 1\n" + MACHINE, ["server.listn", "did you mean listen"]),
    ("[storage]\nprogram_bytes = 1\n" + MACHINE, ["storage.program_bytes", "did you mean programs_bytes"]),
    ("[telemetry]\nmax_byte = 1\n" + MACHINE, ["telemetry.max_byte", "did you mean max_bytes"]),
    (MACHINE + "bauds = 1", ["machines.edm.bauds", "did you mean baud"]),
    (MACHINE + "zzz = 1", ["machines.edm.zzz", "known are", "driver"]),
    (
        MACHINE + "[machines.edm.queue]\nautomatic = true",
        ["machines.edm.queue.automatic", "automatic_transition"],
    ),
    (MACHINE + "[machines.edm.spark]\nholdoff = 1", ["machines.edm.spark.holdoff", "did you mean hold_off"]),
    (MACHINE + "[machines.edm.sim]\ncapacty = 1", ["machines.edm.sim.capacty", "did you mean capacity"]),
    (
        MACHINE + "[machines.edm.log]\nfile_byte = 1",
        ["machines.edm.log.file_byte", "did you mean file_bytes"],
    ),
    (MACHINE + "[machines.edm.history]\nshow = 1", ["machines.edm.history.show", "did you mean shown"]),
    (MACHINE + "[machines.edm.spooler]\nfail = 1", ["machines.edm.spooler.fail", "did you mean failed"]),
    # wrong types and values
    ("server = 5\n" + MACHINE, ["server", "object"]),
    ("[server]\nlisten = 7125\n" + MACHINE, ["server.listen", "str"]),
    ('[server]\nhosts = "x"\n' + MACHINE, ["server.hosts", "array"]),
    ("[server]\nmax_body_bytes = 0\n" + MACHINE, ["server.max_body_bytes", ">= 1"]),
    ('[server]\nmax_connections = "many"\n' + MACHINE, ["server.max_connections", "int"]),
    ("[storage]\nprograms_bytes = -1\n" + MACHINE, ["storage.programs_bytes", ">= 1"]),
    ("[telemetry]\nmax_age_s = 'x'\n" + MACHINE, ["telemetry.max_age_s", "float"]),
    (MACHINE + "baud = 0", ["machines.edm.baud", ">= 1"]),
    (MACHINE + "auto_init = 1", ["machines.edm.auto_init", "bool"]),
    (
        MACHINE + "[machines.edm.queue]\nload_on_startup = 'no'",
        ["machines.edm.queue.load_on_startup", "bool"],
    ),
    (MACHINE + "[machines.edm.queue]\njob_transition_delay = -1", ["queue.job_transition_delay", ">= 0"]),
    (MACHINE + "[machines.edm.queue]\nbed = 'clear'", ["machines.edm.queue.bed", "clear"]),
    (MACHINE + "[machines.edm.spooler]\nfailed = 'BROKEN'", ["machines.edm.spooler.failed", "BROKEN"]),
    (MACHINE + "[machines.edm.sim]\ncapacity = 0", ["machines.edm.sim", "capacity"]),
    (MACHINE + "[machines.edm.sim]\ncommand_time = -1", ["machines.edm.sim", "command_time"]),
    (MACHINE + "[machines.edm.sim]\nfaults = ['explode']", ["machines.edm.sim.faults", "explode", "reboot"]),
    # what is missing
    ("", ["machines", "[machines.edm]"]),
    ("machines = 5", ["machines", "[machines.edm]"]),
    ("[machines]", ["machines", "[machines.edm]"]),
    ("[machines]\nedm = 5", ["machines.edm", "object"]),
    ('[machines.edm]\nlink = "sim"', ["machines.edm.driver", "missing"]),
    ('[machines.edm]\ndriver = "spark"', ["machines.edm.link", "missing"]),
    # drivers, links, addresses, names
    ('[machines.edm]\ndriver = "sprak"\nlink = "sim"', ["machines.edm.driver", "sprak", "spark"]),
    ('[machines.edm]\ndriver = "spark"\nlink = ""', ["machines.edm.link", "tcp://HOST:PORT"]),
    ('[machines.edm]\ndriver = "spark"\nlink = "COM3"', ["machines.edm.link", "COM3", "/dev/serial"]),
    ('[machines.edm]\ndriver = "spark"\nlink = "dev/ttyACM0"', ["machines.edm.link", "/dev/serial"]),
    ('[machines.edm]\ndriver = "spark"\nlink = "http://x:1"', ["machines.edm.link", "tcp://HOST:PORT"]),
    ('[machines.edm]\ndriver = "spark"\nlink = "tcp://x"', ["machines.edm.link", "tcp://HOST:PORT"]),
    ('[machines.edm]\ndriver = "spark"\nlink = "tcp:x:5"', ["machines.edm.link", "tcp://HOST:PORT"]),
    ('[machines.edm]\ndriver = "spark"\nlink = "tcp://x:99999"', ["machines.edm.link", "tcp://HOST:PORT"]),
    ('[machines.edm]\ndriver = "spark"\nlink = "tcp://[::1:5"', ["machines.edm.link", "tcp://HOST:PORT"]),
    ('[machines.edm]\ndriver = "spark"\nlink = "unix:run/x"', ["machines.edm.link", "unix:/absolute/path"]),
    *[
        (f'[server]\nlisten = "{text}"\n{MACHINE}', ["server.listen", "HOST:PORT"])
        for text in (
            "",
            "7125",
            "localhost",
            ":80",
            "x:99999",
            "x:-1",
            "::1:80",
            "[::1]",
            "http://x:80",
            "x:80/",
        )
    ],
    (MACHINE + 'listen = ["x"]', ["machines.edm.listen", "HOST:PORT"]),
    (MACHINE + 'listen = "127.0.0.1:1"', ["machines.edm.listen", "array"]),
    *[
        (f'[machines."{name}"]\ndriver = "spark"\nlink = "sim"', ["machines.", "letters, digits"])
        for name in ("a b", "../etc", "", "-x", "x/y", "é", "x" * 65, "$(reboot)")
    ],
]


@pytest.mark.parametrize(("text", "words"), WRONG, ids=lambda value: str(value)[:50])
def test_message_names_the_key_and_the_fix(tmp_path, text, words):
    path = tmp_path / "toolpost.toml"
    path.write_text(text, "utf-8")
    with pytest.raises(ConfigError) as caught:
        load(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    assert [word for word in words if word not in message] == [], message


@pytest.mark.parametrize(
    ("content", "word"),
    [(b"[server", "Expected"), (b"a = \xff", "utf-8"), (b"[a]\n[a]", "line 2"), (b"x", "Expected")],
)
def test_what_is_no_toml(tmp_path, content, word):
    path = tmp_path / "toolpost.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=f"toolpost.toml: .*{word}"):
        load(path)


def test_file_that_cannot_be_read(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml: No such file"):
        load(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="directory"):
        load(tmp_path)


@pytest.mark.parametrize("network", ["x", "192.168.1.5/24", "10.0.0.0/33", ""])
def test_bad_network(network):
    with pytest.raises(ConfigError, match=r"server\.open_networks: .*192\.168\.1\.0/24"):
        config_of(f'[server]\nopen_networks = ["{network}"]\n{MACHINE}')


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (f"{MACHINE}[machines.edm.spark]\nhold_off = -1", "machines.edm.spark.hold_off"),
        (f"{MACHINE}[machines.edm.spark]\nhold_off = nan", "machines.edm.spark.hold_off"),
        (f"{MACHINE}[machines.edm.spark]\nanswer_timeout = 0", "machines.edm.spark.answer_timeout"),
        (f"{MACHINE}[machines.edm.log]\nfile_bytes = 0", "machines.edm.log.file_bytes"),
        (f"{MACHINE}[machines.edm.sim]\nfaults = ['nonsense']", "machines.edm.sim.faults"),
        (f"{MACHINE}[machines.edm.sim]\ncapacity = 0", "machines.edm.sim"),
        (f"[telemetry]\nring_reports = -1\n{MACHINE}", "telemetry.ring_reports"),
        (f"[server]\nlisten = []\n{MACHINE}", "server.listen"),
    ],
)
def test_values_out_of_range(text, key):
    with pytest.raises(ConfigError, match=f"^{re.escape(key)}: "):
        config_of(text)


def test_two_machines_cannot_share_a_device():
    machine = 'driver = "spark"\nlink = "/dev/ttyACM0"\n'
    with pytest.raises(ConfigError, match=r"machines\.b\.link: .* machines\.a already"):
        config_of(f"[machines.a]\n{machine}[machines.b]\n{machine}")


QUEUE_OPTIONS = {"bed": '"confirm"'}


def test_queue_options_without_effect_are_named_at_the_start(tmp_path):
    """An option that does nothing must not look as if it did."""
    options = "\n".join(f"{name} = {value}" for name, value in QUEUE_OPTIONS.items())
    with Server(tmp_path, spark_config(more=f"[machines.edm.queue]\n{options}")) as server:
        warnings = [line for line in server.log.splitlines() if "WARNING" in line]
    for name in QUEUE_OPTIONS:
        assert any(f"machines.edm.queue.{name}" in line and "no effect" in line for line in warnings), name
    assert len(warnings) == len(QUEUE_OPTIONS)


def test_queue_options_at_their_defaults_are_not_mentioned(tmp_path):
    with Server(tmp_path, SURFACE.replace("7125", "0").replace("9000", "0"), listeners=2) as server:
        assert "queue" not in server.log
