"""Refinement of one vehicle's sortie: gather its frames, solve and draw in worker processes, publish at once."""

import logging
import threading
import time
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Final

from gcs_plugin.config import SORTIE
from gcs_plugin.daemon.jobs.job_queue import ReportProgress
from gcs_plugin.daemon.jobs.joint_refinement import together_jobs
from gcs_plugin.daemon.jobs.publisher import Publisher, detail_of, frames_of, others_near, refined_change
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.worker_tasks import FollowTask, SolveTask, SortieResult, follow, near, register_late, solve
from gcs_plugin.daemon.jobs.workspace_products import PRODUCTS
from gcs_plugin.daemon.layers.layers import new_name
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.store.daemon_events import Events, JobsStop, LayerNeeded, RefinementBegins
from gcs_plugin.daemon.store.frame_rows import last_arrivals, late_frames, newest_seq
from gcs_plugin.daemon.store.job_rows import Job, new_job
from gcs_plugin.daemon.store.journal import Change, Journal, all_changes, no_change
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


@dataclass(slots=True, kw_only=True)
class SortieRefinement:
    """Does the jobs `refine`.

    Attributes:
        journal, store, kept, publisher: of the workspace. workers: compute the job. drawer: of the real-time layer.
        basemap: the map, or None. events: told before the work starts, and before a layer is needed.
        device: where networks run. stopping: set once the daemon stops.
    """

    journal: Journal
    store: PictureStore
    kept: KeptPictures
    publisher: Publisher
    workers: WorkerPool
    drawer: Drawer
    basemap: Path | None
    events: Events
    device: str = "auto"
    stopping: threading.Event = field(default_factory=threading.Event)

    def stop(self, _: JobsStop) -> None:
        """Wait for nothing any more, as the daemon stops."""
        self.stopping.set()

    def refine(self, job: Job, report: ReportProgress) -> Change:
        """The handler of `refine`."""
        vehicle = str(job.vehicle)
        began = time.monotonic()
        report(0.02, "waiting for the last pictures")
        self.events.publish(RefinementBegins(vehicle))
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
        self.kept.drop(job.whose)
        return no_change

    def _follow(self, job: Job) -> None:
        """Track the pictures that have come, while the last ones come and are drawn; if a process is free.

        If others come nevertheless, or one turns out to be unreadable, all are tracked again with the solution.
        """
        try:
            area = self.publisher.area()
            frames, _ = frames_of(self.journal, self.store, job)
            kept = self.kept.of(job.whose, frames)
            task = FollowTask(frames=frames, epsg=area.epsg, origin=area.origin, kept=kept, device=self.device)
            used = None if task.kept is None else self.workers.run_if_free(follow, task)
        except OrthoSwarmError as error:  # the solution will fail, or not, for its own reason
            _log.debug("the tracks of %s: %s", job.vehicle, error)
        else:
            if used is not None:
                job.detail["follow_cpu_s"] = round(used, 3)

    def _solve(self, job: Job, report: ReportProgress, target: Path) -> tuple[PlacedSortie | None, int, SortieResult]:
        """Solve the pictures that have arrived into a new solution file, in the reserved process.

        Returns:
            The solution to which late pictures were registered (None: all were refined), the number of
            pictures, and their result.
        """
        job.detail["refine_started_s"] = time.time()
        job.detail["newest_seq"] = newest_seq(self.journal)  # pictures that arrive later are late
        area = self.publisher.area()
        frames, thumbnails = frames_of(self.journal, self.store, job)
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
            neighbours=[
                self.publisher.solutions / row.path
                for row in others_near(self.journal, job.whose, near(frames, area.epsg), _REACH_M)
            ],
            target=target,
            before=None if before is None else self.publisher.solutions / before.path,
            kept=self.kept.of(job.whose, frames),
            device=self.device,
        )
        return before, len(frames), self.workers.run(solve if before is None else register_late, task)

    def _show(
        self, job: Job, report: ReportProgress, target: Path, solved: SortieResult, before: PlacedSortie | None
    ) -> None:
        """Draw and publish what was solved."""
        layer = "fine" if self.basemap is not None else "coarse"
        job.detail["layer"] = layer
        self.events.publish(LayerNeeded(layer))
        with self.publisher.turn(layer):
            report(0.7, "drawing")
            old = placed_sortie(self.journal, "solutions", job.whose)
            shown = self.publisher.shown(layer, job.whose)
            changed = solved.changed
            if before is None and shown is not None:  # its old ground changes, too
                changed = BoundingBox.around([changed, shown.bounds])
            job.detail["version_before"], job.detail["version"] = self.publisher.publish(
                layer,
                self.workers,
                job.whose,
                target=target,
                changed=changed,
                change=lambda rejected: self._publish(
                    job, layer, target, solved=solved, rejected=rejected, before=before
                ),
            )
        job.detail["published_s"] = time.time()
        if old is not None:  # the journal names it no more
            self.publisher.retire(self.publisher.solutions / old.path)
        self.publisher.tell(layer, job)

    # -- the parts ------------------------------------------------------------------------------------------------

    def wait_drawn(self, job: Job) -> None:
        """Wait a few seconds until the sortie's pictures are drawn, and longer for the first, which begins the map."""
        vehicle, end = str(job.vehicle), time.monotonic() + _BEGUN_S
        drawn = self.drawer.wait_drawn(vehicle, job.sortie, _DRAWN_S)
        while not drawn and self.drawer.area is None and time.monotonic() < end and not self.stopping.is_set():
            drawn = self.drawer.wait_drawn(vehicle, job.sortie, _QUIET_S)

    def _wait_quiet(self, job: Job) -> None:
        """Wait for pictures that were under way when the vehicle completed; they belong to its sortie.

        They are considered complete when none has arrived for longer than the usual interval.
        """
        end = time.monotonic() + _LATE_S
        while time.monotonic() < end and not self.stopping.is_set():
            came = last_arrivals(self.journal, str(job.vehicle), job.sortie, _LOOKED_AT)
            apart = max((a - b for a, b in pairwise(came)), default=0.0)
            if came and time.time() - came[0] > min(max(_QUIET_S, apart), _MOST_QUIET_S):
                return
            time.sleep(0.05)

    def _refined_before(self, job: Job, count: int) -> PlacedSortie | None:
        """The refinement to which late pictures are registered; None if all are to be refined."""
        if job.detail.get("trigger") != "late":
            return None
        row = placed_sortie(self.journal, "solutions", job.whose)
        refined = None if row is None else row.detail.get("refined")
        return row if refined is not None and count - refined < SORTIE.again_pictures else None

    def _publish(
        self, job: Job, layer: str, target: Path, *, solved: SortieResult, rejected: dict[str, str],
        before: PlacedSortie | None,
    ) -> Change:  # fmt: skip
        detail = detail_of(solved, solved.legs)
        if before is None:
            detail |= {"layer": layer, "refined": len(solved.stages) - len(rejected)}
        else:
            detail = before.detail | {"bounds": solved.bounds}
        then: list[Change] = [refined_change(job, solved, rejected, target.name, detail)]
        if self.basemap is not None:  # the coarse layer shows all of the sortie, too
            then.append(new_job("coarse", *job.whose, {"after": "refine"}))
            if before is None:
                then += together_jobs(self.journal, job, solved.bounds)
        then.append(new_job("tones", None, None, {}))
        then.append(new_job("export", None, None, {"formats": list(PRODUCTS), "after": "refine"}))
        return all_changes(*then)


def _nothing_came(job: Job) -> Change:
    job.detail["note"] = "nothing came late"
    return no_change
