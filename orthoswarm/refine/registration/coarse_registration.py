"""Coarse registration of one vehicle: strips correlated with the map, a consensus line, a smooth correction."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Flags, Indices, Ints
from orthoswarm.model.placement import MapWindow
from orthoswarm.raster.map_cache import TiledMap
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.registration.orientation_correlation import (
    COARSE_REACH_M,
    Match,
    Search,
    by_learning,
    register,
    stacked,
    strip_and_map,
)

_STRIP_PICTURES: Final = 25  # pictures of a strip in which corners are followed
_STRIP_PICTURES_SPARSE: Final = 3  # the same of photos that are matched in pairs: some hundred metres of ground
_STRIP_ACROSS_PX: Final = 150.0  # width of a picture in a strip (cost)
_STRIP_GSD_M: Final = (0.2, 2.5)  # limits of a strip's ground pixel
_CONSENSUS_M: Final = 6.0  # strips whose shifts lie this near to a line over the pictures agree
_CONSENSUS_SLOPE_M: Final = 0.5  # steepest such line, metres a picture: a receiver's drift
_CONSENSUS_LEAST_WEIGHT: Final = 0.02  # least weight of a strip (1 minus the ratio of its second peak to its first)
_LEARNED_PICTURES: Final = 16  # pictures of a strip that is matched by learned features
_LEARNED_STRIPS: Final = 5  # strips of a flight that are matched so: some seconds each (for its time)
_LEARNED_ACROSS_PX: Final = 300.0  # width of a picture in such a strip
_LEARNED_GSD_M: Final = (0.2, 0.6)  # limits of its ground pixel
_LEARNED_REACH_M: Final = 30.0  # how far they are searched (for its time)


@dataclass(frozen=True, slots=True)
class CoarseFit:
    """How a vehicle lies on the map after correlation.

    correction: float64 (N, 2), metres to add to each camera. matches: all windows found. inlier: bool for each.
    confidence: share of the windows that agree. If only the sum of their correlations has a peak: 1 minus the ratio of
    its second peak to the first.
    """

    correction: Array
    matches: list[Match]
    inlier: Flags
    confidence: float


def coarse_fits(flight: FlightBlock, basemap: MapWindow, origin: Array) -> Iterator[CoarseFit]:
    """Hypotheses where a flight lies on the map, the likeliest first, for the caller to verify.

    Strips of each leg near their records; then one shift for all strips together; then strips within a wider search.
    """
    gsd = float(np.clip(picture_width_m(flight) / _STRIP_ACROSS_PX, *_STRIP_GSD_M))
    tiles = TiledMap(basemap, gsd)
    near, far = COARSE_REACH_M
    for find, reach_m in ((_fit_within, near), (_fit_together, near), (_fit_within, far)):
        fit = find(flight, Search(tiles, origin, reach_m, gsd))
        if fit is not None:
            yield fit


def _fit_together(flight: FlightBlock, search: Search) -> CoarseFit | None:
    """One shift for the flight, from the sum of the correlations of all its strips (see `stacked`)."""
    cameras = flight.cameras()
    strips = [strip_and_map(cameras, index, flight.pictures.small, search) for index in _strips(flight)]
    found = stacked([s for s in strips if s is not None])
    if found is None:
        return None
    shift, z, ratio = found
    match = Match(0, len(cameras) - 1, (float(shift[0]), float(shift[1])), z, ratio)
    return CoarseFit(np.tile(shift, (len(cameras), 1)), [match], np.ones(1, bool), 1.0 - ratio)


def _fit_within(flight: FlightBlock, search: Search) -> CoarseFit | None:
    """A line of shifts on which most strips agree."""
    found = [register(flight.cameras(), index, flight.pictures.small, search) for index in _strips(flight)]
    return _agreed(flight, [m for m in found if m is not None])


def _agreed(flight: FlightBlock, matches: list[Match]) -> CoarseFit | None:
    """The line of shifts that most matches agree on; None without a match."""
    if not matches:
        return None
    inlier = _consensus(matches)
    return CoarseFit(_smooth(matches, inlier, len(flight.frames)), matches, inlier, float(inlier.mean()))


def learned_fit(flight: FlightBlock, basemap: MapWindow, origin: Array, device: str) -> CoarseFit | None:
    """Registration by learned matching of a few strips, where correlation found no consensus; None without one."""
    cameras, find = flight.cameras(), partial(by_learning, device=device)
    gsd = float(np.clip(picture_width_m(flight) / _LEARNED_ACROSS_PX, *_LEARNED_GSD_M))
    windows = _windows(flight.leg, _LEARNED_PICTURES)
    search = Search(TiledMap(basemap, gsd), origin, _LEARNED_REACH_M, gsd)
    chosen = np.unique(np.linspace(0, len(windows) - 1, _LEARNED_STRIPS).round().astype(int))
    found = [register(cameras, windows[k], flight.pictures.gray, search, find) for k in chosen]
    fit = _agreed(flight, [m for m in found if m is not None])
    if fit is None or fit.inlier.sum() < max(2, len(fit.matches) // 2 + 1):
        return None
    return replace(fit, confidence=float(fit.inlier.sum()) / len(chosen))


def shift_cameras(flight: FlightBlock, correction: Array) -> None:
    """Move cameras and points by a correction (N, 2), and the drift with them, so that the records still agree."""
    adj = flight.adjustment
    adj.cameras.position[:, :2] += correction
    n = len(adj.points)
    count = np.maximum(np.bincount(adj.tracks.point, minlength=n), 1)
    for a in range(2):
        adj.points[:, a] += np.bincount(adj.tracks.point, correction[adj.tracks.camera, a], minlength=n) / count
    lay = adj.layout
    for g, (at, knots) in enumerate(zip(lay.offset, lay.knots)):
        members = np.flatnonzero(adj.priors.group == g)
        if knots and len(members):
            where = lay.knot_left[members] + lay.knot_fraction[members]
            for a in range(2):
                columns = at + 5 + 2 * np.arange(knots) + a
                adj.common[columns] += np.interp(np.arange(knots), where, correction[members, a])


def picture_width_m(flight: FlightBlock) -> float:
    """Width of a picture on the ground, metres."""
    return flight.pictures.size[0] / flight.focal_px * flight.height_m


def _strips(flight: FlightBlock) -> list[Indices]:
    return _windows(flight.leg, _STRIP_PICTURES_SPARSE if flight.sparse else _STRIP_PICTURES)


def _windows(leg: Ints, size: int) -> list[Indices]:
    """Runs of about `size` pictures of one leg each; short legs are one window."""
    out: list[Indices] = []
    for k in range(int(leg.max()) + 1 if len(leg) else 0):
        members = np.flatnonzero(leg == k)
        parts = max(1, round(len(members) / size))
        out += [p for p in np.array_split(members, parts) if len(p) >= 2]
    return out or ([np.arange(len(leg))] if len(leg) else [])


def _consensus(matches: Sequence[Match]) -> Flags:
    """Largest set of windows that lie on a line of correction against picture number, sure ones counting more."""
    t = np.array([0.5 * (m.first + m.last) for m in matches])
    s = np.array([m.shift for m in matches])
    weight = np.clip(1.0 - np.array([m.ratio for m in matches]), _CONSENSUS_LEAST_WEIGHT, 1.0)
    n = len(matches)
    best, best_score = np.zeros(n, bool), -1.0
    for i in range(n):
        for j in range(i, n):
            slope = (s[j] - s[i]) / (t[j] - t[i]) if j > i and t[j] > t[i] else np.zeros(2)
            if np.hypot(*slope) > _CONSENSUS_SLOPE_M:
                continue
            error = np.hypot(*(s - s[i] - slope * (t - t[i])[:, None]).T)
            inside = error < _CONSENSUS_M
            score = float((weight * inside * (1.0 - 0.5 * error / _CONSENSUS_M)).sum())
            if score > best_score:
                best, best_score = inside, score
    return best


def _smooth(matches: Sequence[Match], inlier: Flags, count: int) -> Array:
    """Correction of each picture: medians of three neighbouring windows, linear between, constant beyond."""
    chosen = [m for m, ok in zip(matches, inlier) if ok]
    t = np.array([0.5 * (m.first + m.last) for m in chosen])
    s = np.array([m.shift for m in chosen])
    order = np.argsort(t, kind="stable")
    t, s = t[order], s[order]
    calm = np.array([np.median(s[max(0, i - 1) : i + 2], axis=0) if len(s) > 2 else s[i] for i in range(len(s))])
    if len(s) > 2:
        calm[[0, -1]] = 0.5 * (calm[[0, -1]] + s[[0, -1]])
    i = np.arange(count, dtype=float)
    return np.column_stack([np.interp(i, t, calm[:, a]) for a in range(2)])
