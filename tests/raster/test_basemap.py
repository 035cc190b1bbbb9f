"""Maps of every kind give the same ground at the same place, or one clear error."""

import contextlib
import pickle
import shutil
import sqlite3
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import rasterio
import rasterio.shutil
import rasterio.warp
from rasterio.crs import CRS
from rasterio.transform import Affine, from_origin

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import GroundGrid, LocalGrid
from orthoswarm.raster.basemap import Basemap
from orthoswarm.raster.map_check import UnreadableMapError

EPSG = 32633
EAST, NORTH = 412_000.0, 5_320_000.0
AREA = BoundingBox(EAST + 60.0, NORTH - 140.0, EAST + 140.0, NORTH - 60.0)


def ground(east, north):
    """A smooth ground that tells position: 40 to 215."""
    return 127.5 + 45 * np.sin(east / 7.0) * np.cos(north / 9.0) + 42 * np.sin((east + north) / 23.0)


def expected(bounds, gsd):
    grid = GroundGrid.around(EPSG, bounds, gsd)
    rows, cols = np.mgrid[: grid.height, : grid.width]
    p = grid.to_ground(np.stack([cols, rows], -1))
    return ground(p[..., 0], p[..., 1])


def picture(affine, width, height, epsg=EPSG):
    """The ground as a raster with some transform and CRS sees it, float64."""
    if epsg == EPSG:
        rows, cols = np.mgrid[:height, :width] + 0.5
        return ground(*(affine @ (cols, rows)))
    step = 16  # 20 m at most, over which another system is straight to 0.1 mm
    rows, cols = np.mgrid[: height + 2 * step : step, : width + 2 * step : step]
    x, y = affine @ (cols, rows)
    to = rasterio.warp.transform(f"EPSG:{epsg}", f"EPSG:{EPSG}", x.ravel(), y.ravel())
    x, y = np.reshape(to[0], x.shape), np.reshape(to[1], y.shape)
    down, across = (
        np.maximum(0.0, 1.0 - np.abs((np.arange(side)[:, None] + 0.5) / step - np.arange(count)))
        for side, count in zip((height, width), x.shape)
    )
    return ground(down @ x @ across.T, down @ y @ across.T)


def write(path, bands, affine, epsg=EPSG, **profile):
    bands = np.atleast_3d(bands.T).T if bands.ndim == 2 else bands
    colormap = profile.pop("colormap", None)
    crs = CRS.from_epsg(epsg) if epsg else None
    settings = {"driver": "GTiff", "count": len(bands), "dtype": bands.dtype, "crs": crs, "transform": affine}
    with rasterio.open(path, "w", width=bands.shape[2], height=bands.shape[1], **settings | profile) as out:
        out.write(bands)
        if colormap:
            out.write_colormap(1, colormap)
    return path


def assert_same_ground(basemap, gsd, tolerance=3.0):
    gray, valid = basemap.gray(AREA, gsd)
    want = expected(AREA, gsd)
    assert gray.dtype == np.float32 and gray.shape == want.shape == valid.shape
    assert valid.all()
    assert np.sqrt(np.mean((gray - want) ** 2)) < tolerance
    # The shift that explains the difference best, in pixels of the answer (one step of Lucas and Kanade).
    slope = np.stack([g.ravel() for g in np.gradient(want)], 1)
    shift, *_ = np.linalg.lstsq(slope, (gray - want).ravel(), rcond=None)
    assert np.hypot(*shift) * gsd < 0.02 * max(1.0, basemap.native_gsd_m)


PLAIN = from_origin(EAST, NORTH, 0.4, 0.4)


@pytest.fixture
def gray_tif(tmp_path):
    return write(tmp_path / "map.tif", picture(PLAIN, 500, 500).round().astype(np.uint8), PLAIN)


@pytest.mark.parametrize("gsd", [0.25, 0.4, 0.7, 1.5])
def test_grey_map_at_its_own_and_other_resolutions(gray_tif, gsd):
    basemap = Basemap.open(gray_tif, EPSG, AREA)
    assert basemap.native_gsd_m == pytest.approx(0.4, rel=1e-3)
    assert basemap.bounds == pytest.approx((EAST, NORTH - 200, EAST + 200, NORTH), abs=0.5)
    assert_same_ground(basemap, gsd)


@pytest.mark.parametrize("side", [0.1, 2.0])
def test_fine_and_coarse_maps(tmp_path, side):
    affine = from_origin(EAST, NORTH, side, side)
    n = int(200 / side)
    basemap = Basemap.open(write(tmp_path / "m.tif", picture(affine, n, n).astype(np.uint8), affine), EPSG, AREA)
    assert_same_ground(basemap, 0.5, tolerance=4.0)


def test_colour_with_alpha_tells_where_it_is_empty(tmp_path):
    gray = picture(PLAIN, 500, 500).round().astype(np.uint8)
    alpha = np.full_like(gray, 255)
    alpha[:, :250] = 0
    path = write(
        tmp_path / "m.tif", np.stack([gray, gray // 2, gray // 4, alpha]), PLAIN, photometric="RGB", alpha="YES"
    )
    basemap = Basemap.open(path, EPSG, AREA)
    rgb, valid = basemap.rgb(AREA, 0.4)
    column = int((EAST + 100 - AREA[0]) / 0.4)
    assert not valid[:, : column - 1].any() and valid[:, column + 1 :].all()
    assert rgb.dtype == np.uint8 and not rgb[~valid].any()
    np.testing.assert_allclose(rgb[valid][:, 1], rgb[valid][:, 0] / 2, atol=2)


def test_nodata_and_internal_mask_are_not_ground(tmp_path):
    gray = picture(PLAIN, 500, 500).round().astype(np.uint8)
    gray[200:260, 200:260] = 0
    with_nodata = Basemap.open(write(tmp_path / "n.tif", gray, PLAIN, nodata=0), EPSG, AREA)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        path = write(tmp_path / "i.tif", np.maximum(gray, 90), PLAIN)
        with rasterio.open(path, "r+") as out:
            out.write_mask(gray > 0)
    with_mask = Basemap.open(path, EPSG, AREA)
    for basemap in (with_nodata, with_mask):
        _, valid = basemap.gray(AREA, 0.4)
        assert valid.mean() == pytest.approx(1 - (24 / 80) ** 2, abs=0.02)


def test_the_black_collar_of_a_map_without_mask_is_not_ground(tmp_path):
    gray = picture(PLAIN, 500, 500).round().astype(np.uint8)
    gray[:, :250] = 0
    gray[300:303, 300:303] = 0  # a shadow is ground
    basemap = Basemap.open(write(tmp_path / "m.tif", gray, PLAIN), EPSG, AREA)
    _, valid = basemap.gray(AREA, 0.4)
    assert 0.48 < valid.mean() < 0.52


def test_sixteen_bit_is_stretched_to_the_bulk_of_its_values(tmp_path):
    values = (picture(PLAIN, 500, 500) * 20 + 3000).astype(np.uint16)
    values[10, 10] = 65535
    basemap = Basemap.open(write(tmp_path / "m.tif", values, PLAIN), EPSG, AREA)
    gray, _ = basemap.gray(AREA, 0.4)
    want = expected(AREA, 0.4)
    assert np.corrcoef(gray.ravel(), want.ravel())[0, 1] > 0.995
    assert gray.std() > want.std()


def test_palette_maps_are_averaged_as_colours(tmp_path):
    gray = picture(PLAIN, 500, 500).round().astype(np.uint8)
    shuffled = np.random.default_rng(1).permutation(256).astype(np.uint8)
    colours = {int(shuffled[v]): (v, v, v, 255) for v in range(256)}
    basemap = Basemap.open(write(tmp_path / "m.tif", shuffled[gray], PLAIN, colormap=colours), EPSG, AREA)
    assert_same_ground(basemap, 0.4, tolerance=5.0)
    assert_same_ground(basemap, 1.2, tolerance=5.0)


def test_a_rotated_map(tmp_path):
    affine = Affine.translation(EAST - 60, NORTH - 40) * Affine.rotation(31.0) * Affine.scale(0.4, -0.4)
    basemap = Basemap.open(write(tmp_path / "m.tif", picture(affine, 800, 800).astype(np.uint8), affine), EPSG)
    near = basemap.bounds
    bounds = BoundingBox.around_points(near.center, 30.0)
    gray, valid = basemap.gray(bounds, 0.5)
    assert valid.all()
    assert np.sqrt(np.mean((gray - expected(bounds, 0.5)) ** 2)) < 3
    assert basemap.native_gsd_m == pytest.approx(0.4, rel=1e-3)


@pytest.mark.parametrize("epsg", [4326, 3857, 32634])
def test_maps_in_other_coordinate_systems(tmp_path, epsg):
    west, south, east, north = rasterio.warp.transform_bounds(
        f"EPSG:{EPSG}", f"EPSG:{epsg}", EAST, NORTH - 200, EAST + 200, NORTH
    )
    affine = rasterio.transform.from_bounds(west, south, east, north, 500, 500)
    path = write(tmp_path / "m.tif", picture(affine, 500, 500, epsg).round().astype(np.uint8), affine, epsg)
    assert_same_ground(Basemap.open(path, EPSG, AREA), 0.5)


def test_overviews_are_used_and_agree(tmp_path):
    affine = from_origin(EAST, NORTH, 0.1, 0.1)
    path = write(tmp_path / "m.tif", picture(affine, 2000, 2000).astype(np.uint8), affine, tiled=True)
    plain = Basemap.open(path, EPSG, AREA).gray(AREA, 1.0)[0]
    with rasterio.open(path, "r+") as out:
        out.build_overviews([2, 4], rasterio.enums.Resampling.average)
    gray, valid = Basemap.open(path, EPSG, AREA).gray(AREA, 1.0)
    assert valid.all()
    np.testing.assert_allclose(gray, plain, atol=4)


def web_tiles(folder, zoom, suffix="png", tms=False, size=256):
    """Tiles of the ground around the area at one zoom."""
    n = 2**zoom
    side = 2 * np.pi * 6378137.0 / n
    x, y = rasterio.warp.transform(f"EPSG:{EPSG}", "EPSG:3857", [EAST, EAST + 200], [NORTH, NORTH - 200])
    c = [int((v + n * side / 2) // side) for v in x]
    r = [int((n * side / 2 - v) // side) for v in y]
    for i in range(c[0], c[1] + 1):
        for j in range(r[0], r[1] + 1):
            affine = from_origin(i * side - n * side / 2, n * side / 2 - j * side, side / size, side / size)
            tile = picture(affine, size, size, 3857).round().astype(np.uint8)
            path = folder / str(zoom) / str(i) / f"{n - 1 - j if tms else j}.{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), cv2.merge([tile, tile, tile]))


@pytest.mark.parametrize(("suffix", "tms", "size"), [("png", False, 256), ("jpg", True, 256), ("webp", False, 512)])
def test_a_folder_of_tiles(tmp_path, suffix, tms, size):
    web_tiles(tmp_path, 18, suffix, tms, size)
    web_tiles(tmp_path, 17, suffix, tms, size)
    basemap = Basemap.open(tmp_path, EPSG, AREA)
    assert basemap.native_gsd_m == pytest.approx(0.597 * np.cos(np.radians(48)) * 256 / size, rel=0.02)
    for gsd in (0.3, 0.5, 1.5):
        assert_same_ground(basemap, gsd, tolerance=6.0)


def test_a_folder_of_tiles_whose_rows_come_first(tmp_path):
    web_tiles(tmp_path / "xyz", 18)
    for tile in (tmp_path / "xyz" / "18").rglob("*.png"):
        turned = tmp_path / "zyx" / "18" / tile.stem / f"{tile.parent.name}.png"
        turned.parent.mkdir(parents=True, exist_ok=True)
        tile.rename(turned)
    assert_same_ground(Basemap.open(tmp_path / "zyx", EPSG, AREA), 0.5, tolerance=6.0)


def test_mbtiles(tmp_path):
    zoom = 19
    side = 2 * np.pi * 6378137.0 / 2**zoom
    (x,), (y,) = rasterio.warp.transform(f"EPSG:{EPSG}", "EPSG:3857", [EAST], [NORTH])
    affine = from_origin(x // side * side, y // side * side, side / 256, side / 256)
    gray = picture(affine, 1024, 1024, 3857).round().astype(np.uint8)
    path = write(tmp_path / "m.mbtiles", np.stack([gray] * 3), affine, 3857, driver="MBTiles", TILE_FORMAT="PNG")
    assert_same_ground(Basemap.open(path, EPSG, AREA), 0.4, tolerance=5.0)


@pytest.mark.parametrize("bounds", ["", "13.8197,48.0254,13.8224,48.0273", "13.819701,48.025402,13.822403,48.027304"])
def test_mbtiles_lie_where_their_tiles_lie_whatever_bounds_they_tell(tmp_path, bounds):
    for zoom in (17, 18):
        web_tiles(tmp_path / "xyz", zoom, tms=True)
    path = tmp_path / "m.mbtiles"
    with contextlib.closing(sqlite3.connect(path)) as file, file:
        file.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        file.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
        told = {"format": "png", "minzoom": "17", "maxzoom": "18"} | ({"bounds": bounds} if bounds else {})
        file.executemany("INSERT INTO metadata VALUES (?, ?)", told.items())
        for tile in (tmp_path / "xyz").rglob("*.png"):
            numbers = (int(part) for part in (tile.parts[-3], tile.parts[-2], tile.stem))
            file.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (*numbers, tile.read_bytes()))
    basemap = Basemap.open(path, EPSG, AREA)
    for gsd in (0.4, 1.5):
        assert_same_ground(basemap, gsd, tolerance=6.0)


def test_a_map_without_crs_is_refused(tmp_path):
    path = write(tmp_path / "m.tif", np.zeros((1, 50, 50), np.uint8), PLAIN, epsg=None)
    with pytest.raises(InputError, match="no coordinate system"):
        Basemap.open(path, EPSG, AREA)


def test_a_plain_picture_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "m.png"), np.zeros((50, 50), np.uint8))
    with pytest.raises(InputError, match="no coordinate system"):
        Basemap.open(tmp_path / "m.png", EPSG, AREA)


def test_a_map_elsewhere_is_refused_with_its_distance(gray_tif):
    with pytest.raises(InputError, match=r"does not overlap the flight, it is 9\.\d km away"):
        Basemap.open(gray_tif, EPSG, BoundingBox(*np.add(AREA, (0, 9500, 0, 9500))))


def test_a_map_on_another_continent_is_refused(gray_tif):
    there = LocalGrid(32755).to_grid(-37.8, 145.0)
    with pytest.raises(InputError, match=r"does not overlap|outside the area"):
        Basemap.open(gray_tif, 32755, BoundingBox(there[0], there[1], there[0] + 500, there[1] + 500))


def test_a_world_map_covers_any_area(tmp_path):
    affine = from_origin(-180, 90, 0.1, 0.1)
    path = write(tmp_path / "world.tif", np.full((1, 1800, 3600), 77, np.uint8), affine, 4326)
    gray, valid = Basemap.open(path, EPSG, AREA).gray(AREA, 0.5)
    assert valid.all() and (gray == 77).all()


@pytest.mark.parametrize("content", [b"", b"not a map", b"II*\x00\x08\x00\x00\x00\xff\xff"])
def test_an_unreadable_map_is_refused(tmp_path, content):
    (tmp_path / "m.tif").write_bytes(content)
    with pytest.raises(InputError, match="cannot be read as a map"):
        Basemap.open(tmp_path / "m.tif", EPSG, AREA)


def test_a_missing_map_and_an_empty_folder_are_refused(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        Basemap.open(tmp_path / "none.tif", EPSG, AREA)
    with pytest.raises(InputError, match="no map tiles"):
        Basemap.open(tmp_path, EPSG, AREA)


def test_a_truncated_map_is_one_clear_error(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (1, 2000, 2000), np.uint8)
    path = write(tmp_path / "m.tif", noise, from_origin(EAST, NORTH, 0.1, 0.1), compress="deflate", tiled=True)
    data = path.read_bytes()
    with rasterio.open(path) as src:
        assert src.profile["tiled"]
    path.write_bytes(data[: len(data) // 3])
    with pytest.raises(InputError, match=r"damaged|cannot be read"):
        Basemap.open(path, EPSG, AREA).gray(AREA, 0.1)


def noisy(path, bands=1, kind=np.uint8, **profile):
    """A map of noise over AREA and around it, so that no compression makes its blocks alike."""
    values = np.random.default_rng(0).integers(1, np.iinfo(kind).max, (bands, 1000, 1000), kind)
    return write(path, values, from_origin(EAST, NORTH, 0.2, 0.2), **profile)


STORED = [
    {"compress": "deflate", "tiled": True},
    {"compress": "lzw", "bands": 3, "interleave": "band"},
    {"bands": 3, "interleave": "pixel"},
    {"compress": "deflate", "kind": np.uint16, "tiled": True},
    {"compress": "jpeg", "tiled": True, "bands": 3, "interleave": "pixel", "photometric": "YCBCR"},
]


@pytest.mark.parametrize("stored", STORED)
def test_a_map_that_is_cut_short_is_found_before_it_is_used(tmp_path, stored):
    path = noisy(tmp_path / "m.tif", **stored)
    size = path.stat().st_size
    Basemap.open(path, EPSG, AREA).require_readable(AREA)
    with path.open("r+b") as file:
        file.truncate(int(0.6 * size))
    with pytest.raises(UnreadableMapError, match=r"copy or export it again"):
        Basemap.open(path, EPSG, AREA).require_readable(AREA)


def test_a_map_whose_reduced_pictures_alone_are_whole_is_found(tmp_path):
    path = noisy(tmp_path / "m.tif", compress="deflate", tiled=True)
    rasterio.shutil.copy(path, tmp_path / "cog.tif", driver="COG", compress="deflate")
    cog = tmp_path / "cog.tif"
    Basemap.open(cog, EPSG, AREA).require_readable(AREA)
    with cog.open("r+b") as file:
        file.truncate(int(0.6 * cog.stat().st_size))
    basemap = Basemap.open(cog, EPSG, AREA)
    assert basemap.gray(AREA, 1.0)[1].all()
    with pytest.raises(UnreadableMapError, match="cut short"):
        basemap.require_readable(AREA)


def test_damage_outside_the_area_does_not_matter(tmp_path):
    path = noisy(tmp_path / "m.tif", compress="deflate", tiled=True)
    with path.open("r+b") as file:
        file.truncate(int(0.6 * path.stat().st_size))
    north = BoundingBox(AREA[0], AREA[3] - 5, AREA[2], AREA[3])
    Basemap.open(path, EPSG, north).require_readable(north)


def test_blocks_that_were_never_written_are_found(tmp_path):
    path = noisy(tmp_path / "m.tif", compress="deflate", tiled=True)
    size = path.stat().st_size
    with path.open("r+b") as file:
        file.seek(size // 2)
        file.write(bytes(size - size // 2))
    with pytest.raises(UnreadableMapError, match="damaged"):
        Basemap.open(path, EPSG, AREA).require_readable(AREA)


@pytest.mark.parametrize("overviews", ["inside", "beside", "none"])
def test_a_whole_map_is_not_doubted(tmp_path, overviews):
    path = noisy(tmp_path / "m.tif", compress="deflate", tiled=True, SPARSE_OK=True)
    if overviews != "none":
        with rasterio.Env(TIFF_USE_OVR=overviews == "beside"), rasterio.open(path, "r+") as file:
            file.build_overviews([2, 4, 8])
    assert (tmp_path / "m.tif.ovr").exists() == (overviews == "beside")
    Basemap.open(path, EPSG, AREA).require_readable(AREA)


def test_a_palette_map_that_is_damaged_is_one_clear_error(tmp_path):
    colours = {i: (i, 255 - i, 30, 255) for i in range(256)}
    path = noisy(tmp_path / "m.tif", compress="deflate", tiled=True, colormap=colours)
    with path.open("r+b") as file:
        file.seek(path.stat().st_size // 4)
        file.write(bytes(path.stat().st_size // 2))  # its directory stands at the end
    with pytest.raises(UnreadableMapError, match="damaged"):
        Basemap.open(path, EPSG, AREA).gray(AREA, 0.5)


def test_a_copy_for_another_process_says_at_its_first_use_that_the_map_is_gone(tmp_path):
    path = noisy(tmp_path / "m.tif")
    sent = pickle.dumps(Basemap.open(path, EPSG, AREA))
    path.unlink()
    basemap = pickle.loads(sent)
    with pytest.raises(UnreadableMapError, match="cannot be read"):
        basemap.gray(AREA, 0.5)


def test_threads_and_processes_share_a_map(gray_tif):
    basemap = pickle.loads(pickle.dumps(Basemap.open(gray_tif, EPSG, AREA)))
    first = basemap.gray(AREA, 0.5)[0]
    with ThreadPoolExecutor(4) as pool:
        for gray, _ in pool.map(lambda _: basemap.gray(AREA, 0.5), range(12)):
            np.testing.assert_array_equal(gray, first)


SENTINELS = {
    "float": (np.float32, -9999.0, {}),
    "least float": (np.float32, np.finfo(np.float32).min, {}),
    "uint16": (np.uint16, 65535, {}),
    "int16": (np.int16, -32768, {}),
    "uint16, zero": (np.uint16, 0, {}),
    "white": (np.uint8, 255, {}),
    "plain grey": (np.uint8, 204, {}),
    "black, JPEG": (np.uint8, 0, {"compress": "JPEG", "tiled": True, "jpeg_quality": 70}),
    "white, JPEG": (np.uint8, 255, {"compress": "JPEG", "tiled": True, "jpeg_quality": 70}),
}


@pytest.mark.parametrize("epsg", [EPSG, 3857])
@pytest.mark.parametrize("kind", SENTINELS)
def test_empty_pixels_that_nobody_declared_are_no_ground_and_take_no_contrast(tmp_path, kind, epsg):
    dtype, empty, profile = SENTINELS[kind]
    if epsg == EPSG:
        affine = PLAIN
    else:
        (x,), (y,) = rasterio.warp.transform(f"EPSG:{EPSG}", "EPSG:3857", [EAST - 20], [NORTH + 20])
        affine = from_origin(x, y, 0.6, 0.6)
    values = picture(affine, 600, 600, epsg)
    values = (values * (20 if dtype in (np.uint16, np.int16) else 1)).astype(dtype)
    at = rasterio.warp.transform(f"EPSG:{EPSG}", f"EPSG:{epsg}", [EAST + 100.0], [NORTH - 100.0])
    column = int((at[0][0] - affine.c) / affine.a)
    values[:, :column] = empty
    basemap = Basemap.open(write(tmp_path / "m.tif", values, affine, epsg, **profile), EPSG, AREA)
    for gsd in (0.4, 1.1):
        gray, valid = basemap.gray(AREA, gsd)
        assert 0.4 < valid.mean() < 0.51
        border = valid & np.roll(~valid, 1, axis=1)
        assert gray[valid].std() > 25.0 and len(np.unique(gray[valid].round())) > 90
        want = expected(AREA, gsd)
        shown = np.corrcoef(gray[valid], want[valid])[0, 1]
        fringe = np.corrcoef(gray[border], want[border])[0, 1]
        assert shown > 0.99 and fringe > 0.9


def test_a_drawn_map_is_shown_whole_and_dark_water_is_ground(tmp_path):
    drawn = np.kron(np.random.default_rng(1).integers(1, 9, (25, 25)) * 25, np.ones((20, 20))).astype(np.uint8)
    assert Basemap.open(write(tmp_path / "d.tif", drawn, PLAIN), EPSG, AREA).gray(AREA, 0.4)[1].all()
    water = picture(PLAIN, 500, 500).round().astype(np.uint8)
    water[:, :250] = np.random.default_rng(2).integers(2, 9, (500, 250))
    assert Basemap.open(write(tmp_path / "w.tif", water, PLAIN), EPSG, AREA).gray(AREA, 0.4)[1].all()


def mbtiles_of(folder, path):
    with contextlib.closing(sqlite3.connect(path)) as file, file:
        file.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
        for tile in (t for t in folder.rglob("*") if t.is_file()):
            zoom, column, row = (int(part) for part in (tile.parts[-3], tile.parts[-2], tile.stem))
            file.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (zoom, column, 2**zoom - 1 - row, tile.read_bytes()))
    return path


def kept(folder, zoom, share):
    """Remove the tiles of a level but a share of them, those of the west."""
    columns = sorted((folder / str(zoom)).iterdir())
    for column in columns[round(share * len(columns)) :]:
        shutil.rmtree(column)


def lacking(folder, zoom, how):
    """Spoil the eastern half of a level."""
    columns = sorted((folder / str(zoom)).iterdir())
    for number, file in enumerate(f for column in columns[len(columns) // 2 :] for f in sorted(column.iterdir())):
        if how in ("placeholders", "placeholders of their own"):
            sign = np.full((256, 256, 3), 204, np.uint8)
            text = "no data yet" if how == "placeholders" else f"no tile {number}"
            cv2.putText(sign, text, (20, 120), cv2.FONT_HERSHEY_SIMPLEX, 1.0, (90, 90, 90), 2)
            cv2.imwrite(str(file), sign)
        elif how == "one colour":
            cv2.imwrite(str(file), np.full((256, 256, 3), 100 + number, np.uint8))
        elif how == "half downloads":
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        elif how == "pages":
            file.write_text(f"<html>429 {number}</html>")
        else:
            file.unlink()


@pytest.mark.parametrize("mbtiles", [False, True])
@pytest.mark.parametrize("suffix", ["jpg", *(pytest.param(s, marks=pytest.mark.slow) for s in ("png", "webp"))])
@pytest.mark.parametrize(
    "how", ["placeholders", "placeholders of their own", "one colour", "half downloads", "pages", "none"]
)
def test_what_the_finest_level_lacks_comes_from_the_others(tmp_path, how, suffix, mbtiles):
    folder = tmp_path / "xyz"
    for zoom in (18, 19):
        web_tiles(folder, zoom, suffix)
    lacking(folder, 19, how)
    path = mbtiles_of(folder, tmp_path / "m.mbtiles") if mbtiles else folder
    basemap = Basemap.open(path, EPSG, AREA)
    for gsd in (0.3, 0.8):
        assert_same_ground(basemap, gsd, tolerance=6.0)


@pytest.mark.slow
def test_a_level_that_shows_a_corner_of_the_flight_is_not_the_map(tmp_path):
    for zoom in (18, 19, 21):
        web_tiles(tmp_path, zoom)
    kept(tmp_path, 21, 0.3)
    basemap = Basemap.open(tmp_path, EPSG, AREA)
    assert basemap.native_gsd_m == pytest.approx(0.2, rel=0.02)
    for gsd in (0.1, 0.3, 0.8):
        assert_same_ground(basemap, gsd, tolerance=6.0)


def test_a_finest_level_of_another_town_is_not_the_map(tmp_path):
    web_tiles(tmp_path, 18)
    web_tiles(tmp_path, 20)
    (tmp_path / "20").rename(tmp_path / "away")
    for column in (tmp_path / "away").iterdir():
        column.rename(tmp_path / "away" / f"{int(column.name) + 4000}0")
    for column in (tmp_path / "away").iterdir():
        column.rename(tmp_path / "away" / column.name[:-1])
    (tmp_path / "away").rename(tmp_path / "20")
    assert_same_ground(Basemap.open(tmp_path, EPSG, AREA), 0.5, tolerance=6.0)


def test_a_coarse_level_whose_tiles_are_missing_is_made_of_finer_ones(tmp_path):
    for zoom in (17, 18, 19):
        web_tiles(tmp_path, zoom)
    lacking(tmp_path, 17, "none")
    lacking(tmp_path, 18, "none")
    assert_same_ground(Basemap.open(tmp_path, EPSG, AREA), 1.4, tolerance=6.0)


def test_black_around_tiles_of_jpeg_is_not_ground(tmp_path):
    web_tiles(tmp_path, 19, "jpg")
    columns = sorted((tmp_path / "19").iterdir())
    for file in columns[1].iterdir():
        tile = cv2.imread(str(file))
        tile[:, :128] = 0
        cv2.imwrite(str(file), tile)
    shutil.rmtree(columns[0])
    area = BoundingBox(EAST, NORTH - 160, EAST + 160, NORTH)
    _, valid = Basemap.open(tmp_path, EPSG, AREA).gray(area, 0.4)
    side = 2 * np.pi * 6378137.0 / 2**19
    edge = (int(columns[1].name) + 0.5) * side - 2**18 * side
    _, (y,) = rasterio.warp.transform(f"EPSG:{EPSG}", "EPSG:3857", [EAST], [NORTH - 80])
    (east,), _ = rasterio.warp.transform("EPSG:3857", f"EPSG:{EPSG}", [edge], [y])
    assert valid.mean() == pytest.approx(1 - (east - EAST) / 160, abs=0.06)


def test_a_map_of_an_ellipsoid_without_a_datum_is_refused(tmp_path):
    gray = picture(PLAIN, 500, 500).round().astype(np.uint8)
    crs = CRS.from_string("+proj=utm +zone=33 +ellps=bessel +units=m")
    with pytest.raises(InputError, match=r"m.tif: .* but no datum"):
        Basemap.open(write(tmp_path / "m.tif", gray, PLAIN, crs=crs), EPSG, AREA)


def test_tiles_of_placeholders_alone_are_refused(tmp_path):
    web_tiles(tmp_path, 18)
    sign = cv2.imencode(".png", np.random.default_rng(1).integers(0, 255, (256, 256, 3), np.uint8))[1].tobytes()
    for file in tmp_path.rglob("*.png"):
        file.write_bytes(sign)
    with pytest.raises(InputError, match="placeholders without a map"):
        Basemap.open(tmp_path, EPSG, AREA)
