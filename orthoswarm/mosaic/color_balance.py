"""Brightness and colour of frames evened out, so that seams do not show: one factor a channel and frame.

Two frames that meet at a seam show the same ground; the logarithm of the ratio of their colours there is a measured
difference of their gains. All differences are solved together for a gain per vehicle and a small one per frame, held
near 1 by priors. Nothing varies within a picture, so vignetting stays as it is; it cancels because pairs are
compared at places that lie alike in both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import kernel
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera, Lens
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.mosaic.footprint import LEAST_DESCENT, footprint_boxes
from orthoswarm.mosaic.render_arrays import Shots, heights, project
from orthoswarm.mosaic.seam_labels import label_tile
from orthoswarm.mosaic.visible_ground import by_tile

Array = NDArray[np.float64]
Ints = NDArray[np.int32]
Bytes = NDArray[np.uint8]

_TILE = 512
_CELLS_ACROSS = 64
_MAX_CELLS = 2_000_000
_AT_ONCE = 65_536
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
    frames: Sequence[PlacedFrame],
    thumbnails: Mapping[str, Bytes],
    terrain: Terrain,
    held: Mapping[str, NDArray[np.float32]] | None = None,
) -> dict[str, NDArray[np.float32]]:
    """Gains that make neighbouring frames alike.

    The mean logarithm of the mosaic's brightness stays as it was, channel by channel; where some gains are held, the
    others follow those instead.

    Args:
        frames: placed frames in order of vehicle and time.
        thumbnails: image -> uint8 (rows, columns, 3), means of a picture's parts (RenderStats.thumbnails of an earlier
            rendering); a frame without one gets its vehicle's gain.
        terrain: the ground's height.
        held: image -> gain (3,) of frames that are drawn already and stay as they are.

    Returns:
        image -> float32 (3,), factor of red, green and blue for every frame, within 1/1.6 to 1.6.
    """
    held = held or {}
    known = [i for i, f in enumerate(frames) if f.frame.image in thumbnails]
    if len(known) < 2:
        return {}
    some = [frames[i] for i in known]
    cameras = [f.camera for f in some]
    small = np.stack([thumbnails[f.frame.image] for f in some])
    shots = Shots.of(cameras, [False] * len(cameras))
    names = sorted({f.frame.vehicle for f in frames})
    vehicle = np.array([names.index(f.frame.vehicle) for f in some])

    labels, grid = _coarse_labels(cameras, shots, terrain)
    seams = _seams(labels, grid)
    inner = _consecutive(cameras, shots, vehicle, terrain)
    ratios, good = [], []
    for meeting in (seams, inner):
        ratio, usable = _log_ratios(meeting, shots, small, terrain)
        ratios.append(ratio)
        good.append(usable)
    usable = np.concatenate(good)
    a, b = (np.concatenate([getattr(m, side) for m in (seams, inner)])[usable] for side in "ab")
    fixed = np.array([f.frame.image in held for f in some])
    log_held = np.array([np.log(held.get(f.frame.image, np.ones(3))) for f in some])
    of_vehicle, of_frame = _solve(a, b, np.concatenate(ratios)[usable], vehicle, len(names), fixed, log_held)
    own = np.where(fixed[:, None], log_held, of_vehicle[vehicle] + of_frame)
    area = np.bincount(labels[labels > 0] - 1, minlength=len(some)).astype(float)
    level = np.zeros(3) if fixed.any() else (area[:, None] * own).sum(0) / max(1.0, area.sum())
    gains = {f.frame.image: _factor(of_vehicle[names.index(f.frame.vehicle)] - level) for f in frames}
    gains |= {f.frame.image: _factor(g - level) for f, g in zip(some, own)}
    return gains | {f.frame.image: held[f.frame.image] for f in frames if f.frame.image in held}


def _factor(log_gain: Array) -> NDArray[np.float32]:
    return np.exp(np.clip(log_gain, -_CLIP, _CLIP)).astype(np.float32)


def _coarse_labels(cameras: Sequence[Camera], shots: Shots, terrain: Terrain) -> tuple[Ints, GroundGrid]:
    """The mosaic's labels (index + 1) on cells of a 64th of a picture."""
    boxes = footprint_boxes(cameras, float(terrain.z.min()), float(terrain.z.max()))
    boxes = boxes[boxes[:, 0] <= boxes[:, 2]]
    if len(boxes) == 0:
        return np.zeros((1, 1), np.int32), GroundGrid(0, 0.0, 0.0, 1.0, 1, 1)
    side = float(np.median(boxes[:, 2:] - boxes[:, :2]))
    box = BoundingBox.around(boxes)
    cell = max(side / _CELLS_ACROSS, float(np.sqrt(box.width * box.height / _MAX_CELLS)), 1e-3)
    grid = GroundGrid.around(0, box, cell)
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


def _consecutive(cameras: Sequence[Camera], shots: Shots, vehicle: NDArray[np.intp], terrain: Terrain) -> _Meetings:
    """A 3 x 2 grid of points of each frame with the next one of its vehicle and with the one before: alike in both."""
    u, v = np.meshgrid([0.2, 0.5, 0.8], [0.3, 0.7])
    share = np.stack([u.ravel(), v.ravel()], 1)
    by_lens: dict[Lens, Array] = {}
    for lens in {camera.lens for camera in cameras}:
        pixels = share * (lens.width - 1.0, lens.height - 1.0)
        xy = lens.undistort((pixels - lens.principal_point) / lens.focal_px)
        by_lens[lens] = np.concatenate([xy, np.ones((len(xy), 1))], 1)
    rays = np.stack([by_lens[camera.lens] for camera in cameras]) @ shots.rotation.transpose(0, 2, 1)
    height = shots.position[:, 2] - terrain.height(shots.position[:, :2])
    descent = np.where(rays[..., 2:] < -LEAST_DESCENT, -rays[..., 2:], np.nan)
    ground = shots.position[:, None, :2] + rays[..., :2] * (height[:, None, None] / descent)

    same = np.nonzero(vehicle[1:] == vehicle[:-1])[0]
    a, b = np.concatenate([same, same + 1]), np.concatenate([same + 1, same])
    points = len(share)
    return _Meetings(
        np.repeat(a, points).astype(np.int32), np.repeat(b, points).astype(np.int32), ground[a].reshape(-1, 2)
    )


def _log_ratios(
    meetings: _Meetings, shots: Shots, small: Bytes, terrain: Terrain
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Log of colour a over colour b (M, 3), and where it means something (M,)."""
    ratio, usable = np.zeros((len(meetings.a), 3), np.float32), np.zeros(len(meetings.a), bool)
    west, north = (float(v) for v in shots.position[:, :2].mean(0))
    position, rotation = shots.about(west, north)
    for first in range(0, len(ratio), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        ground = np.nan_to_num(meetings.ground[some])
        place = np.stack([ground[:, 0] - west, north - ground[:, 1], terrain.height(ground)], 1)
        _compare(
            meetings.a[some], meetings.b[some], place, position, rotation, shots.lens, shots.size, small,
            ratio[some], usable[some],
        )  # fmt: skip
    return ratio, usable & np.asarray(np.isfinite(meetings.ground).all(axis=1))


@kernel
def _compare(a, b, place, position, rotation, lens, size, small, ratio, usable):  # type: ignore[no-untyped-def]
    rows, columns = small.shape[1], small.shape[2]
    for m in range(len(a)):
        seen = 0
        for side in range(2):
            k = a[m] if side == 0 else b[m]
            u, v = project(position[k], rotation[k], lens[k], place[m, 0], place[m, 1], place[m, 2])
            if u < 0.0 or v < 0.0 or u > size[k, 0] - 1.0 or v > size[k, 1] - 1.0:
                break
            x = min(max((u + 0.5) / size[k, 0] * columns - 0.5, 0.0), columns - 1.000001)
            y = min(max((v + 0.5) / size[k, 1] * rows - 0.5, 0.0), rows - 1.000001)
            j, i = int(x), int(y)
            fx, fy = x - j, y - i
            good = True
            for channel in range(3):
                top = small[k, i, j, channel] * (1.0 - fx) + small[k, i, j + 1, channel] * fx
                low = small[k, i + 1, j, channel] * (1.0 - fx) + small[k, i + 1, j + 1, channel] * fx
                value = top * (1.0 - fy) + low * fy
                good = good and value > _DARK and value < _BRIGHT
                ratio[m, channel] += (1.0 - 2.0 * side) * np.log(max(value, 1.0))
            seen += good
        usable[m] = seen == 2


def _solve(
    a: Ints,
    b: Ints,
    ratio: NDArray[np.float32],
    vehicle: NDArray[np.intp],
    vehicles: int,
    fixed: NDArray[np.bool_],
    log_held: Array,
) -> tuple[Array, Array]:
    """Log gains of vehicles (V, 3) and frames (N, 3): g_a - g_b = -ratio, robust (Geman-McClure), with priors to 0.

    Frames that are fixed (N,) have log_held (N, 3) and no part in the unknowns.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    n = len(vehicle)
    prior = np.r_[np.full(vehicles, _VEHICLE_SIGMA**-2), np.full(n, _FRAME_SIGMA**-2)]
    ratio = ratio + (np.where(fixed[a, None], log_held[a], 0.0) - np.where(fixed[b, None], log_held[b], 0.0))
    # Weights differ from sample to sample, unknowns do not: two frames meet in some ten samples, which are summed.
    pairs, of_pair = np.unique(a.astype(np.int64) * n + b, return_inverse=True)
    design = _pair_design(pairs // n, pairs % n, vehicle, vehicles, fixed)
    free = np.where(fixed, 0.0, 1.0)[:, None]
    x = np.zeros((vehicles + n, 3))
    for _ in range(_ROUNDS):
        own = (x[vehicle] + x[vehicles:]) * free
        error2 = np.square(own[a] - own[b] + ratio).mean(1) / _SAMPLE_SIGMA**2
        weight = (1.0 + error2 / 9.0) ** -2 / _SAMPLE_SIGMA**2
        summed = np.bincount(of_pair, weight, len(pairs))
        weighted = np.stack([np.bincount(of_pair, weight * ratio[:, k], len(pairs)) for k in range(3)], 1)
        normal = (design.T * summed) @ design + diags_array(prior)
        x = splu(normal.tocsc()).solve(-(design.T @ weighted))
    return x[:vehicles], x[vehicles:]


def _pair_design(
    a: NDArray[np.int64], b: NDArray[np.int64], vehicle: NDArray[np.intp], vehicles: int, fixed: NDArray[np.bool_]
) -> Any:
    """g_a - g_b of pairs of frames (P,) as a sparse matrix (P, V + N); frames that are fixed have no part in it."""
    from scipy.sparse import coo_array

    rows = np.arange(len(a))
    one_a, one_b = (np.where(fixed[side], 0.0, 1.0) for side in (a, b))
    columns = np.concatenate([vehicles + a, vehicles + b, vehicle[a], vehicle[b]])
    values = np.concatenate([one_a, -one_b, one_a, -one_b])
    return coo_array((values, (np.tile(rows, 4), columns)), shape=(len(a), vehicles + len(vehicle))).tocsr()
