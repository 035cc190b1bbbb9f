"""Semi-global labels: steps lie where the picture has an edge."""

import numpy as np
import pytest

from orthoswarm.refine.surface import plane_sweep_kernels as kernels

ROWS, COLUMNS, LEVELS = 21, 24, 6


def heights(cost: np.ndarray, gray: np.ndarray) -> np.ndarray:
    """Heights in steps of 1 m of a block whose rim is not measured."""
    levels = np.zeros((ROWS, COLUMNS), np.int32)
    levels[1:-1, 1:-1] = LEVELS
    cost, gray = (np.ascontiguousarray(volume.transpose(0, 2, 1)) for volume in (cost, gray))
    cost[np.broadcast_to(np.arange(LEVELS)[:, None] >= np.maximum(levels, 1)[:, None], cost.shape)] = 1e6
    out = np.zeros((ROWS, COLUMNS), np.float32)
    f = np.float32
    total = kernels.semi_global(cost, gray, levels, (f(0.15), f(0.3), f(1.2), f(1.0 / 8.0)))
    kernels.lowest(total, levels, f(1.0), out)
    return out


@pytest.mark.parametrize("edge", [14, 15])
def test_a_step_lies_at_the_edge_of_the_picture_where_the_likeness_does_not_tell(edge: int) -> None:
    cost = np.ones((ROWS, COLUMNS, LEVELS), np.float32)
    cost[:, :8, 0] = 0.0
    cost[2:-2, 16:-2, 4] = 0.0  # between them nothing is known
    gray = np.full(cost.shape, 100.0, np.float32)
    gray[2:-2, edge:-2, 4] = 160.0
    gray[:, 12:, 1] = 160.0  # an edge on another height is none
    found = heights(cost, gray)[6:-6, 1:-2]
    assert (found[:, : edge - 1] == 0.0).all() and (np.abs(found[:, edge - 1 :] - 4.0) < 0.5).all()


def test_what_no_picture_tells_stays_on_the_ground() -> None:
    cost = np.ones((ROWS, COLUMNS, LEVELS), np.float32)
    cost[..., 1:] += np.float32(0.1)
    assert (heights(cost, np.full(cost.shape, 100.0, np.float32)) == 0.0).all()
