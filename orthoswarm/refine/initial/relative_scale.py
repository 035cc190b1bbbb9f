"""Ground scale of photos and segments: from the way flown, from each other, from recorded heights."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from orthoswarm.model.camera import fov_rad
from orthoswarm.refine.initial.planar_similarity import Array, Flags, Ints, PairGraph, PhotoRecords

DEFAULT_FOV_RAD = float(np.radians(75.0))
DEFAULT_HEIGHT_M = 60.0
PLAUSIBLE_FOV_RAD = (float(np.radians(30.0)), float(np.radians(120.0)))
_CLOSE_TURN = 0.9
"""Cosine of the turn up to which a pair's shift hardly depends on the tilt."""
_PAIR_SIGMA = 0.02
_C_SCHEDULE = (100.0, 25.0, 9.0, 9.0)


@dataclass(frozen=True, slots=True)
class RecordedHeights:
    """Recorded heights as evidence of scale.

    Attributes:
        relative: float64 (N,), height of each photo over its segment's median, 1 where unknown.
        known: bool (N,), whether `relative` is recorded.
        segment: float64 (S,), median recorded height of each segment above takeoff or ground, NaN where unknown.
    """

    relative: Array
    known: Flags
    segment: Array


def recorded_heights(records: PhotoRecords, above: Array) -> RecordedHeights:
    """Heights over the segment's median, from heights or, for want of them, from absolute altitudes.

    Args:
        records: of N photos.
        above: float64 (S,), height of each segment above the ground as known so far (altitudes tell differences only).
    """
    relative = np.full(len(records), np.nan)
    level = np.full(len(above), np.nan)
    for s in range(len(above)):
        rows = records.segment == s
        h, a = records.height_m[rows], records.altitude_m[rows]
        if np.isfinite(h).sum() > 0.5 * rows.sum() and np.nanmedian(h) > 2.0:
            level[s] = float(np.nanmedian(h))
            ratio = h / level[s]
        elif np.isfinite(a).sum() > 0.5 * rows.sum():
            ratio = 1.0 + (a - np.nanmedian(a)) / above[s]
        else:
            continue
        relative[rows] = np.where((ratio > 0.2) & (ratio < 5.0), ratio, np.nan)
    known = np.isfinite(relative)
    return RecordedHeights(np.where(known, relative, 1.0), known, level)


def first_scale(graph: PairGraph, records: PhotoRecords, lens_of: Ints, focal: Array) -> tuple[Array, Flags]:
    """Metres per pixel of each segment (S,) from ways recorded and shifts seen, and which lenses (L,) had such.

    Pairs of nearly equal heading, whose shift does not depend on the tilt, count alone where there are any. A lens
    without a pair takes its recorded height and its focal length.

    Args:
        graph: pairs of level pictures.
        records: of all photos.
        lens_of: int32 (S,), lens of each segment.
        focal: float64 (L,), pixels, as believed so far.
    """
    i, j = graph.first, graph.second
    way = np.abs(records.position[j] - records.position[i])
    shift = np.abs(graph.centre_first - np.conj(graph.turn) * graph.centre_second)
    same = (records.lens[i] == records.lens[j]) & (way > 3.0) & (shift > 0.02 * records.width[i])
    straight = same & (graph.turn.real > _CLOSE_TURN)
    by_lens, told = np.full(len(focal), np.nan), np.zeros(len(focal), bool)
    recorded = recorded_heights(records, np.full(len(lens_of), DEFAULT_HEIGHT_M)).segment
    for k in range(len(focal)):
        mine = records.lens[i] == k
        rows = np.flatnonzero(straight & mine)
        rows = rows if len(rows) >= 3 else np.flatnonzero(same & mine)
        if len(rows):
            by_lens[k], told[k] = weighted_median(way[rows] / shift[rows], way[rows]), True
        else:
            high = recorded[(lens_of == k) & np.isfinite(recorded)]
            by_lens[k] = (float(np.median(high)) if len(high) else DEFAULT_HEIGHT_M) / focal[k]
    metres = by_lens[lens_of]
    for s in range(len(lens_of)):
        rows = np.flatnonzero(straight & (records.segment[i] == s) & (records.segment[j] == s))
        if len(rows) >= 5:
            metres[s] = weighted_median(way[rows] / shift[rows], way[rows])
    return np.asarray(metres), told


def relative_scales(graph: PairGraph, records: PhotoRecords, heights: RecordedHeights, count: int) -> Array:
    """Metres per pixel of each photo over its segment's, float64 (N,), from the zoom between level pictures.

    Recorded heights are believed to 3 %, none to 15 %; pairs of one segment to 2 % (relief). Robust.
    """
    i, j = graph.first, graph.second
    inside = np.flatnonzero(records.segment[i] == records.segment[j])
    i, j = i[inside], j[inside]
    zoom = np.log(np.maximum(np.abs(graph.factor[inside]), 1e-6))
    misfit = graph.residual[inside] / np.maximum(graph.spread[inside] * np.exp(zoom), 1.0)
    sigma = np.hypot(_PAIR_SIGMA, 3.0 * misfit / np.sqrt(graph.count[inside]))
    prior, prior_sigma = np.log(heights.relative), np.where(heights.known, 0.03, 0.15)
    x = prior.copy()
    k = np.arange(len(inside))
    for c in _C_SCHEDULE:
        e = (zoom - (x[i] - x[j])) / sigma
        d = (prior - x) / prior_sigma
        w = 1.0 / ((1.0 + e * e / c) * sigma)
        v = 1.0 / ((1.0 + d * d / c) * prior_sigma)
        matrix = coo_matrix((np.r_[w, -w], (np.r_[k, k], np.r_[i, j])), shape=(len(inside), count)).tocsr()
        normal = (matrix.T @ matrix + diags(v * v)).tocsc()
        x = np.asarray(spsolve(normal, matrix.T @ (w * zoom) + v * v * prior)).reshape(-1)
    for s in np.unique(records.segment):
        rows = records.segment == s
        x[rows] -= np.median(x[rows])
    return np.asarray(np.exp(x))


def focal_by_height(records: PhotoRecords, heights: RecordedHeights, metres: Array, lens_of: Ints) -> Array:
    """Focal length in pixels of each lens, height over metres per pixel, NaN where that is no lens that exists."""
    focal = np.full(len(records.fov_hint), np.nan)
    for k in range(len(focal)):
        rows = (lens_of == k) & np.isfinite(heights.segment)
        if rows.any():
            f = float(np.median(heights.segment[rows] / metres[rows]))
            view = fov_rad(f, int(records.width[records.lens == k][0]))
            focal[k] = f if PLAUSIBLE_FOV_RAD[0] < view < PLAUSIBLE_FOV_RAD[1] else np.nan
    return focal


def focal_by_hint(records: PhotoRecords) -> tuple[Array, Array]:
    """Log of the focal length in pixels of each lens, and its one sigma: tags to 6 %, else 75 degrees to 35 %."""
    width = np.array([records.width[records.lens == k][0] for k in range(len(records.fov_hint))])
    with np.errstate(invalid="ignore"):
        good = (records.fov_hint > PLAUSIBLE_FOV_RAD[0]) & (records.fov_hint < PLAUSIBLE_FOV_RAD[1])
    view = np.where(good, records.fov_hint, DEFAULT_FOV_RAD)
    return np.log(0.5 * width / np.tan(0.5 * view)), np.where(good, 0.06, 0.35)


def weighted_median(value: Array, weight: Array) -> float:
    """The value that splits the weight in halves."""
    order = np.argsort(value, kind="stable")
    total = np.cumsum(weight[order])
    return float(value[order][np.searchsorted(total, 0.5 * total[-1])])


def first_of(label: Ints, value: NDArray[np.generic], count: int) -> NDArray[np.generic]:
    """The value of the first member of each label, (count,)."""
    return np.array([value[label == k][0] for k in range(count)])
