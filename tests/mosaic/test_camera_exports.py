"""Exported cameras: a ground point falls on the same pixel through the exported camera as through ours."""

import json

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from orthoswarm.export.camera_folders import camera_of, write_colmap, write_odm, write_opensfm
from orthoswarm.export.product_files import frame_row
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame

GRID = LocalGrid(32648)
LENSES = {
    "pinhole": Lens(640, 480, 420.0),
    "radial": Lens(640, 480, 420.0, k1=-0.08, k2=0.01),
    "full": Lens(800, 600, 650.0, k1=-0.1, k2=0.03, k3=-0.004, cx=6.0, cy=-4.0),
}


def flight(tmp_path):
    """Six cameras some 200 m apart, each lens twice, with their picture files and lines of frames.jsonl."""
    rng = np.random.default_rng(4)
    centre = GRID.to_grid(30.57, 103.2)
    cameras, rows = [], []
    for i, lens in enumerate([*LENSES.values()] * 2):
        angles = np.radians([rng.uniform(0, 360), -90 + rng.normal(0, 8), rng.normal(0, 8)])
        position = np.append(centre + rng.uniform(-200, 200, 2), rng.uniform(90, 150))
        camera = Camera(position, rotation_from_angles(*angles), lens)
        name = f"uav/{i}.jpg"
        frame = Frame(
            image=name,
            path=tmp_path / name,
            vehicle="uav",
            time_s=None,
            fix=Fix(0, 0),
            width=lens.width,
            height=lens.height,
        )
        cameras.append(camera)
        rows.append(frame_row(PlacedFrame(frame, camera, "fine", 0.1), GRID, 0.0))
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"a picture")
    return cameras, [json.loads(json.dumps(row)) for row in rows]


def ground_seen(camera):
    """Ground points (25, 3) that a camera sees, and their pixels."""
    lens = camera.lens
    u, v = np.meshgrid(np.linspace(20, lens.width - 21, 5), np.linspace(20, lens.height - 21, 5))
    pixels = np.stack([u.ravel(), v.ravel()], 1)
    ground = camera.to_ground(pixels, 3.0)
    return np.column_stack([ground, np.full(len(ground), 3.0)]), pixels


def test_the_camera_block_of_frames_jsonl_is_the_camera(tmp_path):
    cameras, rows = flight(tmp_path)
    for camera, row in zip(cameras, rows):
        ground, pixels = ground_seen(camera)
        assert np.abs(camera_of(row).project(ground) - pixels).max() < 1e-3


def test_a_reader_of_the_homography_needs_the_two_terms_beside_it_and_no_more(tmp_path):
    cameras, rows = flight(tmp_path)
    for camera, row in zip(cameras, rows):
        wide, (_, pixels) = camera.lens, ground_seen(camera)
        lens = Lens(wide.width, wide.height, wide.focal_px, k1=row.get("k1", 0.0), k2=row.get("k2", 0.0))
        assert row["fov_deg"] == pytest.approx(np.degrees(lens.fov_rad))
        middle = np.array(lens.principal_point)
        plain = lens.undistort((pixels - middle) / lens.focal_px) * lens.focal_px + middle
        found = np.c_[plain, np.ones(len(plain))] @ np.array(row["homography"]).T
        pixel_m = camera.position[2] / lens.focal_px
        assert np.abs(found[:, :2] / found[:, 2:] - camera.to_ground(pixels, 0.0)).max() < 0.5 * pixel_m


def test_colmap_projects_ground_where_we_do(tmp_path):
    cameras, rows = flight(tmp_path)
    assert write_colmap(rows, lambda row: tmp_path / row["image"], tmp_path / "colmap") == []
    model = tmp_path / "colmap" / "sparse" / "0"
    lenses = {}
    for line in (model / "cameras.txt").read_text().splitlines()[1:]:
        number, kind, _, _, *values = line.split()
        lenses[number] = (kind, np.array(values, float))
    assert {kind for kind, _ in lenses.values()} == {"SIMPLE_PINHOLE", "RADIAL", "FULL_OPENCV"}
    epsg, *origin = (tmp_path / "colmap" / "origin.txt").read_text().split()
    assert epsg == "EPSG:32648"
    lines = (model / "images.txt").read_text().splitlines()[1:]
    poses = lines[::2]
    assert len(poses) == 6 and not any(lines[1::2])
    for camera, line in zip(cameras, poses):
        _, w, x, y, z, *t, number, name = line.split()
        assert (tmp_path / "colmap" / "images" / name).exists()
        ground, pixels = ground_seen(camera)
        local = Rotation.from_quat(np.array([x, y, z, w], float)).apply(ground - np.array(origin, float))
        local += np.array(t, float)
        xy = local[:, :2] / local[:, 2:]
        r2 = (xy**2).sum(1, keepdims=True)
        kind, p = lenses[number]
        if kind == "SIMPLE_PINHOLE":
            projected = p[0] * xy + p[1:3]
        elif kind == "RADIAL":
            projected = p[0] * xy * (1 + r2 * (p[3] + r2 * p[4])) + p[1:3]
        else:
            projected = p[:2] * xy * (1 + r2 * (p[4] + r2 * (p[5] + r2 * p[8]))) + p[2:4]
        assert np.abs(projected - 0.5 - pixels).max() < 1e-3  # COLMAP counts from the corner of the first pixel


@pytest.mark.parametrize(
    ("terms", "kind"),
    [
        ({"k1": 1e-17, "k2": -1e-16, "k3": 2e-16}, "SIMPLE_PINHOLE"),
        ({"k1": -0.08, "k2": 0.01, "k3": 2.5e-16, "cx": 7e-19}, "RADIAL"),
        ({"k1": -0.08, "k2": 0.01, "k3": 2e-6, "cx": 5.0}, "RADIAL"),  # 0.005 px in the corner
        ({"k1": -0.08, "k2": 0.01, "k3": 1e-4}, "FULL_OPENCV"),
    ],
)
def test_colmap_has_the_terms_that_move_pixels(tmp_path, terms, kind):
    camera = Camera(
        np.append(GRID.to_grid(30.57, 103.2), 100.0),
        rotation_from_angles(0.0, -1.5, 0.0),
        Lens(640, 480, 350.0, **terms),
    )
    frame = Frame(
        image="a.jpg", path=tmp_path / "a.jpg", vehicle="uav", time_s=None, fix=Fix(0, 0), width=640, height=480
    )
    rows = [frame_row(PlacedFrame(frame, camera, "fine", 0.1), GRID, 0.0)]
    write_colmap(rows, lambda row: None, tmp_path / "colmap")
    line = (tmp_path / "colmap" / "sparse" / "0" / "cameras.txt").read_text().splitlines()[1].split()
    assert line[1] == kind


def test_colmap_itself_reads_the_model(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    cameras, rows = flight(tmp_path)
    write_colmap(rows, lambda row: None, tmp_path / "colmap")
    model = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse" / "0"))
    origin = np.array((tmp_path / "colmap" / "origin.txt").read_text().split()[1:], float)
    for camera, number in zip(cameras, sorted(model.images)):
        ground, pixels = ground_seen(camera)
        projected = np.array([model.images[number].project_point(point) for point in ground - origin])
        assert np.abs(projected - 0.5 - pixels).max() < 1e-3


def test_opensfm_projects_ground_where_we_do(tmp_path):
    cameras, rows = flight(tmp_path)
    assert write_opensfm(rows, lambda row: tmp_path / row["image"], tmp_path / "sfm") == []
    (reconstruction,) = json.loads((tmp_path / "sfm" / "reconstruction.json").read_text())
    reference = reconstruction["reference_lla"]
    place = f"+lat_0={reference['latitude']!r} +lon_0={reference['longitude']!r} +h_0={reference['altitude']}"
    to_plane = Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 {place}"
    )
    assert len(reconstruction["shots"]) == 6
    for camera, (name, shot) in zip(cameras, reconstruction["shots"].items()):
        assert (tmp_path / "sfm" / "images" / name).exists()
        ground, pixels = ground_seen(camera)
        lat, lon = GRID.to_geographic(ground[:, :2]).T
        plane = np.stack(to_plane.transform(np.radians(lon), np.radians(lat), ground[:, 2], radians=True), 1)
        local = Rotation.from_rotvec(shot["rotation"]).apply(plane) + shot["translation"]
        xy = local[:, :2] / local[:, 2:]
        r2 = (xy**2).sum(1, keepdims=True)
        lens = reconstruction["cameras"][shot["camera"]]
        assert lens["projection_type"] == "brown"
        xy = xy * (1 + r2 * (lens["k1"] + r2 * (lens["k2"] + r2 * lens["k3"])))
        size = max(lens["width"], lens["height"])
        u = (lens["focal_x"] * xy[:, 0] + lens["c_x"]) * size + 0.5 * (lens["width"] - 1)
        v = (lens["focal_y"] * xy[:, 1] + lens["c_y"]) * size + 0.5 * (lens["height"] - 1)
        # the map's grid takes its scale of 0.9996 to 1.001 for 1, OpenSfM's plane does not
        assert np.abs(np.stack([u, v], 1) - pixels).max() < 0.3


@pytest.mark.parametrize("write", [write_odm, write_colmap, write_opensfm])
def test_pictures_of_one_name_by_two_vehicles_are_both_exported_and_stay_as_they_were(tmp_path, write):
    _, rows = flight(tmp_path)
    rows = [row | {"image": "0001.jpg", "vehicle": vehicle} for vehicle, row in zip(("v1", "v2"), rows)]
    files = {vehicle: tmp_path / f"{vehicle}.jpg" for vehicle in ("v1", "v2")}
    for vehicle, file in files.items():
        file.write_text(vehicle)
    assert write(rows, lambda row: files[row["vehicle"]], tmp_path / "out") == []
    assert {vehicle: file.read_text() for vehicle, file in files.items()} == {"v1": "v1", "v2": "v2"}
    assert sorted(path.read_text() for path in (tmp_path / "out" / "images").iterdir()) == ["v1", "v2"]


def test_a_map_without_lenses_is_refused(tmp_path):
    _, rows = flight(tmp_path)
    del rows[0]["camera"]["focal_px"]
    with pytest.raises(InputError, match="make the map again"):
        write_colmap(rows, lambda row: None, tmp_path / "colmap")
    with pytest.raises(InputError, match="no placed picture"):
        write_opensfm([{"image": "a.jpg", "stage": "rejected"}], lambda row: None, tmp_path / "sfm")


def test_opendronemap_gets_the_lens_where_all_photos_share_one(tmp_path):
    cameras, rows = flight(tmp_path)
    write_odm(rows, lambda row: tmp_path / row["image"], tmp_path / "mixed")
    assert not (tmp_path / "mixed" / "cameras.json").exists()
    write_odm(rows[2::3], lambda row: tmp_path / row["image"], tmp_path / "odm")
    (lens,) = json.loads((tmp_path / "odm" / "cameras.json").read_text()).values()
    points, _ = ground_seen(cameras[2])
    x, y, z = ((points - cameras[2].position) @ cameras[2].rotation).T
    r2 = (x / z) ** 2 + (y / z) ** 2
    bent = 1 + r2 * (lens["k1"] + r2 * (lens["k2"] + r2 * lens["k3"]))
    size = max(lens["width"], lens["height"])
    u = size * (lens["focal_x"] * bent * x / z + lens["c_x"]) + (lens["width"] - 1) / 2
    v = size * (lens["focal_y"] * bent * y / z + lens["c_y"]) + (lens["height"] - 1) / 2
    assert np.stack([u, v], 1) == pytest.approx(cameras[2].project(points), abs=1e-6)
