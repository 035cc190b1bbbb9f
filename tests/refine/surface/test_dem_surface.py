"""Ground whose shape a height model gives: what of it stays, what the pictures overrule, how it travels."""

import pickle

import numpy as np
import pytest
import rasterio

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.raster.height_model import HeightModel
from orthoswarm.refine.surface.dem_surface import DemFit, LocalDem, fit_over_dem
from orthoswarm.refine.surface.terrain import fit_terrain
from orthoswarm.refine.surface.vehicle_ground import GroundModel, fit_ground

EPSG = 32632
ORIGIN = (500_000.0, 5_400_000.0)
BOUNDS = BoundingBox(-100.0, -100.0, 500.0, 400.0)
AREA = BoundingBox(ORIGIN[0] - 50.0, ORIGIN[1] - 50.0, ORIGIN[0] + 450.0, ORIGIN[1] + 350.0)
DATUM = 437.0


def hills(xy):
    """Ground in the local frame, with a wall-less relief of +-8 m and detail that 30 m nodes do not show."""
    x, y = xy[..., 0], xy[..., 1]
    return 8.0 * np.sin(x / 70.0) * np.cos(y / 80.0) + 0.8 * np.sin(x / 9.0)


def write(path, height=hills, east_m=0.0, known=None, gsd=2.0):
    """A GeoTIFF of heights of another datum, displaced by east_m."""
    n = 450
    east = -200.0 + gsd * (np.arange(n) + 0.5)
    north = 700.0 - gsd * (np.arange(n) + 0.5)
    xy = np.stack(np.meshgrid(east, north), -1)
    z = height(xy - (east_m, 0.0)) + DATUM
    if known is not None:
        z = np.where(known(xy), z, -9999.0)
    transform = rasterio.Affine(gsd, 0, ORIGIN[0] - 200.0, 0, -gsd, ORIGIN[1] + 700.0)
    with rasterio.open(
        path, "w", driver="GTiff", width=n, height=n, count=1, dtype="float32", crs=f"EPSG:{EPSG}", nodata=-9999.0,
        transform=transform,
    ) as dataset:  # fmt: skip
        dataset.write(z.astype(np.float32), 1)
    return path


def cameras(height=150.0):
    x, y = np.meshgrid(np.linspace(20.0, 380.0, 30), np.linspace(20.0, 280.0, 4))
    return np.column_stack([x.ravel() + ORIGIN[0], y.ravel() + ORIGIN[1], np.full(x.size, height)])


def opened(path, at=None):
    return LocalDem(HeightModel.open(path, EPSG, AREA, cameras() if at is None else at), ORIGIN)


def points(ground=hills, count=4000, level=1.5, seed=0):
    """Points on the ground, 0.2 m noise, a quarter of them on things that stand on it."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((-40.0, -40.0), (440.0, 340.0), (count, 2))
    z = ground(xy) + level + rng.normal(0.0, 0.2, count)
    z[::4] += rng.uniform(1.0, 12.0, len(z[::4]))
    return np.column_stack([xy, z]), np.full(count, 0.2)


def probe():
    return np.stack(np.meshgrid(np.arange(0.0, 401.0, 7.0), np.arange(0.0, 301.0, 7.0)), -1)


def off(terrain, ground, level=1.5):
    return terrain.height(probe()) - ground(probe()) - level


def test_a_right_model_keeps_its_shape_and_gets_the_level_of_the_points(tmp_path):
    p, sigma = points()
    fit, differs = fit_over_dem(opened(write(tmp_path / "dem.tif")), p, sigma, BOUNDS)
    assert isinstance(fit, DemFit) and differs < 0.15
    error = off(fit.rendering(), hills)
    assert abs(np.median(error)) < 0.1  # the datum of the file is 437 m away
    assert np.abs(error - np.median(error)).max() < 0.1
    found = fit_terrain(p, sigma, BOUNDS).rendering()
    assert np.percentile(np.abs(off(found, hills)), 95) > 0.5  # what the points alone show


def test_the_level_is_a_height_over_the_shape_that_is_drawn(tmp_path):
    p, sigma = points()
    fit, _ = fit_over_dem(opened(write(tmp_path / "dem.tif")), p, sigma, BOUNDS)
    up = fit.prior(fit.shift_m).height(probe()) - fit.rendering().height(probe())
    assert np.abs(up).max() < 1e-3


def test_a_deposit_on_an_old_model_is_followed_and_the_rest_is_left_alone(tmp_path):
    def now(xy):
        return hills(xy) + 1.5 * np.clip((180.0 - xy[..., 0]) / 40.0, 0.0, 1.0)

    p, sigma = points(now)
    fit, _ = fit_over_dem(opened(write(tmp_path / "dem.tif")), p, sigma, BOUNDS)
    error = off(fit.rendering(), now)
    east = probe()[..., 0]
    assert abs(np.median(error[east < 120.0])) < 0.25
    assert np.percentile(np.abs(error[east > 260.0]), 95) < 0.12


def test_beyond_the_model_the_ground_comes_from_the_points_without_a_step(tmp_path):
    dem = opened(write(tmp_path / "dem.tif", known=lambda xy: xy[..., 0] < 200.0))
    assert 0.4 < dem.model.cover < 0.6
    p, sigma = points()
    fit, _ = fit_over_dem(dem, p, sigma, BOUNDS)
    terrain, found = fit.rendering(), fit_terrain(p, sigma, BOUNDS).rendering()
    error, alone = np.abs(off(terrain, hills)), np.abs(off(found, hills))
    east = probe()[..., 0]
    assert error[east < 190.0].max() < 0.35
    assert np.percentile(error[east > 210.0], 95) < 1.3 * np.percentile(alone[east > 210.0], 95)
    across = np.stack(np.meshgrid(np.arange(190.0, 216.0, 2.0), np.arange(20.0, 280.0, 10.0)), -1)
    jump = np.diff(terrain.height(across) - hills(across), axis=1)
    assert np.abs(jump).max() < 1.0


def test_a_displaced_model_is_no_worse_than_none(tmp_path):
    p, sigma = points()
    fit, differs = fit_over_dem(opened(write(tmp_path / "dem.tif", east_m=20.0)), p, sigma, BOUNDS)
    alone = np.abs(off(fit_terrain(p, sigma, BOUNDS).rendering(), hills))
    error = np.abs(off(fit.rendering(), hills))
    assert differs > 0.3  # which is told
    pure = np.abs(hills(probe() - (20.0, 0.0)) - hills(probe()))
    assert np.median(error) < 0.6 * np.median(pure)
    assert np.percentile(error, 95) < 2.0 * np.percentile(alone, 95)


def test_a_model_of_other_ground_is_not_used(tmp_path):
    fit, differs = fit_over_dem(opened(write(tmp_path / "dem.tif", lambda xy: -hills(xy))), *points(), BOUNDS)
    assert fit is None and differs > 2.0


def test_a_model_that_was_contradicted_is_left_out_for_good(tmp_path):
    dem = opened(write(tmp_path / "dem.tif", lambda xy: -hills(xy)))
    p, sigma = points()
    before = GroundModel(dem=dem)
    np.testing.assert_allclose(before.height(p[:, :2]), dem.height(p[:, :2]))
    after = fit_ground(p, sigma, cameras() - (*ORIGIN, 0.0), before)
    assert after.dem is None and after.contradicted_m > 2.0
    assert np.percentile(np.abs(off(after.terrain(), hills)), 90) < 1.2


def test_what_travels_between_processes_is_small_and_gives_the_same_ground(tmp_path):
    fit, _ = fit_over_dem(opened(write(tmp_path / "dem.tif")), *points(), BOUNDS)
    there = fit.rendering()
    data = pickle.dumps(fit)
    assert len(data) < 20_000 < there.z.nbytes
    again = pickle.loads(data)
    np.testing.assert_array_equal(again.rendering().z, there.z)
    np.testing.assert_array_equal(again.prior(1.0).height(probe()), fit.prior(1.0).height(probe()))


def test_zero_is_the_ground_below_the_cameras_that_the_model_knows(tmp_path):
    path = write(tmp_path / "dem.tif", lambda xy: 0.05 * xy[..., 0], known=lambda xy: xy[..., 0] < 200.0)
    model = HeightModel.open(path, EPSG, AREA, cameras())
    assert model.zero_m == pytest.approx(DATUM + 0.05 * 110.0, abs=0.5)


def test_a_model_that_buries_cameras_is_refused(tmp_path):
    path = write(tmp_path / "dem.tif", lambda xy: 40.0 * hills(xy))
    with pytest.raises(InputError, match="ground lies above"):
        HeightModel.open(path, EPSG, AREA, cameras(60.0))


def test_unknown_camera_heights_do_not_count(tmp_path):
    path = write(tmp_path / "dem.tif")
    assert HeightModel.open(path, EPSG, AREA, cameras(np.nan)).cover > 0.99
