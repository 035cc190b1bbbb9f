"""Selection of picture pairs for matching: a sufficient base for heights, and similar lines of sight."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from orthoswarm.model.camera import Camera
from orthoswarm.model.placement import PlacedFrame, Terrain

_BEST_BASE: Final = 0.4
"""Distance of two cameras over their height above ground at which a pair is preferred. Single pairs of a simulated city
had ground heights within (68 %) 1.4, 0.64, 0.49 and 0.21 m at 0.13, 0.25, 0.4 and 0.7 at 0.67 m a pixel; the higher,
the more ground is hidden behind roofs."""
_LEAST_BASE: Final = 0.12  # pairs with a smaller ratio give inaccurate heights
_MOST_BASE: Final = 0.9  # with a larger ratio the two views differ too much to be matched
_LEAST_OVERLAP: Final = 0.4  # least share of a picture's footprint that the other one also covers
_MOST_TURN_DEG: Final = 40.0  # angle between the two lines of sight at most


def choose_pairs(frames: Sequence[PlacedFrame], terrain: Terrain, partners: int) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of indices of frames, each once, in order.

    Each frame takes the `partners` whose base over the height is nearest (in its logarithm) to the best one; lenses
    and vehicles may differ. Weak and damaged pictures take no part.
    """
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
        near = index[tree.query_ball_point(position[i], _MOST_BASE * height[i])]
        base = np.linalg.norm(position[near] - position[i], axis=1) / height[i]
        same_direction = sight[near] @ sight[i] >= np.cos(np.radians(_MOST_TURN_DEG))
        fit = same_direction & (base >= _LEAST_BASE) & (near != i)
        near, base = near[fit], base[fit]
        order = np.lexsort((near, np.round(np.abs(np.log(base / _BEST_BASE)), 6)))
        used = 0
        for j in near[order].tolist():
            if used == partners:
                break
            if _overlap(frames[i].camera, frames[j].camera, terrain) >= _LEAST_OVERLAP:
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
