"""The homography between two pictures, measured in the pictures without relying on their records."""

from typing import Final

import cv2
import numpy as np

from orthoswarm.model.arrays import Array, Flags, Floats, Gray

_HOMOGRAPHY_PX: Final = 3.0  # flow within this distance agrees with a homography (RANSAC; chosen; not measured)
_HOMOGRAPHY_SHARE: Final = 0.4  # least share of the flow that must agree
_HOMOGRAPHY_LEAST: Final = 12  # fewest corners that must agree
_PYRAMID_WINDOW_PX: Final = 21  # window of the flow over several octaves (OpenCV's default)
_PYRAMID_OCTAVES: Final = 4  # octaves below the full picture of that flow: it reaches some 16 windows
_ORB_CORNERS: Final = 1000  # ORB corners (Rublee et al. 2011) of a turn that nobody recorded
_ORB_LEAST: Final = 30  # fewest ORB matches that must agree
_ORB_SHARE: Final = 0.25  # least share of the ORB matches that must agree
_PHASE_REDUCTION: Final = 4  # phase correlation for a prediction's missing shift works on pictures reduced by this
_PHASE_RESPONSE: Final = 0.05  # least response of that phase correlation


def measured_homography(previous: Gray | None, gray: Gray, uv: Floats, predicted: Array) -> Array | None:
    """The homography that most of a flow over several octaves agrees on; None without agreement.

    For a swaying camera whose angles are degrees off or not recorded. Starts from the prediction and,
    if that finds no consensus (a heading more than ten degrees off), from no motion; after that from
    ORB corners.

    Args:
        previous, gray: uint8 (rows, columns). uv: float32 (K, 2), corners of the previous one.
        predicted: 3x3 homography from the previous one's pixels.
    """
    if previous is None or len(uv) < _HOMOGRAPHY_LEAST:
        return None
    for start in (predicted, np.eye(3)):
        aligned = shifted_prediction(previous, gray, start)
        measured = _flow_homography(previous, gray, uv, start if aligned is None else aligned)
        if measured is not None:
            return measured
    return _turned_homography(previous, gray)


def _flow_homography(previous: Gray, gray: Gray, uv: Floats, start: Array) -> Array | None:
    """The homography that most of the flow from a given start agrees on, None without agreement."""
    guess = apply_homography(start, uv)
    warped = cv2.warpPerspective(previous, start, (gray.shape[1], gray.shape[0]), borderMode=cv2.BORDER_REPLICATE)
    window = (_PYRAMID_WINDOW_PX, _PYRAMID_WINDOW_PX)
    found, status, _ = cv2.calcOpticalFlowPyrLK(warped, gray, guess, None, winSize=window, maxLevel=_PYRAMID_OCTAVES)
    ok = is_inside(guess, gray.shape, 0.0) & (status.ravel() == 1) & is_inside(found, gray.shape, 0.0)
    if ok.sum() < _HOMOGRAPHY_LEAST:
        return None
    return _agreed(uv[ok], found[ok], max(_HOMOGRAPHY_LEAST, _HOMOGRAPHY_SHARE * ok.sum()))


def _turned_homography(previous: Gray, gray: Gray) -> Array | None:
    """The homography that rotation-invariant corners (ORB) agree on, None without agreement.

    For turns of the flight without recorded headings.
    """
    orb = cv2.ORB.create(nfeatures=_ORB_CORNERS)
    (before, ours), (after, theirs) = (orb.detectAndCompute(picture, None) for picture in (previous, gray))
    if ours is None or theirs is None:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(ours, theirs)
    if len(pairs) < _ORB_LEAST:
        return None
    a = np.array([before[m.queryIdx].pt for m in pairs], np.float32)
    b = np.array([after[m.trainIdx].pt for m in pairs], np.float32)
    return _agreed(a, b, max(_ORB_LEAST, _ORB_SHARE * len(pairs)))


def _agreed(a: Floats, b: Floats, fewest: float) -> Array | None:
    """The homography by RANSAC over pairs of pixels (K, 2), None with too few inliers."""
    homography, inlier = cv2.findHomography(a, b, cv2.RANSAC, _HOMOGRAPHY_PX)
    if homography is None or inlier.sum() < fewest:
        return None
    return np.asarray(homography, np.float64)


def shifted_prediction(previous: Gray | None, gray: Gray, predicted: Array) -> Array | None:
    """The prediction corrected by a shift from phase correlation of reduced pictures.

    None where the peak is unclear.
    """
    if previous is None:
        return None
    reduction = _PHASE_REDUCTION
    warped = cv2.warpPerspective(previous, predicted, (gray.shape[1], gray.shape[0]), borderMode=cv2.BORDER_REPLICATE)
    small = [
        cv2.resize(g, None, fx=1.0 / reduction, fy=1.0 / reduction, interpolation=cv2.INTER_AREA).astype(np.float32)
        for g in (warped, gray)
    ]
    window = cv2.createHanningWindow(small[0].shape[::-1], cv2.CV_32F)
    (dx, dy), response = cv2.phaseCorrelate(small[0], small[1], window)
    if response <= _PHASE_RESPONSE:
        return None
    return np.array([[1.0, 0, reduction * dx], [0, 1.0, reduction * dy], [0, 0, 1.0]]) @ predicted


def apply_homography(homography: Array, uv: Floats) -> Floats:
    """Pixels (K, 2) mapped by a homography (3, 3)."""
    p = uv.astype(float) @ homography[:, :2].T + homography[:, 2]
    return np.ascontiguousarray(p[:, :2] / p[:, 2:], dtype=np.float32)


def is_inside(uv: Floats, shape: tuple[int, ...], margin: float) -> Flags:
    """Which pixels (K, 2) lie in a picture of this shape, at least a margin inside its border."""
    h, w = shape[:2]
    return (uv[:, 0] >= margin) & (uv[:, 1] >= margin) & (uv[:, 0] <= w - 1 - margin) & (uv[:, 1] <= h - 1 - margin)
