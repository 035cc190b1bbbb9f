"""What worker processes do for the daemon: solve a vehicle's poses, and draw the next generation of a layer.

Both hand large things over as files: a solution is pickled beside the journal, a generation is a folder of tiles.
"""

import os
import pickle
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gcs_plugin.daemon.layers import Bounds, drawn_bounds, successor, union
from orthoswarm.basemap import Basemap
from orthoswarm.export.partial import written_whole
from orthoswarm.frame import Frame
from orthoswarm.geo import GroundGrid
from orthoswarm.mosaic.canvas import Canvas
from orthoswarm.mosaic.footprint import footprint_boxes
from orthoswarm.mosaic.render import render
from orthoswarm.placement import PlacedFrame, Solution, Terrain

_OVERLAP_M = 50.0


@dataclass(frozen=True, slots=True)
class SolveTask:
    """One vehicle's sortie to refine.

    Attributes:
        frames: in order of time. epsg, origin: the area's. basemap: the map, or None.
        neighbours: pickled solutions of vehicles nearby, held as they are. target: where the new one goes.
    """

    frames: list[Frame]
    epsg: int
    origin: tuple[float, float]
    basemap: Path | None
    neighbours: list[Path]
    target: Path


@dataclass(frozen=True, slots=True)
class Solved:
    """What became of it.

    Attributes:
        stages: image -> stage and sigma in metres. dropped: image -> why.
        legs: as JSON values. fov_deg: with its sigma. warnings: in plain words. bounds: of what its frames see.
        cpu_s: CPU seconds that it took; wall_s.
    """

    stages: dict[str, tuple[str, float]]
    dropped: dict[str, str]
    legs: list[dict[str, Any]]
    fov_deg: float
    fov_sigma_deg: float
    warnings: list[str]
    bounds: Bounds
    cpu_s: float
    wall_s: float


def solve(task: SolveTask) -> Solved:
    """Refine one vehicle.

    Raises:
        OrthoSwarmError: nothing can be made of its frames.
    """
    from dataclasses import asdict

    from orthoswarm.swarm.refine import SwarmRefiner

    began, cpu = time.monotonic(), time.process_time()
    basemap = None if task.basemap is None else Basemap.open(task.basemap, task.epsg, _near(task.frames, task.epsg))
    neighbours = [_load(path) for path in task.neighbours]
    solution = SwarmRefiner(task.epsg, np.array(task.origin)).refine(task.frames, neighbours, basemap)
    with written_whole(task.target) as part, part.open("wb") as file:
        pickle.dump(solution, file, pickle.HIGHEST_PROTOCOL)
        file.flush()
        os.fsync(file.fileno())
    return Solved(
        {p.frame.image: (p.stage, p.sigma_m) for p in solution.placed},
        dict(solution.dropped),
        [asdict(leg) for leg in solution.legs],
        solution.fov_deg,
        solution.fov_sigma_deg,
        list(solution.warnings),
        _seen(solution.placed, solution.terrain or Terrain.flat(solution.ground_z_m)),
        time.process_time() - cpu,
        time.monotonic() - began,
    )


def _near(frames: list[Frame], epsg: int) -> Bounds:
    from orthoswarm.geo import LocalGrid

    ground = LocalGrid(epsg).to_grid([f.fix.lat_deg for f in frames], [f.fix.lon_deg for f in frames])
    (west, south), (east, north) = ground.min(0), ground.max(0)
    return float(west), float(south), float(east), float(north)


def load_solution(path: Path) -> Solution:
    """A solution that `solve` wrote."""
    return _load(path)


def _load(path: Path) -> Solution:
    solution: Solution = pickle.loads(path.read_bytes())
    return solution


def _seen(placed: list[PlacedFrame], terrain: Terrain) -> Bounds:
    boxes = footprint_boxes([p.camera for p in placed], float(terrain.z.min()), float(terrain.z.max()))
    boxes = boxes[np.isfinite(boxes).all(1)]
    return union(boxes) if len(boxes) else (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class DrawTask:
    """The next generation of a refined layer.

    Attributes:
        old: folder of the present generation, None for the first. new: folder of the next.
        grid: where the layer lies.
        solutions: pickled solutions, in the order that breaks ties; all that show on the layer.
        changed: the solution whose ground is drawn anew. before: what its vehicle's frames saw till now, if it did.
    """

    old: Path | None
    new: Path
    grid: GroundGrid
    solutions: list[Path]
    changed: Path
    before: Bounds | None


def draw(task: DrawTask) -> dict[str, str]:
    """Draw a solution, and what overlaps it, into a new generation; gives image -> why it could not be drawn.

    Raises:
        OrthoSwarmError: the disk is full.
    """
    changed = _load(task.changed)
    terrain = changed.terrain or Terrain.flat(changed.ground_z_m)
    own = _seen(changed.placed, terrain)
    bounds = own if task.before is None else union([own, task.before])
    placed: list[PlacedFrame] = []
    for path in task.solutions:
        mine = path == task.changed
        solution = changed if mine else _load(path)
        placed += [_marked(p, len(placed) + i, mine) for i, p in enumerate(solution.placed) if _touches(p, bounds)]
    old = None if task.old is None else Canvas.open(task.old, writable=False)
    canvas = successor(old, task.new, task.grid, "frame", share=True)
    try:
        stats = render(placed, terrain, canvas, bounds=bounds)
        canvas.flush()
        assert drawn_bounds(canvas) is not None or not stats.pixels.any()
    finally:
        canvas.close()
        if old is not None:
            old.close()
    named = ([*key.split(" ", 2), why] for key, why in stats.rejected.items())
    return {image: why for _, whose, image, why in named if whose == _OWN}


_OWN, _OTHER = "own", "other"


def _marked(placed: PlacedFrame, number: int, mine: bool) -> PlacedFrame:
    """Vehicles may use the same names for their pictures, the renderer tells frames apart by name."""
    frame = placed.frame
    return replace(placed, frame=replace(frame, image=f"{number} {_OWN if mine else _OTHER} {frame.image}"))


def _touches(placed: PlacedFrame, bounds: Bounds) -> bool:
    reach = 3.0 * float(placed.camera.position[2]) + _OVERLAP_M
    x, y = (float(v) for v in placed.camera.position[:2])
    west, south, east, north = bounds
    return west - reach < x < east + reach and south - reach < y < north + reach
