"""An OpenSfM data set whose reconstruction is the refined cameras, to be densified from.

OpenSfM's world is a plane tangent to the ellipsoid at `reference_lla`: east, north, up in metres. Pixels are counted
from the picture's middle in units of the longer side; its camera axes are ours.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

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
    stated_sigma_m,
)  # fmt: skip
from orthoswarm.model.camera import Lens
from orthoswarm.model.geo import LocalGrid

Array = NDArray[np.float64]


def write_opensfm(rows: Iterable[Row], find: Find, folder: Path, *, progress: Tell | None = None) -> list[str]:
    """Write `reconstruction.json`, `camera_models.json`, `reference_lla.json` and `images/`.

    Args:
        rows: lines of frames.jsonl. find: their picture files.
        folder: appears when it is complete; an existing one is replaced. progress: called with pictures done and all.

    Returns:
        Images whose files are missing: they are in the reconstruction, but not in `images`.

    Raises:
        InputError: if no picture was placed.
        OrthoSwarmError: if the disk is full.
    """
    pictures = oriented_pictures(rows)
    lat, lon = (float(np.mean([p.row["camera"][name] for p in pictures])) for name in ("lat_deg", "lon_deg"))
    reference = {"latitude": lat, "longitude": lon, "altitude": 0.0}
    names = {lens: f"lens {number}" for lens, number in by_lens(pictures).items()}
    cameras = {name: brown_camera(lens) for lens, name in names.items()}
    centres, rotations = _topocentric(pictures, lat, lon)
    shots = {
        p.name: _shot(p, names[p.camera.lens], centre, rotation)
        for p, centre, rotation in zip(pictures, centres, rotations)
    }
    reconstruction = {"cameras": cameras, "shots": shots, "points": {}, "reference_lla": reference}
    with atomic_write(folder) as part:
        part.mkdir(parents=True)
        for name, document in (
            ("reconstruction.json", [reconstruction]),
            ("camera_models.json", cameras),
            ("reference_lla.json", reference),
        ):
            (part / name).write_text(json.dumps(document, indent=1), encoding="utf-8")
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
        "translation": (-to_camera @ centre).tolist(),
        "camera": camera,
        "orientation": 1,
        "gps_position": centre.tolist(),
        "gps_dop": stated_sigma_m(picture.row),
    }
