"""Brightness and colour of frames evened out, so that seams do not show: one factor a channel and frame.

Two frames that meet at a seam show the same ground; the logarithm of the ratio of their colours there is a measured
difference of their gains. All differences are solved together for a gain per vehicle and a small one per frame, held
near 1 by priors. Nothing varies within a picture, so vignetting stays as it is; it cancels because pairs are
compared at places that lie alike in both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.camera import Camera
from orthoswarm.geo import GroundGrid
from orthoswarm.mosaic.coverage import by_tile
from orthoswarm.mosaic.footprint import footprint_boxes
from orthoswarm.mosaic.labels import label_tile
from orthoswarm.mosaic.lattice import Shots, heights
from orthoswarm.placement import PlacedFrame, Terrain

Array = NDArray[np.float64]
Ints = NDArray[np.int32]
Bytes = NDArray[np.uint8]

_TILE = 512
_CELLS_ACROSS = 64
_MAX_CELLS = 2_000_000
_SAMPLE_SIGMA = 0.15  # of the log ratio of two thumbnails at one place: parallax, shadows, moving things
_VEHICLE_SIGMA = 0.30
_FRAME_SIGMA = 0.06
_CLIP = np.log(1.6)
_DARK, _BRIGHT = 8.0, 247.0  # means beyond these are (partly) clipped and say nothing about a gain
_ROUNDS = 6


@dataclass(frozen=True, slots=True)
class _Meetings:
    """Places where two frames show the same ground: frames a and b (M,), ground points (M, 2)."""

    a: Ints
    b: Ints
    ground: Array


def estimate_gains(
    frames: Sequence[PlacedFrame], thumbnails: Mapping[str, Bytes], terrain: Terrain
) -> dict[str, NDArray[np.float32]]:
    """Gains that make neighbouring frames alike.

    The mean logarithm of the mosaic's brightness stays as it was, channel by channel.

    Args:
        frames: placed frames in order of vehicle and time.
        thumbnails: image -> uint8 (rows, columns, 3), means of a picture's parts (RenderStats.thumbnails of an earlier
            rendering); a frame without one gets its vehicle's gain.
        terrain: the ground's height.

    Returns:
        image -> float32 (3,), factor of red, green and blue for every frame, within 1/1.6 to 1.6.
    """
    known = [i for i, f in enumerate(frames) if f.frame.image in thumbnails]
    if len(known) < 2:
        return {}
    some = [frames[i] for i in known]
    cameras = [f.camera for f in some]
    small = np.stack([thumbnails[f.frame.image] for f in some]).astype(np.float64)
    names = sorted({f.frame.vehicle for f in frames})
    vehicle = np.array([names.index(f.frame.vehicle) for f in some])

    labels, grid = _coarse_labels(cameras, terrain)
    seams = _seams(labels, grid)
    inner = _consecutive(cameras, vehicle, terrain)
    ratios, good = [], []
    for meeting in (seams, inner):
        ratio, usable = _log_ratios(meeting, cameras, small, terrain)
        ratios.append(ratio)
        good.append(usable)
    usable = np.concatenate(good)
    a, b = (np.concatenate([getattr(m, side) for m in (seams, inner)])[usable] for side in "ab")
    of_vehicle, of_frame = _solve(a, b, np.concatenate(ratios)[usable], vehicle, len(names))
    own = of_vehicle[vehicle] + of_frame
    area = np.bincount(labels[labels > 0] - 1, minlength=len(some)).astype(float)
    level = (area[:, None] * own).sum(0) / max(1.0, area.sum())
    gains = {
        f.frame.image: _factor(of_vehicle[names.index(f.frame.vehicle)] - level)
        for f in frames
        if f.frame.image not in thumbnails
    }
    return gains | {f.frame.image: _factor(g - level) for f, g in zip(some, own)}


def _factor(log_gain: Array) -> NDArray[np.float32]:
    return np.exp(np.clip(log_gain, -_CLIP, _CLIP)).astype(np.float32)


def _coarse_labels(cameras: Sequence[Camera], terrain: Terrain) -> tuple[Ints, GroundGrid]:
    """The mosaic's labels (index + 1) on cells of a 64th of a picture."""
    boxes = footprint_boxes(cameras, float(terrain.z.min()), float(terrain.z.max()))
    boxes = boxes[boxes[:, 0] <= boxes[:, 2]]
    if len(boxes) == 0:
        return np.zeros((1, 1), np.int32), GroundGrid(0, 0.0, 0.0, 1.0, 1, 1)
    side = float(np.median(boxes[:, 2:] - boxes[:, :2]))
    west, south = (float(x) for x in boxes[:, :2].min(0))
    east, north = (float(x) for x in boxes[:, 2:].max(0))
    cell = max(side / _CELLS_ACROSS, float(np.sqrt((east - west) * (north - south) / _MAX_CELLS)), 1e-3)
    grid = GroundGrid.around(0, (west, south, east, north), cell)
    shots = Shots.of(cameras, [False] * len(cameras))
    labels = np.zeros((grid.height, grid.width), np.int32)
    for (r, c), ids in by_tile(cameras, grid, _TILE, terrain).items():
        part = np.zeros((min(_TILE, grid.height - r), min(_TILE, grid.width - c)), np.int32)
        left, top = grid.west + c * cell, grid.north - r * cell
        lattice = heights(terrain, left, top, cell, _TILE)
        label_tile(part, shots.take(ids), (ids + 1).astype(np.int32), lattice, left, top, cell)
        labels[r : r + part.shape[0], c : c + part.shape[1]] = part
    return labels, grid


def _seams(labels: Ints, grid: GroundGrid) -> _Meetings:
    """Between neighbouring cells of different frames."""
    parts = []
    for one, other, shift in (
        (labels[:, :-1], labels[:, 1:], (0.5, 0.0)),
        (labels[:-1], labels[1:], (0.0, 0.5)),
    ):
        rows, cols = np.nonzero((one != other) & (one > 0) & (other > 0))
        place = grid.to_ground(np.stack([cols, rows], 1) + np.array(shift))
        parts.append((one[rows, cols] - 1, other[rows, cols] - 1, place))
    return _Meetings(*(np.concatenate([p[k] for p in parts]) for k in range(3)))


def _consecutive(cameras: Sequence[Camera], vehicle: NDArray[np.intp], terrain: Terrain) -> _Meetings:
    """A 4 x 3 grid of points of each frame with the next one of its vehicle and with the one before: alike in both."""
    u, v = np.meshgrid([0.2, 0.4, 0.6, 0.8], [0.2, 0.5, 0.8])
    parts: list[tuple[Array, list[tuple[int, int]]]] = []
    for i, camera in enumerate(cameras):
        size = (camera.lens.width - 1.0, camera.lens.height - 1.0)
        pixels = np.stack([u.ravel(), v.ravel()], 1) * size
        below = float(terrain.height(camera.position[:2]))
        pairs = [(i, j) for j in (i - 1, i + 1) if 0 <= j < len(cameras) and vehicle[j] == vehicle[i]]
        parts.append((camera.to_ground(pixels, below), pairs))
    ground = [g for g, pairs in parts for _ in pairs]
    pairs = [p for _, own in parts for p in own]
    if not pairs:
        return _Meetings(np.empty(0, np.int32), np.empty(0, np.int32), np.empty((0, 2)))
    index = np.repeat(np.array(pairs, np.int32), u.size, 0)
    return _Meetings(index[:, 0], index[:, 1], np.concatenate(ground))


def _log_ratios(
    meetings: _Meetings, cameras: Sequence[Camera], small: Array, terrain: Terrain
) -> tuple[Array, NDArray[np.bool_]]:
    """Log of colour a over colour b (M, 3), and where it means something."""
    ground = np.nan_to_num(meetings.ground)
    point = np.concatenate([ground, terrain.height(ground)[:, None]], 1)
    colours: list[Array] = []
    usable = np.asarray(np.isfinite(meetings.ground).all(axis=1))
    for side in (meetings.a, meetings.b):
        colour, inside = _look(side, point, cameras, small)
        usable = usable & inside & np.asarray(((colour > _DARK) & (colour < _BRIGHT)).all(axis=1))
        colours.append(np.maximum(colour, 1.0))
    return np.asarray(np.log(colours[0] / colours[1])), usable


def _look(index: Ints, point: Array, cameras: Sequence[Camera], small: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Thumbnail colours (M, 3), bilinear, of points (M, 3) in cameras of an index (M,), and whether they are seen."""
    pixel = np.full((len(index), 2), np.nan)
    size = np.array([(c.lens.width, c.lens.height) for c in cameras], float)
    order = np.argsort(index, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(index[order]) > 0]) if len(index) else np.empty(0, np.intp)
    for own in np.split(order, starts[1:]):
        if len(own):
            pixel[own] = cameras[index[own[0]]].project(point[own])
    inside = np.asarray(((pixel >= 0) & (pixel <= size[index] - 1.0)).all(axis=1))
    rows, columns = small.shape[1:3]
    at = np.where(inside[:, None], (pixel + 0.5) / size[index], 0.5) * (columns, rows) - 0.5
    at = np.clip(at, 0.0, (columns - 1.000001, rows - 1.000001))
    j, i = at.astype(np.intp).T
    fx, fy = (at - at.astype(np.intp)).T[:, :, None]
    top = small[index, i, j] * (1 - fx) + small[index, i, j + 1] * fx
    low = small[index, i + 1, j] * (1 - fx) + small[index, i + 1, j + 1] * fx
    return np.asarray(top * (1 - fy) + low * fy), inside


def _solve(a: Ints, b: Ints, ratio: Array, vehicle: NDArray[np.intp], vehicles: int) -> tuple[Array, Array]:
    """Log gains of vehicles (V, 3) and frames (N, 3): g_a - g_b = -ratio, robust (Geman-McClure), with priors to 0."""
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import splu

    n = len(vehicle)
    prior = np.r_[np.full(vehicles, _VEHICLE_SIGMA**-2), np.full(n, _FRAME_SIGMA**-2)]
    rows = np.arange(len(a))
    one = np.ones(len(a))
    design = coo_array(
        (
            np.concatenate([one, -one, one, -one]),
            (np.tile(rows, 4), np.concatenate([vehicles + a, vehicles + b, vehicle[a], vehicle[b]])),
        ),
        shape=(len(a), vehicles + n),
    ).tocsr()
    x = np.zeros((vehicles + n, 3))
    for _ in range(_ROUNDS):
        error2 = ((design @ x + ratio) ** 2).mean(1) / _SAMPLE_SIGMA**2
        weighted = design.T * ((1.0 + error2 / 9.0) ** -2 / _SAMPLE_SIGMA**2)
        x = splu((weighted @ design + diags_array(prior)).tocsc()).solve(-(weighted @ ratio))
    return x[:vehicles], x[vehicles:]
