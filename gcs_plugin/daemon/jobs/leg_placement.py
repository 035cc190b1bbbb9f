"""The coarse layer: legs are placed and drawn as they finish, in flight, at the lowest priority.

A job places all finished legs of the vehicle, so jobs that arrive faster than they can be done are merged into
one. Its result is temporary: the work stops at once when the vehicle completes (its refinement
replaces it) or when a refinement needs the layer.
"""

import logging
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from gcs_plugin.daemon.jobs.job_queue import Preempted, ReportProgress
from gcs_plugin.daemon.jobs.preemption import Preemption
from gcs_plugin.daemon.jobs.publisher import Publisher, detail_of, frames_of
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.worker_tasks import SolveTask, SortieResult, coarse_after, follow, near, place
from gcs_plugin.daemon.layers.layers import new_name
from gcs_plugin.daemon.store.daemon_events import JobDropped, LayerNeeded
from gcs_plugin.daemon.store.job_rows import Job, refinement_is_open
from gcs_plugin.daemon.store.journal import Change, Journal, no_change
from gcs_plugin.daemon.store.picture_store import KeptPictures, PictureStore
from gcs_plugin.daemon.store.sortie_rows import (
    LegRow,
    PlacedSortie,
    is_complete,
    legs_placed,
    placed_sortie,
    shown_sorties,
)
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError, StorageError, WorkerStoppedError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.trajectory.legs import ended_legs

MOST: Final = 200
"""Pictures that are placed at once: those of the newest legs; older ones stay as they were placed."""
_REACH_M: Final = 100.0
_log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class LegPlacement:
    """Does the jobs `coarse`.

    Attributes:
        journal, store, kept, publisher: of the workspace. workers: compute the job; used by nothing else meanwhile.
        basemap: the map, or None. device: where networks run.
    """

    journal: Journal
    store: PictureStore
    kept: KeptPictures
    publisher: Publisher
    workers: WorkerPool
    basemap: Path | None
    device: str = "auto"
    _preemption: Preemption = field(init=False)

    def __post_init__(self) -> None:
        self._preemption = Preemption(self.workers)

    def make(self, job: Job, report: ReportProgress) -> Change:
        """The handler of `coarse`."""
        target = self.publisher.solutions / f"{new_name('coarse')}.pickle"
        began = time.monotonic()
        try:
            with self._preemption.running(str(job.vehicle)):
                change = self._after(job, report, target) if "after" in job.detail else self._legs(job, report, target)
        except (Preempted, WorkerStoppedError, StorageError):
            target.unlink(missing_ok=True)
            raise
        except OrthoSwarmError as error:
            target.unlink(missing_ok=True)
            job.detail["note"] = str(error)  # the map in flight stays as it is until the refinement
            return no_change
        job.detail["seconds"] = round(time.monotonic() - began, 3)
        return change

    def drop(self, event: JobDropped) -> None:
        """Stop a job that was cancelled."""
        if event.job.vehicle == self._preemption.vehicle:
            self._preemption.stop()

    def give_way(self, event: object) -> None:
        """Stop the running job; where a layer is needed, only if it draws on that."""
        if not isinstance(event, LayerNeeded) or event.layer in self.publisher.drawing:
            self._preemption.stop()

    # -- in flight ------------------------------------------------------------------------------------------------

    def _legs(self, job: Job, report: ReportProgress, target: Path) -> Change:
        area = self.publisher.area()
        if self._is_refined(job):
            job.detail["note"] = "it is refined already"
            return no_change
        frames, thumbnails = frames_of(self.journal, self.store, job)
        everything, kept = frames, self.kept.of(job.whose, frames)
        frames, count = newest_legs(frames, area.epsg, over=bool(job.detail.get("over")))
        if not frames:
            raise OrthoSwarmError("no leg is over yet")
        report(0.1, f"{len(frames)} pictures, {count} legs")
        before = placed_sortie(self.journal, "coarse", job.whose)
        small = {f.image: thumbnails[f.image] for f in frames if f.image in thumbnails}
        task = SolveTask(
            frames=frames,
            epsg=area.epsg,
            origin=area.origin,
            basemap=self.basemap,
            thumbnails=small,
            neighbours=self._others(job, frames),
            target=target,
            before=None if before is None else self.publisher.solutions / before.path,
            kept=kept,
            device=self.device,
        )
        solved = self.workers.run(place, task)
        job.detail |= {"frames": len(frames), "solve_cpu_s": round(solved.cpu_s, 3), "legs": len(solved.legs)}
        fresh = {leg["images"][0] for leg in solved.legs}
        mine = {frame.image for frame in frames}
        earlier = [] if before is None else before.detail["legs"]
        legs = [leg for leg in earlier if leg.get("images") and leg["images"][0] not in mine | fresh]
        change = self._publish(job, report, target, solved, [*legs, *solved.legs])
        if job.detail.get("over") and kept is not None:
            self._follow(job, replace(task, frames=everything))
        return change

    def _follow(self, job: Job, task: SolveTask) -> None:
        """Track all pictures of a vehicle that has fallen silent: they may be all of its sortie when it completes."""
        try:
            job.detail["follow_cpu_s"] = round(self.workers.run(follow, task), 3)
        except OrthoSwarmError as error:  # the legs are placed, whatever stopped this
            _log.debug("the tracks of %s: %s", job.vehicle, error)

    def _others(self, job: Job, frames: list[Frame]) -> list[Path]:
        """Drawn sorties nearby, whose exposure is fixed."""
        box = near(frames, self.publisher.area().epsg)
        return [
            self.publisher.solutions / row.path
            for row in shown_sorties(self.journal, "coarse")
            if row.whose != job.whose and row.bounds.gap_m(box) < _REACH_M
        ]

    def _is_refined(self, job: Job) -> bool:
        """Whether a refinement has replaced, or is about to replace, the result."""
        if is_complete(self.journal, job.whose) or refinement_is_open(self.journal, job.whose, "queued", "running"):
            return True
        row = placed_sortie(self.journal, "solutions", job.whose)
        return row is not None and row.detail["layer"] == "coarse"

    # -- after a refinement ---------------------------------------------------------------------------------------

    def _after(self, job: Job, report: ReportProgress, target: Path) -> Change:
        """Place the complete sortie on the coarse layer, from the start values of its refinement."""
        row = placed_sortie(self.journal, "solutions", job.whose)
        if row is None or row.detail["layer"] != "fine":
            return no_change
        report(0.1, "the coarse layer beside the refined one")
        solved = self.workers.run(
            coarse_after, (self.publisher.solutions / row.path, self.publisher.area().origin, target)
        )
        return self._publish(job, report, target, solved, row.detail["legs"])

    # -- both -----------------------------------------------------------------------------------------------------

    def _publish(
        self, job: Job, report: ReportProgress, target: Path, solved: SortieResult, legs: list[LegRow]
    ) -> Change:
        old = placed_sortie(self.journal, "coarse", job.whose)
        changed = solved.changed
        if old is not None and "after" in job.detail:
            changed = BoundingBox.around([changed, old.bounds])
        placed = PlacedSortie(*job.whose, target.name, detail_of(solved, legs))
        sigmas = {image: sigma for image, (_, sigma) in solved.stages.items()}

        def change(rejected: dict[str, str]) -> Change:
            return legs_placed(placed, sigmas, rejected)

        with self.publisher.turn("coarse"):
            report(0.7, "drawing")
            if self._preemption.requested or ("after" not in job.detail and self._is_refined(job)):
                raise OrthoSwarmError("a refinement takes its place")
            job.detail["version_before"], job.detail["version"] = self.publisher.publish(
                "coarse", self.workers, job.whose, target=target, changed=changed, change=change
            )
        if old is not None:
            self.publisher.retire(self.publisher.solutions / old.path)
        self.publisher.tell("coarse", job)
        return no_change


def newest_legs(frames: list[Frame], epsg: int, *, over: bool = False) -> tuple[list[Frame], int]:
    """The pictures of the newest finished legs, at most MOST, including the turns between them; and the number of legs.

    Args:
        frames: of a sortie so far, in order of time. epsg: the area's grid. over: no more pictures are expected.
    """
    position = LocalGrid(epsg).to_grid([f.fix.lat_deg for f in frames], [f.fix.lon_deg for f in frames])
    times = [f.time_s for f in frames]
    timed = None if None in times else np.array(times, float)
    legs = ended_legs(np.asarray(position), timed, over=over)
    if not legs:
        return [], 0
    end = legs[-1][1] + 1
    chosen = [leg for leg in legs if end - leg[0] <= MOST]
    first = chosen[0][0] if chosen else end - MOST
    return frames[first:end], max(1, len(chosen))
