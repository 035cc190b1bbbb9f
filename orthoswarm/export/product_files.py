"""The files of a run besides pictures: a line per picture (frames.jsonl), footprints, and the report's numbers."""

import json
import math
import statistics
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm.export.atomic_file import write_file
from orthoswarm.export.footprint_layer import write_footprints
from orthoswarm.export.json_values import finite, json_text
from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import Camera, Lens, angles_from_rotation, ground_jacobian
from orthoswarm.model.frame import Frame, Rejection
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import STATED_SIGMA_FACTOR, PlacedFrame, Solution
from orthoswarm.mosaic.footprint import footprint
from orthoswarm.mosaic.takeoff_altitude import TakeoffLevel, height_sigma_m, takeoff_levels
from orthoswarm.stores.addresses import address_of

OBLIQUE_AXIS_DOWN: Final = 0.2  # no sigma of a photo's centre whose axis points down by less (unit vector)


def frame_row(placed: PlacedFrame, grid: LocalGrid, ground_z_m: float) -> dict[str, Any]:
    """The line of frames.jsonl of a placed frame.

    `homography` maps a pixel (column, row, 1), distortion removed by `k1` and `k2` beside it alone, to easting and
    northing on the plane `ground_z_m`; both are refitted to a lens without `cx`, `cy` and `k3`, which stand there only
    to say that the full lens, that of `camera`, has them. `camera` has the camera's position, attitude (yaw from true
    north) and lens (focal length in pixels, and those of k1, k2, k3, cx, cy of model.camera.Lens that are not 0), for
    other programs; `recorded_height_m` is the height above takeoff that was recorded with the picture, absent if none
    was.
    """
    frame, camera = placed.frame, placed.camera
    lens = camera.lens
    simple, to_full = simple_lens(lens)
    h = camera_matrix(camera, ground_z_m) @ to_full @ np.linalg.inv(simple.matrix())
    row: dict[str, Any] = {
        "image": frame.image,
        "vehicle": frame.vehicle,
        "time": iso_time(frame.time_s),
        "stage": placed.stage,
        "epsg": grid.epsg,
        "width": lens.width,
        "height": lens.height,
        "homography": (h / h[2, 2]).tolist(),
    }
    if not simple.is_pinhole or lens.cx or lens.cy:
        row |= {"k1": simple.k1, "k2": simple.k2}
    if max(abs(lens.cx), abs(lens.cy)) > 1e-6 or abs(lens.k3) > 1e-9:  # held at zero they come back as 1e-19
        row |= {"cx": lens.cx, "cy": lens.cy, "k3": lens.k3}
    row["fov_deg"] = math.degrees(lens.fov_rad)
    row["sigma_m"] = placed.sigma_m
    if frame.fix.height_m is not None:
        row["recorded_height_m"] = frame.fix.height_m
    flags = {"weak": placed.weak, "damaged": frame.damaged, "ambiguous": frame.ambiguous}
    row |= {name: True for name, value in flags.items() if value}
    row["camera"] = _camera_row(camera, grid)
    return row


def _camera_row(camera: Camera, grid: LocalGrid) -> dict[str, float]:
    yaw, pitch, roll = angles_from_rotation(camera.rotation)
    lat, lon = (float(v) for v in grid.to_geographic(camera.position[:2]))
    true = math.degrees(float(yaw + grid.convergence_rad(lat, lon)))
    lens = camera.lens
    terms = {name: getattr(lens, name) for name in ("k1", "k2", "k3", "cx", "cy")}
    return {
        "lat_deg": lat,
        "lon_deg": lon,
        "height_m": float(camera.position[2]),
        "yaw_deg": wrap_deg(true),
        "pitch_deg": math.degrees(float(pitch)),
        "roll_deg": math.degrees(float(roll)),
        "focal_px": lens.focal_px,
        **{name: value for name, value in terms.items() if value},
    }


def _vertical(placed: PlacedFrame, level: TakeoffLevel | None) -> dict[str, float]:
    """What `camera` says of a camera's height: one sigma of it, its altitude, and one sigma of that."""
    found = {"height_sigma_m": height_sigma_m(placed)} if placed.pose_covariance is not None else {}
    if level is not None:
        altitude_m, sigma_m = level.of_camera(placed)
        found |= {"altitude_m": altitude_m}
        found |= {"altitude_sigma_m": sigma_m} if math.isfinite(sigma_m) else {}
    return found


def camera_matrix(camera: Camera, ground_z_m: float) -> Array:
    """The 3x3 matrix from undistorted normalised coordinates (x, y, 1) to the ground plane, homogeneous."""
    r = camera.rotation
    drop = ground_z_m - float(camera.position[2])
    return np.array(
        [drop * r[0] + camera.position[0] * r[2], drop * r[1] + camera.position[1] * r[2], r[2]], dtype=np.float64
    )


@lru_cache(maxsize=256)
def simple_lens(lens: Lens) -> tuple[Lens, Array]:
    """A lens with only k1 and k2 about the picture's centre that approximates a full one.

    Returns the lens (same focal length), and the 3x3 matrix from its normalised coordinates to those of the full one.
    """
    if not (lens.cx or lens.cy or lens.k3):
        return lens, np.eye(3)
    from scipy.optimize import least_squares

    columns, rows = np.meshgrid(np.linspace(0, lens.width - 1, 17), np.linspace(0, lens.height - 1, 13))
    pixels = np.stack([columns.ravel(), rows.ravel()], 1)
    wanted = lens.undistort((pixels - np.array(lens.principal_point)) / lens.focal_px)

    def parts(p: Array) -> tuple[Lens, Array]:
        guess = Lens(lens.width, lens.height, lens.focal_px, k1=p[8], k2=p[9])
        return guess, np.append(p[:8], 1.0).reshape(3, 3)

    def misfit(p: Array) -> Array:
        guess, matrix = parts(p)
        xy = guess.undistort((pixels - np.array(guess.principal_point)) / guess.focal_px)
        moved = np.c_[xy, np.ones(len(xy))] @ matrix.T
        return np.asarray((moved[:, :2] / moved[:, 2:] - wanted).ravel() * lens.focal_px)

    start = np.array([1, 0, -lens.cx / lens.focal_px, 0, 1, -lens.cy / lens.focal_px, 0, 0, lens.k1, lens.k2], float)
    return parts(least_squares(misfit, start, method="lm").x)


def rejection_row(rejection: Rejection, epsg: int | None) -> dict[str, Any]:
    """The line of frames.jsonl of a rejected picture."""
    return {
        "image": rejection.image,
        "vehicle": rejection.vehicle,
        "time": iso_time(rejection.time_s),
        "stage": "rejected",
        "reason": rejection.reason,
        **({"detail": rejection.detail} if rejection.detail else {}),
        "epsg": epsg,
    }


def iso_time(time_s: float | None) -> str | None:
    """UTC epoch seconds as ISO 8601 with Z; None if unknown or no date."""
    if time_s is None:
        return None
    try:
        text = datetime.fromtimestamp(round(time_s, 6), UTC).isoformat(timespec="microseconds")
    except (OverflowError, ValueError, OSError):
        return None
    head, _, tail = text.removesuffix("+00:00").partition(".")
    return f"{head}.{tail[:3] if tail.endswith('000') else tail}Z"


def pose_covariance(placed: PlacedFrame, ground_z_m: float) -> Array | None:
    """Covariance of a frame's exterior orientation that agrees with its stated error on the ground.

    The adjustment's covariance lacks errors that pictures have in common (the map's own offset and distortion, the
    receiver without a map): a horizontal shift of the camera and its ground. Its variance is what the stated sigma has
    more at the picture's centre than the adjustment's covariance gives there.

    Returns:
        float64 (6, 6) of east, north, up (metres) and rotation about the camera's own axes right, down and forward
        (radians); None where the adjustment gives none.
    """
    camera = placed.camera
    if placed.pose_covariance is None:
        return None
    covariance = placed.pose_covariance.astype(np.float64)
    height = max(float(camera.position[2]) - ground_z_m, 1.0)
    j = ground_jacobian(camera.rotation, height, OBLIQUE_AXIS_DOWN)
    if j is None or not math.isfinite(placed.sigma_m):
        return covariance
    variance = (placed.sigma_m / STATED_SIGMA_FACTOR) ** 2
    own = float(np.trace(j @ covariance @ j.T)) / 2
    if own > variance:
        return covariance * (variance / own)
    covariance[[0, 1], [0, 1]] += variance - own
    return covariance


def write_frames(
    out: Path,
    placed: Sequence[PlacedFrame],
    rejected: Sequence[Rejection],
    grid: LocalGrid,
    z: float,
    *,
    covariance: bool = False,
) -> None:
    """Write frames.jsonl and footprints.gpkg into the output folder.

    Args:
        z: level of the ground plane, metres. covariance: add each camera's, see pose_covariance.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    levels = takeoff_levels(placed)

    def lines() -> Iterator[str]:  # one at a time: 32,544 pictures have 60 MB of lines
        both: list[tuple[str, PlacedFrame | Rejection]] = [(p.frame.image, p) for p in placed]
        both += [(r.image, r) for r in rejected]
        for _, one in sorted(both, key=lambda pair: pair[0]):
            if isinstance(one, Rejection):
                row = rejection_row(one, grid.epsg)
            else:
                row = frame_row(one, grid, z)
                row["camera"] |= _vertical(one, levels.get(one.frame.vehicle))
                if covariance and (of_pose := pose_covariance(one, z)) is not None:
                    row["camera"]["covariance"] = [[float(f"{v:.6g}") for v in line] for line in of_pose]
            yield json_text(row) + "\n"

    write_file(out / "frames.jsonl", lines())
    outlines = ((describe_frame(p), footprint(p.camera, z, inset_px=-0.5)) for p in placed)
    write_footprints(out / "footprints.gpkg", outlines, grid.epsg)


def describe_frame(placed: PlacedFrame) -> dict[str, Any]:
    """Attributes of a picture's footprint and of the ground that the orthoimage takes from it."""
    frame, fov = placed.frame, math.degrees(placed.camera.lens.fov_rad)
    return {
        "image": frame.image, "vehicle": frame.vehicle, "time": iso_time(frame.time_s), "stage": placed.stage,
        "fov_deg": fov, "sigma_m": placed.sigma_m,
    }  # fmt: skip


def read_frames(path: Path) -> Iterator[dict[str, Any]]:
    """The lines of a frames.jsonl."""
    with path.open(encoding="utf-8") as file:
        for line in file:
            if line.strip():
                yield json.loads(line)


def vehicle_rows(solutions: Sequence[Solution], placed: Sequence[PlacedFrame]) -> list[dict[str, Any]]:
    """`vehicles` of report.json: the refined ones, then those placed as recorded.

    `positions_from` counts the pictures by the source of their recorded position.
    """
    used = Counter(p.frame.vehicle for p in placed)
    rows: list[dict[str, Any]] = [
        {
            "id": s.vehicle,
            "frames": used.pop(s.vehicle, 0),
            "fov_deg": finite(s.fov_deg),
            "fov_sigma_deg": finite(s.fov_sigma_deg),
            "legs": len(s.legs),
            "gsd_m": finite(s.gsd_m),
            "false_matches": finite(s.false_matches),
        }
        for s in solutions
    ]
    for vehicle, count in used.items():
        fov = statistics.median(math.degrees(p.camera.lens.fov_rad) for p in placed if p.frame.vehicle == vehicle)
        rows.append({"id": vehicle, "frames": count, "fov_deg": fov, "fov_sigma_deg": None, "legs": 0, "gsd_m": None,
                     "false_matches": None})  # fmt: skip
    for row in rows:
        origins = [p.frame.origin.get("position", "") for p in placed if p.frame.vehicle == row["id"]]
        row["positions_from"] = dict(Counter(origin for origin in origins if origin).most_common())
    return rows


def leg_rows(solutions: Sequence[Solution]) -> list[dict[str, Any]]:
    """`legs` of report.json."""
    return [
        asdict(leg) | {"images": list(leg.images), "confidence": finite(leg.confidence), "sigma_m": finite(leg.sigma_m)}
        for s in solutions
        for leg in s.legs
    ]


def image_root(frames: Sequence[Frame]) -> str | None:
    """The folder (or address) that picture names are relative to; None for pictures of videos."""
    for frame in frames:
        path = frame.path.absolute().as_posix()
        if path.endswith("/" + frame.image):
            return address_of(Path(path.removesuffix("/" + frame.image) or "/"))
    return None


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write one JSON document that appears when it is complete.

    Raises OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    write_file(path, json_text(document, 1) + "\n")
