"""A large swarm refined area by area, each with its halo, then moved onto each other and joined."""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.batch.run_state import RunContext
from orthoswarm.compute.workers import trim_memory
from orthoswarm.control.area_adjustment import AreaMove, AreaTie, adjust_areas
from orthoswarm.control.similarity import moved_camera, moved_terrain
from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.errors import AdjustmentError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import MapWindow, PlacedFrame, Refinement, Refiner, Solution, Terrain
from orthoswarm.mosaic.extent import joined_grounds, solved_level
from orthoswarm.refine.flight.vehicle_refinement import unrefined
from orthoswarm.trajectory.near_paths import NearPaths

_TIE_PLACES = 8
"""Camera positions of a vehicle that tie two areas: they move as one, a few tell shift, turn and scale."""
_BLOCK_NODES = 32
"""Nodes along each side that are taken from one area."""


@dataclass(frozen=True, slots=True)
class SolvedArea:
    """Vehicles that are solved together.

    Attributes:
        own: those whose solutions count. halo: neighbours of these that belong to other areas.
    """

    own: tuple[str, ...]
    halo: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _KeptArea:
    """What is kept of an area.

    Attributes:
        own: refinement of the area's own vehicles, without those of its halo.
        places: vehicle -> float64 (N, 3), some of its camera positions as this area solved them; of the vehicles of the
            halo, too, by which the area is tied to its neighbours.
        failure: why no vehicle could be refined; empty if some were.
    """

    own: Refinement
    places: dict[str, Array]
    failure: str = ""

    @property
    def nadirs(self) -> Array:
        return np.array([p.camera.nadir for s in self.own.fine for p in s.placed]).reshape(-1, 2)

    @property
    def on_map(self) -> bool:
        return any(p.stage == "fine" for s in self.own.fine for p in s.placed)


def refine_by_area(
    run: RunContext,
    refiner: Refiner,
    vehicles: Mapping[str, Sequence[Frame]],
    basemap: MapWindow | None,
    *,
    areas: Sequence[SolvedArea],
    grid: LocalGrid,
    label: str,
) -> Refinement:
    """Refine all vehicles (`Refiner.refine_batch`) with no more than one area in memory.

    An interrupted run goes on with the area that it was at. The first pass of a vehicle is run once, also where it lies
    in the halo of other areas.

    Args:
        run: the run. refiner: of the whole swarm. vehicles: id -> frames in order of time. basemap: the map, or None.
        areas: that the vehicles are divided into. grid: of the swarm. label: name of stored results.

    Raises:
        AdjustmentError: if no vehicle of any area could be refined.
    """
    solved: list[_KeptArea] = []
    for k, area in enumerate(areas):
        name = f"{label} area-{k}"
        one: _KeptArea | None = run.space.recall(name)
        if one is None:
            one = _solve(run, refiner, vehicles, basemap, area=area, grid=grid, of=(k, len(areas), label))
            run.space.remember(name, one)
        own = (frame for vehicle in area.own for frame in vehicles[vehicle])
        solved.append(replace(one, own=with_frames(one.own, own)))
        del one
        trim_memory()
    if all(one.failure for one in solved):
        raise AdjustmentError(solved[0].failure)
    joined, order = _joined(solved), {vehicle: k for k, vehicle in enumerate(vehicles)}
    for solutions in (joined.coarse, joined.fine):
        solutions.sort(key=lambda s: order[s.vehicle])
    return joined


def with_frames(refinement: Refinement, frames: Iterable[Frame]) -> Refinement:
    """Replace copies of frames, which came back from other processes or a file, by the frames: 2 kB a picture less."""
    known = {frame.image: frame for frame in frames}

    def own(solution: Solution) -> Solution:
        placed = [replace(p, frame=known.get(p.frame.image, p.frame)) for p in solution.placed]
        return replace(solution, placed=placed)

    coarse, fine = ([own(s) for s in solutions] for solutions in (refinement.coarse, refinement.fine))
    return replace(refinement, coarse=coarse, fine=fine)


def _solve(
    run: RunContext,
    refiner: Refiner,
    vehicles: Mapping[str, Sequence[Frame]],
    basemap: MapWindow | None,
    *,
    area: SolvedArea,
    grid: LocalGrid,
    of: tuple[int, int, str],
) -> _KeptArea:
    """Refine one area; `of`: its number, how many there are, name of stored results."""
    k, count, label = of
    names = {*area.own, *area.halo}
    frames = {vehicle: own for vehicle, own in vehicles.items() if vehicle in names}
    tasks = run.space.remembering(f"{label}-{k}", run.workers.map, shared=partial(_single_vehicle, label=label))

    def progress(what: str, done: int, all_: int) -> None:
        run.progress(f"{what}, area {k + 1} of {count}", done, all_)

    try:
        refined = refiner.refine_batch(frames, basemap, tasks, progress, halo=frozenset(area.halo))
    except AdjustmentError as error:  # of all its vehicles; those of other areas are mapped
        as_recorded = [unrefined(frames[vehicle], str(error), grid) for vehicle in area.own]
        return _KeptArea(Refinement(as_recorded, as_recorded, None), {}, failure=str(error))
    places = {s.vehicle: _some_places(s.placed) for s in refined.fine if s.placed}
    coarse, fine = (
        [replace(s, state=None) for s in solutions if s.vehicle in area.own]
        for solutions in (refined.coarse, refined.fine)
    )
    return _KeptArea(replace(refined, coarse=coarse, fine=fine), places)


def _single_vehicle(function: Callable[..., Any], item: Any, *, label: str) -> str | None:
    """Name of a vehicle's first pass, which is the same in all areas; None for other results."""
    from orthoswarm.refine.strategy.vehicle_passes import refine_tracked  # which the paper's refiner does without

    if getattr(function, "func", function) is not refine_tracked:
        return None
    unit = hashlib.sha256("\n".join(frame.image for frame in item).encode()).hexdigest()
    return f"{label} alone-{unit[:32]}"


def _some_places(placed: Sequence[PlacedFrame]) -> Array:
    index = np.unique(np.linspace(0, len(placed) - 1, _TIE_PLACES).round().astype(int))
    return np.array([placed[i].camera.position for i in index])


def _joined(every: Sequence[_KeptArea]) -> Refinement:
    """Move areas onto each other, and join them."""
    solved = [area for area in every if len(area.nadirs)]  # all pictures of an area may be damaged
    ties = []
    home = {s.vehicle: k for k, area in enumerate(solved) for s in area.own.fine}
    for k, area in enumerate(solved):
        for vehicle, place in area.places.items():
            other = home.get(vehicle, k)
            known = solved[other].places.get(vehicle)
            if other != k and known is not None and known.shape == place.shape:
                ties.append(AreaTie(other, k, np.stack([known, place])))
    nadirs = [area.nadirs for area in solved]
    moves = adjust_areas(nadirs, [area.on_map for area in solved], ties)
    own = [_moved(area.own, move) for area, move in zip(solved, moves, strict=True)]
    ground = merged_ground([r.terrain for r in own], nadirs)
    below = merged_ground([next((s.terrain for s in r.coarse if s.terrain), None) for r in own], nadirs)
    own += [area.own for area in every if not len(area.nadirs)]
    level = solved_level([s for r in own for s in r.fine])

    def on_ground(s: Solution) -> Solution:
        return s if s.terrain is None else replace(s, terrain=ground, ground_z_m=level)

    return Refinement(
        [replace(s, terrain=s.terrain and below) for r in own for s in r.coarse],
        [on_ground(s) for r in own for s in r.fine],
        ground,
        list(dict.fromkeys(warning for r in own for warning in r.warnings)),
        {name: sum(r.equation_5[name] for r in own if r.equation_5) for r in own for name in r.equation_5},
    )


def _moved(refinement: Refinement, move: AreaMove) -> Refinement:
    """An area with its fine cameras and its ground moved; coarse cameras stay where each vehicle was placed alone."""
    plane = move.plane
    level = float(np.median([s.ground_z_m for s in refinement.fine])) if refinement.fine else 0.0

    def placed(s: Solution) -> list[PlacedFrame]:
        return [replace(p, camera=moved_camera(p.camera, plane, level, move.up_m)) for p in s.placed]

    fine = [replace(s, placed=placed(s), ground_z_m=s.ground_z_m + move.up_m) for s in refinement.fine]
    return replace(refinement, fine=fine, terrain=_moved_ground(refinement.terrain, move, level))


def _moved_ground(terrain: Terrain | None, move: AreaMove, level_m: float) -> Terrain | None:
    if terrain is None:
        return None
    # Where the map holds an area, it is not resampled.
    moved = terrain if np.abs(move.plane.values).max() < 1e-5 else moved_terrain(terrain, move.plane, level_m)
    return moved.changed(lambda z: z + np.float32(move.up_m))


def merged_ground(grounds: Sequence[Terrain | None], nadirs: Sequence[Array]) -> Terrain | None:
    """Join the grounds of areas, on nodes as near to each other as those of the finest.

    Args:
        grounds: of the areas, each some way beyond its own cameras; None for flat at zero.
        nadirs: of their own cameras, float64 (N, 2) each.

    Returns:
        None where all are None.
    """
    found = [ground for ground in grounds if ground is not None]
    if not found:
        return None
    step = min(ground.step_m for ground in found)
    low = np.min([(g.west, g.south) for g in found], axis=0)
    high = np.max([(g.west + g.step_m * (g.z.shape[1] - 1), g.south + g.step_m * (g.z.shape[0] - 1)) for g in found], 0)
    columns, rows = (np.ceil((high - low) / step - 1e-6).astype(int) + 1).tolist()
    area = _nearest_areas(low, step, (rows, columns), nadirs)

    def joined(height: Callable[[Terrain], Floats]) -> Floats:
        z = np.zeros((rows, columns), np.float32)
        for i, j in np.ndindex(area.shape):
            ground = grounds[int(area[i, j])]
            if ground is not None:
                part = z[i * _BLOCK_NODES : (i + 1) * _BLOCK_NODES, j * _BLOCK_NODES : (j + 1) * _BLOCK_NODES]
                east = low[0] + step * (j * _BLOCK_NODES + np.arange(part.shape[1]))
                north = low[1] + step * (i * _BLOCK_NODES + np.arange(part.shape[0]))
                at = Terrain(ground.west, ground.south, ground.step_m, height(ground))
                part[:] = at.height(np.stack(np.meshgrid(east, north), -1))
        return z

    place = Terrain(float(low[0]), float(low[1]), step, np.zeros((rows, columns), np.float32))
    return joined_grounds(place, found, joined)


def _nearest_areas(low: Array, step: float, shape: tuple[int, int], nadirs: Sequence[Array]) -> NDArray[np.intp]:
    """For each block of nodes the area with the nearest camera."""
    from scipy.spatial import cKDTree  # a tenth of a second that runs of one area do without here

    rows, columns = (-(-n // _BLOCK_NODES) for n in shape)
    side = _BLOCK_NODES * step
    middle = np.stack(
        np.meshgrid(low[0] + side * (np.arange(columns) + 0.5), low[1] + side * (np.arange(rows) + 0.5)), -1
    )
    area = np.repeat(np.arange(len(nadirs)), [len(own) for own in nadirs])
    return np.asarray(area[cKDTree(np.concatenate(nadirs)).query(middle)[1]])


def divide(paths: Mapping[str, Array], most: int) -> list[SolvedArea]:
    """Divide vehicles into areas of about the same number of pictures, each with a halo of neighbours around it.

    A vehicle is never divided: its flight is what is adjusted at once.

    Args:
        paths: vehicle -> float64 (N, 3), its pictures' recorded positions above the takeoff level.
        most: so many pictures an area may have, or one vehicle.

    Returns:
        The areas, each with its halo; one without a halo where all pictures are few enough.
    """
    names = list(paths)
    middle = np.array([path[:, :2].mean(0) for path in paths.values()])
    count = np.array([len(path) for path in paths.values()])
    parts = _halves(np.arange(len(names)), middle, count, most)
    if len(parts) == 1:
        return [SolvedArea(tuple(names), ())]
    neighbours = NearPaths(list(paths.values()))
    areas = []
    for part in parts:
        own = set(part.tolist())
        near = {other for k in part.tolist() for other in neighbours.of(k)}
        areas.append(SolvedArea(tuple(names[k] for k in sorted(own)), tuple(names[k] for k in sorted(near - own))))
    return areas


def _halves(members: NDArray[np.intp], middle: Array, count: NDArray[np.intp], most: int) -> Sequence[NDArray[np.intp]]:
    """Members divided across the longer side of where they are, again and again, into parts of equal size."""
    parts = -(-int(count[members].sum()) // most)
    if parts <= 1 or len(members) == 1:
        return [members]
    place = middle[members]
    order = members[np.argsort(place[:, int(np.argmax(np.ptp(place, axis=0)))], kind="stable")]
    until = np.cumsum(count[order])
    cut = int(np.argmin(np.abs(until - until[-1] * (parts // 2) / parts))) + 1
    cut = min(cut, len(order) - 1)
    return [*_halves(order[:cut], middle, count, most), *_halves(order[cut:], middle, count, most)]
