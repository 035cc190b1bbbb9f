"""Ground scale of photos and segments from the distance flown, the scale between photos and recorded heights."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from orthoswarm.config import active
from orthoswarm.model.camera import fov_rad
from orthoswarm.refine.initial.planar_similarity import Array, Flags, Ints, PairGraph, PhotoRecords


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
    """Heights relative to the segment's median, from heights or, if there are none, from absolute altitudes.

    Args:
        records: of N photos.
        above: float64 (S,), height of each segment above the ground as known so far (altitudes give differences only).
    """
    config = active().initial
    share, least, most = config.height_known_share, 1.0 / config.height_ratio, config.height_ratio
    relative = np.full(len(records), np.nan)
    level = np.full(len(above), np.nan)
    for s in range(len(above)):
        rows = records.segment == s
        h, a = records.height_m[rows], records.altitude_m[rows]
        if np.isfinite(h).sum() > share * rows.sum() and np.nanmedian(h) > config.height_least_m:
            level[s] = float(np.nanmedian(h))
            ratio = h / level[s]
        elif np.isfinite(a).sum() > share * rows.sum():
            ratio = 1.0 + (a - np.nanmedian(a)) / above[s]
        else:
            continue
        relative[rows] = np.where((ratio > least) & (ratio < most), ratio, np.nan)
    known = np.isfinite(relative)
    return RecordedHeights(np.where(known, relative, 1.0), known, level)


def first_scale(graph: PairGraph, records: PhotoRecords, lens_of: Ints, focal: Array) -> tuple[Array, Flags]:
    """Metres per pixel of each segment (S,): recorded movement over the pictures' shift.

    And which lenses (L,) have one.

    Only pairs of nearly equal heading are used if there are any, as their shift does not depend on the tilt. A lens
    without a pair uses its recorded height and focal length.

    Args:
        graph: pairs of level pictures.
        records: of all photos.
        lens_of: int32 (S,), lens of each segment.
        focal: float64 (L,), pixels, as known so far.
    """
    config, default_m = active().initial, active().records.default_height_m
    i, j = graph.first, graph.second
    way = np.abs(records.position[j] - records.position[i])
    shift = np.abs(graph.centre_first - np.conj(graph.turn) * graph.centre_second)
    same = (records.lens[i] == records.lens[j]) & (way > config.scale_least_way_m)
    same &= shift > config.scale_least_shift_share * records.width[i]
    straight = same & (graph.turn.real > config.scale_turn_cosine)
    by_lens, measured = np.full(len(focal), np.nan), np.zeros(len(focal), bool)
    recorded = recorded_heights(records, np.full(len(lens_of), default_m)).segment
    for k in range(len(focal)):
        mine = records.lens[i] == k
        rows = np.flatnonzero(straight & mine)
        rows = rows if len(rows) >= config.scale_lens_pairs else np.flatnonzero(same & mine)
        if len(rows):
            by_lens[k], measured[k] = weighted_median(way[rows] / shift[rows], way[rows]), True
        else:
            high = recorded[(lens_of == k) & np.isfinite(recorded)]
            by_lens[k] = (float(np.median(high)) if len(high) else default_m) / focal[k]
    metres = by_lens[lens_of]
    for s in range(len(lens_of)):
        rows = np.flatnonzero(straight & (records.segment[i] == s) & (records.segment[j] == s))
        if len(rows) >= config.scale_segment_pairs:
            metres[s] = weighted_median(way[rows] / shift[rows], way[rows])
    return np.asarray(metres), measured


def relative_scales(graph: PairGraph, records: PhotoRecords, heights: RecordedHeights, count: int) -> Array:
    """Metres per pixel of each photo over its segment's, float64 (N,), from the scale between level pictures.

    One robust adjustment of the scales within each segment, with the recorded heights as priors.
    """
    config = active().initial
    i, j = graph.first, graph.second
    inside = np.flatnonzero(records.segment[i] == records.segment[j])
    i, j = i[inside], j[inside]
    zoom = np.log(np.maximum(np.abs(graph.factor[inside]), 1e-6))
    misfit = graph.residual[inside] / np.maximum(graph.spread[inside] * np.exp(zoom), 1.0)
    sigma = np.hypot(config.zoom_sigma, config.zoom_misfit_sigmas * misfit / np.sqrt(graph.count[inside]))
    prior = np.log(heights.relative)
    prior_sigma = np.where(heights.known, config.relative_height_sigma, config.relative_level_sigma)
    x = prior.copy()
    k = np.arange(len(inside))
    for c in config.scale_schedule:
        e = (zoom - (x[i] - x[j])) / sigma
        d = (prior - x) / prior_sigma
        # both sides of each row are multiplied by the square root of its Geman-McClure weight
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
    """Focal length of each lens in pixels, height over metres per pixel; NaN where no such lens exists."""
    narrowest, widest = np.radians(active().initial.hint_fov_deg)
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
    config = active().initial
    narrowest, widest = np.radians(config.hint_fov_deg)
    width = np.array([records.width[records.lens == k][0] for k in range(len(records.fov_hint))])
    with np.errstate(invalid="ignore"):
        good = (records.fov_hint > narrowest) & (records.fov_hint < widest)
    view = np.where(good, records.fov_hint, float(np.radians(config.default_fov_deg)))
    return np.log(0.5 * width / np.tan(0.5 * view)), np.where(good, config.hint_sigma, config.default_fov_sigma)


def weighted_median(value: Array, weight: Array) -> float:
    """The value that divides the total weight into halves."""
    order = np.argsort(value, kind="stable")
    total = np.cumsum(weight[order])
    return float(value[order][np.searchsorted(total, 0.5 * total[-1])])


def first_of(label: Ints, value: NDArray[np.generic], count: int) -> NDArray[np.generic]:
    """The value of the first member of each label, (count,)."""
    return np.array([value[label == k][0] for k in range(count)])
