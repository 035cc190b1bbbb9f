"""Measuring orthoimages and poses: known shifts come out, nothing is matched that is not there."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs_plugin.cli.main import main
from orthoswarm.evaluation.displacement import FieldSettings, accuracy, completeness, displacement_field
from orthoswarm.evaluation.true_cameras import Placement, camera_from_homography, pose_errors
from orthoswarm.model.camera import Camera, Lens, angles_from_rotation, rotation_from_angles
from orthoswarm.twin.city.procedural_noise import noise_field

SETTINGS = FieldSettings(gsd_m=0.5, block_m=30.0, step_m=20.0, search_m=6.0)
SHAPE = (200, 220)


def texture(seed=1):
    return 120 + 90 * noise_field((SHAPE[0] + 60, SHAPE[1] + 60), 0.5, 9.0, 5, seed)


def shifted(image, east_m, north_m):
    """The picture with its content moved, by an exact Fourier shift, cut to SHAPE."""
    rows, cols = np.fft.fftfreq(image.shape[0])[:, None], np.fft.fftfreq(image.shape[1])[None, :]
    phase = np.exp(-2j * np.pi * (cols * east_m / 0.5 - rows * north_m / 0.5))
    moved = np.fft.ifft2(np.fft.fft2(image) * phase).real
    return moved[30:-30, 30:-30].astype(np.float32)


ALL = np.ones(SHAPE, bool)


@settings(max_examples=12, deadline=None)
@given(st.floats(-4, 4), st.floats(-4, 4), st.integers(0, 50))
def test_a_known_shift_is_measured(east, north, seed):
    image = texture(seed)
    field = displacement_field(shifted(image, east, north), ALL, shifted(image, 0, 0), ALL, settings=SETTINGS)
    assert field.matched.mean() > 0.9
    np.testing.assert_allclose(np.median(field.shift_m[field.matched], axis=0), [east, north], atol=0.04)
    assert np.percentile(np.hypot(*(field.shift_m[field.matched] - [east, north]).T), 95) < 0.1


def test_light_and_contrast_do_not_matter():
    image = texture()
    other = 30 + 0.4 * shifted(image, 1.0, -0.5) + np.linspace(0, 80, SHAPE[1])[None, :]
    field = displacement_field(other.astype(np.float32), ALL, shifted(image, 0, 0), ALL, settings=SETTINGS)
    np.testing.assert_allclose(np.median(field.shift_m[field.matched], axis=0), [1.0, -0.5], atol=0.05)
    assert np.median(field.contrast[field.matched]) == pytest.approx(0.4, rel=0.1)


def test_other_ground_is_not_matched():
    for other in (shifted(texture(2), 0, 0), np.full(SHAPE, 90, np.float32)):
        field = displacement_field(other, ALL, shifted(texture(1), 0, 0), ALL, settings=SETTINGS)
        assert len(field.matched) == 20
        assert field.matched.mean() < 0.15
    measured = accuracy(field, completeness(ALL, ALL), 40.0)
    assert measured.unmatched_share > 0.9
    assert measured.share_within_1m < 0.1


def test_stripes_have_no_place_along_themselves():
    rows = np.tile(128 + 60 * np.sin(np.arange(SHAPE[1]) * 2 * np.pi / 10), (SHAPE[0], 1)).astype(np.float32)
    assert displacement_field(rows, ALL, rows, ALL, settings=SETTINGS).matched.mean() < 0.1


def test_masked_ground_takes_no_part():
    """Half of each block shows something that moved by 3 m; masked away, the rest is measured alone."""
    image = texture()
    fixed, moved = shifted(image, 0, 0), shifted(image, 3.0, 0.0)
    stripes = (np.arange(SHAPE[1]) // 20) % 2 == 0
    mixed = np.where(stripes[None, :], fixed, moved).astype(np.float32)
    mask = np.tile(stripes, (SHAPE[0], 1))
    field = displacement_field(mixed, ALL, fixed, mask, settings=SETTINGS)
    assert field.matched.mean() > 0.8
    np.testing.assert_allclose(np.median(field.shift_m[field.matched], axis=0), [0, 0], atol=0.06)


def test_blocks_that_the_orthoimage_does_not_cover_do_not_count():
    image = shifted(texture(), 0, 0)
    half = ALL.copy()
    half[:, SHAPE[1] // 2 :] = False
    field = displacement_field(image, half, image, ALL, settings=SETTINGS)
    whole = displacement_field(image, ALL, image, ALL, settings=SETTINGS)
    assert 0 < len(field.matched) < 0.75 * len(whole.matched)
    assert field.position[:, 0].max() < SHAPE[1] // 2 + 20


def test_holes_lower_completeness_and_the_outside_does_not():
    valid = np.zeros((100, 100), bool)
    valid[20:80, 20:80] = True
    assert completeness(valid, np.ones((100, 100), bool)) == 1.0
    valid[40:60, 40:60] = False
    assert completeness(valid, np.ones((100, 100), bool)) == pytest.approx(1 - 400 / 3600, abs=0.01)
    assert completeness(np.zeros((9, 9), bool), np.ones((9, 9), bool)) == 0.0


small = st.floats(-0.3, 0.3)


@given(st.floats(-3, 3), small, small, st.floats(60, 110), st.floats(-5, 5))
def test_a_homography_gives_its_camera_back(yaw, tilt, roll, fov, ground):
    lens = Lens(640, 480, 320 / np.tan(np.radians(fov) / 2), k1=-0.04)
    camera = Camera(np.array([4e5, 3.4e6, 150.0]), rotation_from_angles(yaw, tilt - np.pi / 2, roll), lens)
    back = camera_from_homography(camera.homography(ground), lens, ground)
    np.testing.assert_allclose(back.position, camera.position, atol=1e-4)
    np.testing.assert_allclose(
        np.unwrap(np.array([angles_from_rotation(back.rotation), angles_from_rotation(camera.rotation)]), axis=0)[0],
        angles_from_rotation(back.rotation),
    )
    np.testing.assert_allclose(back.rotation, camera.rotation, atol=1e-7)


def test_honest_sigmas_hold_68_and_95_percent_of_the_errors():
    rng = np.random.default_rng(5)
    lens = Lens(640, 480, 300.0)
    placed, truth = [], []
    for i in range(1500):
        true = Camera(np.array([4e5, 3.4e6, 150.0]), rotation_from_angles(rng.uniform(-3, 3), -1.5, 0.02), lens)
        sigma = rng.uniform(0.05, 0.4)
        moved = Camera(true.position + np.array([*rng.normal(0, sigma, 2), 0.0]), true.rotation, lens)
        fov = float(np.degrees(lens.fov_rad))
        placed.append(Placement(f"a/{i}", "a", moved.homography(), fov, sigma))
        truth.append(true)
    figures = pose_errors(placed, truth, 0.0, 0.0).figures()
    assert figures["sigma_within_1"] == pytest.approx(0.68, abs=0.03)
    assert figures["sigma_within_2"] == pytest.approx(0.95, abs=0.02)
    assert figures["sigma_nadir_within_1"] == pytest.approx(0.68, abs=0.03)
    assert figures["sigma_axis_within_1"] == figures["sigma_within_1"]
    assert figures["sigma_length_within_1"] == pytest.approx(0.39, abs=0.03)
    assert figures["sigma_length_within_2"] == pytest.approx(0.86, abs=0.03)
    assert figures["sigma_nadir_length_within_2"] == pytest.approx(0.86, abs=0.03)
    assert figures["fov_error_deg"]["a"] == pytest.approx(0.0, abs=1e-9)
    assert figures["camera_up_median_m"] == pytest.approx(0.0, abs=1e-6)
    assert 0.15 < figures["camera_horizontal_median_m"] < 0.4


def write(path, data, west=400000.0, epsg=32633, alpha=None):
    import rasterio
    from rasterio.transform import from_origin

    bands = [data] * 3 + ([alpha] if alpha is not None else [])
    profile = {
        "driver": "GTiff", "width": data.shape[1], "height": data.shape[0], "count": len(bands), "dtype": "uint8",
        "crs": f"EPSG:{epsg}", "transform": from_origin(west, 5000000.0, 0.5, 0.5),
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as file:
        for i, band in enumerate(bands, start=1):
            file.write(band.astype(np.uint8), i)
    return path


def test_the_command_measures_files_and_says_the_contracts_keys(tmp_path, capsys):
    picture = np.clip(shifted(texture(), 0, 0), 0, 255)
    alpha = np.full(SHAPE, 255)
    alpha[80:120, 80:120] = 0
    reference = write(tmp_path / "reference.tif", picture)
    ortho = write(tmp_path / "ortho.tif", picture, west=400000.5, alpha=alpha)
    assert main(["evaluate", str(ortho), "--reference", str(reference), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert {"median_m", "p90_m", "p95_m", "unmatched_share", "completeness"} <= figures.keys()
    assert figures["median_m"] == pytest.approx(0.5, abs=0.05)
    assert figures["mean_east_m"] == pytest.approx(0.5, abs=0.05)
    assert figures["mean_north_m"] == pytest.approx(0.0, abs=0.05)
    assert figures["completeness"] == pytest.approx(1 - 1600 / (SHAPE[0] * SHAPE[1]), abs=0.01)
    assert main(["evaluate", str(ortho), "--reference", str(reference), "--field", str(tmp_path / "f.csv")]) == 0
    assert "median_m" in capsys.readouterr().out
    assert np.loadtxt(tmp_path / "f.csv", delimiter=",", skiprows=1).shape[1] == 5


def test_a_mask_beside_the_reference_is_used_unless_told_otherwise(tmp_path, capsys):
    picture = np.clip(shifted(texture(), 0, 0), 0, 255)
    reference = write(tmp_path / "reference.tif", picture)
    write(tmp_path / "ground_mask.tif", np.where(np.arange(SHAPE[1])[None, :] < 110, 255, 0) * np.ones(SHAPE))
    args = ["evaluate", str(reference), "--reference", str(reference), "--json"]
    assert main(args) == 0
    masked = json.loads(capsys.readouterr().out)
    assert main([*args, "--mask", "none"]) == 0
    whole = json.loads(capsys.readouterr().out)
    assert (masked["mask"], whole["mask"]) == ("ground_mask.tif", None)
    assert masked["blocks"] < whole["blocks"]


def test_files_that_cannot_be_compared_are_refused(tmp_path, capsys):
    picture = np.clip(shifted(texture(), 0, 0), 0, 255)
    here = write(tmp_path / "here.tif", picture)
    there = write(tmp_path / "there.tif", picture, west=500000.0)
    (tmp_path / "no.tif").write_text("no raster")
    for other, word in (
        (there, "do not overlap"),
        (tmp_path / "no.tif", "cannot be read"),
        (tmp_path / "x", "cannot be"),
    ):
        assert main(["evaluate", str(here), "--reference", str(other)]) == 2
        assert word in capsys.readouterr().err
    assert main(["evaluate", str(here), "--reference", str(here), "--poses", "frames.jsonl"]) == 2
    assert "belong together" in capsys.readouterr().err


def test_poses_are_compared_with_a_table_of_true_cameras(tmp_path, capsys):
    from orthoswarm.model.geo import LocalGrid

    grid, lens = LocalGrid(32633), Lens(640, 480, 300.0)
    lines, rows = [], ["image,vehicle,time,easting,northing,height,yaw_deg,pitch_deg,roll_deg,fov_deg,k1,k2,epsg"]
    for i in range(5):
        position = np.array([400050.0 + i, 4999950.0, 120.0])
        lat, lon = grid.to_geographic(position[:2])
        yaw = np.radians(30.0 + i)
        camera = Camera(position, rotation_from_angles(yaw - grid.convergence_rad(lat, lon), -1.5, 0.03), lens)
        off = Camera(position + np.array([0.3, -0.4, 0.0]), camera.rotation, lens)
        fov = float(np.degrees(lens.fov_rad))
        angles = f"{30.0 + i},{np.degrees(-1.5)},{np.degrees(0.03)}"
        rows.append(f"u/{i}.JPG,u,2025-01-01T00:00:00Z,{position[0]},{position[1]},120,{angles},{fov},0,0,32633")
        placed = {"image": f"photos/u/{i}.JPG", "stage": "fine", "epsg": 32633, "fov_deg": fov, "sigma_m": 0.35}
        lines.append(json.dumps({**placed, "homography": off.homography().tolist()}))
    lines.append(json.dumps({"image": "photos/u/9.JPG", "stage": "rejected", "reason": "dark"}))
    (tmp_path / "frames.jsonl").write_text("\n".join(lines))
    (tmp_path / "truth.csv").write_text("\n".join(rows))
    picture = write(tmp_path / "a.tif", np.clip(shifted(texture(), 0, 0), 0, 255))
    poses = ["--poses", str(tmp_path / "frames.jsonl"), "--truth", str(tmp_path / "truth.csv")]
    assert main(["evaluate", str(picture), "--reference", str(picture), "--json", *poses]) == 0
    everything = json.loads(capsys.readouterr().out)
    figures = everything["poses"]
    assert 0.05 < everything["seen_share"] < 0.9  # the cameras see far beyond the small raster
    assert figures["frames_compared"] == 5
    assert figures["camera_horizontal_median_m"] == pytest.approx(0.5, abs=1e-3)
    assert figures["center_ground_median_m"] == pytest.approx(0.5, abs=1e-3)
    assert (figures["sigma_within_1"], figures["sigma_within_2"]) == (0.5, 1.0)  # 0.3 and 0.4 m with a sigma of 0.35
    assert (figures["sigma_length_within_1"], figures["sigma_length_within_2"]) == (0.0, 1.0)  # 0.5 m
