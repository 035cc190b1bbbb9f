"""SIFT: good between frames of one flight, needs no weights; between dates it fails on about half of real pairs."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.matchers.matcher import Gray, Matches

_SIFT_KEYPOINTS: Final = 1500  # most keypoints a picture (cost)
_SIFT_RATIO: Final = 0.8  # ratio of the nearest to the second nearest descriptor (Lowe 2004)
_SIFT_CONTRAST: Final = 0.02  # contrast threshold: OpenCV's default is 0.04


@dataclass(frozen=True, slots=True)
class Sift:
    """SIFT keypoints, nearest descriptors both ways, Lowe's ratio."""

    def match(self, a: Gray, b: Gray) -> Matches:
        """See PictureMatcher."""
        import cv2

        sift = cv2.SIFT_create(  # type: ignore[attr-defined,unused-ignore]
            nfeatures=_SIFT_KEYPOINTS, contrastThreshold=_SIFT_CONTRAST
        )
        points_a, descriptors_a = sift.detectAndCompute(a, None)
        points_b, descriptors_b = sift.detectAndCompute(b, None)
        if descriptors_a is None or descriptors_b is None or min(len(descriptors_a), len(descriptors_b)) < 2:
            return Matches.none()
        matcher = cv2.BFMatcher(cv2.NORM_L2)
        back = {m.queryIdx: m.trainIdx for m in matcher.match(descriptors_b, descriptors_a)}
        accepted = []
        for best, second in matcher.knnMatch(descriptors_a, descriptors_b, k=2):
            share = best.distance / max(second.distance, 1e-9)
            if share < _SIFT_RATIO and back.get(best.trainIdx) == best.queryIdx:
                accepted.append((points_a[best.queryIdx].pt, points_b[best.trainIdx].pt, 1.0 - share))
        if not accepted:
            return Matches.none()
        first, second_points, score = (np.array(column, np.float64) for column in zip(*accepted, strict=True))
        return Matches(first, second_points, score)
