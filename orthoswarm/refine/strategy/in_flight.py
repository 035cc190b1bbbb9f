"""The coarse map in flight without a basemap: pictures of complete legs are adjusted as one block.

On a single straight leg the receiver's drift and the camera's tilt are not separable, so the drift is held there.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid, local_origin
from orthoswarm.model.placement import Leg, Solution
from orthoswarm.mosaic.recorded_pose import recorded_cameras
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.flight.sparse_block import open_sparse_flight
from orthoswarm.refine.flight.unsolved_pictures import hovering_vehicles
from orthoswarm.refine.flight.vehicle_refinement import merge_units, split_units
from orthoswarm.refine.flight.weakly_held_pictures import HELD_OBSERVATIONS, observations_per_camera
from orthoswarm.refine.registration.block_state import Stopwatch, VehicleState, WorkArea, to_solution
from orthoswarm.refine.strategy.vehicle_passes import RefinerOptions, adjust_without_map, adjusted_state, tracked_flight
from orthoswarm.refine.surface.vehicle_ground import GroundModel, fit_surface
from orthoswarm.trajectory.legs import leads_one_way

__all__ = ["coarse_of", "local_origin", "place_in_flight"]

_SPARSE_FEWEST: Final = 4  # fewer photos are not placed in flight
_SPARSE_MOST: Final = 60  # more photos that must be matched in pairs wait for the refinement
_HELD_DRIFT_M: Final = 3.0
"""Sigma of a receiver's drift over one straight run: tilt and drift cannot be separated there. Without this prior
single legs were up to 12 m off; with it 2 to 4 m (simulated flights)."""
_HELD_DRIFT_BEND_M: Final = 0.3  # the same for the second difference of the drift's knots (measured together)
_HELD_LAG_S: Final = 0.2  # the same for the delay of positions behind the shutter (measured together)
_ODD_FOCAL_CHANGE: Final = 0.2  # a placement whose focal length left its start by more (logarithm) is not shown
_ODD_HEIGHT_CHANGE: Final = 0.2  # the same for the height
_ODD_TURN_DEG: Final = 12.0  # the same for the attitude where tilt was recorded


def place_in_flight(
    frames: Sequence[Frame],
    *,
    epsg: int,
    origin: Array,
    options: RefinerOptions | None = None,
) -> Solution:
    """Coarse placement of a vehicle's pictures so far, in the receiver's frame.

    frames: of finished legs of one vehicle, in order of time, with the turns between them. The solution is of stage
    coarse without state.

    Raises:
        OrthoSwarmError: the block of pictures cannot be adjusted (yet); the message says why.
    """
    if frames and hovering_vehicles(recorded_cameras(frames, LocalGrid(epsg)).placed):
        raise OrthoSwarmError("all its pictures were taken at one spot; they are drawn where its receiver says")
    units = split_units({frames[0].vehicle: frames} if frames else {})
    enough = [unit for unit in units if len(unit) >= _SPARSE_FEWEST]
    area = WorkArea(epsg, origin, None)
    found = [_unit(unit, area, options or RefinerOptions()) for unit in enough]
    if not found:
        raise OrthoSwarmError(f"{len(frames)} pictures are too few to be adjusted; the next leg is tried")
    return replace(merge_units(found)[0], state=None)


def coarse_of(solution: Solution, origin: Array) -> Solution:
    """The coarse placement that a refined solution started from, registered on the map where it was found there.

    Raises:
        OrthoSwarmError: the solution has no state, as that of a vehicle that stood at one spot.
    """
    if solution.state is None:
        raise OrthoSwarmError(f"{solution.vehicle} lies where its receiver says; there is no other coarse placement")
    states = solution.state if isinstance(solution.state, list) else [solution.state]
    if not all(isinstance(state, VehicleState) for state in states):
        raise OrthoSwarmError(f"{solution.vehicle} was refined by another refiner; refine it again")
    parts = []
    for state in states:
        shift = np.asarray(getattr(state, "map_shift", np.zeros(2)))
        legs = to_solution(state, origin, None).legs
        parts.append(replace(to_solution(_shifted(state, shift), origin, None, coarse=True), legs=legs))
    return replace(merge_units(parts)[0], state=None)


def _unit(frames: Sequence[Frame], area: WorkArea, options: RefinerOptions) -> Solution:
    watch, origin = Stopwatch(), area.origin
    flight = tracked_flight(frames, area, options)
    if flight is None:
        if len(frames) > _SPARSE_MOST:
            raise OrthoSwarmError("its pictures overlap too little to be placed in flight; the refinement places them")
        flight = open_sparse_flight(frames, area.grid, origin, options.read)
    one_way = leads_one_way(flight.records.position, flight.leg)
    if one_way and not flight.sparse:
        _hold_drift(flight)
    surface = fit_surface(flight.adjustment, GroundModel()) if flight.sparse else adjust_without_map(flight)
    _check(flight)
    state = adjusted_state(flight, surface, watch)
    flight.pictures.drop()
    legs = [
        Leg.of(flight.frames, own, "failed", 0.0, float(np.median(state.coarse_sigma_m[own])))
        for k in range(int(flight.leg.max()) + 1 if len(flight.leg) else 0)
        if len(own := np.flatnonzero(flight.leg == k))
    ]
    return replace(to_solution(state, origin, None, coarse=True), legs=legs)


def _hold_drift(flight: FlightBlock) -> None:
    """Tighter priors of the receiver's drift, which on a single straight run cannot be told from the camera's tilt."""
    priors = flight.adjustment.priors
    models = tuple(
        replace(
            m, drift_sigma=min(m.drift_sigma, _HELD_DRIFT_M), drift_bend=_HELD_DRIFT_BEND_M,
            lag_sigma=min(m.lag_sigma, _HELD_LAG_S),
        )
        for m in priors.models
    )  # fmt: skip
    flight.adjustment.priors = replace(priors, models=models)


def _check(flight: FlightBlock) -> None:
    """Refuse, by an OrthoSwarmError, an adjustment whose lens, height or attitudes are impossible."""
    cameras, records = flight.cameras(), flight.records
    if float(np.median(observations_per_camera(flight))) < HELD_OBSERVATIONS:
        raise OrthoSwarmError("its pictures have too few points in common")
    if not (np.isfinite(cameras.position).all() and np.isfinite(cameras.rotation).all()):
        raise OrthoSwarmError("its pictures cannot be adjusted yet")
    axes = np.einsum("ni,ni->n", cameras.rotation[:, :, 2], records.rotation()[:, :, 2])
    turned = np.arccos(np.clip(axes, -1.0, 1.0))
    tilted = records.has_tilt
    tilt_off = bool(tilted.any()) and float(np.median(turned[tilted])) > np.radians(_ODD_TURN_DEG)
    if (
        abs(np.log(flight.focal_px / flight.calibration.focal_px)) > _ODD_FOCAL_CHANGE
        or abs(np.log(max(flight.height_m, 0.1) / flight.calibration.height_m)) > _ODD_HEIGHT_CHANGE
        or tilt_off
    ):
        raise OrthoSwarmError("its pictures cannot be adjusted yet; they are drawn where its receiver says")


def _shifted(state: VehicleState, shift: Array) -> VehicleState:
    """The state with its coarse cameras moved by metres (2,) or (N, 2)."""
    position = state.coarse.position.copy()
    position[:, :2] += shift[: len(position)] if shift.ndim == 2 else shift
    return replace(state, coarse=replace(state.coarse, position=position))
