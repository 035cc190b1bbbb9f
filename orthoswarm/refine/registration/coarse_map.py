"""Where a block of vehicles lies on a map whose pixels are far coarser than theirs, as satellite maps of 5 to 10 m.

On such a map no single picture can be recognised, and nothing but one shift of all can be found: the pictures, averaged
to the map's pixel, are correlated with it as one mosaic. The correlation at all other shifts tells how high a peak is
by chance (an a-contrario test as in `map_evidence`); leaving out a part of the ground at a time tells how well the peak
is known (delete-a-group jackknife; Efron and Tibshirani 1993, An Introduction to the Bootstrap, chapter 11).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from orthoswarm.model.arrays import Array, Flags, Floats
from orthoswarm.model.placement import MapWindow
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.registration.map_evidence import FALSE_MATCHES
from orthoswarm.refine.registration.orientation_correlation import (
    COARSE_REACH_M,
    PEAK_APART_PX,
    STRIP_FEWEST_EDGES,
    Mosaic,
    OrientationField,
    Search,
    correlation,
    edges_of,
    highest,
    on_map,
    standing_out,
    strip_mosaic,
)

_STEP = 2  # pixels of the correlation in one of the map's, and of the mosaic in one of the correlation

_COARSE_MAP_GSD_M: Final = 4.5
"""On maps with larger pixels, metres, no tie points are searched. On three sets (0.47 m a pixel) maps of 4 m place
pictures within 0.3 to 0.8 m by tie points, 0.7 to 0.9 m by one shift; of 5 m within 1.5 to 1.7 m by tie points with
sigmas of 0.6 to 1.3 m, 1.2 to 1.8 m by one shift with 1.2 to 1.4 m; of 10 m not at all by ties ..."""
_COARSE_MAP_PICTURES: Final = 8.0  # ... unless they are smaller than so many of the pictures' pixels
_COARSE_MAP_SHARE: Final = 0.95  # least share of a map's pixel that the pictures must show
_COARSE_MAP_TEXTURE: Final = 0.5
"""Length of gradients with the most weight, in medians: strong edges belong to what leans and casts shadows. Error of
an axis on four sets with 0.5 and 1.0: 0.82 and 1.07 m on maps of 5 m, 1.92 and 2.09 m of 10 m."""
_COARSE_MAP_PARTS: Final = 16  # parts of the ground that are left out in turn to find the shift's sigma (for its time)
_COARSE_MAP_SIGMA_PX: Final = 0.22
"""What shadows and leaning buildings of the map displace, one sigma an axis, in its pixels: 1.9 m at 10 m and 0.8 m at
5 m on four sets with maps from 12 to 15 degrees off nadir, 2.3 and 2.0 m in another season; a map without lean is right
to 0.5 m at 10 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CoarseMapShift:
    """One shift of a block onto a coarse map of pixel gsd_m: metres to add, and their sigma, an axis.

    confidence: 1 minus the ratio of the second peak to the first. false_matches: expected number of peaks as high on a
    map of other ground.
    """

    east: float
    north: float
    sigma_m: float
    gsd_m: float
    confidence: float
    false_matches: float


def is_coarse(flight: FlightBlock, basemap: MapWindow) -> bool:
    """Whether a map's pixels are too coarse for tie points of a flight's pictures."""
    picture_m = flight.height_m / flight.focal_px
    return basemap.native_gsd_m > max(_COARSE_MAP_GSD_M, _COARSE_MAP_PICTURES * picture_m)


def shift_on_coarse_map(
    flights: Sequence[FlightBlock], basemap: MapWindow, origin: Array, ground_z: float
) -> CoarseMapShift | None:
    """Where vehicles that make one block lie on a coarse map, None if it shows no such place; ground_z: their level."""
    gsd = basemap.native_gsd_m / _STEP
    drawn = _mosaic(flights, ground_z, gsd)
    strip = None if drawn is None else on_map(drawn, Search(basemap, origin, COARSE_REACH_M[0], gsd))
    if strip is None:
        return None
    moving, fixed = _texture(strip.gray, strip.valid), _texture(strip.ground, strip.known)
    if min(np.count_nonzero(moving), np.count_nonzero(fixed)) < STRIP_FEWEST_EDGES:
        return None
    score = correlation(moving, fixed, strip.reach)
    column, row, _, ratio = highest(score, PEAK_APART_PX)
    z = standing_out(score, PEAK_APART_PX)
    false_matches = float(np.exp(np.log(score.size) + log_ndtr(-z)))
    if false_matches > FALSE_MATCHES:
        return None
    spread = _jackknife(moving, fixed, strip.reach)
    return CoarseMapShift(
        east=float(strip.offset[0] + gsd * column),
        north=float(strip.offset[1] - gsd * row),
        sigma_m=float(np.hypot(gsd * spread, _COARSE_MAP_SIGMA_PX * basemap.native_gsd_m)),
        gsd_m=basemap.native_gsd_m,
        confidence=1.0 - ratio,
        false_matches=false_matches,
    )


def _mosaic(flights: Sequence[FlightBlock], ground_z: float, gsd_m: float) -> Mosaic | None:
    """Grey mosaic of all vehicles, averaged over the map's pixel, with its validity, west and north edges."""
    fine = gsd_m / _STEP
    parts = []
    for flight in flights:
        every = np.arange(len(flight.frames))
        part = strip_mosaic(flight.adjustment.cameras, every, flight.pictures.small, ground_z, fine)
        flight.pictures.drop()
        if part is not None:
            parts.append(part)
    if not parts:
        return None
    west = float(np.floor(min(p[2] for p in parts) / gsd_m) * gsd_m)
    north = float(np.ceil(max(p[3] for p in parts) / gsd_m) * gsd_m)
    places = [(round((north - n) / fine), round((w - west) / fine)) for _, _, w, n in parts]
    rows, columns = (
        -(-max(at[axis] + p[0].shape[axis] for at, p in zip(places, parts)) // _STEP) * _STEP for axis in (0, 1)
    )
    total, count = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    for (row, column), (grey, valid, _, _) in zip(places, parts):
        cut = (slice(row, row + grey.shape[0]), slice(column, column + grey.shape[1]))
        total[cut] += np.where(valid, grey, 0.0)
        count[cut] += valid
    side, middle = (_STEP * _STEP,) * 2, (_STEP * _STEP // 2,) * 2  # the map's pixel, from its upper left corner on
    shown = np.where(count > 0, total / np.maximum(count, 1.0), 0.0), count > 0
    sums = (
        cv2.boxFilter(part.astype(np.float32), -1, side, anchor=middle, borderType=cv2.BORDER_CONSTANT)
        for part in shown
    )
    mean, share = (part[_STEP // 2 :: _STEP, _STEP // 2 :: _STEP] for part in sums)
    valid = share > _COARSE_MAP_SHARE
    return np.asarray(np.where(valid, mean / np.maximum(share, 1e-6), 0.0), np.float32), valid, west, north


def _texture(grey: Floats, valid: Flags) -> OrientationField:
    """Gradients g m / (|g|^2 + m^2) as complex numbers, 0 where not valid; see `patch_matching.gradients`."""
    gradient, length, inner = edges_of(grey, valid)
    middle = _COARSE_MAP_TEXTURE * float(np.median(length[inner])) if inner.any() else 0.0
    weight = middle / np.maximum(length**2 + middle**2, 1e-6)
    return np.asarray(np.where(inner, gradient * weight, 0), np.complex64)


def _jackknife(moving: OrientationField, fixed: NDArray[np.complex64], reach: int) -> float:
    """Sigma of an axis of the peak's place, pixels, by leaving out a part of the mosaic at a time."""
    rows, columns = np.nonzero(moving)
    across = max(1, round(float(np.sqrt(_COARSE_MAP_PARTS))))
    row_edges = np.quantile(rows, np.linspace(0.0, 1.0, across + 1))
    column_edges = np.quantile(columns, np.linspace(0.0, 1.0, across + 1))
    places = []
    for i in range(across):
        for j in range(across):
            part = (rows >= row_edges[i]) & (rows <= row_edges[i + 1])
            part &= (columns >= column_edges[j]) & (columns <= column_edges[j + 1])
            if not part.any() or part.all():
                continue
            left = moving.copy()
            left[rows[part], columns[part]] = 0
            places.append(highest(correlation(left, fixed, reach), PEAK_APART_PX)[:2])
    n = len(places)
    return float("inf") if n < 2 else float(np.sqrt((n - 1) * np.array(places).var(axis=0).mean()))
