"""The coarse layer: legs are placed and drawn as they finish, in flight, at the lowest priority.

A job places all finished legs of the vehicle, so jobs that arrive faster than they can be done are merged into
one. Its result is temporary: the work stops at once when the vehicle completes (its refinement replaces it), or when
any refinement begins.
"""

import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from gcs_plugin.daemon.jobs.job_queue import Preempted, RunningJob
from gcs_plugin.daemon.jobs.publisher import Publisher, detail_of, frames_of
from gcs_plugin.daemon.jobs.solution_file import read_solution
from gcs_plugin.daemon.jobs.worker_tasks import SortieResult, SortieTask, coarse_after, follow, look_for, near, place
from gcs_plugin.daemon.layers.live_registration import MOST_LOOKED_FOR
from gcs_plugin.daemon.store import sortie_rows
from gcs_plugin.daemon.store.daemon_events import Events, VehicleLookedFor
from gcs_plugin.daemon.store.job_rows import Job, refinement_is_open
from gcs_plugin.daemon.store.journal import Change, no_change
from gcs_plugin.daemon.store.picture_store import KeptPictures, PictureStore
from gcs_plugin.daemon.store.sortie_rows import LegRow, PlacedSortie
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError, StorageError, WorkerStoppedError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.trajectory.legs import ended_legs

MOST: Final = 200
"""Pictures that are placed at once: those of the newest legs; older ones stay as they were placed."""
_REACH_M: Final = 100.0
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class LegPlacement:
    """Does the jobs `coarse`; `kept`: what is kept of the pictures in `store` until they are refined.

    `events`: told what came of a vehicle that was looked for.
    """

    publisher: Publisher
    store: PictureStore
    kept: KeptPictures
    events: Events

    def make(self, run: RunningJob) -> Change:
        """The handler of `coarse`."""
        began = time.monotonic()
        if "first" in run.job.detail:
            return self._first(run)
        try:
            with self.publisher.new_solution("coarse") as target:
                (self._after if "after" in run.job.detail else self._legs)(run, target)
        except (Preempted, WorkerStoppedError, StorageError):
            raise
        except OrthoSwarmError as error:
            run.job.detail["note"] = str(error)  # the map in flight stays as it is until the refinement
        else:
            run.job.detail["seconds"] = round(time.monotonic() - began, 3)
        return no_change

    def _first(self, run: RunningJob) -> Change:
        """Look for a vehicle's newest pictures on the basemap, and tell what came of it."""
        job, publisher, solution = run.job, self.publisher, None
        area = publisher.area()
        with publisher.new_solution("live") as target:
            try:
                frames = frames_of(publisher.journal, self.store, job)[0][-MOST_LOOKED_FOR:]
                run.report(0.1, f"looking for {len(frames)} pictures on the basemap")
                solved = run.run(look_for, publisher.task(target, frames=frames))
                job.detail |= {"frames": len(frames), "solve_cpu_s": round(solved, 3)}
                solution = read_solution(target).solution
            except (Preempted, WorkerStoppedError, StorageError):
                raise
            except OrthoSwarmError as error:
                job.detail["note"] = str(error)
        self.events.publish(VehicleLookedFor(str(job.vehicle), int(job.sortie or 0), area.epsg, solution))
        return no_change

    # -- in flight ------------------------------------------------------------------------------------------------

    def _legs(self, run: RunningJob, target: Path) -> None:
        job, publisher = run.job, self.publisher
        area = publisher.area()
        if self._is_refined(job):
            job.detail["note"] = "it is refined already"
            return
        everything, thumbnails = frames_of(publisher.journal, self.store, job)
        kept = self.kept.of(job.whose, everything)
        if publisher.basemap is not None:  # its pictures are registered as they come
            if kept is not None:
                self._follow(run, publisher.task(target, frames=everything, kept=kept))
            return
        frames, count = newest_legs(everything, area.epsg, over=bool(job.detail.get("over")))
        if not frames:
            raise OrthoSwarmError("no leg is over yet")
        run.report(0.1, f"{len(frames)} pictures, {count} legs")
        before = sortie_rows.placed_sortie(publisher.journal, "coarse", job.whose)
        task = publisher.task(
            target,
            frames=frames,
            thumbnails={f.image: thumbnails[f.image] for f in frames if f.image in thumbnails},
            neighbours=self._others(job, near(frames, area.epsg)),
            before=None if before is None else publisher.solutions / before.path,
            kept=kept,
        )
        solved = run.run(place, task)
        job.detail |= {"frames": len(frames), "solve_cpu_s": round(solved.cpu_s, 3), "legs": len(solved.legs)}
        again = {leg["images"][0] for leg in solved.legs} | {frame.image for frame in frames}
        earlier = [] if before is None else before.detail["legs"]
        legs = [leg for leg in earlier if leg.get("images") and leg["images"][0] not in again]
        self._publish(run, target, solved, [*legs, *solved.legs])
        if job.detail.get("over") and kept is not None:
            self._follow(run, replace(task, frames=everything))

    def _follow(self, run: RunningJob, task: SortieTask) -> None:
        """Track all pictures of a vehicle that has fallen silent: they may be all of its sortie when it completes."""
        try:
            run.job.detail["follow_cpu_s"] = round(run.run(follow, task), 3)
        except OrthoSwarmError as error:  # the legs are placed, whatever stopped this
            _log.debug("the tracks of %s: %s", run.job.vehicle, error)

    def _others(self, job: Job, box: BoundingBox) -> list[Path]:
        """Drawn sorties near a box, whose exposure is fixed."""
        return [
            self.publisher.solutions / row.path
            for row in sortie_rows.shown_sorties(self.publisher.journal, "coarse")
            if row.whose != job.whose and row.bounds.gap_m(box) < _REACH_M
        ]

    def _is_refined(self, job: Job) -> bool:
        """Whether a refinement has replaced, or is about to replace, the result."""
        journal = self.publisher.journal
        if sortie_rows.is_complete(journal, job.whose) or refinement_is_open(journal, job.whose, "queued", "running"):
            return True
        row = sortie_rows.placed_sortie(journal, "solutions", job.whose)
        return row is not None and row.detail["layer"] == "coarse"

    # -- after a refinement ---------------------------------------------------------------------------------------

    def _after(self, run: RunningJob, target: Path) -> None:
        """Place the complete sortie on the coarse layer, from the start values of its refinement."""
        row = sortie_rows.placed_sortie(self.publisher.journal, "solutions", run.job.whose)
        if row is None or row.detail["layer"] != "fine":
            return
        run.report(0.1, "the coarse layer beside the refined one")
        solved = run.run(coarse_after, self.publisher.task(target, before=self.publisher.solutions / row.path))
        self._publish(run, target, solved, row.detail["legs"])

    # -- both -----------------------------------------------------------------------------------------------------

    def _publish(self, run: RunningJob, target: Path, solved: SortieResult, legs: list[LegRow]) -> None:
        job, publisher = run.job, self.publisher
        old = sortie_rows.placed_sortie(publisher.journal, "coarse", job.whose)
        changed = solved.changed
        if old is not None and "after" in job.detail:
            changed = BoundingBox.around([changed, old.bounds])
        placed = PlacedSortie(*job.whose, target.name, detail_of(solved, legs))
        sigmas = {image: sigma for image, (_, sigma) in solved.stages.items()}
        with publisher.turn("coarse") as turn:
            run.report(0.7, "drawing")
            if "after" not in job.detail and self._is_refined(job):
                raise OrthoSwarmError("a refinement takes its place")
            rejected = turn.draw(run, job.whose, target, changed)
            job.detail |= turn.publish(sortie_rows.legs_placed(placed, sigmas, rejected))
        publisher.retire(old)
        publisher.tell("coarse", job)


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
