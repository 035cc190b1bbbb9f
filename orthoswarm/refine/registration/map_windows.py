"""A part of the map in memory at one pixel size, cut into small windows about ground points."""

from dataclasses import dataclass

import numpy as np

from orthoswarm.model.arrays import Array, Flags, Gray, Indices
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import MapWindow


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
    gray: Gray
    valid: Flags

    @classmethod
    def load(cls, basemap: MapWindow, origin: Array, bounds: BoundingBox, gsd_m: float) -> "LoadedMap":
        """Read local bounds (west, south, east, north) of a map; origin (2,) is added to reach its grid."""
        east, north = float(origin[0]), float(origin[1])
        world = bounds.moved(east, north)
        gray, valid = basemap.gray(world, gsd_m)
        grid = GroundGrid.around(basemap.epsg, world, gsd_m)
        return cls(grid.west - east, grid.north - north, gsd_m, np.clip(gray + 0.5, 0, 255).astype(np.uint8), valid)

    def pixel_centres(self, xy: Array) -> tuple[Indices, Array]:
        """Row and column (K, 2) of the pixels that hold points (K, 2), and the coordinates (K, 2) of their middles."""
        column = ((xy[:, 0] - self.west) // self.gsd_m).astype(np.int64)
        row = ((self.north - xy[:, 1]) // self.gsd_m).astype(np.int64)
        east, north = self.west + (column + 0.5) * self.gsd_m, self.north - (row + 0.5) * self.gsd_m
        return np.column_stack([row, column]), np.column_stack([east, north])
