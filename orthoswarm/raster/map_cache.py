"""A cache of map tiles, for many overlapping windows of one pixel size."""

import numpy as np

from orthoswarm.model.arrays import Flags, Floats
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import MapWindow

TILE_PX = 128


class TiledMap:
    """A `MapWindow` that caches what it has read at one pixel size; other sizes are read from the map itself.

    Memory grows with the ground that the windows cover, so use one instance per task.
    """

    def __init__(self, basemap: MapWindow, gsd_m: float) -> None:
        self.epsg = basemap.epsg
        self._basemap, self._gsd_m = basemap, gsd_m
        self._tiles: dict[tuple[int, int], tuple[Floats, Flags]] = {}

    @property
    def bounds(self) -> BoundingBox:
        """West, south, east, north of the map in the area's grid."""
        return self._basemap.bounds

    @property
    def native_gsd_m(self) -> float:
        """Size of the map's own pixel."""
        return self._basemap.native_gsd_m

    def gray(self, bounds: BoundingBox, gsd_m: float) -> tuple[Floats, Flags]:
        """Grey values and validity of a window, as the map itself gives them."""
        if gsd_m != self._gsd_m:
            return self._basemap.gray(bounds, gsd_m)
        grid = GroundGrid.around(self.epsg, bounds, gsd_m)
        # rows count southwards from the equator's line of the lattice, columns eastwards
        row, col = -round(grid.north / gsd_m), round(grid.west / gsd_m)
        gray, valid = np.zeros((grid.height, grid.width), np.float32), np.zeros((grid.height, grid.width), bool)
        for i in range(row // TILE_PX, (row + grid.height - 1) // TILE_PX + 1):
            for j in range(col // TILE_PX, (col + grid.width - 1) // TILE_PX + 1):
                r0, c0 = i * TILE_PX - row, j * TILE_PX - col
                rows, cols = slice(max(r0, 0), r0 + TILE_PX), slice(max(c0, 0), c0 + TILE_PX)
                inner = slice(max(-r0, 0), grid.height - r0), slice(max(-c0, 0), grid.width - c0)
                tile_gray, tile_valid = self._tile(i, j)
                gray[rows, cols], valid[rows, cols] = tile_gray[inner], tile_valid[inner]
        return gray, valid

    def _tile(self, i: int, j: int) -> tuple[Floats, Flags]:
        if (i, j) not in self._tiles:
            side = TILE_PX * self._gsd_m
            # from the middles of the outermost pixels, so that rounding cannot add a row or a column
            inset = 0.5 * self._gsd_m
            tile = BoundingBox(j * side, -(i + 1) * side, (j + 1) * side, -i * side)
            self._tiles[i, j] = self._basemap.gray(tile.grown(-inset), self._gsd_m)
        return self._tiles[i, j]
