"""Photos of which nobody knows where they were taken, found on the basemap within a given area.

Features that keep their descriptor under turns and changes of scale (SIFT) are matched between a photo and the map. A
similarity on which several agree is accepted by an a-contrario test: on a map of other ground each match would lie
anywhere (see `map_evidence`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np

from orthoswarm.compute.threads import on_threads
from orthoswarm.model.arrays import Array, Flags, Floats, Gray, Indices
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import MapWindow
from orthoswarm.model.task_runner import Progress
from orthoswarm.refine.features.pair_matching import root_sift
from orthoswarm.refine.registration.map_evidence import FALSE_MATCHES, agreement_probability

_MAP_SIDE_PX: Final = 4000  # longer side of the searched map at most (its features take a minute and 80 MB)
_PHOTO_FEATURES: Final = 3000  # strongest features of a photo that are searched (cost)
_MAP_FEATURES: Final = 150_000  # the same of the map
_PART_PX: Final = 1000  # side of the parts of a map whose features are found at once: 200 MB each
_PART_MARGIN_PX: Final = 40  # around them, so that features near their edges are whole
_CONTRAST: Final = 0.02  # contrast threshold of features: OpenCV's default is 0.04
_RATIO: Final = 0.85  # nearest over second nearest descriptor's distance at most (chosen; 0.8 finds a fifth less)
_AGREE_PX: Final = 6.0
"""Matches within so many map pixels of a similarity agree with it: photos are tilted, and houses stand high."""
_FEWEST: Final = 8
"""Fewest matches that agree: houses that are alike let 5 or 6 agree by chance on a map whose detail is another one."""
_LEAST_WIDTH_PX: Final = 60.0  # a photo covers at least so many pixels of the map: else one spot matches everything
_RANSAC_ROUNDS: Final = 20_000  # finds ten of 250 matches that agree in 19 of 20 photos (chosen)
_AT_ONCE: Final = 64  # descriptors that are compared at once with all of the map (memory)


@dataclass(frozen=True, slots=True)
class SearchedMap:
    """The part of a basemap in which photos are looked for.

    basemap: the map. middle: float64 (2,), in its grid, metres. radius_m: half the side of the searched square.
    """

    basemap: MapWindow
    middle: Array
    radius_m: float


class FoundMarks(NamedTuple):
    """Where the map shows what a photo shows: pixel float64 (K, 2), column and row; ground float64 (K, 2), metres."""

    pixel: Array
    ground: Array


def marks_on_map(
    photos: Sequence[Gray], searched: SearchedMap, progress: Progress | None = None
) -> tuple[list[FoundMarks], float]:
    """Look for photos on a map.

    Args:
        photos: uint8 (rows, columns) each. searched: where. progress: told of photos.

    Returns:
        The marks of each photo (none where it was not found), and one sigma of their ground, metres.
    """
    gsd_m = max(searched.basemap.native_gsd_m, 2.0 * searched.radius_m / _MAP_SIDE_PX)
    area = BoundingBox.around_points(searched.middle, searched.radius_m)
    gray, valid = searched.basemap.gray(area, gsd_m)
    grid = GroundGrid.around(searched.basemap.epsg, area, gsd_m)
    map_features = _map_features(gray.astype(np.uint8), valid)

    def look(photo: Gray) -> FoundMarks:
        pixel, spot = _matches(_features(photo, _PHOTO_FEATURES), map_features)
        agree = _agreeing(pixel, spot, photo.shape[1], searched.radius_m / gsd_m)
        return FoundMarks(pixel[agree], grid.to_ground(spot[agree]))

    found = []
    for marks in on_threads(look, photos):
        found.append(marks)
        if progress is not None:
            progress("photos on the basemap", len(found), len(photos))
    return found, 0.5 * _AGREE_PX * gsd_m


def _map_features(gray: Gray, valid: Flags) -> tuple[Array, Floats]:
    """Features of a map, as many in each part of it."""
    margin = _PART_MARGIN_PX
    corners = [(r, c) for r in range(0, len(gray), _PART_PX) for c in range(0, gray.shape[1], _PART_PX)]

    def part(corner: tuple[int, int]) -> tuple[Array, Floats]:
        top, left = (max(0, at - margin) for at in corner)
        window = slice(top, corner[0] + _PART_PX + margin), slice(left, corner[1] + _PART_PX + margin)
        spots, described = _features(gray[window], _MAP_FEATURES // len(corners), valid[window])
        spots += (left, top)
        own = ((spots >= corner[::-1]) & (spots < np.add(corner[::-1], _PART_PX))).all(1)
        return spots[own], described[own]

    spots, described = zip(*on_threads(part, corners), strict=True)
    return np.concatenate(spots), np.concatenate(described)


def _features(gray: Gray, most: int, valid: Flags | None = None) -> tuple[Array, Floats]:
    """Places (K, 2), column and row, and descriptors float32 (K, 128), see `root_sift`."""
    sift = cv2.SIFT_create(nfeatures=most, contrastThreshold=_CONTRAST)  # type: ignore[attr-defined,unused-ignore]
    spots, found = sift.detectAndCompute(gray, None if valid is None else valid.astype(np.uint8))
    if found is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    return np.array([spot.pt for spot in spots]), root_sift(found)


def _matches(photo: tuple[Array, Floats], other: tuple[Array, Floats]) -> tuple[Array, Array]:
    """Places (M, 2) in the photo and in the other picture of features that have a clear counterpart, each used once."""
    (own, mine), (spots, theirs) = photo, other
    if len(theirs) < 2 or not len(mine):
        return np.zeros((0, 2)), np.zeros((0, 2))
    nearest, distance = np.zeros((2, len(mine)), np.int64), np.zeros((2, len(mine)))
    for start in range(0, len(mine), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        alike = mine[some] @ theirs.T
        rows = np.arange(len(alike))
        for k in range(2):
            best = nearest[k, some] = alike.argmax(1)
            distance[k, some] = np.sqrt(np.maximum(2.0 - 2.0 * alike[rows, best], 0.0))
            alike[rows, best] = -1.0
    clear = np.flatnonzero(distance[0] < _RATIO * distance[1])
    clear = clear[np.argsort(distance[0, clear], kind="stable")]
    clear = clear[np.sort(np.unique(nearest[0, clear], return_index=True)[1])]
    return own[clear], spots[nearest[0, clear]]


def _agreeing(pixel: Array, spot: Array, width_px: int, reach_px: float) -> Indices:
    """The matches (M, 2) that agree on one similarity; none where any map would show such an agreement by chance."""
    nothing = np.zeros(0, np.int64)
    if len(pixel) < 3:
        return nothing
    similarity, inlier = cv2.estimateAffinePartial2D(
        pixel, spot, ransacReprojThreshold=_AGREE_PX, maxIters=_RANSAC_ROUNDS, confidence=0.9999
    )
    if similarity is None or inlier.sum() < _FEWEST or np.hypot(*similarity[:, 0]) * width_px < _LEAST_WIDTH_PX:
        return nothing
    agree = np.flatnonzero(inlier)
    chance = agreement_probability(len(agree) - 2, len(pixel) - 2, _AGREE_PX, reach_px)
    return agree if chance * len(pixel) ** 2 / 2 < FALSE_MATCHES else nothing
