"""The pre-disaster map: windows of a GeoTIFF, COG, MBTiles file or folder of XYZ tiles on the area's grid.

Only requested windows are read. All kinds of content (grey, colour, palette, 16 bit, floats,
alpha, nodata, a rotated or different grid) are returned as 8-bit values and a validity mask.
"""

from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm.model.arrays import Bytes, Flags, Floats
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import GroundGrid
from orthoswarm.raster.gdal_map import RasterMap, luma
from orthoswarm.raster.map_check import sample_windows
from orthoswarm.raster.tile_map import TileMap
from orthoswarm.stores.addresses import address_of
from orthoswarm.stores.listing import exists

_LEAST_SHOWN: Final = 1e-3  # share of an area: a map that shows less of it is transparent or empty there
_LOOK_PX: Final = 256  # pixels a side in which an area is looked at as a whole, finer than a road's corridor


class Basemap:
    """A pre-disaster map (a `placement.MapWindow`); can be pickled and shared among threads.

    path: the file or folder. epsg: the area's grid, in which windows are asked for and returned.
    """

    def __init__(self, path: Path, epsg: int, near: BoundingBox | None) -> None:
        self.path = path
        self.epsg = epsg
        self._near = near

    @cached_property
    def _source(self) -> RasterMap | TileMap:
        """The open map; a copy in another process opens its own at its first use, where an error can be reported."""
        is_tiles = self.path.is_dir() or self.path.suffix.lower() == ".mbtiles"
        kind = TileMap if is_tiles else RasterMap
        return kind(self.path, self.epsg, self._near)

    @classmethod
    def open(cls, path: str | Path, epsg: int, near: BoundingBox | None = None) -> "Basemap":
        """Open a map for an area.

        Args:
            path: GeoTIFF, COG, MBTiles or anything else that GDAL reads, or a folder z/x/y.png|jpg|webp.
            epsg: EPSG code of the area's grid (metres).
            near: west, south, east, north of the area in that grid; the map must touch it.

        Raises:
            InputError: if the map cannot be read, has no coordinate system or lies elsewhere.
        """
        path = Path(path)
        if not exists(path):
            raise InputError(f"the basemap {address_of(path)} does not exist; check the path")
        basemap = cls(path, epsg, near)
        basemap.require_overlap(near or basemap.bounds)
        return basemap

    @property
    def bounds(self) -> BoundingBox:
        """West, south, east, north of the map in the area's grid; of a huge map, of the part near the area."""
        return self._source.bounds

    @property
    def attribution(self) -> str:
        """Whose map it is and under which licence, as an MBTiles file says it; else empty."""
        return self._source.attribution if isinstance(self._source, TileMap) else ""

    @property
    def native_gsd_m(self) -> float:
        """Size of the map's own pixel on the ground of the area, metres."""
        return self._source.native_gsd_m

    def require_overlap(self, near: BoundingBox) -> None:
        """Raise InputError, saying how far away the map is, unless it touches the bounds."""
        west, south, east, north = self.bounds
        dx = max(west - near.east, near.west - east, 0.0)
        dy = max(south - near.north, near.south - north, 0.0)
        if dx or dy:
            away = float(np.hypot(dx, dy))
            size = f"{away / 1000:,.1f} km" if away >= 1000 else f"{away:.0f} m"
            raise InputError(
                f"the basemap {self.path.name} does not overlap the flight, it is {size} away; give a map of this area"
            )

    def require_readable(self, near: BoundingBox) -> None:
        """Raise InputError if the opened map shows nothing where it is needed, or is truncated or damaged there.

        near: west, south, east, north of the area in its grid, metres. Only the map's part of it counts.
        """
        bounds = near.intersection(self.bounds)
        if bounds.empty:
            return
        self._source.require_complete(bounds)
        gsds = self._source.gsds()
        valid = [self.gray(window, gsd)[1].mean() for gsd in gsds for window in sample_windows(bounds, gsd)]
        # A map may be a narrow strip between all samples: only a look at everything, which takes longer, tells.
        look_m = max(self.native_gsd_m, max(bounds.width, bounds.height) / _LOOK_PX)
        if np.mean(valid) < _LEAST_SHOWN and self.gray(bounds, look_m)[1].mean() < _LEAST_SHOWN:
            raise InputError(
                f"the basemap {self.path.name} is transparent or empty in the area; give a map that shows it, or "
                "export this one again without transparency"
            )

    def gray(self, bounds: BoundingBox, gsd_m: float) -> tuple[Floats, Flags]:
        """Grey values and validity of a window.

        Args:
            bounds: west, south, east, north in the area's grid, metres.
            gsd_m: pixel size of the answer; coarser than the map averages, finer interpolates.

        Returns:
            Values float32 (rows, columns) from 0 to 255 (0 where invalid) and validity bool (rows, columns), on the
            grid GroundGrid.around(epsg, bounds, gsd_m).
        """
        data, valid = self._source.read(GroundGrid.around(self.epsg, bounds, gsd_m), gray=True)
        gray = luma(data)[0].astype(np.float32)
        gray[~valid] = 0.0
        return gray, valid

    def rgb(self, bounds: BoundingBox, gsd_m: float) -> tuple[Bytes, Flags]:
        """Colours uint8 (rows, columns, 3) and validity of a window; the grid is that of `gray`."""
        data, valid = self._source.read(GroundGrid.around(self.epsg, bounds, gsd_m), gray=False)
        out = np.array(np.broadcast_to(data, (3, *data.shape[1:])).transpose(1, 2, 0), order="C")  # never a view
        out[~valid] = 0
        return out, valid

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "epsg": self.epsg, "near": self._near}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["path"], state["epsg"], state["near"])  # type: ignore[misc]
