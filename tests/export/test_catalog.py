"""A map in tiles: the pixels of the one file, a valid STAC collection, and one raster for QGIS and GDAL."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from pyproj import Transformer

from gcs_plugin.cli.main import main
from orthoswarm.export.catalog import tiled_raster
from orthoswarm.export.catalog.stac_collection import write_collection
from orthoswarm.export.catalog.tiled_raster import in_tiles, product_file, write_tiled
from orthoswarm.export.product_files import iso_time, write_frames
from orthoswarm.export.value_raster import write_surface
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import LocalGrid
from orthoswarm.stereo.surface_cells import SurfaceModel
from tests.kit import mosaic_scene
from tests.kit.scene import Scene, legs

RASTERS = ("realtime", "coarse", "orthoimage")


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """The same map as one file a raster and in tiles of 512 pixels."""
    top = tmp_path_factory.mktemp("tiled")
    scene = Scene()
    for vehicle in ("a", "b c"):
        scene.fly(top / "photos" / vehicle, legs(count=2, photos=5))
    basemap = scene.basemap(top / "before.tif")
    with pytest.MonkeyPatch.context() as smaller:
        smaller.setattr(tiled_raster, "_TILE_PX", 512)
        for name, how in (("one", "no"), ("tiled", "yes")):
            asked = ["--gsd", "0.15", "--workers", "1", "--tiles", how, "--out", str(top / name)]
            assert main(["mosaic", str(top / "photos"), "--basemap", str(basemap), *asked]) == 0
        yield top


def documents(folder):
    return {path.relative_to(folder): json.loads(path.read_text()) for path in (folder / "tiles").rglob("*.json")}


@pytest.mark.parametrize("name", RASTERS)
def test_tiles_have_the_pixels_of_the_one_file(maps, name):
    folder = maps / "tiled"
    assert not (folder / f"{name}.tif").exists() and not (maps / "one" / "tiles").exists()
    tiles = sorted((folder / "tiles" / name).glob("*.tif"))
    with rasterio.open(maps / "one" / f"{name}.tif") as one, rasterio.open(product_file(folder, f"{name}.tif")) as all_:
        assert len(tiles) > 1 and (all_.shape, all_.transform, all_.crs) == (one.shape, one.transform, one.crs)
        assert np.array_equal(all_.read(), one.read())
        assert [i.name for i in all_.colorinterp] == [i.name for i in one.colorinterp]
        for tile in tiles:
            with rasterio.open(tile) as part:
                window = rasterio.windows.from_bounds(*part.bounds, one.transform).round_offsets().round_lengths()
                assert np.array_equal(part.read(), one.read(window=window))


def test_other_products_are_the_same(maps):
    assert (maps / "one" / "frames.jsonl").read_bytes() == (maps / "tiled" / "frames.jsonl").read_bytes()
    report = json.loads((maps / "tiled" / "report.json").read_text())
    assert report["tiles"]["orthoimage.tif"] == len(list((maps / "tiled" / "tiles" / "orthoimage").glob("*.tif")))
    assert "tiles" not in json.loads((maps / "one" / "report.json").read_text())


def test_the_collection_has_an_item_for_each_tile_and_vehicle(maps):
    found = documents(maps / "tiled")
    collection = found.pop(Path("tiles/collection.json"))
    tiles = sorted((maps / "tiled" / "tiles").rglob("*.tif"))
    vehicles = [d for d in found.values() if "orthoswarm:vehicle" in d["properties"]]
    assert {d["properties"]["orthoswarm:vehicle"] for d in vehicles} == {"a", "b c"} and len(found) == len(tiles) + 2
    assert [d["properties"]["orthoswarm:pictures"] for d in vehicles] == [10, 10]
    schema = json.loads(Path(__file__).with_name("stac_item.schema.json").read_text())
    linked = [(maps / "tiled" / "tiles" / k["href"]).resolve() for k in collection["links"] if k["rel"] == "item"]
    assert sorted(linked) == sorted((maps / "tiled" / where).resolve() for where in found)
    west, south, east, north = collection["extent"]["spatial"]["bbox"][0]
    for where, item in found.items():
        here = (maps / "tiled" / where).parent
        for each in (*item["assets"].values(), *item["links"]):
            assert (here / each["href"]).is_file(), each
        assert west <= item["bbox"][0] < item["bbox"][2] <= east and south <= item["bbox"][1] < item["bbox"][3] <= north
        times = item["properties"]["start_datetime"], item["properties"]["end_datetime"]
        assert "2023-11-14T22:13:20.000Z" <= times[0] < times[1] <= "2023-11-14T22:13:56.000Z"
        if "proj:code" in item["properties"]:
            jsonschema.validate(item, schema)  # of a raster's item
            (asset,) = item["assets"].values()
            with rasterio.open(here / asset["href"]) as raster:
                assert asset["proj:shape"] == list(raster.shape) and asset["proj:transform"] == list(raster.transform)
    for asset in collection["assets"].values():
        assert (maps / "tiled" / "tiles" / asset["href"]).is_file()


class Painted:
    """A source of windows, all of one colour."""

    def __init__(self, grid):
        self.grid = grid

    def read_reduced(self, factor, row0, row1, col0, col1):
        return np.full((row1 - row0, col1 - col0, 4), 255, np.uint8)


def test_vehicles_and_times_are_those_of_the_footprints(tmp_path, monkeypatch):
    monkeypatch.setattr(tiled_raster, "_TILE_PX", 512)
    level = 2.0
    flight = mosaic_scene.survey(0, lens=mosaic_scene.small_lens(k1=-0.05))
    placed = [replace(p, frame=replace(p.frame, time_s=1e9 + k)) for k, p in enumerate(flight.frames)]
    grid = mosaic_scene.grid(320.0, 0.25)
    drawn, window = [BoundingBox(*grid.bounds)], (0, grid.height, 0, grid.width)
    write_tiled(Painted(grid), tmp_path, "orthoimage.tif", window=window, drawn=drawn)
    write_frames(tmp_path, placed, [], LocalGrid(grid.epsg), level)
    (tmp_path / "report.json").write_text(json.dumps({"ground_z_m": level, "surface": {"file": "dsm.tif"}}))
    cells = np.ones((4, 4), np.float32)
    write_surface(
        tmp_path / "dsm.tif", SurfaceModel(mosaic_scene.grid(4.0), cells, cells, cells.astype(np.uint8)), None
    )
    assert write_collection(tmp_path, "2026-01-01T00:00:00Z") > 5
    assert documents(tmp_path)[Path("tiles/collection.json")]["assets"]["surface"]["href"] == "../dsm.tif"
    meta, _, shapes, fields = pyogrio.raw.read(tmp_path / "footprints.gpkg")
    values, seen = dict(zip(meta["fields"], fields, strict=True)), shapely.from_wkb(shapes)
    to_degrees = Transformer.from_crs(meta["crs"], 4326, always_xy=True)
    items = [d["properties"] | d for d in documents(tmp_path).values() if "properties" in d]
    for item in [i for i in items if "orthoswarm:vehicle" in i]:
        own = seen[values["vehicle"] == item["orthoswarm:vehicle"]]
        hull = shapely.transform(shapely.convex_hull(shapely.union_all(own)), to_degrees.transform, interleaved=False)
        assert len(own) and shapely.hausdorff_distance(shapely.geometry.shape(item["geometry"]), hull) < 1e-7  # 1 cm
    times = dict(zip(values["image"], (iso_time(p.frame.time_s) for p in placed), strict=True))
    for item in [i for i in items if "proj:code" in i]:
        ((step, _, west, _, _, north, *_), (rows, cols)) = (
            item["assets"]["orthoimage"][k] for k in ("proj:transform", "proj:shape")
        )
        tile = shapely.box(west, north - rows * step, west + cols * step, north)
        over = [times[name] for name, s in zip(values["image"], seen, strict=True) if tile.intersects(s.envelope)]
        assert (item["start_datetime"], item["end_datetime"]) == (min(over), max(over))


def test_pystac_reads_and_validates_the_collection(maps):
    pystac = pytest.importorskip("pystac", reason="needs the package pystac-core")
    collection = pystac.Collection.from_file(str(maps / "tiled" / "tiles" / "collection.json"))
    items = list(collection.get_items())
    assert len(items) == len(documents(maps / "tiled")) - 1 and collection.get_root() is collection
    for each in (collection, *items):
        each.stac_extensions = []  # their schemas are on the web; the item's own schema above has their fields
        assert each.validate()


def test_gdal_builds_one_raster_of_the_tiles(maps, tmp_path):
    if shutil.which("gdalbuildvrt") is None:
        pytest.skip("needs GDAL's programs (gdalbuildvrt)")
    tiles = sorted(map(str, (maps / "tiled" / "tiles" / "orthoimage").glob("*.tif")))
    done = subprocess.run(["gdalbuildvrt", tmp_path / "all.vrt", *tiles], capture_output=True, text=True, check=True)
    assert "Warning" not in done.stderr
    with rasterio.open(tmp_path / "all.vrt") as built, rasterio.open(maps / "tiled" / "orthoimage.vrt") as own:
        inside = rasterio.windows.from_bounds(*built.bounds, own.transform).round_offsets().round_lengths()
        assert np.array_equal(built.read(), own.read(window=inside))


def test_other_verbs_open_the_map_in_tiles(maps, tmp_path, capsys):
    folder = maps / "tiled"
    assert main(["export", str(folder), "--to", "mbtiles", "--dest", str(tmp_path)]) == 0
    assert (tmp_path / "orthoimage.mbtiles").stat().st_size > 10_000
    capsys.readouterr()
    assert main(["evaluate", str(folder), "--reference", str(maps / "before.tif"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["median_m"] < 1.0


def test_a_run_in_the_other_form_replaces_the_rasters(maps, tmp_path):
    folder = tmp_path / "map"
    shutil.copytree(maps / "tiled", folder)
    (folder / "tiles" / "mine.txt").write_text("")
    asked = ["--gsd", "0.3", "--workers", "1", "--until", "realtime", "--out", str(folder)]
    assert main(["mosaic", str(maps / "photos"), *asked]) == 0
    assert (folder / "realtime.tif").is_file() and not list(folder.glob("*.vrt"))
    assert [p.name for p in (folder / "tiles").rglob("*")] == ["mine.txt"]


def test_large_rasters_come_in_tiles_where_nothing_is_said(monkeypatch):
    assert not in_tiles("auto", (0, 60_000, 512, 60_512)) and in_tiles("auto", (0, 65_000, 0, 65_000))
    monkeypatch.setattr(tiled_raster, "_ONE_FILE_PX", 1e6)
    assert in_tiles("auto", (0, 2000, 0, 2000)) and not in_tiles("no", (0, 2000, 0, 2000))
