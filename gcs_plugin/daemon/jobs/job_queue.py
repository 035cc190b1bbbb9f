"""The queue of long jobs, stored in the journal from request to result, so that none is lost or done twice.

A job that was queued or running when the daemon ended is queued again; it must be repeatable up to the
journal change that also marks it as done. Refinements have their own threads; background jobs
(coarse maps in flight, joint refinements of neighbours, tones, exports) run one at a time in another thread. They
start only while no refinement waits or runs; drawing a layer again does not wait.
"""

import json
import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from gcs_plugin.daemon.store.event_bus import Events
from gcs_plugin.daemon.store.journal import Change, Journal, newest_seq, packed, unpacked
from orthoswarm.model.errors import OrthoSwarmError, StorageError, WorkerStoppedError

_MOST_ATTEMPTS: Final = 3  # of a job whose worker stopped
_MOST_RESTARTS: Final = 20  # of a job by the daemon's own restarts
_MOST_LISTED: Final = 1000  # finished jobs
_BACKGROUND: Final = frozenset({"coarse", "together", "tones", "redraw", "export"})
_IN_FLIGHT: Final = "(kind = 'coarse' AND json_extract(detail, '$.after') IS NULL)"
"""A coarse map of a vehicle that still flies, as SQL; one with `after` completes the layer after a refinement."""
_FIRST: Final = "(kind = 'export' AND json_extract(detail, '$.after') IS 'refine')"
"""What a refinement has changed is written before anything else is done in the background, as SQL."""
_PREEMPTED: Final = frozenset({"coarse", "together", "tones"})
_AFTER_REFINEMENT: Final = _PREEMPTED | {"export"}
"""An export that was asked for during a refinement holds its result."""
_WAITING_THREADS: Final = 2  # beyond those of the workers, for jobs that wait for pictures
_JOURNAL_AGAIN_S: Final = 1.0
_log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class Job:
    """One job.

    Attributes:
        id: number. kind: refine, together, tones, coarse, redraw or export.
        vehicle: its id, None for all. sortie: its number.
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

    @classmethod
    def of(cls, row: sqlite3.Row) -> "Job":
        """The job of a journal's row."""
        vehicle = None if row["vehicle"] is None else unpacked(row["vehicle"])
        return cls(
            id=row["id"],
            kind=row["kind"],
            vehicle=vehicle,
            sortie=row["sortie"],
            state=row["state"],
            progress=row["progress"],
            message=row["message"],
            created=row["created"],
            started=row["started"],
            ended=row["ended"],
            attempts=row["attempts"],
            detail=json.loads(row["detail"]),
        )

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        from orthoswarm.export.product_files import iso_time

        return {
            "id": self.id, "kind": self.kind, "vehicle": self.vehicle, "sortie": self.sortie, "state": self.state,
            "progress": round(self.progress, 3), "message": self.message, "created": iso_time(self.created),
            "started": iso_time(self.started), "ended": iso_time(self.ended), "attempts": self.attempts,
            "detail": self.detail,
        }  # fmt: skip


class Preempted(Exception):
    """Raised by a handler that had to give way; the job is queued again."""


ReportProgress = Callable[[float, str], None]
"""Called with a job's progress, 0 to 1, and what is being done."""
Handler = Callable[[Job, ReportProgress], Change]
"""Does a job, reporting its progress; returns the change that records its result. The job's end is written with it, in
one transaction."""
After = Callable[[Job], None]


class Jobs:
    """The queue of jobs.

    Attributes:
        problem: why a job's end cannot be written at present, else empty.

    Args:
        journal: stores the jobs.
        events: receives every change.
        handlers: kind -> function that does the job.
        slots: number of refinements computed at once. Two more may be at a step that needs no worker process
            (waiting for a vehicle's last pictures, publishing).
        on_drop: called with a running job that was cancelled, to abandon its work.
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
        self.problem = ""
        self._threads = [
            threading.Thread(target=self._run, args=(False,), name=f"refinement {n}", daemon=True)
            for n in range(max(1, slots) + _WAITING_THREADS)
        ]
        self._threads.append(threading.Thread(target=self._run, args=(True,), name="background jobs", daemon=True))
        journal.write(_requeue)

    def on_end(self, listener: After) -> None:
        """Call a function with each job that has ended, in the job's thread."""
        self._after.append(listener)

    def start(self) -> None:
        """Start working."""
        for thread in self._threads:
            thread.start()

    @property
    def stopping(self) -> bool:
        """True once no more jobs are started."""
        return self._stop

    def give_up(self) -> None:
        """Start no more jobs; errors from now on are due to the shutdown and not failures."""
        with self._condition:
            self._stop = True
            self._condition.notify_all()

    def close(self) -> None:
        """Start no more jobs; running ones are abandoned by their workers and queued again at the next start."""
        self.give_up()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(10.0)

    def add(self, kind: str, vehicle: str | None = None, sortie: int | None = None, **detail: Any) -> Job:
        """Queue a job; returns an equal waiting one if there is one."""
        job = self._journal.write(new_job(kind, vehicle, sortie, detail))
        self._publish(job)
        with self._condition:
            self._condition.notify_all()
        return job

    def drop(self, kind: str, vehicle: str, why: str) -> None:
        """Cancel a vehicle's jobs of a kind: waiting ones end at once, a running one is abandoned."""
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
        """Check the queue again, after a job was put directly into the journal."""
        with self._condition:
            self._condition.notify_all()

    def all(self) -> list[Job]:
        """The latest jobs, oldest first."""
        rows = self._journal.rows("SELECT * FROM jobs ORDER BY id DESC LIMIT ?", (_MOST_LISTED,))
        with self._condition:
            running = dict(self._running)
        return [running.get(row["id"]) or Job.of(row) for row in reversed(rows)]

    def find(self, number: int) -> Job | None:
        """A job by its number."""
        if not 0 < number < 1 << 63:  # SQLite's integers have 64 bits
            return None
        row = self._journal.one("SELECT * FROM jobs WHERE id = ?", (number,))
        return None if row is None else Job.of(row)

    def open(self, *kinds: str) -> int:
        """Number of waiting and running jobs of these kinds (all, if none is given), without coarse maps in flight."""
        query = f"SELECT kind FROM jobs WHERE state IN ('queued', 'running') AND NOT {_IN_FLIGHT}"
        return sum(not kinds or row["kind"] in kinds for row in self._journal.rows(query))

    # -- the threads ----------------------------------------------------------------------------------------------

    def _run(self, background: bool) -> None:
        while True:
            with self._condition:
                job = None
                while not self._stop:
                    job = self._next(background)
                    if job is not None:
                        break
                    self._condition.wait(5.0)
                if self._stop or job is None:
                    return
            try:
                self._do(job)
            except Exception as error:  # its start cannot be written: it is still queued in the journal
                _log.error("job %d (%s) waits: %s", job.id, job.kind, error)
                with self._condition:
                    self._running.pop(job.id, None)
                    self._condition.wait(_JOURNAL_AGAIN_S)

    def _next(self, background: bool) -> Job | None:
        """Take the next background job, or the next refinement; the jobs of a vehicle run one after the other."""
        rows = self._journal.rows(f"SELECT * FROM jobs WHERE state = 'queued' ORDER BY NOT {_FIRST}, {_IN_FLIGHT}, id")
        busy = {_lane(job) for job in self._running.values()}
        refining = any(kind == "refine" for kind, _ in busy) or any(row["kind"] == "refine" for row in rows)
        for row in rows:
            job = Job.of(row)
            if (job.kind in _BACKGROUND) != background or row["id"] in self._running or _lane(job) in busy:
                continue
            if refining and job.kind in _AFTER_REFINEMENT:
                continue
            job.state, job.started, job.attempts = "running", time.time(), job.attempts + 1
            self._running[job.id] = job
            return job
        return None

    def _do(self, job: Job) -> None:
        if job.kind == "refine":
            job.detail["newest_seq"] = newest_seq(self._journal)  # pictures that arrive later are late
        self._journal.write(
            lambda db: db.execute(
                "UPDATE jobs SET state = 'running', started = ?, attempts = ?, message = '', detail = ? WHERE id = ?",
                (job.started, job.attempts, json.dumps(job.detail), job.id),
            )
        )
        self._publish(job)

        def progress(share: float, message: str) -> None:
            job.progress, job.message = share, message
            self._publish(job)

        try:
            outcome = self._outcome(job, progress)
            if outcome is None or not self._write_end(*outcome):
                return  # the daemon stops; the job is queued again at the next start
            ended = outcome[0]
        finally:
            with self._condition:
                self._running.pop(job.id, None)
                self._unwanted.pop(job.id, None)
                self._condition.notify_all()
        self._publish(ended)
        for listener in self._after:
            try:
                listener(ended)
            except OrthoSwarmError as error:
                _log.error("after job %d: %s", job.id, error)

    def _outcome(self, job: Job, progress: ReportProgress) -> tuple[Job, Change] | None:
        """Do a job; returns the ended job and the journal change that records it, None if the daemon stops."""
        try:
            change = self._handlers[job.kind](job, progress)
            if self._stop:
                return None
            ended = replace(job, state="done", progress=1.0, message="", ended=time.time())
            return ended, _both(change, _ended(ended))
        except Exception as error:
            if self._stop:  # its worker was stopped
                return None
            if job.id in self._unwanted:
                ended = replace(job, state="done", progress=1.0, message=self._unwanted[job.id], ended=time.time())
            elif isinstance(error, Preempted):
                ended = replace(job, state="queued", progress=0.0, started=None, attempts=job.attempts - 1)
            else:
                ended = _failed(job, error)
            return ended, _ended(ended)

    def _write_end(self, job: Job, change: Change) -> bool:
        """Write a job's end, retrying while the disk is full; False if the daemon stops before that."""
        while True:
            try:
                self._journal.write(change)
            except StorageError as error:
                if not self.problem:
                    _log.error("the end of job %d (%s) waits: %s", job.id, job.kind, error)
                    self._events.publish("problem", text=str(error))
                self.problem = str(error)
            else:
                self.problem = ""
                return True
            with self._condition:
                if self._stop:
                    return False
                self._condition.wait(_JOURNAL_AGAIN_S)

    def _publish(self, job: Job) -> None:
        self._events.publish("job", **job.document())


def _failed(job: Job, error: Exception) -> Job:
    """A failed job; queued again if only its worker process was lost."""
    known = isinstance(error, OrthoSwarmError)
    if not known:
        _log.error("job %d (%s) failed", job.id, job.kind, exc_info=error)
    message = str(error) if known else f"{type(error).__name__}: {error}"
    if isinstance(error, WorkerStoppedError) and job.attempts < _MOST_ATTEMPTS:
        return replace(job, state="queued", message=message)
    return replace(job, state="failed", message=message, ended=time.time())


def new_job(kind: str, vehicle: str | None, sortie: int | None, detail: dict[str, Any]) -> Callable[
    [sqlite3.Connection], Job
]:  # fmt: skip
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
        return Job.of(row)

    return change


def drop_change(kind: str, vehicle: str, why: str) -> Change:
    """The change that ends a vehicle's waiting jobs of a kind."""
    values = (why, time.time(), kind, packed(vehicle))

    def change(db: sqlite3.Connection) -> None:
        db.execute(
            "UPDATE jobs SET state = 'done', progress = 1, message = ?, ended = ? WHERE kind = ? AND vehicle = ?"
            " AND state = 'queued' AND json_extract(detail, '$.after') IS NULL",
            values,
        )

    return change


def _lane(job: Job) -> tuple[str, str | None]:
    """The lane of a job: of jobs in one lane only one runs at a time."""
    return ("background", None) if job.kind in _BACKGROUND else (job.kind, job.vehicle)


def _requeue(db: sqlite3.Connection) -> None:
    """Queue interrupted jobs again, but only a few times, in case the job itself ended the daemon."""
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
