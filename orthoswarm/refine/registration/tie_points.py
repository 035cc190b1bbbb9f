"""Tie points on the map, roofs that show how the map leans, and links between legs."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.model.arrays import Array, Flags, Gray, Ints
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.features.patch_matching import template_of
from orthoswarm.refine.registration.map_windows import LoadedMap
from orthoswarm.refine.registration.patch_search import search_map, search_picture, templates, views_of_other_legs

_MAP_WINDOW_SHARE: Final = 0.7  # least share of a patch's search window that the map covers
_PATCH_SHARE: Final = 0.85  # least share of a patch that its picture shows
_LEAN_FEWEST: Final = 12  # fewest roofs, by count and by sum of weights, that tell the lean
_LEAN_SIGMA_M: Final = 0.25  # sigma of a roof's shift ...
_LEAN_SIGMA_SHARE: Final = 0.05  # ... plus this share of its height
_LEAN_SCALE: Final = 4.0  # robust scale of the vote (2 sigmas)
_LEAN_MOST: Final = 1.0  # largest lean, metres of shift a metre of height (45 degrees)
_LEAN_OVER_NONE: Final = 1.5  # a lean must have so many times the sum of weights that no lean has
_LEAN_LEAST_SHARE: Final = 0.25  # ... and at least this mean weight
LINK_VIEWS: Final = 3  # fewest pictures that show the point
LINK_VIEW_WEIGHT: Final = 0.5  # least mean robust weight of its observations
_LINK_HALF_PX: Final = 15  # half a patch
_LINK_REACH_PX: Final = 6  # how far it is searched
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
_GRADIENT_FLOOR: Final = 1e-3  # least median gradient, grey values: a blank patch has no texture to compress


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
        number, pair = np.zeros(0), np.zeros((0, 2))
        ints = np.zeros(0, np.int32)
        return cls(point=ints, camera=ints, shift=pair, peak=number, ratio=number)

    def take(self, keep: Flags | NDArray[np.integer]) -> "MapMatches":
        """Some of the matches."""
        return MapMatches(**{name: getattr(self, name)[keep] for name in self.__slots__})


def match_points(
    cameras: CameraBlock,
    points: Array,
    chosen: NDArray[np.integer],
    *,
    camera: Ints,
    gray: Callable[[int], Gray],
    ground: LoadedMap,
    half: int,
    reach: int,
    level: Array | None = None,
    texture: bool = False,
) -> MapMatches:
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
        search_map(
            cameras.position[i], cameras.rotation[i], cameras.lens[cameras.lens_id[i]], gray(i), place[part],
            pixel[part], ground.gray, ground.valid, ground.gsd_m, half, reach, texture,
            np.float32(_GRADIENT_FLOOR), _PEAK_EXCLUDE_PX, _MAP_WINDOW_SHARE,
            _PATCH_SHARE, _SEARCH_WIDE_PX, _SEARCH_PROMISING_SHARE, found[part],
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
    """The map's lean (metres of shift per metre of height) from roofs.

    Args:
        height: float64 (Q,) height of each matched point above the ground.
        offset: float64 (2,) shift that ground points have now.

    Returns:
        East and north lean, or None where too few roofs agree (the caller then takes zero).
    """
    if len(height) < _LEAN_FEWEST:
        return None
    shift = matches.shift - offset
    slope = shift / height[:, None]
    sigma = _LEAN_SIGMA_M + _LEAN_SIGMA_SHARE * height

    def support(lean: Array) -> tuple[float, Array]:
        e2 = ((shift - lean * height[:, None]) ** 2).sum(1) / sigma**2
        w = 1.0 / (1.0 + e2 / _LEAN_SCALE) ** 2
        return float(w.sum()), w

    candidates = slope[np.hypot(*slope.T) < _LEAN_MOST]
    if not len(candidates):
        return None
    best = candidates[int(np.argmax([support(c)[0] for c in candidates]))]
    for _ in range(8):
        w = support(best)[1] / sigma**2
        best = (shift * (w * height)[:, None]).sum(0) / max(float((w * height**2).sum()), 1e-9)
    total, w = support(best)
    zero = support(np.zeros(2))[0]
    least = max(_LEAN_FEWEST, _LEAN_OVER_NONE * zero, _LEAN_LEAST_SHARE * len(height))
    if total < least:
        return None
    return float(best[0]), float(best[1])


def link_legs(
    cameras: CameraBlock,
    points: Array,
    chosen: NDArray[np.integer],
    *,
    camera: Ints,
    leg: Ints,
    candidates: NDArray[np.integer],
    gray: Callable[[int], Gray],
    gsd_m: float,
    most: int | None = None,
    reach: int | None = None,
) -> tuple[Ints, Ints, Array, int]:
    """Find points of one leg in the pictures of other legs.

    Args:
        camera: (P,) reference picture of each point. leg: (N,) of each camera. candidates: cameras that may be linked.
        most: other legs in which a point is observed. reach: search in pixels. None: as configured.

    Returns:
        Camera (K,), point (K,), pixel (K, 2) of new observations, and how many were tried.
    """
    config = active().registration
    most = config.link_pictures if most is None else most
    half, reach = _LINK_HALF_PX, _LINK_REACH_PX if reach is None else reach
    floor = np.float32(_GRADIENT_FLOOR)
    chosen = chosen[np.argsort(camera[chosen], kind="stable")]
    _, number = np.unique(leg, return_inverse=True)
    views = np.empty((len(chosen), most), np.int64)
    views_of_other_legs(
        cameras.position, cameras.rotation, cameras.lens_id, cameras.lens, points[chosen], number[camera[chosen]],
        number, int(number.max(initial=-1)) + 1, np.asarray(candidates, np.int64), _LINK_MARGIN_PX, views,
    )  # fmt: skip
    chosen, views = chosen[views[:, 0] >= 0], views[views[:, 0] >= 0]
    found, tried = np.zeros((*views.shape, 4)), 0
    for start in range(0, len(chosen), _LINKS_AT_ONCE):
        some = slice(start, start + _LINKS_AT_ONCE)
        own = points[chosen[some]]
        fields = np.zeros((len(own), *template_of(half).shape), np.float32)
        for i, part in _by_picture(camera[chosen[some]]):
            templates(
                cameras.position[i], cameras.rotation[i], cameras.lens[cameras.lens_id[i]], gray(i), own[part],
                gsd_m, half, floor, _LINK_TEMPLATE_SHARE, fields[part],
            )  # fmt: skip
        shown = np.isfinite(fields[:, 0, 0, 0])
        point, view = np.nonzero((views[some] >= 0) & shown[:, None])
        by = views[some][point, view]
        order = np.argsort(by, kind="stable")
        point, view, by = point[order], view[order], by[order]
        tried += len(by)
        result = np.zeros((len(by), 4))
        for i, part in _by_picture(by):
            search_picture(
                cameras.position[i], cameras.rotation[i], cameras.lens[cameras.lens_id[i]], gray(i),
                own[point[part]], fields, point[part], gsd_m, half, reach, floor, _LINK_APART_PX,
                _LINK_WINDOW_SHARE, result[part],
            )  # fmt: skip
        found[start + point, view] = result
    peak, second = found[..., 2], found[..., 3]
    point, view = np.nonzero((peak > 0) & (peak >= _LINK_PEAK) & (second <= _LINK_RATIO * peak))
    moved = points[chosen[point]]
    moved[:, :2] += found[point, view, :2] * [gsd_m, -gsd_m]
    by_camera = views[point, view].astype(np.int32)
    return by_camera, chosen[point].astype(np.int32), cameras.project(by_camera, moved), tried
