"""Tracks from pairwise matches: features of many photos joined into one tie point by union-find."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Array, Indices, Ints
from orthoswarm.refine.bundle.block_arrays import Tracks
from orthoswarm.refine.features.pair_matching import Pair
from orthoswarm.refine.features.sift_features import SIFT_CELLS, SiftFeatures

_TRACK_LONGEST: Final = 20  # longest track; longer ones stay in pieces (its cost)
_TRACK_PER_CELL: Final = 2  # observations in a cell of a photo from which on further tracks are dropped (its cost)


def build_tracks(features: Sequence[SiftFeatures], pairs: Sequence[Pair]) -> Tracks:
    """Tie points through all photos, each observed 2 to `_TRACK_LONGEST` times, in full pictures.

    The strongest pair is joined first; a join that would put two points of one photo into a track is refused, so that
    one wrong match cannot merge two places. The camera of an observation is the photo's index in `features`.
    """
    offset = np.concatenate([[0], np.cumsum([len(f) for f in features])]).astype(np.int64)
    photo = np.repeat(np.arange(len(features), dtype=np.int32), np.diff(offset))
    same = [f.same_point() for f in features]
    joins: list[Indices] = []
    for pair in sorted(pairs, key=lambda p: (-len(p), p.first, p.second)):
        a = offset[pair.first] + same[pair.first][pair.match[:, 0]]
        b = offset[pair.second] + same[pair.second][pair.match[:, 1]]
        joins.append(np.stack([a, b], axis=1))
    edges = np.concatenate(joins) if joins else np.zeros((0, 2), np.int64)
    root = _union(edges, photo, len(photo), _TRACK_LONGEST)
    return _tracks(root, photo, features)


def _tracks(root: Indices, photo: Ints, features: Sequence[SiftFeatures]) -> Tracks:
    _, inverse, count = np.unique(root, return_inverse=True, return_counts=True)
    node = np.flatnonzero(count[inverse] >= 2)
    uv = np.concatenate([f.uv for f in features]) if len(features) else np.zeros((0, 2), np.float32)
    sigma = np.concatenate([f.sigma_px for f in features]) if len(features) else np.zeros(0, np.float32)
    return Tracks(photo[node], inverse[node].astype(np.int32), uv[node].astype(np.float64), sigma[node]).renumbered()


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
    """Thin the tracks but cover every photo evenly: longest first, while a cell of one of their photos has room.

    Args:
        width, rows: (N,), columns and rows of each photo.
    """
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
