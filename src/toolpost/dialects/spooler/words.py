"""The spooler's requests and answers, as they are on the wire."""

from typing import Any

import msgspec

from toolpost.core.report import Value


def name_the_field(message: str) -> str:
    """Turn a message of msgspec's into one that begins with the field's name."""
    text, _, path = message.partition(" - at `$")
    field = path.rstrip("`").lstrip(".")
    missing = text.removeprefix("Object missing required field `")
    if missing != text:
        return f"{missing.rstrip('`')}: must be given"
    return f"{field}: {text[:1].lower()}{text[1:]}" if field else f"invalid JSON: {text}"


class Empty(msgspec.Struct):
    """``{}``: what several calls take and give."""


class WriteLineRequest(msgspec.Struct):
    """A line to send; ``high_prio`` is known to newer clients only."""

    line: str
    high_prio: bool | None = None


class WriteLineAnswer(msgspec.Struct):
    """Whether the line was taken, and when; ``now`` is what an example of the document calls it."""

    ok: bool
    time: float
    now: float


class GetPsRequest(msgspec.Struct):
    """The latest reports of a tag."""

    tag: str
    count: int | None = None


class PState(msgspec.Struct):
    """One report."""

    time: float
    kv: dict[str, Value]


class GetPsAnswer(msgspec.Struct):
    """Reports, the latest first."""

    pstates: list[PState]


class CommandQueue(msgspec.Struct):
    """Where the pending commands are, as an example of the document shows it."""

    spooler: int
    core: int


class StatusAnswer(msgspec.Struct, omit_defaults=True):
    """The machine in brief."""

    time: float
    busy: bool
    num_pending_commands: int
    device_alive: bool
    command_queue: CommandQueue
    running_job: str | None = None


class SetInitRequest(msgspec.Struct):
    """The init lines; ``content`` is what an example of the document calls them."""

    lines: list[str] | None = None
    content: list[str] | None = None


class GetInitAnswer(msgspec.Struct):
    """The init lines, under both names."""

    lines: list[str]
    content: list[str]


class AddJobRequest(msgspec.Struct):
    """A job. Its parts stay as they came: they may be large. Newer clients say ``polls`` for ``signals``."""

    commands: msgspec.Raw = msgspec.Raw(b"null")
    signals: msgspec.Raw = msgspec.Raw(b"null")
    polls: msgspec.Raw = msgspec.Raw(b"null")


class AddJobAnswer(msgspec.Struct, omit_defaults=True):
    """Whether the job was added, and its id."""

    ok: bool
    job_id: str | None = None


class JobAnswer(msgspec.Struct, omit_defaults=True):
    """One job of the list. What follows ``time_ended`` is more than the document promises."""

    job_id: str
    status: str
    time_added: float
    time_started: float | None = None
    time_ended: float | None = None
    reason: str | None = None
    detail: str | None = None
    num_commands: int | None = None
    num_sent: int | None = None
    num_executed: int | None = None


class ListJobsAnswer(msgspec.Struct):
    """Jobs in the order of adding."""

    jobs: list[JobAnswer]


class QueryTsRequest(msgspec.Struct):
    """Series to sample at start, start + step and so on, up to end."""

    query: list[str] | None = None
    start: float = 0.0
    end: float = 0.0
    step: float = 0.0


class QueryTsAnswer(msgspec.Struct):
    """The times of the samples, and the samples of each series."""

    times: list[float]
    values: dict[str, list[Any]]
