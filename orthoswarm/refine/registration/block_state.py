"""The state of a vehicle's block between the passes of the refiner, and its conversion to a Solution."""

from dataclasses import dataclass, field, replace
from time import process_time
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.camera import fov_rad
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import Leg, LegState, MapWindow, PlacedFrame, Solution, Stage, Terrain
from orthoswarm.refine.bundle.adjustment import MapTies
from orthoswarm.refine.bundle.block_arrays import CX, CY, WIDTH, CameraBlock, F
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.flight.weakly_held_pictures import weakly_held
from orthoswarm.refine.registration.absolute_orientation import TIE_REACH_M
from orthoswarm.refine.registration.coarse_map import CoarseMapShift
from orthoswarm.refine.registration.map_evidence import agreement_probability
from orthoswarm.refine.registration.tie_points import MapMatches
from orthoswarm.refine.surface.vehicle_ground import GroundModel, ground_points

NOT_FOUND = (
    "no part of this flight was found on the map: it lies where its receiver says; check that the map shows this place"
)
CARRIED = "the map does not show what this flight saw; pictures of its neighbours carry it"
SHIFTED = (
    "the map's pixel is {gsd_m:.0f} m: the flight was shifted onto it as a whole, good to {sigma_m:.1f} m (one sigma "
    "of each axis); a map of 2 m or finer places it within decimetres"
)

_LEG_BY_CHANCE: Final = 0.01  # a leg is matched if chance agrees as well with this probability only
_LEG_AGREES_M: Final = 1.2  # a tie point whose residual is below this agrees with its leg's place


@dataclass(frozen=True, slots=True)
class WorkArea:
    """Where vehicles are refined: the grid, the origin (2,) of the local frame, and the map on the grid, or None.

    device: where networks run.
    """

    epsg: int
    origin: Array
    basemap: MapWindow | None
    device: str = "auto"

    @property
    def grid(self) -> LocalGrid:
        """The area's grid."""
        return LocalGrid(self.epsg)


@dataclass(slots=True, kw_only=True)
class VehicleState:
    """One vehicle between passes; it can be pickled, without its decoded pictures.

    Attributes:
        coarse: cameras before the map was used; coarse_surface: the ground below them, in the same frame.
        surface: its ground. ties, matches: of the last round (empty without a map). roofs: raised points on the map and
            their heights. map_shift: float64 (N, 2) or (2,), what the coarse registration added to the coarse cameras.
        dense: extra ground points (K, 3) and sigmas (K,). high: points (H, 3) on what stands high above the ground.
        had_map: whether there is a map. on_map: whether it was found there; unfound: learned matching is still to be
            tried. carried: neighbours that were found carry it. joined: no map holds it, but neighbours alike do.
        coarse_shift: how its block was shifted onto a map of far coarser pixels, None if it was not.
        sigma_m: float64 (N,) own error estimates, coarse_sigma_m before the map. receiver_sigma_m: float64 (2,) of its
            place by its receiver alone, east and north. datum_sigma_m: float64 (N,) of the place of a block that no map
            holds, by all its receivers; None for one alone.
        false_matches: expected number of agreements with a map of other ground as good as the one that put it there.
        map_distortion_m2: variance of an axis of the map's own local distortion as its ties show it, as far as it is
            more than the error that all ties have in common; NaN without ties.
        pose_covariance: float32 (N, 6, 6) of the adjusted cameras, see bundle.covariance.StatedErrors.
        fov_sigma_deg: of the field of view. timings: stage -> CPU seconds.
    """

    vehicle: str
    flight: FlightBlock
    coarse: CameraBlock
    surface: GroundModel
    coarse_surface: GroundModel
    sigma_m: Array
    coarse_sigma_m: Array
    receiver_sigma_m: Array
    fov_sigma_deg: float
    ties: MapTies = field(default_factory=MapTies.none)
    matches: MapMatches = field(default_factory=MapMatches.none)
    roofs: tuple[MapMatches, Array] = field(default_factory=lambda: (MapMatches.none(), np.zeros(0)))
    dense: tuple[Array, Array] = field(default_factory=lambda: (np.zeros((0, 3)), np.zeros(0)))
    on_map: bool = False
    confidence: float = 0.0
    pose_covariance: Floats | None = None
    timings: dict[str, float] = field(default_factory=dict)
    had_map: bool = False
    carried: bool = False
    joined: bool = False
    coarse_shift: CoarseMapShift | None = None
    datum_sigma_m: Array | None = None
    map_shift: Array = field(default_factory=lambda: np.zeros(2))
    high: Array = field(default_factory=lambda: np.zeros((0, 3)))
    unfound: bool = False
    false_matches: float = float("nan")
    map_distortion_m2: float = float("nan")


def lies_on_map(state: VehicleState) -> bool:
    """Whether a vehicle lies in the map's frame, found on it, alone or as part of a block, or carried by others."""
    return state.on_map or state.carried or state.coarse_shift is not None


def findings(state: VehicleState) -> list[str]:
    """Warnings about a vehicle: findings of its records, and how it was registered."""
    shift = state.coarse_shift
    if state.carried:
        return [*state.flight.warnings, CARRIED]
    if shift is not None:
        return [*state.flight.warnings, SHIFTED.format(gsd_m=shift.gsd_m, sigma_m=shift.sigma_m)]
    return [*state.flight.warnings, *([NOT_FOUND] if state.had_map and not state.on_map else [])]


class Stopwatch:
    """CPU seconds by name, added up."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = process_time()

    def lap(self, name: str) -> None:
        """Add the CPU time since the last lap to a name."""
        now = process_time()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now

    def add_to(self, timings: dict[str, float]) -> None:
        """Add what was measured to others' times."""
        for name, seconds in self.seconds.items():
            timings[name] = timings.get(name, 0.0) + seconds


def to_solution(
    state: VehicleState, origin: Array, terrain: Terrain | None, *, coarse: bool = False,
    map_lean: tuple[float, float] = (0.0, 0.0), ground_z_m: float = 0.0,
) -> Solution:  # fmt: skip
    """The state as a Solution on the area's grid (full-resolution lenses); coarse takes the cameras before the map."""
    flight = state.flight
    cameras = full_resolution(state.coarse if coarse else flight.adjustment.cameras, flight)
    stage: Stage = "coarse" if coarse or not lies_on_map(state) else "fine"
    sigma = state.coarse_sigma_m if coarse else state.sigma_m
    covariance = None if coarse else state.pose_covariance
    weak = weakly_held(flight)
    placed = [
        PlacedFrame(
            frame, cameras.camera(i, origin), stage, float(sigma[i]), bool(weak[i]),
            pose_covariance=None if covariance is None else covariance[i],
        )
        for i, frame in enumerate(flight.frames)
        if i not in flight.pictures.damaged
    ]  # fmt: skip
    points, _ = ground_points(flight.adjustment)
    heights = flight.cameras().position[:, 2]  # of one state with the points, also where `cameras` are those before
    above_m = heights.mean() - points[:, 2].mean() if len(points) else np.nan
    return Solution(
        vehicle=state.vehicle,
        placed=placed,
        dropped={flight.frames[i].image: reason for i, reason in flight.pictures.damaged.items()},
        legs=leg_states(state),
        fov_deg=float(np.degrees(fov_rad(flight.focal_px, flight.pictures.size[0]))),
        fov_sigma_deg=state.fov_sigma_deg,
        terrain=terrain,
        ground_z_m=ground_z_m,
        map_lean=map_lean,
        state=state,
        warnings=findings(state),
        timings=dict(state.timings),
        gsd_m=float(above_m / cameras.lens[0, F]),
        false_matches=state.false_matches,
    )


def full_resolution(cameras: CameraBlock, flight: FlightBlock) -> CameraBlock:
    """Cameras whose lenses are in pixels of the stored pictures instead of working pixels."""
    frame = flight.frames[0]
    scale = frame.width / flight.pictures.size[0]
    lens = cameras.lens.copy()
    lens[:, [F, CX, CY]] *= scale
    lens[:, WIDTH], lens[:, WIDTH + 1] = frame.width, frame.height
    return replace(cameras, lens=lens)


def leg_states(state: VehicleState) -> list[Leg]:
    """How the map held each leg.

    Matched: tie points of its own agree with its place more often than by chance. Where that holds for no leg alone
    (few photos a leg) but for all ties together, the legs whose ties agree; and all of a block that was shifted onto a
    coarse map. Carried: the others beside matched ones, of the vehicle itself or of neighbours. Failed: all others.
    """
    flight = state.flight
    residual = flight.adjustment.tie_residual
    leg_of_tie = flight.leg[state.matches.camera]
    agrees = np.ones(len(leg_of_tie), bool)
    if len(residual) == len(leg_of_tie):
        agrees = np.hypot(*residual.T) < _LEG_AGREES_M
    count = int(flight.leg.max()) + 1 if len(flight.leg) else 0
    ties = [int((leg_of_tie == k).sum()) for k in range(count)]
    agree = [int((agrees & (leg_of_tie == k)).sum()) for k in range(count)]
    chance = [agreement_probability(a, n, _LEG_AGREES_M, TIE_REACH_M) for a, n in zip(agree, ties)]
    matched = [state.on_map and p <= _LEG_BY_CHANCE for p in chance]
    if state.coarse_shift is not None:
        matched = [True] * count
    if state.on_map and not any(matched):
        matched = [2 * a > n for a, n in zip(agree, ties)] if sum(agree) else [True] * count
    other: LegState = "carried" if lies_on_map(state) else "failed"
    out = []
    for k in range(count):
        members = np.flatnonzero(flight.leg == k)
        how: LegState = "matched" if matched[k] else other
        share = agree[k] / max(ties[k], 1) if matched[k] else 0.0
        if state.coarse_shift is not None:
            share = state.coarse_shift.confidence
        out.append(Leg.of(flight.frames, members, how, share, float(np.median(state.sigma_m[members]))))
    return out
