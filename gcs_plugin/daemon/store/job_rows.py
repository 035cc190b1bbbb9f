"""Jobs in the journal: what is to be done, by whom it was asked for, and what it came to."""

import json
import sqlite3
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from gcs_plugin.daemon.store.journal import Change, Journal, packed, statement, unpacked
from orthoswarm.export.product_files import iso_time

_MOST_RESTARTS: Final = 20  # of a job by the daemon's own restarts
_IN_FLIGHT: Final = "(kind = 'coarse' AND json_extract(detail, '$.after') IS NULL)"
"""A coarse map of a vehicle that still flies, as SQL; one with `after` completes the layer after a refinement."""
_FIRST: Final = "(kind = 'export' AND json_extract(detail, '$.after') IS 'refine')"
"""What a refinement has changed is written before anything else is done in the background, as SQL."""


@dataclass(slots=True, kw_only=True)
class Job:
    """One job.

    Attributes:
        kind: refine, together, tones, coarse, redraw, export or change. vehicle: None for all.
        state: queued, running, done or failed. progress: 0 to 1. message: the present step, or why it failed.
        created, started, ended: UTC epoch seconds. attempts: number of starts. detail: JSON values.
    """

    id: int
    kind: str
    vehicle: str | None
    sortie: int | None
    state: str
    progress: float
    message: str
    created: float
    started: float | None
    ended: float | None
    attempts: int
    detail: dict[str, Any] = field(default_factory=dict)

    @property
    def whose(self) -> tuple[str, int]:
        """The vehicle and the sortie, of a job for one."""
        return str(self.vehicle), self.sortie or 0

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "id": self.id, "kind": self.kind, "vehicle": self.vehicle, "sortie": self.sortie, "state": self.state,
            "progress": round(self.progress, 3), "message": self.message, "created": iso_time(self.created),
            "started": iso_time(self.started), "ended": iso_time(self.ended), "attempts": self.attempts,
            "detail": self.detail,
        }  # fmt: skip


def _job(row: sqlite3.Row) -> Job:
    vehicle = None if row["vehicle"] is None else unpacked(row["vehicle"])
    return Job(**{**dict(row), "vehicle": vehicle, "detail": json.loads(row["detail"])})


# -- reading ----------------------------------------------------------------------------------------------------------


def latest_jobs(journal: Journal, most: int = -1) -> list[Job]:
    """The latest jobs, oldest first."""
    return [_job(row) for row in reversed(journal.rows("SELECT * FROM jobs ORDER BY id DESC LIMIT ?", (most,)))]


def find_job(journal: Journal, number: int) -> Job | None:
    """A job by its number."""
    if not 0 < number < 1 << 63:  # SQLite's integers have 64 bits
        return None
    row = journal.one("SELECT * FROM jobs WHERE id = ?", (number,))
    return None if row is None else _job(row)


def queued_jobs(journal: Journal) -> list[Job]:
    """The waiting jobs in the order in which they are to be done."""
    return [
        _job(row)
        for row in journal.rows(f"SELECT * FROM jobs WHERE state = 'queued' ORDER BY NOT {_FIRST}, {_IN_FLIGHT}, id")
    ]


def open_jobs(journal: Journal) -> list[str]:
    """The kinds of waiting and running jobs, one for each, without coarse maps in flight."""
    rows = journal.rows(f"SELECT kind FROM jobs WHERE state IN ('queued', 'running') AND NOT {_IN_FLIGHT}")
    return [row["kind"] for row in rows]


def refinement_is_open(journal: Journal, whose: tuple[str, int], *states: str) -> bool:
    """Whether a sortie has a refinement in one of these states (queued, running)."""
    marks = ", ".join("?" * len(states))
    query = f"SELECT 1 FROM jobs WHERE kind = 'refine' AND vehicle = ? AND sortie = ? AND state IN ({marks})"
    return journal.one(query, (packed(whose[0]), whose[1], *states)) is not None


def job_counts(journal: Journal) -> dict[tuple[str, str], int]:
    """How many jobs there are, by kind and state."""
    rows = journal.rows("SELECT kind, state, COUNT(*) AS n FROM jobs GROUP BY kind, state")
    return {(row["kind"], row["state"]): row["n"] for row in rows}


# -- changes ----------------------------------------------------------------------------------------------------------


def new_job(
    kind: str, vehicle: str | None, sortie: int | None, detail: dict[str, Any]
) -> Callable[[sqlite3.Connection], Job]:
    """The change that queues a job unless an equal one waits already; its result is the job."""
    name, text, created = (None if vehicle is None else packed(vehicle)), json.dumps(detail), time.time()

    def change(db: sqlite3.Connection) -> Job:
        db.row_factory = sqlite3.Row
        row = db.execute(
            "SELECT * FROM jobs WHERE kind = ? AND vehicle IS ? AND sortie IS ? AND state = 'queued'"
            " AND json_remove(detail, '$.newest_seq') = json(?)",
            (kind, name, sortie, text),
        ).fetchone()
        if row is None:
            number = db.execute(
                "INSERT INTO jobs (kind, vehicle, sortie, state, created, detail) VALUES (?, ?, ?, 'queued', ?, ?)",
                (kind, name, sortie, created, text),
            ).lastrowid
            row = db.execute("SELECT * FROM jobs WHERE id = ?", (number,)).fetchone()
        return _job(row)

    return change


def waiting_jobs_dropped(kind: str, vehicle: str, why: str) -> Change:
    """The change that ends a vehicle's waiting jobs of a kind."""
    return statement(
        "UPDATE jobs SET state = 'done', progress = 1, message = ?, ended = ? WHERE kind = ? AND vehicle = ?"
        " AND state = 'queued' AND json_extract(detail, '$.after') IS NULL",
        (why, time.time(), kind, packed(vehicle)),
    )


def interrupted_jobs_queued(db: sqlite3.Connection) -> None:
    """Queue interrupted jobs again, but only a few times, in case the job itself ended the daemon."""
    db.execute(
        "UPDATE jobs SET state = 'failed', message = 'the daemon ended each time that this was tried', ended = ?"
        " WHERE state = 'running' AND attempts >= ?",
        (time.time(), _MOST_RESTARTS),
    )
    db.execute("UPDATE jobs SET state = 'queued', progress = 0, started = NULL WHERE state = 'running'")


def job_started(job: Job) -> Change:
    """The change that records a job's start."""
    return statement(
        "UPDATE jobs SET state = 'running', started = ?, attempts = ?, message = '', detail = ? WHERE id = ?",
        (job.started, job.attempts, json.dumps(job.detail), job.id),
    )


def job_ended(job: Job) -> Change:
    """The change that records a job's end."""
    values = (job.state, job.progress, job.message, job.ended, job.attempts, json.dumps(job.detail), job.id)
    return statement("UPDATE jobs SET state=?, progress=?, message=?, ended=?, attempts=?, detail=? WHERE id=?", values)


def job_done(number: int) -> Change:
    """The change that marks a job as done, to be written with its result: it is not repeated if the daemon ends now."""
    return statement("UPDATE jobs SET state = 'done', progress = 1, ended = ? WHERE id = ?", (time.time(), number))
