"""Forward overlap of consecutive photos, which decides between tracking corners and matching features."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Gray
from orthoswarm.model.frame import Frame
from orthoswarm.raster.picture_file import PictureError
from orthoswarm.refine.features.pair_matching import match_features
from orthoswarm.refine.features.sift_features import Features, detect
from orthoswarm.trajectory.legs import PAUSE_S

_DENSE_OVERLAP: Final = 0.8
"""Share of a picture that the next one must show for corners to be followed. Of 150 corners 106 to 127 survive at an
overlap of 0.90, 76 to 109 at 0.81, 51 at 0.72 (measured on four cameras)."""
_DENSE_MATCHED: Final = 0.6  # ... and the share of the sampled pairs that must match at all
_OVERLAP_PIXELS: Final = 240 * 180  # pixels of the reduced pictures on which the overlap is measured (its cost)
_OVERLAP_SAMPLES: Final = 12  # pairs that are sampled over the flight (its cost)


@dataclass(frozen=True, slots=True)
class Overlap:
    """Overlap of consecutive photos.

    Attributes:
        share: median share of a picture's area that the next one shows, 0 to 1; 0 if no pair matched.
        matched: share of the sampled pairs that matched. pairs: how many were sampled.
    """

    share: float
    matched: float
    pairs: int

    @property
    def dense(self) -> bool:
        """Whether corners can be tracked from photo to photo."""
        return self.share >= _DENSE_OVERLAP and self.matched >= _DENSE_MATCHED


def forward_overlap(frames: Sequence[Frame], read_gray: Callable[[Frame], Gray], samples: int | None = None) -> Overlap:
    """Measure the overlap of consecutive photos of one vehicle from the pictures, about 15 ms a photo.

    No recorded height, angle or field of view is needed.

    Args:
        frames: of one vehicle in order of time.
        read_gray: returns a photo's grey values, uint8 (rows, columns), at any size.
        samples: how many pairs, spread over the flight (None: as configured).
    """
    shares: list[float] = []
    chosen = _sample_pairs(frames, _OVERLAP_SAMPLES if samples is None else samples)
    features: dict[int, Features | None] = {}
    for a, b in chosen:
        for k in (a, b):
            if k not in features:
                features[k] = _features(frames[k], read_gray)
        one, two = features[a], features[b]
        shares.append(_shared_area(one, two) if one is not None and two is not None else 0.0)
    found = [s for s in shares if s > 0.0]
    if not found:
        return Overlap(0.0, 0.0, len(shares))
    return Overlap(float(np.median(found)), len(found) / len(shares), len(shares))


def _sample_pairs(frames: Sequence[Frame], samples: int) -> list[tuple[int, int]]:
    """Consecutive pairs of the same picture size without a pause between, spread evenly over the flight."""
    pairs, longest = [], PAUSE_S
    for k in range(len(frames) - 1):
        a, b = frames[k], frames[k + 1]
        pause = 0.0 if a.time_s is None or b.time_s is None else b.time_s - a.time_s
        if (a.width, a.height) == (b.width, b.height) and 0.0 <= pause <= longest:
            pairs.append((k, k + 1))
    if len(pairs) <= samples:
        return pairs
    return [pairs[int(k)] for k in np.linspace(0, len(pairs) - 1, samples).round()]


def _features(frame: Frame, read_gray: Callable[[Frame], Gray]) -> Features | None:
    try:
        return detect(read_gray(frame), frame.width, frame.height, _OVERLAP_PIXELS)
    except PictureError:
        return None


def _shared_area(one: Features, two: Features) -> float:
    """Share of the first picture's area that the second shows, from the similarity of their matches.

    0 without a match.
    """
    import cv2

    match = match_features(one, two)
    if not len(match):
        return 0.0
    p, q = one.uv[match[:, 0]], two.uv[match[:, 1]]
    matrix, _ = cv2.estimateAffinePartial2D(p, q, method=cv2.LMEDS)
    if matrix is None:
        return 0.0
    w, h = one.width, one.height
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
    moved = (corners @ matrix[:, :2].T + matrix[:, 2]).astype(np.float32)
    area, _ = cv2.intersectConvexConvex(moved, corners)
    own = abs(float(cv2.contourArea(moved)))
    return float(np.clip(area / max(own, 1.0), 0.0, 1.0))
