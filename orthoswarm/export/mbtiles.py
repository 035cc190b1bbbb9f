"""MBTiles: the orthoimage as web map tiles in one SQLite file, for tablets and offline maps.

The finest zoom is warped tile by tile from the COG; each coarser tile is made of its four finer ones.
"""

import errno
import math
import sqlite3
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from orthoswarm.export.atomic_file import written_whole
from orthoswarm.model.earth import WEB_MERCATOR_M
from orthoswarm.model.errors import InputError

Bytes = NDArray[np.uint8]
Format = Literal["png", "webp", "jpg"]
_SIZE = 256
_BATCH = 8
_MAX_ZOOM = 23
_ENCODERS = 2


@dataclass(frozen=True, slots=True)
class Range:
    """Tiles of one zoom: first and last column and row (from the north), inclusive."""

    zoom: int
    left: int
    right: int
    top: int
    bottom: int

    @property
    def count(self) -> int:
        """How many tiles."""
        return (self.right - self.left + 1) * (self.bottom - self.top + 1)

    def parent(self) -> "Range":
        """The range one zoom coarser."""
        return Range(self.zoom - 1, self.left // 2, self.right // 2, self.top // 2, self.bottom // 2)


def write_mbtiles(
    source: Path,
    path: Path,
    *,
    name: str = "orthoimage",
    tile_format: Format = "png",
    quality: int = 85,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a georeferenced RGBA raster as MBTiles 1.3.

    Args:
        source: the raster, an orthoimage.
        path: the file; appears when it is complete.
        name: shown by viewers.
        tile_format: "png" is read by all programs, "webp" is a third of its size, "jpg" has no transparency.
        quality: of webp and jpg.
        progress: called with tiles done and tiles in all.

    Raises:
        InputError: if the raster cannot be read.
        OrthoSwarmError: if the disk is full.
    """
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.warp import transform_bounds

    try:
        with rasterio.open(source) as raster, written_whole(path) as part:
            bounds = transform_bounds(raster.crs, "EPSG:4326", *raster.bounds, densify_pts=21)
            levels = _levels(bounds, raster.res[0])
            with closing(sqlite3.connect(part)) as database:
                try:
                    _Writer(database, tile_format, quality, levels, progress).write(raster, name, bounds)
                except sqlite3.Error as error:
                    full = error.sqlite_errorcode == sqlite3.SQLITE_FULL
                    raise OSError(errno.ENOSPC if full else errno.EIO, str(error)) from None
    except RasterioError as error:
        raise InputError(f"{source} cannot be read ({error}); make the map again") from None


def _levels(bounds: tuple[float, float, float, float], gsd_m: float) -> list[Range]:
    """From the zoom that is not coarser than the raster to the one where a single tile holds all."""
    west, south, east, north = bounds
    latitude = math.radians(0.5 * (south + north))
    zoom = math.ceil(math.log2(WEB_MERCATOR_M * math.cos(latitude) / _SIZE / gsd_m) - 0.3)
    zoom = min(max(zoom, 0), _MAX_ZOOM)
    left, top = _tile_of(west, north, zoom)
    right, bottom = _tile_of(east, south, zoom)
    levels = [Range(zoom, left, right, top, bottom)]
    while levels[-1].count > 1 and levels[-1].zoom > 0:
        levels.append(levels[-1].parent())
    return levels


def _tile_of(lon: float, lat: float, zoom: int) -> tuple[int, int]:
    n = 2**zoom
    x, y = _tiles_from_north_west(lon, lat, zoom)
    return min(max(int(x), 0), n - 1), min(max(int(y), 0), n - 1)


def _tiles_from_north_west(lon: float, lat: float, zoom: int) -> tuple[float, float]:
    n = 2**zoom
    return (lon + 180.0) / 360.0 * n, (1.0 - math.asinh(math.tan(math.radians(lat))) / math.pi) / 2.0 * n


def _whole_pixels(bounds: tuple[float, float, float, float], zoom: int) -> tuple[float, float, float, float]:
    """West, south, east, north in degrees, moved outwards to the next pixel's edge.

    GDAL (and so QGIS) uses the bounds as the corners of its raster and shows complete pixels from there: bounds within
    a
    pixel would shift the map by up to half a pixel.
    """
    west, south, east, north = bounds
    (left, top), (right, bottom) = _tiles_from_north_west(west, north, zoom), _tiles_from_north_west(east, south, zoom)
    n = _SIZE * 2**zoom
    columns = math.floor(left * _SIZE) / n, math.ceil(right * _SIZE) / n
    rows = math.floor(top * _SIZE) / n, math.ceil(bottom * _SIZE) / n
    north, south = (math.degrees(math.atan(math.sinh(math.pi * (1.0 - 2.0 * row)))) for row in rows)
    return columns[0] * 360.0 - 180.0, south, columns[1] * 360.0 - 180.0, north


class _Writer:
    """Fills one database."""

    def __init__(
        self,
        database: sqlite3.Connection,
        tile_format: Format,
        quality: int,
        levels: list[Range],
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.database, self.format, self.quality, self.levels = database, tile_format, quality, levels
        self.progress = progress
        self.done, self.total = 0, sum(level.count for level in levels)
        self._encoders = ThreadPoolExecutor(_ENCODERS)

    def write(self, raster: Any, name: str, bounds: tuple[float, float, float, float]) -> None:
        self.database.executescript(
            "PRAGMA journal_mode=OFF; PRAGMA synchronous=OFF; PRAGMA application_id=1297105496;"
            "CREATE TABLE metadata (name text, value text);"
            "CREATE TABLE tiles (zoom_level integer, tile_column integer, tile_row integer, tile_data blob);"
            "CREATE UNIQUE INDEX tile_index ON tiles (zoom_level, tile_column, tile_row);"
        )
        middle = f"{(bounds[0] + bounds[2]) / 2:.6f},{(bounds[1] + bounds[3]) / 2:.6f},{self.levels[0].zoom - 1}"
        rows = {
            "name": name,
            "format": self.format,
            "type": "overlay",
            "version": "1.0",
            "description": "orthoimage made by OrthoSwarm",
            "bounds": ",".join(f"{v:.10f}" for v in _whole_pixels(bounds, self.levels[0].zoom)),
            "center": middle,
            "minzoom": str(self.levels[-1].zoom),
            "maxzoom": str(self.levels[0].zoom),
        }
        self.database.executemany("INSERT INTO metadata VALUES (?, ?)", rows.items())
        with self._encoders:
            self._finest(raster)
            for level in self.levels[1:]:
                self._coarser(level)
        self.database.commit()

    def _finest(self, raster: Any) -> None:
        from rasterio.enums import Resampling
        from rasterio.transform import from_origin
        from rasterio.vrt import WarpedVRT

        level = self.levels[0]
        side = WEB_MERCATOR_M / 2**level.zoom
        for top in range(level.top, level.bottom + 1, _BATCH):
            for left in range(level.left, level.right + 1, _BATCH):
                rows = min(_BATCH, level.bottom + 1 - top)
                cols = min(_BATCH, level.right + 1 - left)
                transform = from_origin(
                    left * side - WEB_MERCATOR_M / 2, WEB_MERCATOR_M / 2 - top * side, side / _SIZE, side / _SIZE
                )
                with WarpedVRT(
                    raster,
                    crs="EPSG:3857",
                    transform=transform,
                    width=cols * _SIZE,
                    height=rows * _SIZE,
                    resampling=Resampling.bilinear,
                    warp_mem_limit=64,
                ) as vrt:
                    block = vrt.read().transpose(1, 2, 0)
                cut = block.reshape(rows, _SIZE, cols, _SIZE, 4).swapaxes(1, 2)
                at = [(r, c) for r in range(rows) for c in range(cols)]
                self._put(level.zoom, [(left + c, top + r) for r, c in at], [np.ascontiguousarray(cut[k]) for k in at])

    def _coarser(self, level: Range) -> None:
        from orthoswarm.canvas.overviews import reduce_rgba

        for y in range(level.top, level.bottom + 1):
            columns = range(level.left, level.right + 1)
            halves = []
            for x in columns:
                four = np.zeros((2 * _SIZE, 2 * _SIZE, 4), np.uint8)
                for i in (0, 1):
                    for j in (0, 1):
                        tile = self._get(level.zoom + 1, 2 * x + j, 2 * y + i)
                        if tile is not None:
                            four[i * _SIZE : (i + 1) * _SIZE, j * _SIZE : (j + 1) * _SIZE] = tile
                halves.append(reduce_rgba(four, 2))
            self._put(level.zoom, [(x, y) for x in columns], halves)

    def _put(self, zoom: int, at: Sequence[tuple[int, int]], tiles: Sequence[Bytes]) -> None:
        """Insert the tiles that are not empty; `at` gives their columns and rows from the north."""
        encoded = self._encoders.map(lambda rgba: self._encode(rgba) if rgba[..., 3].any() else None, tiles)
        for (x, y), data in zip(at, encoded, strict=True):
            self.done += 1
            if data is not None:
                row = 2**zoom - 1 - y  # MBTiles counts rows from the south
                self.database.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (zoom, x, row, data))
            if self.progress is not None:
                self.progress(self.done, self.total)

    def _get(self, zoom: int, x: int, y: int) -> Bytes | None:
        import cv2

        query = "SELECT tile_data FROM tiles WHERE zoom_level=? AND tile_column=? AND tile_row=?"
        found = self.database.execute(query, (zoom, x, 2**zoom - 1 - y)).fetchone()
        if found is None:
            return None
        bgra = np.asarray(cv2.imdecode(np.frombuffer(found[0], np.uint8), cv2.IMREAD_UNCHANGED))
        if bgra.shape[2] == 3:
            return np.asarray(cv2.cvtColor(bgra, cv2.COLOR_BGR2RGBA))
        return np.asarray(cv2.cvtColor(bgra, cv2.COLOR_BGRA2RGBA))

    def _encode(self, rgba: Bytes) -> bytes:
        return encode_tile(rgba, self.format, self.quality)


def encode_tile(rgba: Bytes, tile_format: Format, quality: int = 85) -> bytes:
    """A tile uint8 (rows, columns, 4) as PNG, WebP or JPEG (white where transparent)."""
    import cv2

    if tile_format == "jpg":
        rgb = np.where(rgba[..., 3:] > 0, rgba[..., :3], 255).astype(np.uint8)
        image, options = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    else:
        opaque = bool((rgba[..., 3] == 255).all())
        image = cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGR if opaque else cv2.COLOR_RGBA2BGRA)
        options = [cv2.IMWRITE_PNG_COMPRESSION, 4] if tile_format == "png" else [cv2.IMWRITE_WEBP_QUALITY, quality]
    return bytes(cv2.imencode("." + tile_format, image, options)[1])
