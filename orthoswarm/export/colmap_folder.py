"""A COLMAP model of the refined cameras: text files and the pictures, to be densified from (`image_undistorter`).

World axes are east, north, up in metres from `origin.txt`, a corner of the map's grid. COLMAP's camera axes are ours (x
right, y down, z forward); its pixel (0, 0) is the upper left CORNER of the upper left pixel, ours its centre.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.exterior_orientation import (
    Find,
    OrientedPicture,
    Row,
    Tell,
    by_lens,
    link_oriented,
    oriented_pictures,
)  # fmt: skip
from orthoswarm.model.camera import Lens

Array = NDArray[np.float64]
_ORIGIN_STEP_M = 100.0
_ENOUGH_PX = 0.01
"""Terms that move no pixel by more are left out: the adjustment returns terms that it holds at zero as 1e-16."""


def write_colmap(rows: Iterable[Row], find: Find, folder: Path, *, progress: Tell | None = None) -> list[str]:
    """Write `sparse/0/{cameras,images,points3D}.txt`, `origin.txt` and `images/`.

    Args:
        rows: lines of frames.jsonl. find: their picture files.
        folder: appears when it is complete; an existing one is replaced. progress: called with pictures done and all.

    Returns:
        Images whose files are missing: they are in the model, but not in `images`.

    Raises:
        InputError: if no picture was placed.
        OrthoSwarmError: if the disk is full.
    """
    pictures = oriented_pictures(rows)
    positions = np.array([p.camera.position for p in pictures])
    origin = np.floor(positions[:, :2].min(0) / _ORIGIN_STEP_M) * _ORIGIN_STEP_M
    numbers = by_lens(pictures)
    with atomic_write(folder) as part:
        model = part / "sparse" / "0"
        model.mkdir(parents=True)
        cameras = [f"{number} {_model(lens)}" for lens, number in numbers.items()]
        _write(model / "cameras.txt", ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS", *cameras])
        images = [_image(i, p, numbers[p.camera.lens], origin) for i, p in enumerate(pictures, 1)]
        _write(
            model / "images.txt",
            ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME and a line of its points (none)", *images],
        )
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
