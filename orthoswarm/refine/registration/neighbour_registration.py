"""A vehicle that is not found on the map (blank there, or changed) is registered to neighbours that are.

Where there is no map, vehicles are registered to each other in the same way.

First as a whole: its strips are correlated with a mosaic of the neighbours' pictures, as if that were the map. Then by
its points, which are observed in these pictures, whose cameras are fixed; so relief does not matter.
"""

from copy import deepcopy
from dataclasses import replace
from itertools import chain
from typing import Final

import cv2
import numpy as np

from orthoswarm.config import active
from orthoswarm.model.arrays import Array, Flags, Floats
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.refine.registration.absolute_orientation import working_gsd
from orthoswarm.refine.registration.block_state import VehicleState, lies_on_map
from orthoswarm.refine.registration.coarse_registration import (
    CoarseFit,
    coarse_fits,
    picture_width_m,
    shift_cameras,
)
from orthoswarm.refine.registration.neighbour_ties import FixedCameras, fixed_cameras_near, link_to_fixed, remove_fixed
from orthoswarm.refine.registration.orientation_correlation import strip_mosaic
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


class FixedCameraMosaic:
    """The pictures of fixed cameras as a map of the ground (placement.MapWindow), drawn where a window is read."""

    def __init__(self, fixed: FixedCameras, epsg: int, origin: Array) -> None:
        self.epsg = epsg
        self._fixed, self._origin = fixed, origin
        cameras = fixed.cameras
        focal = cameras.lens[cameras.lens_id, 0]
        self._reach_m = (
            cameras.position[:, 2]
            * np.hypot(cameras.lens[cameras.lens_id, 6], cameras.lens[cameras.lens_id, 7])
            / focal
        )
        self.native_gsd_m = float(np.median(cameras.position[:, 2] / focal))

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
        near = (
            (x > west - reach)
            & (x < west + wide * gsd + reach)
            & (y < north + reach)
            & (y > north - high * gsd - reach)
        )
        drawn = strip_mosaic(cameras, np.flatnonzero(near), self._fixed.small, 0.0, gsd) if near.any() else None
        if drawn is None:
            return
        seen, known, left, top = drawn
        move = np.array([[1.0, 0.0, (left - west) / gsd], [0.0, 1.0, (north - top) / gsd]])
        gray[:] = cv2.warpAffine(seen, move, (wide, high))
        valid[:] = cv2.warpAffine(known.astype(np.uint8), move, (wide, high), flags=cv2.INTER_NEAREST) > 0


def register_to_neighbours(item: tuple[VehicleState, list[VehicleState]], *, epsg: int, origin: Array) -> VehicleState:
    """Register a vehicle that was not found on the map to neighbours that lie on it.

    Args:
        item: the vehicle, and neighbours.
        epsg: the area's grid. origin: float64 (2,) of the local frame.

    Returns:
        A state that is `carried`; the same one where the neighbours' pictures share too little with it.
    """
    state, others = item
    carried = replace(state, carried=True)  # so that the cameras of neighbours on the map are fixed
    found = _registered(carried, [other for other in others if lies_on_map(other)], epsg, origin, near_first=False)
    return found or state


def join_neighbours(item: tuple[VehicleState, list[VehicleState]], *, epsg: int, origin: Array) -> VehicleState:
    """Register a vehicle that no map holds to neighbours that none holds either, so that they make one block.

    Receivers without corrections differ by metres, which is farther than links are searched. Arguments as above.

    Returns:
        A state that is `joined`; the same one where the neighbours' pictures share too little with it.
    """
    state, others = item
    others = [other for other in others if not lies_on_map(other)]
    found = _registered(state, others, epsg, origin, near_first=True)
    if found is None:
        return state
    found.joined, found.confidence = True, state.confidence
    found.surface = fit_surface(found.flight.adjustment, found.surface)
    return found


def _registered(
    state: VehicleState, others: list[VehicleState], epsg: int, origin: Array, *, near_first: bool
) -> VehicleState | None:
    """A copy of the state where links to the others confirm a guess; near_first: the first guess is where it is."""
    fixed = fixed_cameras_near(state, others)
    if fixed is None:
        return None
    here = CoarseFit(np.zeros((len(state.flight.frames), 2)), [], np.zeros(0, bool), 1.0)
    guesses = coarse_fits(state.flight, FixedCameraMosaic(fixed, epsg, origin), origin)
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
    config = active().registration
    flight = state.flight
    shift_cameras(flight, fit.correction)
    fixed = fixed_cameras_near(state, others)
    if fixed is None:
        return False
    cell_m = min(config.link_cell_m, _UNFOUND_CELL_SHARE * picture_width_m(flight))
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
