"""Refinement of one vehicle's sortie: gather its frames, solve and draw in worker processes, publish at once."""

import json
import logging
import sqlite3
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from gcs_plugin.config import SORTIE
from gcs_plugin.daemon.jobs.job_queue import Job, ReportProgress, new_job
from gcs_plugin.daemon.jobs.joint_refinement import together_jobs
from gcs_plugin.daemon.jobs.placed_sorties import detail_of, others_near, refined_change, solution_row, sortie_frames
from gcs_plugin.daemon.jobs.publisher import Publisher
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.worker_tasks import FollowTask, SolveTask, SortieResult, follow, near, register_late, solve
from gcs_plugin.daemon.jobs.workspace_products import PRODUCTS
from gcs_plugin.daemon.layers.layers import new_name
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.store.journal import Change, Journal, late_frames, newest_seq, packed
from gcs_plugin.daemon.store.kept_pictures import KeptPictures
from gcs_plugin.daemon.store.picture_store import PictureStore
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError

_REACH_M: Final = 400.0
_DRAWN_S: Final = 3.0
_BEGUN_S: Final = 60.0
"""How long the first picture may take to begin the map, on a machine that is busy or compiles the kernels."""
_QUIET_S: Final = 0.7
_MOST_QUIET_S: Final = 3.0
_LATE_S: Final = 15.0
_log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class SortieRefinement:
    """Does the jobs `refine`.

    Attributes:
        journal, store, kept, publisher: of the workspace. workers: compute the job. drawer: of the real-time layer.
        basemap: the map, or None. on_published: called with layer and job when pixels have changed.
        make_way: called with vehicle and layer before the work starts, and before the layer is needed.
    """

    journal: Journal
    store: PictureStore
    kept: KeptPictures
    publisher: Publisher
    workers: WorkerPool
    drawer: Drawer
    basemap: Path | None
    on_published: Callable[[str, Job], None] = lambda layer, job: None
    make_way: Callable[[str, str | None], None] = lambda vehicle, layer: None
    stopped: Callable[[], bool] = lambda: False

    def refine(self, job: Job, report: ReportProgress) -> Change:
        """The handler of `refine`."""
        vehicle = str(job.vehicle)
        began = time.monotonic()
        report(0.02, "waiting for the last pictures")
        self.make_way(vehicle, None)
        if job.detail.get("trigger") != "late":
            self._follow(job)
        if job.detail.get("trigger") == "complete":
            self._wait_quiet(job)
        self.wait_drawn(job)
        if job.detail.get("trigger") == "late" and not late_frames(self.journal, vehicle, job.sortie, job.id):
            return _nothing_came(job)
        report(0.03, "waiting for a free worker process")
        target = self.publisher.solutions / f"{new_name('solution')}.pickle"
        published = False
        try:
            with self.workers.reserved():
                before, frames, solved = self._solve(job, report, target)
            if before is not None:
                job.detail["beside"] = len(solved.stages)
                if not solved.stages and not solved.dropped:
                    return _nothing_came(job)
            job.detail |= {
                "frames": frames, "solve_cpu_s": round(solved.cpu_s, 3), "solve_s": round(solved.wall_s, 3),
                "warnings": solved.warnings,
            }  # fmt: skip
            self._show(job, report, target, solved, before)
            published = True
        finally:
            if not published:
                target.unlink(missing_ok=True)
        job.detail["seconds"] = round(time.monotonic() - began, 3)
        self.kept.drop(vehicle, job.sortie)
        return lambda db: None

    def _follow(self, job: Job) -> None:
        """Track the pictures that have come, while the last ones come and are drawn; if a process is free.

        If others come nevertheless, or one turns out to be unreadable, all are tracked again with the solution.
        """
        try:
            area = self.publisher.area()
            frames, _ = sortie_frames(self.journal, self.store, str(job.vehicle), job.sortie)
            kept = self.kept.of(str(job.vehicle), job.sortie, frames)
            task = FollowTask(frames=frames, epsg=area.epsg, origin=area.origin, kept=kept)
            used = None if task.kept is None else self.workers.run_if_free(follow, task)
        except OrthoSwarmError as error:  # the solution will fail, or not, for its own reason
            _log.debug("the tracks of %s: %s", job.vehicle, error)
        else:
            if used is not None:
                job.detail["follow_cpu_s"] = round(used, 3)

    def _solve(self, job: Job, report: ReportProgress, target: Path) -> tuple[Any, int, SortieResult]:
        """Solve the pictures that have arrived into a new solution file, in the reserved process.

        Returns:
            The row of the solution to which late pictures were registered (None: all were refined), the number of
            pictures, and their result.
        """
        job.detail["refine_started_s"] = time.time()
        job.detail["newest_seq"] = newest_seq(self.journal)  # pictures that arrive later are late
        area = self.publisher.area()
        frames, thumbnails = sortie_frames(self.journal, self.store, str(job.vehicle), job.sortie)
        before = self._refined_before(job, len(frames))
        report(
            0.05, f"refining {len(frames)} pictures" if before is None else "registering late pictures to the others"
        )
        task = SolveTask(
            frames=frames,
            epsg=area.epsg,
            origin=area.origin,
            basemap=self.basemap,
            thumbnails=thumbnails,
            neighbours=self._neighbours(job, near(frames, area.epsg)),
            target=target,
            before=None if before is None else self.publisher.solutions / before["path"],
            kept=self.kept.of(str(job.vehicle), job.sortie, frames),
        )
        return before, len(frames), self.workers.run(solve if before is None else register_late, task)

    def _show(self, job: Job, report: ReportProgress, target: Path, solved: SortieResult, before: Any) -> None:
        """Draw and publish what was solved."""
        vehicle, layer = str(job.vehicle), "fine" if self.basemap is not None else "coarse"
        job.detail["layer"] = layer
        self.make_way(vehicle, layer)
        with self.publisher.turn(layer):
            report(0.7, "drawing")
            old = solution_row(self.journal, job)
            shown = self.publisher.shown(layer).get((packed(vehicle), job.sortie or 0))
            changed = solved.changed
            if before is None and shown is not None:  # its old ground changes, too
                changed = BoundingBox.around([changed, shown[1]])
            job.detail["version_before"], job.detail["version"] = self.publisher.publish(
                layer,
                self.workers,
                (vehicle, job.sortie),
                target=target,
                changed=changed,
                change=lambda rejected: self._publish(
                    job, layer, target, solved=solved, rejected=rejected, before=before
                ),
            )
        job.detail["published_s"] = time.time()
        if old is not None:  # the journal names it no more
            self.publisher.retire(self.publisher.solutions / old["path"])
        self.on_published(layer, job)

    # -- the parts ------------------------------------------------------------------------------------------------

    def wait_drawn(self, job: Job) -> None:
        """Wait a few seconds until the sortie's pictures are drawn, and longer for the first, which begins the map."""
        vehicle, end = str(job.vehicle), time.monotonic() + _BEGUN_S
        drawn = self.drawer.wait_drawn(vehicle, job.sortie, _DRAWN_S)
        while not drawn and self.drawer.area is None and time.monotonic() < end and not self.stopped():
            drawn = self.drawer.wait_drawn(vehicle, job.sortie, _QUIET_S)

    def _wait_quiet(self, job: Job) -> None:
        """Wait for pictures that were under way when the vehicle completed; they belong to its sortie.

        They are considered complete when none has arrived for longer than the usual interval.
        """
        end = time.monotonic() + _LATE_S
        while time.monotonic() < end and not self.stopped():
            rows = self.journal.rows(
                "SELECT arrived FROM frames WHERE vehicle = ? AND sortie = ? ORDER BY seq DESC LIMIT 8",
                (packed(str(job.vehicle)), job.sortie),
            )
            came = [float(row["arrived"]) for row in rows]
            apart = max((a - b for a, b in pairwise(came)), default=0.0)
            if came and time.time() - came[0] > min(max(_QUIET_S, apart), _MOST_QUIET_S):
                return
            time.sleep(0.05)

    def _refined_before(self, job: Job, count: int) -> Any:
        """The refinement to which late pictures are registered; None if all are to be refined."""
        if job.detail.get("trigger") != "late":
            return None
        row = solution_row(self.journal, job)
        refined = None if row is None else json.loads(row["detail"]).get("refined")
        return row if refined is not None and count - refined < SORTIE.again_pictures else None

    def _neighbours(self, job: Job, box: BoundingBox) -> list[Path]:
        """Solutions of other vehicles nearby."""
        return [self.publisher.solutions / row["path"] for row in others_near(self.journal, job, box, _REACH_M)]

    def _publish(
        self, job: Job, layer: str, target: Path, *, solved: SortieResult, rejected: dict[str, str], before: Any
    ) -> Change:
        if before is None:
            count = len(solved.stages) - len(rejected)
            detail = detail_of(solved, solved.legs) | {"layer": layer, "refined": count}
        else:
            detail = json.loads(before["detail"]) | {"bounds": solved.bounds}
        stands = refined_change(job, solved, rejected, target.name, detail)
        then = []
        if self.basemap is not None:  # the coarse layer shows all of the sortie, too
            then.append(new_job("coarse", str(job.vehicle), job.sortie, {"after": "refine"}))
            if before is None:
                then += together_jobs(self.journal, job, solved.bounds)
        then.append(new_job("tones", None, None, {}))
        then.append(new_job("export", None, None, {"formats": list(PRODUCTS), "after": "refine"}))

        def change(db: sqlite3.Connection) -> None:
            stands(db)
            for queue in then:
                queue(db)

        return change


def _nothing_came(job: Job) -> Change:
    job.detail["note"] = "nothing came late"
    return lambda db: None
