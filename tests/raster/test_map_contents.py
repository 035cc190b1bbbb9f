"""Maps that hold something else than they say: false alphas, palettes, masks of the finest level alone, no raster."""

import contextlib
import gzip
import sqlite3

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.crs import CRS
from rasterio.transform import from_origin

from orthoswarm.model.errors import InputError
from orthoswarm.raster.basemap import Basemap
from tests.raster.test_basemap import AREA, EAST, EPSG, NORTH, PLAIN, expected, mbtiles_of, picture, web_tiles, write

MIDDLE = EAST + 100.0


def area_seen(path, gsd=0.5, least=0.98):
    """Share of the area that a map shows; what it shows is the ground."""
    basemap = Basemap.open(path, EPSG, AREA)
    basemap.require_readable(AREA)
    gray, valid = basemap.gray(AREA, gsd)
    assert np.corrcoef(gray[valid], expected(AREA, gsd)[valid])[0, 1] > least
    return valid.mean()


def frame(epsg):
    """Transform and side of a raster about the area."""
    if epsg == EPSG:
        return PLAIN, 500
    (x,), (y,) = rasterio.warp.transform(f"EPSG:{EPSG}", f"EPSG:{epsg}", [EAST - 20], [NORTH + 20])
    return from_origin(x, y, 0.6, 0.6), 600


def with_alpha(path, alpha_of, epsg=EPSG, dtype=np.uint8, factor=1):
    """A colour map with a fourth band labelled alpha: what `alpha_of` makes of the ground and of the column's east."""
    affine, side = frame(epsg)
    ground = picture(affine, side, side, epsg).round()
    at = rasterio.warp.transform(f"EPSG:{EPSG}", f"EPSG:{epsg}", [MIDDLE], [NORTH - 100.0])[0][0]
    east = np.broadcast_to(affine.c + (np.arange(side) + 0.5) * affine.a - at, ground.shape)
    bands = [*[ground * factor] * 3, alpha_of(ground, east)]
    return write(path, np.stack(bands).astype(dtype), affine, epsg, photometric="RGB", alpha="YES")


@pytest.mark.parametrize("epsg", [EPSG, 3857])
@pytest.mark.parametrize(
    ("alpha_of", "dtype", "shown"),
    [
        (lambda ground, _: 250 - ground, np.uint8, 1.0),  # near infrared
        (lambda ground, _: 20 * (250 - ground), np.uint16, 1.0),
        (lambda ground, east: 0 * ground + 1, np.uint8, 1.0),
        (lambda ground, east: 255 + 0 * ground, np.uint16, 1.0),
        (lambda ground, east: 1.0 * (east > 0), np.uint8, 0.5),
        (lambda ground, east: 255 * (east > 0), np.uint16, 0.5),
        (lambda ground, east: 65535 * (east > 0), np.uint16, 0.5),
        (lambda ground, east: np.clip(255 * (east / 10 + 0.5), 0, 255), np.uint8, 0.5),  # a soft edge
    ],
)
def test_an_alpha_is_what_it_holds(tmp_path, alpha_of, dtype, shown, epsg):
    path = with_alpha(tmp_path / "m.tif", alpha_of, epsg, dtype, 1 if dtype == np.uint8 else 20)
    assert area_seen(path) == pytest.approx(shown, abs=0.03)


def palette_png(path, gray, transparent=None):
    image = Image.fromarray(gray, "P")
    image.putpalette(np.repeat(np.arange(256, dtype=np.uint8), 3).tobytes())
    image.save(path, **({} if transparent is None else {"transparency": transparent}))
    path.with_suffix(".pgw").write_text(f"0.4\n0\n0\n-0.4\n{EAST + 0.2}\n{NORTH - 0.2}\n")
    path.with_suffix(".prj").write_text(CRS.from_epsg(EPSG).to_wkt())
    return path


GRAYS = {v: (v, v, v, 255) for v in range(256)}


@pytest.mark.parametrize("kind", ["collar", "nodata", "transparent"])
def test_what_a_palette_map_does_not_show_is_no_ground(tmp_path, kind):
    gray = picture(PLAIN, 500, 500).round().astype(np.uint8)
    gray[:, :250] = 0 if kind == "collar" else 240  # within the picture's colours
    if kind == "transparent":
        path = palette_png(tmp_path / "m.png", gray, transparent=240)
    else:
        nodata = {"nodata": 240} if kind == "nodata" else {}
        path = write(tmp_path / "m.tif", gray, PLAIN, colormap=GRAYS, **nodata)
    for gsd in (0.4, 1.1):
        assert area_seen(path, gsd) == pytest.approx(0.5, abs=0.03)


def test_a_palette_of_16_bit_numbers(tmp_path):
    numbers = picture(PLAIN, 500, 500).round().astype(np.uint16) + 300
    colours = {v + 300: colour for v, colour in GRAYS.items()}
    assert area_seen(write(tmp_path / "m.tif", numbers, PLAIN, colormap=colours)) == 1.0


@pytest.mark.parametrize("internal", [True, False])
@pytest.mark.parametrize("epsg", [EPSG, 3857])
def test_a_mask_without_overviews_holds_at_all_resolutions(tmp_path, internal, epsg):
    affine, side = frame(epsg)
    gray = np.maximum(picture(affine, side, side, epsg), 1).round().astype(np.uint8)
    path = write(tmp_path / "m.tif", gray, affine, epsg, tiled=True)
    with rasterio.open(path, "r+") as file:
        file.build_overviews([2, 4], rasterio.enums.Resampling.average)
    at = rasterio.warp.transform(f"EPSG:{EPSG}", f"EPSG:{epsg}", [MIDDLE], [NORTH - 100.0])[0][0]
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=internal), rasterio.open(path, "r+") as file:
        east = affine.c + (np.arange(side) + 0.5) * affine.a
        file.write_mask(np.tile((255 * (east > at)).astype(np.uint8), (side, 1)))
    for gsd in (0.5, 1.2, 2.5):
        assert area_seen(path, gsd, least=0.95) == pytest.approx(0.5, abs=0.04)


def test_a_map_that_shows_nothing_is_refused_and_a_narrow_strip_is_none(tmp_path):
    alpha = np.zeros((500, 500))
    path = with_alpha(tmp_path / "clear.tif", lambda *_: alpha)
    with pytest.raises(InputError, match=r"clear.tif is transparent or empty in the area"):
        Basemap.open(path, EPSG, AREA).require_readable(AREA)
    alpha[200:210] = 255  # 4 m of ground, between the samples
    path = with_alpha(tmp_path / "strip.tif", lambda *_: alpha)
    assert area_seen(path) == pytest.approx(4 / 80, abs=0.02)


def test_a_file_of_several_rasters_is_refused_with_their_names(tmp_path):
    gray = picture(PLAIN, 100, 100).round().astype(np.uint8)
    for name in ("old", "new"):
        more = "YES" if name == "new" else "NO"
        write(tmp_path / "m.gpkg", gray, PLAIN, driver="GPKG", RASTER_TABLE=name, APPEND_SUBDATASET=more)
    with pytest.raises(InputError, match=r"holds 2 rasters \(GPKG:.*:old, GPKG:.*:new\); extract one"):
        Basemap.open(tmp_path / "m.gpkg", EPSG, AREA)


@pytest.mark.parametrize("packed", [True, False])
def test_vector_tiles_are_called_so(tmp_path, packed):
    web_tiles(tmp_path / "xyz", 17)
    path = mbtiles_of(tmp_path / "xyz", tmp_path / "m.mbtiles")
    with contextlib.closing(sqlite3.connect(path)) as file, file:
        for number, (row,) in enumerate(file.execute("SELECT rowid FROM tiles").fetchall()):
            tile = b"\x1a" + np.random.default_rng(number).bytes(2000 + number)
            file.execute(
                "UPDATE tiles SET tile_data = ? WHERE rowid = ?", (gzip.compress(tile) if packed else tile, row)
            )
    with pytest.raises(InputError, match=r"vector tiles \(pbf\); give a map of raster tiles"):
        Basemap.open(path, EPSG, AREA)
