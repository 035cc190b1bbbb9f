"""The map as others file or print it: read back with their own rules."""

import gzip
import json
import re
import sqlite3
import zipfile
from pathlib import Path
from urllib.parse import urljoin

import jsonschema
import numpy as np
import pytest
import rasterio
from PIL import ImageDraw
from pmtiles.tile import zxy_to_tileid
from rasterio.warp import transform

from gcs_plugin.cli.main import main
from orthoswarm.export.forms import FORMS, MapExport
from orthoswarm.export.sheets.geopdf import grid_zone, square, utm_zone, write_geopdf
from orthoswarm.export.sheets.stac_item import write_stac_item
from orthoswarm.export.sheets.stated_accuracy import stated_accuracy
from orthoswarm.export.tactical.places import FILE, Place, write_geojson
from orthoswarm.export.tiles.mbtiles import write_mbtiles, write_pmtiles
from orthoswarm.export.tiles.tile_pyramid import ReducedRaster
from orthoswarm.export.value_raster import write_surface
from orthoswarm.model.geo import GroundGrid
from orthoswarm.stereo.surface_cells import SurfaceModel

WEST, NORTH, GSD = 465_500.0, 5_249_600.0, 0.25
FIND = Place(uid="f", kind="find", name="Roof", lat_deg=47.3975, lon_deg=8.5437, time_s=1.78e9, note="</script>")


@pytest.fixture
def folder(tmp_path):
    """A map's folder as `orthoswarm mosaic` leaves it: 200 m by 150 m, nothing drawn in the east."""
    out = tmp_path / "flood"
    out.mkdir()
    chance = np.random.default_rng(1)
    rgba = np.full((4, 600, 800), 255, np.uint8)
    rgba[:3] = chance.integers(0, 255, (3, 600, 800))
    rgba[3, :, 500:] = 0
    profile = {"driver": "GTiff", "width": 800, "height": 600, "count": 4, "dtype": "uint8", "crs": "EPSG:32632"}
    transform = rasterio.transform.from_origin(WEST, NORTH, GSD, GSD)
    with rasterio.open(out / "orthoimage.tif", "w", **profile, transform=transform) as raster:
        raster.write(rgba)
        raster.colorinterp = [rasterio.enums.ColorInterp[c] for c in ("red", "green", "blue", "alpha")]
    legs = [{"state": "matched", "sigma_m": 0.2}, {"state": "matched", "sigma_m": 0.4}, {"state": "failed"}]
    (out / "report.json").write_text(json.dumps({"legs": legs, "root": None}))
    row = {"image": "a.jpg", "vehicle": "v1", "time": "2026-05-28T20:26:40Z"}
    (out / "frames.jsonl").write_text(json.dumps(row) + "\n")
    return out


def test_mgrs_is_that_of_the_tables():
    assert (grid_zone(32, 47.3977), square(32, 465_741.9, 5_249_460.2)) == ("32T", "MT")
    assert (grid_zone(56, -33.8568), square(56, 334_897.0, 6_252_288.0)) == ("56H", "LH")  # Sydney's opera house
    assert (grid_zone(31, 0.5), square(31, 166_021.0, 55_000.0)) == ("31N", "AA")
    assert utm_zone(32632) == 32 and utm_zone(32760) == 60 and utm_zone(2056) is None and utm_zone(32661) is None


def test_a_stac_item_is_valid_and_names_the_cog(folder):
    write_stac_item(folder / "orthoimage.tif", folder / "orthoimage.stac.json")
    item = json.loads((folder / "orthoimage.stac.json").read_text())
    jsonschema.validate(item, json.loads(Path(__file__).with_name("stac_item.schema.json").read_text()))
    assert (folder / item["assets"]["orthoimage"]["href"]).is_file()
    assert item["properties"]["proj:code"] == "EPSG:32632" and item["properties"]["gsd"] == GSD
    assert item["properties"]["datetime"] == "2026-05-28T20:26:40Z"
    assert "2 of 3 legs" in item["properties"]["description"]
    assert item["bbox"][0] == pytest.approx(8.5426, abs=1e-3) and item["bbox"][3] == pytest.approx(47.399, abs=1e-3)


MATCHED, FAILED = {"state": "matched", "sigma_m": 0.2}, {"state": "failed", "sigma_m": 3.0}
CONTROL = {"points": 5, "left_out": [], "residuals": [{"name": "P0"}, {"name": "P1"}]}
CHECKED = {"checkpoints": 4, "rmse_h_m": 0.3, "survey_rmse_h_m": 0.4, "points": [{"name": "P1"}, {"name": "Q"}]}


@pytest.mark.parametrize(
    ("report", "words", "never", "values"),
    [
        ({"legs": [FAILED], "control": CONTROL}, "Placed on 5 control points. Expected error: 1.10 m", "receivers",
         {"placed_on": "control points", "sigma_median_m": 1.1, "sigma_most_m": 1.7}),
        ({"legs": [MATCHED], "control": CONTROL, "checkpoints": CHECKED},
         "RMSE_H at 4 checkpoints, 1 of which placed it: 0.50 m", "Not checked",
         {"placed_on": "control points", "rmse_h_m": 0.5, "checkpoints": 4}),
        ({"legs": [FAILED], "control": None}, "placed where the receivers say. Expected error: 1.10 m", "control",
         {"placed_on": "receivers", "sigma_median_m": 1.1}),
        ({"legs": [], "refine": "none"}, "Not refined", "found", {"placed_on": "receivers", "sigma_median_m": 1.1}),
        ({"legs": [MATCHED, FAILED], "checkpoints": CHECKED | {"points": []}},
         "Expected error against it: 1.10 m (one sigma an axis; median of the pictures, largest 1.70 m)", "within",
         {"placed_on": "map", "sigma_median_m": 1.1, "rmse_h_m": 0.5}),
        ({"legs": [MATCHED], "map_offset_m": {"doubted": True}}, "The map and the receivers disagree", "within",
         {"placed_on": "map"}),
    ],
)  # fmt: skip
def test_accuracy_is_stated_as_the_map_was_placed_and_checked(folder, monkeypatch, report, words, never, values):
    (folder / "report.json").write_text(json.dumps(report))
    rows = [{"image": f"{k}.jpg", "vehicle": "v1", "sigma_m": sigma} for k, sigma in enumerate((0.5, 1.1, 1.7))]
    rows.append({"image": "r.jpg", "vehicle": "v1", "stage": "rejected"})
    (folder / "frames.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    write_stac_item(folder / "orthoimage.tif", folder / "orthoimage.stac.json")
    properties = json.loads((folder / "orthoimage.stac.json").read_text())["properties"]
    assert words in properties["description"] and never not in properties["description"]
    found = {name: properties[f"orthoswarm:{name}"] for name in values}
    assert found == pytest.approx(values)
    drawn = []
    text = ImageDraw.ImageDraw.text
    monkeypatch.setattr(
        ImageDraw.ImageDraw, "text", lambda self, at, said, **how: drawn.append(said) or text(self, at, said, **how)
    )
    write_geopdf(folder / "orthoimage.tif", folder / "sheet.pdf", (), "Flood")
    assert words in " ".join(drawn)


@pytest.mark.parametrize(("layer", "basemap", "own"), [
    ("realtime", "m.tif", True), ("coarse", "m.tif", True), ("coarse", None, False), ("orthoimage", "m.tif", False),
])  # fmt: skip
def test_an_earlier_layer_does_not_quote_the_accuracy_of_the_last(folder, layer, basemap, own):
    (folder / "report.json").write_text(json.dumps({"legs": [MATCHED], "basemap": basemap, "checkpoints": CHECKED}))
    for name in ("coarse.tif", "realtime.tif"):
        (folder / name).write_bytes((folder / "orthoimage.tif").read_bytes())
    what = MapExport(folder=folder, dest=folder / "dest", layer=layer)
    path = FORMS["stac"].write(what)
    properties = json.loads(path.read_text())["properties"]
    assert ("No accuracy is stated" in properties["description"]) == own
    assert ("orthoswarm:sigma_median_m" in properties) == ("orthoswarm:rmse_h_m" in properties) == (not own)
    pack = FORMS["pack"].write(what)
    with zipfile.ZipFile(pack) as archive:
        item = json.loads(archive.read("flood-map/orthoimage.stac.json"))
        page = archive.read("flood-map/index.html").decode()
    assert item["id"] == f"flood-{layer}"
    assert ("No accuracy is stated" in item["properties"]["description"]) == own
    assert ("No accuracy is stated" in page) == own


@pytest.mark.parametrize(("leg", "placed_on"), [(MATCHED, "map"), (FAILED, "receivers")])
def test_a_coarse_layer_is_placed_on_the_map_only_where_legs_were_found_there(folder, leg, placed_on):
    (folder / "report.json").write_text(json.dumps({"legs": [leg], "basemap": "m.tif"}))
    assert stated_accuracy(folder, "coarse").values == {"orthoswarm:placed_on": placed_on}


def test_a_long_statement_stays_on_the_sheet(folder, monkeypatch):
    many = {f"vehicle-{k:02d}": 100 + k for k in range(40)}
    (folder / "report.json").write_text(json.dumps({"legs": [MATCHED], "unrefined": many}))
    ends = []
    text = ImageDraw.ImageDraw.text

    def recorded(self, at, said, **how):
        ends.append(self.textbbox(at, said, font=how["font"], anchor=how.get("anchor"))[2:])
        text(self, at, said, **how)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", recorded)
    write_geopdf(folder / "orthoimage.tif", folder / "sheet.pdf", (), "Flood")
    right, bottom = np.max(ends, axis=0)
    assert right <= 2339 - 80 and bottom <= 3307 - 80  # A3 at 200 points an inch, standing


def varints(data):
    value = shift = 0
    for byte in data:
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            yield value
            value = shift = 0


def test_signs_of_addresses_in_a_folder_name_are_part_of_it(folder, tmp_path):
    odd = tmp_path / "flood #3 50%? ü"
    odd.mkdir()
    write_mbtiles(folder / "orthoimage.tif", odd / "m.mbtiles", tile_format="webp")
    write_pmtiles(odd / "m.mbtiles", odd / "m.pmtiles")
    assert (odd / "m.pmtiles").read_bytes()[:7] == b"PMTiles"
    (odd / "o.tif").write_bytes((folder / "orthoimage.tif").read_bytes())
    write_stac_item(odd / "o.tif", tmp_path / "item.json")
    href = json.loads((tmp_path / "item.json").read_text())["assets"]["orthoimage"]["href"]
    assert urljoin("file:///maps/item.json", href) == "file:///maps/flood%20%233%2050%25%3F%20%C3%BC/o.tif"


def test_letters_that_no_font_here_has_are_told(folder, tmp_path):
    assert write_geopdf(folder / "orthoimage.tif", tmp_path / "b.pdf", [FIND], "Überflutung, Потоп") == ""
    missing = chr(0x10FFFD)
    assert write_geopdf(folder / "orthoimage.tif", tmp_path / "c.pdf", [FIND], f"A {missing} B") == missing


def test_pmtiles_hold_every_tile_under_its_number(folder, tmp_path):
    write_mbtiles(folder / "orthoimage.tif", tmp_path / "m.mbtiles", tile_format="webp")
    write_pmtiles(tmp_path / "m.mbtiles", tmp_path / "m.pmtiles")
    data = (tmp_path / "m.pmtiles").read_bytes()
    assert data[:8] == b"PMTiles\x03"
    word = [int.from_bytes(data[8 + 8 * k : 16 + 8 * k], "little") for k in range(11)]
    numbers = list(varints(gzip.decompress(data[word[0] : word[0] + word[1]])))
    count = numbers[0]
    ids = np.cumsum(numbers[1 : 1 + count])
    runs, sizes, offsets = (numbers[1 + k * count : 1 + (k + 1) * count] for k in (1, 2, 3))
    found, end = {}, 0
    for number, run, size, offset in zip(ids, runs, sizes, offsets, strict=True):
        begin = offset - 1 if offset else end
        end = begin + size
        found |= {int(number) + k: data[word[6] + begin : word[6] + end] for k in range(run)}
    with sqlite3.connect(tmp_path / "m.mbtiles") as database:
        rows = database.execute("SELECT zoom_level, tile_column, tile_row, tile_data FROM tiles").fetchall()
    database.close()
    assert found == {zxy_to_tileid(z, x, 2**z - 1 - row): tile for z, x, row, tile in rows}
    assert json.loads(gzip.decompress(data[word[2] : word[2] + word[3]]))["name"] == "orthoimage"


def test_a_sheet_is_a_pdf_with_georeferencing_and_a_round_scale(folder, tmp_path):
    write_geopdf(folder / "orthoimage.tif", tmp_path / "sheet.pdf", [FIND], "Flood")
    data = (tmp_path / "sheet.pdf").read_bytes()
    assert data.startswith(b"%PDF") and b"/Measure" in data and b"/GPTS" in data and b"/LPTS" in data
    assert b"/MediaBox" in data and not (tmp_path / "sheet.pdf.aux.xml").exists()
    box, corners = (
        np.array(re.search(rb"/" + key + rb" \[([^\]]*)", data)[1].split(), float) for key in (b"BBox", b"GPTS")
    )
    east, north = transform("EPSG:4326", "EPSG:32632", corners[1::2], corners[::2])
    assert np.ptp(east[:2]) < 1e-3 and np.ptp(east[2:]) < 1e-3 and abs(north[0] - north[3]) < 1e-3  # to a millimetre
    sides = np.array([(east[2] - east[0]) / (box[2] - box[0]), (north[0] - north[1]) / (box[3] - box[1])])
    assert sides * 72 / 0.0254 == pytest.approx([500, 500], rel=1e-6)  # 1:500; a point is 1/72 inch
    assert east[0] < WEST < WEST + 125 < east[2] and north[1] < NORTH - 150 < NORTH < north[0]


def test_every_form_is_written_by_the_command_line(folder, capsys):
    write_geojson([FIND], folder / FILE)
    assert main(["export", str(folder), "--to", "stac", "pmtiles", "pdf", "places", "tak", "pack"]) == 0
    written = [Path(line) for line in capsys.readouterr().out.split()]
    assert all(path.exists() for path in written) and len(written) == 6
    assert {p.name for p in (folder / "export" / "places").iterdir()} == {
        f"places.{s}" for s in ("geojson", "kml", "gpx", "csv")
    }
    with zipfile.ZipFile(folder / "export" / "flood-map.zip") as archive:
        names = set(archive.namelist())
        page = archive.read("flood-map/index.html").decode()
    inside = ("index.html", "orthoimage.tif", "orthoimage.stac.json", "orthoimage.mbtiles", "orthoimage.pmtiles",
              "orthoimage.kmz", "sheet.pdf", "places-tak.zip", "places.geojson", "places.kml", "places.gpx",
              "places.csv")  # fmt: skip
    assert {f"flood-map/{name}" for name in inside} <= names
    assert page.count("</script>") == 1  # a note cannot end the page's script
    assert not [p for p in (folder / "export").iterdir() if p.name.startswith(".")]


def test_page_and_documents_name_every_form():
    root = Path(__file__).parents[2]
    served = {name for name, form in FORMS.items() if form.daemon}
    page = (root / "gcs_plugin/web/static/work/exports.js").read_text(encoding="utf-8")
    words = (root / "gcs_plugin/web/static/core/english.js").read_text(encoding="utf-8")
    assert set(re.findall(r'"(\w+)"', re.search(r"const FORMATS = \[(.*)\]", page)[1])) == served
    assert all(f'"export.{name}": ' in words for name in served)
    usage, console, daemon = ((root / f"docs/{name}.md").read_text() for name in ("usage", "console", "daemon"))
    assert set(re.search(r"orthoswarm export OUT --to (.*)", usage)[1].split()) == set(FORMS)
    assert all(f"`{name}`" in console and f"`{name}`" in daemon for name in served)


def test_the_surface_model_and_the_seamlines_go_along(folder):
    report = json.loads((folder / "report.json").read_text()) | {"surface": {"file": "/elsewhere/heights.tif"}}
    (folder / "report.json").write_text(json.dumps(report))
    cells = np.ones((30, 40), np.float32)
    grid = GroundGrid(epsg=32632, west=WEST, north=NORTH, gsd_m=0.5, width=40, height=30)
    write_surface(folder / "heights.tif", SurfaceModel(grid, cells, cells, cells.astype(np.uint8)), 400.0)
    (folder / "seamlines.gpkg").write_bytes(b"polygons")
    assert main(["export", str(folder), "--to", "stac", "pack"]) == 0
    item = json.loads((folder / "orthoimage.stac.json").read_text())
    asset = item["assets"]["surface"]
    assert asset["href"] == "heights.tif" and asset["proj:shape"] == [30, 40]
    assert [band.get("unit") for band in asset["raster:bands"]] == ["m", "m", None]
    jsonschema.validate(item, json.loads(Path(__file__).with_name("stac_item.schema.json").read_text()))
    with zipfile.ZipFile(folder / "export" / "flood-map.zip") as archive:
        assert {"flood-map/dsm.tif", "flood-map/seamlines.gpkg"} <= set(archive.namelist())
        packed = json.loads(archive.read("flood-map/orthoimage.stac.json"))
    assert packed["assets"]["surface"]["href"] == "dsm.tif"


def test_a_surface_model_of_an_earlier_run_is_not_named(folder):
    (folder / "dsm.tif").write_bytes(b"old")
    write_stac_item(folder / "orthoimage.tif", folder / "orthoimage.stac.json")
    assert "surface" not in json.loads((folder / "orthoimage.stac.json").read_text())["assets"]


def test_without_places_the_command_line_says_where_they_come_from(folder, capsys):
    assert main(["export", str(folder), "--to", "tak"]) == 0
    assert "orthoswarm serve" in capsys.readouterr().out


def test_a_reduced_raster_reads_the_overview_that_is_fine_enough(folder):
    with rasterio.open(folder / "orthoimage.tif", "r+") as raster:
        raster.build_overviews([2, 4], rasterio.enums.Resampling.average)
    with ReducedRaster(folder / "orthoimage.tif") as reduced:
        assert reduced.at(1.0) == (reduced.full, 1.0)
        for asked, expected in ((2.0, 2), (3.0, 2), (4.0, 4), (7.9, 4)):
            dataset, left = reduced.at(asked)
            assert dataset.width == -(-reduced.full.width // expected) and left == asked / expected
