"""A folder for OpenDroneMap: the pictures, a geo.txt with the refined positions and angles, and the solved lens."""

import json
from collections.abc import Iterable
from pathlib import Path

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.exterior_orientation import (
    Find,
    Row,
    Tell,
    camera_of,
    link_pictures,
    placed_rows,
    stated_sigma_m,
    unique_names,
)
from orthoswarm.export.opensfm_folder import brown_camera
from orthoswarm.model.errors import InputError


def write_odm(rows: Iterable[Row], find: Find, folder: Path, *, progress: Tell | None = None) -> list[str]:
    """Write `images/`, `geo.txt` and `cameras.json`.

    geo.txt has longitude, latitude, altitude, yaw from true north, pitch (0 looks straight down, as ODM counts),
    roll, and one sigma of the position, across and up. If the photos have no altitude, the height above the takeoff
    level is used.
    cameras.json, for ODM's `--cameras`, holds the solved lens. It is written where all photos share one: ODM tells
    lenses apart by the photos' tags, which are the same for two drones of a kind.

    Args:
        rows: lines of frames.jsonl. find: their picture files.
        folder: appears when it is complete; an existing one is replaced. progress: called with pictures done and all.

    Returns:
        Images that were left out because their files are missing.

    Raises:
        InputError: if no picture was placed or found.
        OrthoSwarmError: if the disk is full.
    """
    placed = placed_rows(rows)
    names = unique_names([str(row["image"]) for row in placed])
    with atomic_write(folder) as part:
        there = link_pictures(placed, names, find, part / "images", progress)
        if not any(there):
            raise InputError("none of the pictures is where it was when the map was made; give --images FOLDER")
        lines = [_line(name, row) for row, name, found in zip(placed, names, there, strict=True) if found]
        (part / "geo.txt").write_text("\n".join(["EPSG:4326", *lines]) + "\n", encoding="utf-8")
        lenses = {camera_of(row).lens for row in placed if "focal_px" in row["camera"]}
        if len(lenses) == 1:
            cameras = {"all": brown_camera(lenses.pop())}
            (part / "cameras.json").write_text(json.dumps(cameras, indent=1), encoding="utf-8")
    return [str(row["image"]) for row, found in zip(placed, there, strict=True) if not found]


def _line(name: str, row: Row) -> str:
    camera = row["camera"]
    sigma = stated_sigma_m(row)
    up, up_sigma = ("altitude_m", "altitude_sigma_m") if "altitude_m" in camera else ("height_m", "height_sigma_m")
    vertical = max(float(camera.get(up_sigma, 2.0 * sigma)), 0.01)  # a map of an earlier version has none
    return (
        f"{name} {camera['lon_deg']:.9f} {camera['lat_deg']:.9f} {float(camera[up]):.3f} "
        f"{camera['yaw_deg']:.4f} {camera['pitch_deg'] + 90.0:.4f} {camera['roll_deg']:.4f} {sigma:.3f} {vertical:.3f}"
    )
