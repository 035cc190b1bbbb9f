"""The queue of long jobs, stored in the journal from request to result, so that none is lost or done twice.

A job that was queued or running when the daemon ended is queued again; it must be repeatable up to the
journal change that also marks it as done. Refinements have their own threads; background jobs (coarse maps in flight,
joint refinements of neighbours, tones, exports, comparisons with the basemap) run one at a time in another thread. They
start only while no refinement waits or runs, and give way to one that begins; drawing a layer again does not wait.
`JobRequests` asks for jobs when something has happened: a leg is over, a mission complete, a refinement done.
`LegWatch` detects legs that are over in flight, and vehicles that fall silent.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, TypeVar

import numpy as np

from gcs_plugin.config import SORTIE
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.workspace_products import FORMATS, PRODUCTS
from gcs_plugin.daemon.stoppable_thread import Background
from gcs_plugin.daemon.store import daemon_events as happened
from gcs_plugin.daemon.store import job_rows
from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.frame_rows import Whose, late_frames, newest_seq, photographed_sorties, unplaced_frames
from gcs_plugin.daemon.store.job_rows import Job
from gcs_plugin.daemon.store.journal import Change, Journal, all_changes
from gcs_plugin.daemon.store.sortie_rows import complete_sorties, is_complete, present_sortie
from orthoswarm.model.earth import DEGREE_M
from orthoswarm.model.errors import InputError, OrthoSwarmError, StorageError, WorkerStoppedError
from orthoswarm.trajectory.legs import ended_legs

Result = TypeVar("Result")

_MOST_ATTEMPTS: Final = 3  # of a job whose worker stopped
_MOST_LISTED: Final = 1000  # finished jobs
_BACKGROUND: Final = frozenset({"coarse", "together", "tones", "redraw", "export", "change"})
_AFTER_REFINEMENT: Final = _BACKGROUND - {"redraw"}
"""An export that was asked for during a refinement holds its result."""
_GIVES_WAY: Final = _AFTER_REFINEMENT - {"export"}
_CHANGE_PRODUCTS: Final = ("refine", "together", "tones", "coarse", "redraw")
_REPLACED: Final = "dropped: the vehicle's refinement takes its place"
_COMPLETE: Final = "dropped: the vehicle is complete, its refinement takes its place"
_WATCHED_AGAIN: Final = 2000  # pictures of the last daemon
_WAITING_THREADS: Final = 2  # beyond those of the workers, for jobs that wait for pictures
_JOURNAL_AGAIN_S: Final = 1.0
_log = logging.getLogger(__name__)


class Preempted(OrthoSwarmError):
    """A job has to give way; it is queued again."""


@dataclass(slots=True, eq=False)
class RunningJob:
    """A job under way, as the part that does it sees it.

    Attributes:
        job: what is done; its `detail` takes what it comes to. stopping: set once the daemon stops.
        workers: the pool that computes it; what is to be stopped while it runs is computed by `run`.
    """

    job: Job
    workers: WorkerPool
    stopping: threading.Event
    _events: Events
    _gives_way: bool = False

    def report(self, share: float, message: str) -> None:
        """Tell the pages its progress, 0 to 1, and what is being done."""
        self.job.progress, self.job.message = share, message
        self._events.tell("job", **self.job.document())

    def run(self, function: Callable[[Any], Result], item: Any) -> Result:
        """Run a function of one argument in a worker process, see `WorkerPool.run`.

        Raises:
            Preempted: the job has to give way.
        """
        try:
            if not self._gives_way:
                return self.workers.run(function, item)
        except OrthoSwarmError:
            if not self._gives_way:
                raise
        raise Preempted("it gives way")

    def give_way(self) -> None:
        """Stop what it computes, now and from now on; any thread."""
        self._gives_way = True
        self.workers.abandon()


Handler = Callable[[RunningJob], Change]
"""Does a job; returns the change that records its result. The job's end is written with it, in one transaction."""


class Jobs:
    """The queue of jobs.

    Args:
        events: hears of every change, and JobEnded.
        handlers: kind -> function that does the job.
        workers: compute refinements, as many at once as it has processes. Two more may be at a step that needs none
            (waiting for a vehicle's last pictures, publishing). background: computes the others, and nothing else.

    Attributes:
        problem: why a job's end cannot be written at present, else empty.
    """

    def __init__(
        self, journal: Journal, events: Events, handlers: Mapping[str, Handler], workers: WorkerPool,
        background: WorkerPool,
    ) -> None:  # fmt: skip
        self._journal, self._events, self._handlers = journal, events, handlers
        self._workers, self._background = workers, background
        self._condition = threading.Condition()
        self._running: dict[int, RunningJob] = {}
        self._unwanted: dict[int, str] = {}
        self._stop = threading.Event()
        self.problem = ""
        self._threads = [
            threading.Thread(target=self._run, args=(False,), name=f"refinement {n}", daemon=True)
            for n in range(workers.count + _WAITING_THREADS)
        ]
        self._threads.append(threading.Thread(target=self._run, args=(True,), name="background jobs", daemon=True))
        journal.write(job_rows.interrupted_jobs_queued)

    def start(self) -> None:
        """Start working."""
        for thread in self._threads:
            thread.start()

    def give_up(self) -> None:
        """Start no more jobs; errors from now on are due to the shutdown and not failures."""
        self._stop.set()
        self.wake()

    def close(self) -> None:
        """Start no more jobs; running ones are abandoned by their workers and queued again at the next start."""
        self.give_up()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(10.0)

    def add(self, kind: str, vehicle: str | None = None, sortie: int | None = None, **detail: Any) -> Job:
        """Queue a job; returns an equal waiting one if there is one."""
        job = self._journal.write(job_rows.new_job(kind, vehicle, sortie, detail))
        self._events.tell("job", **job.document())
        self.wake()
        return job

    def drop(self, kind: str, vehicle: str, why: str) -> None:
        """Cancel a vehicle's jobs of a kind: waiting ones end at once, a running one is abandoned."""
        self._journal.write(job_rows.waiting_jobs_dropped(kind, vehicle, why))
        with self._condition:
            found = [run for run in self._running.values() if (run.job.kind, run.job.vehicle) == (kind, vehicle)]
            dropped = [run for run in found if "after" not in run.job.detail]
            self._unwanted |= {run.job.id: why for run in dropped}
        for run in dropped:
            run.give_way()

    def wake(self) -> None:
        """Check the queue again, after a job was put directly into the journal."""
        with self._condition:
            self._condition.notify_all()

    def all(self) -> list[Job]:
        """The latest jobs, oldest first."""
        found = job_rows.latest_jobs(self._journal, _MOST_LISTED)
        with self._condition:
            return [self._running[job.id].job if job.id in self._running else job for job in found]

    def documents(self) -> list[dict[str, Any]]:
        """The latest jobs as JSON values, oldest first."""
        return [job.document() for job in self.all()]

    def find(self, number: int) -> Job | None:
        """A job by its number."""
        return job_rows.find_job(self._journal, number)

    def open(self, *kinds: str) -> int:
        """Number of waiting and running jobs of these kinds (all, if none is given), without coarse maps in flight."""
        return sum(not kinds or kind in kinds for kind in job_rows.open_jobs(self._journal))

    # -- the threads ----------------------------------------------------------------------------------------------

    def _run(self, background: bool) -> None:
        while True:
            with self._condition:
                if self._stop.is_set():
                    return
                run = self._next(background)
                if run is None:
                    self._condition.wait(5.0)
                    continue
            try:
                self._do(run)
            except Exception as error:  # its start cannot be written: it is still queued in the journal
                _log.error("job %d (%s) waits: %s", run.job.id, run.job.kind, error)
                with self._condition:
                    self._running.pop(run.job.id, None)
                    self._condition.wait(_JOURNAL_AGAIN_S)

    def _next(self, background: bool) -> RunningJob | None:
        """Take the next background job, or the next refinement; the jobs of a vehicle run one after the other."""
        queued = job_rows.queued_jobs(self._journal)
        busy = {_lane(run.job) for run in self._running.values()}
        refining = any(kind == "refine" for kind, _ in busy) or any(job.kind == "refine" for job in queued)
        for job in queued:
            if (job.kind in _BACKGROUND) != background or job.id in self._running or _lane(job) in busy:
                continue
            if refining and job.kind in _AFTER_REFINEMENT:
                continue
            job.state, job.started, job.attempts = "running", time.time(), job.attempts + 1
            workers = self._background if background else self._workers
            self._running[job.id] = RunningJob(job, workers, self._stop, self._events)
            return self._running[job.id]
        return None

    def _do(self, run: RunningJob) -> None:
        job = run.job
        if job.kind == "refine":
            job.detail["newest_seq"] = newest_seq(self._journal)  # pictures that arrive later are late
            self._make_way(job)
        self._journal.write(job_rows.job_started(job))
        self._events.tell("job", **job.document())
        try:
            outcome = self._outcome(run)
            if outcome is None or not self._write_end(*outcome):
                return  # the daemon stops; the job is queued again at the next start
            ended = outcome[0]
        finally:
            with self._condition:
                self._running.pop(job.id, None)
                self._unwanted.pop(job.id, None)
                self._condition.notify_all()
        self._events.tell("job", **ended.document())
        try:
            self._events.publish(happened.JobEnded(ended))
        except OrthoSwarmError as error:
            _log.error("after job %d: %s", job.id, error)

    def _make_way(self, refinement: Job) -> None:
        """Drop the vehicle's coarse maps, and stop what is done in the background; none of that begins meanwhile."""
        self.drop("coarse", str(refinement.vehicle), _REPLACED)
        with self._condition:
            running = [run for run in self._running.values() if run.job.kind in _GIVES_WAY]
        for run in running:
            run.give_way()

    def _outcome(self, run: RunningJob) -> tuple[Job, Change] | None:
        """Do a job; returns the ended job and the journal change that records it, None if the daemon stops."""
        job = run.job
        try:
            change = self._handlers[job.kind](run)
            if self._stop.is_set():
                return None
            ended = replace(job, state="done", progress=1.0, message="", ended=time.time())
            return ended, all_changes(change, job_rows.job_ended(ended))
        except Exception as error:
            if self._stop.is_set():  # its worker was stopped
                return None
            if job.id in self._unwanted:
                ended = replace(job, state="done", progress=1.0, message=self._unwanted[job.id], ended=time.time())
            elif isinstance(error, Preempted):
                ended = replace(job, state="queued", progress=0.0, started=None, attempts=job.attempts - 1)
            else:
                ended = _failed(job, error)
            return ended, job_rows.job_ended(ended)

    def _write_end(self, job: Job, change: Change) -> bool:
        """Write a job's end, retrying while the disk is full; False if the daemon stops before that."""
        while True:
            try:
                self._journal.write(change)
            except StorageError as error:
                if not self.problem:
                    _log.error("the end of job %d (%s) waits: %s", job.id, job.kind, error)
                    self._events.tell("problem", text=str(error))
                self.problem = str(error)
            else:
                self.problem = ""
                return True
            if self._stop.wait(_JOURNAL_AGAIN_S):
                return False


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


_LOOK_S: Final = 0.5


@dataclass(slots=True)
class _Path:
    """Times and positions of a sortie's pictures since the last leg that was asked for."""

    times: list[float] = field(default_factory=list)
    places: list[tuple[float, float]] = field(default_factory=list)
    heard: float = 0.0
    dirty: bool = False


class LegWatch(Background):
    """Watches the paths of all vehicles, in a thread.

    Args:
        events: told of finished legs, and of a vehicle that falls silent, however few pictures it sent before.

    Attributes:
        silent_s: a vehicle is silent when no picture has arrived for so long, seconds.
    """

    def __init__(self, events: Events, *, silent_s: float) -> None:
        super().__init__("legs")
        self._events, self.silent_s = events, silent_s
        self._lock = threading.Lock()
        self._paths: dict[tuple[str, int], _Path] = {}

    def picture_stored(self, event: happened.PictureStored) -> None:
        """Record a picture that has come; one without a position says nothing of the path."""
        if event.has_fix:
            frame = event.frame
            time_s = event.arrived_s if frame.time_s is None else frame.time_s
            self.add(frame.vehicle, event.sortie, time_s, frame.fix.lat_deg, frame.fix.lon_deg)

    def add(self, vehicle: str, sortie: int, time_s: float, lat_deg: float, lon_deg: float) -> None:
        """Record a picture; any thread."""
        with self._lock:
            path = self._paths.setdefault((vehicle, sortie), _Path())
            path.times.append(time_s)
            path.places.append((lat_deg, lon_deg))
            path.heard, path.dirty = time.monotonic(), True

    def _run(self) -> None:
        while not self._stop.wait(min(_LOOK_S, 0.25 * self.silent_s)):
            now = time.monotonic()
            with self._lock:
                due = [
                    (key, path)
                    for key, path in self._paths.items()
                    if (path.dirty and len(path.times) >= SORTIE.coarse_map_pictures)
                    or 0 < path.heard < now - self.silent_s
                ]
            for key, path in due:
                try:
                    self._look(key, path, now)
                except Exception:  # an error in one path must not end the watch of the others
                    _log.exception("the legs of %s", key[0])

    def _look(self, key: tuple[str, int], path: _Path, now: float) -> None:
        with self._lock:
            order = sorted(range(len(path.times)), key=path.times.__getitem__)
            times = [path.times[k] for k in order]
            places = [path.places[k] for k in order]
            silent = now - path.heard > self.silent_s
            path.dirty = False
            if silent:
                path.heard = 0.0  # reported once
        if silent:
            self._events.publish(happened.VehicleSilent(*key))
        if len(times) < SORTIE.coarse_map_pictures:
            return
        lat, lon = np.array(places).T
        north = (lat - lat[0]) * DEGREE_M
        east = (lon - lon[0]) * DEGREE_M * np.cos(np.radians(lat[0]))
        legs = ended_legs(np.column_stack([east, north]), np.array(times), over=silent)
        if sum(last + 1 - first for first, last in legs) < SORTIE.coarse_map_pictures:
            return
        with self._lock:
            past = set(times[: legs[-1][1] + 1])
            keep = [k for k, t in enumerate(path.times) if t not in past]
            path.times = [path.times[k] for k in keep]
            path.places = [path.places[k] for k in keep]
        self._events.publish(happened.LegsOver(*key, silent))


class JobRequests:
    """Asks for jobs; coarse: in flight, too. basemap: there is one, with which written products are compared."""

    def __init__(self, journal: Journal, jobs: Jobs, *, coarse: bool, basemap: bool) -> None:
        self._journal, self._jobs, self._coarse, self._basemap = journal, jobs, coarse, basemap

    def refine(self, vehicle: str | None = None) -> list[Job]:
        """Queue the refinement of a vehicle's last sortie, or of all sorties that have pictures.

        Raises:
            InputError: the vehicle has sent no picture.
        """
        wanted = photographed_sorties(self._journal)
        if vehicle is not None:
            wanted = [whose for whose in wanted if whose[0] == vehicle][-1:]
            if not wanted:
                raise InputError(f"vehicle {vehicle} has sent no picture; see /api/vehicles")
        return [self._jobs.add("refine", *whose) for whose in wanted]

    def export(self, formats: list[str]) -> Job:
        """Queue an export; raises InputError: an unknown format."""
        unknown = [name for name in formats if name not in FORMATS]
        if unknown or not formats:
            raise InputError(f"there is no format {unknown or 'given'}; choose from: {', '.join(FORMATS)}")
        return self._jobs.add("export", formats=list(dict.fromkeys(formats)))

    def continue_last(self, watch: LegWatch) -> None:
        """Ask for what the last daemon left undone, and have its unplaced pictures watched."""
        for whose in complete_sorties(self._journal):
            self._refine_late(whose)
        for row in unplaced_frames(self._journal, _WATCHED_AGAIN):
            time_s = row.arrived_s if row.time_s is None else row.time_s
            watch.add(row.vehicle, row.sortie, time_s, row.pose["lat_deg"], row.pose["lon_deg"])

    # -- what has happened ----------------------------------------------------------------------------------------

    def first_pictures_came(self, event: happened.FirstPicturesCame) -> None:
        """Have a vehicle looked for on the basemap."""
        if self._coarse and not is_complete(self._journal, (event.vehicle, event.sortie)):
            self._jobs.add("coarse", event.vehicle, event.sortie, first=True)

    def legs_over(self, event: happened.LegsOver) -> None:
        """Queue the coarse map of a sortie that is still flown; on a basemap it is registered picture by picture."""
        whose = (event.vehicle, event.sortie)
        if self._coarse and not self._basemap and not is_complete(self._journal, whose):
            self._jobs.add("coarse", event.vehicle, event.sortie, **({"over": True} if event.silent else {}))

    def vehicle_silent(self, event: happened.VehicleSilent) -> None:
        """Have late pictures placed that came over a slow link; before a refinement, have all tracked for it."""
        whose = (event.vehicle, event.sortie)
        self._refine_late(whose)
        if self._coarse and self._basemap and not is_complete(self._journal, whose):
            self._jobs.add("coarse", *whose, over=True)

    def card_read(self, event: happened.CardRead) -> None:
        """Have the sortie refined with the pictures of a card that was read after landing."""
        self._refine_late((event.vehicle, present_sortie(self._journal, event.vehicle)))

    def _refine_late(self, whose: Whose) -> None:
        if not job_rows.refinement_is_open(self._journal, whose, "queued") and late_frames(self._journal, *whose):
            self._jobs.add("refine", *whose, trigger="late")

    def mission_noted(self, event: happened.MissionNoted) -> None:
        """Begin the refinement that a completion has queued; the vehicle's coarse maps are not needed any more."""
        if event.kind == "complete":
            self._jobs.drop("coarse", event.vehicle, _COMPLETE)
        self._jobs.wake()

    def job_ended(self, event: happened.JobEnded) -> None:
        """Export the products again once nothing is left to refine, then compare them with the map."""
        job = event.job
        written = job.kind == "export" and job.state == "done" and "after" in job.detail
        if written and self._basemap and not self._jobs.open(*_CHANGE_PRODUCTS, "export"):
            self._jobs.add("change")
        if job.kind == "refine":
            self._jobs.wake()
        elif job.kind not in ("together", "tones", "redraw") and (job.kind != "coarse" or "after" not in job.detail):
            return
        if not self._jobs.open(*_CHANGE_PRODUCTS):
            self._jobs.add("export", formats=list(PRODUCTS), after="all")
