"""Placed frames against the true cameras of a twin: reads both tables and brings them together by the images' names."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from PIL import Image

from orthoswarm.evaluation.photo_names import photos_named
from orthoswarm.evaluation.pose_errors import Placement, PoseErrors, pose_errors
from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid


def read_truth(path: Path) -> dict[str, tuple[str, int, Camera]]:
    """True cameras of a twin's frames.csv: image -> (vehicle, EPSG, camera).

    Raises:
        InputError: if the file is not such a table.
    """
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        out = {}
        for row in rows:
            grid = LocalGrid(int(row["epsg"]))
            position = np.array([float(row[k]) for k in ("easting", "northing", "height")])
            convergence = grid.convergence_rad(*grid.to_geographic(position[:2]))
            yaw, pitch, roll = (np.radians(float(row[k])) for k in ("yaw_deg", "pitch_deg", "roll_deg"))
            width, height = _size(row, path)
            focal = focal_px(np.radians(float(row["fov_deg"])), width)
            lens = Lens(width, height, focal, k1=float(row.get("k1") or 0), k2=float(row.get("k2") or 0))
            camera = Camera(position, rotation_from_angles(yaw - convergence, pitch, roll), lens)
            out[row["image"]] = (row["vehicle"], grid.epsg, camera)
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a table of true cameras ({error}); give a twin's truth/frames.csv") from None
    return out


def _size(row: dict[str, str], truth: Path) -> tuple[int, int]:
    """Columns and rows of a picture: from the table, else from the picture in the same folder, else 640x480."""
    if row.get("width_px") and row.get("height_px"):
        return int(row["width_px"]), int(row["height_px"])
    picture = truth.parent.parent / "photos" / row["image"]
    if picture.exists():
        with Image.open(picture) as image:
            return image.width, image.height
    return 640, 480


def evaluate_poses(poses: Path, truth: Path) -> PoseErrors:
    """Compare a product's frames.jsonl with true cameras.

    The plane of the homographies is `ground_z_m` of report.json in the folder of frames.jsonl (0 without one); the true
    ground level is the median of dtm.tif in the folder of the truth, at the cameras' nadirs (0 without one).

    Raises:
        InputError: if nothing in common can be read.
    """
    true = read_truth(truth)
    placed, cameras = [], []
    try:
        records = [json.loads(line) for line in poses.read_text().splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        raise InputError(f"{poses} cannot be read as frames ({error})") from None
    for record in records:
        names = photos_named(true, record.get("image", ""))
        if len(names) != 1 or record.get("stage") == "rejected" or not record.get("homography"):
            continue
        vehicle, epsg, camera = true[names[0]]
        homography = np.asarray(record["homography"], float)
        if int(record["epsg"]) != epsg:
            there = LocalGrid(epsg).to_geographic(camera.position[:2])
            moved = LocalGrid(int(record["epsg"])).to_grid(there[0], there[1])
            shift = np.array(
                [[1, 0, *(camera.position[:1] - moved[:1])], [0, 1, *(camera.position[1:2] - moved[1:])], [0, 0, 1.0]]
            )
            homography = shift @ homography
        placed.append(Placement(names[0], vehicle, homography, record.get("fov_deg"), record.get("sigma_m")))
        cameras.append(camera)
    if not placed:
        raise InputError(f"no placed frame of {poses} stands in {truth}; do both belong to the same set?")
    report = poses.with_name("report.json")
    plane = float(json.loads(report.read_text()).get("ground_z_m") or 0.0) if report.exists() else 0.0
    return pose_errors(placed, cameras, plane, true_ground_level(truth.with_name("dtm.tif"), cameras))


def true_ground_level(dtm: Path, cameras: list[Any]) -> float:
    """Median height of a truth's dtm.tif below cameras, metres; 0 where there is no such file."""
    if not dtm.exists():
        return 0.0

    with rasterio.open(dtm) as file:
        values = np.array([v[0] for v in file.sample([c.position[:2] for c in cameras])], float)
    return float(np.median(values))
