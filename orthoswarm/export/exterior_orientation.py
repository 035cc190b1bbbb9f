"""Cameras from the lines of frames.jsonl, for programs that use our orientation (densify, measure)."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.export.linked_pictures import link_file, unique_names
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid

Array = NDArray[np.float64]
Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class OrientedPicture:
    """A placed picture of a map.

    Attributes:
        name: unique plain file name. image: its name in frames.jsonl. row: its line there.
        camera: position in the map's grid (east, north, height), orientation and lens.
        lat_deg: latitude of the camera. lon_deg: its longitude. altitude_m: its altitude, or the height over the
            takeoff level if the photos have none.
    """

    name: str
    image: str
    row: Row
    camera: Camera
    lat_deg: float
    lon_deg: float
    altitude_m: float


def camera_of(row: Row) -> Camera:
    """The camera of a line of frames.jsonl, in the grid of its `epsg`."""
    block = row["camera"]
    grid = _grid(int(row["epsg"]))
    lat, lon = float(block["lat_deg"]), float(block["lon_deg"])
    position = np.append(grid.to_grid(lat, lon), float(block["height_m"]))
    yaw = math.radians(float(block["yaw_deg"])) - float(grid.convergence_rad(lat, lon))
    angles = (yaw, math.radians(float(block["pitch_deg"])), math.radians(float(block["roll_deg"])))
    terms = {name: float(block.get(name, 0.0)) for name in ("k1", "k2", "k3", "cx", "cy")}
    lens = Lens(int(row["width"]), int(row["height"]), float(block["focal_px"]), **terms)
    return Camera(position, rotation_from_angles(*angles), lens)


@lru_cache(maxsize=4)
def _grid(epsg: int) -> LocalGrid:
    """A grid by its code; its transformer takes a thousand times as long to make as to use."""
    return LocalGrid(epsg)


def oriented_pictures(rows: Sequence[Row]) -> list[OrientedPicture]:
    """The placed pictures of a map.

    Raises:
        InputError: there is none, or the map was made before cameras held their lens.
    """
    placed = [row for row in rows if row["stage"] != "rejected" and "camera" in row]
    if not placed:
        raise InputError("the map has no placed picture to export; make it again")
    if any("focal_px" not in row["camera"] for row in placed):
        raise InputError("the map's frames.jsonl does not hold the lenses; make the map again with this version")
    names = unique_names([str(row["image"]) for row in placed])
    found = []
    for row, name in zip(placed, names, strict=True):
        block = row["camera"]
        altitude = float(block.get("altitude_m", block["height_m"]))
        found.append(
            OrientedPicture(
                name=name,
                image=str(row["image"]),
                row=row,
                camera=camera_of(row),
                lat_deg=float(block["lat_deg"]),
                lon_deg=float(block["lon_deg"]),
                altitude_m=altitude,
            )
        )
    return found


def link_pictures(
    pictures: Sequence[OrientedPicture],
    find: Callable[[Row], Path | None],
    folder: Path,
    progress: Callable[[int, int], None] | None,
) -> list[str]:
    """Link the pictures' files into a folder under their plain names; returns the images whose files are missing.

    Raises:
        OrthoSwarmError: if the disk is full.
    """
    folder.mkdir(parents=True)
    gone = []
    for done, picture in enumerate(pictures, 1):
        file = find(picture.row)
        if file is None:
            gone.append(picture.image)
        else:
            link_file(file, folder / picture.name)
        if progress is not None:
            progress(done, len(pictures))
    return gone


def by_lens(pictures: Sequence[OrientedPicture]) -> dict[Lens, int]:
    """Numbers from 1 of the lenses, in order of appearance."""
    numbers: dict[Lens, int] = {}
    for picture in pictures:
        numbers.setdefault(picture.camera.lens, len(numbers) + 1)
    return numbers
