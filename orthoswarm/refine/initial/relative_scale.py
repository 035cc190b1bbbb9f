"""Ground scale of photos and segments from the distance flown, the scale between photos and recorded heights."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from orthoswarm.compute.robust_kernel import robust_widening
from orthoswarm.model.arrays import Array, Flags, Ints
from orthoswarm.model.camera import fov_rad
from orthoswarm.model.frame import DEFAULT_HEIGHT_M
from orthoswarm.refine.initial.planar_similarity import PairGraph, PhotoRecords

_HINT_FOV_DEG: Final = (30.0, 120.0)  # fields of view of lenses that exist
_HINT_SIGMA: Final = 0.06  # relative sigma of a focal length by tags
_DEFAULT_FOV_SIGMA: Final = 0.35  # relative sigma of the default focal length
_SCALE_LEAST_WAY_M: Final = 3.0  # a pair whose positions are nearer gives no scale
_SCALE_LEAST_SHIFT_SHARE: Final = 0.02  # ... nor one whose pictures shift by less than this share of the width
_SCALE_TURN_COSINE: Final = 0.9  # cosine of the turn up to which a pair's shift hardly depends on the tilt
_SCALE_LENS_PAIRS: Final = 3  # with fewer such pairs of a lens, all its pairs count
_SCALE_SEGMENT_PAIRS: Final = 5  # from so many such pairs on a segment has a scale of its own
_SCALE_SCHEDULE: Final = (100.0, 25.0, 9.0, 9.0)  # robust schedule of the photos' relative scales
_ZOOM_SIGMA: Final = 0.02  # relative sigma of the zoom between two photos by relief
_DEFAULT_FOV_DEG: Final = 75.0  # field of view where no tag gives one: the middle of drones' cameras
_ZOOM_MISFIT_SIGMAS: Final = 3.0  # ... and so many times the misfit over the spread, by the root of matches
_RELATIVE_HEIGHT_SIGMA: Final = 0.03  # relative sigma of a recorded height within its segment
_RELATIVE_LEVEL_SIGMA: Final = 0.15  # the same of a photo without one: about as level as its segment
_HEIGHT_KNOWN_SHARE: Final = 0.5  # share of a segment's photos that must record a height
_HEIGHT_LEAST_M: Final = 2.0  # a median recorded height below this is that of a takeoff or none
_HEIGHT_RATIO: Final = 5.0  # a height beyond this factor of its segment's, either way, is dropped


@dataclass(frozen=True, slots=True)
class RecordedHeights:
    """Recorded heights as evidence of scale.

    relative: float64 (N,), height of each photo over its segment's median, 1 where unknown. known: bool (N,), whether
    it is recorded. segment: float64 (S,), median recorded height of each segment above takeoff or ground, or NaN.
    """

    relative: Array
    known: Flags
    segment: Array


def recorded_heights(records: PhotoRecords, above: Array) -> RecordedHeights:
    """Heights relative to the segment's median, from heights or, if there are none, from absolute altitudes.

    above: float64 (S,), height of each segment above the ground as known so far (altitudes give differences only).
    """
    relative = np.full(len(records), np.nan)
    level = np.full(len(above), np.nan)
    for s in range(len(above)):
        rows = records.segment == s
        h, a = records.height_m[rows], records.altitude_m[rows]
        if np.isfinite(h).sum() > _HEIGHT_KNOWN_SHARE * rows.sum() and np.nanmedian(h) > _HEIGHT_LEAST_M:
            level[s] = float(np.nanmedian(h))
            ratio = h / level[s]
        elif np.isfinite(a).sum() > _HEIGHT_KNOWN_SHARE * rows.sum():
            ratio = 1.0 + (a - np.nanmedian(a)) / above[s]
        else:
            continue
        relative[rows] = np.where((ratio > 1.0 / _HEIGHT_RATIO) & (ratio < _HEIGHT_RATIO), ratio, np.nan)
    known = np.isfinite(relative)
    return RecordedHeights(np.where(known, relative, 1.0), known, level)


def first_scale(graph: PairGraph, records: PhotoRecords, lens_of: Ints, focal: Array) -> tuple[Array, Flags]:
    """Metres per pixel of each segment (S,): recorded movement over the pictures' shift; which lenses (L,) have one.

    Only pairs of nearly equal heading are used if there are any, as their shift does not depend on the tilt. A lens
    without a pair uses its recorded height and focal length.

    lens_of: int32 (S,), lens of each segment. focal: float64 (L,), pixels, as known so far.
    """
    i, j = graph.first, graph.second
    way = np.abs(records.position[j] - records.position[i])
    shift = np.abs(graph.centre_first - np.conj(graph.turn) * graph.centre_second)
    same = (records.lens[i] == records.lens[j]) & (way > _SCALE_LEAST_WAY_M)
    same &= shift > _SCALE_LEAST_SHIFT_SHARE * records.width[i]
    straight = same & (graph.turn.real > _SCALE_TURN_COSINE)
    by_lens, measured = np.full(len(focal), np.nan), np.zeros(len(focal), bool)
    recorded = recorded_heights(records, np.full(len(lens_of), DEFAULT_HEIGHT_M)).segment
    for k in range(len(focal)):
        mine = records.lens[i] == k
        rows = np.flatnonzero(straight & mine)
        rows = rows if len(rows) >= _SCALE_LENS_PAIRS else np.flatnonzero(same & mine)
        if len(rows):
            by_lens[k], measured[k] = weighted_median(way[rows] / shift[rows], way[rows]), True
        else:
            high = recorded[(lens_of == k) & np.isfinite(recorded)]
            by_lens[k] = (float(np.median(high)) if len(high) else DEFAULT_HEIGHT_M) / focal[k]
    metres = by_lens[lens_of]
    for s in range(len(lens_of)):
        rows = np.flatnonzero(straight & (records.segment[i] == s) & (records.segment[j] == s))
        if len(rows) >= _SCALE_SEGMENT_PAIRS:
            metres[s] = weighted_median(way[rows] / shift[rows], way[rows])
    return np.asarray(metres), measured


def relative_scales(graph: PairGraph, records: PhotoRecords, heights: RecordedHeights, count: int) -> Array:
    """Metres per pixel of each photo over its segment's (N,), by one robust adjustment; priors: recorded heights."""
    i, j = graph.first, graph.second
    inside = np.flatnonzero(records.segment[i] == records.segment[j])
    i, j = i[inside], j[inside]
    zoom = np.log(np.maximum(np.abs(graph.factor[inside]), 1e-6))
    misfit = graph.residual[inside] / np.maximum(graph.spread[inside] * np.exp(zoom), 1.0)
    sigma = np.hypot(_ZOOM_SIGMA, _ZOOM_MISFIT_SIGMAS * misfit / np.sqrt(graph.count[inside]))
    prior = np.log(heights.relative)
    prior_sigma = np.where(heights.known, _RELATIVE_HEIGHT_SIGMA, _RELATIVE_LEVEL_SIGMA)
    x = prior.copy()
    k = np.arange(len(inside))
    for c in _SCALE_SCHEDULE:
        e = (zoom - (x[i] - x[j])) / sigma
        d = (prior - x) / prior_sigma
        w = 1.0 / (robust_widening(e * e, c) * sigma)
        v = 1.0 / (robust_widening(d * d, c) * prior_sigma)
        matrix = coo_matrix((np.r_[w, -w], (np.r_[k, k], np.r_[i, j])), shape=(len(inside), count)).tocsr()
        normal = (matrix.T @ matrix + diags(v * v)).tocsc()
        x = np.asarray(spsolve(normal, matrix.T @ (w * zoom) + v * v * prior)).reshape(-1)
    for s in np.unique(records.segment):
        rows = records.segment == s
        x[rows] -= np.median(x[rows])
    return np.asarray(np.exp(x))


def focal_by_height(records: PhotoRecords, heights: RecordedHeights, metres: Array, lens_of: Ints) -> Array:
    """Focal length of each lens in pixels, height over metres per pixel; NaN where no such lens exists."""
    narrowest, widest = np.radians(_HINT_FOV_DEG)
    focal = np.full(len(records.fov_hint), np.nan)
    for k in range(len(focal)):
        rows = (lens_of == k) & np.isfinite(heights.segment)
        if rows.any():
            f = float(np.median(heights.segment[rows] / metres[rows]))
            view = fov_rad(f, int(records.width[records.lens == k][0]))
            focal[k] = f if narrowest < view < widest else np.nan
    return focal


def focal_by_hint(records: PhotoRecords) -> tuple[Array, Array]:
    """Log focal length (pixels) of each lens from its tags or the default, and its sigma; both float64 (L,)."""
    narrowest, widest = np.radians(_HINT_FOV_DEG)
    width = np.array([records.width[records.lens == k][0] for k in range(len(records.fov_hint))])
    with np.errstate(invalid="ignore"):
        good = (records.fov_hint > narrowest) & (records.fov_hint < widest)
    view = np.where(good, records.fov_hint, float(np.radians(_DEFAULT_FOV_DEG)))
    return np.log(0.5 * width / np.tan(0.5 * view)), np.where(good, _HINT_SIGMA, _DEFAULT_FOV_SIGMA)


def weighted_median(value: Array, weight: Array) -> float:
    """The value that divides the total weight into halves."""
    order = np.argsort(value, kind="stable")
    total = np.cumsum(weight[order])
    return float(value[order][np.searchsorted(total, 0.5 * total[-1])])
