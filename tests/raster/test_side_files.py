"""Maps with files beside them: world file and .aux.xml of a PNG, external masks and overviews."""

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.transform import from_origin

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.raster.basemap import Basemap
from tests.raster.test_basemap import EAST, EPSG, NORTH, expected, picture, write

AREA = BoundingBox(EAST + 60.0, NORTH - 140.0, EAST + 140.0, NORTH - 60.0)
AFFINE = from_origin(EAST, NORTH, 0.5, 0.5)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_picture_with_a_world_file_is_a_map(tmp_path, suffix):
    path = tmp_path / f"map.{suffix}"
    bands = np.repeat(picture(AFFINE, 400, 400)[None], 3, axis=0).round().astype(np.uint8)
    driver = {"png": "PNG", "jpg": "JPEG"}[suffix]
    write(path, bands, AFFINE, driver=driver, worldfile=True)
    assert path.with_name(path.name + ".aux.xml").exists()
    gray, valid = Basemap.open(path, EPSG, AREA).gray(AREA, 0.5)
    assert valid.all() and np.abs(gray - expected(AREA, 0.5)).mean() < 4.0


def test_the_system_of_a_picture_with_a_world_file_comes_from_a_prj_beside_it(tmp_path):
    path = tmp_path / "map.jpg"
    write(path, np.repeat(picture(AFFINE, 400, 400)[None], 3, axis=0).round().astype(np.uint8), AFFINE, driver="JPEG",
          worldfile=True)  # fmt: skip
    path.with_name(path.name + ".aux.xml").unlink()
    with pytest.raises(InputError, match="no coordinate system"):
        Basemap.open(path, EPSG, AREA)
    path.with_suffix(".prj").write_text(pyproj.CRS.from_epsg(EPSG).to_wkt("WKT1_ESRI"))
    gray, valid = Basemap.open(path, EPSG, AREA).gray(AREA, 0.5)
    assert valid.all() and np.abs(gray - expected(AREA, 0.5)).mean() < 4.0


def test_masks_and_overviews_in_files_of_their_own_are_used(tmp_path):
    path = tmp_path / "map.tif"
    write(path, picture(AFFINE, 1024, 1024).round().astype(np.uint8), AFFINE, tiled=True)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK="NO"), rasterio.open(path, "r+") as file:
        mask = np.full((1024, 1024), 255, np.uint8)
        mask[:, :200] = 0
        file.write_mask(mask)
    with rasterio.Env(TIFF_USE_OVR="YES"), rasterio.open(path, "r+") as file:
        file.build_overviews([2, 4], rasterio.enums.Resampling.average)
    assert (tmp_path / "map.tif.msk").exists() and (tmp_path / "map.tif.ovr").exists()
    basemap = Basemap.open(path, EPSG, AREA)
    _, valid = basemap.gray(AREA, 0.5)
    columns = valid.mean(axis=0)
    assert columns[:70].max() < 0.1 and columns[90:].min() > 0.9
    basemap.require_readable(AREA)
