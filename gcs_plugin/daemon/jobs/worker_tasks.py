"""Tasks of the daemon's worker processes: placing a vehicle's pictures, and drawing the next generation of a layer.

Large results are passed as files: a solution is pickled next to the journal, a generation is a folder of tiles.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from gcs_plugin.daemon.jobs.solution_file import (
    OWN,
    Bytes,
    SolutionFile,
    gains_of,
    may_see,
    read_solution,
    uniquely_named,
    visible_ground,
)
from gcs_plugin.daemon.layers.layers import drawn_bounds, successor
from gcs_plugin.daemon.store.sortie_rows import LegRow
from orthoswarm.batch.refiners import make_refiner
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.compute.threads import on_threads
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import GroundGrid, LocalGrid
from orthoswarm.model.placement import Leg, PlacedFrame, Solution
from orthoswarm.mosaic.extent import ground_level
from orthoswarm.mosaic.key_pictures import key_pictures
from orthoswarm.mosaic.oblique import stray_warning, strays
from orthoswarm.mosaic.renderer import render
from orthoswarm.raster.basemap import Basemap
from orthoswarm.raster.grey_pictures import GreyPictures

if TYPE_CHECKING:
    from orthoswarm.refine.strategy.swarm_refiner import RefinerOptions, SwarmRefiner


@dataclass(frozen=True, slots=True, kw_only=True)
class SortieTask:
    """A sortie, or the part of it that has arrived, and what is needed to track, place, or place its pictures again.

    Attributes:
        epsg, origin: the area's grid. target: path of the new solution file.
        frames: of one sortie, in order of time. thumbnails: image -> uint8 (12, 16, 3).
        before: the solution file of the sortie's earlier legs (in flight) or of its refinement.
        neighbours: solution files nearby, held fixed. basemap: the map, or None. device: where networks run.
        kept: folder with what is kept of its pictures until it is refined, None if nothing is.
    """

    epsg: int
    origin: tuple[float, float]
    target: Path
    frames: list[Frame] = field(default_factory=list)
    thumbnails: dict[str, Bytes] = field(default_factory=dict)
    before: Path | None = None
    neighbours: list[Path] = field(default_factory=list)
    basemap: Path | None = None
    device: str = "auto"
    kept: Path | None = None

    def read_before(self) -> SolutionFile:
        """The solution in `before`, of a task that has one."""
        assert self.before is not None
        return read_solution(self.before)

    def read_neighbours(self) -> list[SolutionFile]:
        """The solutions nearby."""
        return [read_solution(path) for path in self.neighbours]

    def open_basemap(self, frames: Sequence[Frame]) -> Basemap | None:
        """The map below pictures."""
        return None if self.basemap is None else Basemap.open(self.basemap, self.epsg, near(frames, self.epsg))


@dataclass(frozen=True, slots=True, kw_only=True)
class SortieResult:
    """The result of a task.

    Attributes:
        stages: image -> stage and sigma in metres, of new placements. dropped: image -> why.
        legs: as JSON values with `line`, their ends in degrees. fov_deg: with its sigma. warnings: in plain words.
        bounds: of all its frames' ground. changed: of the ground that has to be drawn again.
        cpu_s: CPU seconds used; wall_s: duration.
    """

    stages: dict[str, tuple[str, float]]
    dropped: dict[str, str]
    legs: list[LegRow]
    fov_deg: float
    fov_sigma_deg: float
    warnings: list[str]
    bounds: BoundingBox
    changed: BoundingBox
    cpu_s: float
    wall_s: float


class _Watch:
    def __init__(self) -> None:
        self._wall, self._cpu = time.monotonic(), time.process_time()

    def solved(
        self, solution: Solution, frames: Sequence[Frame], sortie: SolutionFile, changed: BoundingBox
    ) -> SortieResult:
        return SortieResult(
            stages={p.frame.image: (p.stage, p.sigma_m) for p in solution.placed},
            dropped=dict(solution.dropped),
            legs=_legs(solution.legs, frames),
            fov_deg=solution.fov_deg,
            fov_sigma_deg=solution.fov_sigma_deg,
            warnings=list(solution.warnings),
            bounds=visible_ground(sortie.solution.placed, sortie.terrain),
            changed=changed,
            cpu_s=time.process_time() - self._cpu,
            wall_s=time.monotonic() - self._wall,
        )


def solve(task: SortieTask) -> SortieResult:
    """Refine one vehicle; raises OrthoSwarmError: its frames cannot be refined."""
    watch = _Watch()
    others, basemap = task.read_neighbours(), task.open_basemap(task.frames)
    solution = without_strays(_refiner(task).refine(task.frames, [other.solution for other in others], basemap))
    sortie = SolutionFile(solution, task.thumbnails, gains_of(solution, task.thumbnails, others))
    sortie.write(task.target)
    return watch.solved(solution, task.frames, sortie, visible_ground(solution.placed, sortie.terrain))


def follow(task: SortieTask) -> float:
    """Track the pictures of a sortie for `solve`, while it is not certain yet that no more will come.

    Returns the CPU seconds used.
    """
    began = time.process_time()
    _refiner(task).follow(task.frames)
    return time.process_time() - began


def _refiner(task: SortieTask) -> "SwarmRefiner":
    from orthoswarm.refine.strategy.swarm_refiner import SwarmRefiner

    return SwarmRefiner(task.epsg, np.array(task.origin), _options(task))


def _options(task: SortieTask) -> "RefinerOptions":
    """Options that use what is kept of the sortie's pictures, and keep what is made."""
    from orthoswarm.refine.flight.kept_tracks import KeptTracks
    from orthoswarm.refine.strategy.swarm_refiner import RefinerOptions

    options = RefinerOptions(device=task.device)
    if task.kept is None:
        return options
    return replace(options, read=GreyPictures(task.kept).gray, kept=KeptTracks(task.kept))


def register_late(task: SortieTask) -> SortieResult:
    """Register late pictures to the others of their sortie, which was refined without them."""
    from orthoswarm.refine.registration.late_pictures import register_late_pictures
    from orthoswarm.refine.strategy.vehicle_passes import read_frame

    watch, before = _Watch(), task.read_before()
    refined = before.solution
    known = {p.frame.image for p in refined.placed} | set(refined.dropped)
    placed, dropped = register_late_pictures(
        [f for f in task.frames if f.image not in known], refined, task.epsg, read_frame
    )
    complete = replace(refined, placed=[*refined.placed, *placed], dropped={**refined.dropped, **dropped})
    thumbnails = before.thumbnails | task.thumbnails
    gains = gains_of(complete, thumbnails, task.read_neighbours(), before.gains)
    sortie = SolutionFile(complete, thumbnails, gains)
    sortie.write(task.target)
    new = replace(complete, placed=placed, dropped=dropped, legs=[])
    return watch.solved(new, [], sortie, visible_ground(placed, sortie.terrain))


def without_strays(solution: Solution) -> Solution:
    """The solution without strongly oblique pictures among nadir ones, which would smear."""
    out = strays(solution.placed)
    if not out:
        return solution
    return replace(
        solution,
        placed=[p for p in solution.placed if p.frame.image not in out],
        dropped={**solution.dropped, **out},
        warnings=[*solution.warnings, *stray_warning(out)],
    )


def refine_jointly(task: SortieTask) -> tuple[SortieResult, float] | None:
    """Refine a sortie again.

    Returns the result and its pictures' movement (metres, 95 %), None if nothing is to be solved.

    Its exposure stays as it is: its neighbours were drawn to agree with it.
    """
    watch, before = _Watch(), task.read_before()
    refiner = make_refiner("swarm", task.epsg, np.array(task.origin))
    frames = refiner.refined_frames(before.solution)
    if not frames:
        return None
    basemap = task.open_basemap(frames)
    assert basemap is not None  # without a map nothing is refined again
    solution = refiner.again(before.solution, [other.solution for other in task.read_neighbours()], basemap)
    if solution is before.solution:
        return None
    sortie = replace(before, solution=solution)
    sortie.write(task.target)
    changed = BoundingBox.around([visible_ground(p.solution.placed, p.terrain) for p in (before, sortie)])
    return watch.solved(solution, frames, sortie, changed), _moved_m(before.solution, solution)


def _moved_m(before: Solution, now: Solution) -> float:
    """How far the ground under pictures moved, 95 % of their middles and corners."""
    was = {p.frame.image: p.camera for p in before.placed}
    moved = [
        np.hypot(*(_ground_of(p.camera, now.ground_z_m) - _ground_of(was[p.frame.image], before.ground_z_m)).T)
        for p in now.placed
        if p.frame.image in was and not p.weak
    ]
    found = np.concatenate(moved) if moved else np.zeros(1)
    return float(np.nanpercentile(found, 95))


def _ground_of(camera: Camera, z_m: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """East and north (5, 2) of a picture's middle and corners on a level plane."""
    return np.vstack([camera.to_ground(np.array(camera.lens.principal_point), z_m), camera.corners(z_m)])


def place(task: SortieTask) -> SortieResult:
    """Place the pictures of a vehicle's finished legs, registered to its earlier legs if those were placed.

    Raises:
        OrthoSwarmError: the pictures cannot be adjusted (yet).
    """
    from orthoswarm.refine.strategy.in_flight import place_in_flight

    watch = _Watch()
    options = replace(_options(task), kept=None)  # the next leg's tracks will be others
    solution = place_in_flight(task.frames, epsg=task.epsg, origin=np.array(task.origin), options=options)
    mine = {frame.image for frame in task.frames}
    before = SolutionFile(replace(solution, placed=[])) if task.before is None else task.read_before()
    earlier = [p for p in before.solution.placed if p.frame.image not in mine]
    moved = [p for p in before.solution.placed if p.frame.image in mine]
    complete = replace(solution, placed=[*earlier, *solution.placed])
    stays = {p.frame.image: before.gains[p.frame.image] for p in earlier if p.frame.image in before.gains}
    thumbnails = before.thumbnails | task.thumbnails
    gains = gains_of(complete, thumbnails, task.read_neighbours(), stays)
    sortie = SolutionFile(complete, thumbnails, gains)
    sortie.write(task.target)
    changed = visible_ground([*solution.placed, *moved], sortie.terrain)
    return watch.solved(solution, task.frames, sortie, changed)


def look_for(task: SortieTask) -> float:
    """Refine a vehicle's first pictures on the basemap, with the state that goes on from there; CPU seconds used.

    Raises:
        OrthoSwarmError: they are not found there.
    """
    from orthoswarm.refine.flight.vehicle_refinement import split_units
    from orthoswarm.refine.registration.block_state import WorkArea, to_solution
    from orthoswarm.refine.strategy.vehicle_passes import refine_alone

    began, origin = time.process_time(), np.array(task.origin)
    newest = max(split_units({"": task.frames}), key=lambda unit: unit[-1].time_s or 0.0)
    area = WorkArea(task.epsg, origin, task.open_basemap(task.frames), task.device)
    state = refine_alone(newest, area=area, options=replace(_options(task), kept=None))
    if not state.on_map:
        raise OrthoSwarmError(f"{len(newest)} pictures were not found on the basemap")
    SolutionFile(to_solution(state, origin, None)).write(task.target)
    return time.process_time() - began


def coarse_after(task: SortieTask) -> SortieResult:
    """The coarse placement that the refined sortie in `before` began from, for the coarse layer.

    Raises:
        OrthoSwarmError: the refined one does not contain it any more.
    """
    from orthoswarm.refine.strategy.in_flight import coarse_of

    watch, fine = _Watch(), task.read_before()
    solution = coarse_of(fine.solution, np.array(task.origin))
    there = {p.frame.image for p in solution.placed}
    solution.placed.extend(p for p in fine.solution.placed if p.frame.image not in there)  # registered to the others
    sortie = replace(fine, solution=solution)
    sortie.write(task.target)
    return watch.solved(replace(solution, legs=[]), [], sortie, visible_ground(solution.placed, sortie.terrain))


def near(frames: Sequence[Frame], epsg: int) -> BoundingBox:
    """Recorded positions of pictures."""
    ground = LocalGrid(epsg).to_grid([f.fix.lat_deg for f in frames], [f.fix.lon_deg for f in frames])
    return BoundingBox.around_points(ground)


def _legs(legs: Sequence[Leg], frames: Sequence[Frame]) -> list[LegRow]:
    """Legs as JSON values, each with the recorded positions of its ends as `line`."""
    at = {frame.image: [frame.fix.lon_deg, frame.fix.lat_deg] for frame in frames}
    lines = [[at[image] for image in dict.fromkeys(leg.images) if image in at] for leg in legs]
    return [
        cast(LegRow, asdict(leg) | ({"line": line} if len(line) == 2 else {}))
        for leg, line in zip(legs, lines, strict=True)
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawTask:
    """The next generation of a refined layer.

    Attributes:
        old: folder of the present generation, None for the first. new: folder of the next.
        grid: where the layer lies.
        solutions: solution files near the changed ground, in the order that breaks ties.
        changed: the one whose ground is drawn again. bounds: that ground.
    """

    old: Path | None
    new: Path
    grid: GroundGrid
    solutions: list[Path]
    changed: Path
    bounds: BoundingBox


def draw(task: DrawTask) -> dict[str, str]:
    """Draw a sortie and those that overlap it into a new generation; returns image -> why it could not be drawn.

    Raises:
        OrthoSwarmError: the disk is full.
    """
    placed: list[PlacedFrame] = []
    gains: dict[str, Any] = {}
    terrain = read_solution(task.changed).terrain
    for path in task.solutions:
        sortie = read_solution(path)
        shown = sortie.solution.placed
        for p in key_pictures(shown, ground_level(shown, sortie.terrain)):
            if may_see(p, task.bounds):
                frame = uniquely_named(p, len(placed), own=path == task.changed)
                placed.append(frame)
                if p.frame.image in sortie.gains:
                    gains[frame.frame.image] = sortie.gains[p.frame.image]
    old = None if task.old is None else Canvas.open(task.old, writable=False)
    canvas = successor(old, task.new, task.grid, "frame", share=True)
    try:
        stats = render(placed, terrain, canvas, gains=gains, bounds=task.bounds, run=on_threads)
        canvas.flush()
        assert drawn_bounds(canvas) is not None or not stats.pixels.any()
    finally:
        canvas.close()
        if old is not None:
            old.close()
    named = ([*key.split(" ", 2), why] for key, why in stats.rejected.items())
    return {image: why for _, whose, image, why in named if whose == OWN}
