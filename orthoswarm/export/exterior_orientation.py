"""Cameras and pictures of a map, from the lines of frames.jsonl, for programs that use our orientation."""

import math
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.export.atomic_file import disk_error
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid

Array = NDArray[np.float64]
Row = Mapping[str, Any]
Find = Callable[[Row], Path | None]
"""Returns the picture file of a row, None if it is missing."""
Tell = Callable[[int, int], None]
_UNKNOWN_SIGMA_M: Final = 10.0  # stated for a picture of which no error is known: a receiver's in a bad place
_MOST_STEM: Final = 120  # characters; file systems take names of 255 bytes


@dataclass(frozen=True, slots=True)
class OrientedPicture:
    """A placed picture of a map.

    Attributes:
        name: unique plain file name. row: its line in frames.jsonl.
        camera: position in the map's grid (east, north, height), orientation and lens.
    """

    name: str
    row: Row
    camera: Camera


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


def placed_rows(rows: Iterable[Row]) -> list[Row]:
    """The lines of placed pictures.

    Raises:
        InputError: there is none.
    """
    placed = [row for row in rows if row["stage"] != "rejected" and "camera" in row]
    if not placed:
        raise InputError("the map has no placed picture to export; make it again")
    return placed


def stated_sigma_m(row: Row) -> float:
    """One sigma of a picture's place, metres, as other programs need it: never nothing and never zero."""
    return max(float(row["sigma_m"] or _UNKNOWN_SIGMA_M), 0.01)


def oriented_pictures(rows: Iterable[Row]) -> list[OrientedPicture]:
    """The placed pictures of a map.

    Raises:
        InputError: there is none, or the map was made before cameras held their lens.
    """
    placed = placed_rows(rows)
    if any("focal_px" not in row["camera"] for row in placed):
        raise InputError("the map's frames.jsonl does not hold the lenses; make the map again with this version")
    names = unique_names([str(row["image"]) for row in placed])
    return [OrientedPicture(name, row, camera_of(row)) for row, name in zip(placed, names, strict=True)]


def unique_names(images: Iterable[str]) -> list[str]:
    """Plain file names without blanks for images of several folders (`v1/a b.jpg` -> `v1_a_b.jpg`), all different.

    Two vehicles may have sent pictures of the same name: each has a name of its own, in the order of the images.
    """
    images = list(images)
    heads = [image.split("/")[-1] for image in images]
    repeated = len(set(heads)) < len(heads)
    out: list[str] = []
    taken: set[str] = set()
    for image, head in zip(images, heads, strict=True):
        plain = re.sub(r"[^A-Za-z0-9._-]", "_", image if repeated else head)
        stem, suffix = os.path.splitext(plain)
        if not suffix or not re.fullmatch(r"\.(jpe?g|png|tiff?)", suffix.lower()):
            stem, suffix = plain, ".jpg"
        stem = stem[:_MOST_STEM]
        name, number = stem + suffix, 1
        while name.lower() in taken:
            number += 1
            name = f"{stem}_{number}{suffix}"
        taken.add(name.lower())
        out.append(name)
    return out


def link_pictures(
    rows: Sequence[Row], names: Sequence[str], find: Find, folder: Path, progress: Tell | None
) -> list[bool]:
    """Link the pictures' files into a new folder under their names; returns for each whether it was there.

    Raises:
        OrthoSwarmError: if the disk is full.
    """
    folder.mkdir(parents=True)
    there = []
    for row, name in zip(rows, names, strict=True):
        file = find(row)
        there.append(file is not None)
        if file is not None:
            _link(file, folder / name)
        if progress is not None:
            progress(len(there), len(rows))
    return there


def link_oriented(pictures: Sequence[OrientedPicture], find: Find, folder: Path, progress: Tell | None) -> list[str]:
    """Link the pictures as `link_pictures` does; returns the images whose files are missing."""
    there = link_pictures([p.row for p in pictures], [p.name for p in pictures], find, folder, progress)
    return [str(p.row["image"]) for p, found in zip(pictures, there, strict=True) if not found]


def _link(file: Path, target: Path) -> None:
    """Link a file under another name, or copy it if the file system has no links.

    Raises:
        FileExistsError: the name is taken. A copy there would be written into the file that it is linked to.
    """
    try:
        os.link(file, target)
    except FileExistsError:
        raise
    except OSError:
        try:
            shutil.copyfile(file, target)
        except OSError as error:
            raise disk_error(error, target) from None


def by_lens(pictures: Sequence[OrientedPicture]) -> dict[Lens, int]:
    """Numbers from 1 of the lenses, in order of appearance."""
    numbers: dict[Lens, int] = {}
    for picture in pictures:
        numbers.setdefault(picture.camera.lens, len(numbers) + 1)
    return numbers
