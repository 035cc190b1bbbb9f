"""Heights of tall things by a plane sweep over several pictures, with steps where the pictures have edges.

Surfaces parallel to the ground are laid through the pictures (Collins 1996). At each cell and height the picture most
nearly above is correlated with four around it, of which the two most alike count, since a wall hides a place from some
(Kang et al. 2001); semi-global optimisation (Hirschmüller 2008) chooses the heights. What the pictures do not decide
stays on the ground.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.model.placement import Terrain
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, F, project_point
from orthoswarm.refine.surface import plane_sweep_kernels as kernels

Array = NDArray[np.float64]
Gray = Callable[[int], NDArray[np.uint8]]
Mask = NDArray[np.bool_]
Float32 = NDArray[np.float32]

_LEAST_PICTURES = 3
"""One and two others: of fewer the two most alike are none."""


@dataclass(frozen=True, slots=True)
class SweepViews:
    """Pictures of one vehicle: cameras, and a grey picture by its index, uint8 (rows, columns) as its lens says."""

    cameras: CameraBlock
    gray: Gray


class PlaneSweep:
    """Measures heights above a ground in the pictures of some vehicles.

    Args:
        views: pictures of each vehicle. ground: its nodes are the cells whose heights are measured.
        height_m: flying height above the ground.
    """

    def __init__(self, views: Sequence[SweepViews], ground: Terrain, height_m: float) -> None:
        self._views, self._ground, self._height = views, ground, height_m
        self._owner = np.repeat(np.arange(len(views)), [len(v.cameras) for v in views])
        self._index = np.concatenate([np.arange(len(v.cameras)) for v in views])
        self._position = np.concatenate([v.cameras.position for v in views])

    def heights(self, wanted: Mask, tallest: Float32) -> Float32:
        """Heights above the ground, float32 (rows, columns) of its nodes, 0 where it is the surface.

        Args:
            wanted: bool, nodes where something may stand; the others are on the ground.
            tallest: float32, how high it may be there.
        """
        c = active().surface
        out = np.zeros(wanted.shape, np.float32)
        side, border = c.tall_block_nodes, c.tall_block_border_nodes
        for row in range(0, wanted.shape[0], side):
            for column in range(0, wanted.shape[1], side):
                inner = (slice(row, row + side), slice(column, column + side))
                if not wanted[inner].any():
                    continue
                top, left = max(row - border, 0), max(column - border, 0)
                outer = (slice(top, row + side + border), slice(left, column + side + border))
                found = self._block(wanted[outer], (top, left), float(tallest[outer].max()))
                own = wanted[inner]
                out[inner] = found[row - top : row - top + own.shape[0], column - left : column - left + own.shape[1]]
        return out

    def _block(self, wanted: Mask, corner: tuple[int, int], tallest_m: float) -> Float32:
        """Heights of a block of nodes whose first has row and column `corner`."""
        c, ground, f = active().surface, self._ground, np.float32
        step_m = c.tall_height_step_m * self._height / c.reference_height_m
        found = np.zeros(wanted.shape, np.float32)
        wanted = wanted.copy()
        wanted[[0, -1]] = False
        wanted[:, [0, -1]] = False
        west, south = ground.west + corner[1] * ground.step_m, ground.south + corner[0] * ground.step_m
        z = ground.z[corner[0] : corner[0] + wanted.shape[0], corner[1] : corner[1] + wanted.shape[1]]
        rows, columns = np.nonzero(wanted)
        if not len(rows):
            return found
        east, north = west + columns.mean() * ground.step_m, south + rows.mean() * ground.step_m
        chosen = self._chosen(np.array([east, north, np.median(z[wanted])]))
        if len(chosen) < _LEAST_PICTURES:
            return found
        heights = np.asarray(step_m * np.arange(int(np.ceil(tallest_m / step_m)) + 2), np.float64)
        around = np.asarray(cv2.dilate(wanted.astype(np.uint8), np.ones((3, 3), np.uint8))) > 0
        volumes = np.empty((len(chosen), *wanted.shape, len(heights)), np.float32)
        for volume, camera in zip(volumes, chosen, strict=True):
            self._sample(camera, (west, south), z, around, heights=heights, out=volume)
        cost, total = np.ones(volumes.shape[1:], np.float32), np.zeros(volumes.shape[1:], np.float32)
        kernels.unlikeness(volumes, wanted, f(c.tall_noise_levels**2), cost)
        cost[..., 1:] += f(c.tall_doubt)
        kernels.semi_global(
            cost, volumes[0], wanted, f(c.tall_slope_cost), f(c.tall_edge_cost[0]), f(c.tall_edge_cost[1]),
            f(1.0 / c.tall_edge_levels), total,
        )  # fmt: skip
        kernels.lowest(total, wanted, f(step_m), found)
        return found

    def _chosen(self, middle: Array) -> list[int]:
        """The picture most nearly above a place, and others around it that see the place."""
        c = active().surface
        offset = np.hypot(*(self._position[:, :2] - middle[:2]).T)
        within = int((offset < c.tall_reach_heights * self._height).sum())
        order: list[int] = np.argsort(offset, kind="stable")[:within].tolist()
        near = [i for i in order if self._sees(i, middle)]
        if not near:
            return []
        chosen = near[:1]
        own = self._position[chosen[0], :2]
        base = np.hypot(*(self._position[near, :2] - own).T)
        fit = [i for i, b in zip(near, base) if b >= c.tall_least_base * self._height]
        for angle in np.arange(4) * np.pi / 2:
            wished = own + c.tall_best_base * self._height * np.array([np.cos(angle), np.sin(angle)])
            left = [i for i in fit if i not in chosen]
            if left:
                chosen.append(left[int(np.argmin(np.hypot(*(self._position[left, :2] - wished).T)))])
        return chosen

    def _lens(self, camera: int) -> tuple[SweepViews, int, Array]:
        views, i = self._views[self._owner[camera]], int(self._index[camera])
        return views, i, views.cameras.lens[views.cameras.lens_id[i]]

    def _sees(self, camera: int, place: Array) -> bool:
        views, i, lens = self._lens(camera)
        u, v = project_point(views.cameras.position[i], views.cameras.rotation[i], lens, *place)
        rim = active().surface.tall_rim_share_px
        return bool(rim < u / lens[WIDTH] < 1.0 - rim and rim < v / lens[HEIGHT] < 1.0 - rim)

    def _sample(
        self, camera: int, corner: tuple[float, float], z: Float32, around: Mask, *, heights: Array, out: Float32
    ) -> None:
        """Lay a picture on the surfaces at some heights above nodes whose first lies at `corner`."""
        views, i, lens = self._lens(camera)
        factor = max(1, int(self._ground.step_m / (self._height / lens[F])))
        picture = views.gray(i)
        if factor > 1:
            rows, columns = picture.shape[0] // factor, picture.shape[1] // factor
            cut = picture[: rows * factor, : columns * factor]
            picture = np.asarray(cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8)
        kernels.sample(
            picture, float(factor), views.cameras.position[i], views.cameras.rotation[i], lens, *corner,
            self._ground.step_m, z, around, heights, out,
        )  # fmt: skip
