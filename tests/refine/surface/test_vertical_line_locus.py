"""Heights at free positions from pictures of one leg, on rendered scenes of known shape."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from orthoswarm.model.placement import Terrain
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.surface import vertical_line_locus
from orthoswarm.refine.surface.dem_surface import kernel_mode
from orthoswarm.refine.surface.ground_densification import draw_positions, free_ground
from orthoswarm.refine.surface.vertical_line_locus import LARGE_PATCH, dense_ground
from tests.kit.draped import HEIGHT, WIDTH, Pictures, rig_of


def hill(xy):
    return 3 * np.sin(xy[..., 0] / 45.0) * np.cos(xy[..., 1] / 60.0) + 2.0


@pytest.fixture(scope="module")
def hilly():
    cameras, leg = rig_of()
    return cameras, leg, Pictures(cameras, hill)


def cells(step=9.0, pad=40.0):
    east, north = np.meshgrid(np.arange(-pad, 60 + pad, step), np.arange(-pad, 198 + pad, step))
    return np.c_[east.ravel(), north.ravel()]


SWEEP = (LARGE_PATCH.at_height(100.0),)


def test_the_sweep_finds_the_surface_to_decimetres(hilly):
    cameras, leg, gray = hilly
    found = dense_ground(cameras, gray, cells(), terrain=Terrain.flat(0.0), leg_of_camera=leg, sweeps=SWEEP)
    error = found.points[:, 2] - hill(found.points[:, :2])
    assert len(found.points) > 0.8 * len(cells())
    assert abs(np.median(error)) < 0.05
    assert np.median(np.abs(error)) < 0.12
    assert (np.abs(error) > 1.0).mean() < 0.01


def test_points_stay_by_their_cells(hilly):
    cameras, leg, gray = hilly
    found = dense_ground(cameras, gray, cells(), terrain=Terrain.flat(0.0), leg_of_camera=leg, sweeps=SWEEP)
    beside = np.hypot(*(found.points[:, :2] - cells()[found.cell]).T)
    assert beside.max() < 8.0
    assert len(np.unique(found.cell)) == len(found.cell)


def test_distortion_is_honoured():
    cameras, leg = rig_of(legs=1, k1=-0.06)
    gray = Pictures(cameras, hill)
    at = cells(pad=30)[:, :]
    found = dense_ground(cameras, gray, at, terrain=Terrain.flat(0.0), leg_of_camera=leg, sweeps=SWEEP)
    error = found.points[:, 2] - hill(found.points[:, :2])
    assert len(error) > 100
    assert np.median(np.abs(error)) < 0.12


def test_results_do_not_depend_on_how_many_pictures_are_held(hilly, monkeypatch):
    cameras, leg, gray = hilly
    wide = dense_ground(cameras, gray, cells(), terrain=Terrain.flat(1.0), leg_of_camera=leg, sweeps=SWEEP)
    monkeypatch.setattr(vertical_line_locus, "_SWEEP_REFERENCES", 2)
    narrow = dense_ground(cameras, gray, cells(), terrain=Terrain.flat(1.0), leg_of_camera=leg, sweeps=SWEEP)
    np.testing.assert_array_equal(wide.points, narrow.points)


def test_each_picture_is_read_twice_at_most(hilly):
    cameras, leg, gray = hilly
    gray.read.clear()
    dense_ground(cameras, gray, cells(), terrain=Terrain.flat(1.0), leg_of_camera=leg, sweeps=SWEEP)
    assert len(gray.read) < 2 * len(set(gray.read))


def test_cameras_without_a_leg_are_not_used(hilly):
    cameras, leg, gray = hilly
    gray.read.clear()
    without = np.where(np.arange(len(cameras)) == 3, -1, leg)
    dense_ground(cameras, gray, cells(), terrain=Terrain.flat(1.0), leg_of_camera=without, sweeps=SWEEP)
    assert 3 not in gray.read
    nothing = dense_ground(
        cameras, gray, cells(), terrain=Terrain.flat(1.0), leg_of_camera=np.full(len(cameras), -1), sweeps=SWEEP
    )
    assert nothing.points.shape == (0, 3)


def test_ground_beyond_the_ends_of_legs_is_measured_between_legs():
    """GIVEN ground so far ahead of the legs that one picture of each sees it THEN pictures of other legs help."""
    cameras, leg = rig_of(legs=3, per_leg=4)
    gray = Pictures(cameras, hill)
    at = np.c_[np.arange(0.0, 121.0, 4.0), np.full(31, -66.0)]
    found = dense_ground(cameras, gray, at, terrain=Terrain.flat(0.0), leg_of_camera=leg, sweeps=SWEEP)
    error = found.points[:, 2] - hill(found.points[:, :2])
    assert len(error) > 8
    assert np.abs(error).max() < 0.3
    alone = dense_ground(
        cameras, gray, at, terrain=Terrain.flat(0.0), leg_of_camera=np.where(leg == 1, 1, -1), sweeps=SWEEP
    )
    assert len(alone.points) == 0


def test_featureless_ground_gives_nothing():
    cameras, leg = rig_of(legs=1)
    gray = Pictures(cameras, hill, np.full((1100, 1100), 130.0, np.float32))
    found = dense_ground(cameras, gray, cells(pad=20), terrain=Terrain.flat(0.0), leg_of_camera=leg, sweeps=SWEEP)
    assert len(found.points) < 0.02 * len(cells(pad=20))


def test_a_repeating_texture_is_resolved_by_several_baselines_and_refused_with_one():
    cameras, leg = rig_of(legs=1, tilt_deg=0.0)
    stripes = np.tile((120 + 60 * np.sin(np.arange(1100) * 0.785))[:, None], (1, 1100)).astype(np.float32)
    gray = Pictures(cameras, hill, stripes)  # repeats along the flight every 3.2 m
    middle = cells(pad=20)[np.abs(cells(pad=20)[:, 1] - 99) < 25]  # seen from 54 m fore and aft
    found = dense_ground(cameras, gray, middle, terrain=Terrain.flat(0.0), leg_of_camera=leg, sweeps=SWEEP)
    assert len(found.points) > 0.8 * len(middle)
    assert np.percentile(np.abs(found.points[:, 2] - hill(found.points[:, :2])), 95) < 0.5
    lone = dense_ground(
        cameras,
        gray,
        middle,
        terrain=Terrain.flat(0.0),
        leg_of_camera=leg,
        sweeps=[replace(SWEEP[0], baselines_m=(54.0,))],
    )
    assert len(lone.points) < 0.1 * len(middle)


def test_positions_nobody_sees_are_left_out(hilly):
    cameras, leg, gray = hilly
    far = np.array([[900.0, 900.0], [30.0, 100.0]])
    found = dense_ground(cameras, gray, far, terrain=Terrain.flat(1.0), leg_of_camera=leg, sweeps=SWEEP)
    assert 0 not in found.cell


def test_large_pictures_are_shrunk_to_what_the_sweep_needs():
    cameras, leg = rig_of(legs=1)
    gray = Pictures(cameras, hill)
    fine = cameras.lens.copy()
    fine[:, [0, 6, 7]] *= 3
    double = CameraBlock(cameras.position, cameras.rotation, cameras.lens_id, fine)
    big = lambda i: cv2.resize(gray(i), (3 * WIDTH, 3 * HEIGHT), interpolation=cv2.INTER_LINEAR)  # noqa: E731
    coarse = dense_ground(cameras, gray, cells(pad=20), terrain=Terrain.flat(0.0), leg_of_camera=leg)
    shrunk = dense_ground(double, big, cells(pad=20), terrain=Terrain.flat(0.0), leg_of_camera=leg)
    assert len(shrunk.points) > 0.8 * len(coarse.points)
    error = shrunk.points[:, 2] - hill(shrunk.points[:, :2])
    assert np.median(np.abs(error)) < 0.2


def test_the_open_ground_is_found_below_a_surface_that_lies_above_it(hilly):
    cameras, leg, gray = hilly
    positions = draw_positions(cameras.position[:, :2], 45.0)
    high = Terrain(-300.0, -300.0, 5.0, np.zeros((160, 120), np.float32))
    east, north = np.meshgrid(-300 + 5.0 * np.arange(120), -300 + 5.0 * np.arange(160))
    for offset in (0.0, 0.4):
        surface = Terrain(high.west, high.south, 5.0, (hill(np.stack([east, north], -1)) + offset).astype(np.float32))
        found = free_ground(cameras, gray, positions, surface, leg).points
        assert len(found) > 200
        assert kernel_mode(found[:, 2] - surface.height(found[:, :2])) == pytest.approx(-offset, abs=0.08)


def test_positions_are_drawn_alike_every_time():
    xy = np.c_[np.arange(50.0), np.arange(50.0)]
    a, b = draw_positions(xy, 67.5), draw_positions(xy, 67.5)
    np.testing.assert_array_equal(a, b)
    assert a.shape == (900, 2)
    assert (a.min(0) > -46).all() and (a.max(0) < 96).all()


def test_the_mode_ignores_a_long_tail():
    rng = np.random.default_rng(0)
    values = np.r_[rng.normal(-0.3, 0.1, 300), rng.uniform(-0.5, 8, 500)]
    assert kernel_mode(values) == pytest.approx(-0.28, abs=0.08)


def test_a_wall_in_the_terrain_reads_no_pixel_outside_a_picture():
    cameras, leg = rig_of()
    pictures = Pictures(cameras, lambda xy: np.zeros(xy.shape[:-1]))
    z = np.zeros((60, 60), np.float32)
    z[:, 30:] = 45.0  # a stadium in a height model, 2 m nodes: slopes of 20
    wall = Terrain(-20.0, 0.0, 2.0, z)
    cells = np.stack(np.meshgrid(np.linspace(20.0, 60.0, 60), np.linspace(20.0, 90.0, 20)), -1).reshape(-1, 2)
    found = dense_ground(cameras, pictures, cells, terrain=wall, leg_of_camera=leg)
    assert np.isfinite(found.points).all()
