"""`mosaic --covariance`: covariances of exterior orientations that keep what they say."""

import json
from pathlib import Path

import numpy as np
import pytest

from gcs_plugin.cli.main import main
from orthoswarm.export.product_files import pose_covariance
from orthoswarm.model.camera import Camera, Lens, ground_jacobian, rotation_from_angles
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.placement import STATED_SIGMA_FACTOR, PlacedFrame
from tests.kit.scene import Scene, legs


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """A flight of two legs, mapped with covariances: the scene, its shots, the lines of frames.jsonl."""
    folder = tmp_path_factory.mktemp("flight")
    scene, shots = Scene(), legs(count=2, photos=8)
    scene.fly(folder / "photos" / "a", shots)
    scene.basemap(folder / "map.tif")
    options = ["--basemap", str(folder / "map.tif"), "--workers", "1", "--out", str(folder / "out"), "--covariance"]
    assert main(["mosaic", str(folder / "photos"), *options]) == 0
    return scene, shots, [json.loads(line) for line in (folder / "out" / "frames.jsonl").read_text().splitlines()]


def test_positions_lie_where_their_covariances_say(mapped):
    scene, shots, rows = mapped
    of_errors = []
    for row, shot in zip(sorted(rows, key=lambda row: row["image"]), shots, strict=True):
        camera = row["camera"]
        covariance = np.array(camera["covariance"])
        assert covariance.shape == (6, 6) and np.allclose(covariance, covariance.T, rtol=1e-4, atol=1e-12)
        assert np.linalg.eigvalsh(covariance).min() > 0.0
        true = scene.camera(shot).position[:2]
        error = np.array(scene.grid.to_grid(camera["lat_deg"], camera["lon_deg"])) - true
        of_errors.append(error @ np.linalg.solve(covariance[:2, :2], error) / 2)
    assert 0.02 < np.mean(of_errors) < 4.0  # 1 where covariances are exact


def frame(tilt_deg=0.0, covariance=None, sigma_m=0.5):
    """A placed frame 80 m above the ground at level 5."""
    angles = np.radians([30.0, -90.0 + tilt_deg, 2.0])
    camera = Camera(np.array([1e5, 2e5, 85.0]), rotation_from_angles(*angles), Lens(640, 480, 420.0))
    picture = Frame(
        image="a.jpg", path=Path("a.jpg"), vehicle="a", time_s=None, fix=Fix(0.0, 0.0), width=640, height=480
    )
    return PlacedFrame(picture, camera, "fine", sigma_m, pose_covariance=covariance)


OWN = np.diag([0.01, 0.01, 0.04, 1e-6, 1e-6, 1e-7]).astype(np.float32)


@pytest.mark.parametrize("sigma_m", [0.05, 0.2, 3.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 25.0])
def test_the_ground_below_has_the_stated_error(sigma_m, tilt_deg):
    placed = frame(tilt_deg, OWN, sigma_m)
    covariance = pose_covariance(placed, 5.0)
    j = ground_jacobian(placed.camera.rotation, 80.0, 0.2)
    on_ground = np.trace(j @ covariance @ j.T) / 2
    assert np.sqrt(on_ground) * STATED_SIGMA_FACTOR == pytest.approx(sigma_m, rel=1e-6)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_how_the_ground_moves_with_the_camera_is_the_derivative_of_its_projection():
    camera = frame(20.0).camera
    j = ground_jacobian(camera.rotation, 80.0, 0.2)
    centre = np.array(camera.lens.principal_point)
    from scipy.spatial.transform import Rotation

    for k, step in enumerate([0.01] * 3 + [1e-5] * 3):
        move, turn = np.zeros(3), np.zeros(3)
        (move if k < 3 else turn)[k % 3] = step
        other = Camera(camera.position + move, camera.rotation @ Rotation.from_rotvec(turn).as_matrix(), camera.lens)
        moved = (other.to_ground(centre, 5.0) - camera.to_ground(centre, 5.0)) / step
        assert moved == pytest.approx(j[:, k], rel=1e-3, abs=1e-3)


def test_what_has_no_covariance_gets_none():
    assert pose_covariance(frame(), 5.0) is None
    assert ground_jacobian(frame(85.0).camera.rotation, 80.0, 0.2) is None
