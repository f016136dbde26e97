"""What a simulated Spark core says: its reports as the lines that go up.

Lines end in CR LF and hold at most 100 bytes (Spark serial protocol, line layer); an error that
quotes a long line may hold more.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping

from toolpost.sim.motion import AXES, PREFIX, Motion

EOL = b"\r\n"
ERASE = b" \b"
"""The echo of BS and DEL."""

LINE_LIMIT = 100
"""Bytes of content in a line up."""

SOURCE_LIMIT = 50
"""Bytes of a bad line that its error report quotes."""

FAULT = b'sys < ev:"fault" >\r\n'

BOOT: dict[str, bytes] = {
    "sys": b'sys < ev:"boot" >\r\n',
    "init": (
        b'init < ok:true motor.ok:true\r\ninit pulser.ok:true pulser.msg:"simulated" toolsupply.ok:true >\r\n'
    ),
    "none": b"",
}
"""What a core says at the end of its boot: newer firmware, older firmware, or nothing."""

_REGISTERS = (
    "GCONF",
    "GSTAT",
    "IOIN",
    "IHOLD_IRUN",
    "TSTEP",
    "CHOPCONF",
    "DRV_STATUS",
    "PWM_SCALE",
)
_MOTORS = 7


def default_settings() -> dict[str, float]:
    """Return the settings of a core that has just booted."""
    settings: dict[str, float] = {}
    for motor in range(_MOTORS):
        settings[f"m.{motor}.microstep"] = 32.0
        settings[f"m.{motor}.current"] = 30.0
        settings[f"m.{motor}.thresh"] = 0.0
        settings[f"m.{motor}.unitsteps"] = 200.0
    for axis in AXES[:3]:
        settings[f"a.{axis}.home_side"] = 1.0
        settings[f"a.{axis}.max"] = 200.0
    for letter in PREFIX.values():
        if letter != "m":
            settings.update({f"cs.{letter}.{axis}": 0.0 for axis in AXES})
    return settings


def queue(capacity: int, number: int) -> bytes:
    """Return the answer to ``?queue``; ``number`` counts waiting and running commands."""
    return b"queue < cap:%d num:%d >\r\n" % (capacity, number)


def position(motion: Motion, now: float) -> bytes:
    """Return the answer to ``?pos`` for the time ``now``, seconds.

    It holds the machine position and that of the selected coordinate system.
    """
    machine = motion.position(now)
    words = [f'sys:"{motion.system}"', *_coordinates("m", machine)]
    letter = PREFIX[motion.system]
    if letter != "m":
        words += _coordinates(letter, motion.local(machine))
    return _report("pos", words)


def _coordinates(letter: str, values: Iterable[float]) -> list[str]:
    return [f"{letter}.{axis}:{value:.3f}" for axis, value in zip(AXES, values, strict=True)]


def discharge(cutting: bool, now: float) -> tuple[bytes, bytes]:
    """Return the answer to ``?edm`` in two parts, between which other lines may come.

    Args:
        cutting: whether a cut runs; without one the gap is open.
        now: seconds; the ratios (0 to 1) and distances (mm) change with it.
    """
    if cutting:
        short = 0.05 + 0.04 * math.sin(now * 1.7)
        opened = 0.35 + 0.2 * math.sin(now * 0.6)
        duty = (1.0 - short - opened) * 0.6
    else:
        short, opened, duty = 0.0, 1.0, 0.0
    forward = duty * 0.8
    back = short * 2.0
    distance = 0.02 + 0.03 * (now * 0.21 % 1.0) * cutting
    first = f"edm <\r\nedm eff_duty:{duty:.3f} open:{opened:.3f} short:{short:.3f}\r\n"
    rest = f"edm pb_f:{forward:.3f} pb_b:{back:.3f} dist:{distance:.3f} dist_max:0.050\r\nedm >\r\n"
    return first.encode(), rest.encode()


def settings_report(settings: Mapping[str, float]) -> bytes:
    """Return the answer to ``get``: every setting, on as many lines as it takes."""
    return _report("stg", [f"{key}:{decimal(value)}" for key, value in sorted(settings.items())])


def statistics(executed: int, seconds: float) -> bytes:
    """Return the answer to ``stat``: driver registers in hex, and counters.

    Args:
        executed: commands executed so far.
        seconds: time since the boot.
    """
    words = [f"uptime:{seconds:.1f}", f"cmd.executed:{min(executed, 2**24)}"]
    for motor in range(_MOTORS):
        noise = hashlib.shake_128(b"%d" % motor).digest(4 * len(_REGISTERS))
        for index, register in enumerate(_REGISTERS):
            value = int.from_bytes(noise[4 * index : 4 * index + 4], "big")
            words.append(f"motor.{motor}.{register}:0x{value:08x}")
    return _report("stat", words)


def error(message: str, source: bytes | None = None) -> bytes:
    """Return an error report.

    Args:
        message: what is wrong; the firmware escapes no quotes in it, so neither does this.
        source: the bad line, of which the first bytes are quoted.
    """
    line = f'error < msg:"{message}"'.encode("ascii", "replace")
    if source is not None:
        quoted = source[:SOURCE_LIMIT].replace(b"\\", b"\\\\").replace(b'"', b'\\"')
        line += b' src:"' + quoted + b'"'
    return line + b" >\r\n"


def noise(count: int, seed: int) -> bytes:
    """Return ``count`` bytes of line noise, the same for the same ``seed``.

    It holds bytes that no protocol line has (0xff, ESC), unfinished reports and bare line ends.
    """
    pieces = (
        b"\xff",
        b"\x1b[2J",
        b"edm < eff_du",
        b"\r",
        b"queue < ca",
        b"\n",
        b"\x00\x08",
        b">\n",
    )
    raw = hashlib.shake_128(b"noise %d" % seed).digest(count)
    result = bytearray()
    for index, byte in enumerate(raw):
        if len(result) >= count:
            break
        if index % 4 == 0:
            result += pieces[(index // 4 + byte * (index > 0)) % len(pieces)]
        result.append(byte | 0x80)
    return bytes(result[:count])


def decimal(value: float) -> str:
    """Return a finite number as the protocol writes it: plain decimal, without an exponent."""
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _report(tag: str, words: Iterable[str]) -> bytes:
    """Lay out a report in lines of at most ``LINE_LIMIT`` bytes."""
    lines: list[str] = []
    line = f"{tag} <"
    for word in words:
        if len(line) + 1 + len(word) > LINE_LIMIT - len(" >"):
            lines.append(line)
            line = tag
        line += f" {word}"
    lines.append(f"{line} >")
    return "".join(f"{text}\r\n" for text in lines).encode()
