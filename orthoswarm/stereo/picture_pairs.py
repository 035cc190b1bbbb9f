"""Selection of picture pairs for matching: a sufficient base for heights, and similar lines of sight."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from orthoswarm.config import active
from orthoswarm.model.camera import Camera
from orthoswarm.model.placement import PlacedFrame, Terrain

Array = NDArray[np.float64]


def choose_pairs(frames: Sequence[PlacedFrame], terrain: Terrain) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of indices of frames, each once, in order.

    Each frame takes the few partners whose base over the height is nearest (in its logarithm) to the best one; lenses
    and vehicles may differ. Weak and damaged pictures take no part.
    """
    c = active().stereo
    position = np.array([p.camera.position for p in frames]).reshape(-1, 3)
    sight = np.array([p.camera.rotation[:, 2] for p in frames]).reshape(-1, 3)
    height = position[:, 2] - terrain.height(position[:, :2])
    usable = np.array([not (p.weak or p.frame.damaged) for p in frames], bool) & (height > 0.0)
    index = np.flatnonzero(usable)
    if len(index) < 2:
        return []
    tree = cKDTree(position[index])
    pairs: set[tuple[int, int]] = set()
    for i in index.tolist():
        near = index[tree.query_ball_point(position[i], c.most_base * height[i])]
        base = np.linalg.norm(position[near] - position[i], axis=1) / height[i]
        same_direction = sight[near] @ sight[i] >= np.cos(np.radians(c.most_turn_deg))
        fit = same_direction & (base >= c.least_base) & (near != i)
        near, base = near[fit], base[fit]
        order = np.lexsort((near, np.round(np.abs(np.log(base / c.best_base)), 6)))
        used = 0
        for j in near[order].tolist():
            if used == c.partners:
                break
            if _overlap(frames[i].camera, frames[j].camera, terrain) >= c.least_overlap:
                pairs.add((min(i, j), max(i, j)))
                used += 1
    return sorted(pairs)


def _overlap(first: Camera, second: Camera, terrain: Terrain) -> float:
    """Share of a grid of the first picture's pixels whose ground the second one sees."""
    lens, other = first.lens, second.lens
    columns, rows = np.meshgrid(np.linspace(0, lens.width - 1, 6), np.linspace(0, lens.height - 1, 6))
    level = float(terrain.height(first.nadir))
    ground = first.to_ground(np.stack([columns.ravel(), rows.ravel()], -1), level)
    pixel = second.project(np.column_stack([ground, np.full(len(ground), level)]))
    with np.errstate(invalid="ignore"):
        inside = (pixel >= 0).all(1) & (pixel[:, 0] <= other.width - 1) & (pixel[:, 1] <= other.height - 1)
    return float(inside.mean())
