"""What vehicles of an area share: which are neighbours, the lean of the map, one terrain."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.placement import STATED_SIGMA_FACTOR, Terrain
from orthoswarm.model.task_runner import Run, serial
from orthoswarm.mosaic.extent import ground_of_nearest
from orthoswarm.refine.flight.weakly_held_pictures import weakly_held
from orthoswarm.refine.registration.block_state import VehicleState
from orthoswarm.refine.registration.tie_points import MapMatches, vote_lean
from orthoswarm.refine.surface.dem_surface import LocalDem, fit_over_dem
from orthoswarm.refine.surface.ground_densification import flying_height
from orthoswarm.refine.surface.plane_sweep import SweepViews, with_tall_surfaces
from orthoswarm.refine.surface.smooth_surface import FitSettings
from orthoswarm.refine.surface.terrain import fit_terrain
from orthoswarm.refine.surface.vehicle_ground import TERRAIN_POINTS, ground_points, mapped_ground_level
from orthoswarm.trajectory.near_paths import near_paths

_DRAWN_NODES: Final = 4_000_000  # most nodes of a surface that pictures are drawn on (memory)
_TERRAIN_REACH_HEIGHTS: Final = 1.1  # terrain is made to so many flying heights beyond the cameras
_DEM_DIFFERS_M: Final = 0.2  # what is left over a given height model is said from here on
_DEM_COVERS_SHARE: Final = 0.97  # a height model that covers more than this of the area covers it


def neighbours_of(state: VehicleState, states: Sequence[VehicleState]) -> list[VehicleState]:
    """The other vehicles whose flight paths come near enough for common ground."""
    others = [other for other in states if other is not state]
    paths = [other.flight.adjustment.cameras.position for other in others]
    return [others[k] for k in near_paths(state.flight.adjustment.cameras.position, paths)]


def pooled_lean(states: Sequence[VehicleState]) -> tuple[float, float]:
    """The map's lean by vote over the roofs of all vehicles that lie on it; zero where they do not agree."""
    mapped = [s for s in states if s.on_map]
    if not mapped:
        return (0.0, 0.0)
    joint = MapMatches.joined([s.roofs[0] for s in mapped])
    return vote_lean(joint, np.concatenate([s.roofs[1] for s in mapped]), np.zeros(2)) or (0.0, 0.0)


def common_terrain(
    states: Sequence[VehicleState],
    others: Sequence[VehicleState] = (),
    *,
    near_own: bool = False,
    dem: LocalDem | None = None,
    run: Run = serial,
) -> tuple[Terrain | None, list[str]]:
    """One surface over all vehicles for rendering, in the local frame; None where there are too few points.

    A given height model is shifted to their level; where the points contradict it, a warning says so.

    states: vehicles that are drawn: what stands on the ground is measured where they have found raised points. others:
    more that the ground is common to. near_own: without the ground of others alone.
    """
    own, states = states, [*states, *others]
    if not states:
        return None, []
    tied = [ground_points(s.flight.adjustment) for s in states]
    points = np.concatenate([p for p, _ in tied] + [s.dense[0] for s in states])
    sigma = np.concatenate([q for _, q in tied] + [s.dense[1] for s in states])
    if len(points) < TERRAIN_POINTS:
        return states[0].surface.terrain(), []
    path = np.concatenate([s.flight.adjustment.cameras.position for s in (own if near_own else states)])
    reach = _TERRAIN_REACH_HEIGHTS * float(np.median(path[:, 2]))
    bounds = BoundingBox.around_points(path[:, :2], reach)
    fit, off = None, 0.0
    how = FitSettings.for_drawing(on_map=any(s.on_map for s in states))
    if dem is not None:
        fit, off = fit_over_dem(dem, points, sigma, bounds, settings=how, most_nodes=_DRAWN_NODES)
    drawn = (fit or fit_terrain(points, sigma, bounds, settings=how)).rendering()
    height_m = float(np.median([flying_height(s.flight, s.surface) for s in states]))
    surface = np.concatenate([part for s in own for part in (s.dense[0], s.high)])  # ground, and what stands on it
    drawn = with_tall_surfaces(
        drawn, surface, [_sweep_views(s) for s in states], height_m=height_m, most_nodes=_DRAWN_NODES, run=run
    )
    return drawn, _dem_warnings(dem, fit is None, off, states) if dem is not None else []


def _sweep_views(state: VehicleState) -> SweepViews:
    """A vehicle's pictures for the plane sweep, without those that are damaged or weakly held."""
    flight = state.flight
    usable = ~weakly_held(flight)
    usable[[i for i, frame in enumerate(flight.frames) if frame.damaged or i in flight.pictures.damaged]] = False
    return SweepViews(flight.cameras(), flight.pictures, usable)


def map_distortion_sigma(states: Sequence[VehicleState]) -> float:
    """What the map itself is displaced by from place to place, metres, as a stated sigma; all vehicles saw one map."""
    found = [(s.map_distortion_m2, len(s.matches.point)) for s in states if np.isfinite(s.map_distortion_m2)]
    if not found:
        return 0.0
    variance, ties = np.array(found, float).T
    return STATED_SIGMA_FACTOR * float(np.sqrt(variance @ ties / max(ties.sum(), 1.0)))


def mapped_level(states: Sequence[VehicleState], terrain: Terrain | None) -> float:
    """Level of the ground that vehicles map, metres; terrain: theirs, in the local frame."""
    position = np.concatenate([np.zeros((0, 3)), *(s.flight.adjustment.cameras.position for s in states)])
    return mapped_ground_level(terrain, position, [s.dense[0] for s in states])


def coarse_terrain(states: Sequence[VehicleState]) -> Terrain | None:
    """The ground before the map was used, in the local frame; None where no vehicle has found its ground.

    Each vehicle's ground belongs to its own cameras, on a level that no other shares yet.
    """
    grounds = [None if s.coarse_surface.fit is None else s.coarse_surface.terrain() for s in states]
    steps = [ground.step_m for ground in grounds if ground is not None]
    if not steps:
        return None
    paths = [s.coarse.position for s in states]
    reach = _TERRAIN_REACH_HEIGHTS * float(np.median(np.concatenate(paths)[:, 2]))
    own = [path[:, :2] for path in paths]
    return ground_of_nearest(grounds, own, reach, step_m=min(steps), most_nodes=_DRAWN_NODES)


def _dem_warnings(dem: LocalDem, unused: bool, off_m: float, states: Sequence[VehicleState]) -> list[str]:
    """Warnings about a given height model."""
    name = dem.model.path.name
    if unused:
        return [
            f"{name} contradicts the pictures (their ground differs from it by {off_m:.1f} m in the median), so the "
            "ground found from them is used; check the file"
        ]
    out = []
    doubted = [s for s in states if s.surface.contradicted_m > 0.0]
    if doubted:
        who = ", ".join(sorted({s.vehicle for s in doubted}))
        off = max(s.surface.contradicted_m for s in doubted)
        out.append(f"{name} contradicts the pictures of {who} by {off:.1f} m in the median; check it")
    elif off_m > _DEM_DIFFERS_M:
        out.append(
            f"the ground differs from {name} by {off_m:.1f} m in the median: it is coarse, old or displaced; the "
            "pictures are followed where they differ from it"
        )
    if dem.model.cover < _DEM_COVERS_SHARE:
        share = dem.model.cover
        out.append(f"{name} has heights on {share:.0%} of the area; elsewhere the ground is found from the pictures")
    return out
