"""Maps on the meridian of 180 degrees: every form shows the ground on both sides of it."""

import json
import math
import sqlite3
import zipfile
from contextlib import closing
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import rasterio
import shapely
from rasterio.warp import transform

from gcs_plugin.cli.main import main
from orthoswarm.export.sheets.stac_item import joined_bbox, outline

EPSG, GSD = 32760, 0.5
KML = "{http://www.opengis.net/kml/2.2}"


def ground(east, north):
    """A colour for each place, 60 to 200."""
    return np.stack([130 + 60 * np.sin(east / 40), 130 + 60 * np.sin(north / 50), 130 + 60 * np.cos(east / 60)], -1)


def make(folder, rows, cols):
    """A map's folder with an orthoimage whose middle is on the meridian; places on both sides of it, on the grid."""
    folder.mkdir(parents=True)
    (x,), (y,) = transform("EPSG:4326", f"EPSG:{EPSG}", [180.0], [-17.0])
    west, north = x - cols * GSD / 2, y + rows * GSD / 2
    r, c = np.mgrid[:rows, :cols] + 0.5
    rgba = np.dstack([ground(west + c * GSD, north - r * GSD), np.full(r.shape, 255)]).astype(np.uint8)
    profile = {"driver": "GTiff", "width": cols, "height": rows, "count": 4, "dtype": "uint8", "crs": f"EPSG:{EPSG}"}
    at = rasterio.transform.from_origin(west, north, GSD, GSD)
    with rasterio.open(folder / "orthoimage.tif", "w", **profile, transform=at) as raster:
        raster.write(rgba.transpose(2, 0, 1))
        raster.colorinterp = [rasterio.enums.ColorInterp[name] for name in ("red", "green", "blue", "alpha")]
    (folder / "report.json").write_text(json.dumps({"legs": []}))
    (folder / "frames.jsonl").write_text("")
    return np.array([[x + dx, y + dy] for dx in (-cols / 5, -20.0, 20.0, cols / 5) for dy in (-40.0, 40.0)])


@pytest.fixture
def small(tmp_path):
    return tmp_path / "map", make(tmp_path / "map", 400, 600)


def geographic(places):
    lon, lat = transform(f"EPSG:{EPSG}", "EPSG:4326", *places.T)
    return np.stack([lon, lat], 1)


def test_web_tiles_show_both_sides(small):
    folder, places = small
    assert main(["export", str(folder), "--to", "mbtiles", "pmtiles"]) == 0
    with closing(sqlite3.connect(folder / "export" / "orthoimage.mbtiles")) as database:
        about = dict(database.execute("SELECT name, value FROM metadata"))
        tiles = {
            (z, x, 2**z - 1 - y): data
            for z, x, y, data in database.execute("SELECT zoom_level, tile_column, tile_row, tile_data FROM tiles")
        }
    assert all(0 <= x < 2**z for z, x, _ in tiles) and {x for z, x, _ in tiles if z == 1} == {0, 1}
    zoom = int(about["maxzoom"])
    for place, (lon, lat) in zip(places, geographic(places), strict=True):
        x = (lon + 180) / 360 * 2**zoom
        y = (1 - math.asinh(math.tan(math.radians(lat))) / math.pi) / 2 * 2**zoom
        tile = cv2.imdecode(np.frombuffer(tiles[zoom, int(x), int(y)], np.uint8), cv2.IMREAD_UNCHANGED)
        assert np.abs(tile[int(y % 1 * 256), int(x % 1 * 256), 2::-1] - ground(*place)).max() < 12
    bounds = [float(v) for v in about["bounds"].split(",")]
    assert bounds[0] == -180 and bounds[2] == 180 and -17.01 < bounds[1] < bounds[3] < -16.99
    assert abs(float(about["center"].split(",")[0])) == pytest.approx(180.0, abs=1e-3)
    assert (folder / "export" / "orthoimage.pmtiles").stat().st_size > 10_000


def _overlays(archive, name="doc.kml"):
    folder = name.rpartition("/")[0]
    root = ElementTree.fromstring(archive.read(name))
    for link in root.iter(f"{KML}NetworkLink"):
        href = link.find(f"{KML}Link/{KML}href").text
        yield from _overlays(archive, href.removeprefix("../../"))
    for overlay in root.iter(f"{KML}GroundOverlay"):
        box = {e.tag.removeprefix(KML): float(e.text) for e in overlay.find(f"{KML}LatLonBox")}
        image = f"{folder}/{overlay.find(f'{KML}Icon/{KML}href').text}".lstrip("/")
        yield name, box, cv2.imdecode(np.frombuffer(archive.read(image), np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize(("rows", "cols"), [(400, 600), (1200, 3000)])
def test_a_kmz_shows_both_sides(tmp_path, rows, cols):
    places = make(tmp_path / "map", rows, cols)
    assert main(["export", str(tmp_path / "map"), "--to", "kmz"]) == 0
    with zipfile.ZipFile(tmp_path / "map" / "export" / "orthoimage.kmz") as archive:
        found = list(_overlays(archive))
    assert all(-180 <= box["west"] < box["east"] <= 180 for _, box, _ in found)
    for place, (lon, lat) in zip(places, geographic(places), strict=True):
        over = [o for o in found if o[1]["west"] <= lon < o[1]["east"] and o[1]["south"] < lat < o[1]["north"]]
        _, box, image = min(over, key=lambda o: o[1]["east"] - o[1]["west"])
        column = int((lon - box["west"]) / (box["east"] - box["west"]) * image.shape[1])
        row = int((box["north"] - lat) / (box["north"] - box["south"]) * image.shape[0])
        assert np.abs(image[row, column, 2::-1] - ground(*place)).max() < 12


def test_the_pack_and_its_page_hold_both_sides(small):
    folder, _ = small
    assert main(["export", str(folder), "--to", "pack"]) == 0
    with zipfile.ZipFile(folder / "export" / "map-map.zip") as archive:
        page = archive.read("map-map/index.html").decode()
        names = archive.namelist()
    west, _, east, _ = json.loads(page.split('"bounds": ')[1].split("]")[0] + "]")
    assert 179 < west < 180 < east < 181
    assert {name.split("/")[3] for name in names if name.startswith("map-map/tiles/1/")} == {"0", "1"}


def test_a_stac_item_is_cut_at_the_meridian(small):
    folder, places = small
    assert main(["export", str(folder), "--to", "stac"]) == 0
    item = json.loads((folder / "orthoimage.stac.json").read_text())
    west, south, east, north = item["bbox"]
    assert 179 < west < 180 and -180 < east < -179 and south < north
    assert item["geometry"]["type"] == "MultiPolygon"
    shape = shapely.geometry.shape(item["geometry"])
    assert shape.is_valid and all(shape.contains(shapely.Point(at)) for at in geographic(places))
    assert shape.area == pytest.approx((east + 360 - west) * (north - south), rel=0.1)
    assert all(shapely.is_ccw(part.exterior) for part in shape.geoms)


def test_outlines_elsewhere_are_polygons_and_boxes_are_joined():
    ring = [[10.0, 5.0], [11.0, 5.0], [11.0, 6.0], [10.0, 6.0]]
    plain = outline(ring)
    assert plain["geometry"]["type"] == "Polygon" and plain["bbox"] == [5.0, 10.0, 6.0, 11.0]
    (points,) = plain["geometry"]["coordinates"]
    assert points[0] == points[-1] and shapely.is_ccw(shapely.LinearRing(points))
    assert joined_bbox([[5.0, 1.0, 6.0, 2.0], [-3.0, 0.0, 5.5, 1.0]]) == [-3.0, 0.0, 6.0, 2.0]
    assert joined_bbox([[179.0, 1.0, 180.0, 2.0], [-180.0, 0.0, -179.0, 1.0]]) == [179.0, 0.0, -179.0, 2.0]
    assert joined_bbox([[-180.0, 0.0, -179.5, 1.0], [179.5, 1.0, -179.9, 2.0]]) == [179.5, 0.0, -179.5, 2.0]


def test_a_map_that_shows_nothing_makes_no_tiles(small, capsys):
    folder, _ = small
    with rasterio.open(folder / "orthoimage.tif", "r+") as raster:
        raster.write(np.zeros((4, 400, 600), np.uint8))
    for kind in ("mbtiles", "kmz", "pmtiles"):
        assert main(["export", str(folder), "--to", kind]) == 1
        assert "shows nothing" in capsys.readouterr().err
    assert not [path for path in (folder / "export").glob("*") if path.suffix in (".mbtiles", ".kmz", ".pmtiles")]
