"""The second pass of a vehicle: links to fixed neighbours, new tie points, sigmas, denser ground.

Beyond the outermost leg ground is seen at 40 degrees and more off nadir, from one side and by few pictures: its height
is poorly triangulated, and an error of it displaces the orthoimage by nearly as much. The map shows it: ground that is
higher than assumed appears farther out in a picture, displaced along the line of sight.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from orthoswarm.export.product_files import OBLIQUE_AXIS_DOWN
from orthoswarm.model.arrays import Array, Flags, Floats, Ints
from orthoswarm.model.camera import fov_rad
from orthoswarm.model.task_runner import Continued
from orthoswarm.refine.bundle.adjustment import TRACK_ROBUST_C
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, F
from orthoswarm.refine.bundle.covariance import (
    common_map_sigma,
    map_distortion_variance,
    stated_errors,
    systematic_tie_offset,
    with_distance_errors,
)
from orthoswarm.refine.bundle.priors import HEIGHT_OFFSET_SIGMA_M
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.flight.weakly_held_pictures import interpolate_weak
from orthoswarm.refine.registration.absolute_orientation import (
    TIE_HALF_PX,
    TIE_REACH_PX,
    TIE_SCALES,
    clear_matches,
    load_map,
    map_gsd,
    reorient_on_map,
    working_gsd,
)
from orthoswarm.refine.registration.block_state import Stopwatch, VehicleState, WorkArea, lies_on_map
from orthoswarm.refine.registration.neighbour_registration import fixed_cameras_near, link_to_fixed, remove_fixed
from orthoswarm.refine.registration.tie_points import LoadedMap, match_points
from orthoswarm.refine.strategy.vehicle_passes import SIGMA_FLOOR_M, level_sigma_deg
from orthoswarm.refine.surface.ground_densification import (
    cells_near,
    dense_points,
    flying_height,
    sight_reach,
    spaced_pictures,
)
from orthoswarm.refine.surface.vehicle_ground import GroundModel

_COHERENT_SIGMAS: Final = 2.0
"""Ties around a picture whose common offset exceeds so many sigmas show an error that the covariance does not
contain."""
_SECOND_STEPS: Final = 4  # steps of the second pass without a map
_OBLIQUE_CELL_M: Final = 5.0  # at least this far apart, however small the picture
_OBLIQUE_SLOPE: Final = 0.35  # horizontal distance over height from which on a view counts as oblique: 19 degrees
_OBLIQUE_CELL_SHARE: Final = 0.06  # distance of the positions, as a share of the flying height (cost)
_OBLIQUE_HALF_M: Final = 10.0  # half a patch: smaller than a tie point's
_OBLIQUE_REACH_M: Final = 6.0  # how far a patch is searched
_OBLIQUE_ACROSS_M: Final = 0.6  # what is found lies this near to the line of sight, metres, or is another place
_OBLIQUE_SIGMA_SHARE: Final = 1.5
"""Sigma of such a place, in sigmas of the tie points, which are averages over a leg's views."""
_OBLIQUE_VIEWS: Final = 8  # most cameras, nearest first, that are asked whether they show a position (for its time)


def second_pass(item: tuple[VehicleState, list[VehicleState], float], *, area: WorkArea) -> Continued[VehicleState]:
    """Adjust one vehicle again on the common level, linked to its neighbours and tied to the map; densify its ground.

    item: the vehicle, its neighbours, whose cameras are fixed, and metres to add to its level.
    """
    state, others, correction = item
    state = deepcopy(state)  # neighbours use the state of the first pass, in whatever order the tasks run
    watch = Stopwatch()
    flight = state.flight
    state.surface = replace(state.surface, level_m=state.surface.level_m + correction)
    # Pictures are not kept between the passes; decoding a spaced subset again is enough.
    pictures = None if flight.sparse else spaced_pictures(flight, state.surface)
    fixed = fixed_cameras_near(state, others)
    if fixed is not None:
        link_to_fixed(flight, fixed, working_gsd(flight), pictures=pictures)
    watch.lap("links to neighbours")
    ground = None
    if state.on_map and area.basemap is not None:
        ground = load_map(flight, area.basemap, area.origin, map_gsd(flight, area.basemap))
        state.surface, state.ties, state.matches = reorient_on_map(flight, ground, state.surface, state.ties, pictures)
    else:
        for _ in range(_SECOND_STEPS):
            flight.adjustment.step(TRACK_ROBUST_C, state.surface.height_prior(flight.adjustment.points))
    watch.lap("second adjustment")
    watch.add_to(state.timings)
    return Continued(_errors_and_ground, (state, others, ground, pictures))


def _errors_and_ground(item: tuple[VehicleState, list[VehicleState], LoadedMap | None, Flags | None]) -> VehicleState:
    """The second half: sigmas, and denser ground."""
    state, others, ground, pictures = item
    flight, watch = state.flight, Stopwatch()
    _own_errors(state, others, ground)
    remove_fixed(flight)
    if not flight.sparse:
        interpolate_weak(flight, state.sigma_m)
    watch.lap("sigma")
    _denser_ground(state, others, ground, pictures)
    watch.lap("denser terrain")
    flight.pictures.drop()
    for other in others:
        other.flight.pictures.drop()
    watch.add_to(state.timings)
    return state


def _own_errors(state: VehicleState, others: Sequence[VehicleState], ground: LoadedMap | None) -> None:
    """Set the sigmas of the frames and of the field of view, systematic offsets of the map's ties included."""
    flight = state.flight
    adj = flight.adjustment
    ties = state.ties if state.on_map else None
    floor = SIGMA_FLOOR_M
    if ground is not None:
        floor = common_map_sigma(adj.tie_residual, state.ties.sigma_m, ground.gsd_m)
    belief = state.surface.height_prior(adj.points)
    stated = stated_errors(adj, TRACK_ROBUST_C, belief, ties=ties, tie_c=TIE_SCALES[1], floor_m=floor)
    level_deg = level_sigma_deg(flight, state.surface)
    state.fov_sigma_deg = float(np.hypot(stated.fov_sigma_deg, level_deg))
    state.sigma_m = stated.sigma_m[: len(flight.frames)]
    state.pose_covariance = _with_focal_error(flight, stated.pose[: len(flight.frames)], level_deg)
    placed = state.datum_sigma_m if state.coarse_shift is None else state.coarse_shift.sigma_m
    if placed is not None:  # it replaces the receiver's error, which all pictures have in common
        own = state.coarse_sigma_m
        state.sigma_m = np.hypot(np.sqrt(np.maximum(own**2 - own.min() ** 2, 0.0)), placed)
    elif not lies_on_map(state):
        state.sigma_m = np.maximum(state.sigma_m, state.coarse_sigma_m)  # neighbours off the map add no accuracy
    elif not state.on_map:
        theirs = [float(np.median(other.sigma_m)) for other in others if lies_on_map(other)]
        state.sigma_m = np.hypot(state.sigma_m, max(theirs, default=0.0))
    if state.on_map and len(adj.tie_residual) == len(state.matches.camera):
        place, height = adj.points[state.matches.point, :2], float(np.median(adj.cameras.position[:, 2]))
        distortion = map_distortion_variance(place, adj.tie_residual, height)
        state.map_distortion_m2 = max(0.0, distortion - floor**2)  # the floor covers so much of it
        off = systematic_tie_offset(flight.leg, state.matches.camera, adj.tie_residual)
        off[off < _COHERENT_SIGMAS * state.sigma_m] = 0.0
        state.sigma_m = np.hypot(state.sigma_m, off)


def _with_focal_error(flight: FlightBlock, pose: Floats, fov_sigma_deg: float) -> Floats:
    """Covariances with what a wrong field of view means for the distance from the ground; used heights bound it."""
    cameras = flight.cameras()
    fov = fov_rad(float(cameras.lens[0, F]), int(cameras.lens[0, WIDTH]))
    share = float(np.radians(fov_sigma_deg)) / float(np.sin(fov))
    down = np.maximum(-cameras.rotation[:, 2, 2], OBLIQUE_AXIS_DOWN)
    height_sigma_m = share * cameras.position[:, 2]
    if flight.calibration.trusted_height:
        height_sigma_m = np.minimum(height_sigma_m, HEIGHT_OFFSET_SIGMA_M)
    return with_distance_errors(pose, cameras.rotation, height_sigma_m / down)


def _denser_ground(
    state: VehicleState, others: Sequence[VehicleState], ground: LoadedMap | None, pictures: Flags | None
) -> None:
    """Add ground points for drawing: between the tracks and, where views are oblique only, from the map."""
    flight = state.flight
    points, sigmas, state.high = dense_points(flight, state.surface)
    state.dense = points, sigmas
    if ground is not None:
        paths = [other.flight.cameras().position[:, :2] for other in others if other.on_map]
        elsewhere = np.concatenate([np.zeros((0, 2)), *paths])
        more = map_heights(
            flight, state.surface, ground, others=elsewhere, tie_sigma_m=state.ties.sigma_m, pictures=pictures
        )
        state.dense = np.concatenate([state.dense[0], more[0]]), np.concatenate([state.dense[1], more[1]])


def map_heights(
    flight: FlightBlock,
    surface: GroundModel,
    ground: LoadedMap,
    *,
    others: Array,
    tie_sigma_m: Array,
    pictures: Flags | None = None,
) -> tuple[Array, Array]:
    """Ground points (K, 3) and one sigma of their heights (K,), where an adjusted flight's views are oblique.

    others: float64 (M, 2), where other vehicles' cameras were; ground that they see more steeply is left out.
    tie_sigma_m: float64 (Q,), of the flight's ties. pictures: bool (N,), to compare with the map; None: all on legs.
    """
    cameras, own = flight.cameras(), np.flatnonzero((flight.leg >= 0) & (True if pictures is None else pictures))
    if not len(tie_sigma_m) or not len(own):
        return np.zeros((0, 3)), np.zeros(0)
    cells = _positions(flight, flying_height(flight, surface), own, others)
    points = np.column_stack([cells, surface.terrain().height(cells)])
    camera = _best_views(cameras, points, own)
    chosen = np.flatnonzero(camera >= 0)
    found = match_points(
        cameras,
        points,
        chosen,
        camera=camera,
        gray=flight.pictures.gray,
        ground=ground,
        half=max(TIE_HALF_PX, round(_OBLIQUE_HALF_M / ground.gsd_m)),
        reach=max(TIE_REACH_PX, round(_OBLIQUE_REACH_M / ground.gsd_m)),
        level=points[:, 2],
        texture=True,
    )
    found = clear_matches(found)
    sight = points[found.point] - cameras.position[found.camera]
    out = np.hypot(sight[:, 0], sight[:, 1])
    slope = out / np.maximum(-sight[:, 2], 1.0)
    east, north = (sight[:, :2] / np.maximum(out, 1.0)[:, None]).T
    along = found.shift[:, 0] * east + found.shift[:, 1] * north
    across = found.shift[:, 1] * east - found.shift[:, 0] * north
    good = (np.abs(across) < _OBLIQUE_ACROSS_M) & (slope > _OBLIQUE_SLOPE)
    where = points[found.point[good]].copy()
    where[:, :2] += found.shift[good]
    where[:, 2] -= along[good] / slope[good]
    return where, _OBLIQUE_SIGMA_SHARE * float(np.median(tie_sigma_m)) / slope[good]


def _positions(flight: FlightBlock, height_m: float, own: NDArray[np.integer], others: Array) -> Array:
    """Centres (K, 2) of cells that own cameras see obliquely and no other vehicle sees more steeply."""
    path, reach = flight.cameras().position[:, :2], sight_reach(flight)
    cell = max(_OBLIQUE_CELL_SHARE * height_m, _OBLIQUE_CELL_M)
    cells = cells_near(path, cell, reach + cell)
    mine, _ = cKDTree(path[own]).query(cells)
    keep = (mine > _OBLIQUE_SLOPE * height_m) & (mine < reach)
    if len(others):
        keep &= mine <= cKDTree(others).query(cells)[0]
    return np.asarray(cells[keep])


def _best_views(cameras: CameraBlock, points: Array, own: NDArray[np.integer]) -> Ints:
    """For each point (K, 3) the camera nearest above it that sees it, -1 for none."""
    best = np.full(len(points), -1, np.int32)
    if not len(points) or not len(own):
        return best
    _, near = cKDTree(cameras.position[own, :2]).query(points[:, :2], k=min(_OBLIQUE_VIEWS, len(own)))
    for rank in np.atleast_2d(near.T):
        left = best < 0
        camera = own[rank]
        uv = cameras.project(camera, points)
        size = cameras.lens[cameras.lens_id[camera]][:, [WIDTH, HEIGHT]]
        seen = np.isfinite(uv).all(1) & (uv > 0).all(1) & (uv < size - 1).all(1)
        best[left & seen] = camera[left & seen]
    return best
