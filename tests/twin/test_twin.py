"""A small set of the digital twin: what lies where, what the photos say, and that all of it fits together."""

import csv
import json
import re
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest

from gcs_plugin.cli.main import main
from orthoswarm.evaluation.true_cameras import read_truth
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.raster.picture_file import read_gray
from orthoswarm.twin.flights import FlightPlan
from orthoswarm.twin.make import make_twin
from orthoswarm.twin.presets import spec
from orthoswarm.twin.site import with_heading

SMALL = FlightPlan(
    columns=1, photos=8, legs=2, spacing_m=15.0, leg_spacing_m=20.0, width=160, height=120, height_m=40.0
)


def small(**changes):
    return spec("tiny", **{"plan": SMALL, "margin_m": 80.0, **changes})


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    folder = tmp_path_factory.mktemp("twin") / "set"
    assert main(["twin", "make", "tiny", "--out", str(folder), "--seed", "6", "--disaster", "debris"]) == 0
    return folder


def truth_rows(folder):
    with (folder / "truth" / "frames.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def xmp(path):
    return dict(re.findall(r'drone-dji:(\w+)="([^"]+)"', path.read_bytes()[:6000].decode("latin1")))


def test_a_set_has_photos_map_plan_and_its_truth_apart(tiny):
    photos = sorted((tiny / "photos").glob("*/*.JPG"))
    assert len(photos) == 40
    assert sorted(p.name for p in tiny.iterdir()) == ["basemap.tif", "photos", "plan.geojson", "truth"]
    truth = {p.name for p in (tiny / "truth").iterdir()}
    assert {"frames.csv", "reference.tif", "dsm.tif", "dtm.tif", "ground_mask.tif", "manifest.json"} <= truth
    assert {p.relative_to(tiny / "photos").as_posix() for p in photos} == {r["image"] for r in truth_rows(tiny)}
    assert not list(tiny.rglob("*.part"))
    plan = json.loads((tiny / "plan.geojson").read_text())
    assert [f["properties"]["role"] for f in plan["features"]] == ["area", "path", "path"]


def test_photos_do_not_tell_their_field_of_view(tiny):
    from PIL import Image

    path = next((tiny / "photos").glob("*/*.JPG"))
    with Image.open(path) as image:
        exif = image.getexif()
        tags = {*exif, *exif.get_ifd(0x8769)}
    assert not tags & {0x920A, 0xA405, 0xA20E}  # focal length, 35 mm equivalent, focal plane resolution
    assert "fov" not in path.read_bytes()[:6000].decode("latin1").lower()


def test_exif_and_xmp_of_a_photo_agree(tiny):
    from PIL import Image

    rows = truth_rows(tiny)
    for row in rows[::9]:
        path = tiny / "photos" / row["image"]
        with Image.open(path) as image:
            exif = image.getexif()
            gps, detail = exif.get_ifd(0x8825), exif.get_ifd(0x8769)
        tags = xmp(path)
        for values, key in ((gps[2], "GpsLatitude"), (gps[4], "GpsLongitude")):
            degrees = float(values[0]) + float(values[1]) / 60 + float(values[2]) / 3600
            assert degrees == pytest.approx(float(tags[key]), abs=1e-9)
        assert float(gps[6]) == pytest.approx(float(tags["AbsoluteAltitude"]), abs=1e-3)
        moment = datetime.strptime(f"{detail[0x9003]}.{detail[0x9291]} +0000", "%Y:%m:%d %H:%M:%S.%f %z")
        assert moment.timestamp() == pytest.approx(datetime.fromisoformat(row["time"]).timestamp(), abs=1e-3)


def test_the_papers_noise_is_in_positions_only(tiny):
    rows = truth_rows(tiny)
    grid = LocalGrid(int(rows[0]["epsg"]))
    far = []
    for i, row in enumerate(rows):
        tags, index = xmp(tiny / "photos" / row["image"]), i % 20
        east, north = grid.to_grid(float(tags["GpsLatitude"]), float(tags["GpsLongitude"]))
        error = np.array([east - float(row["easting"]), north - float(row["northing"])])
        assert (np.abs(error) <= 1.0 + 0.1 * index + 1e-3).all()
        far.append(np.abs(error).max())
        for key, name in (("GimbalYawDegree", "yaw_deg"), ("GimbalPitchDegree", "pitch_deg")):
            assert float(tags[key]) == pytest.approx(float(row[name]), abs=2e-3)
        assert float(tags["RelativeAltitude"]) == pytest.approx(float(row["height"]), abs=1e-2)
    assert np.median(far) > 0.3


def gradient(gray):
    import cv2

    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.2)
    g = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) + 1j * cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    return g / (np.abs(g) + np.median(np.abs(g)))


def shift_of(moving, fixed):
    """Shift in pixels (columns, rows) of one gradient field against another, by FFT."""
    score = np.fft.ifft2(np.fft.fft2(moving) * np.conj(np.fft.fft2(fixed))).real
    r, c = np.unravel_index(score.argmax(), score.shape)
    rows, cols = score.shape

    def vertex(a, b, d):
        return 0.5 * (a - d) / (a - 2 * b + d)

    dr = r + vertex(score[r - 1, c], score[r, c], score[(r + 1) % rows, c])
    dc = c + vertex(score[r, c - 1], score[r, c], score[r, (c + 1) % cols])
    return np.array([(dc + cols / 2) % cols - cols / 2, (dr + rows / 2) % rows - rows / 2])


@pytest.mark.parametrize(("raster", "bound_m"), [("truth/reference.tif", 0.1), ("basemap.tif", 0.35)])
def test_photos_fall_on_reference_and_map_with_their_true_poses(tiny, raster, bound_m):
    """The whole geometry at once: EXIF-free truth, rendering, leaning map, true orthoimage."""
    import cv2
    import rasterio

    with rasterio.open(tiny / raster) as file:
        picture, place = file.read([1, 2, 3]).mean(0), file.transform
    with rasterio.open(tiny / "truth" / "ground_mask.tif") as file:
        ground, cells = file.read(1) > 0, file.transform
    if (tiny / "truth" / "disaster_mask.tif").exists() and raster == "basemap.tif":
        with rasterio.open(tiny / "truth" / "disaster_mask.tif") as file:
            ground &= file.read(1) == 0
    errors = []
    for image, (_, _, camera) in list(read_truth(tiny / "truth" / "frames.csv").items()):
        step = place.a
        col, row = ((camera.position[0] - place.c) / step, (place.f - camera.position[1]) / step)
        half = int(32 / step)
        cols, rows = np.meshgrid(int(col) + np.arange(-half, half), int(row) + np.arange(-half, half))
        east, north = place.c + (cols + 0.5) * step, place.f - (rows + 0.5) * step
        seen = ground[((cells.f - north) / 0.5).astype(int), ((east - cells.c) / 0.5).astype(int)]
        if seen.mean() < 0.5:
            continue
        pixels = camera.project(np.stack([east, north, np.zeros_like(east)], -1)).astype(np.float32)
        photo = cv2.remap(read_gray(tiny / "photos" / image), pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)
        theirs = picture[rows, cols]
        errors.append(step * np.hypot(*shift_of(gradient(photo) * seen, gradient(theirs) * seen)))
    assert len(errors) >= 8
    assert np.median(errors) < 0.3 * bound_m
    assert np.mean(np.array(errors) < bound_m) > 0.85


def test_the_same_spec_gives_the_same_bytes_and_an_interrupted_set_goes_on(tmp_path):
    first = make_twin(small(), tmp_path / "a", only=3)
    assert (first.made, first.photos) == (3, 8)
    again = make_twin(small(), tmp_path / "a")
    assert again.made == 5
    make_twin(small(), tmp_path / "b", workers=2)
    for name in ["basemap.tif", *(f"photos/uav01/DJI_{i + 1:04d}.JPG" for i in range(8)), "truth/frames.csv"]:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    with pytest.raises(InputError, match="other parameters"):
        make_twin(small(seed=2), tmp_path / "a")


def test_wrong_arguments_are_refused_in_one_sentence(tmp_path, capsys):
    for args, word in (
        (["nowhere"], "no preset"), (["tiny", "--noise", "loud"], "no noise"), (["tiny", "--lens", "a"], "two numbers"),
        (["tiny", "--ground", "x.tif"], "--surface"), (["tiny", "--legs", "900"], "more --photos"),
    ):  # fmt: skip
        assert main(["twin", "make", *args, "--out", str(tmp_path / "x")]) == 2
        assert word in capsys.readouterr().err


def test_a_real_place_keeps_its_own_crs(tmp_path, real_data):
    import rasterio

    folder = real_data("autzen")
    ground = (
        str(folder / "autzen_ortho_0.3m_utm10.tif"),
        str(folder / "autzen_dsm_0.5m_utm10_cm.tif"),
        str(folder / "autzen_ground_approx_0.5m_utm10_cm.tif"),
    )
    plan = replace(SMALL, photos=3, legs=1)
    made = make_twin(with_heading(small(plan=plan, ground=ground, disaster="none")), tmp_path / "set")
    assert made.photos == 3
    with rasterio.open(tmp_path / "set" / "basemap.tif") as file:
        assert file.crs.to_epsg() == 32610
        assert file.read(1).std() > 15
    assert read_gray(tmp_path / "set" / "photos" / "uav01" / "DJI_0002.JPG").std() > 10
