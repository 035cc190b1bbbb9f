"""The refined cameras of a map as folders for other programs: OpenDroneMap, OpenSfM, COLMAP."""

import json
import math
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm.export.atomic_file import atomic_write, disk_error
from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid

Row = Mapping[str, Any]
Find = Callable[[Row], Path | None]  # returns the picture file of a row, None if it is missing
Tell = Callable[[int, int], None]
_UNKNOWN_SIGMA_M: Final = 10.0  # stated for a picture of which no error is known: a receiver's in a bad place
_MOST_STEM: Final = 120  # characters; file systems take names of 255 bytes


@dataclass(frozen=True, slots=True)
class OrientedPicture:
    """A placed picture of a map."""

    name: str  # unique plain file name
    row: Row  # its line in frames.jsonl
    camera: Camera  # position in the map's grid (east, north, height), orientation and lens


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
    """The lines of placed pictures. Raises InputError: there is none."""
    placed = [row for row in rows if row["stage"] != "rejected" and "camera" in row]
    if not placed:
        raise InputError("the map has no placed picture to export; make it again")
    return placed


def stated_sigma_m(row: Row) -> float:
    """One sigma of a picture's place, metres, as other programs need it: never nothing and never zero."""
    return max(float(row["sigma_m"] or _UNKNOWN_SIGMA_M), 0.01)


def oriented_pictures(rows: Iterable[Row]) -> list[OrientedPicture]:
    """The placed pictures of a map.

    Raises InputError: there is none, or the map was made before cameras held their lens.
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

    Raises OrthoSwarmError: if the disk is full.
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

    Raises FileExistsError: the name is taken. A copy there would be written into the file that it is linked to.
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


def _numbered_lenses(pictures: Sequence[OrientedPicture]) -> dict[Lens, int]:
    """Numbers from 1 of the lenses, in order of appearance."""
    return {lens: number for number, lens in enumerate(dict.fromkeys(p.camera.lens for p in pictures), 1)}


# -- OpenSfM -----------------------------------------------------------------------------------------------------------


def write_opensfm(rows: Iterable[Row], find: Find, folder: Path, *, progress: Tell | None = None) -> list[str]:
    """Write an OpenSfM data set to densify from: reconstruction, camera models, reference and `images/`.

    OpenSfM's world is a plane tangent to the ellipsoid at `reference_lla`: east, north, up in metres. Pixels are
    counted from the picture's middle in units of the longer side; its camera axes are ours.

    Arguments and errors are as of `write_odm`; returns the images whose files are missing: the reconstruction has them,
    `images` has not.
    """
    pictures = oriented_pictures(rows)
    lat, lon = (float(np.mean([p.row["camera"][name] for p in pictures])) for name in ("lat_deg", "lon_deg"))
    reference = {"latitude": lat, "longitude": lon, "altitude": 0.0}
    names = {lens: f"lens {number}" for lens, number in _numbered_lenses(pictures).items()}
    cameras = {name: brown_camera(lens) for lens, name in names.items()}
    centres, rotations = _topocentric(pictures, lat, lon)
    shots = {
        p.name: _shot(p, names[p.camera.lens], centre, rotation)
        for p, centre, rotation in zip(pictures, centres, rotations)
    }
    reconstruction = {"cameras": cameras, "shots": shots, "points": {}, "reference_lla": reference}
    with atomic_write(folder) as part:
        part.mkdir(parents=True)
        for name, document in {
            "reconstruction": [reconstruction], "camera_models": cameras, "reference_lla": reference,
        }.items():  # fmt: skip
            (part / f"{name}.json").write_text(json.dumps(document, indent=1), encoding="utf-8")
        return link_oriented(pictures, find, part / "images", progress)


def brown_camera(lens: Lens) -> dict[str, Any]:
    """OpenSfM's and OpenDroneMap's "brown" camera of a lens, as a JSON object."""
    size = float(max(lens.width, lens.height))
    return {
        "projection_type": "brown", "width": lens.width, "height": lens.height,
        "focal_x": lens.focal_px / size, "focal_y": lens.focal_px / size, "c_x": lens.cx / size, "c_y": lens.cy / size,
        "k1": lens.k1, "k2": lens.k2, "p1": 0.0, "p2": 0.0, "k3": lens.k3,
    }  # fmt: skip


def _topocentric(pictures: Sequence[OrientedPicture], lat: float, lon: float) -> tuple[Array, Array]:
    """Centres (N, 3) and camera-to-world rotations (N, 3, 3) in the plane tangent at a reference on the ellipsoid."""
    from pyproj import Transformer

    plane_at = f"+proj=topocentric +ellps=WGS84 +lat_0={lat!r} +lon_0={lon!r} +h_0=0"
    to_plane = Transformer.from_pipeline(f"+proj=pipeline +step +proj=cart +ellps=WGS84 +step {plane_at}")
    # Heights are altitudes, or over the takeoff level if the photos have none.
    geographic = np.array([
        [c["lon_deg"], c["lat_deg"], c.get("altitude_m", c["height_m"])] for c in (p.row["camera"] for p in pictures)
    ])  # fmt: skip
    lons, lats, altitudes = geographic.T
    centres = np.stack(to_plane.transform(np.radians(lons), np.radians(lats), altitudes, radians=True), 1)
    plane = _east_north_up(np.radians(lat), np.radians(lon))
    rotations = []
    for picture, here_lat, here_lon in zip(pictures, lats, lons, strict=True):
        convergence = float(LocalGrid(int(picture.row["epsg"])).convergence_rad(here_lat, here_lon))
        local = _east_north_up(np.radians(here_lat), np.radians(here_lon))
        rotations.append(plane @ local.T @ _about_up(-convergence) @ picture.camera.rotation)
    return centres, np.array(rotations)


def _east_north_up(lat: float, lon: float) -> Array:
    """Rows: east, north and up at a place, in earth-centred axes."""
    sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    return np.array([[-so, co, 0.0], [-sl * co, -sl * so, cl], [cl * co, cl * so, sl]])


def _about_up(angle: float) -> Array:
    """Rotation of east, north, up counter-clockwise about up."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _shot(picture: OrientedPicture, camera: str, centre: Array, rotation: Array) -> dict[str, Any]:
    """A shot: axis and angle from world to camera, and the world's origin in camera axes."""
    from scipy.spatial.transform import Rotation

    to_camera = rotation.T
    return {
        "rotation": Rotation.from_matrix(to_camera).as_rotvec().tolist(),
        "translation": (-to_camera @ centre).tolist(), "camera": camera, "orientation": 1,
        "gps_position": centre.tolist(), "gps_dop": stated_sigma_m(picture.row),
    }  # fmt: skip


# -- OpenDroneMap ------------------------------------------------------------------------------------------------------


def write_odm(rows: Iterable[Row], find: Find, folder: Path, *, progress: Tell | None = None) -> list[str]:
    """Write a folder for OpenDroneMap: `images/`, `geo.txt` and `cameras.json`.

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


# -- COLMAP ------------------------------------------------------------------------------------------------------------

_ORIGIN_STEP_M = 100.0
_ENOUGH_PX = 0.01
"""Terms that move no pixel by more are left out: the adjustment returns terms that it holds at zero as 1e-16."""


def write_colmap(rows: Iterable[Row], find: Find, folder: Path, *, progress: Tell | None = None) -> list[str]:
    """Write a COLMAP model to densify from (`image_undistorter`): `sparse/0/*.txt`, `origin.txt` and `images/`.

    World axes are east, north, up in metres from `origin.txt`, a corner of the map's grid. COLMAP's camera axes are
    ours (x right, y down, z forward); its pixel (0, 0) is the upper left CORNER of the first pixel, ours its centre.

    Arguments and errors are as of `write_odm`; returns the images whose files are missing: they are in the model,
    but not in `images`.
    """
    pictures = oriented_pictures(rows)
    positions = np.array([p.camera.position for p in pictures])
    origin = np.floor(positions[:, :2].min(0) / _ORIGIN_STEP_M) * _ORIGIN_STEP_M
    numbers = _numbered_lenses(pictures)
    with atomic_write(folder) as part:
        model = part / "sparse" / "0"
        model.mkdir(parents=True)
        cameras = [f"{number} {_model(lens)}" for lens, number in numbers.items()]
        _write(model / "cameras.txt", ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS", *cameras])
        images = [_image(i, p, numbers[p.camera.lens], origin) for i, p in enumerate(pictures, 1)]
        head = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME and a line of its points (none)"
        _write(model / "images.txt", [head, *images])
        _write(model / "points3D.txt", ["# no points"])
        _write(part / "origin.txt", [f"EPSG:{pictures[0].row['epsg']} {origin[0]:.1f} {origin[1]:.1f} 0"])
        return link_oriented(pictures, find, part / "images", progress)


def _model(lens: Lens) -> str:
    """COLMAP's camera model of a lens with its parameters: the simplest one that holds its terms to _ENOUGH_PX."""
    u, v = (c + 0.5 for c in lens.principal_point)
    f = lens.focal_px
    if _difference_px(lens, replace(lens, k1=0.0, k2=0.0, k3=0.0)) < _ENOUGH_PX:
        name, values = "SIMPLE_PINHOLE", [f, u, v]
    elif _difference_px(lens, replace(lens, k3=0.0)) < _ENOUGH_PX:
        name, values = "RADIAL", [f, u, v, lens.k1, lens.k2]
    else:
        name, values = "FULL_OPENCV", [f, f, u, v, lens.k1, lens.k2, 0.0, 0.0, lens.k3, 0.0, 0.0, 0.0]
    return f"{name} {lens.width} {lens.height} " + " ".join(repr(float(v)) for v in values)


def _difference_px(lens: Lens, simpler: Lens) -> float:
    """How far apart two lenses of one focal length show a point of the picture's corners, pixels."""
    corners = np.array([[u, v] for u in (-0.5, lens.width - 0.5) for v in (-0.5, lens.height - 0.5)])
    seen = lens.undistort((corners - np.array(lens.principal_point)) / lens.focal_px)
    return float(np.abs(lens.distort(seen) - simpler.distort(seen)).max() * lens.focal_px)


def _image(number: int, picture: OrientedPicture, camera: int, origin: Array) -> str:
    """Two lines of images.txt: the pose from world to camera, and no points."""
    from scipy.spatial.transform import Rotation

    to_camera = picture.camera.rotation.T
    x, y, z, w = Rotation.from_matrix(to_camera).as_quat()
    centre = picture.camera.position - np.append(origin, 0.0)
    values = [w, x, y, z, *(-to_camera @ centre)]
    return f"{number} " + " ".join(repr(float(v)) for v in values) + f" {camera} {picture.name}\n"


def _write(path: Path, lines: Sequence[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
