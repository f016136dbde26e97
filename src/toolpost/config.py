"""The configuration: a TOML file, read strictly, with errors that name the key and the fix."""

import difflib
import ipaddress
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta

from toolpost.commlog import CommLogLimits
from toolpost.drivers.spark.options import SparkOptions
from toolpost.errors import ConfigError
from toolpost.sim.faults import Fault
from toolpost.sim.options import SimulatedSparkOptions
from toolpost.telemetry.limits import Limits as TelemetryLimits

DRIVERS: Final = ("spark",)
"""The drivers of this version."""

_NOT_YET: Final = ("bed",)

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_ADDRESS = re.compile(r"(?:\[(?P<ipv6>[0-9a-fA-F:.]+)\]|(?P<host>[^\[\]:]+)):(?P<port>\d{1,5})")

Positive = Annotated[int, Meta(ge=1)]
Seconds = Annotated[float, Meta(ge=0)]


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the file; every key may be left out, and no other key may be there."""


class Address(msgspec.Struct, frozen=True):
    """Where a listener listens."""

    host: str
    port: int

    def __str__(self) -> str:
        """Return ``host:port``, IPv6 in brackets."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class QueueConfig(_Table, frozen=True, kw_only=True):
    """A machine's queue (moonraker_job_queue.md; bed: states of the bed).

    Attributes:
        automatic_transition: start the next job when one is completed.
        load_on_startup: jobs that wait when Toolpost starts may start; otherwise they are held.
        job_transition_delay: seconds between two jobs.
        job_transition_gcode: commands between two jobs.
        bed: when the bed counts as clear.
    """

    automatic_transition: bool = False
    load_on_startup: bool = False
    job_transition_delay: Seconds = 0.01
    job_transition_gcode: str = ""
    bed: Literal["assume-clear", "confirm", "after-gcode", "timer"] = "assume-clear"


class HistoryConfig(_Table, frozen=True, kw_only=True):
    """Bounds of a machine's history.

    Attributes:
        shown: ended jobs that lists show.
        stored: jobs that are kept on disk.
    """

    shown: Positive = 1000
    stored: Positive = 100_000


class SpoolerConfig(_Table, frozen=True, kw_only=True):
    """The spooler API of a machine.

    Attributes:
        failed: how a job that failed is called; ``CANCELED`` for clients that know no ``FAILED``.
    """

    failed: Literal["FAILED", "CANCELED"] = "FAILED"


class MachineConfig(_Table, frozen=True, kw_only=True):
    """One machine.

    Attributes:
        driver: its protocol.
        link: ``sim``, a serial device or pty, ``tcp://host:port`` or ``unix:/path``.
        baud: speed of a serial link, bits per second.
        listen: addresses at which this machine alone is at the root.
        auto_init: send the init lines whenever the machine has booted or been connected.
        queue, history, spooler, spark, sim, log: see their types.
    """

    driver: str
    link: str
    baud: Positive = 115_200
    listen: tuple[str, ...] = ()
    auto_init: bool = False
    queue: QueueConfig = QueueConfig()
    history: HistoryConfig = HistoryConfig()
    spooler: SpoolerConfig = SpoolerConfig()
    spark: SparkOptions = SparkOptions()
    sim: SimulatedSparkOptions = SimulatedSparkOptions()
    log: CommLogLimits = CommLogLimits()


class ServerConfig(_Table, frozen=True, kw_only=True):
    """The HTTP server.

    Attributes:
        listen: addresses of the main listeners.
        hosts: names, beside this computer's own, under which clients may reach the server.
        origins: origins, beside this computer's, whose pages may call the server.
        open_networks: networks whose clients need no key on listeners that are not loopback.
        max_body_bytes: longest body of one request.
        max_connections: connections at one time, on one listener.
    """

    listen: str | tuple[str, ...] = "127.0.0.1:7125"
    hosts: tuple[str, ...] = ()
    origins: tuple[str, ...] = ()
    open_networks: tuple[str, ...] = ()
    max_body_bytes: Positive = 64 * 2**20
    max_connections: Positive = 512


class StorageConfig(_Table, frozen=True, kw_only=True):
    """Bounds of what is kept.

    Attributes:
        programs_bytes: programs that no waiting or running job needs are deleted beyond this.
    """

    programs_bytes: Positive = 4 * 2**30


class Config(_Table, frozen=True, kw_only=True):
    """The whole configuration."""

    server: ServerConfig = ServerConfig()
    storage: StorageConfig = StorageConfig()
    telemetry: TelemetryLimits = TelemetryLimits()
    machines: dict[str, MachineConfig]


DEFAULT: Final = Config(machines={"sim": MachineConfig(driver="spark", link="sim")})
"""Without a file: one simulated machine."""


def load(path: Path) -> Config:
    """Read the configuration.

    Raises:
        ConfigError: the file cannot be read or is wrong; the message names the key and the fix.
    """
    try:
        tree = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from None
    try:
        return parse(tree)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def parse(tree: dict[str, Any]) -> Config:
    """Return the configuration that a TOML document stands for; as `load`."""
    known = set(Config.__struct_fields__)
    for key in tree:
        if key not in known:
            raise ConfigError(f"{key}: unknown table{_suggestion(key, known)}")
    machines = tree.get("machines", {})
    if not isinstance(machines, dict) or not machines:
        raise ConfigError("machines: there is none; add a table such as [machines.edm]")
    config = Config(
        server=_convert(tree.get("server", {}), ServerConfig, "server"),
        storage=_convert(tree.get("storage", {}), StorageConfig, "storage"),
        telemetry=_convert(tree.get("telemetry", {}), TelemetryLimits, "telemetry"),
        machines={
            name: _convert(table, MachineConfig, f"machines.{name}") for name, table in machines.items()
        },
    )
    _check(config)
    return config


def parse_address(text: str, key: str) -> Address:
    """Return the address that ``HOST:PORT`` stands for; IPv6 in brackets.

    Raises:
        ConfigError: it stands for none; the message begins with `key`.
    """
    match = _ADDRESS.fullmatch(text)
    if match is None or int(match["port"]) > 65535:
        raise ConfigError(f'{key}: {text!r} is no address; write "HOST:PORT", e.g. "127.0.0.1:7125"')
    return Address(match["ipv6"] or match["host"], int(match["port"]))


def main_addresses(config: ServerConfig) -> list[Address]:
    """Return the addresses of the main listeners."""
    listen = (config.listen,) if isinstance(config.listen, str) else config.listen
    return [parse_address(text, "server.listen") for text in listen]


def machine_addresses(name: str, config: MachineConfig) -> list[Address]:
    """Return the addresses at which a machine alone is at the root."""
    return [parse_address(text, f"machines.{name}.listen") for text in config.listen]


def without_effect(config: Config) -> list[str]:
    """Return the keys whose values ask for what this version does not do yet."""
    plain = QueueConfig()
    return [
        f"machines.{name}.queue.{key}"
        for name, machine in config.machines.items()
        for key in _NOT_YET
        if getattr(machine.queue, key) != getattr(plain, key)
    ]


T = TypeVar("T")


def _convert(table: object, kind: type[T], key: str) -> T:
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(_explain(str(error), kind, key)) from None


def _explain(message: str, kind: type, key: str) -> str:
    """Turn a message of msgspec's into one that names the key as it stands in the file."""
    text, _, path = message.partition(" - at `$")
    where = key + path.rstrip("`")
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", text)
    if unknown:
        fields = _fields(kind, where.removeprefix(key).strip("."))
        return f"{where}.{unknown[1]}: unknown key{_suggestion(unknown[1], fields)}"
    missing = re.fullmatch(r"Object missing required field `(.*)`", text)
    if missing:
        return f"{where}.{missing[1]}: is missing; add it"
    return f"{where}: {text[:1].lower()}{text[1:]}"


def _fields(kind: type, path: str) -> set[str]:
    for part in filter(None, path.split(".")):
        kind = next(f.type for f in msgspec.structs.fields(kind) if f.name == part)
    return {field.encode_name for field in msgspec.structs.fields(kind)}


def _suggestion(name: str, known: set[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    if close:
        return f"; did you mean {close[0]}?"
    return f"; known are {', '.join(sorted(known))}"


def _check(config: Config) -> None:
    if not main_addresses(config.server):
        raise ConfigError('server.listen: there is no address; write e.g. "127.0.0.1:7125"')
    for text in config.server.open_networks:
        try:
            ipaddress.ip_network(text)
        except ValueError as error:
            raise ConfigError(
                f'server.open_networks: {error}; write a network such as "192.168.1.0/24"'
            ) from None
    links: dict[str, str] = {}
    for name, machine in config.machines.items():
        key = f"machines.{name}"
        if not _NAME.fullmatch(name):
            raise ConfigError(f"{key}: a machine's name is letters, digits, '-' and '_', at most 64")
        machine_addresses(name, machine)
        if machine.driver not in DRIVERS:
            raise ConfigError(
                f"{key}.driver: {machine.driver!r} is not to be had; this version drives {', '.join(DRIVERS)}"
            )
        _check_link(machine.link, f"{key}.link")
        if machine.link != "sim" and machine.link in links:
            raise ConfigError(
                f"{key}.link: {machine.link} is the link of machines.{links[machine.link]} already"
            )
        links[machine.link] = name
        for fault in machine.sim.faults:
            try:
                Fault.parse(fault)
            except ValueError as error:
                raise ConfigError(f"{key}.sim.faults: {error}") from None


def _check_link(link: str, key: str) -> None:
    if link.startswith("tcp:"):
        try:
            address = urlsplit(link)
            valid = address.scheme == "tcp" and bool(address.hostname) and bool(address.port)
        except ValueError:
            valid = False
        if not valid:
            raise ConfigError(f'{key}: {link!r} is no TCP address; write "tcp://HOST:PORT"')
    elif link.startswith("unix:"):
        if not link.startswith("unix:/"):
            raise ConfigError(f'{key}: {link!r} is no socket; write "unix:/absolute/path"')
    elif link != "sim" and not link.startswith("/"):
        raise ConfigError(
            f'{key}: {link!r} is no link; write "sim", a device such as "/dev/serial/by-id/...", '
            '"tcp://HOST:PORT" or "unix:/path"'
        )
