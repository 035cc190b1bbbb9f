"""Refined neighbours together: those that overlap are solved again with each other, and the tones of all are balanced.

A vehicle is refined when it completes, with the neighbours refined so far held fixed; the first one has none. Once a
neighbour has been refined, all sorties that overlap it are refined again together with it (the second pass of the
batch, `orthoswarm.refine.strategy`): on a common height level, with ties between their pictures, so that sorties that
could not be registered onto the map are registered to their neighbours.

When a sortie is refined, its tones follow those drawn before, which stay. Where two that hardly overlap were drawn
first, each has a tone of its own, and one that comes between them would have to change from the one to the other. So
the tones of all are solved together, and sorties whose tones change visibly are drawn again.

These jobs have low priority: they start when no refinement waits, and give way to any that begins.
"""

import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gcs_plugin.daemon.jobs.job_queue import RunningJob
from gcs_plugin.daemon.jobs.publisher import Publisher, detail_of, refined_change
from gcs_plugin.daemon.jobs.solution_file import Bytes, Gain, SolutionFile, read_solution, uniquely_named
from gcs_plugin.daemon.jobs.worker_tasks import refine_jointly
from gcs_plugin.daemon.store import sortie_rows
from gcs_plugin.daemon.store.job_rows import Job, new_job
from gcs_plugin.daemon.store.journal import Change, no_change
from gcs_plugin.daemon.store.sortie_rows import PlacedSortie
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.mosaic.extent import ground_of_nearest
from orthoswarm.mosaic.radiometry import estimate_fields

_GROUND_STEP_M = 10.0
_MOST_NODES = 250_000  # of the ground's height

_REDRAW_TONE: Final = 0.015
"""Log factors of a flight's pictures, 95 %: if balancing all flights together changes them by more, it is drawn again
(1.5 grey levels of 100, less than is seen as a step)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ToneTask:
    """The sorties of a layer, to be balanced together."""

    solutions: list[Path]
    targets: list[Path]


def balance_tones(task: ToneTask) -> tuple[list[float], int, float]:
    """Write new solution files of the sorties whose tones change visibly.

    Returns:
        For each sortie, by how much its pictures' log factors change (95 %); a new file is written if by more than
        `_REDRAW_TONE`. The number of pictures; CPU seconds used.
    """
    began = time.process_time()
    sorties = [read_solution(path) for path in task.solutions]
    frames: list[PlacedFrame] = []
    small: dict[str, Bytes] = {}
    names: list[dict[str, str]] = []
    for sortie in sorties:
        mine: dict[str, str] = {}
        for placed in sortie.solution.placed:
            frame = uniquely_named(placed, len(frames), own=True)
            frames.append(frame)
            mine[placed.frame.image] = frame.frame.image
            if placed.frame.image in sortie.thumbnails:
                small[frame.frame.image] = sortie.thumbnails[placed.frame.image]
        names.append(mine)
    found = estimate_fields(frames, small, _common_ground(sorties))
    balanced = [
        {image: found[name] for image, name in mine.items() if name in found and image in sortie.gains}
        for sortie, mine in zip(sorties, names, strict=True)
    ]
    changes = [_changes(sortie.gains, gains) for sortie, gains in zip(sorties, balanced, strict=True)]
    common = np.median(np.concatenate(changes), axis=0)  # the map as a whole stays as bright as it was drawn
    greatest = [float(np.percentile(np.abs(each - common), 95)) if len(each) else 0.0 for each in changes]
    for sortie, gains, change, target in zip(sorties, balanced, greatest, task.targets, strict=True):
        if change > _REDRAW_TONE:
            factor = np.exp(-common).astype(np.float32)[:, None]
            replace(sortie, gains={**sortie.gains, **{k: v * factor for k, v in gains.items()}}).write(target)
    return greatest, len(frames), round(time.process_time() - began, 3)


def _changes(before: dict[str, Gain], now: dict[str, Gain]) -> NDArray[np.float64]:
    """Changes of the log factors (N, 3) in the middles of N pictures."""
    factors = [np.array([gains[image][:, 0] for image in now], float).reshape(-1, 3) for gains in (before, now)]
    return np.asarray(np.log(factors[1] / np.maximum(factors[0], 1e-3)))


def _common_ground(sorties: list[SolutionFile]) -> Terrain:
    """One terrain under all sorties: at each node the height that the sortie of the nearest picture has there."""
    paths = [np.array([p.camera.position for p in s.solution.placed]).reshape(-1, 3) for s in sorties]
    reach = float(np.concatenate(paths)[:, 2].max())
    own = [path[:, :2] for path in paths]
    return ground_of_nearest([s.terrain for s in sorties], own, reach, step_m=_GROUND_STEP_M, most_nodes=_MOST_NODES)


@dataclass(slots=True)
class ToneBalance:
    """Does the jobs `tones`."""

    publisher: Publisher

    def balance(self, run: RunningJob) -> Change:
        """The handler of `tones`."""
        began = time.monotonic()
        self._balance(run)
        run.job.detail["seconds"] = round(time.monotonic() - began, 3)
        return no_change

    def _balance(self, run: RunningJob) -> None:
        publisher, detail = self.publisher, run.job.detail
        refined = sortie_rows.solution_paths(publisher.journal, "solutions")
        shown = [row for row in sortie_rows.shown_sorties(publisher.journal, publisher.refined) if row.whose in refined]
        if len({row.vehicle for row in shown}) < 2:
            detail["note"] = "there is one vehicle only"
            return
        run.report(0.05, f"balancing the tones of {len(shown)} flights")
        with ExitStack() as stack:
            targets = [stack.enter_context(publisher.new_solution()) for _ in shown]
            task = ToneTask(solutions=[publisher.solutions / row.path for row in shown], targets=targets)
            changes, pictures, cpu_s = run.run(balance_tones, task)
            detail |= {"frames": pictures, "tones_changed": round(max(changes), 4), "solve_cpu_s": cpu_s, "drawn": 0}
            todo = [(row, target) for row, target in zip(shown, targets, strict=True) if target.exists()]
            for n, (row, target) in enumerate(todo):
                run.report(0.2 + 0.8 * n / len(todo), f"drawing {row.vehicle}")
                if self._draw(run, row, target):
                    detail["drawn"] += 1
                    publisher.tell(publisher.refined, run.job)

    def _draw(self, run: RunningJob, before: PlacedSortie, target: Path) -> bool:
        """Draw and publish a sortie; False if it was refined again meanwhile."""
        publisher = self.publisher
        with publisher.turn(publisher.refined) as turn:
            now = publisher.shown(publisher.refined, before.whose)
            if now is None or now.path != before.path:
                return False
            turn.draw(run, before.whose, target, before.bounds)
            turn.publish(sortie_rows.solution_replaced(before.whose, target.name))
        publisher.retire(before)
        return True


def together_jobs(publisher: Publisher, job: Job, box: BoundingBox) -> list[Change]:
    """The changes that queue joint refinements after a sortie was refined: of its neighbours, then of itself."""
    others = publisher.refined_near(job.whose, box)
    again = [*others, job.whose] if others else []
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
        row = sortie_rows.placed_sortie(publisher.journal, "solutions", job.whose)
        if row is None or publisher.basemap is None or row.detail["layer"] != "fine":
            return "it was not refined on the map"
        others = list(publisher.refined_near(job.whose, row.bounds).values())
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
            now = sortie_rows.placed_sortie(publisher.journal, "solutions", job.whose)
            if now is None or now.path != row.path:
                return "it was refined again meanwhile"
            run.report(0.7, "drawing")
            rejected = turn.draw(run, job.whose, target, solved.changed)
            detail = row.detail | detail_of(solved, solved.legs)
            job.detail |= turn.publish(refined_change(job, solved, rejected, target.name, detail))
        publisher.retire(row)
        publisher.tell("fine", job)
        return ""
