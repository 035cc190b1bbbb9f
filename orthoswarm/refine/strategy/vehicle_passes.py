"""The first pass of one vehicle: its block adjusted without a map, then registered on the map."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Gray
from orthoswarm.model.camera import fov_rad
from orthoswarm.model.errors import AdjustmentError
from orthoswarm.model.frame import Frame
from orthoswarm.model.placement import MapWindow
from orthoswarm.model.task_runner import Continued, whole
from orthoswarm.raster.grey_pictures import WORK_WIDTH_PX
from orthoswarm.raster.height_model import HeightModel
from orthoswarm.raster.picture_file import read_gray, reduction
from orthoswarm.refine.bundle.adjustment import TIE_ROBUST_C, TRACK_ROBUST_C, Adjustment
from orthoswarm.refine.bundle.block_arrays import WIDTH, F
from orthoswarm.refine.bundle.covariance import receiver_sigma, stated_errors
from orthoswarm.refine.bundle.height_consistency import (
    FreeHeight,
    contradicted_heights,
    height_disagreement,
    predicted_height_offset,
    release_heights,
)
from orthoswarm.refine.features.working_pictures import ReadGray
from orthoswarm.refine.flight.kept_tracks import KeptTracks
from orthoswarm.refine.flight.record_findings import contradiction
from orthoswarm.refine.flight.relative_block import (
    FEW_PHOTOS,
    INLIER_WEIGHT,
    FlightBlock,
    distorts_strongly,
    free_full_lens,
    open_flight,
    weigh_records,
)
from orthoswarm.refine.flight.sparse_block import open_sparse_flight
from orthoswarm.refine.registration.absolute_orientation import (
    TIE_REACH_M,
    add_links,
    confirmed,
    evidence_log10,
    orient_on_map,
    tie_half_m,
    working_gsd,
)
from orthoswarm.refine.registration.block_state import Stopwatch, VehicleState, WorkArea
from orthoswarm.refine.registration.coarse_map import is_coarse
from orthoswarm.refine.registration.coarse_registration import CoarseFit, coarse_fits, learned_fit
from orthoswarm.refine.registration.map_offset import had_corrections
from orthoswarm.refine.registration.tie_points import MapMatches
from orthoswarm.refine.strategy.joined_vehicles import TAKEOFF_LEVEL_SIGMA_M
from orthoswarm.refine.surface.dem_surface import LocalDem
from orthoswarm.refine.surface.vehicle_ground import GroundModel, fit_surface
from orthoswarm.stores.local_copies import copy_ahead
from orthoswarm.trajectory.legs import leads_one_way

SIGMA_FLOOR_M: Final = 0.05  # least sigma of a photo on the ground where no map tells it
START_FOV_DEG: Final = 80.0  # horizontal field of view to start from where no tag hints at one
_FULL_LENS_STEPS: Final = 4  # steps at the last scale more where all parameters of a lens are solved
_RECORDS_WEIGHED_STEP: Final = 3  # from this step, from 0, records are weighed and the ground fitted (nearly converged)
_FIRST_STEPS: Final = 2  # steps, from the first, with the wide height prior of the next two fields ...
_FIRST_GROUND_SIGMA_M: Final = 3.0  # sigma of points about the expected ground in these steps
_FIRST_GROUND_ROBUST_C: Final = 1e3  # robust scale of that prior, squared sigmas: nearly none
_GROUND_SIGMA_M: Final = 2.0  # the sigma in all later steps
_GROUND_ROBUST_C: Final = 1.0  # the robust scale in all later steps, squared sigmas
_FLOW_PAIRS: Final = 6  # fewest pairs of pictures whose focal length by flow an adjustment is compared with
_RUNAWAY_SHARE: Final = 0.15
"""An adjustment whose focal length differs from that of the flow by this share has found another minimum and is
rejected, unless the flow itself is that uncertain (next field)."""
_RUNAWAY_SIGMAS: Final = 5.0  # ... and by so many of its sigmas
_SOLVED_INLIERS: Final = 0.7
"""Least share of a tracked flight's observations that fit its adjustment. Of 17 flights, four without heights over
relief of 25 m ended elsewhere, with 0.00 to 0.40; the others have 0.93 to 0.98. Those four are right when matched in
pairs."""
_NARROWEST_FOV_DEG: Final = 33.0  # recorded heights are rejected if they lead to a horizontal field of view below this
_WIDEST_FOV_DEG: Final = 137.0  # ... or above this; a little above the widest that is accepted from flow
_REST_STEPS: Final = 3  # steps after which a contradiction must still be there
_FREE_STEPS: Final = 6  # steps of a round without the recorded heights
_FREE_ROUNDS: Final = 4  # rounds without the recorded heights at most
_SCHEDULE: Final = (100.0, 100.0, 100.0, 100.0, 9.0, 9.0)
"""Robust scales of the steps without a map, squared, of normalised residuals. Starts are near enough for 10 sigmas
(recorded poses, focal length by optical flow); two first steps at 1e4 gave the same accuracy on 31 runs of small
flights and on 1,017 photos, and wrong tracks could carry the focal length away (docs/method.md)."""
_MAP_FOV_SIGMAS: Final = 6.0  # a registration that changes the field of view by more sigmas is doubted ...
_MAP_FOV_DEG: Final = 4.0  # ... and by more than this
_NEW_EVIDENCE: Final = 2.0
"""A doubted registration is right if the tie points of the flight as it then lies speak for it so many times as much
as the first ones (logarithms). A wrong lens tag of 30 photos (73 instead of 41 degrees): 10^-124 after 10^-8."""
_LEG_LINK_STEPS: Final = 6  # steps of a flight without a map once its legs are linked to each other
_NO_HEIGHT_SHARE: Final = 0.03  # sigma of focal lengths without a height, a share (15 flights: 2.5 % rms)
_ONE_WAY_FOV_SIGMA_DEG: Final = 5.0  # the same for photos on one straight line (11 such legs: 5.6 rms)
_DECENTRED_SHARE: Final = 0.02
"""What tangential distortion, which is not modelled, does to the focal length of a strong lens, a share (measured: 1.6
%)."""


@dataclass(frozen=True, slots=True)
class RefinerOptions:
    """How the refiner works.

    dem: given height model, None to find the ground. read: reads a frame's grey picture; picklable. kept: where tracks
    are kept for a refinement of the same pictures, None if they are not. device: where networks run.
    """

    dem: HeightModel | None = None
    read: ReadGray = field(default_factory=lambda: read_frame)
    kept: KeptTracks | None = None
    device: str = "auto"

    def ground(self, origin: Array) -> GroundModel:
        """The ground before any picture is used, in the local frame: level, or the given height model."""
        if self.dem is None:
            return GroundModel()
        return GroundModel(dem=LocalDem(self.dem, (float(origin[0]), float(origin[1]))))


def read_frame(frame: Frame) -> Gray:
    """A frame's grey picture, reduced while it is decoded where it is larger than what the refinement works on."""
    return read_gray(frame.path, reduction(frame.width, frame.height, WORK_WIDTH_PX))


def refine_alone(frames: Sequence[Frame], *, area: WorkArea, options: RefinerOptions) -> VehicleState:
    """Refine one vehicle by itself: relative adjustment, then onto the map where there is one."""
    state = whole(partial(refine_tracked, area=area, options=options), frames)
    if state is None:
        watch = Stopwatch()
        flight = open_sparse_flight(frames, area.grid, area.origin, options.read)
        watch.lap("tracks")
        state = refine_matched(flight, area=area, options=options)
        watch.add_to(state.timings)
    return registered_by((state, learned_registration(state, area)), area=area) if state.unfound else state


def refine_tracked(
    frames: Sequence[Frame], *, area: WorkArea, options: RefinerOptions
) -> VehicleState | Continued[VehicleState | None] | None:
    """Refine one vehicle by itself, with corners tracked from picture to picture; continued on the map, if any.

    None where the pictures cannot be tracked or the adjustment of the tracks fails; they are then matched in pairs.
    """
    watch = Stopwatch()
    copy_ahead(f.path for f in frames)
    flight = tracked_flight(frames, area, options)
    watch.lap("tracks")
    if flight is None:
        return None
    try:
        surface = adjust_without_map(flight, options.ground(area.origin))
        if area.basemap is None:
            surface = link_own_legs(flight, surface)
        if not _NARROWEST_FOV_DEG < field_of_view_deg(flight.adjustment, flight) < _WIDEST_FOV_DEG:
            return None  # a recorded height that leads to such a lens is wrong
        if len(frames) < FEW_PHOTOS and distorts_strongly(flight):
            return None  # too few corners for all parameters of such a lens; photos matched in pairs have more
        state = adjusted_state(flight, surface, watch)
    except AdjustmentError:
        return None
    return Continued(partial(_registered, area=area), (state, flight.pictures.reduced()))


def _registered(item: tuple[VehicleState, dict[int, Gray]], *, area: WorkArea) -> VehicleState | None:
    """The second half of `refine_tracked`; item: the state, and its reduced pictures, which it does not take along."""
    state, reduced = item
    state.flight.pictures.restore(reduced, {})
    try:
        register_on_map(state, area)
    except AdjustmentError:
        return None
    return state


def tracked_flight(frames: Sequence[Frame], area: WorkArea, options: RefinerOptions) -> FlightBlock | None:
    """A vehicle's pictures with corners tracked from one to the next, see `open_flight`."""
    hints = [f.fov_hint_rad for f in frames if f.fov_hint_rad is not None]
    start = float(np.median(hints)) if hints else float(np.radians(START_FOV_DEG))
    return open_flight(frames, area.grid, area.origin, options.read, start, kept=options.kept)


def refine_matched(flight: FlightBlock, *, area: WorkArea, options: RefinerOptions) -> VehicleState:
    """Refine one vehicle whose photos were matched in pairs and adjusted together with those of others."""
    state = adjusted_state(flight, fit_surface(flight.adjustment, options.ground(area.origin)), Stopwatch())
    register_on_map(state, area)
    return state


def adjusted_state(flight: FlightBlock, surface: GroundModel, watch: Stopwatch) -> VehicleState:
    """The state of a vehicle that is adjusted without a map, with its sigmas."""
    adj = flight.adjustment
    belief = surface.height_prior(adj.points)
    stated = stated_errors(adj, TRACK_ROBUST_C, belief, ties=None, tie_c=TIE_ROBUST_C, floor_m=SIGMA_FLOOR_M)
    watch.lap("relative")
    return VehicleState(
        vehicle=flight.frames[0].vehicle,
        flight=flight,
        coarse=adj.cameras.copy(),
        surface=surface,
        sigma_m=stated.sigma_m,
        coarse_sigma_m=stated.sigma_m,
        receiver_sigma_m=receiver_sigma(adj),
        fov_sigma_deg=stated.fov_sigma_deg,
        pose_covariance=stated.pose,
        coarse_surface=surface,
        timings=dict(watch.seconds),
    )


def register_on_map(state: VehicleState, area: WorkArea) -> None:
    """Register an adjusted vehicle on the map, if any, and free its pictures' memory."""
    flight, watch, basemap, origin = state.flight, Stopwatch(), area.basemap, area.origin
    if basemap is not None:
        state.had_map = not (is_coarse(flight, basemap) and had_corrections(flight.frames))
    if basemap is not None and not is_coarse(flight, basemap):
        state.unfound = not _onto_map(state, coarse_fits(flight, basemap, origin), basemap, origin, watch)
    flight.pictures.drop()
    watch.add_to(state.timings)


def adjust_without_map(flight: FlightBlock, surface: GroundModel | None = None) -> GroundModel:
    """Adjust a tracked flight without a map and fit its ground; returns the ground.

    surface: what is known of the ground before, None for level ground.

    Raises:
        AdjustmentError: it does not fit its observations, so it has converged to something else than the truth.
    """
    surface = surface or GroundModel()
    begun = flight.adjustment.copy()
    found = adjust_by_schedule(flight, surface)
    if focal_length_ran_away(flight):  # begin again with the focal length by optical flow as its prior
        flight.adjustment = begun
        p = flight.adjustment.priors
        sigma = p.lens_sigma.copy()
        sigma[:, 0] = flight.calibration.focal_sigma
        flight.adjustment.priors = replace(p, lens_sigma=sigma)
        found = adjust_by_schedule(flight, surface)
    found = _without_wrong_heights(flight, found)
    inliers = float((flight.adjustment.obs_weight > INLIER_WEIGHT).mean())
    if inliers < _SOLVED_INLIERS:
        raise AdjustmentError(f"only {inliers:.0%} of the observations fit the adjustment")
    return found


def link_own_legs(flight: FlightBlock, surface: GroundModel) -> GroundModel:
    """Observe points of each leg in pictures of the others and adjust again; returns the ground.

    Corners are followed from picture to picture only: without a map nothing else holds the legs together, and what
    tracks and receiver drift by along the way bends and scales the block.
    """
    if not add_links(flight, working_gsd(flight)):
        return surface
    return _steps(flight, surface, _LEG_LINK_STEPS)[0]


def field_of_view_deg(adjustment: Adjustment, flight: FlightBlock) -> float:
    """Horizontal field of view of a flight's first lens, degrees."""
    return float(np.degrees(fov_rad(float(adjustment.cameras.lens[0, F]), flight.pictures.size[0])))


def focal_length_ran_away(flight: FlightBlock) -> bool:
    """Whether the focal length is far from the one by optical flow: the adjustment converged to another minimum."""
    flow = flight.calibration
    if flow.pairs < _FLOW_PAIRS or not flow.trusted_height or not np.isfinite(flow.spread):
        return False
    away = abs(float(np.log(flight.adjustment.cameras.lens[0, F] / flow.focal_px)))
    return away > max(_RUNAWAY_SHARE, _RUNAWAY_SIGMAS * flow.focal_sigma)


def adjust_by_schedule(flight: FlightBlock, surface: GroundModel) -> GroundModel:
    """Adjust a tracked flight by the steps of `_SCHEDULE`; returns the ground fitted to its points."""
    schedule = list(_SCHEDULE)
    wide, narrow = (_FIRST_GROUND_SIGMA_M, _FIRST_GROUND_ROBUST_C), (_GROUND_SIGMA_M, _GROUND_ROBUST_C)
    for k, c in enumerate(schedule):
        prior = wide if k < _FIRST_STEPS else narrow
        flight.adjustment.step(c, surface.height_prior(flight.adjustment.points, *prior))
        if k == _RECORDS_WEIGHED_STEP:
            weigh_records(flight)
            if free_full_lens(flight):
                schedule += [TRACK_ROBUST_C] * _FULL_LENS_STEPS
        if k >= _RECORDS_WEIGHED_STEP:
            surface = fit_surface(flight.adjustment, surface)
    return surface


def _without_wrong_heights(flight: FlightBlock, surface: GroundModel) -> GroundModel:
    """Drop recorded heights that the pictures contradict; keep them where the pictures alone determine no height.

    The contradiction must remain once the adjustment has converged, and the adjustment without the heights must confirm
    it (`FreeHeight.refutes_record`).
    """
    if not flight.records.has_height.any() or not contradicted_heights(flight.adjustment).any():
        return surface
    surface, _ = _steps(flight, surface, _REST_STEPS)
    with_heights, calibration, ground_with_heights = flight.adjustment.copy(), flight.calibration, surface
    predicted = predicted_height_offset(flight.adjustment)
    if not release_heights(flight.adjustment).any():
        return surface
    flight.calibration = replace(calibration, trusted_height=False)
    for _ in range(_FREE_ROUNDS):
        surface, focal_px = _steps(flight, surface, _FREE_STEPS)
        free = FreeHeight(
            focal_px=focal_px,
            recorded_m=float(np.median(flight.records.position[flight.records.has_height, 2])),
            solved_m=float(np.median(flight.adjustment.cameras.position[:, 2])) - surface.level_m,
            predicted=predicted,
        )
        if free.converged:
            break
    if not free.refutes_record:
        flight.adjustment, flight.calibration = with_heights, calibration
        return ground_with_heights
    flight.warnings.append(contradiction(flight.frames[0].vehicle, free.recorded_m, free.solved_m))
    return surface


def _steps(flight: FlightBlock, surface: GroundModel, count: int) -> tuple[GroundModel, list[float]]:
    """Take steps at the final robust scale; the ground, and the focal length in pixels after each step."""
    focal_px = []
    for _ in range(count):
        flight.adjustment.step(TRACK_ROBUST_C, surface.height_prior(flight.adjustment.points))
        surface = fit_surface(flight.adjustment, surface)
        focal_px.append(float(flight.adjustment.cameras.lens[0, F]))
    return surface, focal_px


def learned_registration(state: VehicleState, area: WorkArea) -> CoarseFit | None:
    """The coarse registration of a flight by learned matching; None where that finds nothing.

    PyTorch and the network take 400 MB of a process's memory: one process serves all flights, one after the other.
    """
    watch = Stopwatch()
    fit = None if area.basemap is None else learned_fit(state.flight, area.basemap, area.origin, area.device)
    state.flight.pictures.drop()
    watch.lap("coarse registration")
    watch.add_to(state.timings)
    return fit


def registered_by(item: tuple[VehicleState, CoarseFit | None], *, area: WorkArea) -> VehicleState:
    """A flight registered by the result of `learned_registration`, if tie points confirm that."""
    state, fit = item
    watch = Stopwatch()
    state.unfound = False
    if fit is not None and area.basemap is not None:
        _onto_map(state, [fit], area.basemap, area.origin, watch)
    state.flight.pictures.drop()
    watch.add_to(state.timings)
    return state


def _onto_map(
    state: VehicleState, fits: Iterable[CoarseFit], basemap: MapWindow, origin: Array, watch: Stopwatch
) -> bool:
    """Register a flight at the first coarse registration that tie points confirm; whether one was confirmed.

    The flight stays as it was where the confirmed one would need another field of view than its pictures alone gave and
    its new tie points do not prove that: tags may have misled the pictures, no tag makes the map agree.
    """
    flight = state.flight
    before, ground_alone, sigma = flight.adjustment.copy(), state.surface, state.fov_sigma_deg
    found = confirmed(flight, fits, basemap, origin, state.surface)
    watch.lap("coarse registration")
    if found is None:
        return False
    settled = orient_on_map(flight, found.ground, found.matches, state.surface)
    alone_deg, now_deg = (field_of_view_deg(a, flight) for a in (before, flight.adjustment))
    known_deg = float(np.hypot(sigma, level_sigma_deg(flight, ground_alone)))
    doubted = abs(now_deg - alone_deg) > max(_MAP_FOV_SIGMAS * known_deg, _MAP_FOV_DEG)
    if doubted and not _proven(flight, settled.matches, found.false_matches):
        flight.adjustment = before
        flight.warnings.append(
            f"on the map its field of view would be {now_deg:.0f} degrees, by its own pictures it is {alone_deg:.0f}: "
            "the place found on the map is rejected"
        )
        return True
    state.map_shift = found.fit.correction
    state.surface, state.ties = settled.surface, settled.ties
    state.matches, state.roofs = settled.matches, settled.roofs
    state.on_map, state.confidence, state.false_matches = True, found.fit.confidence, found.false_matches
    watch.lap("ties and absolute")
    return True


def _proven(flight: FlightBlock, matches: MapMatches, false_matches: float) -> bool:
    """Whether new tie points of a flight that lies on the map speak for its place more than the first ones did.

    matches: the new ones. false_matches: expected number of false matches behind the first.
    """
    first = float(np.log10(max(false_matches, float(np.finfo(float).tiny))))
    return evidence_log10(flight, matches, tie_half_m(flight), TIE_REACH_M) <= _NEW_EVIDENCE * first


def level_sigma_deg(flight: FlightBlock, surface: GroundModel) -> float:
    """Sigma of the field of view, degrees, by what the adjustment does not model.

    - The takeoff point is not at the ground's median level. In nadir views of flat ground only f / h is observable, so
      the error of the level is one of f; it grows with the relief.
    - Recorded heights may be wrong, by as much as the pictures disagree with them.
    - Without heights only relief and tilt determine f; on one straight leg nothing does.
    - A lens that was solved with other vehicles is held, and has the sigma of that solution.
    - A lens that distorts strongly has tangential distortion, too, which is not modelled.
    """
    unknown = flight.sparse or not flight.records.has_height.any()
    if unknown and not flight.calibration.trusted_height and leads_one_way(flight.records.position, flight.leg):
        return _ONE_WAY_FOV_SIGMA_DEG
    cameras = flight.cameras()
    share = float(np.hypot(flight.focal_sigma, _DECENTRED_SHARE if distorts_strongly(flight) else 0.0))
    if flight.calibration.trusted_height and flight.records.has_height.any():
        relief = 0.0 if surface.fit is None else surface.fit.sd_m
        level = float(np.hypot(TAKEOFF_LEVEL_SIGMA_M, relief)) / max(float(np.median(cameras.position[:, 2])), 1.0)
        share = float(np.linalg.norm([share, level, height_disagreement(flight.adjustment)]))
    elif not flight.sparse:
        share = float(np.hypot(share, _NO_HEIGHT_SHARE))
    half = 0.5 * fov_rad(float(cameras.lens[0, F]), int(cameras.lens[0, WIDTH]))
    return float(np.degrees(np.sin(2 * half))) * share
