"""Height models from outside: any CRS, gaps, units, and files that are none."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.raster.height_model import DEM_MOST_NODES, HeightModel

EPSG = 32632
WEST, SOUTH = 500_000.0, 5_400_000.0
BOUNDS = BoundingBox(WEST, SOUTH, WEST + 400.0, SOUTH + 300.0)


def ground(east, north):
    return 300.0 + 0.05 * (east - WEST) - 0.03 * (north - SOUTH) + 4.0 * np.sin((east - WEST) / 80.0)


def write(path, z, epsg=EPSG, transform=None, unit=None, **profile):
    profile = {"nodata": None, "dtype": z.dtype, **profile}
    with rasterio.open(
        path, "w", driver="GTiff", width=z.shape[1], height=z.shape[0], count=1,
        crs=None if epsg is None else f"EPSG:{epsg}", transform=transform, **profile,
    ) as dataset:  # fmt: skip
        dataset.write(z, 1)
        if unit:
            dataset.units = [unit]
    return path


def utm_dem(gsd=2.0, margin=100.0, factor=1.0, dtype="float32"):
    left, top = WEST - margin, SOUTH + 300.0 + margin
    east = left + (np.arange(int((400 + 2 * margin) / gsd)) + 0.5) * gsd
    north = top - (np.arange(int((300 + 2 * margin) / gsd)) + 0.5) * gsd
    z = ground(*np.meshgrid(east, north)) * factor
    return z.astype(dtype), from_origin(left, top, gsd, gsd)


def probe():
    east, north = np.meshgrid(np.arange(WEST + 5, WEST + 396, 13.0), np.arange(SOUTH + 5, SOUTH + 296, 13.0))
    return np.stack([east, north], -1)


def check(terrain, level, atol):
    p = probe()
    np.testing.assert_allclose(terrain.height(p), ground(p[..., 0], p[..., 1]) - level, atol=atol)


def read(path, cameras=(), level_m=None, epsg=EPSG, bounds=BOUNDS):
    """The ground as terrain, relative to that below cameras (N, 2) or to a level."""
    at = np.array([[*camera, np.nan] for camera in cameras]).reshape(-1, 3)
    model = HeightModel.open(path, epsg, bounds, at)
    return (model if level_m is None else replace(model, zero_m=level_m)).window(bounds, DEM_MOST_NODES).terrain


def test_heights_are_relative_to_the_takeoff(tmp_path):
    z, transform = utm_dem()
    path = write(tmp_path / "dem.tif", z, transform=transform)
    takeoff = np.array([WEST + 50.0, SOUTH + 60.0])
    terrain = read(path, [takeoff])
    check(terrain, ground(*takeoff), 0.05)
    assert terrain.height(takeoff) == pytest.approx(0.0, abs=0.02)
    assert terrain.step_m == 2.0


def test_a_stated_level_wins(tmp_path):
    z, transform = utm_dem()
    path = write(tmp_path / "dem.tif", z, transform=transform)
    check(read(path, level_m=290.0), 290.0, 0.05)


def test_the_median_of_several_positions_is_the_datum(tmp_path):
    z, transform = utm_dem()
    path = write(tmp_path / "dem.tif", z, transform=transform)
    cameras = np.array([[WEST + 50.0, SOUTH + 60.0], [WEST + 60.0, SOUTH + 60.0], [WEST + 300.0, SOUTH + 60.0]])
    check(read(path, cameras), ground(*cameras[1]), 0.05)


def test_geographic_coordinates_are_warped(tmp_path):
    from pyproj import Transformer

    to_utm = Transformer.from_crs(4326, EPSG, always_xy=True)
    lon, lat = to_utm.transform(WEST, SOUTH, direction="INVERSE")
    step = 5e-5
    left, top = lon - 0.002, lat + 0.005
    lons, lats = np.meshgrid(left + (np.arange(200) + 0.5) * step, top - (np.arange(150) + 0.5) * step)
    east, north = to_utm.transform(lons, lats)
    path = write(tmp_path / "geo.tif", ground(east, north).astype(np.float32), 4326, from_origin(left, top, step, step))
    check(read(path, level_m=300.0), 300.0, 0.1)


def test_a_fine_dem_is_averaged_and_a_coarse_one_interpolated(tmp_path):
    z, transform = utm_dem(gsd=0.5)
    noisy = (z + np.random.default_rng(0).normal(0, 1.0, z.shape)).astype(np.float32)
    path = write(tmp_path / "fine.tif", noisy, transform=transform)
    fine = HeightModel(path, EPSG, zero_m=300.0, cover=1.0).window(BOUNDS, most_nodes=1200).terrain  # 10 m apart
    check(fine, 300.0, 0.5)
    z, transform = utm_dem(gsd=20.0)
    coarse = read(write(tmp_path / "c.tif", z, transform=transform), level_m=300.0)
    check(coarse, 300.0, 0.3)


@pytest.mark.parametrize(("gsd", "side"), [(1.0, 1), (2.0, 1), (5.0, 1)])
def test_the_highest_ground_is_that_of_single_pixels_within_a_distance(tmp_path, gsd, side):
    z, transform = utm_dem(gsd=gsd)
    level = np.full_like(z, 300.0)
    row, column = (int(v) for v in (~transform * (WEST + 201.0, SOUTH + 151.0))[::-1])
    level[row : row + side, column : column + side] = 375.0
    model = HeightModel.open(write(tmp_path / "mast.tif", level, transform=transform), EPSG, BOUNDS, np.empty((0, 3)))
    highest = model.highest(BOUNDS, 10.0, 2.0, 1_000_000)
    middle = np.array(transform * (column + 0.5 * side, row + 0.5 * side))
    turns = np.linspace(0.0, 2.0 * np.pi, 25)
    ring = np.stack([np.cos(turns), np.sin(turns)], -1)
    np.testing.assert_allclose(highest.height(middle + 10.0 * ring), 75.0, atol=0.01)
    np.testing.assert_allclose(highest.height(middle + 30.0 * ring), 0.0, atol=0.01)
    if gsd < 2.0:
        assert model.window(BOUNDS).terrain.z.max() < 60.0  # the mean, as before


def test_the_highest_ground_of_a_coarse_model_is_not_that_of_far_away(tmp_path):
    east = WEST - 585.0 + 30.0 * np.arange(60)
    z = np.tile((0.3 * (east - WEST)).astype(np.float32), (60, 1))
    path = write(tmp_path / "slope.tif", z, transform=from_origin(WEST - 600.0, SOUTH + 900.0, 30.0, 30.0))
    model = HeightModel.open(path, EPSG, BOUNDS, np.empty((0, 3)))
    rise = model.highest(BOUNDS.grown(30.0), 10.0, 2.0, 1_000_000).height(probe())
    rise -= model.window(BOUNDS.grown(30.0)).terrain.height(probe())
    assert rise.min() > 2.9 and rise.max() < 5.3  # 3 m within 10 m


@pytest.mark.parametrize("nodata", [-9999.0, None])
def test_gaps_are_filled_from_around(tmp_path, nodata):
    z, transform = utm_dem()
    z[120:140, 150:180] = -9999.0
    path = write(tmp_path / "dem.tif", z, transform=transform, nodata=nodata)
    check(read(path, level_m=300.0), 300.0, 3.0)


@pytest.mark.parametrize("unit", ["ft", "Foot_US", "foot_us", "ftUS", "us-ft", "US survey foot", "U.S. Survey Feet"])
def test_feet_become_metres(tmp_path, unit):
    z, transform = utm_dem(factor=1 / 0.3048)
    path = write(tmp_path / "feet.tif", z, transform=transform, unit=unit)
    check(read(path, level_m=300.0), 300.0, 0.05)


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        *dict.fromkeys(
            ("unknown", "none", "1", "m", "METERS", "meters above sea level", "m a.s.l.", "m (EGM96)", "1 m"), 1.0
        ).items(),
        *dict.fromkeys(("m NAVD88", "NAVD88 (m)", "metre (orthometric)", "meter(s)"), 1.0).items(),
        ("feet above sea level", 0.3048),
        ("NAVD88 (ft)", 0.3048),
        ("NAVD88 height (US survey feet)", 1200 / 3937),
        ("cm (EGM96)", 0.01),
    ],
)
def test_a_unit_is_found_beside_what_else_is_written(tmp_path, unit, metres):
    z, transform = utm_dem(factor=1 / metres)
    path = write(tmp_path / "dem.tif", z, transform=transform, unit=unit)
    check(read(path, level_m=300.0), 300.0, 0.05)


@pytest.mark.parametrize("unit", ["fathom", "yd", "%", "degrees", "0.1 m", "1.5 m", "1/10 m", "10 cm"])
def test_an_unknown_unit_is_not_taken_for_metres(tmp_path, unit):
    z, transform = utm_dem()
    path = write(tmp_path / "dem.tif", z, transform=transform, unit=unit)
    with pytest.raises(InputError, match=f"heights in '{unit}', which is no known unit"):
        read(path)


def test_whole_numbers_are_read(tmp_path):
    z, transform = utm_dem(dtype="int16")
    path = write(tmp_path / "int.tif", z, transform=transform, nodata=-32768)
    check(read(path, level_m=300.0), 300.0, 1.1)


def test_what_cannot_be_used_is_refused_in_one_sentence(tmp_path):
    z, transform = utm_dem()
    with pytest.raises(InputError, match="does not exist"):
        read(tmp_path / "none.tif")
    (tmp_path / "text.tif").write_text("no picture")
    with pytest.raises(InputError, match="not a readable height model"):
        read(tmp_path / "text.tif")
    with pytest.raises(InputError, match="no CRS"):
        read(write(tmp_path / "bare.tif", z, None, transform))
    away = BoundingBox(WEST + 10_000.0, SOUTH, WEST + 10_400.0, SOUTH + 300.0)
    with pytest.raises(InputError, match="covers"):
        read(write(tmp_path / "away.tif", z, transform=transform), bounds=away)
    picture = tmp_path / "rgb.tif"
    with rasterio.open(
        picture, "w", driver="GTiff", width=8, height=8, count=3, dtype="uint8", crs=f"EPSG:{EPSG}", transform=transform
    ) as dataset:
        dataset.write(np.zeros((3, 8, 8), np.uint8))
    with pytest.raises(InputError, match="is a picture"):
        read(picture)


def test_a_real_ground_model_is_read(real_data):
    path = real_data("autzen") / "autzen_ground_approx_0.5m_utm10_cm.tif"
    with rasterio.open(path) as dataset:
        b = dataset.bounds
    bounds = BoundingBox(b.left + 200, b.bottom + 300, b.right - 200, b.top - 300)
    terrain = read(path, epsg=32610, bounds=bounds)
    middle = terrain.height(np.array([[0.5 * (b.left + b.right), 0.5 * (b.bottom + b.top)]]))
    assert np.isfinite(middle).all()
    assert abs(np.median(terrain.z)) < 1e-3


def test_a_dem_in_another_unit_is_refused_before_it_buries_cameras(tmp_path):
    cameras = np.c_[np.random.default_rng(5).uniform(BOUNDS[:2], BOUNDS[2:], (40, 2)), np.full(40, 90.0)]
    z, transform = utm_dem()
    HeightModel.open(write(tmp_path / "dem.tif", z, transform=transform), EPSG, BOUNDS, cameras)
    steep = write(tmp_path / "steep.tif", 300.0 + 30.0 * (z - 300.0), transform=transform)
    with pytest.raises(InputError, match=r"steep\.tif the ground lies above \d+% of the cameras"):
        HeightModel.open(steep, EPSG, BOUNDS, cameras)
    HeightModel.open(steep, EPSG, BOUNDS, [])
