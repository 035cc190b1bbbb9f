"""`mosaic --surface`: the surface model of a run beside the true heights of its scene."""

import json

import numpy as np
import pytest
import rasterio

from gcs_plugin.cli.main import main
from orthoswarm.export.value_raster import write_surface
from orthoswarm.model.geo import GroundGrid
from orthoswarm.report.report_pictures import relief
from orthoswarm.stereo.surface_cells import SurfaceModel
from orthoswarm.twin.make import SEA_LEVEL_M
from tests.kit.scenes import tiny_twin


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return tiny_twin(tmp_path_factory, 5)


@pytest.fixture(scope="module")
def made(twin, tmp_path_factory):
    out = tmp_path_factory.mktemp("surface") / "map"
    inputs = [str(twin / "photos"), "--basemap", str(twin / "basemap.tif"), "--workers", "1"]
    assert main(["mosaic", *inputs, "--out", str(out), "--surface", str(out / "dsm.tif")]) == 0
    return out


def test_heights_and_sigmas_are_those_of_the_scene(twin, made):
    with rasterio.open(made / "dsm.tif") as file:
        height, sigma, pairs = file.read(masked=True)
        altitude = float(file.tags()["TAKEOFF_ALTITUDE_M"])
        rows, columns = np.nonzero(~np.ma.getmaskarray(height))
        east, north = (np.array(v) for v in rasterio.transform.xy(file.transform, rows, columns))
        assert file.descriptions[1].startswith("one sigma") and file.crs.is_projected
    with rasterio.open(twin / "truth" / "dsm.tif") as truth, rasterio.open(twin / "truth" / "dtm.tif") as ground:
        row, column = (np.array(v) for v in rasterio.transform.rowcol(truth.transform, east, north))
        inside = (row >= 0) & (column >= 0) & (row < truth.height) & (column < truth.width)
        true = truth.read(1)[row[inside], column[inside]]
        tall = true - ground.read(1)[row[inside], column[inside]] > 3.0
    error = height[rows, columns].data[inside] - altitude - true
    error = np.abs(error - np.median(error[~tall]))  # the takeoff level itself is known to some decimetres
    stated = sigma[rows, columns].data[inside]
    assert len(error) > 20_000 and tall.sum() > 1_000
    assert np.median(error) < 0.4 and np.median(error[tall]) < 1.2  # a pixel is 0.67 m
    assert 0.6 < (error < stated).mean() < 0.9 and (error < 2 * stated).mean() > 0.9
    assert pairs.min() >= 2


def test_the_file_is_a_cog_that_says_what_its_heights_are(tmp_path):
    grid = GroundGrid(epsg=32632, west=465_000.0, north=5_250_000.0, gsd_m=0.1, width=1300, height=700)
    height = np.linspace(3.0, 9.0, grid.height * grid.width, dtype=np.float32).reshape(grid.height, grid.width)
    height[:, 500:613] = np.nan
    for altitude, datum in ((400.0, "altitudes in the photos"), (None, "over the takeoff level")):
        surface = SurfaceModel(grid, height, np.full_like(height, 0.2), np.full(height.shape, 3, np.uint8))
        write_surface(tmp_path / "dsm.tif", surface, altitude)
        assert [path.name for path in tmp_path.iterdir()] == ["dsm.tif"]
        with rasterio.open(tmp_path / "dsm.tif") as file:
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG" and file.overviews(1) == [2, 4]
            assert file.units[:2] == ("m", "m") and file.tags()["TIFFTAG_SOFTWARE"].startswith("OrthoSwarm")
            assert datum in file.tags()["VERTICAL_DATUM"]
            whole = file.read(1, masked=True)
            assert np.array_equal(whole.filled(np.nan), height + np.float32(altitude or 0.0), equal_nan=True)
        with rasterio.open(tmp_path / "dsm.tif", OVERVIEW_LEVEL=0) as half:
            reduced = half.read(1, masked=True)
        assert reduced.mask.any() and whole.min() <= reduced.min() < reduced.max() <= whole.max()  # gaps take no part


@pytest.mark.slow
def test_the_report_says_what_was_made(made):
    surface = json.loads((made / "report.json").read_text())["surface"]
    assert surface["file"].endswith("dsm.tif") and surface["known_ha"] > 3.0
    assert 0.1 < surface["median_sigma_m"] < 1.0 < surface["cell_m"] < 2.0


def test_the_error_that_all_heights_share_is_stated_with_them(twin, made):
    surface = json.loads((made / "report.json").read_text())["surface"]
    with rasterio.open(made / "dsm.tif") as file, rasterio.open(twin / "truth" / "dsm.tif") as truth:
        height = file.read(1, masked=True)
        rows, columns = np.nonzero(~np.ma.getmaskarray(height))
        east, north = rasterio.transform.xy(file.transform, rows, columns)
        row, column = (np.array(v) for v in rasterio.transform.rowcol(truth.transform, east, north))
        inside = (row >= 0) & (column >= 0) & (row < truth.height) & (column < truth.width)
        error = (height[rows, columns].data - SEA_LEVEL_M)[inside] - truth.read(1)[row[inside], column[inside]]
        assert f"{surface['common_sigma_m']:.2f} m besides" in file.descriptions[1]
    assert abs(np.median(error)) < 2.0 * surface["common_sigma_m"] < 12.0
    fov = json.loads((made / "report.json").read_text())["vehicles"]
    share = [np.radians(v["fov_sigma_deg"]) / np.sin(np.radians(v["fov_deg"])) for v in fov]
    assert min(share) - 1e-4 <= surface["scale_sigma"] <= max(share) + 1e-4
    assert surface["common_sigma_m"] > 80.0 * min(share)  # they fly 90 m up
    page = (made / "report.html").read_text()
    assert f"{surface['common_sigma_m']:.1f} m that all heights have in common" in page
    assert "above the zero of the receivers" in page


def test_the_page_shows_the_surface_and_the_range_of_the_expected_error(made):
    page = (made / "report.html").read_text()
    assert "Shaded heights of ground" in page
    rows = [json.loads(line) for line in (made / "frames.jsonl").read_text().splitlines()]
    low, usual, high = np.quantile([row["sigma_m"] for row in rows], [0.05, 0.5, 0.95])
    assert f"expected error against it {usual:.2f} m (one sigma an axis" in page
    assert low == pytest.approx(high, abs=0.01) or f"{low:.2f} to {high:.2f} m in nine of ten pictures" in page


def test_relief_is_lit_from_the_north_west():
    east, north = np.meshgrid(np.arange(40.0), -np.arange(40.0))
    flat = relief(0.0 * east, 1.0)[20, 20, 0]
    assert relief(east, 1.0)[20, 20, 0] > flat > relief(-east, 1.0)[20, 20, 0]  # east rising faces west
    assert relief(-north, 1.0)[20, 20, 0] > flat > relief(north, 1.0)[20, 20, 0]


def test_photos_without_common_ground_make_a_map_and_a_warning_but_no_surface(twin, tmp_path):
    photos = sorted((twin / "photos").rglob("*.JPG"))[:1]
    out = tmp_path / "map"
    assert main(["mosaic", *map(str, photos), "--out", str(out), "--surface", str(tmp_path / "dsm.tif")]) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["surface"] is None and any("surface model was not made" in w for w in report["warnings"])
    assert not (tmp_path / "dsm.tif").exists()


@pytest.mark.parametrize("more", [["--surface", "dsm.png"], ["--surface", "dsm.tif", "--until", "realtime"]])
def test_what_cannot_be_made_is_refused_before_the_work(more, twin, tmp_path, capsys):
    assert main(["mosaic", str(twin / "photos"), "--out", str(tmp_path / "map"), *more]) == 2
    assert "--surface" in capsys.readouterr().err and not (tmp_path / "map").exists()
