"""How far the ground moves from one picture to the next, from features of pictures decoded at reduced size."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.raster.picture_file import PictureError, read_gray, reduction

Array = NDArray[np.float64]

_MOTION_LEAST_INLIERS: Final = 25  # corners that the motion between two pictures takes at least
_MOTION_RATIO: Final = 0.8  # ratio test of their matches (Lowe 2004)
_MOTION_MOST_TURN_RAD: Final = 0.4  # two pictures that turn by more are not on one straight leg


@dataclass(frozen=True, slots=True)
class PictureFile:
    """A picture and its size in pixels."""

    path: Path
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Features:
    """Features of one picture at reduced size.

    Attributes:
        points: (N, 2) column and row. descriptors: (N, 128) float32. centre: (2,) column and row of the middle.
    """

    points: Array
    descriptors: NDArray[np.float32]
    centre: Array


def features(picture: PictureFile, *, width: int = 480, most: int = 800) -> Features | None:
    """SIFT features of a picture reduced to a width in pixels; None where it cannot be decoded or shows too few."""
    import cv2

    try:
        gray = read_gray(picture.path, reduction(picture.width, picture.height, width))
    except PictureError:
        return None
    scale = min(1.0, width / gray.shape[1])
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1.0 else gray
    points, descriptors = cv2.SIFT.create(nfeatures=most).detectAndCompute(small, None)
    if descriptors is None or len(points) < _MOTION_LEAST_INLIERS:
        return None
    middle = 0.5 * (np.array([small.shape[1], small.shape[0]], dtype=np.float64) - 1.0)
    return Features(np.array([p.pt for p in points]), descriptors, middle)


@dataclass(frozen=True, slots=True)
class Shift:
    """How the ground in the middle of one picture moves to another.

    Attributes:
        pixels: (2,) columns and rows at the reduced size. turned_rad: clockwise as seen. inliers: matches that agree.
    """

    pixels: Array
    turned_rad: float
    inliers: int


def centre_shift(one: Features, two: Features) -> Shift | None:
    """The similarity on which most matches agree; None where too few do."""
    import cv2

    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one.descriptors, two.descriptors, k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < _MOTION_RATIO * p[1].distance]
    if len(good) < _MOTION_LEAST_INLIERS:
        return None
    source = np.array([one.points[m.queryIdx] for m in good])
    target = np.array([two.points[m.trainIdx] for m in good])
    model, inliers = cv2.estimateAffinePartial2D(source, target, method=cv2.RANSAC, ransacReprojThreshold=4.0)
    count = 0 if inliers is None else int(inliers.sum())
    if model is None or count < _MOTION_LEAST_INLIERS:
        return None
    shift = model[:, :2] @ one.centre + model[:, 2] - one.centre
    return Shift(shift, float(np.arctan2(model[1, 0], model[0, 0])), count)


def shifts_px(pictures: Sequence[PictureFile], *, width: int = 320, most: int = 250, workers: int = 2) -> Array:
    """(N - 1,) pixels, at this width, that the ground moves between consecutive pictures; 20 ms a picture.

    NaN where two do not match, or where the vehicle turned: the way around a turn is longer than the shift.
    """
    with ThreadPoolExecutor(max(1, workers)) as pool:
        found = list(pool.map(lambda picture: features(picture, width=width, most=most), pictures))

        def length(i: int) -> float:
            one, two = found[i], found[i + 1]
            shift = centre_shift(one, two) if one is not None and two is not None else None
            straight = shift is not None and abs(shift.turned_rad) < _MOTION_MOST_TURN_RAD
            return float(np.hypot(*shift.pixels)) if shift is not None and straight else float("nan")

        return np.array(list(pool.map(length, range(len(pictures) - 1))), dtype=np.float64)
