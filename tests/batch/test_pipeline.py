"""The batch end to end: products and their contract, resumption, independence of workers, a full disk."""

import errno
import hashlib
import json
import math
import re

import numpy as np
import pytest
import rasterio

from gcs_plugin.cli.main import main
from orthoswarm.batch.pipeline import legs_as_vehicles, run
from orthoswarm.batch.refiners import REFINERS
from orthoswarm.batch.run_state import PRODUCTS, MapOptions
from orthoswarm.batch.workspace import Workspace
from orthoswarm.compute.workers import Processes, Serial
from orthoswarm.export import cog
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.mosaic.extent import ground_level
from orthoswarm.raster.basemap import Basemap
from orthoswarm.report.page import write_page
from telemetry import LoadOptions, load
from tests.kit.scene import FOV, Scene, legs


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A scene, its shots, a folder with photos of two vehicles, and a map."""
    folder = tmp_path_factory.mktemp("flight")
    scene = Scene()
    shots = legs(count=2, photos=8)
    scene.fly(folder / "photos" / "a", shots)
    other = [s.__class__(**{**_fields(s), "north": s.north + 80, "fov": 70.0}) for s in legs(count=2, photos=8)]
    scene.fly(folder / "photos" / "b", other)
    (folder / "photos" / "a" / "notes.txt").write_text("hello")
    (folder / "photos" / "a" / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 broken")
    scene.basemap(folder / "map.tif")
    return scene, {"a": shots, "b": other}, folder


def _fields(shot):
    return {name: getattr(shot, name) for name in shot.__dataclass_fields__}


@pytest.fixture(scope="module")
def mapped(flight, tmp_path_factory):
    """The flight mapped on its map with one worker."""
    _, _, folder = flight
    out = tmp_path_factory.mktemp("mapped") / "out"
    report = make(folder / "photos", out, MapOptions(basemap=folder / "map.tif"))
    return out, report


def make(photos, out, options=None, workers=None, progress=lambda *_: None):
    def read(tell):
        return load([photos], progress=tell, options=LoadOptions(exclude=(out,)))

    return run(read, out, options or MapOptions(), workers or Serial(), progress)


def rows_of(out):
    return {r["image"]: r for r in map(json.loads, (out / "frames.jsonl").read_text().splitlines())}


def content(out):
    """What the products are, but for times of writing."""
    import pyogrio

    bytes_of = {n: (out / n).read_bytes() for n in PRODUCTS if n.endswith((".tif", ".jsonl"))}
    for name in ("footprints.gpkg", "seamlines.gpkg"):
        _, _, shapes, fields = pyogrio.raw.read(out / name)
        bytes_of[name] = repr([list(shapes), *(list(field) for field in fields)]).encode()
    return {name: hashlib.sha256(data).hexdigest() for name, data in bytes_of.items()}


def test_all_products_are_there_and_nothing_else(mapped):
    out, _ = mapped
    assert {p.name for p in out.iterdir()} == set(PRODUCTS)


def test_every_picture_has_its_line_and_lies_where_it_is(flight, mapped):
    scene, shots, _ = flight
    rows = rows_of(mapped[0])
    assert len(rows) == 33
    assert rows["a/broken.jpg"]["stage"] == "rejected" and rows["a/broken.jpg"]["reason"]
    errors = []
    for vehicle, own in shots.items():
        for i, shot in enumerate(own):
            row = rows[f"{vehicle}/DJI_{i:04d}.JPG"]
            assert row["vehicle"] == vehicle and row["stage"] == "fine" and row["epsg"] == scene.grid.epsg
            assert row["homography"][2][2] == 1.0 and np.shape(row["homography"]) == (3, 3)
            assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z", row["time"])
            assert abs(row["fov_deg"] - shot.fov) < 3
            assert 0 < row["sigma_m"] < 2
            errors.append(scene.error_m(row, shot))
    assert np.median(errors) < 0.3 and max(errors) < 1.5


def test_pictures_are_cogs_of_drone_pixels(flight, mapped):
    scene, _, _ = flight
    for name in ("realtime.tif", "coarse.tif", "orthoimage.tif"):
        with rasterio.open(mapped[0] / name) as image:
            assert image.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert image.count == 4 and set(image.dtypes) == {"uint8"}
            assert image.crs.to_epsg() == scene.grid.epsg
            rgba = image.read()
        assert set(np.unique(rgba[3])) <= {0, 255} and (rgba[:3, rgba[3] == 0] == 0).all()


def test_each_picture_of_the_map_has_the_time_of_the_last_photo(mapped):
    out = mapped[0]
    rows = map(json.loads, (out / "frames.jsonl").read_text().splitlines())
    last = max(row["time"] for row in rows if row["stage"] != "rejected")
    for name in ("realtime.tif", "coarse.tif", "orthoimage.tif"):
        with rasterio.open(out / name) as image:
            assert image.tags()["TIFFTAG_DATETIME"] == last[:19].replace("-", ":").replace("T", " ")


def test_the_orthoimage_shows_the_ground_where_it_is(flight, mapped):
    scene, _, _ = flight
    with rasterio.open(mapped[0] / "orthoimage.tif") as image:
        rgba = image.read(out_dtype="float32")
        rows, cols = np.mgrid[: image.height, : image.width] + 0.5
        t = image.transform
        east, north = t.c + t.a * cols, t.f + t.e * rows
    column = np.floor((east - scene.ground.west) / scene.ground.gsd_m).astype(int)
    row = np.floor((scene.ground.north - north) / scene.ground.gsd_m).astype(int)
    n = scene.ground.width
    inside = (rgba[3] > 0) & (column >= 0) & (row >= 0) & (column < n) & (row < n)
    truth = scene.rgb[row[inside], column[inside]].astype(float)
    assert np.abs(rgba[:3, inside].T - truth).mean() < 12


def test_the_report_has_its_keys(mapped):
    out, report = mapped
    assert report == json.loads((out / "report.json").read_text())
    assert report["frames"] == {"input": 33, "used": 32, "rejected": 1}
    assert {v["id"] for v in report["vehicles"]} == {"a", "b"}
    assert all({"id", "frames", "fov_deg", "fov_sigma_deg", "legs", "gsd_m"} <= set(v) for v in report["vehicles"])
    assert all(0 <= v["false_matches"] < 1e-4 for v in report["vehicles"])  # the map has evidence for both
    for leg in report["legs"]:
        assert {"vehicle", "first", "last", "images", "state", "confidence", "sigma_m"} <= set(leg)
        assert len(leg["images"]) == 2 and all(name.startswith(f"{leg['vehicle']}/") for name in leg["images"])
        assert leg["state"] in {"matched", "carried", "failed"}
    names = [s["name"] for s in report["stages"]]
    heads = ("load", "realtime", "coarse", "fine", "final")
    assert all(n.startswith(heads) for n in names) and {h for h in heads for n in names if n.startswith(h)} == set(
        heads
    )
    assert all(set(s) == {"name", "wall_s", "cpu_s", "items"} for s in report["stages"])
    assert report["wall_s"] > 0 and report["cpu_s"] > 0 and report["peak_rss_mb"] > 50
    assert 2.0 < report["area_ha"] < 12.0 and report["covered_share"] > 0.97
    assert math.isfinite(report["ground_z_m"]) and report["refine"] == "swarm" and isinstance(report["warnings"], list)


def test_the_page_stands_alone_and_has_its_pictures(mapped):
    page = (mapped[0] / "report.html").read_text()
    assert page.count("data:image/jpeg;base64,") >= 6
    assert not re.search(r"""(src|href)=["']?(http|/|\w+\.)""", page)
    assert "broken.jpg" in page and "Lies on the pre-disaster map" in page
    report, rows = mapped[1], rows_of(mapped[0])
    day = min(row["time"] for row in rows.values() if row["time"])[:10]
    assert f"<b>{report['epsg']}</b><span>EPSG code: WGS 84 / UTM zone" in page and f"<b>{day}</b><span>taken" in page
    assert 'class="leg matched"' in page


def test_footprints_open_as_polygons(flight, mapped):
    import pyogrio
    import shapely

    meta, _, shapes, fields = pyogrio.raw.read(mapped[0] / "footprints.gpkg")
    polygons = shapely.from_wkb(shapes)
    assert len(polygons) == 32 and meta["crs"] == f"EPSG:{flight[0].grid.epsg}"
    assert all(p.is_valid and 2000 < p.area < 40_000 for p in polygons)
    assert list(meta["fields"])[:3] == ["image", "vehicle", "time"] and "a/DJI_0000.JPG" in fields[0]
    assert meta["dtypes"][2] == "datetime64[ms]"


def test_results_do_not_depend_on_the_number_of_workers(flight, mapped, tmp_path):
    with Processes(2) as two:
        make(flight[2] / "photos", tmp_path / "two", MapOptions(basemap=flight[2] / "map.tif"), two)
    assert content(tmp_path / "two") == content(mapped[0])


@pytest.mark.parametrize("when", ["drawing realtime", "solo", "joint", "drawing orthoimage", "writing orthoimage.tif"])
def test_an_interrupted_run_is_continued(flight, mapped, tmp_path, when):
    photos, options = flight[2] / "photos", MapOptions(basemap=flight[2] / "map.tif")
    seen = []

    def interrupt(what, done, total):
        if what == when:
            raise KeyboardInterrupt
        seen.append(what)

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        make(photos, out, options, progress=interrupt)
    made = {p.name for p in out.iterdir()} - {".work"}
    assert made <= set(PRODUCTS) and "report.json" not in made and "orthoimage.tif" not in made
    for name in made:
        with rasterio.open(out / name) as image:
            image.read(1)
    before = set(seen)
    seen.clear()
    report = make(photos, out, options, progress=lambda what, *_: seen.append(what))
    assert content(out) == content(mapped[0])
    assert {p.name for p in out.iterdir()} == set(PRODUCTS)
    if when != "drawing realtime":
        assert "drawing realtime" in before and "drawing realtime" not in seen
        assert any("continued" in w for w in report["warnings"])


def test_a_quick_look_is_coarser_and_the_same_run_goes_on_from_it(flight, mapped, tmp_path):
    photos, basemap, out, seen = flight[2] / "photos", flight[2] / "map.tif", tmp_path / "out", []
    quick = make(photos, out, MapOptions(basemap=basemap, quick=True))
    assert any("--quick" in w for w in quick["warnings"])
    assert quick["gsd_m"] == pytest.approx(4.0 * mapped[1]["gsd_m"])
    with rasterio.open(out / "orthoimage.tif") as image:
        assert image.res[0] == pytest.approx(quick["gsd_m"])
    report = make(photos, out, MapOptions(basemap=basemap), progress=lambda what, *_: seen.append(what))
    assert not {"drawing realtime", "solo"} & set(seen)
    assert not any("--quick" in w or "continued" in w for w in report["warnings"])
    assert content(out) == content(mapped[0])
    assert {p.name for p in out.iterdir()} == set(PRODUCTS)


def test_a_refusal_leaves_an_interrupted_run_to_be_continued(flight, mapped, tmp_path):
    def interrupt(what, done, total):
        if what == "drawing orthoimage":
            raise KeyboardInterrupt

    photos, out, options = flight[2] / "photos", tmp_path / "out", MapOptions(basemap=flight[2] / "map.tif")
    with pytest.raises(KeyboardInterrupt):
        make(photos, out, options, progress=interrupt)
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}
    Scene(47.5, 8.9).basemap(tmp_path / "elsewhere.tif")
    with pytest.raises(InputError, match="does not overlap"):
        make(photos, out, MapOptions(basemap=tmp_path / "elsewhere.tif"))
    assert before == {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}
    report = make(photos, out, options)
    assert any("continued" in w for w in report["warnings"]) and content(out) == content(mapped[0])


def test_a_map_that_was_replaced_does_not_continue_an_interrupted_run(flight, tmp_path):
    def interrupt(what, done, total):
        if what == "drawing orthoimage":
            raise KeyboardInterrupt

    scene, _, folder = flight
    photos, out, options = folder / "photos" / "a", tmp_path / "out", MapOptions(basemap=tmp_path / "map.tif")
    scene.basemap(tmp_path / "map.tif")
    with pytest.raises(KeyboardInterrupt):
        make(photos, out, options, progress=interrupt)
    scene.basemap(tmp_path / "map.tif")
    assert not any("continued" in w for w in make(photos, out, options)["warnings"])


def test_other_options_do_not_continue_an_interrupted_run(flight, tmp_path):
    def interrupt(what, done, total):
        if what == "solo":
            raise KeyboardInterrupt

    photos, out, seen = flight[2] / "photos", tmp_path / "out", []
    with pytest.raises(KeyboardInterrupt):
        make(photos, out, MapOptions(), progress=interrupt)
    make(photos, out, MapOptions(gsd_m=1.0, until="realtime"), progress=lambda what, *_: seen.append(what))
    assert "drawing realtime" in seen
    assert {p.name for p in out.iterdir()} == set(PRODUCTS) - {
        "coarse.tif",
        "orthoimage.tif",
        "seamlines.gpkg",
        "confidence.tif",
        "ground.tif",
    }


def test_what_a_killed_run_left_half_written_is_cleared(flight, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".orthoimage.part4711.tif").write_bytes(b"half")
    make(flight[2] / "photos" / "a", tmp_path / "out", MapOptions(until="realtime"))
    assert {p.name for p in (tmp_path / "out").iterdir()} == set(PRODUCTS) - {
        "coarse.tif",
        "orthoimage.tif",
        "seamlines.gpkg",
        "confidence.tif",
        "ground.tif",
    }


def test_two_runs_do_not_write_to_one_folder(flight, tmp_path):
    with Workspace(tmp_path / "out"), pytest.raises(InputError, match="another run"):
        make(flight[2] / "photos", tmp_path / "out")


def test_a_full_disk_is_one_clear_error_and_leaves_nothing_half_written(flight, tmp_path, monkeypatch):
    count = 0
    compress = cog.isal_zlib.compress

    def full(data, level):
        nonlocal count
        count += 1
        if count > 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        return compress(data, level)

    monkeypatch.setattr(cog.isal_zlib, "compress", full)
    with pytest.raises(OrthoSwarmError, match="disk is full") as caught:
        make(flight[2] / "photos", tmp_path / "out")
    assert caught.value.exit_code == 1
    assert not (tmp_path / "out").exists()


def test_a_fault_in_the_refinement_leaves_the_real_time_map_and_exit_1(flight, tmp_path, monkeypatch, capsys):
    class Faulty:
        """A refiner with a bug."""

        def refine_batch(self, *_):
            raise ZeroDivisionError("by a bug")

    _, _, folder = flight
    out = tmp_path / "out"
    monkeypatch.setitem(REFINERS, "swarm", lambda *_: Faulty())
    for name in ("orthoimage.tif", "coarse.tif"):  # of an earlier run: they must not pass for this one's
        out.mkdir(exist_ok=True)
        (out / name).write_bytes(b"old")
    command = ["mosaic", str(folder / "photos"), "--basemap", str(folder / "map.tif"), "--out", str(out), "--json"]
    assert main([*command, "--workers", "1"]) == 1
    told = capsys.readouterr()
    assert "ZeroDivisionError: by a bug" in told.err and not told.out
    assert {p.name for p in out.iterdir()} == set(PRODUCTS) - {
        "orthoimage.tif",
        "coarse.tif",
        "seamlines.gpkg",
        "confidence.tif",
        "ground.tif",
    }
    report = json.loads((out / "report.json").read_text())
    assert any("ZeroDivisionError" in w for w in report["warnings"]) and report["refine"] == "none"
    rows = rows_of(out)
    assert {r["stage"] for r in rows.values()} == {"realtime", "rejected"} and len(rows) == 33
    with rasterio.open(out / "realtime.tif") as image:
        assert image.count == 4


def test_without_a_map_the_orthoimage_is_the_coarse_one(flight, tmp_path):
    scene, shots, folder = flight
    report = make(folder / "photos" / "a", tmp_path / "out")
    assert any("no basemap" in w for w in report["warnings"])
    rows = rows_of(tmp_path / "out")
    assert {r["stage"] for r in rows.values()} == {"coarse", "rejected"}
    assert (tmp_path / "out" / "coarse.tif").read_bytes() == (tmp_path / "out" / "orthoimage.tif").read_bytes()
    errors = [scene.error_m(rows[f"DJI_{i:04d}.JPG"], shot) for i, shot in enumerate(shots["a"])]
    assert np.median(errors) < 2.0


def test_stopping_early_makes_what_was_asked(flight, tmp_path):
    folder = flight[2]
    report = make(folder / "photos" / "a", tmp_path / "r", MapOptions(until="realtime", fov_min_deg=60, gsd_m=0.8))
    assert {p.name for p in (tmp_path / "r").iterdir()} == set(PRODUCTS) - {
        "coarse.tif",
        "orthoimage.tif",
        "seamlines.gpkg",
        "confidence.tif",
        "ground.tif",
    }
    rows = rows_of(tmp_path / "r")
    assert {r["stage"] for r in rows.values()} == {"realtime", "rejected"}
    assert all(r["fov_deg"] == pytest.approx(60) for r in rows.values() if "fov_deg" in r)
    assert report["vehicles"][0]["frames"] == 16
    with rasterio.open(tmp_path / "r" / "realtime.tif") as image:
        assert image.res == (0.8, 0.8)
    report = make(folder / "photos" / "a", tmp_path / "c", MapOptions(basemap=folder / "map.tif", until="coarse"))
    assert {p.name for p in (tmp_path / "c").iterdir()} == set(PRODUCTS) - {
        "orthoimage.tif",
        "seamlines.gpkg",
        "confidence.tif",
        "ground.tif",
    }
    assert {r["stage"] for r in rows_of(tmp_path / "c").values()} == {"coarse", "rejected"}
    page = (tmp_path / "c" / "report.html").read_text()  # nothing was searched for on the map, so nothing failed
    assert "failed" not in page.partition("<main>")[2] and " m (one sigma an axis)" in page
    assert abs(report["vehicles"][0]["fov_deg"] - FOV) < 4


def test_the_output_folder_may_lie_among_the_photos(flight, tmp_path):
    scene, shots, _ = flight
    photos = tmp_path / "photos"
    scene.fly(photos, shots["a"][:8])
    for _ in range(2):
        report = make(photos, photos / "map", MapOptions(until="realtime"))
        assert report["frames"] == {"input": 8, "used": 8, "rejected": 0}


def test_legs_become_vehicles(flight, tmp_path):
    scene, shots, _ = flight
    scene.fly(tmp_path / "photos", shots["a"])
    frames = load([tmp_path / "photos"]).frames
    named = [f.vehicle for f in legs_as_vehicles(frames, scene.grid)]
    assert named[0] == "photos/leg1" and named[-1] == "photos/leg2"
    assert named == sorted(named) and 6 <= named.count("photos/leg1") <= 10
    report = make(tmp_path / "photos", tmp_path / "out", MapOptions(split_legs=True, until="realtime"))
    assert [v["id"] for v in report["vehicles"]] == ["photos/leg1", "photos/leg2"]


def test_ground_level_is_that_below_the_cameras(mapped):
    assert ground_level([], None) == 0.0
    assert abs(mapped[1]["ground_z_m"]) < 2.0


def test_the_command_prints_one_json_document(flight, tmp_path, capsys):
    photos, out = flight[2] / "photos" / "b", tmp_path / "out"
    args = ["mosaic", str(photos), "--out", str(out), "--until", "realtime", "--workers", "1", "--json"]
    assert main(args) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["frames"]["used"] == 16
    assert "reading photos" in printed.err


def test_a_map_that_only_the_report_cannot_read_costs_the_reports_pictures_alone(flight, tmp_path, monkeypatch):
    _, _, folder = flight

    def page(out, report, placed, *, rejected, basemap):
        if basemap is not None:
            raise InputError("the basemap map.tif is damaged; copy or export it again")
        write_page(out, report, placed, rejected=rejected, basemap=None)

    monkeypatch.setattr("orthoswarm.batch.run_report.write_page", page)
    photos, out = folder / "photos" / "b", tmp_path / "out"
    report = make(photos, out, MapOptions(basemap=folder / "map.tif", until="realtime"))
    assert any("without the map: the basemap map.tif is damaged" in w for w in report["warnings"])
    assert {p.name for p in out.iterdir()} >= {"report.html", "report.json", "frames.jsonl"}


def test_a_large_area_is_compared_with_the_map_in_parts(flight, mapped):
    from orthoswarm.report.page import shifts_against_map
    from orthoswarm.report.report_pictures import MapView, product_bounds, product_picture, view_grid

    best = mapped[0] / "orthoimage.tif"
    bounds = product_bounds(best)
    basemap = Basemap.open(flight[2] / "map.tif", flight[0].grid.epsg, bounds)
    ortho = product_picture(best, view_grid(flight[0].grid.epsg, bounds, 400, 0.3))
    there = MapView.read(basemap, ortho.grid)
    whole = shifts_against_map(best, ortho, there, basemap, 0.3)
    coarse = product_picture(best, view_grid(flight[0].grid.epsg, bounds, 100, 0.3))
    assert coarse.grid.gsd_m > 0.6
    parts = shifts_against_map(best, coarse, MapView.read(basemap, coarse.grid), basemap, 0.3, fine_m=0.6, part_px=160)
    assert len(whole.at) > 3 and len(parts.at) > 3
    assert np.median(parts.size_m) < np.median(whole.size_m) + 0.3
