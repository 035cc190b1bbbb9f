"""TMSTC*: lines along the round trip about a spanning tree of bricks, which turns as seldom as it can.

After "TMSTC*: A Path Planning Algorithm for Minimizing Turns in Multi-robot Coverage" (Lu et al., RA-L 2023), with
what drones over free outlines need: cells only partly filled by the area keep only the lines over ground, lines reach
to the outline instead of ending at cell centres, and where a line was left out the order is mended by local search.
"""

from typing import Any, Final

import numpy as np
import shapely

from orthoswarm.model.arrays import Array, Flags, Indices
from orthoswarm.planning.lines.bricks import joins
from orthoswarm.planning.lines.line_spacing import Footprint
from orthoswarm.planning.lines.spanning_tree import circumnavigate, spanning_edges
from orthoswarm.planning.lines.sweep_lines import Field, Turned, line_count, strip_legs

Geometry = Any
Loop = Indices

_TMSTC_CRUMB_SHARE: Final = 0.02  # a cell of the spanning tree that holds a smaller share of the area is left out


def tmstc_legs(field: Field, angle_rad: float, foot: Footprint) -> list[Array]:
    """Legs along the closed paths about the trees, one list entry per connected part of the area.

    Args:
        field: ground and obstacles, grid metres.
        angle_rad: direction of one axis of the grid of cells, from grid east, counter-clockwise.
        foot: footprint; sub-cells are one line spacing wide.

    Returns:
        float64 (n, 2, 2) per closed path: start and end of its legs in flying order, grid metres.
    """
    frame = Turned(angle_rad, (field.ground.centroid.x, field.ground.centroid.y))
    local = field.turned(frame)
    x0, y0, x1, y1 = local.ground.bounds
    columns, rows = line_count(x1 - x0, foot.spacing_m), line_count(y1 - y0, foot.spacing_m)
    size = ((x1 - x0) / columns, (y1 - y0) / rows)
    # An odd column or row out is left without ground: its lines fall away again.
    filled = occupied(local.ground, (x0, y0), size, (columns + columns % 2, rows + rows % 2))
    cells = np.asarray(filled.reshape(filled.shape[0] // 2, 2, filled.shape[1] // 2, 2).any((1, 3)), bool)
    loops = circumnavigate(cells, spanning_edges(cells, *joins(cells)))
    both = (local, local.swapped())
    found = [_loop_legs(loop, filled, both, origin=(x0, y0), size=size, foot=foot) for loop in loops]
    return [frame.to_grid(np.array(legs)) for legs in found if legs]


def occupied(ground: Geometry, origin: tuple[float, float], size: tuple[float, float], shape: tuple[int, int]) -> Flags:
    """Which boxes of a raster hold more than a crumb of ground: bool, `shape` = boxes along x and y."""
    x = origin[0] + size[0] * np.arange(shape[0])[:, None]
    y = origin[1] + size[1] * np.arange(shape[1])[None, :]
    boxes = shapely.box(*np.broadcast_arrays(x, y, x + size[0], y + size[1]))
    shapely.prepare(ground)
    result = np.asarray(shapely.contains_properly(ground, boxes), bool)
    edge = shapely.intersects(ground, boxes) & ~result
    result[edge] = shapely.area(shapely.intersection(ground, boxes[edge])) > _TMSTC_CRUMB_SHARE * size[0] * size[1]
    return result


def _loop_legs(
    loop: Loop,
    filled: Flags,
    fields: tuple[Field, Field],
    *,
    origin: tuple[float, float],
    size: tuple[float, float],
    foot: Footprint,
) -> list[Array]:
    """Legs of one closed path: each sub-cell with ground is covered by the longest run through it."""
    n = len(loop)
    steps = np.roll(loop, -1, axis=0) - loop
    corners = np.flatnonzero((steps != np.roll(steps, 1, axis=0)).any(1))
    ends = np.append(corners[1:], corners[0] + n)
    runs = [np.arange(a, b + 1) % n for a, b in zip(corners, ends)]
    free = filled[loop[:, 0], loop[:, 1]]
    owned: dict[int, list[Loop]] = {}
    for number in sorted(range(len(runs)), key=lambda r: -int(free[runs[r]].sum())):
        mine = np.flatnonzero(free[runs[number]])
        owned[number] = [runs[number][g] for g in np.split(mine, np.flatnonzero(np.diff(mine) > 1) + 1) if len(g)]
        free[runs[number]] = False
    legs: list[Array] = []
    for number, run in enumerate(runs):
        step = loop[run[1]] - loop[run[0]]
        along_y = step[1] != 0
        for part in owned[number]:
            low, high = loop[part].min(0), loop[part].max(0) + 1
            box = [origin[0] + size[0] * low[0], origin[1] + size[1] * low[1]]
            box += [origin[0] + size[0] * high[0], origin[1] + size[1] * high[1]]
            if along_y:
                new = strip_legs(fields[0], (box[0], box[1], box[2], box[3]), foot, 0.5 * foot.spacing_m)
            else:
                new = strip_legs(fields[1], (box[1], box[0], box[3], box[2]), foot, 0.5 * foot.spacing_m)
                new = [leg[:, ::-1] for leg in new]
            legs += new if step.sum() > 0 else [leg[::-1] for leg in reversed(new)]
    return legs
