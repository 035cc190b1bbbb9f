"""The camera's conventions: golden poses, and properties that hold for every pose."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.model.camera import Camera, Lens, angles_from_rotation, focal_px, rotation_from_angles
from orthoswarm.model.geo import LocalGrid, utm_epsg

small = st.floats(-0.3, 0.3)


def camera_of(pose: dict) -> Camera:
    grid = LocalGrid(pose["epsg"])
    lat, lon = pose["lat_deg"], pose["lon_deg"]
    yaw = np.radians(pose["yaw_deg"]) - grid.convergence_rad(lat, lon)
    rotation = rotation_from_angles(yaw, np.radians(pose["pitch_deg"]), np.radians(pose["roll_deg"]))
    position = np.array([*grid.to_grid(lat, lon), pose["height_m"]])
    lens = Lens(pose["width"], pose["height"], focal_px(np.radians(pose["fov_deg"]), pose["width"]))
    return Camera(position, rotation, lens)


def test_golden_poses_are_reproduced_to_two_centimetres(golden_poses):
    assert len(golden_poses) == 6
    for pose in golden_poses:
        camera = camera_of(pose)
        assert utm_epsg(pose["lat_deg"], pose["lon_deg"]) == pose["epsg"]
        pixels = np.array([p["pixel"] for p in pose["points"]], float)
        expected = np.array([p["ground"] for p in pose["points"]])
        np.testing.assert_allclose(camera.to_ground(pixels), expected, atol=0.02)
        h = np.c_[pixels, np.ones(len(pixels))] @ camera.homography().T
        np.testing.assert_allclose(h[:, :2] / h[:, 2:], expected, atol=0.02)


@given(st.floats(-3, 3), small, small, st.floats(-0.08, 0.1), st.floats(0.0, 0.05))
def test_projection_and_ground_are_inverse(yaw, tilt, roll, k1, k2):
    lens = Lens(640, 480, focal_px(np.radians(80), 640), k1=k1, k2=k2)
    camera = Camera(np.array([1e5, 2e6, 120.0]), rotation_from_angles(yaw, tilt - np.pi / 2, roll), lens)
    pixels = np.array([[0.0, 0.0], [639, 479], [320, 240], [600, 20]])
    ground = camera.to_ground(pixels, 7.5)
    back = camera.project(np.c_[ground, np.full(4, 7.5)])
    np.testing.assert_allclose(back, pixels, atol=1e-6)


@given(st.floats(-3.1, 3.1), st.floats(-1.2, 1.2), st.floats(-1.2, 1.2))
def test_angles_survive_the_rotation(yaw, tilt, roll):
    y, p, r = angles_from_rotation(rotation_from_angles(yaw, tilt - np.pi / 2, roll))
    np.testing.assert_allclose([y, p, r], [yaw, tilt - np.pi / 2, roll], atol=1e-9)


def test_a_picture_above_the_horizon_has_no_ground():
    lens = Lens(640, 480, 320.0)
    camera = Camera(np.array([0.0, 0.0, 100.0]), rotation_from_angles(0.0, 0.0, 0.0), lens)
    assert np.isnan(camera.to_ground([[320.0, 0.0]])).all()


@pytest.mark.parametrize(("lat", "lon", "epsg"), [(0, 179.9, 32660), (-0.1, -179.9, 32701), (51.5, -0.12, 32630)])
def test_zones(lat, lon, epsg):
    assert utm_epsg(lat, lon) == epsg
