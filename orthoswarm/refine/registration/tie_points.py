"""Tie points on the map, roofs that show how the map leans, and links between legs.

All patches of one picture are searched in one call of compiled code.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import kernel
from orthoswarm.compute.robust_kernel import robust_weights
from orthoswarm.model.arrays import Array, Flags, Gray, Indices, Ints
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import MapWindow
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, project_point
from orthoswarm.refine.features.patch_matching import (
    gradients,
    locate,
    locate_wanted,
    promising_blocks,
    rectify,
    template_of,
    window_of,
)
from orthoswarm.refine.features.shift_products import ROWS

_MAP_WINDOW_SHARE: Final = 0.7  # least share of a patch's search window that the map covers
_PATCH_SHARE: Final = 0.85  # least share of a patch that its picture shows
_LEAN_FEWEST: Final = 12  # fewest roofs, by count and by sum of weights, that tell the lean
_LEAN_SIGMA_M: Final = 0.25  # sigma of a roof's shift ...
_LEAN_SIGMA_SHARE: Final = 0.05  # ... plus this share of its height
_LEAN_SCALE: Final = 4.0  # robust scale of the vote (2 sigmas)
_LEAN_MOST: Final = 1.0  # largest lean, metres of shift a metre of height (45 degrees)
_LEAN_OVER_NONE: Final = 1.5  # a lean must have so many times the sum of weights that no lean has
_LEAN_LEAST_SHARE: Final = 0.25  # ... and at least this mean weight
LINK_CELL_M: Final = 40.0  # one point a leg in each cell of this size is sought in other legs (cost)
_LINK_PICTURES: Final = 3  # most other legs in which a point is observed, one picture each (cost)
_LINK_HALF_PX: Final = 15  # half a patch
LINK_REACH_PX: Final = 6  # how far it is searched
_LINK_MARGIN_PX: Final = 12.0  # points nearer to a picture's border are not searched in it, working pixels
_LINK_TEMPLATE_SHARE: Final = 0.95  # least share of the patch that its own picture shows ...
_LINK_WINDOW_SHARE: Final = 0.8  # ... and of the search window in the other picture
_LINK_APART_PX: Final = 3  # correlations within this distance, pixels, belong to the same peak
_LINK_PEAK: Final = 0.45  # least correlation of a link
_LINK_RATIO: Final = 0.8  # largest ratio of the second peak to the first
_LINKS_AT_ONCE: Final = 2_000  # points whose patches are held at once, 9 kB each (memory)
_PEAK_EXCLUDE_PX: Final = 4  # the second peak of a correlation is sought farther than this from the first
_SEARCH_WIDE_PX: Final = 16  # searches of more pixels than this to each side on the map look first at half size
_SEARCH_PROMISING_SHARE: Final = 0.6
"""... and then where that correlates with at least this share of its highest value. Of 1,030 sure first ties 3 are not
found or lie elsewhere with 0.5, 13 with 0.65, 38 with 0.8."""
_GRADIENT_FLOOR: Final = np.float32(1e-3)  # least median gradient, grey values: a blank patch has no texture


@dataclass(frozen=True, slots=True)
class LoadedMap:
    """Grey map of an area in a local frame, in memory at one pixel size.

    west, north: edges in the local frame (grid minus origin), metres. gsd_m: pixel. gray: uint8 (rows, columns). valid:
    bool (rows, columns).
    """

    west: float
    north: float
    gsd_m: float
    gray: Gray
    valid: Flags

    @classmethod
    def load(cls, basemap: MapWindow, origin: Array, bounds: BoundingBox, gsd_m: float) -> "LoadedMap":
        """Read local bounds (west, south, east, north) of a map; origin (2,) is added to reach its grid."""
        east, north = float(origin[0]), float(origin[1])
        world = bounds.moved(east, north)
        gray, valid = basemap.gray(world, gsd_m)
        grid = GroundGrid.around(basemap.epsg, world, gsd_m)
        return cls(grid.west - east, grid.north - north, gsd_m, np.clip(gray + 0.5, 0, 255).astype(np.uint8), valid)

    @property
    def bounds(self) -> BoundingBox:
        """West, south, east, north in the local frame."""
        rows, columns = self.gray.shape
        return BoundingBox(self.west, self.north - rows * self.gsd_m, self.west + columns * self.gsd_m, self.north)

    def pixel_centres(self, xy: Array) -> tuple[Indices, Array]:
        """Row and column (K, 2) of the pixels that hold points (K, 2), and the coordinates (K, 2) of their middles."""
        column = ((xy[:, 0] - self.west) // self.gsd_m).astype(np.int64)
        row = ((self.north - xy[:, 1]) // self.gsd_m).astype(np.int64)
        east, north = self.west + (column + 0.5) * self.gsd_m, self.north - (row + 0.5) * self.gsd_m
        return np.column_stack([row, column]), np.column_stack([east, north])


@dataclass(frozen=True, slots=True, kw_only=True)
class MapMatches:
    """Points found on the map.

    Attributes (Q): point: int32. camera: int32 whose picture was compared. shift: float64 (Q, 2) metres from the
        point to its place on the map. peak, ratio: float64 correlation and second peak / peak.
    """

    point: Ints
    camera: Ints
    shift: Array
    peak: Array
    ratio: Array

    @classmethod
    def joined(cls, parts: "Sequence[MapMatches]") -> "MapMatches":
        """All matches of at least one part, one part after the other."""
        return cls(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in cls.__slots__})

    @classmethod
    def none(cls) -> "MapMatches":
        """No matches."""
        number, ints = np.zeros(0), np.zeros(0, np.int32)
        return cls(point=ints, camera=ints, shift=np.zeros((0, 2)), peak=number, ratio=number)

    def take(self, keep: Flags | NDArray[np.integer]) -> "MapMatches":
        """Some of the matches."""
        return MapMatches(**{name: getattr(self, name)[keep] for name in self.__slots__})


def match_points(
    cameras: CameraBlock, points: Array, chosen: NDArray[np.integer], *, camera: Ints, gray: Callable[[int], Gray],
    ground: LoadedMap, half: int, reach: int, level: Array | None = None, texture: bool = False,
) -> MapMatches:  # fmt: skip
    """Find the surroundings of points on the map.

    What surrounds a corner is mostly ground, although the corner itself sits on something raised: so the surroundings
    are rectified on the ground where the camera sees the point, not at the point's own height.

    Args:
        chosen: (Q,) indices of points; camera: (P,) the picture to take for each point.
        gray: working-scale picture of a camera (its lens is in these pixels).
        half: half the patch in map pixels; reach: search in map pixels.
        level: float64 (P,) height on which to rectify around each point; None takes the points' own heights (roofs).
        texture: compare texture instead of edges, see `patch_matching.gradients`.
    """
    chosen = chosen[np.argsort(camera[chosen], kind="stable")]
    by, z = camera[chosen], points[chosen, 2]
    plane = z if level is None else np.asarray(level, float)[chosen]
    along = (points[chosen, :2] - cameras.position[by, :2]) / np.maximum(cameras.position[by, 2] - z, 1.0)[:, None]
    pixel, centre = ground.pixel_centres(points[chosen, :2] + along * (z - plane)[:, None])
    place = np.column_stack([centre, plane])
    found = np.zeros((len(chosen), 4))
    for i, part in _by_picture(by):
        _search_map(
            cameras.position[i], cameras.rotation[i], cameras.lens[cameras.lens_id[i]], gray(i), place[part],
            pixel[part], ground.gray, ground.valid, ground.gsd_m, half, reach, texture, found[part],
        )  # fmt: skip
    good = found[:, 2] > 0
    found, by = found[good], by[good]
    return MapMatches(
        point=chosen[good].astype(np.int32),
        camera=by.astype(np.int32),
        shift=found[:, :2] * [ground.gsd_m, -ground.gsd_m],
        peak=found[:, 2],
        ratio=found[:, 3] / found[:, 2],
    )


def _by_picture(ascending: NDArray[np.integer]) -> Iterator[tuple[int, slice]]:
    """Each picture of an ascending list, with where it stands in that."""
    edges = np.flatnonzero(np.diff(ascending, prepend=-1)).tolist()
    for a, b in pairwise([*edges, len(ascending)]):
        yield int(ascending[a]), slice(a, b)


def vote_lean(matches: MapMatches, height: Array, offset: Array) -> tuple[float, float] | None:
    """The map's lean, metres of shift east and north per metre of height, from roofs; None where too few of them agree.

    height: float64 (Q,) of each matched point above the ground. offset: float64 (2,) shift of ground points now.
    """
    if len(height) < _LEAN_FEWEST:
        return None
    shift = matches.shift - offset
    slope = shift / height[:, None]
    sigma = _LEAN_SIGMA_M + _LEAN_SIGMA_SHARE * height

    def weights(lean: Array) -> Array:
        return robust_weights(((shift - lean * height[:, None]) ** 2).sum(1) / sigma**2, _LEAN_SCALE)

    candidates = slope[np.hypot(*slope.T) < _LEAN_MOST]
    if not len(candidates):
        return None
    best = candidates[int(np.argmax([weights(c).sum() for c in candidates]))]
    for _ in range(8):
        w = weights(best) / sigma**2
        best = (shift * (w * height)[:, None]).sum(0) / max(float((w * height**2).sum()), 1e-9)
    without = float(weights(np.zeros(2)).sum())
    least = max(_LEAN_FEWEST, _LEAN_OVER_NONE * without, _LEAN_LEAST_SHARE * len(height))
    return (float(best[0]), float(best[1])) if weights(best).sum() >= least else None


def link_legs(
    cameras: CameraBlock, points: Array, chosen: NDArray[np.integer], *, camera: Ints, leg: Ints,
    candidates: NDArray[np.integer], gray: Callable[[int], Gray], gsd_m: float, most: int | None = None,
    reach: int = LINK_REACH_PX,
) -> tuple[Ints, Ints, Array]:  # fmt: skip
    """Find points of one leg in the pictures of other legs: camera (K,), point (K,), pixel (K, 2) of new observations.

    camera: (P,) reference picture of each point. leg: (N,) of each camera. candidates: cameras that may be linked.
    most: other legs in which a point is observed, None: as configured. reach: search in pixels.
    """
    most, half = most or _LINK_PICTURES, _LINK_HALF_PX
    chosen = chosen[np.argsort(camera[chosen], kind="stable")]
    _, number = np.unique(leg, return_inverse=True)
    views = np.empty((len(chosen), most), np.int64)
    _views_of_other_legs(
        cameras.position, cameras.rotation, cameras.lens_id, cameras.lens, points[chosen], number[camera[chosen]],
        number, int(number.max(initial=-1)) + 1, np.asarray(candidates, np.int64), views,
    )  # fmt: skip
    chosen, views = chosen[views[:, 0] >= 0], views[views[:, 0] >= 0]
    found = np.zeros((*views.shape, 4))
    for start in range(0, len(chosen), _LINKS_AT_ONCE):
        some = slice(start, start + _LINKS_AT_ONCE)
        own = points[chosen[some]]
        fields = np.zeros((len(own), *template_of(half).shape), np.float32)
        for i, part in _by_picture(camera[chosen[some]]):
            _templates(
                cameras.position[i], cameras.rotation[i], cameras.lens[cameras.lens_id[i]], gray(i), own[part],
                gsd_m, half, fields[part],
            )  # fmt: skip
        shown = np.isfinite(fields[:, 0, 0, 0])
        point, view = np.nonzero((views[some] >= 0) & shown[:, None])
        by = views[some][point, view]
        order = np.argsort(by, kind="stable")
        point, view, by = point[order], view[order], by[order]
        result = np.zeros((len(by), 4))
        for i, part in _by_picture(by):
            _search_picture(
                cameras.position[i], cameras.rotation[i], cameras.lens[cameras.lens_id[i]], gray(i),
                own[point[part]], fields, point[part], gsd_m, half, reach, result[part],
            )  # fmt: skip
        found[start + point, view] = result
    peak, second = found[..., 2], found[..., 3]
    point, view = np.nonzero((peak > 0) & (peak >= _LINK_PEAK) & (second <= _LINK_RATIO * peak))
    moved = points[chosen[point]]
    moved[:, :2] += found[point, view, :2] * [gsd_m, -gsd_m]
    by_camera = views[point, view].astype(np.int32)
    return by_camera, chosen[point].astype(np.int32), cameras.project(by_camera, moved)


@kernel
def _search_map(  # type: ignore[no-untyped-def]
    position, rotation, lens, gray, place, pixel, ground, valid, gsd, half, reach, texture, found
):
    """Find the surroundings of K points of one picture on the map.

    Args:
        position, rotation, lens: of the picture, (3,), (3, 3), (8,). gray: uint8, the picture.
        place: float64 (K, 3), centre of each patch on the map's lattice, and the height on which it is rectified.
        pixel: int64 (K, 2), the same in rows and columns of the map.
        ground, valid: uint8 and bool (rows, columns), the map. gsd: its pixel, metres.
        half, reach: half the patch and the search, pixels. texture: see `gradients`.
        found: float64 (K, 4) out, column and row of the shift, peak, second peak; peak 0 where there is none.
    """
    patch = np.empty((2 * half + 3, 2 * half + 3), np.float32)
    around = half + reach + 1
    size = 2 * around + 1
    seen = np.empty((size, size), np.float32)
    template, window = template_of(half), window_of(half, reach)
    for k in range(len(place)):
        found[k] = 0.0
        row, column = pixel[k, 0] - around, pixel[k, 1] - around
        if row < 0 or column < 0 or row + size > ground.shape[0] or column + size > ground.shape[1]:
            continue
        known = 0
        for r in range(size):
            values, counts, to = ground[row + r], valid[row + r], seen[r]
            for c in range(size):
                known += counts[column + c]
                to[c] = values[column + c] if counts[column + c] else np.nan
        if known < _MAP_WINDOW_SHARE * size * size:
            continue
        shown = rectify(position, rotation, lens, gray, place[k, 0], place[k, 1], place[k, 2], gsd, half + 1, patch)
        if shown < _PATCH_SHARE:
            continue
        gradients(patch, texture, _GRADIENT_FLOOR, template, ROWS - 1)
        gradients(seen, texture, _GRADIENT_FLOOR, window, 0)
        if reach > _SEARCH_WIDE_PX:
            wanted = promising_blocks(patch, seen, reach, texture, _GRADIENT_FLOOR, _SEARCH_PROMISING_SHARE)
            best = locate_wanted(template, window, reach, _PEAK_EXCLUDE_PX, wanted)
        else:
            best = locate(template, window, reach, _PEAK_EXCLUDE_PX)
        found[k, 0], found[k, 1], found[k, 2], found[k, 3] = best


@kernel
def _templates(position, rotation, lens, gray, points, gsd, half, fields):  # type: ignore[no-untyped-def]
    """Gradients of the surroundings of K points (K, 3) in one picture, into fields (K, ...), see `template_of`.

    The first value of what the picture shows less of than `_LINK_TEMPLATE_SHARE` becomes NaN.
    """
    patch = np.empty((2 * half + 3, 2 * half + 3), np.float32)
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        shown = rectify(position, rotation, lens, gray, x, y, z, gsd, half + 1, patch)
        gradients(patch, False, _GRADIENT_FLOOR, fields[k], ROWS - 1)
        if shown < _LINK_TEMPLATE_SHARE:
            fields[k, 0, 0, 0] = np.nan


@kernel
def _search_picture(  # type: ignore[no-untyped-def]
    position, rotation, lens, gray, points, fields, field, gsd, half, reach, found
):
    """Find K patches in one picture.

    Args:
        points: float64 (K, 3), their places. fields: of `_templates`. field: int64 (K,), the one of each place.
        The others: as in `_search_map`.
        found: float64 (K, 4) out, column and row of the shift, peak, second peak; peak 0 where there is none.
    """
    around = half + reach + 1
    seen = np.empty((2 * around + 1, 2 * around + 1), np.float32)
    window = window_of(half, reach)
    for k in range(len(points)):
        found[k] = 0.0
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        if rectify(position, rotation, lens, gray, x, y, z, gsd, around, seen) < _LINK_WINDOW_SHARE:
            continue
        gradients(seen, False, _GRADIENT_FLOOR, window, 0)
        best = locate(fields[field[k]], window, reach, _LINK_APART_PX)
        found[k, 0], found[k, 1], found[k, 2], found[k, 3] = best


@kernel
def _views_of_other_legs(  # type: ignore[no-untyped-def]
    position, rotation, lens_id, lens, points, own_leg, leg, legs, candidates, views
):
    """For each point (K, 3) the pictures of other legs that show it best, at most views.shape[1] of them.

    Of each leg the picture whose nadir is nearest, the nearest legs first.

    own_leg: int64 (K,), the leg of each point. leg: int64 (N,), of each camera, 0 to legs - 1. candidates: int64 (C,),
    cameras that may be taken. views: int64 (K, V) out, cameras; -1 where there are no more.
    """
    margin = _LINK_MARGIN_PX
    nearest, which = np.empty(legs), np.empty(legs, np.int64)
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        nearest[:] = np.inf
        for i in candidates:
            away = np.sqrt((position[i, 0] - x) ** 2 + (position[i, 1] - y) ** 2)
            if leg[i] == own_leg[k] or away >= nearest[leg[i]]:
                continue
            own = lens[lens_id[i]]
            u, v = project_point(position[i], rotation[i], own, x, y, z)
            if u > margin and v > margin and u < own[WIDTH] - margin and v < own[HEIGHT] - margin:
                nearest[leg[i]], which[leg[i]] = away, i
        for n in range(views.shape[1]):
            best = int(np.argmin(nearest))
            views[k, n] = which[best] if nearest[best] < np.inf else -1
            nearest[best] = np.inf
