"""Shortest ways around no-fly zones: a visibility graph over the zones' convex corners.

Obstacles are the zones grown by a clearance, with enclosed pockets filled, because no vehicle can get into those.
Sight lines are tested against the obstacles shrunk by a hair, so that paths may touch corners and run along edges.
"""

from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import ArrayLike

from orthoswarm.compute.jit import kernel
from orthoswarm.model.arrays import Array, Flags, Ints
from orthoswarm.model.errors import InputError

Geometry = Any

_DETOUR_INSIDE_M: Final = 0.02  # how far a detour may pass inside an obstacle: its corners touch it (rounding)
_OBSTACLE_TOLERANCE: Final = 0.1  # obstacles are simplified outwards by this share of the clearance ...
_OBSTACLE_TOLERANCE_M: Final = 50.0  # ... doubled until they have few corners, up to this
_DETOUR_MOST_CORNERS: Final = 300  # obstacles are simplified to so many corners: cost grows with their square (time)


def make_obstacles(no_fly: Geometry, clearance_m: float) -> Geometry:
    """The no-fly zones grown by a clearance and simplified outwards to few corners, pockets filled.

    Args:
        no_fly: shapely geometry in metres, may be empty.
        clearance_m: distance that paths keep from the zones, metres, larger than 0.
    """
    if no_fly.is_empty:
        return shapely.MultiPolygon()
    tolerance = _OBSTACLE_TOLERANCE * clearance_m
    while True:
        grown = no_fly.buffer(clearance_m + tolerance, join_style="mitre", mitre_limit=2.0).simplify(tolerance)
        parts = [shapely.Polygon(p.exterior) for p in shapely.get_parts(grown)]
        obstacles = shapely.union_all(parts)
        corners = shapely.get_num_coordinates(obstacles)
        if corners <= _DETOUR_MOST_CORNERS or tolerance > _OBSTACLE_TOLERANCE_M:
            return obstacles
        tolerance *= 2.0


@kernel
def _blocked(p, q, edges):  # type: ignore[no-untyped-def]
    """Which segments p[i] -> q[i] cross an edge (x0, y0, x1, y1)."""
    result = np.zeros(len(p), np.bool_)
    for i in range(len(p)):
        ax, ay, bx, by = p[i, 0], p[i, 1], q[i, 0], q[i, 1]
        for k in range(len(edges)):
            cx, cy, dx, dy = edges[k, 0], edges[k, 1], edges[k, 2], edges[k, 3]
            if max(ax, bx) < min(cx, dx) or max(cx, dx) < min(ax, bx):
                continue
            if max(ay, by) < min(cy, dy) or max(cy, dy) < min(ay, by):
                continue
            s = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            t = (bx - ax) * (dy - ay) - (by - ay) * (dx - ax)
            u = (dx - cx) * (ay - cy) - (dy - cy) * (ax - cx)
            v = (dx - cx) * (by - cy) - (dy - cy) * (bx - cx)
            if ((s > 0) != (t > 0)) and ((u > 0) != (v > 0)):
                result[i] = True
                break
    return result


@kernel
def _min_plus(a, b):  # type: ignore[no-untyped-def]
    """Entry (i, j) is the smallest a[i, k] + b[j, k]."""
    result = np.empty((len(a), len(b)))
    for i in range(len(a)):
        for j in range(len(b)):
            best = np.inf
            for k in range(a.shape[1]):
                best = min(best, a[i, k] + b[j, k])
            result[i, j] = best
    return result


class Router:
    """Finds shortest paths that stay out of obstacles.

    Attributes:
        obstacles: shapely geometry in grid metres, as `make_obstacles` gives it; may be empty.
    """

    def __init__(self, obstacles: Geometry) -> None:
        self.obstacles = obstacles
        shrunk = obstacles.buffer(-_DETOUR_INSIDE_M, join_style="mitre")
        rings = [shapely.get_coordinates(r) for p in shapely.get_parts(shrunk) for r in shapely.get_rings(p)]
        self._edges = np.concatenate([np.hstack([r[:-1], r[1:]]) for r in rings]) if rings else np.empty((0, 4))
        shapely.prepare(shrunk)
        self._shrunk = shrunk
        found = [np.empty((0, 2))]
        for polygon in shapely.get_parts(obstacles):
            ring = shapely.get_coordinates(shapely.geometry.polygon.orient(polygon).exterior)[:-1]
            before, after = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
            found.append(ring[before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] > 0])
        self._corners = np.concatenate(found)
        self._hops: Array = np.empty((0, 0))
        self._before: Ints = np.empty((0, 0), np.int32)
        if len(self._corners):
            from scipy.sparse.csgraph import shortest_path  # not at the start of a station, which it holds up

            sight = self._sight(self._corners, self._corners)
            self._hops, self._before = shortest_path(
                np.where(np.isfinite(sight), sight, 0.0), directed=False, return_predecessors=True
            )

    def blocked(self, start: ArrayLike, end: ArrayLike) -> Flags:
        """Which straight segments start[i] -> end[i], both (n, 2), cross an obstacle: bool (n,)."""
        p, q = np.ascontiguousarray(start, np.float64), np.ascontiguousarray(end, np.float64)
        if not len(self._edges):
            return np.zeros(len(p), bool)
        return np.asarray(_blocked(p, q, self._edges))

    def inside(self, points: ArrayLike) -> Flags:
        """Which points (n, 2) lie in an obstacle: bool (n,)."""
        p = np.asarray(points, np.float64).reshape(-1, 2)
        return np.asarray(shapely.contains_xy(self._shrunk, p[:, 0], p[:, 1]))

    def _sight(self, p: Array, q: Array) -> Array:
        """Distances (n, m) of points that see each other, else infinite."""
        n, m = len(p), len(q)
        result = np.hypot(p[:, None, 0] - q[None, :, 0], p[:, None, 1] - q[None, :, 1])
        hidden = self.blocked(np.repeat(p, m, axis=0), np.tile(q, (n, 1))).reshape(n, m)
        result[hidden] = np.inf
        return result

    def distances(self, start: ArrayLike, end: ArrayLike) -> Array:
        """Lengths of the shortest free paths, float64 (n, m), between points (n, 2) and (m, 2), metres."""
        p = np.asarray(start, np.float64).reshape(-1, 2)
        q = np.asarray(end, np.float64).reshape(-1, 2)
        result = self._sight(p, q)
        rows, columns = np.flatnonzero(np.isinf(result).any(1)), np.flatnonzero(np.isinf(result).any(0))
        if len(rows):
            to_corner = _min_plus(self._sight(p[rows], self._corners), np.ascontiguousarray(self._hops.T))
            around = _min_plus(to_corner, self._sight(q[columns], self._corners))
            block = np.ix_(rows, columns)
            result[block] = np.minimum(result[block], around)
        return result

    def each(self, start: ArrayLike, end: ArrayLike) -> Array:
        """Lengths of the shortest free paths, float64 (n,), from start[i] to end[i], both (n, 2), metres."""
        p, q = np.asarray(start, np.float64).reshape(-1, 2), np.asarray(end, np.float64).reshape(-1, 2)
        result: Array = np.hypot(*(q - p).T)
        hidden = np.flatnonzero(self.blocked(p, q))
        if len(hidden):
            to_corner = _min_plus(self._sight(p[hidden], self._corners), np.ascontiguousarray(self._hops.T))
            result[hidden] = (to_corner + self._sight(q[hidden], self._corners)).min(1)
        return result

    def path(self, start: ArrayLike, end: ArrayLike) -> Array:
        """The shortest free path, float64 (k, 2) with both ends.

        Raises InputError: there is none (one end lies in an obstacle).
        """
        p, q = np.asarray(start, np.float64).reshape(1, 2), np.asarray(end, np.float64).reshape(1, 2)
        if not self.blocked(p, q)[0]:
            return np.concatenate([p, q])
        first, last = self._sight(p, self._corners)[0], self._sight(q, self._corners)[0]
        total = first[:, None] + self._hops + last[None, :]
        i, j = np.unravel_index(np.argmin(total), total.shape)
        if not np.isfinite(total[i, j]):
            raise InputError("a vehicle would have to fly through a no-fly zone; move the start or the zone")
        corners = [int(j)]
        while corners[-1] != i:
            corners.append(int(self._before[i, corners[-1]]))
        return np.concatenate([p, self._corners[corners[::-1]], q])
