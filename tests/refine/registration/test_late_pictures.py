"""Pictures laid beside refined ones that stay as they are."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame, Solution
from orthoswarm.mosaic.recorded_pose import recorded_cameras
from orthoswarm.raster.picture_file import read_gray
from orthoswarm.refine.registration.late_pictures import centre_sigma, on_terrain, register_late_pictures, resected
from tests.kit.made_up_ground import made_up_flight, made_up_ground
from tests.kit.mosaic_scene import EAST, NORTH, hills, terrain_of

EPSG = 32631
GRID = LocalGrid(EPSG)
LENS = Lens(640, 480, 457.0, k1=-0.05, k2=0.01)


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6), st.floats(-3.1, 3.1), st.integers(0, 1000), st.booleans()
)
def test_a_camera_is_found_from_points_a_third_of_which_are_wrong(off, yaw, seed, distorted):
    rng = np.random.default_rng(seed)
    lens = LENS if distorted else replace(LENS, k1=0.0, k2=0.0)
    true = Camera(np.array([EAST, NORTH, 150.0]), rotation_from_angles(yaw, -1.5, 0.05), lens)
    start = Camera(
        true.position + 3.0 * np.array(off[:3]),
        rotation_from_angles(yaw + 0.02 * off[3], -1.5 + 0.02 * off[4], 0.05 + 0.02 * off[5]), lens,
    )  # fmt: skip
    uv = rng.uniform((10, 10), (630, 470), (150, 2))
    ground = np.column_stack([true.to_ground(uv, 0.0), np.zeros(150)])
    uv += rng.normal(0.0, 0.2, uv.shape)
    uv[:50] += rng.uniform(-40, 40, (50, 2))
    found = resected(start, uv, ground)
    corners = np.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [0.0, 479.0]])
    assert np.hypot(*(found.to_ground(corners) - true.to_ground(corners)).T).max() < 0.5


@given(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0))
def test_a_ray_ends_on_the_terrain(u, v):
    terrain = terrain_of(hills)
    camera = Camera(np.array([EAST + u, NORTH + v, 120.0]), rotation_from_angles(0.3, -1.5, 0.0), LENS)
    points = on_terrain(camera, np.array([[5.0, 5.0], [320.0, 240.0], [630.0, 400.0]]), terrain)
    np.testing.assert_allclose(points[:, 2], terrain.height(points[:, :2]), atol=0.1)
    np.testing.assert_allclose(camera.project(points), [[5.0, 5.0], [320.0, 240.0], [630.0, 400.0]], atol=0.5)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return made_up_flight(made_up_ground(), tmp_path_factory.mktemp("p"), "v1")


def solution_of(frames):
    """A perfect refinement."""
    placed = recorded_cameras(frames, GRID).placed
    return Solution(
        vehicle="v1",
        placed=[PlacedFrame(p.frame, p.camera, "fine", 0.1) for p in placed],
        dropped={},
        legs=[],
        fov_deg=70.0,
        fov_sigma_deg=0.1,
        terrain=None,
    )


def moved(frame, east_m, north_m):
    lat, lon = GRID.to_geographic(GRID.to_grid(frame.fix.lat_deg, frame.fix.lon_deg) + np.array([east_m, north_m]))
    return replace(frame, fix=replace(frame.fix, lat_deg=float(lat), lon_deg=float(lon)))


def read_of(frame):
    return read_gray(frame.path)


def test_a_late_picture_lies_as_well_as_its_neighbours_whatever_its_record_says(flight):
    late = [moved(flight[4], 4.0, -3.0), moved(flight[20], -3.0, 2.0)]
    refined = solution_of([f for k, f in enumerate(flight) if k not in (4, 20)])
    placed, dropped = register_late_pictures(late, refined, EPSG, lambda frame: read_gray(frame.path))
    assert not dropped
    for one, frame in zip(placed, (flight[4], flight[20]), strict=True):
        true = recorded_cameras([frame], GRID).placed[0].camera
        assert np.hypot(*(one.camera.corners() - true.corners()).T).max() < 0.5
        assert (one.stage, one.weak) == ("fine", False)
        assert 0.1 <= one.sigma_m < 0.5


def test_beyond_its_neighbours_a_late_picture_is_less_sure_than_among_them(flight):
    among, beyond = flight[20], flight[-1]
    (sure,), _ = register_late_pictures([among], solution_of([f for f in flight if f is not among]), EPSG, read_of)
    (unsure,), _ = register_late_pictures([beyond], solution_of(flight[:-4]), EPSG, read_of)
    assert not unsure.weak
    assert sure.sigma_m < 0.15 < unsure.sigma_m
    true = recorded_cameras([beyond], GRID).placed[0].camera
    middle = np.array([true.lens.principal_point])
    assert np.hypot(*(unsure.camera.to_ground(middle) - true.to_ground(middle))[0]) < 2.0 * unsure.sigma_m


def test_few_points_in_a_corner_hold_its_middle_badly():
    camera = Camera(np.array([EAST, NORTH, 150.0]), rotation_from_angles(0.4, -1.5, 0.05), LENS)
    rng = np.random.default_rng(4)
    noise = rng.normal(0.0, 0.3, (60, 2))
    everywhere, corner = rng.uniform((10, 10), (630, 470), (60, 2)), rng.uniform((10, 10), (110, 90), (60, 2))
    held, hanging = (
        centre_sigma(camera, uv + noise, np.column_stack([camera.to_ground(uv, 0.0), np.zeros(60)]), 1.0)
        for uv in (everywhere, corner)
    )
    assert 0.005 < held < 0.1
    assert hanging > 3.0 * held


def test_where_the_pictures_show_nothing_it_follows_its_neighbours_corrections(flight):
    refined = solution_of(flight[1:])
    shifted = [replace(p, frame=moved(p.frame, 2.0, 0.0)) for p in refined.placed]  # all records are 2 m too far east
    blank = np.full((180, 240), 90, np.uint8)
    late = moved(flight[0], 2.0, 0.0)
    (one,), _ = register_late_pictures([late], replace(refined, placed=shifted), EPSG, lambda frame: blank)
    true = recorded_cameras([flight[0]], GRID).placed[0].camera
    assert np.hypot(*(one.camera.nadir - true.nadir)) < 0.01
    assert one.weak
    assert one.sigma_m > 1.0


def test_a_picture_that_cannot_be_read_is_named(flight, tmp_path):
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8 no more")
    late = replace(flight[0], path=tmp_path / "broken.jpg")
    placed, dropped = register_late_pictures([late], solution_of(flight[1:]), EPSG, lambda frame: read_gray(frame.path))
    assert not placed
    assert "damaged" in dropped[late.image]
