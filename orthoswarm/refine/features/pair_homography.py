"""The homography between two pictures, measured in the pictures without relying on their records."""

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]


def measured_homography(previous: Gray | None, gray: Gray, uv: NDArray[np.float32], predicted: Array) -> Array | None:
    """The homography that most of a flow over several octaves agrees on; None without agreement.

    For a swaying camera whose angles are degrees off or not recorded. Starts from the prediction and,
    if that finds no consensus (a heading more than ten degrees off), from no motion; after that from
    ORB corners.

    Args:
        previous, gray: uint8 (rows, columns). uv: float32 (K, 2), corners of the previous one.
        predicted: 3x3 homography from the previous one's pixels.
    """
    if previous is None or len(uv) < active().features.homography_least:
        return None
    for start in (predicted, np.eye(3)):
        aligned = shifted_prediction(previous, gray, start)
        measured = _flow_homography(previous, gray, uv, start if aligned is None else aligned)
        if measured is not None:
            return measured
    return _turned_homography(previous, gray)


def _flow_homography(previous: Gray, gray: Gray, uv: NDArray[np.float32], start: Array) -> Array | None:
    """The homography that most of the flow from a given start agrees on, None without agreement."""
    config = active().features
    guess = apply_homography(start, uv)
    warped = cv2.warpPerspective(previous, start, (gray.shape[1], gray.shape[0]), borderMode=cv2.BORDER_REPLICATE)
    window = (config.pyramid_window_px, config.pyramid_window_px)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        warped, gray, guess, None, winSize=window, maxLevel=config.pyramid_octaves
    )
    ok = is_inside(guess, gray.shape, 0.0) & (status.ravel() == 1) & is_inside(found, gray.shape, 0.0)
    if ok.sum() < config.homography_least:
        return None
    return _agreed(uv[ok], found[ok], max(config.homography_least, config.homography_share * ok.sum()))


def _turned_homography(previous: Gray, gray: Gray) -> Array | None:
    """The homography that rotation-invariant corners (ORB) agree on, None without agreement.

    For turns of the flight without recorded headings.
    """
    config = active().features
    orb = cv2.ORB.create(nfeatures=config.orb_corners)
    (before, ours), (after, theirs) = (orb.detectAndCompute(picture, None) for picture in (previous, gray))
    if ours is None or theirs is None:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(ours, theirs)
    if len(pairs) < config.orb_least:
        return None
    a = np.array([before[m.queryIdx].pt for m in pairs], np.float32)
    b = np.array([after[m.trainIdx].pt for m in pairs], np.float32)
    return _agreed(a, b, max(config.orb_least, config.orb_share * len(pairs)))


def _agreed(a: NDArray[np.float32], b: NDArray[np.float32], fewest: float) -> Array | None:
    """The homography by RANSAC over pairs of pixels (K, 2), None with too few inliers."""
    homography, inlier = cv2.findHomography(a, b, cv2.RANSAC, active().features.homography_px)
    if homography is None or inlier.sum() < fewest:
        return None
    return np.asarray(homography, np.float64)


def shifted_prediction(previous: Gray | None, gray: Gray, predicted: Array) -> Array | None:
    """The prediction corrected by a shift from phase correlation of reduced pictures.

    None where the peak is unclear.
    """
    if previous is None:
        return None
    config = active().features
    reduction = config.phase_reduction
    warped = cv2.warpPerspective(previous, predicted, (gray.shape[1], gray.shape[0]), borderMode=cv2.BORDER_REPLICATE)
    small = [
        cv2.resize(g, None, fx=1.0 / reduction, fy=1.0 / reduction, interpolation=cv2.INTER_AREA).astype(np.float32)
        for g in (warped, gray)
    ]
    window = cv2.createHanningWindow(small[0].shape[::-1], cv2.CV_32F)
    (dx, dy), response = cv2.phaseCorrelate(small[0], small[1], window)
    if response <= config.phase_response:
        return None
    return np.array([[1.0, 0, reduction * dx], [0, 1.0, reduction * dy], [0, 0, 1.0]]) @ predicted


def apply_homography(homography: Array, uv: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pixels (K, 2) mapped by a homography (3, 3)."""
    p = uv.astype(float) @ homography[:, :2].T + homography[:, 2]
    return np.ascontiguousarray(p[:, :2] / p[:, 2:], dtype=np.float32)


def is_inside(uv: NDArray[np.float32], shape: tuple[int, ...], margin: float) -> NDArray[np.bool_]:
    """Which pixels (K, 2) lie in a picture of this shape, at least a margin inside its border."""
    h, w = shape[:2]
    return (uv[:, 0] >= margin) & (uv[:, 1] >= margin) & (uv[:, 0] <= w - 1 - margin) & (uv[:, 1] <= h - 1 - margin)
