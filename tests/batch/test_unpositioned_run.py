"""Photos without a position are placed by control points that they show, or stay out with the reason."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rasterio

from gcs_plugin.cli.main import main
from tests.batch.test_control_run import survey
from tests.kit.scene import Scene, legs


def taken():
    """Shots by vehicle and number, of two vehicles beside each other."""
    return {
        (vehicle, i): replace(s, north=s.north + 60.0 * k)
        for k, vehicle in enumerate("ab")
        for i, s in enumerate(legs(count=2, photos=8))
    }


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Two vehicles over one scene, and points that photos show: vehicle b recorded nothing, or neither did."""
    folder = tmp_path_factory.mktemp("unpositioned")
    scene, shots = Scene(), {f"{v}/DJI_{i:04d}.JPG": s for (v, i), s in taken().items()}
    for vehicle in "ab":
        own = [s for (v, _), s in taken().items() if v == vehicle]
        nothing = [replace(s, tags="none") for s in own]
        scene.fly(folder / "mixed" / vehicle, own if vehicle == "a" else nothing)
        scene.fly(folder / "bare" / vehicle, nothing)
    survey(folder / "control.csv", scene, shots, [(-60.0, -20.0), (55.0, 0.0), (0.0, 90.0), (-40.0, 60.0)])
    survey(folder / "check.csv", scene, shots, [(-30.0, 10.0), (40.0, 60.0), (20.0, -15.0), (-50.0, 85.0)])
    return folder


def mosaic(folder, photos, out, *more):
    arguments = ["mosaic", str(folder / photos), "--out", str(out), "--workers", "1", "--fov-min", "80"]
    return main([*arguments, *map(str, more)])


@pytest.mark.slow
def test_photos_that_recorded_nothing_are_placed_by_control_points(flight, tmp_path):
    out = tmp_path / "out"
    assert mosaic(flight, "bare", out, "--control", flight / "control.csv", "--checkpoints", flight / "check.csv") == 0
    report = json.loads((out / "report.json").read_text())
    assert report["frames"]["used"] == 32 and report["frames"]["rejected"] == 0
    assert report["checkpoints"]["checkpoints"] == 4 and report["checkpoints"]["rmse_h_m"] < 0.3
    assert any("32 photos without a position were placed by control points" in w for w in report["warnings"])
    assert not any("receivers say" in w for w in report["warnings"])  # none has a receiver


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_photos_that_nothing_places_become_a_picture_without_coordinates(flight, tmp_path, capsys):
    out = tmp_path / "out"
    assert mosaic(flight, "bare", out, "--unreferenced") == 0
    assert sorted(path.name for path in out.iterdir()) == ["report.json", "unreferenced.tif"]
    report = json.loads((out / "report.json").read_text())
    assert report["frames"]["used"] == 32 and "is a picture, not a map" in report["headline"]
    with rasterio.open(out / "unreferenced.tif") as picture:
        assert picture.crs is None and picture.transform.is_identity and not picture.gcps[0]
        rgba = np.moveaxis(picture.read(), 0, -1)
    found = like_the_scene(np.ascontiguousarray(rgba[..., :3]), rgba[..., 3])
    assert found.sum() > 60 and found.mean() > 0.7  # the others are wrong pairs of features
    capsys.readouterr()
    assert mosaic(flight, "mixed", tmp_path / "other", "--unreferenced") == 2
    assert "16 pictures have a position" in capsys.readouterr().err
    assert mosaic(flight, "bare", tmp_path / "other", "--unreferenced", "--control", flight / "control.csv") == 2
    for name in ("DJI_0000.JPG", "DJI_0007.JPG"):  # at the ends of a leg
        (tmp_path / "few").mkdir(exist_ok=True)
        shutil.copy(flight / "bare" / "a" / name, tmp_path / "few")
    assert mosaic(tmp_path, "few", tmp_path / "other", "--unreferenced") == 1
    assert "no two of 2 photos without a position show ground in common" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def like_the_scene(rgb, seen):
    """Which features of a picture lie within two of its pixels of where one similarity puts those of the scene."""
    sift, grays = cv2.SIFT_create(2000), (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), Scene().rgb.mean(-1).astype(np.uint8))
    (here, ours), (there, theirs) = (sift.detectAndCompute(g, m) for g, m in zip(grays, (seen, None), strict=True))
    pairs = cv2.BFMatcher().knnMatch(ours, theirs, k=2)
    good = [a for a, b in pairs if a.distance < 0.7 * b.distance]
    one, other = (np.float32([k[getattr(m, n)].pt for m in good]) for k, n in ((here, "queryIdx"), (there, "trainIdx")))
    _, inliers = cv2.estimateAffinePartial2D(other, one, ransacReprojThreshold=2.0)
    return inliers.ravel() > 0


@pytest.mark.slow
def test_photos_with_positions_help_to_place_those_without(flight, tmp_path):
    """One point lies in photos of the other vehicle only: a single one could not place it alone."""
    lines = (flight / "control.csv").read_text().splitlines()
    (tmp_path / "one.csv").write_text("\n".join([lines[0], *(line for line in lines if line.startswith("p0,"))]))
    out = tmp_path / "out"
    assert mosaic(flight, "mixed", out, "--control", tmp_path / "one.csv", "--checkpoints", flight / "check.csv") == 0
    report = json.loads((out / "report.json").read_text())
    assert report["frames"]["used"] == 32
    assert report["checkpoints"]["rmse_h_m"] < 2.0  # as good as receivers


def test_without_control_points_they_stay_out_with_the_reason(flight, tmp_path, capsys):
    assert mosaic(flight, "bare", tmp_path / "none") == 1
    said = capsys.readouterr().err
    assert (
        "has no position" in said
        and "mark at least two surveyed points in them (--control)" in said
        and "--unreferenced" in said
    )
    out = tmp_path / "mixed"
    assert mosaic(flight, "mixed", out, "--until", "realtime") == 0
    frames = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    left = [f for f in frames if f["stage"] == "rejected"]
    assert {f["vehicle"] for f in left} == {"b"} and len(left) == 16
    assert all("no position" in f["reason"] for f in left)


def test_one_point_cannot_place_them(flight, tmp_path, capsys):
    lines = (flight / "control.csv").read_text().splitlines()
    (tmp_path / "one.csv").write_text("\n".join([lines[0], *(line for line in lines if line.startswith("p0,"))]))
    out = tmp_path / "out"
    assert mosaic(flight, "bare", out, "--control", tmp_path / "one.csv") == 1
    assert "has no position" in capsys.readouterr().err and not out.exists()


@pytest.mark.parametrize("flies", [True, False])
def test_pictures_recorded_at_one_spot_are_a_map_only_if_they_show_one(tmp_path, flies, capsys):
    """A receiver that wanders about one place while the vehicle flies, and a vehicle that hovers there."""
    rng, shots = np.random.default_rng(2), legs(count=2, photos=5, noise=0.0)
    noise = rng.normal(scale=0.4, size=(len(shots), 2))
    if flies:
        shots = [replace(s, recorded=(e - s.east, n - s.north)) for s, (e, n) in zip(shots, noise, strict=True)]
    else:
        shots = [replace(s, east=e, north=n, yaw=s.yaw + k) for k, (s, (e, n)) in enumerate(zip(shots, noise))]
    Scene().fly(tmp_path / "photos", shots)
    assert mosaic(tmp_path, "photos", tmp_path / "out") == (1 if flies else 0)
    if flies:
        assert "told one spot, but the pictures show that it flew on" in capsys.readouterr().err
    assert (tmp_path / "out" / "orthoimage.tif").exists() != flies


@pytest.fixture(scope="module")
def kite(tmp_path_factory):
    """Photos that each look another way from another height, and points that one photo shows, marked in no other."""
    folder, scene, rng = tmp_path_factory.mktemp("kite"), Scene(), np.random.default_rng(5)
    shots = [
        replace(
            s,
            tags="none",
            height=s.height * rng.uniform(0.8, 1.25),
            yaw=rng.uniform(0.0, 360.0),
            pitch=s.pitch + rng.uniform(-15.0, 15.0),
            roll=rng.uniform(-15.0, 15.0),
        )
        for s in legs(count=3, photos=8)
    ]
    scene.fly(folder / "photos", shots)
    survey(folder / "marks.csv", scene, {f"DJI_{k:04d}.JPG": s for k, s in enumerate(shots)}, POINTS)
    return scene, shots, folder


POINTS = [(-60.0, -20.0), (55.0, 0.0), (-30.0, 45.0)]


def one_mark_a_point(table, count):
    """The table with the first mark of each of the first points."""
    title, *lines = table.read_text().splitlines()
    first = {line.split(",")[0]: line for line in reversed(lines)}
    (table.parent / "few.csv").write_text("\n".join([title, *(first[f"p{k}"] for k in range(count))]))
    return table.parent / "few.csv"


@pytest.mark.slow
@pytest.mark.parametrize("points", [2, 3])
def test_photos_that_all_look_another_way_are_placed_by_points_in_one_photo_each(kite, tmp_path, points):
    scene, shots, folder = kite
    out = tmp_path / "out"
    assert mosaic(folder, "photos", out, "--control", one_mark_a_point(folder / "marks.csv", points)) == 0
    rows = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    used = [row for row in rows if row["stage"] != "rejected"]
    report = json.loads((out / "report.json").read_text())
    assert report["frames"]["used"] == len(used) == 24
    middle = np.array([(0.5 * (s.size[0] - 1), 0.5 * (s.size[1] - 1)) for s in shots])
    truth = [scene.camera(s).to_ground(m[None])[0] for s, m in zip(shots, middle)]
    away = []
    for row in used:
        k = int(row["image"][-8:-4])
        at = np.array(row["homography"]) @ [*middle[k], 1.0]
        away.append(float(np.hypot(*(at[:2] / at[2] - truth[k][:2]))))
    assert np.median(away) < 1.5 and max(away) < 5.0
    assert not any("one spot" in w or "receivers say" in w for w in report["warnings"])


@pytest.mark.slow
def test_a_kites_photos_are_a_map_and_no_heap(real_data, tmp_path):
    """Oblique photos from 160 to 480 m above a town; of three points two are marked, each in one of these photos."""
    source = real_data("ochota_kite_1000")
    for k in range(3018, 3041):
        if (photo := source / f"img_{k}.jpg").exists():
            (tmp_path / "kite").mkdir(exist_ok=True)
            shutil.copy(photo, tmp_path / "kite")
    out = tmp_path / "out"
    assert mosaic(tmp_path, "kite", out, "--control", source / "gcp_list.txt", "--gsd", "1") == 0
    report = json.loads((out / "report.json").read_text())
    rows = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    used = {row["image"]: np.array(row["homography"]) for row in rows if row["stage"] != "rejected"}
    assert report["frames"]["used"] == len(used) >= 16
    middle = np.array([h @ [499.5, 374.5, 1.0] for h in used.values()])
    assert np.ptp(middle[:, 0] / middle[:, 2]) > 100.0  # metres
    assert report["control"]["points"] == 2 and report["control"]["residual_rms_m"] < 1.0
    assert any("img_3015.jpg" in w and "not here" in w for w in report["warnings"])
    assert not any("one spot" in w or "receivers say" in w for w in report["warnings"])


@pytest.mark.slow
def test_photos_of_a_receiver_that_froze_are_placed_by_the_photos_beside_them(tmp_path):
    scene = Scene()
    shots = legs(count=2, photos=8)
    frozen = shots[10]
    told = [
        replace(s, recorded=tuple(np.add((frozen.east, frozen.north), frozen.recorded) - (s.east, s.north)))
        if k > 10
        else s
        for k, s in enumerate(shots)
    ]
    scene.fly(tmp_path / "photos", told)
    out = tmp_path / "out"
    assert mosaic(tmp_path, "photos", out) == 0
    rows = {r["image"]: r for r in map(json.loads, (out / "frames.jsonl").read_text().splitlines())}
    assert all(rows[f"DJI_{k:04d}.JPG"]["stage"] != "rejected" for k in range(16))
    assert max(scene.error_m(rows[f"DJI_{k:04d}.JPG"], shots[k]) for k in range(11, 16)) < 3.0
    report = json.loads((out / "report.json").read_text())
    assert any("were placed by the photos beside them" in w for w in report["warnings"])


def near(flight, lat, lon, radius_m=150):
    return "--basemap", flight / "map.tif", "--near", f"{lat},{lon},{radius_m}"


@pytest.mark.slow
def test_photos_that_recorded_nothing_are_found_on_the_basemap_near_a_place(flight, tmp_path):
    scene, out = Scene(), tmp_path / "out"
    scene.basemap(flight / "map.tif")
    assert mosaic(flight, "bare", out, *near(flight, scene.lat + 3e-4, scene.lon)) == 0
    shots = {f"{vehicle}/DJI_{i:04d}.JPG": s for (vehicle, i), s in taken().items()}
    rows = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    assert len(rows) == 32 and {row["stage"] for row in rows} == {"fine"}
    assert np.median([scene.error_m(row, shots[row["image"]]) for row in rows]) < 0.3
    report = json.loads((out / "report.json").read_text())
    assert any("32 photos without a position were placed by the basemap" in w for w in report["warnings"])
    assert not any("receivers say" in w for w in report["warnings"])
    assert mosaic(flight, "mixed/a", out, *near(flight, scene.lat, scene.lon), "--until", "realtime") == 0
    report = json.loads((out / "report.json").read_text())
    assert "--near was not used: every picture has a position" in report["warnings"]


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (("--near", "47.4,8.5"), "give one with --basemap"),
        (("--near", "47.4"), "is not LAT,LON[,M]"),
        (("--near", "947.4,8.5"), "latitude to 80"),
    ],
)
def test_a_place_that_makes_no_sense_is_refused(flight, tmp_path, capsys, option, said):
    assert mosaic(flight, "bare", tmp_path / "out", *option) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_photos_of_other_ground_are_not_found_on_a_basemap(flight, tmp_path, capsys):
    other, out = Scene(seed=8), tmp_path / "out"
    other.basemap(flight / "map.tif")
    assert mosaic(flight, "bare", out, *near(flight, other.lat, other.lon)) == 1
    assert "were not found on the basemap" in capsys.readouterr().err and not out.exists()
