"""Gaps: connected cells that were missed or seen poorly for one cause, as polygons."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.coverage.coverage_grid import Cells, CellState, CoverageGrid, Due
from orthoswarm.coverage.missing_pictures import Cause, MissingPicture
from orthoswarm.coverage.painting import UNSEEN
from orthoswarm.coverage.view import FLAW_NAMES, Flaw
from orthoswarm.model.arrays import Array, Bytes, Flags, Floats

Geometry = Any
_CAUSES = tuple(Cause)
_NONE = 255
_SMALLEST_GAP_M2: Final = 4.0  # smaller gaps are only counted
_BY_IMPORTANCE = (Flaw.DAMAGED, Flaw.BLURRED, Flaw.HAZE, Flaw.POSITION, Flaw.COARSE, Flaw.OBLIQUE, Flaw.EDGE)


@dataclass(frozen=True, slots=True)
class PlannedFlight:
    """The planned flight."""

    legs: Array  # float64 (n, 2, 2), first and last ground point of each leg in the grid of the cells, metres
    width_m: float  # ground that the narrowest camera sees across a leg; height_m along it
    height_m: float
    fov_rad: float  # theta-hat, the horizontal field of view that the plan relies on


@dataclass(frozen=True, slots=True, kw_only=True)
class CoverageGap:
    """A gap."""

    polygon: Geometry  # shapely Polygon in the grid of the cells
    area_m2: float  # its size
    cause: Cause
    detail: str  # the flaw, for ground seen poorly; else empty
    confidence: float  # of the cause, 0 to 1
    vehicle: str = ""  # the vehicle whose pictures are missing or narrow, empty if unknown


@dataclass(frozen=True, slots=True)
class Gaps:
    """All gaps, largest first."""

    gaps: list[CoverageGap]  # those of at least the smallest size
    small: int  # how many smaller ones there are
    small_m2: float  # their total size


@dataclass(frozen=True, slots=True)
class _Explained:
    """Per cell: cause (index of Cause, 255 none), confidence, index of the vehicle (-1 unknown)."""

    cause: Bytes
    confidence: Floats
    vehicle: NDArray[np.int16]

    def enter(self, where: Flags, cause: Cause, confidence: float, vehicle: int = -1) -> None:
        cells = where & (self.cause == _NONE)
        self.cause[cells], self.confidence[cells], self.vehicle[cells] = _CAUSES.index(cause), confidence, vehicle


def find_gaps(
    cover: CoverageGrid,
    missing: Sequence[MissingPicture] = (),
    plan: PlannedFlight | None = None,
    due: Due = True,
) -> Gaps:
    """Gaps and their causes.

    The cause of a gap is the first of these that would have covered it: a missing picture; the same pictures with the
    planned field of view (the lens is narrower than planned); a planned leg (it was not flown). Otherwise the plan
    itself leaves the ground out. Without a plan, gaps that no missing picture explains count as not flown, with
    confidence 0.5.

    Args:
        cover: with all pictures. missing: of `missing_pictures`. plan: what was to be flown, None if not known.
        due: cells whose flight is over, as for `CoverageGrid.states`; no other is a gap.
    """
    state = cover.states(due)
    vehicles = sorted({v.vehicle for v in cover.views})
    size = state.shape
    explained = _Explained(np.full(size, _NONE, np.uint8), np.zeros(size, np.float32), np.full(size, -1, np.int16))
    explained.enter((state == CellState.POOR) & due, Cause.POOR, 1.0)
    missed = state == CellState.MISSED
    for vehicle in vehicles:
        for cause in (Cause.REJECTED, Cause.NOT_ARRIVED, Cause.NOT_TRIGGERED):
            lacking = [m for m in missing if m.view.vehicle == vehicle and m.cause == cause]
            if lacking:
                seen = _would_see(cover, [m.view for m in lacking])
                explained.enter(
                    missed & seen, cause, float(np.mean([m.confidence for m in lacking])), vehicles.index(vehicle)
                )
    if plan is not None:
        for vehicle in vehicles:
            planned = math.tan(0.5 * plan.fov_rad)
            narrow = [  # by more than two sigma, and half a percent
                v for v in cover.views
                if v.vehicle == vehicle
                and math.tan(0.5 * v.fov_rad) < planned * (1.0 - max(0.005, 2.0 * v.focal_sigma))
            ]  # fmt: skip
            if narrow:
                wide = _would_see(cover, [v.with_fov(plan.fov_rad) for v in narrow])
                explained.enter(missed & wide, Cause.NARROW_LENS, 0.9, vehicles.index(vehicle))
        explained.enter(missed & below_legs(cover.cells, plan, plan.legs), Cause.NOT_FLOWN, 0.9)
        explained.enter(missed, Cause.NOT_PLANNED, 0.9)
    explained.enter(missed, Cause.NOT_FLOWN, 0.5)
    return _polygons(cover, explained, vehicles, _SMALLEST_GAP_M2)


def _would_see(cover: CoverageGrid, views: Sequence[Any]) -> Flags:
    other = CoverageGrid(cover.cells, cover.terrain)
    other.put(views)
    return np.asarray(other.best != UNSEEN)


def below_legs(cells: Cells, plan: PlannedFlight, legs: Array) -> Flags:
    """Cells that a plan's pictures of some of its legs would show, bool (rows, columns).

    cells: of the area. plan: with the size of its pictures. legs: float64 (n, 2, 2), ends of legs, grid metres.
    """
    import shapely
    from rasterio.features import rasterize

    if not len(legs):
        return np.zeros(cells.wanted.shape, bool)
    step = legs[:, 1] - legs[:, 0]
    along = step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    across = along[:, ::-1] * [-0.5 * plan.width_m, 0.5 * plan.width_m]
    a, b = legs[:, 0] - 0.5 * plan.height_m * along, legs[:, 1] + 0.5 * plan.height_m * along
    bands = shapely.polygons(np.stack([a + across, b + across, b - across, a - across], axis=1))
    grid = cells.grid
    return np.asarray(rasterize(list(bands), (grid.height, grid.width), transform=grid.affine()) > 0)


def _polygons(cover: CoverageGrid, explained: _Explained, vehicles: Sequence[str], smallest_m2: float) -> Gaps:
    import shapely
    from rasterio.features import shapes

    flaw = np.where(explained.cause == _CAUSES.index(Cause.POOR), _worst_flaw(cover.best), 0)
    code = (
        explained.cause.astype(np.int32)
        + 256 * flaw.astype(np.int32)
        + 65536 * (explained.vehicle.astype(np.int32) + 1)
    )
    gaps, small, small_m2 = [], 0, 0.0
    grid = cover.cells.grid
    for geometry, value in shapes(code, mask=explained.cause != _NONE, connectivity=4, transform=grid.affine()):
        polygon = shapely.geometry.shape(geometry)
        area = float(polygon.area)
        if area < smallest_m2:
            small, small_m2 = small + 1, small_m2 + area
            continue
        number = int(value)
        cause = _CAUSES[number & 255]
        detail = FLAW_NAMES[Flaw((number >> 8) & 255)] if cause is Cause.POOR else ""
        vehicle = number >> 16
        point = shapely.point_on_surface(polygon)
        c, r = np.round(grid.to_pixel([point.x, point.y])).astype(int)
        confidence = float(explained.confidence[min(max(r, 0), grid.height - 1), min(max(c, 0), grid.width - 1)])
        gaps.append(
            CoverageGap(
                polygon=polygon,
                area_m2=area,
                cause=cause,
                detail=detail,
                confidence=confidence,
                vehicle=vehicles[vehicle - 1] if vehicle else "",
            )
        )
    gaps.sort(key=lambda g: -g.area_m2)
    return Gaps(gaps, small, small_m2)


def _worst_flaw(best: Bytes) -> Bytes:
    """The flaw of each cell that is reported: of several, one that affects the complete picture comes first."""
    worst = np.zeros(best.shape, np.uint8)
    for flaw in _BY_IMPORTANCE:
        worst[(worst == 0) & (best != UNSEEN) & ((best & int(flaw)) > 0)] = int(flaw)
    return worst
