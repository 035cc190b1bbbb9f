"""The coarse map in flight: pictures of complete legs are adjusted as one block and registered on the map.

On a single straight leg the receiver's drift and the camera's tilt are not separable, so the drift is held there.
Measured on simulated flights with biases and drift: one leg is 2 to 4 m off on the map (up to 12 m, or not found at
all, where the drift is not held), two legs in opposite directions 0.5 to 2 m.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid, local_origin
from orthoswarm.model.placement import Leg, LegState, MapWindow, Solution
from orthoswarm.mosaic.recorded_pose import recorded_cameras
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.flight.sparse_block import open_sparse_flight
from orthoswarm.refine.flight.unsolved_pictures import hovering_vehicles
from orthoswarm.refine.flight.vehicle_refinement import merge_units, split_units
from orthoswarm.refine.flight.weakly_held_pictures import HELD_OBSERVATIONS, observations_per_camera
from orthoswarm.refine.registration.absolute_orientation import confirmed
from orthoswarm.refine.registration.block_state import Stopwatch, VehicleState, WorkArea, to_solution
from orthoswarm.refine.registration.coarse_map import is_coarse
from orthoswarm.refine.registration.coarse_registration import CoarseFit, coarse_fits
from orthoswarm.refine.strategy.vehicle_passes import RefinerOptions, adjust_without_map, adjusted_state, tracked_flight
from orthoswarm.refine.surface.vehicle_ground import GroundModel, fit_surface
from orthoswarm.trajectory.legs import leads_one_way

__all__ = ["coarse_of", "local_origin", "place_in_flight"]

_SPARSE_FEWEST: Final = 4  # fewer photos are not placed in flight
_SPARSE_MOST: Final = 60  # more photos that must be matched in pairs wait for the refinement
_HELD_DRIFT_M: Final = 3.0
"""Sigma of a receiver's drift over one straight run: tilt and drift cannot be separated there. Without this prior
single legs were up to 12 m off on the map or not found; with it 2 to 4 m (simulated flights)."""
_HELD_DRIFT_BEND_M: Final = 0.3  # the same for the second difference of the drift's knots (measured together)
_HELD_LAG_S: Final = 0.2  # the same for the delay of positions behind the shutter (measured together)
_ONE_WAY_SIGMA_SHARE: Final = 0.025  # error of a leg's coarse placement over the height (simulated: 2 to 4 m)
_MANY_WAYS_SIGMA_SHARE: Final = 0.014  # the same with legs in opposite directions (simulated: 0.5 to 2 m)
_ODD_FOCAL_CHANGE: Final = 0.2  # a placement whose focal length left its start by more (logarithm) is not shown
_ODD_HEIGHT_CHANGE: Final = 0.2  # the same for the height
_ODD_TURN_DEG: Final = 12.0  # the same for the attitude where tilt was recorded


def place_in_flight(
    frames: Sequence[Frame],
    *,
    epsg: int,
    origin: Array,
    basemap: MapWindow | None,
    options: RefinerOptions | None = None,
) -> Solution:
    """Coarse placement of a vehicle's pictures so far; without a map they stay in the receiver's frame.

    frames: of finished legs of one vehicle, in order of time, with the turns between them. The solution is of stage
    coarse without state; its legs say how the map holds them (failed where there is none).

    Raises:
        OrthoSwarmError: the block of pictures cannot be adjusted (yet); the message says why.
    """
    if frames and hovering_vehicles(recorded_cameras(frames, LocalGrid(epsg)).placed):
        raise OrthoSwarmError("all its pictures were taken at one spot; they are drawn where its receiver says")
    units = split_units({frames[0].vehicle: frames} if frames else {})
    enough = [unit for unit in units if len(unit) >= _SPARSE_FEWEST]
    area = WorkArea(epsg, origin, basemap)
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
    watch, origin, basemap = Stopwatch(), area.origin, area.basemap
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
    found = None
    if basemap is not None and not is_coarse(flight, basemap):
        found = confirmed(flight, coarse_fits(flight, basemap, origin), basemap, origin, surface)
    flight.pictures.drop()
    if found is not None:
        state.false_matches = found.false_matches
        share = _ONE_WAY_SIGMA_SHARE if one_way else _MANY_WAYS_SIGMA_SHARE
        state = _shifted(state, found.fit.correction)
        state.coarse_sigma_m = np.minimum(np.hypot(share * flight.height_m, _scatter(found.fit)), state.coarse_sigma_m)
    legs = _legs(state, None if found is None else found.fit)
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


def _scatter(fit: CoarseFit) -> float:
    """Median distance of the agreeing windows' shifts from the correction, metres."""
    off = [
        np.hypot(*(np.asarray(m.shift) - fit.correction[(m.first + m.last) // 2]))
        for m, ok in zip(fit.matches, fit.inlier, strict=True)
        if ok
    ]
    return float(np.median(off))


def _legs(state: VehicleState, fit: CoarseFit | None) -> list[Leg]:
    """Legs most of whose strips agree on a place on the map are matched, the others are carried by them.

    Where no leg has so many by itself, those with any are matched. Where there is no place on a map, all failed.
    """
    leg = state.flight.leg
    legs = [np.flatnonzero(leg == k) for k in range(int(leg.max()) + 1 if len(leg) else 0)]
    share = [0.0 if fit is None else _agreeing_windows(fit, int(own[0]), int(own[-1])) for own in legs]
    least = 0.5 if max(share, default=0.0) > 0.5 else 0.0
    out = []
    for own, part in zip(legs, share, strict=True):
        how: LegState = "failed" if fit is None else "matched" if part > least else "carried"
        sigma = float(np.median(state.coarse_sigma_m[own]))
        out.append(Leg.of(state.flight.frames, own, how, part, sigma))
    return out


def _agreeing_windows(fit: CoarseFit, first: int, last: int) -> float:
    """Share of the windows with pictures of a leg that agree with the registration; 0 where it has none."""
    mine = [ok for m, ok in zip(fit.matches, fit.inlier, strict=True) if m.first <= last and m.last >= first]
    return sum(map(bool, mine)) / len(mine) if mine else 0.0
