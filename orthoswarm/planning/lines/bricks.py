"""Fewest bricks of a grid of cells: a maximum independent set, found through Hopcroft-Karp matching.

TMSTC* (Lu et al., RA-L 2023, section IV) cuts the free cells into straight bricks one cell wide. Every pair of
neighbouring cells could be joined; joining saves a brick. A cell can be joined along x or along y, not both, so
horizontal and vertical joins that share a cell exclude each other: a bipartite graph. Joins of a maximum independent
set give the fewest bricks. By Koenig's theorem that set is what a minimum vertex cover leaves, and the cover follows
from a maximum matching by alternating paths from the unmatched vertices.
"""

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel, kernel

Cells = NDArray[np.bool_]


@in_place_kernel
def _layers(start, links, mate_left, mate_right, level, queue):  # type: ignore[no-untyped-def]
    """Breadth-first levels from the unmatched left vertices; True if an unmatched right vertex is in reach."""
    tail = 0
    for u in range(len(mate_left)):
        level[u] = -1
        if mate_left[u] < 0:
            level[u] = 0
            queue[tail] = u
            tail += 1
    head, reached = 0, False
    while head < tail:
        u = queue[head]
        head += 1
        for k in range(start[u], start[u + 1]):
            w = mate_right[links[k]]
            if w < 0:
                reached = True
            elif level[w] < 0:
                level[w] = level[u] + 1
                queue[tail] = w
                tail += 1
    return reached


@in_place_kernel
def _augment(root, start, links, mate_left, mate_right, level, cursor, stack):  # type: ignore[no-untyped-def]
    """Depth-first search for an augmenting path along rising levels; flips it. No recursion: paths get long."""
    depth = 0
    stack[0] = root
    while depth >= 0:
        u = stack[depth]
        if cursor[u] >= start[u + 1]:
            level[u] = -1  # a dead end for this phase
            depth -= 1
            if depth >= 0:
                cursor[stack[depth]] += 1
            continue
        w = mate_right[links[cursor[u]]]
        if w < 0:
            for d in range(depth, -1, -1):
                v = links[cursor[stack[d]]]
                mate_left[stack[d]] = v
                mate_right[v] = stack[d]
            return True
        if level[w] == level[u] + 1:
            depth += 1
            stack[depth] = w
        else:
            cursor[u] += 1
    return False


@kernel
def _hopcroft_karp(start, links, rights):  # type: ignore[no-untyped-def]
    """Maximum matching of a bipartite graph in compressed rows: mates of the left and of the right, -1 without."""
    lefts = len(start) - 1
    mate_left, mate_right = np.full(lefts, -1, np.int64), np.full(rights, -1, np.int64)
    for u in range(lefts):  # a greedy start saves most phases
        for k in range(start[u], start[u + 1]):
            if mate_right[links[k]] < 0:
                mate_left[u] = links[k]
                mate_right[links[k]] = u
                break
    level, queue = np.empty(lefts, np.int64), np.empty(lefts, np.int64)
    stack = np.empty(lefts + 1, np.int64)
    while _layers(start, links, mate_left, mate_right, level, queue):
        cursor = start[:-1].copy()
        for u in range(lefts):
            if mate_left[u] < 0:
                _augment(u, start, links, mate_left, mate_right, level, cursor, stack)
    return mate_left, mate_right


@kernel
def _independent(start, links, mate_left, mate_right):  # type: ignore[no-untyped-def]
    """Maximum independent set from a maximum matching: left vertices reached by alternating paths, right not."""
    lefts, rights = len(mate_left), len(mate_right)
    left, right = mate_left < 0, np.ones(rights, np.bool_)
    queue = np.empty(lefts, np.int64)
    tail = 0
    for u in range(lefts):
        if left[u]:
            queue[tail] = u
            tail += 1
    head = 0
    while head < tail:
        u = queue[head]
        head += 1
        for k in range(start[u], start[u + 1]):
            v = links[k]
            if right[v]:
                right[v] = False
                w = mate_right[v]
                if w >= 0 and not left[w]:
                    left[w] = True
                    queue[tail] = w
                    tail += 1
    return left, right


def maximum_matching(
    start: NDArray[np.int64], links: NDArray[np.int64], rights: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Right mate of each left vertex and left mate of each right one (-1 without) in a maximum matching.

    Hopcroft and Karp 1973.

    Args:
        start: int64 (lefts + 1,), where each left vertex's neighbours begin in `links`.
        links: int64, right neighbours, row by row. rights: number of right vertices.
    """
    mate_left, mate_right = _hopcroft_karp(start, links, rights)
    return mate_left, mate_right


def joins(cells: Cells) -> tuple[Cells, Cells]:
    """Which neighbouring cells form one brick, so that the bricks are as few as can be.

    Args:
        cells: bool (nx, ny), True where a cell is to be covered.

    Returns:
        bool (nx - 1, ny): cell (i, j) is joined with (i + 1, j); bool (nx, ny - 1): with (i, j + 1).
    """
    along_x, along_y = cells[:-1] & cells[1:], cells[:, :-1] & cells[:, 1:]
    left = np.full(along_x.shape, -1, np.int64)
    left[along_x] = np.arange(along_x.sum())
    right = np.full(along_y.shape, -1, np.int64)
    right[along_y] = np.arange(along_y.sum())
    pairs = []
    for dx in (0, 1):  # a join along x of cells i, i + 1 meets up to four joins along y: at each cell, up and down
        for dy in (0, 1):
            i, j = np.nonzero(along_x)
            column, row = i + dx, j - dy
            fits = (row >= 0) & (row < cells.shape[1] - 1)
            i, j, column, row = i[fits], j[fits], column[fits], row[fits]
            other = right[column, row]
            pairs.append(np.stack([left[i, j][other >= 0], other[other >= 0]], -1))
    edges = np.concatenate(pairs)
    edges = edges[np.lexsort((edges[:, 1], edges[:, 0]))]
    lefts, rights = int(along_x.sum()), int(along_y.sum())
    start = np.searchsorted(edges[:, 0], np.arange(lefts + 1)).astype(np.int64)
    links = np.ascontiguousarray(edges[:, 1])
    mates = maximum_matching(start, links, rights)
    free_left, free_right = _independent(start, links, *mates)
    x_joins, y_joins = np.zeros_like(along_x), np.zeros_like(along_y)
    x_joins[along_x] = free_left
    y_joins[along_y] = free_right
    return x_joins, y_joins
