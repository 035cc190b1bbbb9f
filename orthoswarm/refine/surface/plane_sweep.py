"""Heights of the nodes of a grid by a plane sweep over several pictures, with steps where the pictures have edges.

Surfaces parallel to the ground are laid through the pictures (Collins 1996). At each node and height the picture most
nearly above is correlated with four around it, of which the two most alike count, since a wall hides a place from some
(Kang et al. 2001); semi-global optimisation (Hirschmüller 2008) chooses the heights.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from scipy.spatial import cKDTree

from orthoswarm.model.arrays import Array, Flags, Floats, Gray, Indices, Ints
from orthoswarm.model.placement import Terrain
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, F
from orthoswarm.refine.features.working_pictures import shrunk
from orthoswarm.refine.surface import plane_sweep_kernels as kernels
from orthoswarm.refine.surface.vertical_line_locus import REFERENCE_HEIGHT_M

_LEAST_PICTURES: Final = 3  # one and two others: of fewer the two most alike are none
_BLOCK_NODES: Final = 48
"""Side of the blocks of nodes that are measured at a time, in the same pictures (measured: of 96 nodes 82.9 % of those
on wide roofs are right within 1 m instead of 84.5 %, beside them 90.4 instead of 93.2; 32 are no better)."""
_BORDER_NODES: Final = 4
"""Nodes around a block that it is measured with (measured: 8 nodes take a third more time, and 0.3 per cent more nodes
on wide roofs are right within 1 m). The outermost may lie at any height."""
_BLOCKS_PER_TASK: Final = 16  # blocks of one task, so that neighbours read a picture once (memory)
_HEIGHT_STEP_M: Final = 0.75  # step of the heights at the reference height: a third of a pixel's parallax
_BEST_BASE: Final = 0.45
"""Wished distance of the pictures compared over the flying height (measured: 0.55 is as good; of 0.35 one per cent
fewer nodes are right within 1 m, of 0.25 five)."""
_LEAST_BASE: Final = 0.12  # ... and the least: nearer pictures give inaccurate heights
_SPREAD_HEIGHTS: Final = 0.4
"""Further references lie within so many flying heights (measured on one surface model: with 0.2 78 % of the cells on
trees and roofs are within 1 m, with 0.4 82 % of a sixth fewer)."""
_EDGE_LEVELS: Final = 8.0  # difference of grey values that halves what is between the costs of a step
_REACH_HEIGHTS: Final = 1.5  # pictures whose nadir points are farther away, in flying heights, are not compared
_RIM_SHARE: Final = 0.02  # share of a picture's sides at its rim that shows no place
_MOST_HIDDEN: Final = 0.75  # pictures that show less than the rest of nine places of a block are not compared
_RANGE_STEPS: Final = 4.0  # a narrowed range goes on for so many steps beyond the heights that occur ...
_RANGE_NODES: Final = 9  # ... within a square of so many coarse nodes


@dataclass(frozen=True, slots=True)
class SweepViews:
    """Pictures to compare: their cameras, and what reads each at the scale of its lens (by itself, in any process)."""

    cameras: CameraBlock
    read: Sequence[Callable[[], Gray]]


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepCosts:
    """What makes heights likely; correlations are between -1 and 1.

    Attributes:
        noise_levels: sigma of grey values below which a node's texture says nothing.
        doubt: cost of any height above the ground, in correlation.
        slope: cost of a step to the next height between nodes, in correlation.
        edge: cost of a larger step across a strong edge of the picture, and on even ground.
        unlike: mean of one less the correlations from which a node is not known (NaN); infinite: all are.
        references: pictures that are compared with others, in turn; each measures all nodes for itself.
        depth_m: how far below the ground heights are searched, too.
        step_m: step of the heights at the reference height.
        narrow: search every second node first, and then only the range of heights that occurs, with the ground's.
    """

    noise_levels: float
    doubt: float
    slope: float
    edge: tuple[float, float]
    unlike: float = np.inf
    references: int = 1
    depth_m: float = 0.0
    step_m: float = _HEIGHT_STEP_M
    narrow: bool = False


@dataclass(frozen=True, slots=True)
class _View:
    """A picture by itself: position float64 (3,), rotation (3, 3), lens (8,), and by how much it is reduced."""

    position: Array
    rotation: Array
    lens: Array
    read: Callable[[], Gray]
    factor: int


@dataclass(frozen=True, slots=True)
class SweepBlock:
    """Nodes that are measured together.

    Attributes:
        inner: rows and columns (from, to, from, to) of the nodes whose heights are kept; those around them are measured
            to hold them. corner: row and column of the first node.
        ground: float32, its nodes. levels: int32, heights that each can have.
        views: for each reference the indices of its pictures among the task's, itself first.
    """

    inner: tuple[int, int, int, int]
    corner: tuple[int, int]
    ground: Floats
    levels: Ints
    views: list[list[int]]


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepTask:
    """Some blocks side by side with their pictures; west, south: node (0, 0); cell_m: of nodes, step_m: of heights."""

    west: float
    south: float
    cell_m: float
    step_m: float
    costs: SweepCosts
    views: list[_View]
    blocks: list[SweepBlock]


def sweep_tasks(
    views: SweepViews, ground: Terrain, tallest: Floats, *, height_m: float, costs: SweepCosts
) -> Iterator[SweepTask]:
    """The blocks of nodes that may be raised, with pictures to measure them, row by row, some a task for `measured`.

    ground: its nodes are those that are measured. tallest: float32 (rows, columns), how high above it something may
    be, metres; 0: the node is on it. height_m: flying height above the ground.
    """
    swath, step_m = _Swath(views, ground, height_m), costs.step_m * height_m / REFERENCE_HEIGHT_M
    depth_m = np.float32(costs.depth_m)
    pending: list[tuple[SweepBlock, list[list[int]]]] = []

    def task() -> SweepTask:
        pictures = sorted({i for _, chosen in pending for some in chosen for i in some})
        place = {i: k for k, i in enumerate(pictures)}
        blocks = [
            SweepBlock(block.inner, block.corner, block.ground, block.levels, [[place[i] for i in c] for c in chosen])
            for block, chosen in pending
        ]
        return SweepTask(
            west=ground.west, south=ground.south, cell_m=ground.step_m, step_m=step_m, costs=costs,
            views=[swath.view(i) for i in pictures], blocks=blocks,
        )  # fmt: skip

    rows, columns = tallest.shape
    for row in range(0, rows, _BLOCK_NODES):
        for column in range(0, columns, _BLOCK_NODES):
            block = _block((row, column), ground, tallest, depth_m, step_m)
            chosen = [] if block is None else swath.chosen(_places(block, ground), costs.references)
            if block is not None and chosen:
                pending.append((block, chosen))
            if len(pending) == _BLOCKS_PER_TASK:
                yield task()
                pending.clear()
    if pending:
        yield task()


def measured(task: SweepTask) -> list[tuple[tuple[int, int, int, int], Floats]]:
    """Rows and columns (from, to, from, to) of each block, and its heights over the ground by each reference.

    Heights are float32 (references, rows, columns), metres; NaN where a node is not known.
    """
    pictures = [shrunk(view.read(), view.factor) for view in task.views]
    out = []
    for block in task.blocks:
        low, levels = (0, block.levels) if not task.costs.narrow else _narrowed(task, block, pictures)
        heights = np.empty((len(block.views), *levels.shape), np.float32)
        for own, views in zip(heights, block.views, strict=True):
            found, unlike = _heights(task, block, pictures, views, levels, low=low)
            own[:] = np.where(unlike < task.costs.unlike, found - np.float32(task.costs.depth_m), np.nan)
        top, left = block.corner
        r0, r1, c0, c1 = block.inner
        out.append((block.inner, heights[:, r0 - top : r1 - top, c0 - left : c1 - left].copy()))
    return out


def ground_at_nodes(ground: Terrain, west: float, south: float, step_m: float, shape: tuple[int, int]) -> Terrain:
    """The same ground on other nodes, (rows, columns) of them."""
    east, north = west + step_m * np.arange(shape[1]), south + step_m * np.arange(shape[0])
    z = np.empty(shape, np.float32)
    for row in range(shape[0]):
        z[row] = ground.height(np.column_stack([east, np.full(shape[1], north[row])]))
    return Terrain(west, south, step_m, z)


class _Swath:
    """All pictures that may be compared, and which of them show a place best."""

    def __init__(self, views: SweepViews, ground: Terrain, height_m: float) -> None:
        self.views, self.ground, self.height_m = views, ground, height_m
        self._nadir = views.cameras.position[:, :2]
        self._tree = cKDTree(self._nadir) if len(views.cameras) else None

    def view(self, i: int) -> _View:
        """A picture by its index."""
        cameras = self.views.cameras
        position, lens = cameras.position[i].copy(), cameras.lens[cameras.lens_id[i]].copy()
        pixel_m = (position[2] - float(self.ground.height(position[:2]))) / lens[F]
        factor = max(1, int(self.ground.step_m / max(pixel_m, 1e-3)))
        return _View(position, cameras.rotation[i].copy(), lens, self.views.read[i], factor)

    def chosen(self, places: Array, references: int) -> list[list[int]]:
        """The picture most nearly above places (9, 3) and further ones around it, each with others that see them, too.

        A picture counts as farther away the less of the places it shows. Further references lie far from each other, so
        that walls hide other places from them.
        """
        if self._tree is None:
            return []
        middle = places[len(places) // 2, :2]
        near = np.array(sorted(self._tree.query_ball_point(middle, _REACH_HEIGHTS * self.height_m)), np.intp)
        hidden = 1.0 - self._seen(near, places).mean(1)
        near, hidden_m = near[hidden < _MOST_HIDDEN], self.height_m * hidden[hidden < _MOST_HIDDEN]
        if not len(near):
            return []
        nadir = self._nadir[near]
        away = np.hypot(*(nadir - middle).T) + hidden_m
        may, apart = away < away.min() + _SPREAD_HEIGHTS * self.height_m, np.full(len(near), np.inf)
        found, k = [], int(np.argmin(away))
        for _ in range(min(references, len(near))):
            found.append(near[self._with_others(k, nadir, hidden_m)].tolist())
            apart = np.minimum(apart, np.hypot(*(nadir - nadir[k]).T))
            k = int(np.argmax(np.where(may, apart, -1.0)))
        return [pictures for pictures in found if len(pictures) >= _LEAST_PICTURES]

    def _with_others(self, k: int, nadir: Array, hidden_m: Array) -> list[int]:
        """A picture among near ones, and of the others the nearest to each of four places around it."""
        chosen, left = [k], np.hypot(*(nadir - nadir[k]).T) >= _LEAST_BASE * self.height_m
        for angle in np.arange(4) * np.pi / 2:
            wished = nadir[k] + _BEST_BASE * self.height_m * np.array([np.cos(angle), np.sin(angle)])
            if left.any():
                chosen.append(int(np.argmin(np.where(left, np.hypot(*(nadir - wished).T) + hidden_m, np.inf))))
                left[chosen[-1]] = False
        return chosen

    def _seen(self, pictures: Indices, places: Array) -> Flags:
        """Which pictures show which places, bool (N, P)."""
        cameras, count = self.views.cameras, len(places)
        index = np.repeat(pictures, count)
        size = cameras.lens[cameras.lens_id[index]][:, [WIDTH, HEIGHT]]
        share = cameras.project(index, np.tile(places, (len(pictures), 1))) / size
        return ((share > _RIM_SHARE) & (share < 1.0 - _RIM_SHARE)).all(1).reshape(-1, count)


def _block(
    first: tuple[int, int], ground: Terrain, tallest: Floats, depth_m: np.float32, step_m: float
) -> SweepBlock | None:
    """The block whose inner nodes begin at a row and column; None where nothing is raised."""
    (row, column), side, border = first, _BLOCK_NODES, _BORDER_NODES
    rows, columns = tallest.shape
    inner = (row, min(row + side, rows), column, min(column + side, columns))
    if not tallest[inner[0] : inner[1], inner[2] : inner[3]].any():
        return None
    top, left = max(row - border, 0), max(column - border, 0)
    outer = (slice(top, row + side + border), slice(left, column + side + border))
    high = tallest[outer]
    levels = np.where(high > 0.0, np.ceil((high + depth_m) / np.float32(step_m)) + 2, 0).astype(np.int32)
    levels[[0, -1]] = 0
    levels[:, [0, -1]] = 0
    return SweepBlock(inner, (top, left), ground.z[outer] - depth_m, levels, []) if levels.any() else None


def _places(block: SweepBlock, ground: Terrain) -> Array:
    """Nine places across a block's raised nodes on the ground, float64 (9, 3)."""
    rows, columns = np.nonzero(block.levels)
    row, column = (np.linspace(v.min(), v.max(), 3) for v in (rows, columns))
    at = np.stack(np.meshgrid(column + block.corner[1], row + block.corner[0]), -1).reshape(-1, 2) * ground.step_m
    z = np.full((9, 1), np.median(block.ground[block.levels > 0]))
    return np.hstack([np.array([ground.west, ground.south]) + at, z])


def _narrowed(task: SweepTask, block: SweepBlock, pictures: Sequence[Gray]) -> tuple[int, Ints]:
    """The lowest height that occurs, in steps, and the number from there that each node can have.

    Found by a search of every second node at every second height, which takes an eighth of the time.
    """
    coarse = (block.levels[::2, ::2] + 1) // 2
    coarse[[0, -1]] = 0
    coarse[:, [0, -1]] = 0
    found = _heights(task, block, pictures, block.views[0], coarse, every=2)[0][1:-1, 1:-1] / np.float32(task.step_m)
    found = cv2.medianBlur(found, 5)
    level = task.costs.depth_m / task.step_m
    low = max(0, int(min(found.min(), level) - _RANGE_STEPS))
    around = cv2.dilate(np.pad(found, 1, "edge"), np.ones((_RANGE_NODES, _RANGE_NODES), np.uint8))
    high = np.ceil(np.maximum(around, level) + _RANGE_STEPS).astype(np.int32).repeat(2, 0).repeat(2, 1)
    rows, columns = block.levels.shape
    return low, np.clip(block.levels - low, 0, high[:rows, :columns] - low)


def _heights(
    task: SweepTask,
    block: SweepBlock,
    pictures: Sequence[Gray],
    views: Sequence[int],
    levels: Ints,
    *,
    every: int = 1,
    low: int = 0,
) -> tuple[Floats, Floats]:
    """The heights of a block's nodes, those around the inner ones included, by one reference and its others; and costs.

    levels: the number of heights of each node. every: of nodes and of heights. low: the first height, in such steps.
    """
    f, costs = np.float32, task.costs
    most, cell, step = int(levels.max()), task.cell_m * every, f(task.step_m * every)
    ground = block.ground[::every, ::every] + f(low) * step
    around = np.asarray(cv2.dilate(levels.astype(np.uint16), np.ones((3, 3), np.uint8)), np.int32)
    volumes = np.empty((len(views), levels.shape[0], most, levels.shape[1]), np.float32)
    west, south = task.west + block.corner[1] * task.cell_m, task.south + block.corner[0] * task.cell_m
    for volume, i in zip(volumes, views, strict=True):
        view = task.views[i]
        kernels.sample(
            pictures[i], float(view.factor), view.position, view.rotation, view.lens, west, south, cell, ground, around,
            step, volume,
        )  # fmt: skip
    cost = np.empty(volumes.shape[1:], np.float32)
    kernels.unlikeness(volumes, levels, f(costs.noise_levels**2), f(costs.doubt), cost)
    steps = f(costs.slope), f(costs.edge[0]), f(costs.edge[1]), f(1.0 / _EDGE_LEVELS)
    found, unlike = np.empty(levels.shape, np.float32), np.empty(levels.shape, np.float32)
    kernels.lowest(kernels.semi_global(cost, volumes[0], levels, steps), cost, levels, step, found, unlike)
    found = np.asarray(cv2.medianBlur(found, 3), np.float32)  # single nodes tell nothing
    return found + f(low) * step, unlike
