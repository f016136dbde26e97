"""Jobs and their events in the database."""

import asyncio
import sqlite3
from collections.abc import Sequence
from typing import Any

import msgspec

from toolpost.core.job import Job
from toolpost.store.database import QUERIES, Database


class JobStore:
    """The table of jobs, with one event for each transition.

    Args:
        database: where it is.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._last_seq = int(database.read("last_seq")[0][0])

    def next_seq(self) -> int:
        """Return a sequence number that no job has had or will have."""
        self._last_seq += 1
        return self._last_seq

    def add(self, jobs: Sequence[Job], actor: str) -> "asyncio.Future[None]":
        """Store new jobs; the future is done when all are on disk, or fails with StorageError."""

        def apply(connection: sqlite3.Connection) -> None:
            _insert(connection, jobs, actor)

        return self._database.submit(apply)

    def update(
        self, jobs: Sequence[Job], at_us: int, actor: str, added: Sequence[Job] = ()
    ) -> "asyncio.Future[None]":
        """Store what has become of jobs, and new ones together with it: all of it or nothing. As `add`."""

        def apply(connection: sqlite3.Connection) -> None:
            if added:
                _insert(connection, added, actor)
            connection.executemany(QUERIES["update_job"], [_row(job) for job in jobs])
            connection.executemany(QUERIES["insert_event"], [_event(job, at_us, actor) for job in jobs])

        return self._database.submit(apply)

    def delete(self, seqs: Sequence[int]) -> "asyncio.Future[None]":
        """Delete jobs that have ended, as `add`; their sequence numbers are not used again."""

        def apply(connection: sqlite3.Connection) -> None:
            connection.executemany(QUERIES["delete_job"], [{"seq": seq} for seq in seqs])

        return self._database.submit(apply)

    def trim(self, machine: str, keep: int) -> "asyncio.Future[None]":
        """Delete the oldest ended jobs of a machine but the `keep` newest jobs."""

        def apply(connection: sqlite3.Connection) -> None:
            connection.execute(QUERIES["trim_jobs"], {"machine": machine, "keep": keep})

        return self._database.submit(apply)

    def load(self, machine: str, most: int) -> list[Job]:
        """Return a machine's jobs in the order of adding: the newest `most`, and all that have not ended."""
        rows = self._database.read("newest_jobs", machine=machine, most=most)
        rows += self._database.read("jobs_not_ended", machine=machine)
        jobs = {row[0]: _job(row) for row in rows}
        return [jobs[seq] for seq in sorted(jobs)]

    def programs_in_use(self) -> set[str]:
        """Return the hashes of the programs that jobs not ended refer to."""
        return {row[0] for row in self._database.read("programs_in_use")}


def _insert(connection: sqlite3.Connection, jobs: Sequence[Job], actor: str) -> None:
    # Who added a job, and when, is in its row: there may be thousands of them at once.
    connection.executemany(QUERIES["insert_job"], [{**_row(job), "actor": actor} for job in jobs])


def _row(job: Job) -> dict[str, Any]:
    return {
        "seq": job.seq,
        "id": job.id,
        "machine": job.machine,
        "program": job.program,
        "commands": job.commands,
        "name": job.name,
        "position": job.position,
        "called": job.called,
        "signals": msgspec.json.encode(job.signals).decode() if job.signals else "{}",
        "state": job.state.value,
        "reason": job.reason.value,
        "detail": job.detail,
        "created_us": job.created_us,
        "started_us": job.started_us,
        "ended_us": job.ended_us,
    }


def _job(row: tuple[Any, ...]) -> Job:
    values = dict(zip(Job.__struct_fields__, row, strict=True))
    values["signals"] = msgspec.json.decode(values["signals"])
    values["called"] = bool(values["called"])
    return msgspec.convert(values, Job)


def _event(job: Job, time_us: int, actor: str) -> dict[str, Any]:
    return {
        "job": job.seq,
        "time_us": time_us,
        "actor": actor,
        "state": job.state.value,
        "reason": job.reason.value,
        "detail": job.detail,
    }
