"""A vehicle that is not found on the map (blank there, or changed) is registered to neighbours that are.

First as a whole: its strips are correlated with a mosaic of the neighbours' pictures, as if that were the map. Then by
its points, which are observed in these pictures, whose cameras are fixed; so relief does not matter. Where there is no
map, vehicles are registered to each other in the same way.
"""

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final

import cv2
import numpy as np

from orthoswarm.model.arrays import Array, Flags, Floats, Gray, Indices, Ints
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, F
from orthoswarm.refine.bundle.priors import Priors
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.registration.absolute_orientation import linkable_points, working_gsd
from orthoswarm.refine.registration.block_state import VehicleState, WorkArea, lies_on_map
from orthoswarm.refine.registration.coarse_registration import CoarseFit, coarse_fits, picture_width_m, shift_cameras
from orthoswarm.refine.registration.orientation_correlation import strip_mosaic
from orthoswarm.refine.registration.tie_points import LINK_CELL_M, LINK_REACH_PX, link_legs
from orthoswarm.refine.surface.vehicle_ground import fit_surface

_BLOCK_PX = 512

_UNFOUND_REACH_PX: Final = 24  # how far points are searched in the neighbours' pictures once strips agree
_UNFOUND_CELL_SHARE: Final = 0.15
"""`link_cell_m` for it is at most this share of a picture's width: low flights have room for few points 40 m apart
(legs of six photos from 40 m had 2 to 4 links)."""
_UNFOUND_SCALES: Final = (1e4, 400.0, 36.0, 9.0, 9.0)  # robust scales of the steps with these links
_UNFOUND_FEWEST: Final = 8  # fewest links that must agree in the end, or the vehicle stays where its receiver says ...
_UNFOUND_LEAST_SHARE: Final = 0.4  # ... and the least share of them
_UNFOUND_AGREES: Final = 0.3  # links with at least this robust weight agree
_UNFOUND_REACH_SHARE: Final = 0.6  # neighbours' pictures are drawn to this share of their diagonal from their cameras
_NEIGHBOUR_SIGMA_PX: Final = 1.5  # sigma of a link to another vehicle, whose cameras do not move, working pixels
_NEIGHBOUR_PICTURES: Final = 2  # most vehicles in which a point is observed, one picture each (cost)
_NEIGHBOUR_REACH_HEIGHTS: Final = 1.2  # other vehicles' cameras within so many flying heights may show its ground
_NEIGHBOUR_EVERY: Final = 2  # every so-manieth of these cameras is used: neighbours in time show the same (cost)


@dataclass(frozen=True, slots=True)
class FixedCameras:
    """Cameras (M) of neighbours that may show a vehicle's ground; they do not move in its adjustment.

    vehicle: int32 (M,), number of their vehicle. gray: picture i at working scale. small: picture i, reduced.
    """

    cameras: CameraBlock
    vehicle: Ints
    gray: Callable[[int], Gray]
    small: Callable[[int], Gray]


def fixed_cameras_near(state: VehicleState, others: Sequence[VehicleState]) -> FixedCameras | None:
    """The neighbours' cameras near a vehicle's path (not all are needed); None where there are none."""
    own = state.flight.adjustment.cameras.position[:, :2]
    reach = _NEIGHBOUR_REACH_HEIGHTS * float(np.median(state.flight.adjustment.cameras.position[:, 2]))
    low, high = own.min(0) - reach, own.max(0) + reach
    parts: list[tuple[VehicleState, Indices]] = []
    for other in others:
        xy = other.flight.adjustment.cameras.position[: len(other.flight.frames), :2]
        within = ((xy > low) & (xy < high)).all(1) & (other.flight.leg >= 0)
        near = np.flatnonzero(within)[::_NEIGHBOUR_EVERY]
        fits = other.on_map if state.on_map else lies_on_map(other) == lies_on_map(state)
        if len(near) and fits:
            parts.append((other, near))
    if not parts:
        return None
    cameras = CameraBlock.joined([o.flight.adjustment.cameras.take(near) for o, near in parts])
    vehicle = np.concatenate([np.full(len(near), k, np.int32) for k, (_, near) in enumerate(parts)])
    where = [(o, int(i)) for o, near in parts for i in near]
    return FixedCameras(
        cameras,
        vehicle,
        lambda j: where[j][0].flight.pictures.gray(where[j][1]),
        lambda j: where[j][0].flight.pictures.small(where[j][1]),
    )


def link_to_fixed(
    flight: FlightBlock, fixed: FixedCameras, gsd_m: float, *, reach_px: int = LINK_REACH_PX,
    pictures: Flags | None = None, cell_m: float | None = None,
) -> int:  # fmt: skip
    """Observe own points in fixed pictures and add these observations; the fixed cameras are appended to the block.

    gsd_m: pixel in which they are compared. reach_px: how far a point is searched there. pictures: bool (N,), own ones
    to compare, None for all. cell_m: one point a leg in each cell of this size, None: as configured.
    """
    adj = flight.adjustment
    n = len(adj.cameras)
    joint = CameraBlock.joined([adj.cameras, fixed.cameras])
    seen, chosen = linkable_points(flight, cell_m or LINK_CELL_M, pictures)
    leg = np.concatenate([flight.leg, int(flight.leg.max()) + 1 + fixed.vehicle]).astype(np.int32)
    candidates = np.arange(n, len(joint))

    def gray(i: int) -> Gray:
        return flight.pictures.gray(i) if i < n else fixed.gray(i - n)

    camera, point, uv = link_legs(
        joint, adj.points, chosen, camera=seen.camera, leg=leg, candidates=candidates, gray=gray, gsd_m=gsd_m,
        most=_NEIGHBOUR_PICTURES, reach=reach_px,
    )  # fmt: skip
    if not len(camera):
        return 0
    tracks = adj.tracks.with_more(camera, point, uv, _NEIGHBOUR_SIGMA_PX)
    free = np.arange(len(joint)) < n
    new = Adjustment.begin(joint, tracks, _padded(adj.priors, fixed.cameras), adj.points, free)
    new.common[: adj.layout.lens_columns] = adj.common[: adj.layout.lens_columns]
    new.common[new.layout.lens_columns :] = adj.common[adj.layout.lens_columns :]
    flight.adjustment = new
    return len(camera)


def remove_fixed(flight: FlightBlock) -> None:
    """Remove the fixed cameras and their observations from a flight's adjustment."""
    adj = flight.adjustment
    n, lenses = len(flight.frames), int(adj.cameras.lens_id[: len(flight.frames)].max()) + 1
    own = adj.tracks.camera < n
    tracks = adj.tracks.take(own)
    cameras = replace(adj.cameras.take(slice(0, n)), lens=adj.cameras.lens[:lenses])
    p = adj.priors
    by_camera = ("position", "position_sigma", "rotation", "rotation_sigma", "velocity", "group")
    own_records = {name: getattr(p, name)[:n] for name in by_camera}
    priors = replace(p, **own_records, lens=p.lens[:lenses], lens_sigma=p.lens_sigma[:lenses])
    new = Adjustment.begin(cameras, tracks, priors, adj.points)
    new.common[: 6 * lenses] = adj.common[: 6 * lenses]
    new.common[6 * lenses :] = adj.common[adj.layout.lens_columns :]
    new.obs_weight[:] = adj.obs_weight[own][np.lexsort((tracks.camera, tracks.point))]
    new.point_inverse[:] = adj.point_inverse
    new.tie_residual = adj.tie_residual
    flight.adjustment = new


def _padded(p: Priors, fixed: CameraBlock) -> Priors:
    """Priors with fixed cameras, which belong to no sortie and whose lenses do not change."""
    cameras, lens = len(fixed), np.column_stack([np.log(fixed.lens[:, 0]), fixed.lens[:, 1:6]])
    return replace(
        p,
        position=np.concatenate([p.position, np.zeros((cameras, 3))]),
        position_sigma=np.concatenate([p.position_sigma, np.full((cameras, 3), np.inf)]),
        rotation=np.concatenate([p.rotation, np.broadcast_to(np.eye(3), (cameras, 3, 3))]),
        rotation_sigma=np.concatenate([p.rotation_sigma, np.full((cameras, 3), np.inf)]),
        velocity=np.concatenate([p.velocity, np.zeros((cameras, 2))]),
        group=np.concatenate([p.group, np.full(cameras, -1)]).astype(np.int32),
        lens=np.concatenate([p.lens, lens]),
        lens_sigma=np.concatenate([p.lens_sigma, np.zeros_like(lens)]),
    )


class FixedCameraMosaic:
    """The pictures of fixed cameras as a map of the ground (placement.MapWindow), drawn where a window is read."""

    def __init__(self, fixed: FixedCameras, epsg: int, origin: Array) -> None:
        self.epsg = epsg
        self._fixed, self._origin = fixed, origin
        lens, height = fixed.cameras.lens[fixed.cameras.lens_id], fixed.cameras.position[:, 2]
        self._reach_m = height * np.hypot(lens[:, WIDTH], lens[:, HEIGHT]) / lens[:, F]
        self.native_gsd_m = float(np.median(height / lens[:, F]))

    @property
    def bounds(self) -> BoundingBox:
        """West, south, east, north of what the cameras may see, in the area's grid."""
        xy = self._fixed.cameras.position[:, :2] + self._origin[:2]
        return BoundingBox.around(np.hstack([xy - self._reach_m[:, None], xy + self._reach_m[:, None]]))

    def gray(self, bounds: BoundingBox, gsd_m: float) -> tuple[Floats, Flags]:
        """Grey values (rows, columns), 0 to 255, and validity of a window."""
        grid = GroundGrid.around(self.epsg, bounds, gsd_m)
        gray, valid = np.zeros((grid.height, grid.width), np.float32), np.zeros((grid.height, grid.width), bool)
        for r in range(0, grid.height, _BLOCK_PX):
            for c in range(0, grid.width, _BLOCK_PX):
                rows, cols = slice(r, min(r + _BLOCK_PX, grid.height)), slice(c, min(c + _BLOCK_PX, grid.width))
                self._draw(grid, rows, cols, gray[rows, cols], valid[rows, cols])
        return gray, valid

    def _draw(self, grid: GroundGrid, rows: slice, cols: slice, gray: Floats, valid: Flags) -> None:
        cameras, gsd = self._fixed.cameras, grid.gsd_m
        west = grid.west + cols.start * gsd - float(self._origin[0])
        north = grid.north - rows.start * gsd - float(self._origin[1])
        high, wide = gray.shape
        x, y = cameras.position[:, 0], cameras.position[:, 1]
        reach = _UNFOUND_REACH_SHARE * self._reach_m
        near = (x > west - reach) & (x < west + wide * gsd + reach)
        near &= (y < north + reach) & (y > north - high * gsd - reach)
        drawn = strip_mosaic(cameras, np.flatnonzero(near), self._fixed.small, 0.0, gsd) if near.any() else None
        if drawn is None:
            return
        seen, known, left, top = drawn
        move = np.array([[1.0, 0.0, (left - west) / gsd], [0.0, 1.0, (north - top) / gsd]])
        gray[:] = cv2.warpAffine(seen, move, (wide, high))
        valid[:] = cv2.warpAffine(known.astype(np.uint8), move, (wide, high), flags=cv2.INTER_NEAREST) > 0


def register_to_neighbours(item: tuple[VehicleState, list[VehicleState]], *, area: WorkArea) -> VehicleState:
    """The vehicle `carried` by neighbours that lie on the map; as it was where they share too little with it."""
    state, others = item
    carried = replace(state, carried=True)  # so that the cameras of neighbours on the map are fixed
    found = _registered(carried, [other for other in others if lies_on_map(other)], area, near_first=False)
    return found or state


def join_neighbours(item: tuple[VehicleState, list[VehicleState]], *, area: WorkArea) -> VehicleState:
    """The vehicle `joined` to neighbours that no map holds either, in one block; as it was where they share too little.

    Receivers without corrections differ by metres, which is farther than links are searched.
    """
    state, others = item
    others = [other for other in others if not lies_on_map(other)]
    found = _registered(state, others, area, near_first=True)
    if found is None:
        return state
    found.joined, found.confidence = True, state.confidence
    found.surface = fit_surface(found.flight.adjustment, found.surface)
    return found


def _registered(
    state: VehicleState, others: list[VehicleState], area: WorkArea, *, near_first: bool
) -> VehicleState | None:
    """A copy of the state where links to the others confirm a guess; near_first: the first guess is where it is."""
    fixed = fixed_cameras_near(state, others)
    if fixed is None:
        return None
    here = CoarseFit(np.zeros((len(state.flight.frames), 2)), [], np.zeros(0, bool), 1.0)
    guesses = coarse_fits(state.flight, FixedCameraMosaic(fixed, area.epsg, area.origin), area.origin)
    try:
        for fit in chain([here] if near_first else [], guesses):
            out = deepcopy(state)
            if _linked(out, fit, others):
                out.flight.pictures.drop()
                return out
        return None
    finally:
        for used in (state, *others):
            used.flight.pictures.drop()


def _linked(state: VehicleState, fit: CoarseFit, others: list[VehicleState]) -> bool:
    """Adjust a vehicle with its points observed in fixed pictures; False where too few of them agree."""
    flight = state.flight
    shift_cameras(flight, fit.correction)
    fixed = fixed_cameras_near(state, others)
    if fixed is None:
        return False
    cell_m = min(LINK_CELL_M, _UNFOUND_CELL_SHARE * picture_width_m(flight))
    found = link_to_fixed(flight, fixed, working_gsd(flight), reach_px=_UNFOUND_REACH_PX, cell_m=cell_m)
    if found < _UNFOUND_FEWEST:
        return False
    adj = flight.adjustment
    for c in _UNFOUND_SCALES:
        adj.step(c, state.surface.height_prior(adj.points))
    linked = adj.tracks.camera >= len(flight.frames)
    agree = int((adj.obs_weight[linked] > _UNFOUND_AGREES).sum())
    if agree < max(_UNFOUND_FEWEST, _UNFOUND_LEAST_SHARE * found):
        return False
    remove_fixed(flight)
    state.confidence = agree / found
    return True
