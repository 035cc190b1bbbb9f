"""Joint refinement of overlapping neighbours: a sortie refined first does not use those that completed after it.

A vehicle is refined when it completes, with the neighbours refined so far held fixed; the first one has none. Once a
neighbour has been refined, all sorties that overlap it are refined again together with it (the second pass of the
batch, `orthoswarm.refine.strategy`): on a common height level, with ties between their pictures, so that sorties that
could not be registered onto the map are registered to their neighbours. The job has low priority: it starts when no
refinement waits, and gives way to any that arrives.
"""

import time
from dataclasses import dataclass
from pathlib import Path

from gcs_plugin.daemon.jobs.job_queue import RunningJob
from gcs_plugin.daemon.jobs.publisher import Publisher, detail_of, others_near, refined_change
from gcs_plugin.daemon.jobs.worker_tasks import refine_jointly
from gcs_plugin.daemon.store.job_rows import Job, new_job
from gcs_plugin.daemon.store.journal import Change, Journal, no_change
from gcs_plugin.daemon.store.sortie_rows import placed_sortie
from orthoswarm.model.bounding_box import BoundingBox


def together_jobs(journal: Journal, job: Job, box: BoundingBox) -> list[Change]:
    """The changes that queue joint refinements after a sortie was refined: of its neighbours, then of itself."""
    others = others_near(journal, job.whose, box, 0.0)
    again = [*(row.whose for row in others), *([job.whose] if others else [])]
    return [new_job("together", vehicle, sortie, {}) for vehicle, sortie in again]


@dataclass(slots=True)
class JointRefinement:
    """Does the jobs `together`; `least_px`: pictures that move less, in pixels of the layer, are not drawn again."""

    publisher: Publisher
    least_px: float

    def solve(self, run: RunningJob) -> Change:
        """The handler of `together`."""
        began = time.monotonic()
        with self.publisher.new_solution() as target:
            note = self._solve(run, target)
        run.job.detail |= {"note": note} if note else {}
        run.job.detail["seconds"] = round(time.monotonic() - began, 3)
        return no_change

    def _solve(self, run: RunningJob, target: Path) -> str:
        """Solve and publish; returns why nothing changes, empty if something does."""
        job, publisher = run.job, self.publisher
        row = placed_sortie(publisher.journal, "solutions", job.whose)
        if row is None or publisher.basemap is None or row.detail["layer"] != "fine":
            return "it was not refined on the map"
        near = others_near(publisher.journal, job.whose, row.bounds, 0.0)
        others = [publisher.solutions / other.path for other in near]
        if not others:
            return "it has no neighbours"
        run.report(0.05, f"refining again together with {len(others)} neighbour{'s' * (len(others) > 1)}")
        found = run.run(
            refine_jointly, publisher.task(target, before=publisher.solutions / row.path, neighbours=others)
        )
        if found is None:
            return "nothing of it needs refining again"
        solved, moved_m = found
        job.detail |= {
            "frames": len(solved.stages), "neighbours": len(others), "moved_p95_m": round(moved_m, 3),
            "solve_cpu_s": round(solved.cpu_s, 3), "warnings": solved.warnings,
        }  # fmt: skip
        if moved_m < self.least_px * publisher.area().gsd_m:
            return "it agrees with its neighbours already"
        with publisher.turn("fine") as turn:
            now = placed_sortie(publisher.journal, "solutions", job.whose)
            if now is None or now.path != row.path:
                return "it was refined again meanwhile"
            run.report(0.7, "drawing")
            rejected = turn.draw(run, job.whose, target, solved.changed)
            detail = row.detail | detail_of(solved, solved.legs)
            job.detail |= turn.publish(refined_change(job, solved, rejected, target.name, detail))
        publisher.retire(row)
        publisher.tell("fine", job)
        return ""
