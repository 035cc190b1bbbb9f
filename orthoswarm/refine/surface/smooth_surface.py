"""A smooth surface on regular nodes, fitted to points from below by least squares.

Unknowns are the heights of the nodes. Points observe them by bilinear interpolation, with a robust kernel that is wider
below the surface than above; second differences (xx, yy, sqrt 2 xy) and first differences have a prior at zero. The
normal equations are banded along the shorter side of the grid.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.compute.robust_kernel import robust_costs, robust_weight
from orthoswarm.model.arrays import Array, Flags, Ints
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.refine.bundle.banded_solver import factorise, solve_factored

KAPPA_SPACING_M = 30.0
"""Kappa, the smoothness, is defined as the sigma of second differences between nodes this far apart, metres; for other
distances it is scaled, so that it means the same ground."""

_NODE_SPACING_M: Final = 30.0  # distance of the terrain's nodes
_POINT_SIGMA_FLOOR_M: Final = 0.25  # added in squares to every point's own sigma
_ROBUST_START_M: Final = 10.0  # robust scale above the surface in the first solve: higher than most houses
_ROBUST_END_M: Final = 0.3
"""Robust scale above the surface in the last solve. It seeks the mode of the heights: 0.6 above and 1.5 below let cars
and bushes lift the surface by 0.1 to 0.2 m (measured on synthetic towns)."""
_ROBUST_BELOW_FACTOR: Final = 3.0  # the robust scale below the surface is this multiple of that above
_ROBUST_BELOW_LEAST_M: Final = 0.8  # the robust scale below the surface is never less than this (see `_ROBUST_END_M`)
_ROBUST_SOLVES: Final = 12  # solves over which the robust scale shrinks geometrically from start to end
_SLOPE_SIGMA_M: Final = 6.0  # sigma of first differences between nodes: ground is rather level
_SLOPE_FULL_KAPPA_M: Final = 0.8  # smoother surfaces get a sigma of first differences smaller in proportion
_OPEN_SLOPE_RATIO: Final = 1.5
"""Sigma of first differences next to nodes without data, as a multiple of kappa: beyond the data the surface goes on
level instead of diving (linear extrapolation dived by 4 to 10 m at borders)."""
_KAPPAS_M: Final = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Smoothness tried by the hold-out, from smooth to rough: sigma of the second difference between nodes 30 m apart
(scaled for other distances, so that it means the same ground)."""
_HOLD_OUT_EVERY: Final = 4  # every so many-th point is left out to find the smoothness
_HOLD_OUT_POINTS: Final = 10  # with fewer points left out the smoothest surface is taken
_HOLD_OUT_SOLVES: Final = 8  # solves for each smoothness tried (its cost; not measured)
_HOLD_OUT_STANDARD_ERRORS: Final = 0.5  # the smoothest surface within so many of the best's errors at points left out
_TILE_NODES: Final = 40  # larger areas are solved in tiles of so many nodes a side
_TILE_OVERLAP_NODES: Final = 8  # nodes by which tiles overlap on each side
_TILE_KAPPA_VOTES: Final = 4
"""So many of the fullest tiles ask for a smoothness, and the median is taken for all (its cost)."""
_DRAWN_HOLD_OUT_STANDARD_ERRORS: Final = 1.0  # as `_HOLD_OUT_STANDARD_ERRORS`, of the surface for drawing
_DRAWN_FLAT_RELIEF_M: Final = 0.15  # as `FLAT_RELIEF_M`, for drawing
_DRAWN_ON_MAP_SIGMA_FLOOR_M: Final = 0.15
"""As `_POINT_SIGMA_FLOOR_M`, where heights by the map are among the points (chosen with them: the 95 % of the map's
error fell by a quarter on flat ground, by half on relief)."""
_DRAWN_ON_MAP_FLAT_RELIEF_M: Final = 0.0  # as `_DRAWN_FLAT_RELIEF_M`, with heights by the map


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """What differs between fits of a surface: by default as for the height prior.

    Attributes:
        step_m: spacing of the nodes. floor_sigma_m: added in squares to every point's own sigma.
        render_flat_sd_m: for drawing relief of this standard deviation or less is noise.
        held_out_se: the smoothest surface is chosen whose error at held-out points is within so many standard errors
            of the best.
    """

    step_m: float = _NODE_SPACING_M
    floor_sigma_m: float = _POINT_SIGMA_FLOOR_M
    render_flat_sd_m: float = _DRAWN_FLAT_RELIEF_M
    held_out_se: float = _HOLD_OUT_STANDARD_ERRORS

    @classmethod
    def for_drawing(cls, *, on_map: bool) -> "FitSettings":
        """Settings for the surface that pictures are drawn on; on_map: its points include heights from the map."""
        drawn = cls(held_out_se=_DRAWN_HOLD_OUT_STANDARD_ERRORS)
        if not on_map:
            return drawn
        return replace(drawn, floor_sigma_m=_DRAWN_ON_MAP_SIGMA_FLOOR_M, render_flat_sd_m=_DRAWN_ON_MAP_FLAT_RELIEF_M)


@dataclass(frozen=True, slots=True)
class _Grid:
    """A grid of nodes: the first one, their spacing and number."""

    west: float
    south: float
    step: float
    columns: int
    rows: int

    @classmethod
    def over(cls, bounds: BoundingBox, step: float) -> "_Grid":
        """The nodes on multiples of the step that cover bounds (west, south, east, north)."""
        west, south = (float(np.floor(v / step) * step) for v in bounds[:2])
        columns, rows = (int(np.ceil((v - first) / step)) + 1 for v, first in zip(bounds[2:], (west, south)))
        return cls(west, south, step, max(3, columns), max(3, rows))

    def window(self, column: int, row: int, count: int) -> "_Grid":
        """At most count cells in each direction from a node on, within this grid."""
        c, r = max(column, 0), max(row, 0)
        columns, rows = min(column + count, self.columns - 1) - c + 1, min(row + count, self.rows - 1) - r + 1
        return _Grid(self.west + c * self.step, self.south + r * self.step, self.step, max(columns, 3), max(rows, 3))

    def holds(self, points: Array) -> Flags:
        """Which points (P, 3) lie inside and have a height."""
        c, r = (points[:, 0] - self.west) / self.step, (points[:, 1] - self.south) / self.step
        inside = (c >= 0) & (r >= 0) & (c < self.columns - 1) & (r < self.rows - 1) & np.isfinite(points[:, 2])
        return np.asarray(inside, np.bool_)


@dataclass(slots=True, kw_only=True)
class Surface:
    """Points on a grid of nodes, prepared for solving with any smoothness; "inner" is the shorter side of the grid.

    Attributes:
        columns, rows: number of nodes. cell: int32 (P,), first node of the cell of each point, in the solver's order.
        share: float64 (P, 2), position within the cell (0 to 1), inner and outer. z, sigma: float64 (P,), heights.
        base: float64 (P,), weight of a point on the surface; 0 for points that do not count.
        support: bool (N,), nodes that have data in a cell next to them.
        curvature, slope, level: float64 (N, 2 inner + 1), penalties for unit sigma; [i, k] = A[i, i + k].
    """

    columns: int
    rows: int
    cell: Ints
    share: Array
    z: Array
    sigma: Array
    base: Array
    support: Flags
    curvature: Array
    slope: Array
    level: Array
    settings: FitSettings

    @classmethod
    def over(cls, points: Array, sigma_z: Array, grid: _Grid, s: FitSettings) -> "Surface":
        """Set up the nodes of a grid; points (P, 3) outside or without a sigma are ignored."""
        columns, rows = grid.columns, grid.rows
        c, r = (points[:, 0] - grid.west) / s.step_m, (points[:, 1] - grid.south) / s.step_m
        good = grid.holds(points) & (sigma_z > 0)
        inner, outer = sorted((columns, rows))
        if columns > rows:
            c, r = r, c
        c, r = np.where(good, c, 0.0), np.where(good, r, 0.0)
        ci, ri = np.floor(c), np.floor(r)
        cell = np.asarray(ri * inner + ci, np.int32)
        support: Flags = np.zeros(inner * outer, np.bool_)
        for k in (0, 1, inner, inner + 1):
            support[cell[good] + k] = True
        size = (inner * outer, 2 * inner + 1)
        curvature, slope, level = np.zeros(size), np.zeros(size), np.zeros(size)
        _penalties(inner, outer, support, curvature, slope, level)
        return cls(
            columns=columns, rows=rows, cell=cell, share=np.stack([c - ci, r - ri], 1),
            z=np.where(good, points[:, 2], 0.0), sigma=np.where(good, sigma_z, 1.0),
            base=np.where(good, 1.0 / (sigma_z**2 + s.floor_sigma_m**2), 0.0),
            support=support, curvature=curvature, slope=slope, level=level, settings=s,
        )  # fmt: skip

    @property
    def inner(self) -> int:
        """Number of nodes along the shorter side."""
        return min(self.columns, self.rows)

    def grid(self, nodes: NDArray[Any]) -> NDArray[Any]:
        """Node values (rows, columns), rows going north."""
        g = nodes.reshape(-1, self.inner)
        return np.ascontiguousarray(g.T) if self.columns > self.rows else g

    def solve(self, kappa: float, base: Array | None = None, solves: int = _ROBUST_SOLVES) -> Array:
        """Heights of the nodes (N,), in the solver's order, for one smoothness."""
        s, inner = self.settings, self.inner
        base = self.base if base is None else base
        ratio = s.step_m / KAPPA_SPACING_M
        slope_sigma = _SLOPE_SIGMA_M * min(1.0, kappa / _SLOPE_FULL_KAPPA_M) * ratio
        kappa *= ratio**2
        penalty = (
            self.curvature / kappa**2 + self.slope / slope_sigma**2 + self.level / (_OPEN_SLOPE_RATIO * kappa) ** 2
        )
        band, rhs = np.empty_like(penalty), np.empty(len(self.support))
        start = float(np.median(self.z[base > 0]))
        z, weight = np.full(len(rhs), start), np.empty(len(base))
        for scale in np.geomspace(_ROBUST_START_M, _ROBUST_END_M, solves):
            below = max(_ROBUST_BELOW_FACTOR * scale, _ROBUST_BELOW_LEAST_M)
            _robust(z, self.cell, self.share, inner, self.z, self.sigma, scale, below, weight)
            _assemble(penalty, self.cell, self.share, inner, self.z - start, base * weight, band, rhs)
            z = solve_factored(factorise(band.T), rhs) + start
        return z

    def choose_kappa(self) -> float:
        """The smoothest surface about as good as the best at held-out points; the best would follow rubble."""
        s = self.settings
        out = np.flatnonzero(self.base > 0)[_HOLD_OUT_EVERY - 1 :: _HOLD_OUT_EVERY]
        if len(out) < _HOLD_OUT_POINTS:
            return _KAPPAS_M[0]
        base = self.base.copy()
        base[out] = 0.0
        costs: list[Array] = []
        mean: list[float] = []
        for kappa in _KAPPAS_M:
            z = self.solve(kappa, base, _HOLD_OUT_SOLVES)
            e = self.z[out] - _interpolate(z, self.cell[out], self.share[out], self.inner)
            scale2 = np.where(e > 0, _ROBUST_END_M, _ROBUST_BELOW_LEAST_M) ** 2 + self.sigma[out] ** 2
            costs.append(robust_costs(e**2 / scale2, 1.0))
            mean.append(float(costs[-1].mean()))
            if min(mean[-2:]) > min(mean):  # two rougher surfaces were no better
                break
        best = int(np.argmin(mean))
        limit = mean[best] + s.held_out_se * float(costs[best].std()) / np.sqrt(len(out))
        return _KAPPAS_M[next(i for i, m in enumerate(mean) if m <= limit)]


@dataclass(frozen=True, slots=True)
class Nodes:
    """A solved surface: first node, heights (rows, columns; rows go north), which nodes have data next to them."""

    west: float
    south: float
    z: Array
    support: Flags
    kappa: float


def fit_nodes(
    points: Array,
    sigma_z: Array,
    bounds: BoundingBox,
    kappa: float | None,
    s: FitSettings,
    *,
    tile_nodes: int = _TILE_NODES,
) -> Nodes | None:
    """Solve for nodes that cover bounds; None without a point. Large areas in overlapping tiles, blended.

    All tiles use the median smoothness of those with most points. tile_nodes: side of a tile.
    """
    core, overlap = tile_nodes, _TILE_OVERLAP_NODES
    grid = _Grid.over(bounds, s.step_m)
    if max(grid.columns, grid.rows) <= core + 3 * overlap:
        surface = Surface.over(points, sigma_z, grid, s)
        if not (surface.base > 0).any():
            return None
        kappa = kappa or surface.choose_kappa()
        return Nodes(grid.west, grid.south, surface.grid(surface.solve(kappa)), surface.grid(surface.support), kappa)
    tiles = []
    for row in range(0, grid.rows - 1, core):
        for column in range(0, grid.columns - 1, core):
            part = grid.window(column - overlap, row - overlap, core + 2 * overlap)
            inside = part.holds(points)
            if inside.any():
                tiles.append((part, inside))
    if not tiles:
        return None
    if kappa is None:
        fullest = sorted(tiles, key=lambda tile: -int(tile[1].sum()))[:_TILE_KAPPA_VOTES]
        asked = [Surface.over(points[i], sigma_z[i], part, s).choose_kappa() for part, i in fullest]
        kappa = sorted(asked)[len(asked) // 2]
    total, weight = np.zeros((grid.rows, grid.columns)), np.zeros((grid.rows, grid.columns))
    support: Flags = np.zeros((grid.rows, grid.columns), np.bool_)
    for part, inside in tiles:
        surface = Surface.over(points[inside], sigma_z[inside], part, s)
        r, c = round((part.south - grid.south) / s.step_m), round((part.west - grid.west) / s.step_m)
        at = (slice(r, r + part.rows), slice(c, c + part.columns))
        ramp = np.multiply.outer(_ramp(part.rows, 2 * overlap), _ramp(part.columns, 2 * overlap))
        total[at] += ramp * surface.grid(surface.solve(kappa))
        weight[at] += ramp
        support[at] |= surface.grid(surface.support)
    return Nodes(grid.west, grid.south, _blended(total, weight), support, kappa)


def _ramp(count: int, reach: int) -> Array:
    """Weights of a tile's nodes along one side: small at its ends, 1 from `reach` nodes on."""
    k = np.arange(count)
    return np.asarray(np.minimum(np.minimum(k, k[::-1]) + 0.1, reach) / reach, np.float64)


def _blended(total: Array, weight: Array) -> Array:
    from scipy.ndimage import distance_transform_edt

    z = total / np.where(weight > 0, weight, 1.0)
    if (weight > 0).all():
        return z
    nearest = distance_transform_edt(weight == 0, return_distances=False, return_indices=True)
    return np.asarray(z[tuple(nearest)])


def _interpolate(z: Array, cell: Ints, share: Array, inner: int) -> Array:
    c, r = share[:, 0], share[:, 1]
    low = z[cell] * (1 - c) + z[cell + 1] * c
    return np.asarray(low * (1 - r) + (z[cell + inner] * (1 - c) + z[cell + inner + 1] * c) * r)


@in_place_kernel
def _robust(z, cell, share, inner, height, sigma, above, below, weight):  # type: ignore[no-untyped-def]
    """Robust weights of the points, each scale widened by the point's own sigma."""
    for m in range(len(cell)):
        i, c, r = cell[m], share[m, 0], share[m, 1]
        low = z[i] * (1.0 - c) + z[i + 1] * c
        high = z[i + inner] * (1.0 - c) + z[i + inner + 1] * c
        e = height[m] - low * (1.0 - r) - high * r
        scale = above if e > 0.0 else below
        weight[m] = robust_weight(e * e, scale * scale + sigma[m] * sigma[m], 1.0)


@kernel
def _assemble(penalty, cell, share, inner, height, weight, band, rhs):  # type: ignore[no-untyped-def]
    """Normal equations: penalty plus weighted bilinear observations; band[i, k] = A[i, i + k]."""
    band[:] = penalty
    rhs[:] = 0.0
    b = np.empty(4)
    node = np.empty(4, np.int64)
    for m in range(len(cell)):
        c, r, w = share[m, 0], share[m, 1], weight[m]
        if w == 0.0:
            continue
        b[0], b[1], b[2], b[3] = (1.0 - c) * (1.0 - r), c * (1.0 - r), (1.0 - c) * r, c * r
        node[0], node[1], node[2], node[3] = cell[m], cell[m] + 1, cell[m] + inner, cell[m] + inner + 1
        for i in range(4):
            rhs[node[i]] += w * b[i] * height[m]
            for j in range(i, 4):
                band[node[i], node[j] - node[i]] += w * b[i] * b[j]


@in_place_kernel
def _add_row(band, nodes, values):  # type: ignore[no-untyped-def]
    for i in range(len(nodes)):
        for j in range(len(nodes)):
            if nodes[j] >= nodes[i] and values[i] != 0.0 and values[j] != 0.0:
                band[nodes[i], nodes[j] - nodes[i]] += values[i] * values[j]


@kernel
def _penalties(inner, outer, support, curvature, slope, level):  # type: ignore[no-untyped-def]
    """Squares of second and first differences; first differences at nodes without data go to `level`."""
    three, four = np.array([1.0, -2.0, 1.0]), np.array([1.0, -1.0, -1.0, 1.0]) * np.sqrt(2.0)
    two = np.array([-1.0, 1.0])
    for r in range(outer):
        for c in range(inner):
            i = r * inner + c
            if c + 2 < inner:
                _add_row(curvature, np.array([i, i + 1, i + 2]), three)
            if r + 2 < outer:
                _add_row(curvature, np.array([i, i + inner, i + 2 * inner]), three)
            if c + 1 < inner and r + 1 < outer:
                _add_row(curvature, np.array([i, i + 1, i + inner, i + inner + 1]), four)
            for step in (1, inner):
                if (step == 1 and c + 1 < inner) or (step == inner and r + 1 < outer):
                    pair = np.array([i, i + step])
                    _add_row(slope, pair, two)
                    if not (support[i] and support[i + step]):
                        _add_row(level, pair, two)
