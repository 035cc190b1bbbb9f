"""One ground from those of several areas: at each place that of the area whose cameras are nearest."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.placement import Terrain

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
_BLOCK = 32
"""Nodes along each side that are taken from one area."""


def merged_ground(grounds: Sequence[Terrain | None], nadirs: Sequence[Array]) -> Terrain | None:
    """Join the grounds of areas, on nodes as near to each other as those of the finest.

    Args:
        grounds: of the areas, each some way beyond its own cameras; None for flat at zero.
        nadirs: of their own cameras, float64 (N, 2) each.

    Returns:
        None where all are None.
    """
    found = [ground for ground in grounds if ground is not None]
    if not found:
        return None
    step = min(ground.step_m for ground in found)
    low = np.min([(g.west, g.south) for g in found], axis=0)
    high = np.max([(g.west + g.step_m * (g.z.shape[1] - 1), g.south + g.step_m * (g.z.shape[0] - 1)) for g in found], 0)
    columns, rows = (np.ceil((high - low) / step - 1e-6).astype(int) + 1).tolist()
    area = _nearest_areas(low, step, (rows, columns), nadirs)

    def joined(height: Callable[[Terrain], Float32]) -> Float32:
        z = np.zeros((rows, columns), np.float32)
        for i, j in np.ndindex(area.shape):
            ground = grounds[int(area[i, j])]
            if ground is not None:
                part = z[i * _BLOCK : (i + 1) * _BLOCK, j * _BLOCK : (j + 1) * _BLOCK]
                east = low[0] + step * (j * _BLOCK + np.arange(part.shape[1]))
                north = low[1] + step * (i * _BLOCK + np.arange(part.shape[0]))
                at = Terrain(ground.west, ground.south, ground.step_m, height(ground))
                part[:] = at.height(np.stack(np.meshgrid(east, north), -1))
        return z

    tall = any(ground.bare is not None for ground in found)
    return Terrain(
        float(low[0]), float(low[1]), step, joined(lambda g: g.z),
        joined(lambda g: g.z if g.bare is None else g.bare) if tall else None,
    )  # fmt: skip


def _nearest_areas(low: Array, step: float, shape: tuple[int, int], nadirs: Sequence[Array]) -> NDArray[np.intp]:
    """For each block of nodes the area with the nearest camera."""
    from scipy.spatial import cKDTree  # a tenth of a second that runs of one area do without here

    rows, columns = (-(-n // _BLOCK) for n in shape)
    side = _BLOCK * step
    middle = np.stack(
        np.meshgrid(low[0] + side * (np.arange(columns) + 0.5), low[1] + side * (np.arange(rows) + 0.5)), -1
    )
    area = np.repeat(np.arange(len(nadirs)), [len(own) for own in nadirs])
    return np.asarray(area[cKDTree(np.concatenate(nadirs)).query(middle)[1]])
