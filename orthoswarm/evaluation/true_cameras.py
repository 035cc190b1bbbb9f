"""Placed frames against the true cameras of a twin: reads both tables and brings them together by the images' names."""

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from PIL import Image

from orthoswarm.evaluation.photo_names import photos_named
from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import Camera, Lens, angles_from_rotation, focal_px, rotation_from_angles
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid


def read_truth(path: Path) -> dict[str, tuple[str, int, Camera]]:
    """True cameras of a twin's frames.csv: image -> (vehicle, EPSG, camera).

    Raises InputError: if the file is not such a table.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseErrors:
    """Errors of placed frames, arrays over the compared frames (NaN where not stated)."""

    image: list[str]  # names
    vehicle: list[str]  # ids
    position_m: Array  # float64 (N, 3), camera's east, north, up minus truth
    angle_deg: Array  # float64 (N, 3), grid yaw, pitch, roll minus truth
    fov_deg: Array  # float64 (N,), minus truth
    center_m: Array  # float64 (N, 2), ground point of the picture's centre minus truth, on the mean ground level
    nadir_m: Array  # float64 (N, 2), the same at the pixel that truly looks straight down (no height plays a part)
    sigma_m: Array  # float64 (N,), stated

    def figures(self) -> dict[str, Any]:
        """Numbers for a report: medians, 95 % values, FoV per vehicle, honesty of the stated sigma.

        The shares of errors within 1 and 2 sigma are counted in two ways, because "error" has two meanings: each axis
        by itself (`sigma_axis_within_1`; a Gaussian has 68 and 95 %), and the length of the error
        (`sigma_length_within_1`; 39 and 86 % of a Gaussian whose axes have that sigma). `sigma_within_1` is the first.
        """
        horizontal = np.hypot(*self.position_m[:, :2].T)
        center, nadir = np.hypot(*self.center_m.T), np.hypot(*self.nadir_m.T)
        out: dict[str, Any] = {"frames_compared": len(self.image)}
        for name, values in (
            ("camera_horizontal", horizontal), ("camera_up", np.abs(self.position_m[:, 2])),
            ("center_ground", center), ("nadir_ground", nadir),
        ):  # fmt: skip
            out[f"{name}_median_m"], out[f"{name}_p95_m"] = _median_p95(values)
        out["angle_median_deg"] = [_median_p95(a)[0] for a in np.abs(self.angle_deg).T]
        vehicles = np.array(self.vehicle)
        out["fov_error_deg"] = {v: _median_p95(self.fov_deg[vehicles == v])[0] for v in sorted(set(self.vehicle))}
        for label, errors in (("sigma", self.center_m), ("sigma_nadir", self.nadir_m)):
            for k in (1, 2):
                by_axis = _share_within(errors, self.sigma_m, k)
                out[f"{label}_within_{k}"] = out[f"{label}_axis_within_{k}"] = by_axis
                out[f"{label}_length_within_{k}"] = _share_within(np.hypot(*errors.T)[:, None], self.sigma_m, k)
        out["sigma_median_m"] = _median_p95(self.sigma_m)[0]
        return out


def evaluate_poses(poses: Path, truth: Path) -> PoseErrors:
    """Compare a product's frames.jsonl with true cameras.

    The plane of the homographies is `ground_z_m` of report.json in the folder of frames.jsonl (0 without one); the true
    ground level is the median of dtm.tif in the folder of the truth, at the cameras' nadirs (0 without one).

    Raises InputError: if nothing in common can be read.
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


def camera_from_homography(homography: Array, lens: Lens, ground_z_m: float) -> Camera:
    """The camera that has a homography from undistorted pixels to a level plane; inverse of Camera.homography.

    H^-1 = K [r1 r2 t] up to scale, r1 and r2 the first columns of the ground-to-camera rotation (Zhang 2000).

    Args:
        homography: 3x3, pixel (column, row, 1) to (east, north).
        lens: its focal length and principal point (distortion plays no part). ground_z_m: height of the plane.
    """
    u, v = lens.principal_point
    center = homography @ np.array([u, v, 1.0])
    origin = center[:2] / center[2]
    shifted = np.array([[1, 0, -origin[0]], [0, 1, -origin[1]], [0, 0, 1.0]]) @ homography
    m = np.linalg.inv(lens.matrix()) @ np.linalg.inv(shifted)
    m /= 0.5 * (np.linalg.norm(m[:, 0]) + np.linalg.norm(m[:, 1]))
    if m[2, 2] < 0:
        m = -m
    near = np.stack([m[:, 0], m[:, 1], np.cross(m[:, 0], m[:, 1])], -1)
    left, _, right = np.linalg.svd(near)
    rotation = left @ right
    position = -rotation.T @ m[:, 2]
    return Camera(position + np.array([origin[0], origin[1], ground_z_m]), np.ascontiguousarray(rotation.T), lens)


@dataclass(frozen=True, slots=True)
class Placement:
    """A frame as a product places it."""

    image: str  # name
    vehicle: str
    homography: Array  # 3x3, undistorted pixel to (east, north) on a plane
    fov_deg: float | None  # its field of view, None if not stated
    sigma_m: float | None  # its own estimate of the ground error, None if none


def _median_p95(values: Array) -> tuple[float | None, float | None]:
    known = values[np.isfinite(values)]
    if not len(known):
        return None, None
    return float(np.median(known)), float(np.percentile(known, 95))


def _share_within(errors: Array, sigma: Array, k: int) -> float | None:
    """Share of errors (N, axes), each axis by itself, within k sigma."""
    known = np.isfinite(sigma) & np.isfinite(errors).all(1)
    if not known.any():
        return None
    return float((np.abs(errors[known]) <= k * sigma[known, None]).mean())


def pose_errors(
    placed: Sequence[Placement], truth: Sequence[Camera], ground_z_m: float, true_ground_z_m: float
) -> PoseErrors:
    """Compare placed frames with their true cameras, in the same grid and order.

    Args:
        placed: frames as placed. truth: the true camera of each.
        ground_z_m: height of the plane of the homographies, in the product's heights.
        true_ground_z_m: the mean ground level in the truth's heights.
    """
    n = len(placed)
    position, angle, fov = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full(n, np.nan)
    center, nadir, sigma = np.full((n, 2), np.nan), np.full((n, 2), np.nan), np.full(n, np.nan)
    for i, (frame, true) in enumerate(zip(placed, truth, strict=True)):
        middle = np.array(true.lens.principal_point)
        center[i] = _apply(frame.homography, middle) - true.to_ground(middle, true_ground_z_m)
        down = true.position - np.array([0, 0, 1.0])
        undistorted = replace(true.lens, k1=0.0, k2=0.0, k3=0.0)
        pinhole = Camera(true.position, true.rotation, undistorted)
        nadir[i] = _apply(frame.homography, pinhole.project(down)) - true.position[:2]
        sigma[i] = np.nan if frame.sigma_m is None else frame.sigma_m
        if frame.fov_deg is None:
            continue
        fov[i] = frame.fov_deg - np.degrees(true.lens.fov_rad)
        focal = 0.5 * true.lens.width / np.tan(0.5 * np.radians(frame.fov_deg))
        camera = camera_from_homography(frame.homography, Lens(true.lens.width, true.lens.height, focal), ground_z_m)
        position[i] = camera.position - true.position
        position[i, 2] += true_ground_z_m - ground_z_m
        turn = np.array(angles_from_rotation(camera.rotation)) - np.array(angles_from_rotation(true.rotation))
        angle[i] = wrap_deg(np.degrees(turn))
    return PoseErrors(
        image=[p.image for p in placed], vehicle=[p.vehicle for p in placed], position_m=position, angle_deg=angle,
        fov_deg=fov, center_m=center, nadir_m=nadir, sigma_m=sigma,
    )  # fmt: skip


def _apply(homography: Array, pixel: Array) -> Array:
    p = homography @ np.array([pixel[0], pixel[1], 1.0])
    return np.asarray(p[:2] / p[2])
