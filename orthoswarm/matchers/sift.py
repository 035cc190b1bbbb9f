"""SIFT: good between frames of one flight, no weights; between dates it fails on about half of real pairs."""

from dataclasses import dataclass

import numpy as np

from orthoswarm.config import active
from orthoswarm.matchers.matcher import Gray, Matches


@dataclass(frozen=True, slots=True)
class Sift:
    """SIFT keypoints, nearest descriptors both ways, Lowe's ratio."""

    def match(self, a: Gray, b: Gray) -> Matches:
        """See PictureMatcher."""
        import cv2

        config = active().matchers
        sift = cv2.SIFT_create(  # type: ignore[attr-defined,unused-ignore]
            nfeatures=config.sift_keypoints, contrastThreshold=config.sift_contrast
        )
        points_a, words_a = sift.detectAndCompute(a, None)
        points_b, words_b = sift.detectAndCompute(b, None)
        if words_a is None or words_b is None or min(len(words_a), len(words_b)) < 2:
            return Matches.none()
        matcher = cv2.BFMatcher(cv2.NORM_L2)
        back = {m.queryIdx: m.trainIdx for m in matcher.match(words_b, words_a)}
        kept = []
        for best, second in matcher.knnMatch(words_a, words_b, k=2):
            share = best.distance / max(second.distance, 1e-9)
            if share < config.sift_ratio and back.get(best.trainIdx) == best.queryIdx:
                kept.append((points_a[best.queryIdx].pt, points_b[best.trainIdx].pt, 1.0 - share))
        if not kept:
            return Matches.none()
        first, second_points, score = (np.array(column, np.float64) for column in zip(*kept, strict=True))
        return Matches(first, second_points, score)
