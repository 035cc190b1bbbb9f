"""Where two frames show the same ground, and the ratio of their colours there.

Places are taken at the seams of the orthoimage, a little to either side of them (there one frame sees steeply, the
other obliquely), and on a grid over each frame and its nearest neighbours, of any vehicle.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.compute.threads import on_threads
from orthoswarm.model.arrays import Array, Bytes, Floats, Ints
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera, Lens
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.footprint import LEAST_DESCENT, footprint_boxes
from orthoswarm.mosaic.kernels.drawn_heights import heights
from orthoswarm.mosaic.kernels.render_arrays import Shots, project
from orthoswarm.mosaic.seam_labels import label_tile
from orthoswarm.mosaic.visible_ground import by_tile

_TILE = 512

_RATIO_SIGMA: Final = 0.08
"""Log ratio of two thumbnails at one place of even ground: reflection by direction, shadows (two suburbs with all kinds
of ground, once solved: half within 0.05, 90 % within 0.19; tried: 0.08 and 0.15)."""
_MISPLACED: Final = 0.7
"""Displacement of the two thumbnails against each other, in their pixels: a ratio's sigma grows by it times the
contrast from pixel to pixel (0.35 and 0.7 tried)."""
DARK_LEVEL: Final = 8.0  # thumbnail levels from 0 to here are partly clipped and say nothing about a gain
BRIGHT_LEVEL: Final = 247.0  # the same for levels from here to 255
_BESIDE_SEAM: Final = 0.35  # how far beside a seam, towards each picture's nadir, colours are compared as well
_RATIOS_PER_PICTURE: Final = 48  # most ratios a picture at and beside seams, besides neighbours' (cost)
_NEIGHBOURS: Final = 6  # nearest pictures with which each is compared; with 2 or 3 a lawn's steps stay
_NEIGHBOUR_PLACES: Final = ((0.2, 0.5, 0.8), (0.3, 0.7))  # that grid: shares of a picture's width, and of its height
_RATIOS_AT_ONCE: Final = 65_536  # places whose colours are compared at once (memory)
_LABEL_CELLS: Final = 64  # cells across a picture on which the seams for this comparison are found (cost)
_LABEL_MOST_CELLS: Final = 2_000_000  # most of these cells in a map; they grow beyond it (memory)


@dataclass(frozen=True, slots=True)
class OverlapColors:
    """Colours of the same ground in two frames, M samples.

    Attributes:
        frame: int32 (M, 2), indices of the frames.
        ratio: float32 (M, 3), log of the first one's colour over the other's.
        place: float32 (M, 2, 4), for either frame: where in the picture (x, y from its centre, half its width being 1),
            and how it is seen (tangents of the view direction, east and north).
        sigma: float32 (M,), of the ratio: great where the thumbnails change much from one pixel to the next, so that a
            small displacement matters; small on meadows, water and roads, where steps are seen most.
    """

    frame: Ints
    ratio: Floats
    place: Floats
    sigma: Floats

    @classmethod
    def joined(cls, parts: "Sequence[OverlapColors]") -> "OverlapColors":
        """All samples of one or more parts."""
        return cls(*(np.concatenate(arrays) for arrays in zip(*(part._arrays for part in parts), strict=True)))

    def put(self, at: int, part: "OverlapColors") -> None:
        """Write other samples over those from `at` on."""
        for own, its in zip(self._arrays, part._arrays, strict=True):
            own[at : at + len(its)] = its

    def first(self, count: int) -> "OverlapColors":
        """The first samples."""
        return OverlapColors(*(own[:count] for own in self._arrays))

    @property
    def _arrays(self) -> tuple[NDArray[Any], ...]:
        return self.frame, self.ratio, self.place, self.sigma


@dataclass(frozen=True, slots=True)
class _Meetings:
    """Places where two frames show the same ground: frames a and b (M,), ground points (M, 2)."""

    a: Ints
    b: Ints
    ground: Array


def overlap_colors(
    cameras: Sequence[Camera], shots: Shots, small: Bytes, terrain: Terrain, threads: int = 1
) -> tuple[OverlapColors, Array]:
    """Compare the frames' colours where they overlap.

    Args:
        cameras: N cameras; shots: the same as arrays. small: uint8 (N, rows, columns, 3) thumbnails.
        terrain: the ground. threads: that share the work.

    Returns:
        The samples, and each frame's share (N,) of the orthoimage in cells.
    """
    labels, grid = _coarse_labels(cameras, shots, terrain, threads)
    seams = _seams(labels, grid)
    towards = [_towards(seams, side, shots) for side in (seams.a, seams.b)]
    meetings = [*(_thinned(m, len(cameras)) for m in (seams, *towards)), _neighbours(cameras, shots, terrain)]
    area = np.bincount(labels[labels > 0] - 1, minlength=len(cameras)).astype(float)
    return _compared(meetings, shots, small, terrain, threads), area


def _coarse_labels(cameras: Sequence[Camera], shots: Shots, terrain: Terrain, threads: int) -> tuple[Ints, GroundGrid]:
    """The mosaic's labels (index + 1) on cells of a 64th of a picture."""
    boxes = footprint_boxes(cameras, float(terrain.z.min()), float(terrain.z.max()))
    boxes = boxes[boxes[:, 0] <= boxes[:, 2]]
    if len(boxes) == 0:
        return np.zeros((1, 1), np.int32), GroundGrid(epsg=0, west=0.0, north=0.0, gsd_m=1.0, width=1, height=1)
    side = float(np.median(boxes[:, 2:] - boxes[:, :2]))
    box = BoundingBox.around(boxes)
    cell = max(side / _LABEL_CELLS, float(np.sqrt(box.width * box.height / _LABEL_MOST_CELLS)), 1e-3)
    grid = GroundGrid.around(0, box, cell)
    labels = np.zeros((grid.height, grid.width), np.int32)

    def label(tile: tuple[tuple[int, int], Ints]) -> None:
        (r, c), ids = tile
        part = np.zeros((min(_TILE, grid.height - r), min(_TILE, grid.width - c)), np.int32)
        left, top = grid.west + c * cell, grid.north - r * cell
        lattice = heights(terrain, left, top, cell, _TILE)
        label_tile(part, shots.take(ids), (ids + 1).astype(np.int32), lattice=lattice, west=left, north=top, gsd_m=cell)
        labels[r : r + part.shape[0], c : c + part.shape[1]] = part

    for _ in on_threads(label, by_tile(cameras, grid, _TILE, terrain).items(), threads):
        pass
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


def _neighbours(cameras: Sequence[Camera], shots: Shots, terrain: Terrain) -> _Meetings:
    """A grid of points of each frame, with each of the frames that have the nearest nadirs."""
    from scipy.spatial import cKDTree

    u, v = np.meshgrid(*_NEIGHBOUR_PLACES)
    share = np.stack([u.ravel(), v.ravel()], 1)
    ground = grid_on_ground(cameras, shots, terrain, share)

    nearest = min(_NEIGHBOURS + 1, len(cameras))
    others = cKDTree(shots.position[:, :2]).query(shots.position[:, :2], nearest)[1].reshape(len(cameras), nearest)
    a = np.repeat(np.arange(len(cameras)), nearest)
    b = others.ravel()
    a, b = a[a != b], b[a != b]
    points = len(share)
    return _Meetings(
        np.repeat(a, points).astype(np.int32), np.repeat(b, points).astype(np.int32), ground[a].reshape(-1, 2)
    )


def grid_on_ground(cameras: Sequence[Camera], shots: Shots, terrain: Terrain, share: Array) -> Array:
    """Ground points (N, P, 2) of N frames at shares (P, 2) of their width and height; NaN above the horizon."""
    by_lens: dict[Lens, Array] = {}
    for lens in {camera.lens for camera in cameras}:
        pixels = share * (lens.width - 1.0, lens.height - 1.0)
        xy = lens.undistort((pixels - lens.principal_point) / lens.focal_px)
        by_lens[lens] = np.concatenate([xy, np.ones((len(xy), 1))], 1)
    rays = np.stack([by_lens[camera.lens] for camera in cameras]) @ shots.rotation.transpose(0, 2, 1)
    height = shots.position[:, 2] - terrain.height(shots.position[:, :2])
    descent = np.where(rays[..., 2:] < -LEAST_DESCENT, -rays[..., 2:], np.nan)
    return np.asarray(shots.position[:, None, :2] + rays[..., :2] * (height[:, None, None] / descent))


def _towards(seams: _Meetings, frame: Ints, shots: Shots) -> _Meetings:
    """The same places, moved towards the nadirs of one of the two frames."""
    nadir = shots.position[frame, :2]
    return _Meetings(seams.a, seams.b, seams.ground + _BESIDE_SEAM * (nadir - seams.ground))


def _thinned(meetings: _Meetings, frames: int) -> _Meetings:
    """Every k-th place, so that there are not more than some a frame."""
    step = max(1, -(-len(meetings.a) // (_RATIOS_PER_PICTURE // 3 * frames)))
    return _Meetings(meetings.a[::step], meetings.b[::step], meetings.ground[::step])


def _compared(
    meetings: Sequence[_Meetings], shots: Shots, small: Bytes, terrain: Terrain, threads: int
) -> OverlapColors:
    """The samples at places whose colour both frames show."""
    west, north = (float(v) for v in shots.position[:, :2].mean(0))
    position, rotation = shots.about(west, north)

    def compare(some: _Meetings) -> OverlapColors:
        count = len(some.a)
        ratio, usable = np.zeros((count, 3), np.float32), np.zeros(count, bool)
        contrast, seen = np.zeros(count, np.float32), np.zeros((count, 2, 4), np.float32)
        ground = np.nan_to_num(some.ground)
        place = np.stack([ground[:, 0] - west, north - ground[:, 1], terrain.height(ground)], 1)
        _compare(
            some.a, some.b, place, position, rotation, shots.lens, shots.size, small, ratio, usable, seen, contrast,
        )  # fmt: skip
        usable &= np.asarray(np.isfinite(some.ground).all(axis=1))
        sigma = np.sqrt(_RATIO_SIGMA**2 + np.square(_MISPLACED * contrast))
        return OverlapColors(np.stack([some.a, some.b], 1)[usable], ratio[usable], seen[usable], sigma[usable])

    names = "a", "b", "ground"
    parts = (
        _Meetings(*(np.ascontiguousarray(getattr(kind, name)[first : first + _RATIOS_AT_ONCE]) for name in names))
        for kind in meetings
        for first in range(0, max(1, len(kind.a)), _RATIOS_AT_ONCE)
    )
    places = sum(len(kind.a) for kind in meetings)
    all_ = OverlapColors(
        np.empty((places, 2), np.int32), np.empty((places, 3), np.float32), np.empty((places, 2, 4), np.float32),
        np.empty(places, np.float32),
    )  # fmt: skip
    filled = 0
    for part in on_threads(compare, parts, threads):  # which are not all there at once
        all_.put(filled, part)
        filled += len(part.frame)
    return all_.first(filled)


@in_place_kernel
def _compare(a, b, place, position, rotation, lens, size, small, ratio, usable, seen, contrast):  # type: ignore[no-untyped-def]
    rows, columns = small.shape[1], small.shape[2]
    for m in range(len(a)):
        clear = 0
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
                if channel == 1:
                    falling = float(small[k, i + 1, j + 1, 1]) - float(small[k, i, j, 1])
                    rising = float(small[k, i, j + 1, 1]) - float(small[k, i + 1, j, 1])
                    across, down = falling + rising, falling - rising
                    contrast[m] += 0.5 * np.hypot(across, down) / max(value, 1.0)
                good = good and value > DARK_LEVEL and value < BRIGHT_LEVEL
                ratio[m, channel] += (1.0 - 2.0 * side) * np.log(max(value, 1.0))
            half = 0.5 * size[k, 0]
            seen[m, side, 0] = (u + 0.5) / half - 1.0
            seen[m, side, 1] = (v + 0.5 - 0.5 * size[k, 1]) / half
            rise = max(position[k, 2] - place[m, 2], 1e-3)
            seen[m, side, 2] = (place[m, 0] - position[k, 0]) / rise
            seen[m, side, 3] = (position[k, 1] - place[m, 1]) / rise
            clear += good
        usable[m] = clear == 2
