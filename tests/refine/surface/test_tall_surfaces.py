"""What stands on the ground is drawn where it stands, up to its edges, and the ground beside it on the ground."""

import numpy as np
import pytest

from orthoswarm.model.placement import Terrain
from orthoswarm.model.task_runner import serial
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.features.working_pictures import Pictures
from orthoswarm.refine.strategy.swarm_refiner import RefinerOptions
from orthoswarm.refine.surface.plane_sweep import TALL_FROM_M, SweepViews, with_tall_surfaces
from orthoswarm.refine.surface.seen_objects import hidden_by
from tests.kit.refine import refine_all, through_pickle
from tests.refine.surface.hall_flight import GRID, HALF, HEIGHT_M, MIDDLE, ROOF_M, HallFlight, away

MANY = 4_000_000
GROUND = Terrain(-60.0, -60.0, 30.0, np.zeros((13, 11), np.float32))


@pytest.fixture(scope="module")
def flight() -> HallFlight:
    return HallFlight()


@pytest.fixture(scope="module")
def places() -> np.ndarray:
    """Places every 2 m on and round the hall."""
    east, north = (MIDDLE[k] + np.arange(-HALF[k] - 20.0, HALF[k] + 20.1, 2.0) for k in (0, 1))
    return np.stack(np.meshgrid(east, north), -1).reshape(-1, 2)


def raised(roof_m: float = ROOF_M) -> np.ndarray:
    """Points every 14 m on the hall's roof, and on the ground elsewhere."""
    east, north = (a.ravel() for a in np.meshgrid(np.arange(-30.0, 180.0, 14.0), np.arange(-30.0, 240.0, 14.0)))
    xy = np.column_stack([east, north])
    return np.column_stack([xy, np.where(away(xy) < -2.0, roof_m, 0.0)])


def drawn(flight: HallFlight, points: np.ndarray, *, usable: object = True, most_nodes: int = MANY) -> Terrain:
    count = len(flight.frames)
    views = SweepViews(flight.cameras, Pictures(flight.frames, flight.read), np.full(count, usable, bool))
    return with_tall_surfaces(GROUND, points, [views], height_m=HEIGHT_M, most_nodes=most_nodes, run=serial)


def test_a_hall_is_drawn_on_its_roof_up_to_the_edges_and_the_ground_beside_it_on_the_ground(flight, places) -> None:
    refined = refine_all({"a": flight.frames}, None, GRID, options=RefinerOptions(read=flight.read))
    offset = np.median(
        [p.camera.position - t for p, t in zip(refined.fine[0].placed, flight.cameras.position, strict=True)], axis=0
    )
    terrain = refined.terrain
    height = terrain.height(places + offset[:2])
    bare = terrain.bare_ground().height(places + offset[:2])
    roof, beside = away(places) < -3.0, away(places) > 3.0
    assert np.median(np.abs(height[roof] - bare[roof] - ROOF_M)) < 0.5
    assert (np.abs(height[roof] - bare[roof] - ROOF_M) < 1.5).mean() > 0.95
    assert (np.abs(height[beside] - bare[beside]) < 1.5).mean() > 0.95
    halves = refine_all({"a": flight.frames}, None, GRID, options=RefinerOptions(read=flight.read), run=through_pickle)
    np.testing.assert_array_equal(terrain.z, halves.terrain.z)


def test_it_is_measured_as_far_as_the_edges_from_points_that_lie_well_inside(flight, places) -> None:
    height = drawn(flight, raised()).height(places)
    assert (np.abs(height[away(places) < -3.0] - ROOF_M) < 1.0).mean() > 0.97
    assert (np.abs(height[away(places) > 3.0]) < 1.0).mean() > 0.97


def test_a_tower_has_its_own_size_although_it_hides_the_ground_behind_it_from_the_picture_above(places) -> None:
    half, roof_m = np.array([10.0, 10.0]), 25.0
    height = drawn(HallFlight(roof_m, half), np.array([[*MIDDLE, roof_m]])).height(places)
    far = away(places, half)
    assert (np.abs(height[far < -2.5] - roof_m) < 1.5).mean() > 0.95
    assert (height[(far > 2.5) & (far < 15.0)] < 1.5).mean() > 0.98


def test_points_that_are_raised_by_mistake_leave_the_ground_as_it_is(places) -> None:
    level = HallFlight(roof_m=0.0)
    surface = drawn(level, raised())
    assert (np.abs(surface.height(places)) < 1.0).mean() > 0.99


def test_what_too_few_pictures_show_stays_on_the_ground(flight) -> None:
    usable = np.zeros(len(flight.frames), bool)
    usable[[5, 17]] = True
    surface = drawn(flight, raised(), usable=usable)
    assert (surface.z == 0.0).all() and surface.tops.max() == 3.0  # something may stand there


def test_ground_without_raised_points_is_given_back(flight) -> None:
    assert drawn(flight, raised(0.9 * TALL_FROM_M)) is GROUND
    assert drawn(flight, np.zeros((0, 3))) is GROUND


def test_number_of_nodes_stays_bounded(flight) -> None:
    surface = drawn(flight, raised(), most_nodes=200 * GROUND.z.size)
    assert GROUND.z.size < surface.z.size <= 200 * GROUND.z.size


def test_it_is_drawn_on_the_ground_where_all_pictures_look_from_one_side(flight, places) -> None:
    """Behind it the ground is in no picture: drawn on its top, the hall would be shown there once more."""
    west = flight.cameras.position[:, 0] < MIDDLE[0] - HALF[0] - 25.0
    assert west.sum() >= 6
    put_down, kept = drawn(flight, raised(), usable=west), drawn(flight, raised())
    assert (put_down.z == put_down.bare).all() and (put_down.tops > put_down.bare).any()
    assert (kept.z > kept.bare).any()


def test_places_that_no_picture_sees_are_named_by_what_hides_them() -> None:
    z = np.zeros((21, 21), np.float32)
    z[:, 10] = 4.0  # a wall from south to north
    wall = Terrain(-10.0, -10.0, 1.0, z, bare=np.zeros_like(z))
    lens = np.array([[100.0, 0.0, 0.0, 0.0, 0.0, 0.0, 400.0, 400.0]])
    above, west = np.array([[0.0, 0.0, 20.0]]), np.array([[-20.0, 0.0, 20.0]])
    down = np.diag([1.0, -1.0, -1.0])[None]
    everywhere = np.ones(z.shape, bool)

    def hidden(*positions: np.ndarray) -> np.ndarray:
        position = np.concatenate(positions)
        n = len(position)
        return hidden_by(wall, CameraBlock(position, np.repeat(down, n, 0), np.zeros(n, np.int32), lens), everywhere)

    behind = hidden(west)
    assert (behind[10, 12:15] == 10 * 21 + 10).all()  # 45 degrees: four metres behind the wall
    assert (behind[10, :11] == -1).all() and (behind[10, 17:] == -1).all()
    assert (hidden(west, above) == -1).all()  # both sides of the wall are seen from over it
