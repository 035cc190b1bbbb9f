"""Boustrophedon cellular decomposition (Choset 2000): cells without obstacles inside, each swept up and down.

Sweeping a line over the area, its free part splits or merges only at critical points: corners of the outline that
point into the area along the sweep. A cut through each critical point, up and down to the next wall, leaves cells
that every line crosses in one piece. Cells are then flown in an order, and entered at a corner, with short ways
between them.
"""

from typing import Any, Final

import numpy as np
import shapely

from orthoswarm.compute.jit import kernel
from orthoswarm.model.arrays import Array
from orthoswarm.planning.lines.detours import Router
from orthoswarm.planning.lines.line_spacing import Footprint
from orthoswarm.planning.lines.sweep_lines import Field, Turned, lines_across

Geometry = Any

# Walls exactly across the sweep have no single critical point; a hair of rotation gives them one.
_HAIR_RAD = 1e-7
_SNAP_M, _INTO_M = 1e-4, 0.01

_TOOTH_SPACINGS: Final = 0.1  # outlines are simplified by so many line spacings before they are cut into cells
_EXACT_CELLS: Final = 8  # so many cells are put in the shortest order exactly (0.02 s)
_ROW_STARTS: Final = 60  # more cells are put in order from so many of them at most (for its time) ...
_ROW_MANY: Final = 80  # ... and up to this number of cells the order is improved ...
_ROW_ROUNDS: Final = (20, 2)  # ... in so many rounds at most, with more cells in so many (for its time)


def cells(ground: Geometry) -> list[Geometry]:
    """Cells of a polygon for a sweep along +x (lines along y): shapely polygons that together are the ground.

    ground: shapely (Multi)Polygon, metres.
    """
    tilt = Turned(_HAIR_RAD, (0.0, 0.0))
    found = []
    for polygon in shapely.get_parts(tilt.turn(ground)):
        polygon = shapely.geometry.polygon.orient(polygon)
        cuts = [_cut(polygon, corner) for corner in critical_points(polygon)]
        lines = shapely.union_all([polygon.boundary, *[c for c in cuts if c is not None]], grid_size=_SNAP_M)
        for cell in shapely.get_parts(shapely.polygonize(shapely.get_parts(lines))):
            point = shapely.point_on_surface(cell)
            if shapely.contains_xy(polygon, *(point.x, point.y)):
                found.append(shapely.transform(cell, tilt.to_grid))
    return found


def critical_points(polygon: Geometry) -> Array:
    """Corners (n, 2) of an oriented polygon where a line along y, swept along x, is split or merged.

    These are the reflex corners (interior angle above 180 degrees) with both walls on the same side of the line.
    """
    found = [np.empty((0, 2))]
    for ring in shapely.get_rings(polygon):
        at = shapely.get_coordinates(ring)[:-1]
        before, after = at - np.roll(at, 1, axis=0), np.roll(at, -1, axis=0) - at
        reflex = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] < 0
        found.append(at[reflex & (before[:, 0] * after[:, 0] < 0)])
    return np.concatenate(found)


def _cut(polygon: Geometry, corner: Array) -> Geometry:
    """The line through a critical point, up and down to the next wall."""
    _, low, _, high = polygon.bounds
    line = shapely.LineString([(corner[0], low - 1.0), (corner[0], high + 1.0)])
    here = shapely.Point(corner)
    near = [p for p in shapely.get_parts(line.intersection(polygon)) if p.distance(here) < 1e-6 and p.length > 0]
    if not near:
        return None
    bottom, top = min(p.bounds[1] for p in near), max(p.bounds[3] for p in near)
    # A little into the walls, so that cut and wall are certain to meet.
    return shapely.LineString([(corner[0], bottom - _INTO_M), (corner[0], top + _INTO_M)])


def _variants(lines: list[Array]) -> list[Array]:
    """Four ways to fly a cell: beginning at the first or the last line, upwards or downwards.

    lines: for each its legs from low to high y, float64 (k, 2, 2).
    """
    result = []
    for row in (lines, lines[::-1]):
        for up in (True, False):
            legs = [line if up == (k % 2 == 0) else line[::-1, ::-1] for k, line in enumerate(row)]
            result.append(np.concatenate(legs))
    return result


def bcd_legs(field: Field, angle_rad: float, foot: Footprint, router: Router, multiple: int = 1) -> Array:
    """Legs of all cells in flying order.

    Args:
        field: ground and obstacles, grid metres. angle_rad: direction of the sweep, from grid east, counter-clockwise.
        foot: footprint of the narrowest camera. router: measures the ways between cells.
        multiple: make the number of lines a multiple of this, by laying them closer.

    Returns:
        float64 (n, 2, 2), start and end of each leg, grid metres.
    """
    frame = Turned(angle_rad, (field.ground.centroid.x, field.ground.centroid.y))
    local = field.turned(frame)
    # A ragged coast has a critical point at every tooth, so cells are cut from a smoothed outline.
    parts = cells(local.ground.simplify(_TOOTH_SPACINGS * foot.spacing_m))
    by_cell = _by_cell(lines_across(local, foot, multiple), parts)
    if not by_cell:
        return np.empty((0, 2, 2))
    variants = [_variants([frame.to_grid(np.array(line)) for line in lines]) for lines in by_cell]
    entry = np.array([[v[0, 0] for v in cell] for cell in variants]).reshape(-1, 2)
    exit_ = np.array([[v[-1, 1] for v in cell] for cell in variants]).reshape(-1, 2)
    ways = np.minimum(router.distances(exit_, entry), 1e9)
    order = order_cells(ways)
    return np.concatenate([variants[k // 4][k % 4] for k in order])


def _by_cell(lines: list[list[Array]], parts: list[Geometry]) -> list[list[list[Array]]]:
    """The lines within each cell: a leg belongs to the cell at its middle.

    All lines are laid on one raster, not anew in every cell: so a cell narrower than the space between lines costs
    no line of its own.
    """
    tree = shapely.STRtree(parts)
    found: list[list[list[Array]]] = [[] for _ in parts]
    for line in lines:
        of_cell: dict[int, list[Array]] = {}
        for leg in line:
            of_cell.setdefault(int(tree.nearest(shapely.Point(leg.mean(0)))), []).append(leg)
        for cell, legs in of_cell.items():
            found[cell].append(legs)
    return [lines for lines in found if lines]


def order_cells(ways: Array) -> list[int]:
    """A short row through all cells: 4 * cell + way to fly it, from each cell's exit to the next one's entry.

    Few cells are ordered exactly (Held and Karp 1962). Of many: nearest neighbours from every cell, the best row
    improved by moving cells; which of its four ways each cell is flown follows exactly, by dynamic programming over it.

    ways: float64 (4 n, 4 n), from exit of cell and way to entry of cell and way, metres.
    """
    n = len(ways) // 4
    if n == 1:
        return [0]
    if n <= _EXACT_CELLS:
        return _shortest_order(ways)
    first = np.linspace(0, n - 1, min(n, _ROW_STARTS)).astype(int)
    rounds = _ROW_ROUNDS[0] if n <= _ROW_MANY else _ROW_ROUNDS[1]
    row, code = _best_row(np.ascontiguousarray(ways), first, rounds)
    return [4 * int(cell) + int(way) for cell, way in zip(row, code)]


def _shortest_order(ways: Array) -> list[int]:
    """The shortest way through all cells: dynamic programming over sets of cells, the last one and how it is flown."""
    n = len(ways) // 4
    length = np.full((1 << n, 4 * n), np.inf)
    came_from = np.full((1 << n, 4 * n), -1)
    for cell in range(n):
        length[1 << cell, 4 * cell : 4 * cell + 4] = 0.0
    for flown in range(1, 1 << n):
        through = length[flown][:, None] + ways
        last, best = through.argmin(axis=0), through.min(axis=0)
        for cell in range(n):
            if not flown >> cell & 1:
                to, own = flown | 1 << cell, slice(4 * cell, 4 * cell + 4)
                shorter = best[own] < length[to, own]
                length[to, own] = np.where(shorter, best[own], length[to, own])
                came_from[to, own] = np.where(shorter, last[own], came_from[to, own])
    flown, state = (1 << n) - 1, int(length[-1].argmin())
    order = [state]
    while came_from[flown, state] >= 0:
        flown, state = flown & ~(1 << state // 4), int(came_from[flown, state])
        order.append(state)
    return order[::-1]


@kernel
def _row_cost(ways, row, code):  # type: ignore[no-untyped-def]
    """Cheapest choice of ways for a row of cells, written to `code`; returns its length."""
    n = len(row)
    cost, back = np.zeros(4), np.zeros((n, 4), np.int64)
    for k in range(1, n):
        new = np.empty(4)
        for b in range(4):
            best, arg = np.inf, 0
            for a in range(4):
                c = cost[a] + ways[4 * row[k - 1] + a, 4 * row[k] + b]
                if c < best:
                    best, arg = c, a
            new[b] = best
            back[k, b] = arg
        cost = new
    code[n - 1] = np.argmin(cost)
    for k in range(n - 1, 0, -1):
        code[k - 1] = back[k, code[k]]
    return cost.min()


@kernel
def _nearest_row(ways, first):  # type: ignore[no-untyped-def]
    """From a cell on, always to the unvisited cell with the shortest way."""
    n = len(ways) // 4
    row, seen = np.empty(n, np.int64), np.zeros(n, np.bool_)
    row[0] = first
    seen[first] = True
    for k in range(1, n):
        best, arg = np.inf, -1
        for cell in range(n):
            if not seen[cell]:
                way = ways[4 * row[k - 1] : 4 * row[k - 1] + 4, 4 * cell : 4 * cell + 4].min()
                if way < best:
                    best, arg = way, cell
        row[k] = arg
        seen[arg] = True
    return row


@kernel
def _best_row(ways, starts, rounds):  # type: ignore[no-untyped-def]
    n = len(ways) // 4
    code = np.empty(n, np.int64)
    best, row = np.inf, np.arange(n)
    for first in starts:
        trial = _nearest_row(ways, first)
        cost = _row_cost(ways, trial, code)
        if cost < best:
            best, row = cost, trial
    for _ in range(rounds):
        better = False
        for i in range(n):
            for j in range(n):
                if i == j:
                    continue
                trial = np.empty(n, np.int64)  # cell i moved to place j
                trial[:j] = np.delete(row, i)[:j]
                trial[j] = row[i]
                trial[j + 1 :] = np.delete(row, i)[j:]
                cost = _row_cost(ways, trial, code)
                if cost < best - 1e-6:
                    best, row, better = cost, trial, True
        if not better:
            break
    _row_cost(ways, row, code)
    return row, code
