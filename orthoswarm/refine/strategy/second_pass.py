"""The second pass of a vehicle: links to fixed neighbours, new tie points, sigmas, denser ground."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Final

import numpy as np

from orthoswarm.export.product_files import OBLIQUE_AXIS_DOWN
from orthoswarm.model.arrays import Array, Flags, Floats
from orthoswarm.model.camera import fov_rad
from orthoswarm.model.placement import MapWindow
from orthoswarm.model.task_runner import Continued
from orthoswarm.refine.bundle.adjustment import TRACK_ROBUST_C
from orthoswarm.refine.bundle.block_arrays import WIDTH, F
from orthoswarm.refine.bundle.covariance import (
    common_map_sigma,
    stated_errors,
    systematic_tie_offset,
    with_distance_errors,
)
from orthoswarm.refine.bundle.map_distortion import map_distortion_variance
from orthoswarm.refine.bundle.priors import HEIGHT_OFFSET_SIGMA_M
from orthoswarm.refine.flight.relative_block import Flight
from orthoswarm.refine.flight.weakly_held_pictures import interpolate_weak
from orthoswarm.refine.registration.absolute_orientation import (
    TIE_SCALES,
    load_map,
    map_gsd,
    reorient_on_map,
    working_gsd,
)
from orthoswarm.refine.registration.block_state import Stopwatch, VehicleState, lies_on_map
from orthoswarm.refine.registration.map_heights import map_heights
from orthoswarm.refine.registration.map_windows import LoadedMap
from orthoswarm.refine.registration.neighbour_ties import fixed_cameras_near, link_to_fixed, remove_fixed
from orthoswarm.refine.strategy.vehicle_passes import SIGMA_FLOOR_M, level_sigma_deg
from orthoswarm.refine.surface.ground_densification import dense_points, spaced_pictures

_COHERENT_SIGMAS: Final = 2.0
"""Ties around a picture whose common offset exceeds so many sigmas show an error that the covariance does not
contain."""
_SECOND_STEPS: Final = 4  # steps of the second pass without a map


def second_pass(
    item: tuple[VehicleState, list[VehicleState], float],
    *,
    basemap: MapWindow | None,
    origin: Array,
) -> Continued[VehicleState]:
    """Adjust one vehicle again on the common level, linked to its neighbours and tied to the map; densify its ground.

    Args:
        item: the vehicle, its neighbours, whose cameras are fixed, and metres to add to its level.
        basemap: the map on the area's grid, or None. origin: float64 (2,) of the local frame.
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
    if state.on_map and basemap is not None:
        ground = load_map(flight, basemap, origin, map_gsd(flight, basemap))
        state.surface, state.ties, state.matches = reorient_on_map(flight, ground, state.surface, state.ties, pictures)
    else:
        for _ in range(_SECOND_STEPS):
            flight.adjustment.step(TRACK_ROBUST_C, state.surface.height_prior(flight.adjustment.points))
    watch.lap("second adjustment")
    watch.add_to(state.timings)
    return Continued(_errors_and_ground, (state, others, ground, pictures))


def _errors_and_ground(
    item: tuple[VehicleState, list[VehicleState], LoadedMap | None, Flags | None],
) -> VehicleState:
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
    track_c, tie_c = TRACK_ROBUST_C, TIE_SCALES[1]
    stated = stated_errors(adj, track_c, state.surface.height_prior(adj.points), ties=ties, tie_c=tie_c, floor_m=floor)
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
        beyond = (
            map_distortion_variance(place, adj.tie_residual, height) - floor**2
        )  # of which the floor covers so much
        state.map_distortion_m2 = max(0.0, beyond)
        off = systematic_tie_offset(flight.leg, state.matches.camera, adj.tie_residual)
        off[off < _COHERENT_SIGMAS * state.sigma_m] = 0.0
        state.sigma_m = np.hypot(state.sigma_m, off)


def _with_focal_error(flight: Flight, pose: Floats, fov_sigma_deg: float) -> Floats:
    """Covariances of the frames' cameras with what a wrong field of view means for their distance from the ground.

    Recorded heights that the adjustment uses bound it.
    """
    cameras = flight.cameras()
    fov = fov_rad(float(cameras.lens[0, F]), int(cameras.lens[0, WIDTH]))
    share = float(np.radians(fov_sigma_deg)) / float(np.sin(fov))
    down = np.maximum(-cameras.rotation[:, 2, 2], OBLIQUE_AXIS_DOWN)
    height_sigma_m = share * cameras.position[:, 2]
    if flight.calibration.trusted_height:
        height_sigma_m = np.minimum(height_sigma_m, HEIGHT_OFFSET_SIGMA_M)
    return with_distance_errors(pose, cameras.rotation, height_sigma_m / down)


def _denser_ground(
    state: VehicleState,
    others: Sequence[VehicleState],
    ground: LoadedMap | None,
    pictures: Flags | None,
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
