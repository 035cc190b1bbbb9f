"""The field of view of a gap flight: what pictures saw from the heights that were recorded, two sigma narrower."""

from dataclasses import replace

import numpy as np
import pytest

from orthoswarm.coverage.planning_lens import planning_fov_rad, planning_fovs_deg
from orthoswarm.coverage.view import View
from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.placement import Terrain

DOWN = rotation_from_angles(0.0, -np.pi / 2, 0.0)


def _view(k: int, fov_deg: float, height_m: float, recorded_m: float | None, **more: object) -> View:
    lens = Lens(1600, 1200, focal_px(np.radians(fov_deg), 1600))
    camera = Camera(np.array([10.0 * k, 0.0, height_m]), DOWN, lens)
    return View.of_camera(camera, f"{k}.jpg", "v1", 0.2, recorded_height_m=recorded_m, **more)


def test_height_exchanged_for_focal_length_leaves_the_footprint() -> None:
    height_m = 40.0 * np.tan(np.radians(50.0)) / np.tan(np.radians(56.4))  # solved with 112.8 instead of 100 degrees
    views = [_view(k, 112.8, height_m, 40.0) for k in range(20)]
    assert np.degrees(planning_fov_rad(views)) == pytest.approx(100.0, abs=1e-6)
    assert planning_fovs_deg(views)["v1"] == pytest.approx(100.0, abs=1e-6)


def test_heights_recorded_too_large_narrow_what_is_seen_from_them() -> None:
    views = [_view(k, 60.0, 72.0, 80.0) for k in range(20)]
    assert np.tan(0.5 * planning_fov_rad(views)) == pytest.approx(0.9 * np.tan(np.radians(30.0)))


def test_the_ground_below_a_picture_counts() -> None:
    ground = Terrain.flat(10.0)
    views = [_view(k, 60.0, 80.0, 80.0, ground=ground) for k in range(20)]
    assert np.tan(0.5 * planning_fov_rad(views)) == pytest.approx(7 / 8 * np.tan(np.radians(30.0)))
    level = [_view(k, 60.0, 80.0, 80.0) for k in range(20)]
    assert np.tan(0.5 * planning_fov_rad(level, ground_z_m=10.0)) == pytest.approx(7 / 8 * np.tan(np.radians(30.0)))


def test_scatter_between_pictures_narrows_it_by_two_sigma_and_outliers_do_not() -> None:
    rng = np.random.default_rng(4)
    heights = 80.0 * (1.0 + 0.02 * rng.standard_normal(400))
    heights[:20] = 10.0
    found = np.tan(0.5 * planning_fov_rad([_view(k, 60.0, h, 80.0) for k, h in enumerate(heights)]))
    assert found == pytest.approx(0.96 * np.tan(np.radians(30.0)), rel=0.006)


@pytest.mark.parametrize("recorded_m", [None, 0.0])
def test_without_recorded_heights_it_is_the_lens_two_sigma_narrower(recorded_m: float | None) -> None:
    views = [_view(k, 60.0, 80.0, recorded_m, focal_sigma=0.03) for k in range(3)]
    assert np.tan(0.5 * planning_fov_rad(views)) == pytest.approx(0.94 * np.tan(np.radians(30.0)))


def test_over_a_height_model_it_is_the_lens_whatever_the_relief() -> None:
    views = [_view(k, 60.0, 80.0 + k, 30.0 + 20.0 * k, focal_sigma=0.01) for k in range(9)]
    found = np.tan(0.5 * planning_fov_rad(views, heights_over_level_ground=False))
    assert found == pytest.approx(0.98 * np.tan(np.radians(30.0)))


def test_pictures_placed_on_the_map_count_before_recorded_poses() -> None:
    views = [_view(k, 60.0, 80.0, 80.0) for k in range(5)]
    assumed = [replace(_view(10 + k, 75.0, 80.0, 80.0), placed=False) for k in range(50)]
    assert np.degrees(planning_fov_rad([*views, *assumed])) == pytest.approx(60.0)
    assert np.degrees(planning_fov_rad(assumed)) == pytest.approx(75.0)
