"""Flights over a made-up ground, and what is drawn and refined of them."""

import contextlib
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.batch.refiners import make_refiner
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.camera import NADIR_PITCH_RAD, Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import GroundGrid, LocalGrid
from orthoswarm.mosaic.radiometry import estimate_fields
from orthoswarm.mosaic.realtime import RealtimeMosaic
from orthoswarm.mosaic.renderer import render
from orthoswarm.raster.basemap import Basemap
from orthoswarm.raster.picture_quality import picture_quality

_EPSG: Final = 32631
_EAST, _NORTH = 500_000.0, 5_000_000.0
_SIDE_M: Final = 420
_HEIGHT_M: Final = 60.0
_LENS: Final = Lens(240, 180, focal_px(float(np.radians(70.0)), 240))


def draw_something(folder: Path) -> None:
    """Draw a grey picture in real time, and judge it."""
    camera = Camera(np.array([16.0, 16.0, 30.0]), rotation_from_angles(0.0, NADIR_PITCH_RAD, 0.0), Lens(32, 24, 30.0))
    grid = GroundGrid(epsg=_EPSG, west=0.0, north=64.0, gsd_m=1.0, width=64, height=64)
    with Canvas.create(folder / "drawn", grid, tile_px=64) as canvas:
        RealtimeMosaic(canvas).add(np.full((24, 32, 4), 255, np.uint8), camera)
    picture_quality(np.zeros((24, 32, 4), np.uint8))


def refine_something() -> None:
    """Refine and draw a vehicle next to another one on the same path, over a synthetic map; the result is discarded."""
    ground = made_up_ground()
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(OrthoSwarmError):
        place = Path(folder)
        write_map(ground, place / "map.tif")
        basemap = Basemap.open(place / "map.tif", _EPSG)
        origin = np.array([_EAST, _NORTH])
        refiner = make_refiner("swarm", _EPSG, origin)
        first = refiner.refine(made_up_flight(ground, place, "a"), [], basemap)
        second = refiner.refine(made_up_flight(ground, place, "b"), [first], basemap)
        terrain = second.terrain
        if terrain is None:
            return
        grid = GroundGrid(epsg=_EPSG, west=_EAST - 200.0, north=_NORTH + 200.0, gsd_m=0.5, width=800, height=800)
        with Canvas.create(place / "canvas", grid, plane="frame") as canvas:
            stats = render(second.placed, terrain, canvas)
            estimate_fields(second.placed, stats.thumbnails, terrain)


def made_up_ground() -> NDArray[np.float32]:
    """Colours of synthetic ground with detail at all scales, float32 (metres south, metres east, 3)."""
    import cv2

    rng = np.random.default_rng(7)
    ground = np.zeros((_SIDE_M, _SIDE_M, 3), np.float32)
    for cells in (20, 80, 300):
        part = rng.uniform(0.0, 85.0, (cells, cells, 3)).astype(np.float32)
        ground += cv2.resize(part, (_SIDE_M, _SIDE_M), interpolation=cv2.INTER_LINEAR)
    return ground


def write_map(ground: NDArray[np.float32], path: Path) -> None:
    """Write the ground as a georeferenced map."""
    import rasterio
    from rasterio.transform import from_origin

    half = 0.5 * _SIDE_M
    about: dict[str, Any] = {"driver": "GTiff", "width": _SIDE_M, "height": _SIDE_M, "count": 3, "dtype": "uint8"}
    with rasterio.open(
        path, "w", crs=f"EPSG:{_EPSG}", transform=from_origin(_EAST - half, _NORTH + half, 1.0, 1.0), **about
    ) as raster:
        raster.write(np.moveaxis(ground.astype(np.uint8), -1, 0))


def made_up_flight(ground: NDArray[np.float32], folder: Path, vehicle: str) -> list[Frame]:
    """Two opposite legs of 14 pictures each, rendered into a folder."""
    grid = LocalGrid(_EPSG)
    frames = []
    for number in range(28):
        back = number >= 14
        along = -78.0 + 6.0 * (number - 14 if back else number)
        position = np.array([_EAST - 60.0 + 30.0 * back, _NORTH + (-along if back else along), _HEIGHT_M])
        yaw = np.pi if back else 0.0
        camera = Camera(position, rotation_from_angles(yaw, NADIR_PITCH_RAD, 0.0), _LENS)
        path = folder / f"{vehicle}{number}.jpg"
        _photograph(ground, camera, path)
        lat, lon = (float(v) for v in grid.to_geographic(position[:2]))
        turn = float(grid.convergence_rad(lat, lon))
        fix = Fix(
            lat_deg=lat,
            lon_deg=lon,
            height_m=_HEIGHT_M,
            altitude_m=None,
            yaw_rad=yaw + turn,
            pitch_rad=NADIR_PITCH_RAD,
            roll_rad=0.0,
            flight_yaw_rad=None,
            position_sigma_m=None,
            height_is_ground=False,
        )
        frames.append(
            Frame(
                image=path.name,
                path=path,
                vehicle=vehicle,
                time_s=1e9 + number,
                fix=fix,
                width=_LENS.width,
                height=_LENS.height,
            )
        )
    return frames


def _photograph(ground: NDArray[np.float32], camera: Camera, path: Path) -> None:
    import cv2

    half = 0.5 * _SIDE_M
    to_cells = np.array([[1.0, 0.0, half - 0.5 - _EAST], [0.0, -1.0, half - 0.5 + _NORTH], [0.0, 0.0, 1.0]])
    matrix = to_cells @ camera.homography(0.0)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    picture = cv2.warpPerspective(ground, matrix, (_LENS.width, _LENS.height), flags=flags)
    cv2.imwrite(str(path), picture[..., ::-1].astype(np.uint8))
