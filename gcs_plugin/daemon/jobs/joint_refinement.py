"""Joint refinement of overlapping neighbours: a sortie refined first does not use those that completed after it.

A vehicle is refined when it completes, with the neighbours refined so far held fixed; the first one has none. Once a
neighbour has been refined, all sorties that overlap it are refined again together with it (the second pass of the
batch, `orthoswarm.refine.strategy`): on a common height level, with ties between their pictures, so that sorties that
could not be registered onto the map are registered to their neighbours. The job has low priority: it starts when no
refinement waits, and gives way to any that arrives.
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

from gcs_plugin.daemon.jobs.job_queue import ReportProgress
from gcs_plugin.daemon.jobs.preemption import Preemption
from gcs_plugin.daemon.jobs.publisher import Publisher, detail_of, others_near, refined_change
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.worker_tasks import JointTask, SortieResult, refine_jointly
from gcs_plugin.daemon.layers.layers import new_name
from gcs_plugin.daemon.store.job_rows import Job, new_job
from gcs_plugin.daemon.store.journal import Change, Journal, no_change
from gcs_plugin.daemon.store.sortie_rows import SortieDetail, placed_sortie
from orthoswarm.model.bounding_box import BoundingBox


def together_jobs(journal: Journal, job: Job, box: BoundingBox) -> list[Change]:
    """The changes that queue joint refinements after a sortie was refined: of its neighbours, then of itself."""
    others = others_near(journal, job.whose, box, 0.0)
    again = [*(row.whose for row in others), *([job.whose] if others else [])]
    return [new_job("together", vehicle, sortie, {}) for vehicle, sortie in again]


@dataclass(slots=True, kw_only=True)
class JointRefinement:
    """Does the jobs `together`.

    Attributes:
        journal, publisher: of the workspace. workers: compute the job; used by nothing else meanwhile.
        basemap: the map.
        least_px: pictures that move less, in pixels of the layer, are not drawn again.
    """

    journal: Journal
    publisher: Publisher
    workers: WorkerPool
    basemap: Path | None
    least_px: float
    _preemption: Preemption = field(init=False)

    def __post_init__(self) -> None:
        self._preemption = Preemption(self.workers)

    def solve(self, job: Job, report: ReportProgress) -> Change:
        """The handler of `together`."""
        target = self.publisher.solutions / f"{new_name('solution')}.pickle"
        began = time.monotonic()
        published = False
        try:
            with self._preemption.running():
                published = self._solve(job, report, target)
        finally:
            if not published:
                target.unlink(missing_ok=True)
        job.detail["seconds"] = round(time.monotonic() - began, 3)
        return no_change

    def give_way(self, _: object = None) -> None:
        """Stop the running job; it is done later."""
        self._preemption.stop()

    def _solve(self, job: Job, report: ReportProgress, target: Path) -> bool:
        """Solve and publish; False if nothing changes."""
        row = placed_sortie(self.journal, "solutions", job.whose)
        if row is None or self.basemap is None or row.detail["layer"] != "fine":
            return _note(job, "it was not refined on the map")
        near = others_near(self.journal, job.whose, row.bounds, 0.0)
        others = [self.publisher.solutions / other.path for other in near]
        if not others:
            return _note(job, "it has no neighbours")
        report(0.05, f"refining again together with {len(others)} neighbour{'s' * (len(others) > 1)}")
        area = self.publisher.area()
        task = JointTask(
            before=self.publisher.solutions / row.path,
            neighbours=others,
            target=target,
            epsg=area.epsg,
            origin=area.origin,
            basemap=self.basemap,
        )
        found = self.workers.run(refine_jointly, task)
        if found is None:
            return _note(job, "nothing of it needs refining again")
        solved, moved_m = found
        job.detail |= {
            "frames": len(solved.stages), "neighbours": len(others), "moved_p95_m": round(moved_m, 3),
            "solve_cpu_s": round(solved.cpu_s, 3), "warnings": solved.warnings,
        }  # fmt: skip
        if moved_m < self.least_px * area.gsd_m:
            return _note(job, "it agrees with its neighbours already")
        with self.publisher.turn("fine"):
            now = placed_sortie(self.journal, "solutions", job.whose)
            if now is None or now.path != row.path:
                return _note(job, "it was refined again meanwhile")
            report(0.7, "drawing")
            self._print(job, target, solved, row.detail)
        self.publisher.retire(self.publisher.solutions / row.path)
        self.publisher.tell("fine", job)
        return True

    def _print(self, job: Job, target: Path, solved: SortieResult, before: SortieDetail) -> None:
        def change(rejected: dict[str, str]) -> Change:
            return refined_change(job, solved, rejected, target.name, before | detail_of(solved, solved.legs))

        job.detail["version_before"], job.detail["version"] = self.publisher.publish(
            "fine", self.workers, job.whose, target=target, changed=solved.changed, change=change
        )


def _note(job: Job, text: str) -> bool:
    job.detail["note"] = text
    return False
