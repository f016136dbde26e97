"""The nine calls of the spooler's API, translated to the shop's."""

import math

import msgspec

from toolpost.clock import now_us, seconds
from toolpost.core.grid import SampleGrid
from toolpost.core.job import Job, JobState
from toolpost.dialects.spooler import words
from toolpost.dialects.spooler.commands import decode_blocks
from toolpost.errors import InvalidLineError, InvalidRequestError, NotAcceptedError
from toolpost.shop import Shop

MAX_COUNT = 10_000
MAX_KEYS = 1_000
MAX_VALUES = 250_000
MAX_LINE = 100
MAX_INIT_LINES = 25_000
MIN_INTERVAL = 0.02
MAX_INTERVAL = 86_400.0
MAX_SIGNALS = 64
MAX_SIGNALS_BYTES = 64 * 1024

_INTERVALS = msgspec.json.Decoder(dict[str, float] | None)

_STATUS = {
    JobState.PENDING: "WAITING",
    JobState.PENDING_HELD: "WAITING",
    JobState.PROCESSING: "RUNNING",
    JobState.PROCESSING_STOPPED: "RUNNING",
    JobState.COMPLETED: "COMPLETED",
    JobState.CANCELED: "CANCELED",
}


class SpoolerApi:
    """The API of one machine.

    Args:
        shop: does the work.
        machine: name of the machine.
        failed: how a job that failed is called.

    Every call raises InvalidRequestError, with a text that names the field, for what does not conform.
    """

    def __init__(self, shop: Shop, machine: str, failed: str) -> None:
        self._shop = shop
        self._machine = machine
        self._status = {**_STATUS, JobState.ABORTED: failed}

    async def write_line(self, request: words.WriteLineRequest, actor: str) -> words.WriteLineAnswer:
        """``/write-line``: send one line."""
        # Clients wait for reports later than this time: it must not be a moment late.
        time = seconds(now_us())
        if len(request.line.strip()) > MAX_LINE:
            raise InvalidRequestError(f"line: must be at most {MAX_LINE} bytes, its comment included")
        try:
            ok = await self._shop.write_line(
                self._machine, request.line, urgent=request.high_prio, actor=actor
            )
        except InvalidRequestError as error:
            raise InvalidRequestError(f"line: {error}") from None
        return words.WriteLineAnswer(ok, time, time)

    async def get_ps(self, request: words.GetPsRequest, actor: str) -> words.GetPsAnswer:  # noqa: ARG002
        """``/get-ps``: the latest reports of a tag."""
        if not request.tag:
            raise InvalidRequestError("tag: cannot be empty")
        count = 1 if request.count is None else request.count
        if count <= 0:
            raise InvalidRequestError("count: must be > 0")
        if count > MAX_COUNT:
            raise InvalidRequestError(f"count: too big, must be <= {MAX_COUNT}")
        reports = await self._shop.reports(self._machine, request.tag, count)
        return words.GetPsAnswer([words.PState(seconds(report.time_us), report.values) for report in reports])

    async def status(self, request: words.Empty, actor: str) -> words.StatusAnswer:  # noqa: ARG002
        """``/status``: the machine in brief."""
        status = self._shop.status(self._machine)
        pending = status.host_commands + status.machine_commands
        return words.StatusAnswer(
            time=seconds(status.time_us),
            busy=pending > 0,
            num_pending_commands=pending,
            device_alive=status.alive,
            command_queue=words.CommandQueue(status.host_commands, status.machine_commands),
            running_job=status.running_job,
        )

    async def cancel(self, request: words.Empty, actor: str) -> words.Empty:
        """``/cancel``: stop everything."""
        await self._shop.cancel(self._machine, actor)
        return request

    async def set_init(self, request: words.SetInitRequest, actor: str) -> words.Empty:  # noqa: ARG002
        """``/set-init``: set the init lines."""
        name = "lines" if request.lines is not None else "content"
        lines = request.lines if request.lines is not None else request.content
        if lines is None:
            raise InvalidRequestError("lines: must be given")
        if len(lines) > MAX_INIT_LINES:
            raise InvalidRequestError(f"{name}: must be at most {MAX_INIT_LINES} lines")
        try:
            await self._shop.set_init_lines(self._machine, lines)
        except InvalidLineError as error:
            raise InvalidRequestError(f"{name}[{error.index}]: {error.problem}") from None
        return words.Empty()

    async def get_init(self, request: words.Empty, actor: str) -> words.GetInitAnswer:  # noqa: ARG002
        """``/get-init``: the init lines."""
        lines = self._shop.init_lines(self._machine)
        return words.GetInitAnswer(lines, lines)

    async def add_job(self, request: words.AddJobRequest, actor: str) -> words.AddJobAnswer:
        """``/add-job``: add a job if no other is waiting or running."""
        commands = memoryview(request.commands)
        if commands[:5].tobytes() == b"null":
            raise InvalidRequestError("commands: must be given")
        signals = self._check_signals(
            _intervals("signals", request.signals), _intervals("polls", request.polls)
        )
        try:
            job = await self._shop.submit(self._machine, decode_blocks(commands), signals, actor=actor)
        except NotAcceptedError:
            return words.AddJobAnswer(ok=False)
        except InvalidLineError as error:
            raise InvalidRequestError(f"commands[{error.index}]: {error.problem}") from None
        return words.AddJobAnswer(ok=True, job_id=job.id)

    async def list_jobs(self, request: words.Empty, actor: str) -> words.ListJobsAnswer:  # noqa: ARG002
        """``/list-jobs``: the jobs, in the order of adding."""
        return words.ListJobsAnswer([self._job(job) for job in self._shop.jobs(self._machine)])

    async def query_ts(self, request: words.QueryTsRequest, actor: str) -> words.QueryTsAnswer:  # noqa: ARG002
        """``/query-ts``: series at regular times."""
        keys = request.query
        if not keys:
            raise InvalidRequestError("query: cannot be empty")
        if len(keys) > MAX_KEYS:
            raise InvalidRequestError(f"query: too many, must be at most {MAX_KEYS} keys")
        try:
            grid = SampleGrid.from_seconds(request.start, request.end, request.step)
        except ValueError as error:
            raise InvalidRequestError(str(error)) from None
        if grid.count * len(keys) > MAX_VALUES:
            raise InvalidRequestError(f"query: keys times steps must be at most {MAX_VALUES}")
        values = await self._shop.query(self._machine, keys, grid)
        return words.QueryTsAnswer(grid.seconds(), values)

    def _check_signals(self, signals: dict[str, float], polls: dict[str, float]) -> dict[str, float]:
        """Return both together; newer clients may poll with any line, older ones with ``?`` signals only."""
        if len(signals) + len(polls) > MAX_SIGNALS:
            raise InvalidRequestError(f"signals: must be at most {MAX_SIGNALS}, polls included")
        checked = {}
        for name, lines in (("signals", signals), ("polls", polls)):
            for line, interval in lines.items():
                where = f"{name}: {line[:100]!r}"
                if not (math.isfinite(interval) and MIN_INTERVAL <= interval <= MAX_INTERVAL):
                    raise InvalidRequestError(
                        f"{where}: the interval must be from {MIN_INTERVAL} to {MAX_INTERVAL:g} seconds"
                    )
                try:
                    text = self._shop.check_poll(self._machine, line)
                except InvalidRequestError as error:
                    raise InvalidRequestError(f"{where}: {error}") from None
                if lines is signals and not text.startswith("?"):
                    raise InvalidRequestError(f"{where}: must begin with ?")
                checked[text] = interval
        return checked

    def _job(self, job: Job) -> words.JobAnswer:
        progress = self._shop.progress(job)
        return words.JobAnswer(
            job_id=job.id,
            status=self._status[job.state],
            time_added=seconds(job.created_us),
            time_started=None if job.started_us is None else seconds(job.started_us),
            time_ended=None if job.ended_us is None else seconds(job.ended_us),
            reason=job.reason.value,
            detail=job.detail or None,
            num_commands=job.commands,
            num_sent=None if progress is None else progress.sent,
            num_executed=None if progress is None else progress.executed,
        )


def _intervals(name: str, raw: msgspec.Raw) -> dict[str, float]:
    """Return the lines and intervals of a field that is decoded only if it is small."""
    data = memoryview(raw)
    if len(data) > MAX_SIGNALS_BYTES:
        raise InvalidRequestError(f"{name}: must be at most {MAX_SIGNALS}")
    try:
        return _INTERVALS.decode(data) or {}
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at `$")
        where = f"$.{name}{path.rstrip('`')}"
        raise InvalidRequestError(words.name_the_field(f"{problem} - at `{where}`")) from None
