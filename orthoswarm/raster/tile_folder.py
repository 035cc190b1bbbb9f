"""A folder of map tiles z/x/y.png|jpg|webp in web Mercator, read in windows on the area's grid."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.earth import WEB_MERCATOR_M
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import GroundGrid

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")


class TileFolder:
    """Tiles of one or several zoom levels; XYZ order, or TMS (rows from the south), whichever fits the area.

    Attributes:
        native_gsd_m: ground size of a pixel of the finest zoom, metres.
        bounds: west, south, east, north of the tiles near the area, in its grid.
    """

    def __init__(self, path: Path, epsg: int, near: BoundingBox | None) -> None:
        self._path = path
        self._epsg = epsg
        zooms = sorted(int(p.name) for p in path.iterdir() if p.is_dir() and p.name.isdigit())
        self._columns = {z: _columns(path / str(z)) for z in zooms}
        self._columns = {z: c for z, c in self._columns.items() if c}
        if not self._columns:
            raise InputError(f"the folder {path} holds no map tiles z/x/y.png (or jpg, webp); give a map")
        self._zoom = max(self._columns)
        rows = self._columns[self._zoom][min(self._columns[self._zoom])]
        first = _decode(rows[min(rows)])
        if first is None:
            raise InputError(f"the map tile {rows[min(rows)]} cannot be decoded; download the tiles again")
        self._size = len(first[0])
        self._tms = near is not None and self._rows_from_south(near)
        self.bounds = self._ground_bounds(near)
        x, y = (near or self.bounds).center
        per_metre = np.diff(self._mercator(np.array([[x, y], [x + 100.0, y]])), axis=0)
        self.native_gsd_m = float(WEB_MERCATOR_M / 2**self._zoom / self._size / np.hypot(*per_metre[0]) * 100.0)

    def _mercator(self, east_north: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y = _transformer(self._epsg).transform(east_north[:, 0], east_north[:, 1])
        return np.stack([np.asarray(x), np.asarray(y)], axis=1)

    def _tile_range(self, bounds: BoundingBox, zoom: int) -> tuple[int, int, int, int]:
        """First and last column, first and last row (from the north) of the tiles that bounds need, inclusive."""
        west, south, east, north = bounds
        s = np.linspace(0.0, 1.0, 9)
        ring = np.r_[
            np.c_[west + s * (east - west), np.full(9, south)],
            np.c_[west + s * (east - west), np.full(9, north)],
            np.c_[np.full(9, west), south + s * (north - south)],
            np.c_[np.full(9, east), south + s * (north - south)],
        ]
        xy = self._mercator(ring)
        side = WEB_MERCATOR_M / 2**zoom
        column = np.floor((xy[:, 0] + WEB_MERCATOR_M / 2) / side)
        row = np.floor((WEB_MERCATOR_M / 2 - xy[:, 1]) / side)
        return int(column.min()), int(column.max()), int(row.min()), int(row.max())

    def _rows_from_south(self, near: BoundingBox) -> bool:
        """True if the area has tiles only when rows count from the south."""
        left, right, top, bottom = self._tile_range(near, self._zoom)
        flip = 2**self._zoom - 1
        columns = self._columns[self._zoom]

        def hits(first: int, last: int) -> int:
            return sum(first <= r <= last for c in range(left, right + 1) for r in columns.get(c, ()))

        return hits(top, bottom) == 0 and hits(flip - bottom, flip - top) > 0

    def _ground_bounds(self, near: BoundingBox | None) -> BoundingBox:
        """Bounds of the finest tiles in the grid, those within some kilometres of the area."""
        side, flip = WEB_MERCATOR_M / 2**self._zoom, 2**self._zoom - 1
        tiles = np.array(
            [(c, flip - r if self._tms else r) for c, rows in self._columns[self._zoom].items() for r in rows]
        )
        if near is not None:
            margin = max(5000.0, near.width, near.height)
            left, right, top, bottom = self._tile_range(near.grown(margin), self._zoom)
            close = (tiles[:, 0] >= left) & (tiles[:, 0] <= right) & (tiles[:, 1] >= top) & (tiles[:, 1] <= bottom)
            tiles = tiles[close] if close.any() else tiles
        x = np.array([tiles[:, 0].min(), tiles[:, 0].max() + 1]) * side - WEB_MERCATOR_M / 2
        y = WEB_MERCATOR_M / 2 - np.array([tiles[:, 1].max() + 1, tiles[:, 1].min()]) * side
        corners = np.array([[a, b] for a in (*x, x.mean()) for b in (*y, y.mean())])
        east, north = _transformer(self._epsg).transform(corners[:, 0], corners[:, 1], direction="INVERSE")
        return BoundingBox.around_points(np.column_stack([east, north]))

    def gsds(self) -> list[float]:
        """A pixel size for each zoom level, metres."""
        return [self.native_gsd_m * 2 ** (self._zoom - zoom) for zoom in self._columns]

    def require_complete(self, bounds: BoundingBox) -> None:
        """Does nothing: each tile is a separate file, and one that cannot be decoded is a hole in the map."""

    def read(self, grid: GroundGrid, gray: bool) -> tuple[Bytes, Mask]:
        """Colours uint8 (3, rows, columns), also where grey is enough, and validity of a window."""
        from rasterio.enums import Resampling
        from rasterio.transform import from_origin
        from rasterio.warp import reproject

        fine = max(0.0, float(np.log2(max(grid.gsd_m / self.native_gsd_m, 1e-9))))
        zooms = [z for z in self._columns if z >= self._zoom - fine + 1] or [self._zoom]
        zoom = min(zooms)
        shrink = max(1, 2 ** int(fine - (self._zoom - zoom) - 1))
        shrink = min(shrink, self._size)
        colours, origin, pixel = self._assemble(grid.bounds, zoom, shrink)
        out = np.zeros((4, grid.height, grid.width), np.uint8)
        if colours is None:
            return out[:3], out[3] > 0
        coarse = grid.gsd_m / self.native_gsd_m * 2.0 ** (zoom - self._zoom) / shrink >= 2
        reproject(
            colours,
            out,
            src_transform=from_origin(*origin, pixel, pixel),
            src_crs="EPSG:3857",
            dst_transform=grid.affine(),
            dst_crs=f"EPSG:{grid.epsg}",
            resampling=Resampling.average if coarse else Resampling.bilinear,
            src_alpha=4,
            dst_alpha=4,
            tolerance=0.01,
        )
        return out[:3], out[3] > 127

    def _assemble(self, bounds: BoundingBox, zoom: int, shrink: int) -> tuple[Bytes | None, tuple[float, float], float]:
        """The tiles under bounds as one RGBA picture (4, rows, columns), its upper left corner and pixel size."""
        import cv2

        left, right, top, bottom = self._tile_range(bounds, zoom)
        flip = 2**zoom - 1
        n = self._size // shrink
        tiles = {
            (c, flip - r if self._tms else r): file
            for c in range(left, right + 1)
            for r, file in self._columns[zoom].get(c, {}).items()
        }
        tiles = {(c, r): file for (c, r), file in tiles.items() if top <= r <= bottom}
        side = WEB_MERCATOR_M / 2**zoom
        origin = (left * side - WEB_MERCATOR_M / 2, WEB_MERCATOR_M / 2 - top * side)
        if not tiles:
            return None, origin, side / n
        canvas = np.zeros(((bottom - top + 1) * n, (right - left + 1) * n, 4), np.uint8)
        for (c, r), file in tiles.items():
            tile = _decode(file)
            if tile is not None:
                small = tile if tile.shape[:2] == (n, n) else cv2.resize(tile, (n, n), interpolation=cv2.INTER_AREA)
                canvas[(r - top) * n : (r - top + 1) * n, (c - left) * n : (c - left + 1) * n] = small
        return np.ascontiguousarray(canvas.transpose(2, 0, 1)), origin, side / n


@lru_cache(maxsize=8)
def _transformer(epsg: int) -> Transformer:
    return Transformer.from_crs(epsg, 3857, always_xy=True)


def _columns(folder: Path) -> dict[int, dict[int, Path]]:
    """Column -> row -> file of one zoom level."""
    out: dict[int, dict[int, Path]] = {}
    for column in folder.iterdir():
        if column.name.isdigit() and column.is_dir():
            rows = {int(f.stem): f for f in column.iterdir() if f.stem.isdigit() and f.suffix.lower() in _SUFFIXES}
            if rows:
                out[int(column.name)] = rows
    return out


def _decode(file: Path) -> Bytes | None:
    """A tile as RGBA uint8 (size, size, 4); None if it is damaged."""
    import cv2

    data = np.frombuffer(file.read_bytes(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        return None
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.ndim == 2:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGBA))
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGBA if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA))
