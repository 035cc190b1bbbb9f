"""Pairs of overlapping photos: candidates, matching of their features, geometric verification, tracks through them.

Candidates come from the recorded positions, not only from the order in time, as legs, vehicles and sorties overlap too.
A pair is accepted when mutual nearest neighbours agree on one similarity of the plane (loosely, because cameras tilt
and the ground is not flat) and on one epipolar geometry (tightly). Features of many photos are joined into one tie
point by union-find.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Array, Complex, Flags, Floats, Indices, Ints
from orthoswarm.refine.bundle.block_arrays import Tracks
from orthoswarm.refine.features.sift_features import SIFT_CELLS, SiftFeatures
from orthoswarm.trajectory.legs import PAUSE_S

_MATCH_RATIO: Final = 0.85
"""A match is clearly nearer than the next candidate: ratio test (Lowe 2004: 0.8; chosen on four real flights)."""
_MATCH_LEAST: Final = 15  # fewest matches of a pair of photos (chosen on four real flights)
_PLANE_SHARE: Final = 0.03  # matches agree with one similarity of the plane within this share of the width
_PLANE_SCALES: Final = (0.5, 2.0)  # scales of that similarity which are possible
_EPIPOLAR_PX: Final = 1.5
"""Matches agree with one epipolar geometry within so many reduced pixels (MAGSAC; four real flights)."""
_RANSAC_ROUNDS: Final = 1000  # most rounds of both consensus searches (its cost)
_RANSAC_CONFIDENCE: Final = 0.999  # confidence at which they end earlier
_PAIR_SECTORS: Final = 6  # directions over which a photo's neighbours are spread
_PAIR_BEST_DISTANCE: Final = 0.4  # best distance of a pair as a share of its reach
_TRACK_LONGEST: Final = 20  # longest track; longer ones stay in pieces (its cost)
_TRACK_PER_CELL: Final = 2  # observations in a cell of a photo from which on further tracks are dropped (its cost)


@dataclass(frozen=True, slots=True)
class Pair:
    """Photos `first` < `second` that show the same ground; match: int32 (n, 2), rows of features in the two."""

    first: int
    second: int
    match: Ints

    def __len__(self) -> int:
        return len(self.match)


def match_features(one: SiftFeatures, two: SiftFeatures) -> Ints:
    """Rows of matching features in two photos, int32 (n, 2); (0, 2) without a match.

    Mutual nearest neighbours that pass the ratio test, then a similarity by RANSAC, then the fundamental matrix by
    MAGSAC (Barath et al. 2020). Fewer than `_MATCH_LEAST` inliers count as no match.
    """
    none = np.zeros((0, 2), np.int32)
    candidates = mutual_nearest(_root_sift(one), _root_sift(two))
    if len(candidates) < _MATCH_LEAST:
        return none
    p = one.uv[candidates[:, 0]] / np.float32(one.step_px)
    q = two.uv[candidates[:, 1]] / np.float32(two.step_px)
    plane = _similarity_inliers(p, q, _PLANE_SHARE * two.width / two.step_px)
    if plane.sum() < _MATCH_LEAST:
        return none
    candidates, p, q = candidates[plane], p[plane], q[plane]
    epipolar = _epipolar_inliers(p, q)
    return candidates[epipolar] if epipolar.sum() >= _MATCH_LEAST else none


def mutual_nearest(one: Floats, two: Floats) -> Ints:
    """Rows of unit descriptors (n, d) and (m, d) nearest to each other and clearly nearer than the next, (k, 2)."""
    if len(one) < 2 or len(two) < 2:
        return np.zeros((0, 2), np.int32)
    dot = one @ two.T
    rows = np.arange(len(one))
    best = dot.argmax(axis=1)
    mutual = dot.argmax(axis=0)[best] == rows
    top = dot[rows, best]
    dot[rows, best] = -1.0
    second = dot.max(axis=1)
    clear = (1.0 - top) < _MATCH_RATIO**2 * (1.0 - second)
    keep = mutual & clear
    return np.stack([rows[keep], best[keep]], axis=1).astype(np.int32)


def _similarity_inliers(p: Floats, q: Floats, threshold: float) -> Flags:
    matrix, inliers = cv2.estimateAffinePartial2D(
        p, q, method=cv2.RANSAC, ransacReprojThreshold=threshold, maxIters=_RANSAC_ROUNDS,
        confidence=_RANSAC_CONFIDENCE, refineIters=2,
    )  # fmt: skip
    if matrix is None or not _PLANE_SCALES[0] <= float(np.hypot(matrix[0, 0], matrix[1, 0])) <= _PLANE_SCALES[1]:
        return np.zeros(len(p), bool)
    return np.asarray(inliers[:, 0] > 0)


def _epipolar_inliers(p: Floats, q: Floats) -> Flags:
    try:
        _, inliers = cv2.findFundamentalMat(p, q, cv2.USAC_MAGSAC, _EPIPOLAR_PX, _RANSAC_CONFIDENCE, _RANSAC_ROUNDS)
    except cv2.error:  # OpenCV 5.0 asserts where it finds no model
        return np.zeros(len(p), bool)
    return np.zeros(len(p), bool) if inliers is None else np.asarray(inliers[:, 0] > 0)


def root_sift(descriptor: NDArray[np.generic]) -> Floats:
    """Unit vectors float32 (n, 128) whose dot product compares SIFT descriptors by the Hellinger kernel."""
    d = descriptor.astype(np.float32)
    d /= np.maximum(d.sum(axis=1, keepdims=True), 1.0)
    return np.asarray(np.sqrt(d, out=d))


@lru_cache(maxsize=64)
def _root_sift(features: SiftFeatures) -> Floats:
    return root_sift(features.descriptor)


def consecutive(group: NDArray[np.integer], time_s: Array) -> Ints:
    """Pairs that follow each other in one group, in order of time, without a pause: int32 (n, 2); time_s may be NaN."""
    last: dict[int, int] = {}
    pairs: list[tuple[int, int]] = []
    for k, g in enumerate(group.tolist()):
        before = last.get(g)
        if before is not None and not abs(time_s[k] - time_s[before]) > PAUSE_S:
            pairs.append((before, k))
        last[g] = k
    return np.array(pairs, np.int32).reshape(-1, 2)


def nearby(centre: Complex, reach: Array, group: NDArray[np.integer], count: int = 8) -> Ints:
    """Pairs with possibly overlapping footprints, spread over all directions, int32 (n, 2), sorted, first < second.

    Each photo chooses `count` partners in every direction, both of its own group and of others, preferring those whose
    distance is near the best one.

    centre: complex (N,), east + i north of the ground at each photo's centre. group: integers (N,), leg or segment.
    reach: float64 (N,), metres; two photos are near if their distance is below the mean of their reaches.
    """
    from scipy.spatial import cKDTree

    sectors = _PAIR_SECTORS
    points = np.stack([centre.real, centre.imag], axis=1)
    tree = cKDTree(points)
    chosen: set[tuple[int, int]] = set()
    for i, close in enumerate(tree.query_ball_point(points, r=np.maximum(reach, 1e-6), return_sorted=True)):
        near = np.asarray(close, np.int64)
        near = near[near != i]
        distance = np.abs(centre[near] - centre[i])
        mean = 0.5 * (reach[near] + reach[i])
        near, distance = near[distance <= mean], (distance / mean)[distance <= mean]
        order = np.lexsort((near, np.abs(near - i), np.round(np.abs(distance - _PAIR_BEST_DISTANCE), 3)))
        near = near[order]
        sector = np.floor(np.angle(centre[near] - centre[i]) / (2 * np.pi) * sectors + 0.5).astype(np.int64) % sectors
        for j in _round_robin(near, sector + sectors * (group[near] != group[i]), count):
            chosen.add((min(i, j), max(i, j)))
    return np.array(sorted(chosen), np.int32).reshape(-1, 2)


def _round_robin(near: Indices, kind: Indices, count: int) -> list[int]:
    """The first item of every kind, then the second, until there are `count`."""
    rank = np.zeros(len(near), np.int64)
    for k in np.unique(kind):
        inside = np.flatnonzero(kind == k)
        rank[inside] = np.arange(len(inside))
    order = np.lexsort((np.arange(len(near)), rank))
    return [int(j) for j in near[order][:count]]


def build_tracks(features: Sequence[SiftFeatures], pairs: Sequence[Pair]) -> Tracks:
    """Tie points through all photos, each observed 2 to `_TRACK_LONGEST` times, in full pictures.

    The strongest pair is joined first; a join that would put two points of one photo into a track is refused, so that
    one wrong match cannot merge two places. The camera of an observation is the photo's index in `features`.
    """
    offset = np.concatenate([[0], np.cumsum([len(f) for f in features])]).astype(np.int64)
    photo = np.repeat(np.arange(len(features), dtype=np.int32), np.diff(offset))
    same = [f.same_point() for f in features]
    joins = [np.zeros((0, 2), np.int64)]
    for pair in sorted(pairs, key=lambda p: (-len(p), p.first, p.second)):
        a = offset[pair.first] + same[pair.first][pair.match[:, 0]]
        b = offset[pair.second] + same[pair.second][pair.match[:, 1]]
        joins.append(np.stack([a, b], axis=1))
    root = _union(np.concatenate(joins), photo, len(photo), _TRACK_LONGEST)
    _, inverse, count = np.unique(root, return_inverse=True, return_counts=True)
    node = np.flatnonzero(count[inverse] >= 2)
    uv = np.concatenate([np.zeros((0, 2), np.float32), *(f.uv for f in features)])[node]
    sigma = np.concatenate([np.zeros(0, np.float32), *(f.sigma_px for f in features)])[node]
    return Tracks(photo[node], inverse[node].astype(np.int32), uv.astype(np.float64), sigma).renumbered()


@in_place_kernel
def _find(parent, x):  # type: ignore[no-untyped-def]
    while parent[x] != x:
        parent[x] = parent[parent[x]]
        x = parent[x]
    return x


@kernel
def _union(edges, photo, count, max_length):  # type: ignore[no-untyped-def]
    """Root of each node after joining along the edges in order; the members of a root form a linked list."""
    parent = np.arange(count)
    following = np.full(count, -1)
    tail = np.arange(count)
    size = np.ones(count, np.int64)
    for e in range(len(edges)):
        a, b = _find(parent, edges[e, 0]), _find(parent, edges[e, 1])
        if a == b or size[a] + size[b] > max_length:
            continue
        clash = False
        x = a
        while x >= 0 and not clash:
            y = b
            while y >= 0:
                if photo[x] == photo[y]:
                    clash = True
                    break
                y = following[y]
            x = following[x]
        if clash:
            continue
        if a > b:
            a, b = b, a
        parent[b] = a
        following[tail[a]] = b
        tail[a] = tail[b]
        size[a] += size[b]
    root = np.empty(count, np.int64)
    for x in range(count):
        root[x] = _find(parent, x)
    return root


def thin_tracks(tracks: Tracks, width: Array, rows: Array) -> Tracks:
    """Keep tracks, longest first, while a cell of a photo has room; width, rows: (N,), size of each photo."""
    if not len(tracks.camera):
        return tracks
    nx, ny = SIFT_CELLS
    length = np.bincount(tracks.point, minlength=tracks.count)
    order = np.lexsort((tracks.camera, tracks.point, -length[tracks.point]))
    start = np.flatnonzero(np.r_[True, np.diff(tracks.point[order]) != 0, True])
    cx = np.clip(tracks.uv[:, 0] * nx / np.asarray(width)[tracks.camera], 0, nx - 1).astype(np.int64)
    cy = np.clip(tracks.uv[:, 1] * ny / np.asarray(rows)[tracks.camera], 0, ny - 1).astype(np.int64)
    cell = tracks.camera.astype(np.int64) * nx * ny + cy * nx + cx
    keep = np.zeros(len(order), np.bool_)
    _thin(cell[order], start, _TRACK_PER_CELL, nx * ny * len(width), keep)
    return tracks.take(np.sort(order[keep])).renumbered()


@kernel
def _thin(cell, start, room, cells, keep):  # type: ignore[no-untyped-def]
    used = np.zeros(cells, np.int64)
    for t in range(len(start) - 1):
        wanted = False
        for k in range(start[t], start[t + 1]):
            if used[cell[k]] < room:
                wanted = True
        if wanted:
            for k in range(start[t], start[t + 1]):
                used[cell[k]] += 1
                keep[k] = True
