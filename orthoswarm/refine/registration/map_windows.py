"""A part of the map in memory at one pixel size, cut into small windows about ground points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import MapWindow

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LoadedMap:
    """Grey map of an area in a local frame.

    Attributes:
        west, north: edges in the local frame (grid minus origin), metres. gsd_m: pixel.
        gray: uint8 (rows, columns). valid: bool (rows, columns).
    """

    west: float
    north: float
    gsd_m: float
    gray: NDArray[np.uint8]
    valid: NDArray[np.bool_]

    @classmethod
    def load(cls, basemap: MapWindow, origin: Array, bounds: BoundingBox, gsd_m: float) -> "LoadedMap":
        """Read local bounds (west, south, east, north) of a map; origin (2,) is added to reach its grid."""
        east, north = float(origin[0]), float(origin[1])
        world = bounds.moved(east, north)
        gray, valid = basemap.gray(world, gsd_m)
        grid = GroundGrid.around(basemap.epsg, world, gsd_m)
        return cls(grid.west - east, grid.north - north, gsd_m, np.clip(gray + 0.5, 0, 255).astype(np.uint8), valid)

    def pixel_centre(self, x: float, y: float) -> tuple[int, int, float, float]:
        """Row and column of the pixel that holds a point, and the local coordinates of its centre."""
        c, r = int((x - self.west) // self.gsd_m), int((self.north - y) // self.gsd_m)
        return r, c, self.west + (c + 0.5) * self.gsd_m, self.north - (r + 0.5) * self.gsd_m

    def window(self, row: int, column: int, half: int) -> tuple[NDArray[np.float32], float] | None:
        """Grey float32 (2 half + 1, 2 half + 1) about a pixel and its valid share; None if it leaves the map."""
        rows, cols = self.gray.shape
        if row < half or column < half or row + half >= rows or column + half >= cols:
            return None
        cut = (slice(row - half, row + half + 1), slice(column - half, column + half + 1))
        valid = self.valid[cut]
        share = np.count_nonzero(valid) / valid.size
        gray = self.gray[cut].astype(np.float32)
        if share < 1.0:
            gray[~valid] = np.nan
        return gray, share
