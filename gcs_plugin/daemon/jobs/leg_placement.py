"""The coarse layer: legs are placed and drawn as they finish, in flight, at the lowest priority.

A job places all finished legs of the vehicle, so jobs that arrive faster than they can be done are merged into
one. Its result is temporary: the work stops at once when the vehicle completes (its refinement
replaces it) or when a refinement needs the layer.
"""

import json
import logging
import sqlite3
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from gcs_plugin.daemon.jobs.job_queue import Job, Preempted, ReportProgress
from gcs_plugin.daemon.jobs.placed_sorties import detail_of, sortie_frames
from gcs_plugin.daemon.jobs.preemption import Preemption
from gcs_plugin.daemon.jobs.publisher import Publisher
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.worker_tasks import SolveTask, SortieResult, coarse_after, follow, near, place
from gcs_plugin.daemon.layers.layers import new_name
from gcs_plugin.daemon.store.journal import Change, Journal, packed
from gcs_plugin.daemon.store.kept_pictures import KeptPictures
from gcs_plugin.daemon.store.picture_store import PictureStore
from orthoswarm.export.product_files import finite
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
        basemap: the map, or None. on_published: called with layer and job when pixels have changed.
    """

    journal: Journal
    store: PictureStore
    kept: KeptPictures
    publisher: Publisher
    workers: WorkerPool
    basemap: Path | None
    on_published: Callable[[str, Job], None] = lambda layer, job: None
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
            return lambda db: None
        job.detail["seconds"] = round(time.monotonic() - began, 3)
        return change

    def give_up(self, vehicle: str | None, layer: str | None = None) -> None:
        """Stop a vehicle's running job (None: any), or the one that uses a layer."""
        if vehicle in (None, self._preemption.vehicle) and (layer is None or layer in self.publisher.drawing):
            self._preemption.stop()

    # -- in flight ------------------------------------------------------------------------------------------------

    def _legs(self, job: Job, report: ReportProgress, target: Path) -> Change:
        vehicle, area = str(job.vehicle), self.publisher.area()
        if self._is_refined(job):
            job.detail["note"] = "it is refined already"
            return lambda db: None
        frames, thumbnails = sortie_frames(self.journal, self.store, vehicle, job.sortie)
        everything, kept = frames, self.kept.of(vehicle, job.sortie, frames)
        frames, count = newest_legs(frames, area.epsg, over=bool(job.detail.get("over")))
        if not frames:
            raise OrthoSwarmError("no leg is over yet")
        report(0.1, f"{len(frames)} pictures, {count} legs")
        before = self._row(job)
        small = {f.image: thumbnails[f.image] for f in frames if f.image in thumbnails}
        task = SolveTask(
            frames=frames,
            epsg=area.epsg,
            origin=area.origin,
            basemap=self.basemap,
            thumbnails=small,
            neighbours=self._others(job, frames),
            target=target,
            before=None if before is None else self.publisher.solutions / before["path"],
            kept=kept,
        )
        solved = self.workers.run(place, task)
        job.detail |= {"frames": len(frames), "solve_cpu_s": round(solved.cpu_s, 3), "legs": len(solved.legs)}
        fresh = {leg["images"][0] for leg in solved.legs}
        mine = {frame.image for frame in frames}
        earlier = [] if before is None else json.loads(before["detail"])["legs"]
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
        mine = (packed(str(job.vehicle)), job.sortie)
        shown = self.publisher.shown("coarse").items()
        return [path for key, (path, bounds) in shown if key != mine and bounds.gap_m(box) < _REACH_M]

    def _is_refined(self, job: Job) -> bool:
        """Whether a refinement has replaced, or is about to replace, the result."""
        key = (packed(str(job.vehicle)), job.sortie)
        for query in (
            "SELECT 1 FROM completions WHERE vehicle = ? AND sortie = ?",
            "SELECT 1 FROM jobs WHERE vehicle = ? AND sortie = ? AND kind = 'refine'"
            " AND state IN ('queued', 'running')",
        ):
            if self.journal.one(query, key) is not None:
                return True
        row = self.journal.one("SELECT detail FROM solutions WHERE vehicle = ? AND sortie = ?", key)
        return row is not None and json.loads(row["detail"])["layer"] == "coarse"

    # -- after a refinement ---------------------------------------------------------------------------------------

    def _after(self, job: Job, report: ReportProgress, target: Path) -> Change:
        """Place the complete sortie on the coarse layer, from the start values of its refinement."""
        row = self.journal.one(
            "SELECT path, detail FROM solutions WHERE vehicle = ? AND sortie = ?",
            (packed(str(job.vehicle)), job.sortie),
        )
        if row is None or json.loads(row["detail"])["layer"] != "fine":
            return lambda db: None
        report(0.1, "the coarse layer beside the refined one")
        solved = self.workers.run(
            coarse_after, (self.publisher.solutions / row["path"], self.publisher.area().origin, target)
        )
        return self._publish(job, report, target, solved, json.loads(row["detail"])["legs"])

    # -- both -----------------------------------------------------------------------------------------------------

    def _row(self, job: Job) -> Any:
        return self.journal.one(
            "SELECT * FROM coarse WHERE vehicle = ? AND sortie = ?", (packed(str(job.vehicle)), job.sortie)
        )

    def _publish(
        self, job: Job, report: ReportProgress, target: Path, solved: SortieResult, legs: list[dict[str, Any]]
    ) -> Change:
        vehicle = packed(str(job.vehicle))
        old = self._row(job)
        changed = solved.changed
        if old is not None and "after" in job.detail:
            changed = BoundingBox.around([changed, BoundingBox(*json.loads(old["detail"])["bounds"])])
        detail = json.dumps(detail_of(solved, legs))

        def change(rejected: dict[str, str]) -> Change:
            placed = [
                (finite(sigma), vehicle, job.sortie, packed(image))
                for image, (_, sigma) in solved.stages.items()
                if image not in rejected
            ]

            def both(db: sqlite3.Connection) -> None:
                db.executemany(
                    "UPDATE frames SET stage = 'coarse', sigma = ? WHERE vehicle = ? AND sortie = ? AND image = ?"
                    " AND stage IN ('realtime', 'coarse') AND reason IS NULL",
                    placed,
                )
                db.execute(
                    "INSERT OR REPLACE INTO coarse VALUES (?, ?, ?, ?)", (vehicle, job.sortie, target.name, detail)
                )

            return both

        with self.publisher.turn("coarse"):
            report(0.7, "drawing")
            if self._preemption.requested or ("after" not in job.detail and self._is_refined(job)):
                raise OrthoSwarmError("a refinement takes its place")
            job.detail["version_before"], job.detail["version"] = self.publisher.publish(
                "coarse", self.workers, (str(job.vehicle), job.sortie), target=target, changed=changed, change=change
            )
        if old is not None:
            self.publisher.retire(self.publisher.solutions / old["path"])
        self.on_published("coarse", job)
        return lambda db: None


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
