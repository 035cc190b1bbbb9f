"""Correlation of gradient orientations: small mosaics against the map by one FFT, no network, any season."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from orthoswarm.model.arrays import Array, Flags, Floats, Gray
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import MapWindow
from orthoswarm.raster.subpixel_peak import vertex
from orthoswarm.refine.bundle.block_arrays import CameraBlock

OrientationField = NDArray[np.complex64]

Mosaic = tuple[Floats, Flags, float, float]
"""Grey values (rows, columns), their validity, west and north edges, metres in the local frame."""

Found = tuple[float, float, float, float]
"""Column and row of a shift from the centre, pixels, peak, and ratio of second peak to peak."""

COARSE_REACH_M: Final = (60.0, 150.0)
"""How far strips are searched: first, and where that is refuted (receivers without corrections are within the
first)."""
_STRIP_MOST_PX: Final = 4_000_000  # larger strips are not correlated (memory)
_STRIP_FARTHEST_HEIGHTS: Final = 4.0
"""A picture that looks farther than so many flying heights and the next field is left out: horizon."""
_STRIP_FARTHEST_M: Final = 50.0  # ... and this
STRIP_MAP_SHARE: Final = 0.1  # least share of a strip's search area that the map covers
_STRIP_BLUR_PX: Final = 0.7  # sigma of the blur before the gradients
STRIP_FEWEST_EDGES: Final = 400  # fewer pixels with an orientation, in the strip or on the map, show nothing
_STRIP_BORDER_PX: Final = 5  # side of the square by which the valid part is eroded: gradients at its edge are artefacts
_ENERGY_SHARE: Final = 0.05  # least energy of the map under a shift, as a share of the largest
PEAK_APART_PX: Final = 4  # correlations within this distance, pixels, belong to the same peak
_STACK_BLUR_PX: Final = 2.0
"""Sigma of the blur of the correlations that are summed over a flight: strips lie a little wrong among themselves (of
96 flights of 42 pictures 37 had no consensus; 20 of them are found by the sum, none wrong, and none on 288 maps of
other ground)."""
_STACK_APART_PX: Final = 6  # `PEAK_APART_PX` for that sum (measured together)
_STACK_MAP_SHARE: Final = 0.7  # least share of the search area that the map covers, for a strip to be summed


@dataclass(frozen=True, slots=True)
class Match:
    """A window of consecutive pictures found on the map.

    first, last: its pictures (inclusive). shift: (2,) east, north: what has to be added to the cameras, metres. peak:
    correlation. ratio: second peak / peak (small is sure).
    """

    first: int
    last: int
    shift: tuple[float, float]
    peak: float
    ratio: float


def edges_of(gray: Floats, valid: Flags) -> tuple[OrientationField, Floats, Flags]:
    """Gradients gx + i gy, their lengths, and where they are no artefact of the valid part's edge."""
    side = np.ones((_STRIP_BORDER_PX, _STRIP_BORDER_PX), np.uint8)
    gradient = cv2.Sobel(gray, cv2.CV_32F, 1, 0) + 1j * cv2.Sobel(gray, cv2.CV_32F, 0, 1)
    return gradient, np.abs(gradient), cv2.erode(valid.astype(np.uint8), side, borderValue=0).astype(bool)


def orientation_field(gray: Floats, valid: Flags) -> OrientationField:
    """Double-angle orientation field (gx + i gy)^2 / |g|^2 * |g| / (|g| + median |g|), 0 where not valid.

    An edge keeps its value when light and dark change places.
    """
    g, size, inner = edges_of(gray, valid)
    middle = float(np.median(size[inner])) if inner.any() else 1.0
    return np.asarray(np.where(inner, g * g / (np.maximum(size, 1e-3) * (size + max(middle, 1e-3))), 0), np.complex64)


def correlation(moving: OrientationField, fixed: OrientationField, reach: int) -> Floats:
    """Correlation (2 reach + 1, 2 reach + 1) of a field (h, w) with a larger one (h + 2 reach, w + 2 reach).

    At [reach + row, reach + column] of the shift; normalised by the energies under the overlap.
    """
    shape = tuple(int(fft.next_fast_len(n)) for n in fixed.shape)
    weight = (moving != 0).astype(np.float32)
    f_fixed = fft.fft2(fixed, shape)
    product = fft.ifft2(f_fixed * np.conj(fft.fft2(moving, shape))).real
    # energies of both under the overlap: a mask as a second complex channel saves one transform
    energy_fixed = fft.irfft2(fft.rfft2(np.abs(fixed) ** 2, shape) * np.conj(fft.rfft2(weight, shape)), shape)
    energy = float((np.abs(moving) ** 2).sum())
    n = 2 * reach + 1
    floor = _ENERGY_SHARE * float(energy_fixed[:n, :n].max()) + 1e-6
    score = product[:n, :n] / np.sqrt(np.maximum(energy_fixed[:n, :n], floor) * max(energy, 1e-6))
    return np.asarray(score, np.float32)


def highest(score: Floats, apart: int) -> Found:
    """Peak of a correlation, sub-pixel; what is nearer than `apart` + 1 pixels belongs to it."""
    n = len(score)
    r, c = np.unravel_index(int(score.argmax()), score.shape)
    peak = float(score[r, c])
    rest = _without(score, int(r), int(c), apart)
    ratio = float(rest.max()) / max(peak, 1e-9)
    dc, dr = 0.0, 0.0
    if 0 < r < n - 1 and 0 < c < n - 1:
        dc = vertex(float(score[r, c - 1]), peak, float(score[r, c + 1]))
        dr = vertex(float(score[r - 1, c]), peak, float(score[r + 1, c]))
    return c + dc - n // 2, r + dr - n // 2, peak, ratio


def standing_out(score: Floats, apart: int) -> float:
    """How many standard deviations of the rest a correlation's peak stands over their mean."""
    r, c = np.unravel_index(int(score.argmax()), score.shape)
    rest = _without(score, int(r), int(c), apart)
    rest = rest[rest != 0]
    return (float(score[r, c]) - float(rest.mean())) / max(float(rest.std()), 1e-9)


def _without(score: Floats, row: int, column: int, apart: int) -> Floats:
    rest = score.copy()
    rest[max(0, row - apart) : row + apart + 1, max(0, column - apart) : column + apart + 1] = 0
    return rest


def strip_mosaic(
    cameras: CameraBlock, index: NDArray[np.integer], small: Callable[[int], Gray], ground_z: float, gsd_m: float
) -> Mosaic | None:
    """Nearest-nadir mosaic of some pictures on a level plane; None where nothing is seen.

    small: reduced picture i; its scale is taken from its width.
    """
    corners, homographies = [], []
    for i in index:
        camera = cameras.camera(int(i), np.zeros(2))
        quad = camera.corners(ground_z)
        height = abs(camera.position[2] - ground_z)
        farthest = _STRIP_FARTHEST_HEIGHTS * height + _STRIP_FARTHEST_M
        if not np.isfinite(quad).all() or np.abs(quad - camera.nadir).max() > farthest:
            continue
        corners.append(quad)
        homographies.append((int(i), camera))
    if not corners:
        return None
    low, high = np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))
    west, north = np.floor(low[0] / gsd_m) * gsd_m, np.ceil(high[1] / gsd_m) * gsd_m
    width, height = int(np.ceil((high[0] - west) / gsd_m)), int(np.ceil((north - low[1]) / gsd_m))
    if width * height > _STRIP_MOST_PX:
        return None
    out = np.zeros((height, width), np.float32)
    best = np.full((height, width), np.inf, np.float32)
    to_grid = np.array([[1 / gsd_m, 0, -west / gsd_m - 0.5], [0, -1 / gsd_m, north / gsd_m - 0.5], [0, 0, 1.0]])
    for (i, camera), quad in zip(homographies, corners):
        picture = small(i)
        scale = camera.lens.width / picture.shape[1]
        up = np.array([[scale, 0, 0.5 * scale - 0.5], [0, scale, 0.5 * scale - 0.5], [0, 0, 1.0]])
        pixels = np.c_[quad, np.ones(4)] @ to_grid.T
        c0, r0 = np.maximum(np.floor(pixels[:, :2].min(0)).astype(int), 0)
        c1, r1 = np.minimum(np.ceil(pixels[:, :2].max(0)).astype(int) + 1, [width, height])
        if c1 <= c0 or r1 <= r0:
            continue
        shift = np.array([[1, 0, -c0], [0, 1, -r0], [0, 0, 1.0]])
        h = shift @ to_grid @ camera.homography(ground_z) @ up
        warped = cv2.warpPerspective(picture.astype(np.float32) + 1, h, (int(c1 - c0), int(r1 - r0)))
        nadir = to_grid @ np.array([*camera.nadir, 1.0])
        d2 = (np.arange(c0, c1) - nadir[0])[None, :] ** 2 + (np.arange(r0, r1) - nadir[1])[:, None] ** 2
        view = best[r0:r1, c0:c1]
        wins = (warped >= 1) & (d2 < view)
        view[wins] = d2[wins]
        out[r0:r1, c0:c1][wins] = warped[wins] - 1
    return out, np.isfinite(best), float(west), float(north)


@dataclass(frozen=True, slots=True, kw_only=True)
class Strip:
    """A mosaic of consecutive pictures and the part of the map where it may lie.

    gray, valid: the mosaic, float32 and bool (rows, columns). ground, known: the map, `reach` pixels wider on every
    side. gsd_m: pixel of both. offset: (2,) east, north: where the map's pixels lie from those of the mosaic, less than
    a pixel, metres.
    """

    gray: Floats
    valid: Flags
    ground: Floats
    known: Flags
    reach: int
    gsd_m: float
    offset: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Search:
    """Where strips are sought: on a map about the origin (2,), to reach_m on each side, in pixels of gsd_m."""

    basemap: MapWindow
    origin: Array
    reach_m: float
    gsd_m: float


def strip_and_map(
    cameras: CameraBlock, index: NDArray[np.integer], picture: Callable[[int], Gray], search: Search
) -> Strip | None:
    """Mosaic some consecutive pictures and read the map around them; None where either has nothing to show."""
    mosaic = strip_mosaic(cameras, index, picture, 0.0, search.gsd_m)
    return None if mosaic is None else on_map(mosaic, search)


def on_map(mosaic: Mosaic, search: Search) -> Strip | None:
    """A mosaic with the map around it; None where the map hardly covers that."""
    basemap, origin, gsd_m = search.basemap, search.origin, search.gsd_m
    gray, valid, west, north = mosaic
    reach = int(np.ceil(search.reach_m / gsd_m))
    rows, cols = gray.shape
    bounds = BoundingBox(
        origin[0] + west - reach * gsd_m,
        origin[1] + north - (rows + reach) * gsd_m,
        origin[0] + west + (cols + reach) * gsd_m,
        origin[1] + north + reach * gsd_m,
    )
    ground, known = basemap.gray(bounds, gsd_m)
    ground, known = ground[: rows + 2 * reach, : cols + 2 * reach], known[: rows + 2 * reach, : cols + 2 * reach]
    if ground.shape != (rows + 2 * reach, cols + 2 * reach) or known.mean() < STRIP_MAP_SHARE:
        return None
    grid = GroundGrid.around(basemap.epsg, bounds, gsd_m)
    return Strip(
        gray=gray, valid=valid, ground=ground, known=known, reach=reach, gsd_m=gsd_m,
        offset=(grid.west - bounds[0], grid.north - bounds[3]),
    )  # fmt: skip


def by_edges(strip: Strip) -> Found | None:
    """Where a strip lies on its map, by their edges."""
    fields = _edges(strip)
    return None if fields is None else highest(correlation(*fields, strip.reach), PEAK_APART_PX)


def _edges(strip: Strip) -> tuple[OrientationField, OrientationField] | None:
    """Orientation fields of a strip and of its map; None where one of them has hardly an edge."""
    moving = orientation_field(cv2.GaussianBlur(strip.gray, (0, 0), _STRIP_BLUR_PX), strip.valid)
    fixed = orientation_field(cv2.GaussianBlur(strip.ground, (0, 0), _STRIP_BLUR_PX), strip.known)
    edges = min(np.count_nonzero(moving), np.count_nonzero(fixed))
    return None if edges < STRIP_FEWEST_EDGES else (moving, fixed)


def stacked(strips: Sequence[Strip]) -> tuple[Array, float, float] | None:
    """Where strips of one flight, at one pixel size and reach, lie on the map by the sum of what each says.

    Strips that lie a little wrong among themselves (tilt, field of view and drift are not known yet) have low and
    ragged peaks, each near the right place: blurred and summed they make one that stands out (see `_STACK_BLUR_PX`).
    Returns the shift (2,) east, north in metres, the peak in standard deviations of the rest, and the ratio of the
    second peak to it: a guess that the caller must confirm. None where no strip has an edge.
    """
    total = None
    for strip in strips:
        fields = None if strip.known.mean() < _STACK_MAP_SHARE else _edges(strip)
        if fields is None:
            continue
        energy = float((np.abs(fields[0]) ** 2).sum())
        score = cv2.GaussianBlur(correlation(*fields, strip.reach), (0, 0), _STACK_BLUR_PX)
        score *= np.sqrt(energy) / max(float(score.std()), 1e-9)
        total = score if total is None else total + score
    if total is None:
        return None
    column, row, _, ratio = highest(total, _STACK_APART_PX)
    z = standing_out(total, _STACK_APART_PX)
    offset, gsd = np.mean([s.offset for s in strips], axis=0), strips[0].gsd_m
    return offset + gsd * np.array([column, -row]), z, ratio


def by_learning(strip: Strip, device: str) -> Found | None:
    """Where a strip lies on the map by learned matching, some seconds a strip: for strips whose edges do not agree.

    device: where the network runs.
    """
    from orthoswarm.matchers.patch_registration import second_opinion

    shift = second_opinion(strip.gray, strip.valid, strip.ground, known=strip.known, reach=strip.reach, device=device)
    return None if shift is None else (float(shift[0]), float(shift[1]), 1.0, 0.0)


def register(
    cameras: CameraBlock, index: NDArray[np.integer], picture: Callable[[int], Gray], search: Search,
    find: Callable[[Strip], Found | None] = by_edges,
) -> Match | None:  # fmt: skip
    """Find the mosaic of some consecutive pictures on the map; None where there is nothing to find."""
    strip = strip_and_map(cameras, index, picture, search)
    found = None if strip is None else find(strip)
    if strip is None or found is None:
        return None
    columns, rows, peak, ratio = found
    shift = strip.offset[0] + columns * strip.gsd_m, strip.offset[1] - rows * strip.gsd_m
    return Match(int(index[0]), int(index[-1]), shift, peak, ratio)
