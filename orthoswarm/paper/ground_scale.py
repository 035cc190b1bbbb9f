"""Metres per pixel from overlapping frames and the distance flown, and the field of view by Eq. 4 (paper III.C)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.matchers.matcher import Matches, PictureMatcher
from orthoswarm.model.arrays import Array, Gray
from orthoswarm.model.camera import focal_px
from orthoswarm.model.robust import mad_sigma

_SCALE_PAIR_HEIGHTS: Final = 0.35  # wanted distance between the two photos, flying heights: about 70 % overlap
_SCALE_PAIR_RANGE_HEIGHTS: Final = (0.05, 1.0)  # range of that distance, flying heights
_SCALE_CENTRE_SHARE: Final = 0.3  # matches count up to this share of the picture's height from the orthogonal centre
_SCALE_LEAST_SHIFT_PX: Final = 2.0  # shorter shifts do not count
_SCALE_MATCHES: Final = 12  # least matches that agree on a scale
_SCALE_SCATTER: Final = 0.2  # largest standard deviation of the shifts as a share of their mean
SCALE_LEAST_PAIRS: Final = 3  # least pairs that give a field of view
_OUTLIER_SIGMAS: Final = 2.0  # Gaussian outlier suppression keeps what lies within so many standard deviations
_OUTLIER_ROUNDS: Final = 20  # most rounds of it


@dataclass(frozen=True, slots=True)
class Gaussian:
    """Mean and standard deviation of the inliers."""

    mean: float  # of the inliers
    sigma: float  # of the inliers
    inliers: int  # how many


def gaussian(samples: Array) -> Gaussian:
    """Gaussian outlier suppression: mean and standard deviation of the samples near the mean, iterated.

    It starts at the median and the median absolute deviation, since outliers may pull the mean far off.
    """
    mean = float(np.median(samples))
    sigma = mad_sigma(samples - mean)
    inliers = samples
    for _ in range(_OUTLIER_ROUNDS):
        inside = np.abs(samples - mean) <= _OUTLIER_SIGMAS * max(sigma, 1e-12)
        if not inside.any():
            break
        inliers = samples[inside]
        before = mean
        mean, sigma = float(inliers.mean()), float(inliers.std())
        if abs(mean - before) <= 1e-9 * abs(mean):
            break
    return Gaussian(mean, sigma, len(inliers))


def metres_per_pixel(matches: Matches, centre: tuple[float, float], reach_px: float, flown_m: float) -> float | None:
    """Ground sampling distance at the orthogonal centre from two frames of a leg: distance flown / image shift.

    Args:
        matches: between the two pictures. centre: column and row of the orthogonal centre (straight below).
        reach_px: matches farther from the centre are not used, since relief and tilt distort them.
        flown_m: distance between the two frames along the leg's line.

    Returns:
        Metres per pixel; None where too few matches agree.
    """
    if len(matches) < _SCALE_MATCHES or flown_m <= 0:
        return None
    middle = 0.5 * (matches.a + matches.b)
    near = np.hypot(*(middle - centre).T) <= reach_px
    shift = np.hypot(*(matches.b - matches.a)[near].T)
    shift = shift[shift > _SCALE_LEAST_SHIFT_PX]
    if len(shift) < _SCALE_MATCHES:
        return None
    found = gaussian(shift)
    if found.inliers < _SCALE_MATCHES or found.sigma > _SCALE_SCATTER * found.mean:
        return None
    return flown_m / found.mean


def field_of_view(scale_m: float, width: int, height_m: float, tilt_rad: float = 0.0) -> float:
    """Eq. 4: the horizontal field of view in radians.

    theta = 2 arctan(L / d) with L = scale W / 2, HALF the ground width that the picture's width would cover at the
    scale of the orthogonal centre, and d = h cos(tilt), the depth of the orthogonal centre along the optical axis.
    The printed equation uses the full width, inverts the fraction of L, and divides by the slant height of the
    image centre although the scale is measured at the orthogonal centre; see docs/method.md.
    """
    return 2.0 * float(np.arctan2(0.5 * scale_m * width, height_m * np.cos(tilt_rad)))


@dataclass(frozen=True, slots=True)
class ScaleTask:
    """A pair of frames of one leg that gives one measurement of the scale."""

    first: int  # indices
    second: int  # indices
    flown_m: float  # along the line
    height_m: float  # mean height
    tilt_rad: float  # mean tilt of the camera


def choose_pairs(along: Array, height: Array, tilt: Array, members: NDArray[np.integer], count: int) -> list[ScaleTask]:
    """Up to `count` pairs, evenly spread over a leg, with a distance near `_SCALE_PAIR_HEIGHTS` flying heights.

    Args:
        along: float64 (n,), distance along the line of the leg's frames, in flying order. height: float64 (n,), metres.
        tilt: float64 (n,), radians from straight down. members: (n,), the frames' indices in the vehicle.
        count: how many pairs.
    """
    n, ratio = len(along), _SCALE_PAIR_HEIGHTS
    least, most = _SCALE_PAIR_RANGE_HEIGHTS
    found = []
    for i in np.unique(np.linspace(0, n - 2, min(count, n - 1)).round().astype(int)).tolist():
        later = np.arange(i + 1, n)
        j = int(later[np.argmin(np.abs(np.abs(along[later] - along[i]) - ratio * height[i]))])
        flown = float(abs(along[j] - along[i]))
        if least * height[i] <= flown <= most * height[i]:
            h, t = float(0.5 * (height[i] + height[j])), float(0.5 * (tilt[i] + tilt[j]))
            found.append(ScaleTask(int(members[i]), int(members[j]), flown, h, t))
    return found


def orthogonal_centre(rotation: Array, focal: float, size: tuple[int, int]) -> tuple[float, float]:
    """Column and row of the ground point straight below a camera; rotation (3, 3), focal length and size in pixels."""
    down = rotation.T @ np.array([0.0, 0.0, -1.0])
    u = focal * down[0] / max(float(down[2]), 0.2) + 0.5 * (size[0] - 1)
    v = focal * down[1] / max(float(down[2]), 0.2) + 0.5 * (size[1] - 1)
    return float(u), float(v)


def estimate_fov(
    tasks: list[ScaleTask],
    gray: Callable[[int], Gray],
    rotation: Array,
    *,
    size: tuple[int, int],
    start_rad: float,
    matcher: PictureMatcher,
) -> Gaussian | None:
    """The field of view (radians) of a camera from pairs of frames, outliers suppressed; None if too few agree.

    Args:
        tasks: pairs. gray: picture i. rotation: float64 (N, 3, 3). size: width and height of the pictures.
        start_rad: first guess, used only to place the orthogonal centre. matcher: for the pairs.
    """
    focal = focal_px(start_rad, size[0])
    found = []
    for task in tasks:
        matches = matcher.match(gray(task.first), gray(task.second))
        centres = [orthogonal_centre(rotation[i], focal, size) for i in (task.first, task.second)]
        middle = (0.5 * (centres[0][0] + centres[1][0]), 0.5 * (centres[0][1] + centres[1][1]))
        scale = metres_per_pixel(matches, middle, _SCALE_CENTRE_SHARE * size[1], task.flown_m)
        if scale is not None:
            found.append(field_of_view(scale, size[0], task.height_m, task.tilt_rad))
    if len(found) < SCALE_LEAST_PAIRS:
        return None
    return gaussian(np.array(found))
