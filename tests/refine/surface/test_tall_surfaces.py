"""Tops of halls and stands: drawn where they stand, while houses and trees leave the ground as it is."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.config import active
from orthoswarm.model.placement import Terrain
from orthoswarm.refine.surface.tall_surfaces import with_tall_surfaces

CELL_M = 14.0
MANY = 4_000_000


def slope() -> Terrain:
    """Ground that rises by 3 % to the east, 600 m by 600 m, nodes 30 m apart."""
    return Terrain(0.0, 0.0, 30.0, np.tile(0.03 * 30.0 * np.arange(21, dtype=np.float32), (21, 1)))


def sights(ground: Terrain, over: object, seed: int = 0) -> np.ndarray:
    """Points about CELL_M apart on the ground plus over(x, y), with 0.1 m of noise."""
    rng = np.random.default_rng(seed)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(7.0, 600.0, CELL_M), np.arange(7.0, 600.0, CELL_M)))
    xy = np.column_stack([x, y]) + rng.uniform(-2.0, 2.0, (len(x), 2))
    z = ground.height(xy) + over(xy[:, 0], xy[:, 1]) + rng.normal(0.0, 0.1, len(xy))  # type: ignore[operator]
    return np.column_stack([xy, z])


def hall(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A flat roof of 80 m by 60 m, 12 m high."""
    return np.where((np.abs(x - 300.0) < 40.0) & (np.abs(y - 200.0) < 30.0), 12.0, 0.0)


def test_hall_is_drawn_on_its_roof_and_the_street_beside_it_on_the_ground() -> None:
    ground = slope()
    drawn = with_tall_surfaces(ground, sights(ground, hall), CELL_M, MANY)
    inside = np.stack(np.meshgrid(np.linspace(280.0, 320.0, 9), np.linspace(190.0, 210.0, 5)), -1)
    assert np.abs(drawn.height(inside) - ground.height(inside) - 12.0).max() < 1.0
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.0, 600.0, 5.0), np.arange(0.0, 600.0, 5.0)))
    beside = (np.abs(x - 300.0) > 60.0) | (np.abs(y - 200.0) > 50.0)
    there = np.column_stack([x, y])[beside]
    assert np.abs(drawn.height(there) - ground.height(there)).max() < 0.05
    assert drawn.step_m == active().surface.tall_node_spacing_m
    middle = np.array([300.0, 200.0])
    assert abs(float(drawn.bare_ground().height(middle) - ground.height(middle))) < 0.01


def test_stand_keeps_its_slope() -> None:
    def stand(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where((np.abs(x - 300.0) < 50.0) & (np.abs(y - 300.0) < 100.0), 0.2 * (x - 250.0), 0.0)

    ground = slope()
    drawn = with_tall_surfaces(ground, sights(ground, stand), CELL_M, MANY)
    x = np.arange(265.0, 331.0, 5.0)
    at = np.column_stack([x, np.full(len(x), 300.0)])
    assert np.abs(drawn.height(at) - ground.height(at) - 0.2 * (x - 250.0)).max() < 2.5


def test_houses_and_trees_leave_the_ground_as_it_is() -> None:
    def houses(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where((x % 42.0 < 13.0) & (y % 42.0 < 13.0), 8.0, 0.0)

    ground = slope()
    assert with_tall_surfaces(ground, sights(ground, houses), CELL_M, MANY) is ground


def test_lone_wrong_heights_on_a_roof_do_not_dent_it() -> None:
    def big(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where((np.abs(x - 300.0) < 60.0) & (np.abs(y - 200.0) < 60.0), 12.0, 0.0)

    ground = slope()
    points = sights(ground, big)
    middle = np.abs(points[:, :2] - (300.0, 200.0)).max(1) < 30.0
    points[np.flatnonzero(middle)[::7], 2] += 9.0
    drawn = with_tall_surfaces(ground, points, CELL_M, MANY)
    inside = np.stack(np.meshgrid(np.linspace(270.0, 330.0, 9), np.linspace(170.0, 230.0, 9)), -1)
    assert np.abs(drawn.height(inside) - ground.height(inside) - 12.0).max() < 1.0


def test_pit_is_drawn_at_its_bottom() -> None:
    ground = slope()
    drawn = with_tall_surfaces(ground, sights(ground, lambda x, y: -0.6 * hall(x, y)), CELL_M, MANY)
    middle = np.array([300.0, 200.0])
    assert abs(float(drawn.height(middle) - ground.height(middle)) + 7.2) < 1.0


def test_number_of_nodes_stays_bounded() -> None:
    ground = slope()
    drawn = with_tall_surfaces(ground, sights(ground, hall), CELL_M, 4 * ground.z.size)
    assert ground.z.size < drawn.z.size <= 4 * ground.z.size


@given(seed=st.integers(0, 2**32 - 1), rough=st.floats(0.0, 0.9), count=st.integers(0, 40))
def test_ground_that_is_only_rough_is_given_back(seed: int, rough: float, count: int) -> None:
    ground = slope()
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0.0, 600.0, (count, 2))
    z = ground.height(xy) + rng.uniform(-rough, rough, count) * active().surface.tall_from_m
    assert with_tall_surfaces(ground, np.column_stack([xy, z]), CELL_M, MANY) is ground
