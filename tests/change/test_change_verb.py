"""`orthoswarm change` on a small twin: the files and figures, and what uses them."""

import json
import shutil
import zipfile

import numpy as np
import pyogrio
import pytest
import rasterio

from gcs_plugin.cli.main import main
from tests.kit.scenes import tiny_twin

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    folder = tiny_twin(tmp_path_factory, 5, disaster="debris")
    arguments = ["--basemap", str(folder / "basemap.tif"), "--out", str(folder / "out"), "--workers", "1"]
    assert main(["mosaic", str(folder / "photos"), *arguments]) == 0
    return folder


@pytest.fixture(scope="module")
def changed(twin):
    assert main(["change", str(twin / "out"), "--out", str(twin / "out")]) == 0
    return twin


def figures(capsys, *arguments):
    assert main(["change", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_buried_ground_is_found_and_other_ground_is_not(changed):
    with rasterio.open(changed / "out" / "change.tif") as file:
        chance, visible, bounds = file.read(1), file.read_masks(1) > 0, file.bounds
        assert file.count == 1 and file.dtypes == ("uint8",) and file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
    with rasterio.open(changed / "truth" / "disaster_mask.tif") as file:
        window = rasterio.windows.from_bounds(*bounds, file.transform)
        buried = file.read(1, window=window, out_shape=chance.shape, boundless=True) > 127
    assert (chance[visible & buried] > 127).mean() > 0.85
    assert (chance[visible & ~buried] > 127).mean() < 0.03
    assert visible.any() and not visible.all()


def test_the_figures_and_the_polygons_agree(changed, capsys):
    out = figures(capsys, changed / "out", "--out", changed / "again")
    assert 0.02 < out["changed_share"] < 0.2 and 0.0 <= out["not_visible_share"] < 0.5
    assert len(out["largest"]) <= 10 and out["largest"][0]["kind"] == "rubble or earth"
    areas = [row["area_m2"] for row in out["largest"]]
    assert areas == sorted(areas, reverse=True) and areas[0] > 2000.0
    assert (changed / "photos" / out["largest"][0]["photos"][0]["image"]).is_file()
    meta, _, _, columns = pyogrio.raw.read(changed / "again" / "change.gpkg")
    rows = dict(zip(meta["fields"], columns, strict=True))
    assert set(rows) == {"area_m2", "probability", "kind", "photos"} and len(rows["kind"]) == out["count"]
    assert rows["area_m2"][0] == areas[0] and (rows["probability"] >= 0.5).all()


def test_the_report_shows_it_once(changed):
    report = (changed / "out" / "report.html").read_text(encoding="utf-8")
    assert report.count('id="change"') == 1 and "rubble or earth" in report


def test_exports_have_it(changed, tmp_path):
    assert main(["export", str(changed / "out"), "--to", "pack", "stac", "--dest", str(tmp_path)]) == 0
    with zipfile.ZipFile(next(tmp_path.glob("*-map.zip"))) as archive:
        names = {name.split("/", 1)[1] for name in archive.namelist()}
        kml = archive.read(next(name for name in archive.namelist() if name.endswith("places.kml"))).decode()
    assert {"change.tif", "change.gpkg"} <= names and "rubble or earth" in kml
    item = json.loads((changed / "out" / "orthoimage.stac.json").read_text())
    assert item["assets"]["change"]["href"] == "change.tif"


def test_other_cells_and_another_threshold(changed, capsys):
    fine = figures(capsys, changed / "out", "--out", changed / "fine", "--want-m", "1")
    sure = figures(capsys, changed / "out", "--out", changed / "sure", "--threshold", "0.95")
    usual = figures(capsys, changed / "out", "--out", changed / "usual")
    assert fine["cell_m"] == 1.0 and fine["largest"][0]["area_m2"] > 2000.0
    assert usual["largest"][0]["area_m2"] > sure["largest"][0]["area_m2"] > 500.0 and usual["count"] > sure["count"]


def test_pictures_that_are_gone_are_told(changed, tmp_path, capsys):
    folder = tmp_path / "out"
    shutil.copytree(changed / "out", folder)
    report = json.loads((folder / "report.json").read_text())
    (folder / "report.json").write_text(json.dumps(report | {"root": str(tmp_path / "nowhere")}))
    out = figures(capsys, folder, "--out", tmp_path / "change")
    assert out["not_visible_share"] == 1.0 and out["largest"] == []
    assert any("could not be read" in text for text in out["warnings"])


def test_wrong_inputs_are_refused_in_a_sentence(changed, tmp_path, capsys):
    empty = tmp_path / "empty"
    empty.mkdir()
    for arguments in (
        [str(empty), "--out", str(tmp_path / "a")],
        [str(changed / "out"), "--out", str(tmp_path / "a"), "--want-m", "0"],
        [str(changed / "out"), "--out", str(tmp_path / "a"), "--threshold", "1.5"],
        [str(changed / "out"), "--out", str(tmp_path / "a"), "--basemap", str(tmp_path / "no.tif")],
    ):
        assert main(["change", *arguments]) == 2
        assert "Traceback" not in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_collapsed_houses_of_the_twin(tmp_path_factory):
    folder = tiny_twin(tmp_path_factory, 5, disaster="collapse")
    with rasterio.open(folder / "truth" / "disaster_mask.tif") as file:
        struck = file.read(1) > 0
    with rasterio.open(folder / "truth" / "dsm.tif") as dsm, rasterio.open(folder / "truth" / "dtm.tif") as dtm:
        height = dsm.read(1) - dtm.read(1)
    assert 0.003 < struck.mean() < 0.1
    assert np.median(height[struck]) < 4.0 and height[struck].max() < 14.0
