"""Jobs: what takes long, kept in the journal from the wish to the result, so that none is forgotten or done twice.

A job that was queued or running when the daemon ended is queued again; what it does must be repeatable up to the one
change of the journal that also marks it as done. Refinement of completed vehicles goes before everything; what belongs
to the background (coarse maps in flight, neighbours solved together, exports) runs one at a time and never takes a
refinement's place; neighbours are solved together only while no refinement waits or runs.
"""

import json
import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from gcs_plugin.daemon.store.event_bus import Events
from gcs_plugin.daemon.store.journal import Change, Journal, packed, unpacked
from orthoswarm.model.errors import OrthoSwarmError

_MOST_ATTEMPTS: Final = 3
_MOST_RESTARTS: Final = 20
_KEPT: Final = 1000
_BACKGROUND: Final = frozenset({"coarse", "together", "redraw", "export"})
_ORDER: Final = (
    "CASE WHEN kind = 'refine' THEN 0 WHEN kind = 'coarse' AND detail NOT LIKE '%\"after\"%' THEN 2 ELSE 1 END, id"
)
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Job:
    """One job.

    Attributes:
        id: number. kind: refine, together, coarse, redraw or export. vehicle: whose, None for all. sortie: which.
        state: queued, running, done or failed. progress: 0 to 1. message: what is being done, or why it failed.
        created, started, ended: UTC epoch seconds. attempts: how often it was begun. detail: JSON values.
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

    @classmethod
    def of(cls, row: sqlite3.Row) -> "Job":
        """The job of a journal's row."""
        vehicle = None if row["vehicle"] is None else unpacked(row["vehicle"])
        return cls(
            row["id"], row["kind"], vehicle, row["sortie"], row["state"], row["progress"], row["message"],
            row["created"], row["started"], row["ended"], row["attempts"], json.loads(row["detail"]),
        )  # fmt: skip

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        from orthoswarm.export.product_files import iso_time

        return {
            "id": self.id, "kind": self.kind, "vehicle": self.vehicle, "sortie": self.sortie, "state": self.state,
            "progress": round(self.progress, 3), "message": self.message, "created": iso_time(self.created),
            "started": iso_time(self.started), "ended": iso_time(self.ended), "attempts": self.attempts,
            "detail": self.detail,
        }  # fmt: skip


class GaveWay(Exception):
    """A handler's way to say that its work was taken away: to be done again later."""


Tell = Callable[[float, str], None]
"""Told a job's progress, 0 to 1, and what is being done."""
Handler = Callable[[Job, Tell], Change]
"""Does a job, telling its progress; gives the change that makes its result so. That the job is done is written with
it, in one transaction."""
After = Callable[[Job], None]


class Jobs:
    """The queue of jobs.

    Args:
        journal: where they are kept.
        events: told of every change.
        handlers: kind -> what does it.
        slots: how many refinements run at once; one job of the background runs beside them.
        on_drop: called with a running job that is not wanted any more, so that its work may be given up.
    """

    def __init__(
        self,
        journal: Journal,
        events: Events,
        handlers: Mapping[str, Handler],
        slots: int,
        on_drop: After = lambda _: None,
    ) -> None:
        self._journal, self._events, self._handlers = journal, events, handlers
        self._condition = threading.Condition()
        self._running: dict[int, Job] = {}
        self._unwanted: dict[int, str] = {}
        self._on_drop = on_drop
        self._stop = False
        self._after: list[After] = []
        self._threads = [
            threading.Thread(target=self._run, name=f"jobs {n}", daemon=True) for n in range(max(1, slots) + 1)
        ]
        journal.write(_requeue)

    def on_end(self, listener: After) -> None:
        """Call a function with each job that has ended, in the job's thread."""
        self._after.append(listener)

    def start(self) -> None:
        """Begin to work."""
        for thread in self._threads:
            thread.start()

    @property
    def stopping(self) -> bool:
        """True once nothing more is begun."""
        return self._stop

    def give_up(self) -> None:
        """Begin nothing more; what fails from now on is not a failure but the end."""
        with self._condition:
            self._stop = True
            self._condition.notify_all()

    def close(self) -> None:
        """Begin nothing more; what runs is given up by its crew and is queued again at the next start."""
        self.give_up()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(10.0)

    def add(self, kind: str, vehicle: str | None = None, sortie: int | None = None, **detail: Any) -> Job:
        """Queue a job; an equal one that waits already is given instead."""
        job = self._journal.write(new_job(kind, vehicle, sortie, detail))
        self._tell(job)
        with self._condition:
            self._condition.notify_all()
        return job

    def drop(self, kind: str, vehicle: str, why: str) -> None:
        """Let go of a vehicle's jobs of a kind: those that wait end at once, one that runs is given up."""
        self._journal.write(drop_change(kind, vehicle, why))
        with self._condition:
            running = [
                job
                for job in self._running.values()
                if (job.kind, job.vehicle) == (kind, vehicle) and "after" not in job.detail
            ]
            for job in running:
                self._unwanted[job.id] = why
        for job in running:
            self._on_drop(job)

    def wake(self) -> None:
        """Look at the queue again: somebody else has put a job into the journal."""
        with self._condition:
            self._condition.notify_all()

    def all(self) -> list[Job]:
        """The latest jobs, oldest first."""
        rows = self._journal.rows("SELECT * FROM jobs ORDER BY id DESC LIMIT ?", (_KEPT,))
        with self._condition:
            running = dict(self._running)
        return [running.get(row["id"]) or Job.of(row) for row in reversed(rows)]

    def find(self, number: int) -> Job | None:
        """A job by its number."""
        row = self._journal.one("SELECT * FROM jobs WHERE id = ?", (number,))
        return None if row is None else Job.of(row)

    def open(self, *kinds: str) -> int:
        """How many jobs of these kinds (any, if none is named) wait or run; coarse maps in flight do not count."""
        query = (
            "SELECT kind FROM jobs WHERE state IN ('queued', 'running')"
            " AND (kind != 'coarse' OR detail LIKE '%\"after\"%')"
        )
        return sum(not kinds or row["kind"] in kinds for row in self._journal.rows(query))

    # -- the threads ----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._condition:
                job = None
                while not self._stop:
                    job = self._next()
                    if job is not None:
                        break
                    self._condition.wait(5.0)
                if self._stop or job is None:
                    return
            try:
                self._do(job)
            except Exception:  # the disk is full or gone: the job is still in the journal, try again
                _log.exception("job %d (%s) waits", job.id, job.kind)
                with self._condition:
                    self._running.pop(job.id, None)
                    self._condition.wait(1.0)

    def _next(self) -> Job | None:
        """Take the next job that may run: refinement goes first, and a vehicle's jobs one after the other."""
        rows = self._journal.rows(f"SELECT * FROM jobs WHERE state = 'queued' ORDER BY {_ORDER}")
        busy = {_lane(job) for job in self._running.values()}
        refining = any(kind == "refine" for kind, _ in busy) or any(row["kind"] == "refine" for row in rows)
        for row in rows:
            job = Job.of(row)
            if row["id"] in self._running or _lane(job) in busy or (refining and job.kind == "together"):
                continue
            job.state, job.started, job.attempts = "running", time.time(), job.attempts + 1
            self._running[job.id] = job
            return job
        return None

    def _do(self, job: Job) -> None:
        self._journal.write(
            lambda db: db.execute(
                "UPDATE jobs SET state = 'running', started = ?, attempts = ?, message = '' WHERE id = ?",
                (job.started, job.attempts, job.id),
            )
        )
        self._tell(job)

        def progress(share: float, message: str) -> None:
            job.progress, job.message = share, message
            self._tell(job)

        try:
            change = self._handlers[job.kind](job, progress)
            if self._stop:
                return
            job.state, job.progress, job.message, job.ended = "done", 1.0, "", time.time()
            self._journal.write(_both(change, _ended(job)))
        except Exception as error:
            if self._stop:  # its worker was taken away: it is queued again at the next start
                return
            if job.id in self._unwanted:
                job.state, job.progress, job.ended = "done", 1.0, time.time()
                job.message = self._unwanted[job.id]
                self._journal.write(_ended(job))
            elif isinstance(error, GaveWay):
                job.state, job.progress, job.started, job.attempts = "queued", 0.0, None, job.attempts - 1
                self._journal.write(_ended(job))
            else:
                self._failed(job, error)
        finally:
            with self._condition:
                self._running.pop(job.id, None)
                self._unwanted.pop(job.id, None)
                self._condition.notify_all()
        self._tell(job)
        for listener in self._after:
            try:
                listener(job)
            except OrthoSwarmError as error:
                _log.error("after job %d: %s", job.id, error)

    def _failed(self, job: Job, error: Exception) -> None:
        known = isinstance(error, OrthoSwarmError)
        if not known:
            _log.error("job %d (%s) failed", job.id, job.kind, exc_info=error)
        job.message = str(error) if known else f"{type(error).__name__}: {error}"
        again = "stopped from outside" in job.message and job.attempts < _MOST_ATTEMPTS
        job.state, job.ended = ("queued", None) if again else ("failed", time.time())
        try:
            self._journal.write(_ended(job))
        except OrthoSwarmError as reason:
            _log.error("job %d: %s", job.id, reason)

    def _tell(self, job: Job) -> None:
        self._events.publish("job", **job.document())


def new_job(kind: str, vehicle: str | None, sortie: int | None, detail: dict[str, Any]) -> Callable[
    [sqlite3.Connection], Job
]:  # fmt: skip
    """The change that queues a job, unless an equal one waits already; gives the job."""
    name, text, created = (None if vehicle is None else packed(vehicle)), json.dumps(detail), time.time()

    def change(db: sqlite3.Connection) -> Job:
        db.row_factory = sqlite3.Row
        row = db.execute(
            "SELECT * FROM jobs WHERE kind = ? AND vehicle IS ? AND sortie IS ? AND state = 'queued' AND detail = ?",
            (kind, name, sortie, text),
        ).fetchone()
        if row is None:
            number = db.execute(
                "INSERT INTO jobs (kind, vehicle, sortie, state, created, detail) VALUES (?, ?, ?, 'queued', ?, ?)",
                (kind, name, sortie, created, text),
            ).lastrowid
            row = db.execute("SELECT * FROM jobs WHERE id = ?", (number,)).fetchone()
        return Job.of(row)

    return change


def drop_change(kind: str, vehicle: str, why: str) -> Change:
    """The change that ends a vehicle's waiting jobs of a kind."""
    values = (why, time.time(), kind, packed(vehicle))

    def change(db: sqlite3.Connection) -> None:
        db.execute(
            "UPDATE jobs SET state = 'done', progress = 1, message = ?, ended = ? WHERE kind = ? AND vehicle = ?"
            " AND state = 'queued' AND detail NOT LIKE '%\"after\"%'",
            values,
        )

    return change


def _lane(job: Job) -> tuple[str, str | None]:
    """Of jobs in one lane one runs at a time."""
    return ("background", None) if job.kind in _BACKGROUND else (job.kind, job.vehicle)


def _requeue(db: sqlite3.Connection) -> None:
    """What was under way when the daemon ended is done again, but not for ever if it is what ended the daemon."""
    db.execute(
        "UPDATE jobs SET state = 'failed', message = 'the daemon ended each time that this was tried', ended = ?"
        " WHERE state = 'running' AND attempts >= ?",
        (time.time(), _MOST_RESTARTS),
    )
    db.execute("UPDATE jobs SET state = 'queued', progress = 0, started = NULL WHERE state = 'running'")


def _ended(job: Job) -> Change:
    values = (job.state, job.progress, job.message, job.ended, job.attempts, json.dumps(job.detail), job.id)

    def change(db: sqlite3.Connection) -> None:
        db.execute("UPDATE jobs SET state=?, progress=?, message=?, ended=?, attempts=?, detail=? WHERE id=?", values)

    return change


def _both(one: Change, other: Change) -> Change:
    def change(db: sqlite3.Connection) -> None:
        one(db)
        other(db)

    return change
