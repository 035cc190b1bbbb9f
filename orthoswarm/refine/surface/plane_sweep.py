"""Heights of tall things by a plane sweep over several pictures, with steps where the pictures have edges.

Surfaces parallel to the ground are laid through the pictures (Collins 1996). At each cell and height the picture most
nearly above is correlated with four around it, of which the two most alike count, since a wall hides a place from some
(Kang et al. 2001); semi-global optimisation (Hirschmüller 2008) chooses the heights. What the pictures do not decide
stays on the ground.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Flags, Floats, Gray, Ints
from orthoswarm.model.placement import Terrain
from orthoswarm.model.task_runner import Run
from orthoswarm.mosaic.confidence import UNMEASURED_M
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, F
from orthoswarm.refine.features.working_pictures import Pictures, shrunk
from orthoswarm.refine.surface import plane_sweep_kernels as kernels
from orthoswarm.refine.surface.seen_objects import seen_objects
from orthoswarm.refine.surface.vertical_line_locus import REFERENCE_HEIGHT_M

_LEAST_PICTURES = 3  # one and two others: of fewer the two most alike are none

_TALL_BLOCK_NODES: Final = 48
"""Side of the blocks of nodes that are measured at a time, in the same pictures (measured: of 96 nodes 82.9 % of those
on wide roofs are right within 1 m instead of 84.5 %, beside them 90.4 instead of 93.2; 32 are no better)."""
_TALL_BLOCK_BORDER_NODES: Final = 4
"""Nodes around a block that it is measured with (measured: 8 nodes take a third more time, and 0.3 per cent more nodes
on wide roofs are right within 1 m). The outermost may lie at any height."""
_TALL_BLOCKS_PER_TASK: Final = 16  # blocks of one task, so that neighbours read a picture once (memory)
_TALL_HEIGHT_STEP_M: Final = 0.75  # step of the heights at the reference height: a third of a pixel's parallax
_TALL_BEST_BASE: Final = 0.45
"""Wished distance of the pictures compared over the flying height (measured: 0.55 is as good; of 0.35 one per cent
fewer nodes are right within 1 m, of 0.25 five)."""
_TALL_LEAST_BASE: Final = 0.12  # ... and the least: nearer pictures give inaccurate heights
_TALL_NOISE_LEVELS: Final = 1.0
"""Sigma of grey values below which a cell's texture says nothing (measured: with 2 a tenth fewer of a plain roof's
nodes are right within 1 m; less than 1 is the noise of a JPEG)."""
_TALL_DOUBT: Final = 0.07
"""Cost of any height against the ground, in correlation: what is not sure is ground (measured: with 0.05 more roofs are
whole and more of the ground beside them is raised, with 0.1 the other way round)."""
_TALL_SLOPE_COST: Final = 0.15  # cost of a step to the next height between cells, in correlation
_TALL_EDGE_COST: Final = (0.15, 1.2)
"""Cost of a larger step across a strong edge of the picture, and on even ground (measured: 0.3 and 1.2 give 0.4 per
cent fewer right nodes, 0.3 and 1.8 another 0.7)."""
TALL_FROM_M: Final = 1.5  # what differs less from the ground belongs to it
_TALL_EDGE_LEVELS: Final = 8.0  # difference of grey values that halves what is between these costs
_TALL_REACH_HEIGHTS: Final = 1.5  # pictures whose nadir points are farther away, in flying heights, are not compared
_TALL_RIM_SHARE: Final = 0.05  # share of a picture's sides at its rim that a block's middle must not lie in
_TALL_NEAR_M: Final = 18.0  # heights are measured within this distance of raised points at the reference height
_TALL_ABOVE_M: Final = 2.0
"""... and up to so much above the highest of them (0 and larger distances change the share of nodes within 1 m by at
most 0.008 on two scenes)."""
_TALL_CELL_M: Final = 1.25  # distance of the nodes whose heights are measured at the reference height


@dataclass(frozen=True, slots=True)
class SweepViews:
    """Pictures of one vehicle with their cameras; usable: bool (N,), False where content or camera is unreliable."""

    cameras: CameraBlock
    pictures: Pictures
    usable: Flags


@dataclass(frozen=True, slots=True)
class _View:
    """A picture by itself: position float64 (3,), rotation (3, 3), lens (8,), and by how much it is reduced."""

    position: Array
    rotation: Array
    lens: Array
    picture: Pictures
    factor: int

    def reduced(self) -> Gray:
        """The picture with pixels about as large as the cells."""
        return shrunk(self.picture.once(0), self.factor)


@dataclass(frozen=True, slots=True)
class _Block:
    """Nodes that are measured together.

    Attributes:
        inner: rows and columns (from, to, from, to) of the ground's nodes whose heights are kept; those around them are
            measured to hold them. corner: row and column of the first node.
        ground: float32, its nodes. levels: int32, heights that each can have.
        views: indices of the pictures among the task's, the one that the others are compared with first.
    """

    inner: tuple[int, int, int, int]
    corner: tuple[int, int]
    ground: Floats
    levels: Ints
    views: list[int]


@dataclass(frozen=True, slots=True, kw_only=True)
class _SweepTask:
    """Some blocks side by side with their pictures; west, south: node (0, 0); cell_m: of nodes, step_m: of heights."""

    west: float
    south: float
    cell_m: float
    step_m: float
    views: list[_View]
    blocks: list[_Block]


def tall_heights(views: Sequence[SweepViews], ground: Terrain, tallest: Floats, *, height_m: float, run: Run) -> Floats:
    """Heights above the ground, float32 (rows, columns) of its nodes, metres, 0 where it is the surface.

    ground: its nodes are the cells whose heights are measured. tallest: float32 (rows, columns), how high something may
    stand, metres; 0: the node is on the ground. height_m: flying height above the ground.
    """
    out = np.zeros(tallest.shape, np.float32)
    tasks = list(_tasks(_Swath(views, ground, height_m), tallest))
    for task, found in zip(tasks, run(_measure, tasks), strict=True):
        for block, heights in zip(task.blocks, found, strict=True):
            top, bottom, left, right = block.inner
            out[top:bottom, left:right] = heights
    return out


class _Swath:
    """All pictures that may be compared, and which of them show a place best."""

    def __init__(self, views: Sequence[SweepViews], ground: Terrain, height_m: float) -> None:
        self.views, self.ground, self.height_m = views, ground, height_m
        self._owner = np.repeat(np.arange(len(views)), [len(v.usable) for v in views])
        self._index = np.concatenate([np.arange(len(v.usable)) for v in views])
        self._usable = np.concatenate([v.usable for v in views])
        self._nadir = np.concatenate([v.cameras.position[: len(v.usable), :2] for v in views])

    def view(self, picture: int) -> _View:
        """A picture by its index among all."""
        views, i = self.views[self._owner[picture]], int(self._index[picture])
        cameras = views.cameras
        position, lens = cameras.position[i].copy(), cameras.lens[cameras.lens_id[i]].copy()
        pixel_m = (position[2] - float(self.ground.height(position[:2]))) / lens[F]
        factor = max(1, int(self.ground.step_m / max(pixel_m, 1e-3)))
        return _View(position, cameras.rotation[i].copy(), lens, views.pictures.only(i), factor)

    def chosen(self, place: Array) -> list[int]:
        """The picture most nearly above a place (3,), and others around it that see the place."""
        away = np.hypot(*(self._nadir - place[:2]).T)
        near = np.flatnonzero((away < _TALL_REACH_HEIGHTS * self.height_m) & self._usable)
        near = near[self._see(near, place)]
        if not len(near):
            return []
        chosen = [int(near[np.argmin(away[near])])]
        own = self._nadir[chosen[0]]
        base = np.hypot(*(self._nadir[near] - own).T)
        fit = near[base >= _TALL_LEAST_BASE * self.height_m].tolist()
        for angle in np.arange(4) * np.pi / 2:
            wished = own + _TALL_BEST_BASE * self.height_m * np.array([np.cos(angle), np.sin(angle)])
            left = [i for i in fit if i not in chosen]
            if left:
                chosen.append(left[int(np.argmin(np.hypot(*(self._nadir[left] - wished).T)))])
        return chosen

    def _see(self, pictures: NDArray[np.intp], place: Array) -> Flags:
        """Which pictures show a place well inside their border."""
        seen = np.zeros(len(pictures), bool)
        for k in np.unique(self._owner[pictures]):
            mine = self._owner[pictures] == k
            cameras, index = self.views[k].cameras, self._index[pictures[mine]]
            size = cameras.lens[cameras.lens_id[index]][:, [WIDTH, HEIGHT]]
            share = cameras.project(index, np.tile(place, (len(index), 1))) / size
            seen[mine] = ((share > _TALL_RIM_SHARE) & (share < 1.0 - _TALL_RIM_SHARE)).all(1)
        return seen


def _tasks(swath: _Swath, tallest: Floats) -> Iterator[_SweepTask]:
    """The blocks with nodes that may be raised and with pictures to measure them, row by row, some a task."""
    ground = swath.ground
    step_m = _TALL_HEIGHT_STEP_M * swath.height_m / REFERENCE_HEIGHT_M
    pending: list[tuple[_Block, list[int]]] = []

    def task() -> _SweepTask:
        pictures = sorted({i for _, chosen in pending for i in chosen})
        place = {i: k for k, i in enumerate(pictures)}
        blocks = [
            _Block(block.inner, block.corner, block.ground, block.levels, [place[i] for i in chosen])
            for block, chosen in pending
        ]
        views = [swath.view(i) for i in pictures]
        return _SweepTask(
            west=ground.west, south=ground.south, cell_m=ground.step_m, step_m=step_m, views=views, blocks=blocks
        )

    rows, columns = tallest.shape
    for row in range(0, rows, _TALL_BLOCK_NODES):
        for column in range(0, columns, _TALL_BLOCK_NODES):
            block = _block((row, column), ground, tallest, step_m)
            chosen = [] if block is None else swath.chosen(_middle(block, ground))
            if block is not None and len(chosen) >= _LEAST_PICTURES:
                pending.append((block, chosen))
            if len(pending) == _TALL_BLOCKS_PER_TASK:
                yield task()
                pending.clear()
    if pending:
        yield task()


def _block(first: tuple[int, int], ground: Terrain, tallest: Floats, step_m: float) -> _Block | None:
    """The block whose inner nodes begin at a row and column; None where nothing is raised."""
    (row, column), side, border = first, _TALL_BLOCK_NODES, _TALL_BLOCK_BORDER_NODES
    rows, columns = tallest.shape
    inner = (row, min(row + side, rows), column, min(column + side, columns))
    if not tallest[inner[0] : inner[1], inner[2] : inner[3]].any():
        return None
    top, left = max(row - border, 0), max(column - border, 0)
    outer = (slice(top, row + side + border), slice(left, column + side + border))
    high = tallest[outer]
    levels = np.where(high > 0.0, np.ceil(high / np.float32(step_m)) + 2, 0).astype(np.int32)
    levels[[0, -1]] = 0
    levels[:, [0, -1]] = 0
    return _Block(inner, (top, left), ground.z[outer].copy(), levels, []) if levels.any() else None


def _middle(block: _Block, ground: Terrain) -> Array:
    """The middle of a block's raised nodes on the ground, float64 (3,)."""
    row, column = (index.mean() + first for index, first in zip(np.nonzero(block.levels), block.corner, strict=True))
    z = np.median(block.ground[block.levels > 0])
    return np.array([ground.west + column * ground.step_m, ground.south + row * ground.step_m, z])


def _measure(task: _SweepTask) -> list[Floats]:
    """The heights of the inner nodes of each block of a task, metres."""
    pictures = [view.reduced() for view in task.views]
    out = []
    for block in task.blocks:
        heights = _heights(task, block, pictures)
        top, left = block.corner
        r0, r1, c0, c1 = block.inner
        out.append(heights[r0 - top : r1 - top, c0 - left : c1 - left].copy())
    return out


def _heights(task: _SweepTask, block: _Block, pictures: Sequence[Gray]) -> Floats:
    """The heights of a block's nodes, those around the inner ones included."""
    f = np.float32
    levels, most = block.levels, int(block.levels.max())
    around = np.asarray(cv2.dilate(levels.astype(np.uint16), np.ones((3, 3), np.uint8)), np.int32)
    volumes = np.empty((len(block.views), levels.shape[0], most, levels.shape[1]), np.float32)
    west, south = task.west + block.corner[1] * task.cell_m, task.south + block.corner[0] * task.cell_m
    for volume, i in zip(volumes, block.views, strict=True):
        view = task.views[i]
        kernels.sample(
            pictures[i], float(view.factor), view.position, view.rotation, view.lens, west, south, task.cell_m,
            block.ground, around, f(task.step_m), volume,
        )  # fmt: skip
    cost = np.empty(volumes.shape[1:], np.float32)
    kernels.unlikeness(volumes, levels, f(_TALL_NOISE_LEVELS**2), f(_TALL_DOUBT), cost)
    steps = f(_TALL_SLOPE_COST), f(_TALL_EDGE_COST[0]), f(_TALL_EDGE_COST[1]), f(1.0 / _TALL_EDGE_LEVELS)
    found = np.empty(levels.shape, np.float32)
    kernels.lowest(kernels.semi_global(cost, volumes[0], levels, steps), levels, f(task.step_m), found)
    return np.asarray(cv2.medianBlur(found, 3), np.float32)  # single cells tell nothing


def with_tall_surfaces(
    ground: Terrain, points: Array, views: Sequence[SweepViews], *, height_m: float, most_nodes: int, run: Run
) -> Terrain:
    """The bare ground plus the tops of what stands near raised points, where pictures see the ground behind it too.

    points: float64 (K, 3) at free positions on the visible surface. height_m: flying height above the ground.
    most_nodes: the ground gets no more nodes than this.
    """
    over = points[:, 2] - ground.height(points[:, :2])
    raised = over > TALL_FROM_M
    if not raised.any():
        return ground
    scale = height_m / REFERENCE_HEIGHT_M
    parts = max(1, round(ground.step_m / (_TALL_CELL_M * scale)))
    while parts > 1 and ground.z.size * parts**2 > most_nodes:
        parts -= 1
    fine = _finer(ground, parts)
    tallest = _tallest(points[raised, :2], over[raised], fine, _TALL_NEAR_M * scale)
    heights = tall_heights(views, fine, tallest, height_m=height_m, run=run)
    heights[heights < TALL_FROM_M] = 0.0
    cameras = CameraBlock.joined([v.cameras.take(np.flatnonzero(v.usable)) for v in views])
    may_stand = np.where((tallest > 0.0) & (heights == 0.0), np.float32(UNMEASURED_M), heights)
    return seen_objects(replace(fine, z=fine.z + heights, bare=fine.z, tops=fine.z + may_stand), cameras)


def _finer(ground: Terrain, parts: int) -> Terrain:
    """A ground with its nodes closer: each step divided into so many parts."""
    rows, columns = ((n - 1) * parts + 1 for n in ground.z.shape)
    step = ground.step_m / parts
    east, north = ground.west + step * np.arange(columns), ground.south + step * np.arange(rows)
    z = np.empty((rows, columns), np.float32)
    for row in range(rows):
        z[row] = ground.height(np.column_stack([east, np.full(columns, north[row])]))
    return Terrain(ground.west, ground.south, step, z)


def _tallest(xy: Array, over: Array, nodes: Terrain, near_m: float) -> Floats:
    """How high something may stand at each node, metres: above all raised points within a distance; 0 without any."""
    place = np.rint((xy - (nodes.west, nodes.south)) / nodes.step_m).astype(int)
    within = ((place >= 0) & (place < nodes.z.shape[::-1])).all(1)
    columns, rows = place[within].T
    highest = np.zeros(nodes.z.shape, np.float32)
    np.maximum.at(highest, (rows, columns), np.float32(_TALL_ABOVE_M) + over[within].astype(np.float32))
    side = 2 * int(near_m / nodes.step_m) + 1
    return np.asarray(cv2.dilate(highest, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))), np.float32)
