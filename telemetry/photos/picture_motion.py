"""How far the ground moves from one picture to the next, and the yaw that this shows on straight legs.

The camera moves along the leg's course; the direction in which the ground moves through the picture gives the azimuth
of the picture's up direction. Accurate to a few degrees, which is enough to find a yaw that is flipped or belongs to
the airframe instead of the camera. PictureFeatures are those of pictures decoded at reduced size.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.frame import Frame
from orthoswarm.raster.picture_file import PictureError, read_gray, reduction
from telemetry.photos.photo_tags import Photo
from telemetry.samples.course import Straight, ground_track, straight_legs
from telemetry.samples.findings import Finding, plural

_MOTION_LEAST_INLIERS: Final = 25  # corners that the motion between two pictures takes at least
_MOTION_RATIO: Final = 0.8  # ratio test of their matches (Lowe 2004)
_MOTION_MOST_TURN_RAD: Final = 0.4  # two pictures that turn by more are not on one straight leg
_YAW_PAIRS_A_LEG: Final = 3  # pairs of pictures by which the recorded yaw of a leg is checked
_YAW_MOST_LEGS: Final = 12  # legs of a flight that are checked at most
_YAW_LEAST_STEP_M: Final = 1.0  # distance flown between such pictures at least (receivers' noise)


@dataclass(frozen=True, slots=True)
class PictureFeatures:
    """PictureFeatures of one picture at reduced size."""

    points: Array  # (N, 2) column and row
    descriptors: Floats  # (N, 128) float32
    centre: Array  # (2,) column and row of the middle


def features(picture: Photo | Frame, *, width: int, most: int) -> PictureFeatures | None:
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
    return PictureFeatures(np.array([p.pt for p in points]), descriptors, middle)


def centre_shift(one: PictureFeatures | None, two: PictureFeatures | None) -> tuple[Array, float] | None:
    """How the ground in the middle of one picture moves to another: the similarity on which most matches agree.

    Returns columns and rows (2,) at the reduced size, and the turn in radians, clockwise as seen; None where too few
    matches agree or a picture has no features.
    """
    import cv2

    if one is None or two is None:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one.descriptors, two.descriptors, k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < _MOTION_RATIO * p[1].distance]
    if len(good) < _MOTION_LEAST_INLIERS:
        return None
    source = np.array([one.points[m.queryIdx] for m in good])
    target = np.array([two.points[m.trainIdx] for m in good])
    model, inliers = cv2.estimateAffinePartial2D(source, target, method=cv2.RANSAC, ransacReprojThreshold=4.0)
    if model is None or inliers.sum() < _MOTION_LEAST_INLIERS:
        return None
    shift = model[:, :2] @ one.centre + model[:, 2] - one.centre
    return shift, float(np.arctan2(model[1, 0], model[0, 0]))


def shifts_px(pictures: Sequence[Photo | Frame], workers: int = 2) -> Array:
    """(N - 1,) pixels, of pictures 320 wide, that the ground moves between consecutive pictures; 20 ms a picture.

    NaN where two do not match, or where the vehicle turned: the way around a turn is longer than the shift.
    """
    with ThreadPoolExecutor(max(1, workers)) as pool:
        found = list(pool.map(lambda picture: features(picture, width=320, most=250), pictures))

        def length(i: int) -> float:
            pixels, turned_rad = centre_shift(found[i], found[i + 1]) or (np.full(2, np.nan), 0.0)
            return float(np.hypot(*pixels)) if abs(turned_rad) < _MOTION_MOST_TURN_RAD else float("nan")

        return np.array(list(pool.map(length, range(len(pictures) - 1))), dtype=np.float64)


def _seen_headings(frames: Sequence[Frame]) -> list[tuple[Straight, int, float]]:
    """Straight legs of a vehicle, the index of a picture on each, and its yaw in degrees as measured in the pictures.

    Legs that cannot be matched are left out.
    """
    ground = ground_track([f.fix for f in frames])
    legs = straight_legs(ground)
    if len(legs) > _YAW_MOST_LEGS:
        legs = [legs[i] for i in np.linspace(0, len(legs) - 1, _YAW_MOST_LEGS).round().astype(int)]
    found: list[tuple[Straight, int, float]] = []
    for leg in legs:
        middle = (leg.first + leg.last) // 2
        order = sorted(range(leg.first, leg.last), key=lambda i: abs(i - middle))
        for i in order[:_YAW_PAIRS_A_LEG]:
            yaw_deg = _seen_yaw_deg(frames[i], frames[i + 1], ground[i + 1] - ground[i])
            if yaw_deg is not None:
                found.append((leg, i + 1, yaw_deg))
                break
    return found


def _seen_yaw_deg(a: Frame, b: Frame, moved: Array) -> float | None:
    """Yaw of the second of two pictures; None if they cannot be matched."""
    if np.hypot(*moved) < _YAW_LEAST_STEP_M:
        return None
    matched = centre_shift(*(features(f, width=480, most=800) for f in (a, b)))
    if matched is None or np.hypot(*matched[0]) < 4.0:
        return None
    # In the second picture the first one's centre lies in the direction the camera came from; up is opposite to the
    # rows.
    to_the_right_of_up = np.degrees(np.arctan2(-matched[0][0], matched[0][1]))
    course = np.degrees(np.arctan2(moved[0], moved[1]))
    return wrap_deg(float(course - to_the_right_of_up))


def heading_findings(frames: Sequence[Frame], vehicle: str) -> list[Finding]:
    """Contradictions between recorded yaw and pictures, leg by leg."""
    seen = [(leg, yaw_deg, frames[i].fix.yaw_rad) for leg, i, yaw_deg in _seen_headings(frames)]
    seen = [(leg, yaw_deg, recorded) for leg, yaw_deg, recorded in seen if recorded is not None]
    if not seen:
        return []
    apart = wrap_deg(np.array([np.degrees(recorded or 0.0) - yaw_deg for _, yaw_deg, recorded in seen]))
    turned = np.abs(apart) > 130.0
    found: list[Finding] = []
    if turned.any():
        ends = ((frames[leg.first].image, frames[leg.last].image) for (leg, *_), t in zip(seen, turned) if t)
        text = (
            "the recorded yaw is turned by 180 degrees against the pictures on "
            f"{plural(int(turned.sum()), 'leg')} of {len(seen)} ({', '.join(f'{a} to {b}' for a, b in ends)})"
        )
        found.append(Finding("yaw-flip", text, vehicle))
    rest = apart[~turned]
    if len(rest) and np.median(np.abs(rest)) > 25.0:
        off = float(np.median(np.abs(rest)))
        text = f"the recorded yaw is {off:.0f} degrees off what the pictures show (median)"
        found.append(Finding("yaw-wrong", text, vehicle))
    elif len(rest):
        within = float(np.abs(rest).max())
        text = f"the pictures confirm the recorded yaw on {plural(len(rest), 'leg')} within {within:.0f} degrees"
        found.append(Finding("yaw-confirmed", text, vehicle, note=True))
    return found
