"""Column by column: parallel lines over the whole area in one direction, flown in turn, up and down."""

import itertools

import numpy as np
from numpy.typing import NDArray

from orthoswarm.planning.lines.line_spacing import Footprint
from orthoswarm.planning.lines.sweep_lines import Field, Turned, line_count, strip_legs

Array = NDArray[np.float64]


def column_legs(field: Field, angle_rad: float, foot: Footprint, multiple: int = 1) -> Array:
    """Legs of all columns in flying order.

    A column that an obstacle or a bay of the outline interrupts is flown to its end (around the obstacle) before
    the next one begins: simple and even, but it goes around an obstacle once per column.

    Args:
        field: ground and obstacles, grid metres.
        angle_rad: direction of the sweep, from grid east, counter-clockwise.
        foot: footprint of the narrowest camera.
        multiple: make the number of columns a multiple of this, by laying them closer.

    Returns:
        float64 (n, 2, 2), start and end of each leg, grid metres.
    """
    x, y = field.ground.centroid.x, field.ground.centroid.y
    frame = Turned(angle_rad, (x, y))
    local = field.turned(frame)
    x0, y0, x1, y1 = local.ground.bounds
    count = line_count(x1 - x0, foot.spacing_m)
    edges = np.linspace(x0, x1, -(-count // multiple) * multiple + 1)
    found: list[Array] = []
    up = True
    for left, right in itertools.pairwise(edges):
        legs = strip_legs(local, (left, y0 - 1, right, y1 + 1), foot, 0.5 * foot.spacing_m)
        found += legs if up else [leg[::-1] for leg in reversed(legs)]
        up = up != bool(legs)
    return frame.to_grid(np.array(found)) if found else np.empty((0, 2, 2))
