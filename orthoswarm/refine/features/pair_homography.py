"""Homographies that two pictures show by themselves, whatever was recorded of them."""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

SEEN_PX, SEEN_SHARE, SEEN_LEAST = 3.0, 0.4, 12
"""How near to a homography flow must lie, the share of it that must, and the fewest."""

TURNED_CORNERS, TURNED_LEAST, TURNED_SHARE = 1000, 30, 0.25
"""Corners that are described, the fewest pairs that must agree, and the share of them."""


def measured_homography(previous: Gray | None, gray: Gray, uv: NDArray[np.float32], predicted: Array) -> Array | None:
    """The homography that flow over several octaves shows, whatever was recorded; None where it shows none.

    For angles that are wrong by degrees, or that nobody recorded of a camera that sways. Begun from the prediction
    and, where that leads nowhere (a heading that is wrong by more than ten degrees), from no motion at all.
    """
    if previous is None or len(uv) < SEEN_LEAST:
        return None
    for start in (predicted, np.eye(3)):
        aligned = shifted_prediction(previous, gray, start)
        seen = _flow_homography(previous, gray, uv, start if aligned is None else aligned)
        if seen is not None:
            return seen
    return _turned_homography(previous, gray)


def _flow_homography(previous: Gray, gray: Gray, uv: NDArray[np.float32], start: Array) -> Array | None:
    """The homography from one picture to the next that most flow from a start agrees on, None without agreement."""
    guess = apply_homography(start, uv)
    warped = cv2.warpPerspective(previous, start, (gray.shape[1], gray.shape[0]), borderMode=cv2.BORDER_REPLICATE)
    found, status, _ = cv2.calcOpticalFlowPyrLK(warped, gray, guess, None, winSize=(21, 21), maxLevel=4)
    ok = is_inside(guess, gray.shape, 0.0) & (status.ravel() == 1) & is_inside(found, gray.shape, 0.0)
    if ok.sum() < SEEN_LEAST:
        return None
    return _agreed(uv[ok], found[ok], max(SEEN_LEAST, SEEN_SHARE * ok.sum()))


def _turned_homography(previous: Gray, gray: Gray) -> Array | None:
    """The homography that corners described whatever their direction (ORB) agree on, None without agreement.

    For a turn of the flight whose headings nobody recorded.
    """
    orb = cv2.ORB.create(nfeatures=TURNED_CORNERS)
    (before, ours), (after, theirs) = (orb.detectAndCompute(picture, None) for picture in (previous, gray))
    if ours is None or theirs is None:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(ours, theirs)
    if len(pairs) < TURNED_LEAST:
        return None
    a = np.array([before[m.queryIdx].pt for m in pairs], np.float32)
    b = np.array([after[m.trainIdx].pt for m in pairs], np.float32)
    return _agreed(a, b, max(TURNED_LEAST, TURNED_SHARE * len(pairs)))


def _agreed(a: NDArray[np.float32], b: NDArray[np.float32], fewest: float) -> Array | None:
    """The homography that so many pairs of pixels (K, 2) agree on, None where fewer do."""
    homography, inlier = cv2.findHomography(a, b, cv2.RANSAC, SEEN_PX)
    if homography is None or inlier.sum() < fewest:
        return None
    return np.asarray(homography, np.float64)


def shifted_prediction(previous: Gray | None, gray: Gray, predicted: Array) -> Array | None:
    """The prediction with the shift that it lacks, by phase correlation of quarter pictures; None where unclear."""
    if previous is None:
        return None
    warped = cv2.warpPerspective(previous, predicted, (gray.shape[1], gray.shape[0]), borderMode=cv2.BORDER_REPLICATE)
    small = [
        cv2.resize(g, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA).astype(np.float32) for g in (warped, gray)
    ]
    window = cv2.createHanningWindow(small[0].shape[::-1], cv2.CV_32F)
    (dx, dy), response = cv2.phaseCorrelate(small[0], small[1], window)
    if response <= 0.05:
        return None
    return np.array([[1.0, 0, 4.0 * dx], [0, 1.0, 4.0 * dy], [0, 0, 1.0]]) @ predicted


def apply_homography(homography: Array, uv: NDArray[np.float32]) -> NDArray[np.float32]:
    """Where a homography (3, 3) takes pixels (K, 2)."""
    p = uv.astype(float) @ homography[:, :2].T + homography[:, 2]
    return np.ascontiguousarray(p[:, :2] / p[:, 2:], dtype=np.float32)


def is_inside(uv: NDArray[np.float32], shape: tuple[int, ...], margin: float) -> NDArray[np.bool_]:
    """Which pixels (K, 2) lie in a picture of this shape, so far from its border."""
    h, w = shape[:2]
    return (uv[:, 0] >= margin) & (uv[:, 1] >= margin) & (uv[:, 0] <= w - 1 - margin) & (uv[:, 1] <= h - 1 - margin)
