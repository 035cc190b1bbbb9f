"""Voids of height models, declared or not, never mix with the heights beside them."""

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.raster.height_model import HeightModel

EPSG = 32632
WEST, SOUTH = 500_000.0, 5_400_000.0
BOUNDS = BoundingBox(WEST + 50.0, SOUTH + 50.0, WEST + 350.0, SOUTH + 350.0)
LEVEL_M = 500.0


def dem(path, void, nodata, dtype, metres=1.0, offset=0.0, side=1.0):
    """Flat ground with single pixels and small patches of voids; `metres` a stored step from `offset`."""
    n = int(400 / side)
    z = np.full((n, n), (LEVEL_M - offset) / metres)
    for row, column in np.random.default_rng(0).integers(2, n - 4, (max(n * n // 5000, 20), 2)):
        size = 1 + (row + column) % 3
        z[row : row + size, column : column + size] = void
    place = from_origin(WEST, SOUTH + 400.0, side, side)
    profile = {"width": n, "height": n, "count": 1, "dtype": dtype, "crs": f"EPSG:{EPSG}", "transform": place}
    with rasterio.open(path, "w", driver="GTiff", nodata=nodata, **profile) as file:
        file.write(z.astype(dtype), 1)
        file.scales, file.offsets = (metres,), (offset,)
    return path


VOIDS = {
    "declared": (-9999, -9999, "float32"),
    "not declared": (-9999, None, "float32"),
    "another one": (-9999, -32768, "float32"),
    "above": (32767, -32768, "int16"),
    "of three digits": (-999, None, "int16"),
    "least float": (np.finfo(np.float32).min, None, "float32"),
    "no number": (np.nan, -9999, "float32"),
    "declared as a possible height": (0, 0, "int16"),
    "centimetres": (-200_000, None, "int32", 0.01),
    "depths": (9999, None, "float32", -1.0),
    "over a level": (65535, None, "uint16", 1.0, -100.0),
}


@pytest.mark.parametrize("side", [0.5, 2.0, 5.0])
@pytest.mark.parametrize("kind", VOIDS)
def test_voids_leave_the_ground_beside_them_as_it_is(tmp_path, kind, side):
    model = HeightModel.open(dem(tmp_path / "dem.tif", *VOIDS[kind], side=side), EPSG, BOUNDS, [])
    assert model.zero_m == pytest.approx(LEVEL_M) and model.cover > 0.8
    ground = model.window(BOUNDS)
    np.testing.assert_allclose(ground.terrain.z, 0.0, atol=0.01)
    np.testing.assert_allclose(model.highest(BOUNDS, 10.0, 4.0, 250_000).z, 0.0, atol=0.01)


def test_ground_below_the_sea_and_of_small_numbers_is_no_void(tmp_path):
    path = dem(tmp_path / "dem.tif", -32768, -32768, "int32", metres=0.001, offset=LEVEL_M + 430.0)
    model = HeightModel.open(path, EPSG, BOUNDS, [])
    assert model.zero_m == pytest.approx(LEVEL_M) and model.cover > 0.8
