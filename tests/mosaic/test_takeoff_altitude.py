"""Altitudes: one level for vehicles that were solved together, one each for those that were not, with its error."""

import json
from pathlib import Path

import numpy as np
import pytest

from orthoswarm.export.camera_folders import write_odm, write_opensfm
from orthoswarm.export.product_files import read_frames, write_frames
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame

GRID = LocalGrid(32632)
LENS = Lens(640, 480, 420.0)
NADIR = rotation_from_angles(0.0, -np.pi / 2, 0.0)
CORNER = np.array([465_000.0, 5_250_000.0])


def leg(vehicle, at, level, *, stage="coarse", up_sigma=None, position_sigma=None):
    """Five cameras 80 m up, 20 m apart, of a vehicle whose recorded altitudes put its zero at a level (None: none)."""
    made = []
    for k in range(5):
        position = np.array([*(CORNER + at + (0.0, 20.0 * k)), 80.0 + k])
        fix = Fix(47.4, 8.5, 80.0, altitude_m=None if level is None else level + 80.0 + k,
                  position_sigma_m=position_sigma)  # fmt: skip
        image = f"{vehicle}/{k}.jpg"
        frame = Frame(image=image, path=Path(image), vehicle=vehicle, time_s=None, fix=fix, width=640, height=480)
        covariance = None if up_sigma is None else np.diag([0.01, 0.01, (up_sigma + 0.1 * k) ** 2, 0, 0, 0])
        made.append(PlacedFrame(frame, Camera(position, NADIR, LENS), stage, 0.2, pose_covariance=covariance))
    return made


def cameras(folder, placed):
    """`camera` of each line of frames.jsonl by image."""
    folder.mkdir(exist_ok=True)
    write_frames(folder, placed, [], GRID, 0.0)
    return {row["image"]: row["camera"] for row in read_frames(folder / "frames.jsonl")}


def levels(rows):
    return {image.split("/")[0]: row["altitude_m"] - row["height_m"] for image, row in rows.items()}


def test_vehicles_that_were_solved_together_have_one_level(tmp_path):
    placed = leg("a", (0, 0), 500.0) + leg("b", (60, 0), 501.0) + leg("c", (120, 0), 508.0) + leg("d", (180, 0), None)
    rows = cameras(tmp_path, placed)
    assert levels(rows) == pytest.approx({"a": 501.0, "b": 501.0, "c": 501.0, "d": 501.0})
    near = {row["altitude_sigma_m"] for row in rows.values()}
    assert min(near) >= 3.0  # that of receivers which state nothing
    apart = leg("a", (0, 0), 490.0) + leg("b", (60, 0), 501.0) + leg("c", (120, 0), 512.0)
    assert min(row["altitude_sigma_m"] for row in cameras(tmp_path, apart).values()) > 11.0  # they disagree by more


def test_vehicles_that_were_not_solved_together_have_each_their_own(tmp_path):
    far = leg("a", (0, 0), 500.0) + leg("b", (3000, 0), 540.0)
    assert levels(cameras(tmp_path, far)) == pytest.approx({"a": 500.0, "b": 540.0})
    recorded = leg("a", (0, 0), 500.0, stage="realtime") + leg("b", (60, 0), 540.0, stage="realtime")
    assert levels(cameras(tmp_path, recorded)) == pytest.approx({"a": 500.0, "b": 540.0})


def test_a_chain_of_neighbours_is_one_block(tmp_path):
    chain = [p for k in range(6) for p in leg(f"v{k}", (100.0 * k, 0), 500.0 + k)]
    assert list(levels(cameras(tmp_path, chain)).values()) == pytest.approx([502.5] * 6)


def test_an_opensfm_block_keeps_the_relative_orientation(tmp_path):
    placed = leg("a", (0, 0), 500.0) + leg("b", (60, 0), 505.0)
    cameras(tmp_path, placed)
    write_opensfm(list(read_frames(tmp_path / "frames.jsonl")), lambda row: None, tmp_path / "sfm")
    (made,) = json.loads((tmp_path / "sfm" / "reconstruction.json").read_text())
    up = {name: shot["gps_position"][2] for name, shot in made["shots"].items()}
    one, other = (np.array([up[n] for n in sorted(up) if n.startswith(v)]) for v in "ab")
    assert one == pytest.approx(other, abs=0.01)


def test_opendronemap_is_told_the_error_of_the_altitudes(tmp_path):
    (tmp_path / "x.jpg").write_bytes(b"a picture")

    def vertical(placed):
        cameras(tmp_path, placed)
        write_odm(list(read_frames(tmp_path / "frames.jsonl")), lambda row: tmp_path / "x.jpg", tmp_path / "odm")
        return [float(line.split()[-1]) for line in (tmp_path / "odm" / "geo.txt").read_text().splitlines()[1:]]

    plain = vertical(leg("a", (0, 0), 500.0, up_sigma=1.0))
    assert plain[0] == pytest.approx(3.0, abs=0.01) and plain[-1] == pytest.approx(np.hypot(3.0, 0.98), abs=0.01)
    corrected = vertical(leg("a", (0, 0), 500.0, up_sigma=1.0, position_sigma=0.02))
    assert corrected[0] == pytest.approx(0.04, abs=0.001)  # what all heights have in common is in no altitude
    assert vertical(leg("a", (0, 0), None, up_sigma=1.0))[0] == pytest.approx(1.0)  # heights have it
