"""The temperature band of a map of thermal pictures whose pixels are temperatures.

Each ground pixel takes its value from the picture that the orthoimage shows there, by linear interpolation, unchanged:
neither balanced nor blended. Pictures hold degrees Celsius or kelvin in 32-bit numbers, as programs that convert
thermal photos write them, or counts of a part of a kelvin in 16 bits (FLIR's TLinear: 0.04 or 0.01 K a count). What is
in a maker's own radiometric JPEG only the maker's library tells.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.export.cog import software
from orthoswarm.export.value_raster import write_values
from orthoswarm.model.arrays import Floats
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.mosaic.extent import drawn_window
from orthoswarm.mosaic.kernels.drawn_heights import heights
from orthoswarm.mosaic.kernels.pixel_sampling import UNIT, place
from orthoswarm.mosaic.kernels.render_arrays import Shots, crop
from orthoswarm.raster.picture_file import read_values

TEMPERATURE: Final = "temperature.tif"
_ZERO_K: Final = 273.15
_KELVIN_FROM: Final = 200.0  # greater medians of 32-bit pictures are kelvin: no ground has as many degrees Celsius
_NO_DATA: Final = -9999.0
_KEPT: Final = 64  # pictures between tiles: 80 MB of 640 x 512


def read_temperatures(path: Path, kelvin: float) -> Floats:
    """A picture's temperatures, degrees Celsius, float32 (rows, columns).

    kelvin: a count of a picture of 16 bits; 0 where they have 32.

    Raises:
        InputError: its pixels are no temperatures. PictureError: it cannot be read.
    """
    image = read_values(path)
    if image is not None and image.ndim == 2 and image.dtype == np.float32:
        celsius = not np.nanmedian(image) > _KELVIN_FROM
        return np.asarray(image - np.float32(0.0 if celsius else _ZERO_K))
    if image is not None and image.ndim == 2 and image.dtype == np.uint16:
        if kelvin <= 0.0:
            raise InputError(f"{path.name} has counts of 16 bits: say how many kelvin one is, --temperature 0.04")
        return np.asarray(image * np.float32(kelvin) - np.float32(_ZERO_K), np.float32)
    raise InputError(
        f"{path.name} holds colours, not temperatures: convert thermal photos to 32-bit TIFF with their maker's "
        "program (what is in a radiometric JPEG only its library tells), or leave out --temperature"
    )


def write_temperature(
    path: Path, canvas: Canvas, frames: Sequence[PlacedFrame], terrain: Terrain, *, kelvin: float, scratch: Path
) -> None:
    """Write the temperatures of the ground that an orthoimage shows, degrees Celsius, a COG.

    Args:
        path: the file; appears when it is complete. canvas: rendered from `frames` on `terrain`, with plane "frame".
        kelvin: see `read_temperatures`. scratch: folder for a file of the map's size.

    Raises:
        PictureError: a picture cannot be read any more. StorageError: if the disk is full.
    """
    drawn = _Drawn(canvas, frames, terrain, kelvin)
    row0, row1, col0, col1 = drawn_window(canvas)
    scratch.mkdir(parents=True, exist_ok=True)
    values = np.memmap(scratch / "temperature", np.float32, "w+", shape=(max(row1 - row0, 1), max(col1 - col0, 1)))
    for row in range(row0, row1, canvas.tile_px):
        for column in range(col0, col1, canvas.tile_px):
            tile = drawn.tile(row, min(row + canvas.tile_px, row1), column, min(column + canvas.tile_px, col1))
            values[row - row0 :, column - col0 :][: tile.shape[0], : tile.shape[1]] = tile
    grid = canvas.grid
    here = GroundGrid(
        epsg=grid.epsg, west=grid.west + col0 * grid.gsd_m, north=grid.north - row0 * grid.gsd_m, gsd_m=grid.gsd_m,
        width=values.shape[1], height=values.shape[0],
    )  # fmt: skip
    tags = {"TIFFTAG_SOFTWARE": software()}
    write_values(path, here, {"temperature": values}, no_data=_NO_DATA, units=("degC",), tags=tags)


class _Drawn:
    """What an orthoimage was drawn from, and the temperatures of its newest pictures."""

    def __init__(self, canvas: Canvas, frames: Sequence[PlacedFrame], terrain: Terrain, kelvin: float) -> None:
        self._canvas, self._frames, self._terrain = canvas, frames, terrain
        self._shots = Shots.of([p.camera for p in frames], [False] * len(frames))
        self._read = lru_cache(_KEPT)(partial(read_temperatures, kelvin=kelvin))

    def tile(self, row0: int, row1: int, col0: int, col1: int) -> Floats:
        """The temperatures of a tile of the canvas, float32 (rows, columns)."""
        grid, shots = self._canvas.grid, self._shots
        labels = np.ascontiguousarray(self._canvas.read_plane(row0, row1, col0, col1))
        out = np.full(labels.shape, _NO_DATA, np.float32)
        west, north, side = grid.west + col0 * grid.gsd_m, grid.north - row0 * grid.gsd_m, self._canvas.tile_px
        east, south = west + side * grid.gsd_m, north - side * grid.gsd_m
        lattice = heights(crop(self._terrain, BoundingBox(west, south, east, north)), west, north, grid.gsd_m, side)
        position, rotation = shots.about(west, north)
        window = np.array([0, labels.shape[0], 0, labels.shape[1]], np.int32)
        for label in np.unique(labels[labels > 0]).tolist():
            k = label - 1
            index, spots, *_ = place(
                labels, label, window, position[k], rotation[k], shots.lens[k], lattice, grid.gsd_m, shots.size[k], 1
            )
            at = np.zeros((2, *labels.shape), np.float32)
            at.reshape(2, -1)[:, index] = spots * np.float32(1.0 / UNIT)
            found = cv2.remap(self._read(self._frames[k].frame.path), at[0], at[1], cv2.INTER_LINEAR)
            out.flat[index] = np.nan_to_num(found.flat[index], nan=_NO_DATA)
        return out
