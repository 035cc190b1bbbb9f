"""The queue of long jobs, stored in the journal from request to result, so that none is lost or done twice.

A job that was queued or running when the daemon ended is queued again; it must be repeatable up to the
journal change that also marks it as done. Refinements have their own threads; background jobs
(coarse maps in flight, joint refinements of neighbours, tones, exports) run one at a time in another thread. They
start only while no refinement waits or runs; drawing a layer again does not wait.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

from gcs_plugin.daemon.store.daemon_events import Events, JobChanged, JobDropped, JobEnded, JobsStop, Problem
from gcs_plugin.daemon.store.frame_rows import newest_seq
from gcs_plugin.daemon.store.job_rows import (
    Job,
    find_job,
    interrupted_jobs_queued,
    job_ended,
    job_started,
    latest_jobs,
    new_job,
    open_jobs,
    queued_jobs,
    waiting_jobs_dropped,
)
from gcs_plugin.daemon.store.journal import Change, Journal, all_changes
from orthoswarm.model.errors import OrthoSwarmError, StorageError, WorkerStoppedError

_MOST_ATTEMPTS: Final = 3  # of a job whose worker stopped
_MOST_LISTED: Final = 1000  # finished jobs
_BACKGROUND: Final = frozenset({"coarse", "together", "tones", "redraw", "export"})
_AFTER_REFINEMENT: Final = _BACKGROUND - {"redraw"}
"""An export that was asked for during a refinement holds its result."""
_WAITING_THREADS: Final = 2  # beyond those of the workers, for jobs that wait for pictures
_JOURNAL_AGAIN_S: Final = 1.0
_log = logging.getLogger(__name__)


class Preempted(Exception):
    """Raised by a handler that had to give way; the job is queued again."""


ReportProgress = Callable[[float, str], None]
"""Called with a job's progress, 0 to 1, and what is being done."""
Handler = Callable[[Job, ReportProgress], Change]
"""Does a job, reporting its progress; returns the change that records its result. The job's end is written with it, in
one transaction."""


class Jobs:
    """The queue of jobs.

    Args:
        events: hears of every change; see JobChanged, JobDropped, JobEnded.
        handlers: kind -> function that does the job.
        slots: number of refinements computed at once. Two more may be at a step that needs no worker process
            (waiting for a vehicle's last pictures, publishing).

    Attributes:
        problem: why a job's end cannot be written at present, else empty.
    """

    def __init__(self, journal: Journal, events: Events, handlers: Mapping[str, Handler], slots: int) -> None:
        self._journal, self._events, self._handlers = journal, events, handlers
        self._condition = threading.Condition()
        self._running: dict[int, Job] = {}
        self._unwanted: dict[int, str] = {}
        self._stop = False
        self.problem = ""
        self._threads = [
            threading.Thread(target=self._run, args=(False,), name=f"refinement {n}", daemon=True)
            for n in range(max(1, slots) + _WAITING_THREADS)
        ]
        self._threads.append(threading.Thread(target=self._run, args=(True,), name="background jobs", daemon=True))
        journal.write(interrupted_jobs_queued)

    def start(self) -> None:
        """Start working."""
        for thread in self._threads:
            thread.start()

    def give_up(self) -> None:
        """Start no more jobs; errors from now on are due to the shutdown and not failures."""
        with self._condition:
            self._stop = True
            self._condition.notify_all()
        self._events.publish(JobsStop())

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
        self._journal.write(waiting_jobs_dropped(kind, vehicle, why))
        with self._condition:
            running = [
                job
                for job in self._running.values()
                if (job.kind, job.vehicle) == (kind, vehicle) and "after" not in job.detail
            ]
            for job in running:
                self._unwanted[job.id] = why
        for job in running:
            self._events.publish(JobDropped(job))

    def wake(self) -> None:
        """Check the queue again, after a job was put directly into the journal."""
        with self._condition:
            self._condition.notify_all()

    def all(self) -> list[Job]:
        """The latest jobs, oldest first."""
        found = latest_jobs(self._journal, _MOST_LISTED)
        with self._condition:
            return [self._running.get(job.id, job) for job in found]

    def find(self, number: int) -> Job | None:
        """A job by its number."""
        return find_job(self._journal, number)

    def open(self, *kinds: str) -> int:
        """Number of waiting and running jobs of these kinds (all, if none is given), without coarse maps in flight."""
        return sum(not kinds or kind in kinds for kind in open_jobs(self._journal))

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
        queued = queued_jobs(self._journal)
        busy = {_lane(job) for job in self._running.values()}
        refining = any(kind == "refine" for kind, _ in busy) or any(job.kind == "refine" for job in queued)
        for job in queued:
            if (job.kind in _BACKGROUND) != background or job.id in self._running or _lane(job) in busy:
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
        self._journal.write(job_started(job))
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
        try:
            self._events.publish(JobEnded(ended))
        except OrthoSwarmError as error:
            _log.error("after job %d: %s", job.id, error)

    def _outcome(self, job: Job, progress: ReportProgress) -> tuple[Job, Change] | None:
        """Do a job; returns the ended job and the journal change that records it, None if the daemon stops."""
        try:
            change = self._handlers[job.kind](job, progress)
            if self._stop:
                return None
            ended = replace(job, state="done", progress=1.0, message="", ended=time.time())
            return ended, all_changes(change, job_ended(ended))
        except Exception as error:
            if self._stop:  # its worker was stopped
                return None
            if job.id in self._unwanted:
                ended = replace(job, state="done", progress=1.0, message=self._unwanted[job.id], ended=time.time())
            elif isinstance(error, Preempted):
                ended = replace(job, state="queued", progress=0.0, started=None, attempts=job.attempts - 1)
            else:
                ended = _failed(job, error)
            return ended, job_ended(ended)

    def _write_end(self, job: Job, change: Change) -> bool:
        """Write a job's end, retrying while the disk is full; False if the daemon stops before that."""
        while True:
            try:
                self._journal.write(change)
            except StorageError as error:
                if not self.problem:
                    _log.error("the end of job %d (%s) waits: %s", job.id, job.kind, error)
                    self._events.publish(Problem(str(error)))
                self.problem = str(error)
            else:
                self.problem = ""
                return True
            with self._condition:
                if self._stop:
                    return False
                self._condition.wait(_JOURNAL_AGAIN_S)

    def _publish(self, job: Job) -> None:
        self._events.publish(JobChanged(job.document()))


def _failed(job: Job, error: Exception) -> Job:
    """A failed job; queued again if only its worker process was lost."""
    known = isinstance(error, OrthoSwarmError)
    if not known:
        _log.error("job %d (%s) failed", job.id, job.kind, exc_info=error)
    message = str(error) if known else f"{type(error).__name__}: {error}"
    if isinstance(error, WorkerStoppedError) and job.attempts < _MOST_ATTEMPTS:
        return replace(job, state="queued", message=message)
    return replace(job, state="failed", message=message, ended=time.time())


def _lane(job: Job) -> tuple[str, str | None]:
    """The lane of a job: of jobs in one lane only one runs at a time."""
    return ("background", None) if job.kind in _BACKGROUND else (job.kind, job.vehicle)
