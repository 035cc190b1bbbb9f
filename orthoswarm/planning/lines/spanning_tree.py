"""The turn-minimising spanning tree over bricks and the round trip about it (TMSTC*, RA-L 2023, section IV).

A cell is 2 x 2 sub-cells. Going around a spanning tree of the cells visits every sub-cell once and comes back. How
often that path turns in a cell depends only on the tree's edges there: none 4, a tip 2, straight on 0, a corner 2,
a T 2, a crossing 4. So bricks are joined greedily by the edge that adds the fewest turns.
"""

import heapq

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel

Cells = NDArray[np.bool_]

# Turns in a cell by its tree edges as bits: east 1, north 2, west 4, south 8.
_TURNS = np.array([4, 2, 2, 2, 2, 0, 2, 2, 2, 2, 0, 2, 2, 2, 2, 4])
_EAST, _NORTH, _WEST, _SOUTH = 1, 2, 4, 8


def spanning_edges(cells: Cells, x_joins: Cells, y_joins: Cells) -> NDArray[np.uint8]:
    """Tree edges of each cell as bits (east 1, north 2, west 4, south 8) of a spanning forest with few turns.

    Args:
        cells: bool (nx, ny). x_joins: bool (nx - 1, ny), joins of bricks along x.
        y_joins: bool (nx, ny - 1), joins along y.
    """
    edges = np.zeros(cells.shape, np.uint8)
    edges[:-1][x_joins] |= _EAST
    edges[1:][x_joins] |= _WEST
    edges[:, :-1][y_joins] |= _NORTH
    edges[:, 1:][y_joins] |= _SOUTH
    ny = cells.shape[1]
    label = np.arange(cells.size)
    for i, j in np.argwhere(x_joins):
        _unite(label, i * ny + j, (i + 1) * ny + j)
    for i, j in np.argwhere(y_joins):
        _unite(label, i * ny + j, i * ny + j + 1)
    heap = []
    for axis, fits in enumerate((cells[:-1] & cells[1:] & ~x_joins, cells[:, :-1] & cells[:, 1:] & ~y_joins)):
        for i, j in np.argwhere(fits).tolist():
            heap.append((_added_turns(edges, i, j, axis), axis, i, j))
    heapq.heapify(heap)
    while heap:
        cost, axis, i, j = heapq.heappop(heap)
        a, b = i * ny + j, (i + 1) * ny + j if axis == 0 else i * ny + j + 1
        if _root(label, a) == _root(label, b):
            continue
        now = _added_turns(edges, i, j, axis)
        if now > cost:  # an edge taken meanwhile made this one dearer
            heapq.heappush(heap, (now, axis, i, j))
            continue
        _unite(label, a, b)
        if axis == 0:
            edges[i, j] |= _EAST
            edges[i + 1, j] |= _WEST
        else:
            edges[i, j] |= _NORTH
            edges[i, j + 1] |= _SOUTH
    return edges


def _added_turns(edges: NDArray[np.uint8], i: int, j: int, axis: int) -> int:
    a, b = int(edges[i, j]), int(edges[i + (axis == 0), j + (axis == 1)])
    new_a, new_b = a | (_EAST if axis == 0 else _NORTH), b | (_WEST if axis == 0 else _SOUTH)
    return int(_TURNS[new_a] + _TURNS[new_b] - _TURNS[a] - _TURNS[b])


def _root(label: NDArray[np.int64], a: int) -> int:
    while label[a] != a:
        label[a] = label[label[a]]
        a = label[a]
    return int(a)


def _unite(label: NDArray[np.int64], a: int, b: int) -> None:
    label[_root(label, b)] = _root(label, a)


@in_place_kernel
def _walk(edges, i, j, path):  # type: ignore[no-untyped-def]
    """Sub-cells counter-clockwise around the tree from cell (i, j)'s south-east one; returns how many."""
    x, y, n = 2 * i + 1, 2 * j, 0
    while True:
        path[n, 0], path[n, 1] = x, y
        n += 1
        bits = edges[x >> 1, y >> 1]
        if y & 1 == 0:
            if x & 1 == 1:  # south-east: on along the eastern edge, else north
                if bits & 1:
                    x += 1
                else:
                    y += 1
            elif bits & 8:  # south-west: on along the southern edge, else east
                y -= 1
            else:
                x += 1
        elif x & 1 == 1:  # north-east: on along the northern edge, else west
            if bits & 2:
                y += 1
            else:
                x -= 1
        elif bits & 4:  # north-west: on along the western edge, else south
            x -= 1
        else:
            y -= 1
        if x == 2 * i + 1 and y == 2 * j:
            return n


def circumnavigate(cells: Cells, edges: NDArray[np.uint8]) -> list[NDArray[np.int64]]:
    """The closed paths around the trees: one int64 (n, 2) array of sub-cell indices per connected part.

    Sub-cell (2i, 2j) is the lower left quarter of cell (i, j). Every sub-cell of every cell is visited once.
    """
    seen = np.zeros(cells.shape, bool)
    path = np.empty((4 * int(cells.sum()) + 1, 2), np.int64)
    loops = []
    for i, j in np.argwhere(cells).tolist():
        if not seen[i, j]:
            count = _walk(edges, i, j, path)
            loop = path[:count].copy()
            seen[loop[:, 0] >> 1, loop[:, 1] >> 1] = True
            loops.append(loop)
    return loops
