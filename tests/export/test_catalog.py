"""A map in tiles: the pixels of the one file, a valid STAC collection, and one raster for QGIS and GDAL."""

import json
import shutil
import subprocess
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import rasterio

from gcs_plugin.cli.main import main
from orthoswarm.export.catalog.tiled_raster import in_tiles, product_file
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
    (top / "small.toml").write_text("[raster]\ntile_px = 512\n")
    for name, how in (("one", "no"), ("tiled", "yes")):
        asked = ["--gsd", "0.15", "--workers", "1", "--config", str(top / "small.toml"), "--tiles", how]
        assert main(["mosaic", str(top / "photos"), "--basemap", str(basemap), "--out", str(top / name), *asked]) == 0
    return top


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


def test_large_rasters_come_in_tiles_where_nothing_is_said(configure):
    assert not in_tiles("auto", (0, 60_000, 512, 60_512)) and in_tiles("auto", (0, 65_000, 0, 65_000))
    configure({"raster": {"one_file_px": 1e6}})
    assert in_tiles("auto", (0, 2000, 0, 2000)) and not in_tiles("no", (0, 2000, 0, 2000))
