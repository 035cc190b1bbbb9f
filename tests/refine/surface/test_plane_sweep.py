"""Semi-global labels: steps lie where the picture has an edge, and what something taller hides is not believed."""

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


@pytest.mark.parametrize("unlike", [0.05, 0.9])
def test_likeness_says_little_at_heights_that_something_taller_hides_from_the_camera(unlike: float) -> None:
    f, shape, cell, tower = np.float32, (ROWS, COLUMNS), 1.0, 4.0
    surface = np.zeros(shape, np.float32)
    surface[2:-2, 8:11] = tower
    cost = np.full((ROWS, LEVELS, COLUMNS), unlike, np.float32)
    levels = np.full(shape, LEVELS, np.int32)
    west_of_it = np.array([-12.0, 10.0, 24.0])  # a line of sight falls by about a metre a cell
    kernels.bound_hidden(
        cost, levels, surface, np.zeros(shape, np.float32), 0.0, 0.0, cell, f(1.0), west_of_it, f(0.2), f(0.35), f(0.1),
        f(0.2),
    )  # fmt: skip
    touched = cost != f(unlike)
    assert not touched[10, :, :8].any()  # before it, seen as it is
    assert touched[10, 0, 11:13].all() and not touched[10, 4:, 11:].any()  # behind it, up to the line of sight
    assert not touched[10, :, 16:].any()  # farther than its shadow
    bounded = cost[10, :, 11][touched[10, :, 11]]
    bound = f(0.2) if unlike < 0.2 else f(0.35)
    np.testing.assert_allclose(bounded, bound + np.array([0.0, 0.1, 0.1, 0.1])[: len(bounded)], atol=1e-6)
