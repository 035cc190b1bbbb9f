"""Tops of wide tall objects (halls, grandstands, woods), on which pictures are drawn.

The ground is fitted from below, which suits houses and single trees: drawn on the ground they lean, and the
streets next to them are in place. Under a wide object no ground is visible, and its top, 10 m above the ground
and seen 40 degrees off nadir, would be drawn 8 m from its place.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from orthoswarm.config import active
from orthoswarm.model.placement import Terrain

Array = NDArray[np.float64]

_AT_ONCE = 20_000
"""Points whose neighbours are held in memory at a time."""


def with_tall_surfaces(ground: Terrain, points: Array, cell_m: float, most_nodes: int) -> Terrain:
    """The ground plus the tops of tall surfaces.

    Args:
        ground: bare ground.
        points: float64 (K, 3) at free positions about cell_m apart, on the visible surface.
        cell_m: their distance. most_nodes: the ground gets no more nodes than this.
    """
    c = active().surface
    over = points[:, 2] - ground.height(points[:, :2])
    top, counts = _tall_points(points[:, :2], over, max(c.tall_reach_m, c.tall_reach_cells * cell_m))
    if not (counts & (top != 0.0)).any():
        return ground
    parts = max(1, round(ground.step_m / c.tall_node_spacing_m))
    while parts > 1 and ground.z.size * parts**2 > most_nodes:
        parts -= 1
    fine = _finer(ground, parts)
    tops = _spread(points[counts, :2], top[counts], fine, c.tall_hole_cells * cell_m)
    return replace(fine, z=fine.z + tops, bare=fine.z)


def _tall_points(xy: Array, over: Array, reach_m: float) -> tuple[Array, NDArray[np.bool_]]:
    """Smoothed height above ground of each point (0 on it), and which points are used; isolated raised ones are not."""
    c = active().surface
    tree = cKDTree(xy)
    raised = np.abs(over) > c.tall_from_m
    core, top = np.zeros(len(xy), bool), np.zeros(len(xy))
    for some in _parts(np.flatnonzero(raised)):
        own, other = _pairs(tree, xy[some], reach_m)
        as_high = np.abs(over[other] - over[some][own]) < c.tall_agreement_m
        count = np.bincount(own, minlength=len(some))
        share = np.where(np.abs(over[some]) > c.very_tall_from_m, c.very_tall_share, c.tall_share)
        core[some] = (count >= c.tall_points) & (np.bincount(own, as_high, len(some)) >= share * count)
        weight = as_high / (1.0 + ((xy[other] - xy[some][own]) ** 2).sum(1) / (0.5 * reach_m) ** 2)
        top[some] = np.bincount(own, weight * over[other], len(some)) / np.bincount(own, weight, len(some))
    counts = core | ~raised
    for some in _parts(np.flatnonzero(raised & ~core)):  # corners and rims of tall surfaces
        own, other = _pairs(tree, xy[some], reach_m)
        as_high = core[other] & (np.abs(top[other] - over[some][own]) < c.tall_agreement_m)
        counts[some] = np.bincount(own, as_high, len(some)) >= c.tall_rim_share * np.bincount(own, minlength=len(some))
    return top, counts


def _parts(index: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    for start in range(0, len(index), _AT_ONCE):
        yield index[start : start + _AT_ONCE]


def _pairs(tree: cKDTree, xy: Array, reach_m: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Index pairs of positions and of the tree's points within reach of them."""
    near: Any = tree.query_ball_point(xy, reach_m)
    own = np.repeat(np.arange(len(xy)), [len(n) for n in near])
    return own, np.concatenate(near).astype(np.intp)


def _finer(ground: Terrain, parts: int) -> Terrain:
    """The same ground with each step subdivided."""
    rows, columns = ((n - 1) * parts + 1 for n in ground.z.shape)
    step = ground.step_m / parts
    east, north = ground.west + step * np.arange(columns), ground.south + step * np.arange(rows)
    z = np.empty((rows, columns), np.float32)
    for row in range(rows):
        z[row] = ground.height(np.column_stack([east, np.full(columns, north[row])]))
    return Terrain(ground.west, ground.south, step, z)


def _spread(xy: Array, top: Array, nodes: Terrain, reach_m: float) -> NDArray[np.float32]:
    """Height to add at each node: the median top of the nearest points, 0 far from all of them."""
    c = active().surface
    tree, (rows, columns) = cKDTree(xy), nodes.z.shape
    add = np.zeros((rows, columns))
    east = nodes.west + nodes.step_m * np.arange(columns)
    for row in range(rows):
        at = np.column_stack([east, np.full(columns, nodes.south + nodes.step_m * row)])
        away, which = tree.query(at, k=min(c.tall_node_points, len(xy)))
        away, which = np.reshape(away, (columns, -1)), np.reshape(which, (columns, -1))
        add[row] = np.where(away[:, min(1, away.shape[1] - 1)] < reach_m, np.median(top[which], axis=1), 0.0)
    return np.asarray(gaussian_filter(add, c.tall_wall_sigma_nodes), np.float32)
