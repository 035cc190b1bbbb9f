"""Exported files open elsewhere and show the same ground at the same place."""

import json
import math
import sqlite3
import zipfile
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from rasterio.warp import transform, transform_bounds

from gcs_plugin.cli.main import main
from orthoswarm.export import cog
from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.camera_folders import unique_names, write_odm
from orthoswarm.export.cog import CLASSIC_BYTES, TILE_PX, convert_cog, copy_dataset, predict, write_cog
from orthoswarm.export.product_files import iso_time, simple_lens
from orthoswarm.export.tiles.kmz import write_kmz
from orthoswarm.export.tiles.mbtiles import write_mbtiles
from orthoswarm.model.camera import Lens
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.geo import GroundGrid
from telemetry.formats.photo.picture_container import read_container

EPSG = 32632
WEST, NORTH, STEP = 465_000.0, 5_250_000.0, 0.5


class Raster:
    """A source of windows in memory."""

    def __init__(self, rgba):
        self.rgba = rgba
        self.grid = GroundGrid(epsg=EPSG, west=WEST, north=NORTH, gsd_m=STEP, width=rgba.shape[1], height=rgba.shape[0])
        self.largest = 0

    def read_reduced(self, factor, row0, row1, col0, col1):
        self.largest = max(self.largest, (row1 - row0) * (col1 - col0))
        part = self.rgba[row0 * factor : row1 * factor, col0 * factor : col1 * factor]
        out = np.zeros((row1 - row0, col1 - col0, 4), np.uint8)
        small = part[::factor, ::factor]
        out[: small.shape[0], : small.shape[1]] = small
        return out


def ground(east, north):
    """A colour for each place, 60 to 200."""
    return np.stack(
        [130 + 60 * np.sin(east / 40), 130 + 60 * np.sin(north / 50), 130 + 60 * np.cos((east + north) / 60)], -1
    )


@pytest.fixture(scope="module")
def raster():
    rows, cols = np.mgrid[:900, :1300] + 0.5
    rgba = np.dstack([ground(WEST + cols * STEP, NORTH - rows * STEP), np.full(rows.shape, 255)]).astype(np.uint8)
    rgba[(rows - 450) ** 2 + (cols - 650) ** 2 > 440**2] = 0
    return Raster(rgba)


@pytest.fixture(scope="module")
def ortho(raster, tmp_path_factory):
    path = tmp_path_factory.mktemp("ortho") / "orthoimage.tif"
    write_cog(raster, path)
    return path


@pytest.mark.parametrize(("limit", "head"), [(CLASSIC_BYTES, 8), (1, 16)], ids=["classic", "BigTIFF"])
def test_a_cog_is_laid_out_as_gdals_validator_wants_it(raster, tmp_path, limit, head):
    """By validate_cloud_optimized_geotiff.py: directories by size right after the header, small levels' tiles first."""
    write_cog(raster, tmp_path / "o.tif", classic_bytes=limit)
    data = (tmp_path / "o.tif").read_bytes()
    name = b"GDAL_STRUCTURAL_METADATA_SIZE="
    due = head + len(name + b"000000 bytes\n") + int(data[head + len(name) :][:6])
    assert data[head:].startswith(name)
    with rasterio.open(tmp_path / "o.tif") as image:
        levels = [None, *range(len(image.overviews(1)))]
        item = {
            kind: [image.get_tag_item(kind, "TIFF", bidx=1, ovr=k) for k in levels]
            for kind in ("IFD_OFFSET", "BLOCK_OFFSET_0_0")
        }
    directories, tiles = (list(map(int, values)) for values in item.values())
    assert directories[0] == due + due % 2 and directories == sorted(directories)
    assert tiles == sorted(tiles, reverse=True) and directories[-1] < tiles[-1]


def test_a_cog_holds_the_pixels_and_its_overviews(raster, ortho):
    with rasterio.open(ortho) as image:
        assert image.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert image.overviews(1) == [2, 4] and image.crs.to_epsg() == EPSG
        assert image.bounds == pytest.approx(raster.grid.bounds)
        np.testing.assert_array_equal(image.read().transpose(1, 2, 0), raster.rgba)
        assert [c.name for c in image.colorinterp] == ["red", "green", "blue", "alpha"]
    with rasterio.open(ortho, OVERVIEW_LEVEL=1) as image:
        np.testing.assert_array_equal(image.read().transpose(1, 2, 0), raster.rgba[::4, ::4])
    assert raster.largest <= TILE_PX**2


@pytest.mark.parametrize(("limit", "version"), [(CLASSIC_BYTES, 42), (1, 43)])
def test_a_picture_is_a_classic_tiff_unless_it_may_be_too_large(raster, tmp_path, limit, version):
    path = tmp_path / "o.tif"
    write_cog(raster, path, classic_bytes=limit)
    data = path.read_bytes()
    assert data[:4] == bytes([73, 73, version, 0])
    with rasterio.open(path) as image:
        assert image.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        np.testing.assert_array_equal(image.read().transpose(1, 2, 0), raster.rgba)
        places = [int(image.get_tag_item(f"BLOCK_OFFSET_{c}_1", "TIFF", bidx=1)) for c in range(3)]
        assert places == sorted(places) and max(places) < len(data)
        assert image.crs.to_epsg() == EPSG and image.bounds == pytest.approx(raster.grid.bounds)
    if version == 42:  # as software reads it that knows nothing of maps
        with Image.open(path) as image:
            np.testing.assert_array_equal(np.asarray(image), raster.rgba)
    assert read_container(path).georeferenced  # a map, not a photo, where it lies among photos


def test_a_city_is_a_classic_tiff_and_a_county_is_not():
    assert cog._form_of(cog._levels(16_000, 14_000), CLASSIC_BYTES) is cog._CLASSIC
    assert cog._form_of(cog._levels(60_000, 50_000), CLASSIC_BYTES) is cog._BIG
    noise = np.random.default_rng(0).integers(0, 256, (TILE_PX, TILE_PX, 4), np.uint8)
    noise[..., 3] = np.maximum(noise[..., 3], 1)
    assert len(cog._deflate(noise)) + 8 < cog._WORST_TILE


def test_a_cog_of_a_window(raster, tmp_path):
    write_cog(raster, tmp_path / "w.tif", window=(512, 900, 0, 700))
    with rasterio.open(tmp_path / "w.tif") as image:
        assert (image.transform.c, image.transform.f) == (WEST, NORTH - 512 * STEP)
        np.testing.assert_array_equal(image.read().transpose(1, 2, 0), raster.rgba[512:900, :700])


def test_transparent_tiles_take_no_room(tmp_path):
    rgba = np.zeros((4096, 4096, 4), np.uint8)
    rgba[:5, :5] = 255
    write_cog(Raster(rgba), tmp_path / "s.tif")
    assert (tmp_path / "s.tif").stat().st_size < 40_000
    with rasterio.open(tmp_path / "s.tif") as image:
        assert image.read(4).sum() == 25 * 255


def test_differences_are_taken_channel_by_channel():
    rng = np.random.default_rng(3)
    for columns in (1, 2, 7, 64):
        tile = rng.integers(0, 256, (5, columns, 4), np.uint8)
        tile[rng.random((5, columns)) < 0.3, 3] = 0
        differences = np.empty((5, columns), np.uint32)
        assert predict(tile.view(np.uint32)[..., 0], differences) == tile[..., 3].any()
        summed = np.cumsum(differences.view(np.uint8).reshape(tile.shape), axis=1, dtype=np.uint8)
        assert np.array_equal(summed, np.where(tile[..., 3:] > 0, tile, 0))
    assert not predict(np.full((3, 4), 0x00FFFFFF, np.uint32), np.empty((3, 4), np.uint32))


def test_a_single_pixel_and_a_long_strip(tmp_path):
    for i, shape in enumerate([(1, 1), (3, 1100)]):
        write_cog(Raster(np.full((*shape, 4), 255, np.uint8)), tmp_path / f"{i}.tif")
        with rasterio.open(tmp_path / f"{i}.tif") as image:
            assert image.shape == shape and (image.read() == 255).all()


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "x.bin"
    path.write_bytes(b"old")
    with pytest.raises(OrthoSwarmError, match="disk is full"), atomic_write(path) as part:
        part.write_bytes(b"half")
        raise OSError(28, "No space left on device")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def colours_at(picture, affine, epsg, places):
    x, y = transform(f"EPSG:{EPSG}", f"EPSG:{epsg}", places[:, 0], places[:, 1])
    col = np.floor((np.array(x) - affine.c) / affine.a).astype(int)
    row = np.floor((np.array(y) - affine.f) / affine.e).astype(int)
    return picture[row, col]


PLACES = np.column_stack([WEST + 325 + np.array([-150, 0, 90, 150, 0]), NORTH - 225 + np.array([0, 150, -60, 0, -150])])


@pytest.mark.parametrize("kind", ["png", "webp", "jpg"])
def test_mbtiles_open_and_show_the_ground(ortho, tmp_path, kind):
    path = tmp_path / "m.mbtiles"
    seen = []
    write_mbtiles(ortho, path, tile_format=kind, progress=lambda done, total: seen.append((done, total)))
    with rasterio.open(path) as image:
        assert image.res[0] * math.cos(math.radians(47.4)) == pytest.approx(STEP, rel=0.4)
        rgba = image.read().transpose(1, 2, 0)
        found = colours_at(rgba, image.transform, 3857, PLACES)
        corner = np.array([image.transform.c, image.transform.f]) / image.res[0]
        assert corner == pytest.approx(corner.round(), abs=1e-3)  # on whole pixels: else GDAL shows it shifted
    assert np.abs(found[:, :3] - ground(*PLACES.T)).max() < (12 if kind == "png" else 20)
    database = sqlite3.connect(path)
    meta = dict(database.execute("SELECT name, value FROM metadata"))
    west, south, east, north = (float(v) for v in meta["bounds"].split(","))
    grid = (WEST, NORTH - 450, WEST + 650, NORTH)
    assert (west, south, east, north) == pytest.approx(transform_bounds(f"EPSG:{EPSG}", "EPSG:4326", *grid), abs=1e-5)
    zooms = [z for (z,) in database.execute("SELECT DISTINCT zoom_level FROM tiles ORDER BY 1")]
    assert zooms == list(range(int(meta["minzoom"]), int(meta["maxzoom"]) + 1)) and meta["format"] == kind
    assert database.execute("SELECT COUNT(*) FROM tiles WHERE zoom_level=?", (zooms[0],)).fetchone() == (1,)
    database.close()
    assert seen[-1][0] == seen[-1][1]


def overlays(path):
    """(box, RGBA) of every ground overlay in a KMZ, found by following its links from doc.kml."""
    space = "{http://www.opengis.net/kml/2.2}"
    out = []
    with zipfile.ZipFile(path) as archive:
        todo = ["doc.kml"]
        while todo:
            name = todo.pop()
            folder = name.rpartition("/")[0]
            root = ElementTree.fromstring(archive.read(name))
            for link in root.iter(f"{space}NetworkLink"):
                todo.append(_join(folder, link.find(f"{space}Link/{space}href").text))
            for overlay in root.iter(f"{space}GroundOverlay"):
                box = {e.tag.removeprefix(space): float(e.text) for e in overlay.find(f"{space}LatLonBox")}
                data = archive.read(_join(folder, overlay.find(f"{space}Icon/{space}href").text))
                out.append((name, box, cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)))
    return out


def _join(folder, href):
    parts = folder.split("/") if folder else []
    for part in href.split("/"):
        parts = parts[:-1] if part == ".." else [*parts, part]
    return "/".join(parts)


def colour_in(overlay, place):
    _, box, bgra = overlay
    (lon,), (lat,) = transform(f"EPSG:{EPSG}", "EPSG:4326", [place[0]], [place[1]])
    col = (lon - box["west"]) / (box["east"] - box["west"]) * bgra.shape[1]
    row = (box["north"] - lat) / (box["north"] - box["south"]) * bgra.shape[0]
    if not (0 <= col < bgra.shape[1] and 0 <= row < bgra.shape[0]):
        return None
    pixel = bgra[int(row), int(col)]
    return None if len(pixel) == 4 and pixel[3] == 0 else pixel[2::-1].astype(float)


def middle_of_pixel(overlay, place):
    """Grid coordinates of the middle of the overlay's pixel at a place: a coarse pixel is some metres wide."""
    _, box, bgra = overlay
    (lon,), (lat,) = transform(f"EPSG:{EPSG}", "EPSG:4326", [place[0]], [place[1]])
    wide, high = (box["east"] - box["west"]) / bgra.shape[1], (box["north"] - box["south"]) / bgra.shape[0]
    lon = box["west"] + wide * (int((lon - box["west"]) / wide) + 0.5)
    lat = box["north"] - high * (int((box["north"] - lat) / high) + 0.5)
    (east,), (north,) = transform("EPSG:4326", f"EPSG:{EPSG}", [lon], [lat])
    return east, north


@pytest.mark.parametrize("limit", [CLASSIC_BYTES, 0])
def test_the_date_of_the_flight_stands_in_the_tags_and_nothing_else_changes(raster, tmp_path, limit):
    write_cog(raster, tmp_path / "dated.tif", classic_bytes=limit, time_s=1_779_999_999.5)
    write_cog(raster, tmp_path / "plain.tif", classic_bytes=limit)
    convert_cog(tmp_path / "dated.tif", tmp_path / "copy.tif")
    convert_cog(tmp_path / "dated.tif", tmp_path / "warped.tif", epsg=EPSG + 1)
    for name in ("dated.tif", "copy.tif", "warped.tif"):
        with rasterio.open(tmp_path / name) as image:
            assert image.tags()["TIFFTAG_DATETIME"] == "2026:05:28 20:26:39"
    with rasterio.open(tmp_path / "dated.tif") as dated, rasterio.open(tmp_path / "plain.tif") as plain:
        assert "TIFFTAG_DATETIME" not in plain.tags()
        assert dated.tags(ns="IMAGE_STRUCTURE") == plain.tags(ns="IMAGE_STRUCTURE")
        assert dated.profile == plain.profile and dated.overviews(1) == plain.overviews(1)
        np.testing.assert_array_equal(dated.read(), plain.read())


def test_a_small_kmz_is_one_overlay(ortho, tmp_path):
    write_kmz(ortho, tmp_path / "m.kmz")
    (overlay,) = overlays(tmp_path / "m.kmz")
    for place in PLACES:
        assert np.abs(colour_in(overlay, place) - ground(*place)).max() < 12


def test_a_large_kmz_is_a_pyramid(tmp_path):
    rows, cols = np.mgrid[:1800, :2600] + 0.5
    rgba = np.dstack([ground(WEST + cols * STEP, NORTH - rows * STEP), np.full(rows.shape, 255)]).astype(np.uint8)
    rgba[:600, :600] = 0
    write_cog(Raster(rgba), tmp_path / "o.tif")
    write_kmz(tmp_path / "o.tif", tmp_path / "m.kmz")
    found = overlays(tmp_path / "m.kmz")
    by_level = {}
    for overlay in found:
        by_level.setdefault(overlay[0].split("/")[0], []).append(overlay)
    assert len(by_level) >= 3 and len(by_level["0"]) <= 4
    place = np.array([WEST + 700.0, NORTH - 500.0])
    for overlays_there in by_level.values():
        colours = [(o, c) for o, c in ((o, colour_in(o, place)) for o in overlays_there) if c is not None]
        ((overlay, colour),) = colours
        assert np.abs(colour - ground(*middle_of_pixel(overlay, place))).max() < 8
        assert all(colour_in(o, (WEST + 100, NORTH - 100)) is None for o in overlays_there)


def test_a_cog_in_another_system_and_as_jpeg(ortho, tmp_path):
    convert_cog(ortho, tmp_path / "w.tif", epsg=3857)
    convert_cog(ortho, tmp_path / "j.tif", jpeg_quality=85)
    with rasterio.open(tmp_path / "w.tif") as image:
        assert image.crs.to_epsg() == 3857 and image.tags()["TIFFTAG_SOFTWARE"].startswith("OrthoSwarm")
        assert image.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        found = colours_at(image.read().transpose(1, 2, 0), image.transform, 3857, PLACES)
        assert np.abs(found[:, :3] - ground(*PLACES.T)).max() < 12
    with rasterio.open(tmp_path / "j.tif") as image:
        assert image.profile["compress"] == "jpeg" and image.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert image.dataset_mask()[0, 0] == 0
    assert (tmp_path / "j.tif").stat().st_size < 0.5 * ortho.stat().st_size


@pytest.mark.parametrize(
    ("epsg", "why"),
    [
        (999_999, "check --epsg"), (4978, "no system for maps"), (5703, "no system for maps"),
        (4807, "no system for maps"), (2193, "not used where"), (32_655, "not used where"), (3031, "not used where"),
    ],
)  # fmt: skip
def test_a_system_that_a_map_cannot_be_written_in_is_refused(ortho, tmp_path, epsg, why):
    with pytest.raises(InputError, match=why):
        convert_cog(ortho, tmp_path / "n.tif", epsg=epsg)
    assert not list(tmp_path.glob("n.tif*"))


def test_what_is_uncertain_about_a_system_is_told(ortho, tmp_path):
    assert convert_cog(ortho, tmp_path / "a.tif", epsg=31468) == (
        "places in EPSG:31468 are good to 3 m (no better table is here)"
    )
    assert convert_cog(ortho, tmp_path / "b.tif", epsg=25832) == ""


def test_what_gdal_cannot_write_is_an_error_of_the_system(ortho, tmp_path):
    with rasterio.open(ortho) as image, pytest.raises(OSError, match="gone"):
        copy_dataset(image, tmp_path / "gone" / "o.tif", driver="COG")


def row(image, **more):
    camera = {"lat_deg": 47.4, "lon_deg": 8.5, "height_m": 80.0, "yaw_deg": 12.0, "pitch_deg": -85.0, "roll_deg": 1.0}
    return {"image": image, "stage": "fine", "sigma_m": 0.25, "camera": camera | more}


def test_odm_gets_pictures_and_positions(tmp_path):
    for name in ("a/x y.JPG", "b/x y.JPG"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(name.encode())
    rows = [
        row("a/x y.JPG"),
        row("b/x y.JPG", altitude_m=512.5),
        row("c/gone.jpg"),
        {"image": "q", "stage": "rejected"},
    ]

    def find(one):
        path = tmp_path / one["image"]
        return path if path.exists() else None

    assert write_odm(rows, find, tmp_path / "odm") == ["c/gone.jpg"]
    lines = (tmp_path / "odm" / "geo.txt").read_text().splitlines()
    assert lines[0] == "EPSG:4326" and len(lines) == 3
    name, lon, lat, z, yaw, pitch, roll, *accuracy = lines[2].split()
    assert (tmp_path / "odm" / "images" / name).read_bytes() == b"b/x y.JPG"
    assert [float(v) for v in (lon, lat, z, yaw, pitch, roll)] == [8.5, 47.4, 512.5, 12.0, 5.0, 1.0]
    assert [float(v) for v in accuracy] == [0.25, 0.5]
    with pytest.raises(InputError, match="--images"):
        write_odm([row("c/gone.jpg")], find, tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_names_for_odm_are_plain_and_different():
    names = unique_names(["a/1.jpg", "a_1.jpg", "b/1.jpg", "v.mp4#000001"])
    assert len(set(names)) == 4
    assert all("/" not in n and " " not in n and "#" not in n for n in names)
    assert names[-1].endswith(".jpg")


@given(st.lists(st.text(st.sampled_from("ab_2./ x"), max_size=300), max_size=8))
def test_each_picture_for_odm_has_a_name_of_its_own_that_a_disk_takes(images):
    names = unique_names(images)
    assert len({name.lower() for name in names}) == len(images)
    assert all(len(name) < 200 for name in names)


def test_a_fuller_lens_is_stated_in_the_simple_form():
    lens = Lens(1600, 1300, 1913.0, k1=-0.42, k2=0.27, k3=-0.1, cx=14.0, cy=-9.0)
    simple, matrix = simple_lens(lens)
    assert (simple.cx, simple.cy, simple.k3) == (0, 0, 0) and simple.focal_px == lens.focal_px
    pixels = np.array([[0.0, 0], [1599, 1299], [800, 650], [300, 1200], [1599, 0]])
    xy = simple.undistort((pixels - np.array(simple.principal_point)) / simple.focal_px)
    moved = np.c_[xy, np.ones(5)] @ matrix.T
    wanted = lens.undistort((pixels - np.array(lens.principal_point)) / lens.focal_px)
    error_px = np.hypot(*(moved[:, :2] / moved[:, 2:] - wanted).T) * lens.focal_px
    assert error_px.max() < 2.0 and error_px[2] < 0.7  # 14 px off, and a third radial term, without it


def test_times_are_iso():
    assert iso_time(1_700_000_000.25) == "2023-11-14T22:13:20.250Z"
    assert iso_time(None) is None and iso_time(1e30) is None


@pytest.fixture
def out(ortho, tmp_path):
    folder = tmp_path / "map"
    folder.mkdir()
    (folder / "orthoimage.tif").write_bytes(ortho.read_bytes())
    (folder / "footprints.gpkg").write_bytes(b"polygons")
    return folder


def test_the_command_exports_several_formats(out, capsys):
    assert main(["export", str(out), "--to", "mbtiles", "kmz", "gpkg", "cog", "--json"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert set(files) == {"mbtiles", "kmz", "gpkg", "cog"}
    assert {p.name for p in (out / "export").iterdir()} == {
        "orthoimage.mbtiles", "orthoimage.kmz", "footprints.gpkg", "orthoimage.tif",
    }  # fmt: skip


def test_the_command_says_what_is_missing(out, capsys, tmp_path):
    assert main(["export", str(out), "--to", "odm"]) == 2
    assert "frames.jsonl" in capsys.readouterr().err
    assert main(["export", str(out), "--to", "kmz", "--layer", "coarse"]) == 2
    assert main(["export", str(tmp_path / "nothing"), "--to", "kmz"]) == 2
    assert main(["export", str(out), "--to", "shapefile"]) == 2
