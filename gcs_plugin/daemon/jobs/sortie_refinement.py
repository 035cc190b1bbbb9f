"""Refinement of one vehicle's sortie: gather its frames, solve and draw in worker processes, publish at once."""

import logging
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

from gcs_plugin.config import SORTIE
from gcs_plugin.daemon.jobs.job_queue import RunningJob
from gcs_plugin.daemon.jobs.neighbours import together_jobs
from gcs_plugin.daemon.jobs.publisher import Publisher, detail_of, frames_of, refined_change
from gcs_plugin.daemon.jobs.worker_tasks import SortieResult, follow, near, register_late, solve
from gcs_plugin.daemon.jobs.workspace_products import PRODUCTS
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.store.frame_rows import last_arrivals, late_frames, newest_seq
from gcs_plugin.daemon.store.job_rows import Job, new_job
from gcs_plugin.daemon.store.journal import Change, all_changes, no_change
from gcs_plugin.daemon.store.picture_store import KeptPictures, PictureStore
from gcs_plugin.daemon.store.sortie_rows import PlacedSortie, placed_sortie
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError

_REACH_M: Final = 400.0
_DRAWN_S: Final = 3.0
_BEGUN_S: Final = 60.0
"""How long the first picture may take to begin the map, on a machine that is busy or compiles the kernels."""
_QUIET_S: Final = 0.7
_MOST_QUIET_S: Final = 3.0
_LATE_S: Final = 15.0
_LOOKED_AT: Final = 8  # pictures whose interval is the usual one
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class SortieRefinement:
    """Does the jobs `refine`; `kept`: what is kept of the pictures in `store` until they are refined.

    `drawer`: of the real-time layer.
    """

    publisher: Publisher
    store: PictureStore
    kept: KeptPictures
    drawer: Drawer

    def refine(self, run: RunningJob) -> Change:
        """The handler of `refine`."""
        job, began = run.job, time.monotonic()
        late = job.detail.get("trigger") == "late"
        run.report(0.02, "waiting for the last pictures")
        if not late:
            self._follow(run)
        if job.detail.get("trigger") == "complete":
            self._wait_quiet(run)
        self.wait_drawn(run)
        if late and not late_frames(self.publisher.journal, str(job.vehicle), job.sortie, job.id):
            return _nothing_came(job)
        run.report(0.03, "waiting for a free worker process")
        with self.publisher.new_solution() as target:
            with run.workers.reserved():
                before, frames, solved = self._solve(run, target)
            if before is not None:
                job.detail["beside"] = len(solved.stages)
                if not solved.stages and not solved.dropped:
                    return _nothing_came(job)
            job.detail |= {
                "frames": frames, "solve_cpu_s": round(solved.cpu_s, 3), "solve_s": round(solved.wall_s, 3),
                "warnings": solved.warnings,
            }  # fmt: skip
            self._show(run, target, solved, before)
        job.detail["seconds"] = round(time.monotonic() - began, 3)
        self.kept.drop(job.whose)
        return no_change

    def _follow(self, run: RunningJob) -> None:
        """Track the pictures that have come, while the last ones come and are drawn; if a process is free.

        If others come nevertheless, or one turns out to be unreadable, all are tracked again with the solution.
        """
        job, used = run.job, None
        try:
            frames, _ = frames_of(self.publisher.journal, self.store, job)
            task = self.publisher.task(Path(), frames=frames, kept=self.kept.of(job.whose, frames))
            if task.kept is not None:
                used = run.workers.run_if_free(follow, task)
        except OrthoSwarmError as error:  # the solution will fail, or not, for its own reason
            _log.debug("the tracks of %s: %s", job.vehicle, error)
        if used is not None:
            job.detail["follow_cpu_s"] = round(used, 3)

    def _solve(self, run: RunningJob, target: Path) -> tuple[PlacedSortie | None, int, SortieResult]:
        """Solve the pictures that have arrived into a new solution file, in the reserved process.

        Returns:
            The solution to which late pictures were registered (None: all were refined), the number of
            pictures, and their result.
        """
        job, publisher = run.job, self.publisher
        journal = publisher.journal
        job.detail["refine_started_s"] = time.time()
        job.detail["newest_seq"] = newest_seq(journal)  # pictures that arrive later are late
        frames, thumbnails = frames_of(journal, self.store, job)
        before = self._refined_before(job, len(frames))
        run.report(
            0.05, f"refining {len(frames)} pictures" if before is None else "registering late pictures to the others"
        )
        others = publisher.refined_near(job.whose, near(frames, publisher.area().epsg), _REACH_M)
        task = publisher.task(
            target,
            frames=frames,
            thumbnails=thumbnails,
            neighbours=list(others.values()),
            before=None if before is None else publisher.solutions / before.path,
            kept=self.kept.of(job.whose, frames),
        )
        return before, len(frames), run.run(solve if before is None else register_late, task)

    def _show(self, run: RunningJob, target: Path, solved: SortieResult, before: PlacedSortie | None) -> None:
        """Draw and publish what was solved."""
        job, publisher = run.job, self.publisher
        layer = job.detail["layer"] = publisher.refined
        with publisher.turn(layer) as turn:
            run.report(0.7, "drawing")
            old = placed_sortie(publisher.journal, "solutions", job.whose)
            shown = publisher.shown(layer, job.whose)
            changed = solved.changed
            if before is None and shown is not None:  # its old ground changes, too
                changed = BoundingBox.around([changed, shown.bounds])
            rejected = turn.draw(run, job.whose, target, changed)
            job.detail |= turn.publish(self._change(job, target, solved, rejected, before))
        job.detail["published_s"] = time.time()
        publisher.retire(old)  # the journal names it no more
        publisher.tell(layer, job)

    # -- the parts ------------------------------------------------------------------------------------------------

    def wait_drawn(self, run: RunningJob) -> None:
        """Wait a few seconds until the sortie's pictures are drawn, and longer for the first, which begins the map."""
        vehicle, sortie, end = str(run.job.vehicle), run.job.sortie, time.monotonic() + _BEGUN_S
        drawn = self.drawer.wait_drawn(vehicle, sortie, _DRAWN_S)
        while not drawn and self.drawer.area is None and time.monotonic() < end and not run.stopping.is_set():
            drawn = self.drawer.wait_drawn(vehicle, sortie, _QUIET_S)

    def _wait_quiet(self, run: RunningJob) -> None:
        """Wait for pictures that were under way when the vehicle completed; they belong to its sortie.

        They are considered complete when none has arrived for longer than the usual interval.
        """
        end = time.monotonic() + _LATE_S
        while time.monotonic() < end and not run.stopping.is_set():
            came = last_arrivals(self.publisher.journal, str(run.job.vehicle), run.job.sortie, _LOOKED_AT)
            apart = max((a - b for a, b in pairwise(came)), default=0.0)
            if came and time.time() - came[0] > min(max(_QUIET_S, apart), _MOST_QUIET_S):
                return
            time.sleep(0.05)

    def _refined_before(self, job: Job, count: int) -> PlacedSortie | None:
        """The refinement to which late pictures are registered; None if all are to be refined."""
        if job.detail.get("trigger") != "late":
            return None
        row = placed_sortie(self.publisher.journal, "solutions", job.whose)
        refined = None if row is None else row.detail.get("refined")
        return row if refined is not None and count - refined < SORTIE.again_pictures else None

    def _change(
        self, job: Job, target: Path, solved: SortieResult, rejected: dict[str, str], before: PlacedSortie | None
    ) -> Change:
        """What the journal records of what was drawn, with the jobs that come after."""
        detail = detail_of(solved, solved.legs)
        if before is None:
            detail |= {"layer": self.publisher.refined, "refined": len(solved.stages) - len(rejected)}
        else:
            detail = before.detail | {"bounds": solved.bounds}
        then: list[Change] = [refined_change(job, solved, rejected, target.name, detail)]
        if self.publisher.basemap is not None:  # the coarse layer shows all of the sortie, too
            then.append(new_job("coarse", *job.whose, {"after": "refine"}))
            if before is None:
                then += together_jobs(self.publisher, job, solved.bounds)
        then.append(new_job("tones", None, None, {}))
        then.append(new_job("export", None, None, {"formats": list(PRODUCTS), "after": "refine"}))
        return all_changes(*then)


def _nothing_came(job: Job) -> Change:
    job.detail["note"] = "nothing came late"
    return no_change
