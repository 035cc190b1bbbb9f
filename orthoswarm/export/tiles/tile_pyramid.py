"""Web map tiles (XYZ, web mercator, 256 pixels) of an orthoimage, drawn once and handed to all files that want them.

The finest zoom is warped from the orthoimage in blocks of 8 x 8 tiles; each coarser tile is the mean of its four finer
ones. Tiles come four at a time, as the quad that their parent is made of, children before parents, so that no more than
one block and one quad a zoom are in memory.

A map on the meridian of 180 degrees is drawn as one that goes on to the east of it: longitudes beyond 180 degrees and
columns beyond the last one. Files get columns and longitudes as they are counted from the west again.
"""

import contextlib
import math
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from orthoswarm.canvas.overviews import reduce_rgba
from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Array, Bytes
from orthoswarm.model.earth import WEB_MERCATOR_M
from orthoswarm.model.errors import InputError, OrthoSwarmError


class ReducedRaster(contextlib.ExitStack):
    """An open raster, and its overviews as rasters of their own.

    The overviews of our orthoimages are means of 2 x 2 pixels, so that nothing is lost against reading all pixels; they
    are opened when they are first asked for. Not for several threads at once.

    path: the raster. Raises RasterioError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        import rasterio

        super().__init__()
        self._path = path
        self.full = self.enter_context(rasterio.open(path))
        self._factors: list[int] = self.full.overviews(1)
        self._overviews: dict[int, Any] = {}

    def at(self, factor: float) -> tuple[Any, float]:
        """The dataset whose pixels are the largest that are at most `factor` pixels of the raster wide.

        Returns the dataset, and how many of its pixels `factor` is.
        """
        import rasterio

        levels = [k for k, size in enumerate(self._factors) if size <= factor]
        if not levels:
            return self.full, factor
        level = levels[-1]
        if level not in self._overviews:
            self._overviews[level] = self.enter_context(rasterio.open(self._path, overview_level=level))
        return self._overviews[level], factor / self._factors[level]


Tell = Callable[[int, int], None]
SIDE: Final = 256
_STEP: Final = 32  # pixels between exactly transformed points: a tile bends by less than 1e-4 of a pixel between them
_BLOCK_ZOOMS: Final = 3
_DEEPEST: Final = 23
_ENCODERS: Final = 2
_AHEAD: Final = 32  # quads of 1 MB that wait to be encoded


@dataclass(frozen=True, slots=True)
class TileRange:
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

    def parent(self) -> "TileRange":
        """The range one zoom coarser."""
        return TileRange(self.zoom - 1, self.left // 2, self.right // 2, self.top // 2, self.bottom // 2)

    def tiles(self) -> list[tuple[int, int]]:
        """Column and row of each tile, row by row."""
        return [(x, y) for y in range(self.top, self.bottom + 1) for x in range(self.left, self.right + 1)]

    def has(self, x: int, y: int) -> bool:
        """True if the tile of this column and row is in it."""
        return self.left <= x <= self.right and self.top <= y <= self.bottom


@dataclass(frozen=True, slots=True)
class Pyramid:
    """The tiles of an orthoimage."""

    # west, south, east, north of the orthoimage in degrees; east is beyond 180 where the map lies on that meridian, and
    # columns are beyond the last one there
    bounds: tuple[float, float, float, float]
    # from the finest zoom to the one where a single tile holds all, or zoom 1 with a tile on either side
    levels: tuple[TileRange, ...]

    @property
    def finest(self) -> TileRange:
        """The tiles of the finest zoom."""
        return self.levels[0]

    @property
    def crosses(self) -> bool:
        """True if the map lies on both sides of the meridian of 180 degrees."""
        return self.bounds[2] > 180.0

    def pixels(self) -> tuple[int, int, int, int]:
        """Left, top, right, bottom of the orthoimage in whole pixels of the finest zoom, counted from its first tile.

        Outwards to the next pixel's edge: GDAL (and so QGIS) shows complete pixels from the bounds on; bounds within a
        pixel would shift the map by up to half a pixel.
        """
        west, south, east, north = self.bounds
        zoom = self.finest.zoom
        left, top = _tiles_from_north_west(west, north, zoom)
        right, bottom = _tiles_from_north_west(east, south, zoom)
        x, y = self.finest.left, self.finest.top
        return (
            math.floor((left - x) * SIDE),
            math.floor((top - y) * SIDE),
            math.ceil((right - x) * SIDE),
            math.ceil((bottom - y) * SIDE),
        )

    def whole_pixel_bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north in degrees of `pixels`; east as in `bounds`."""
        left, top, right, bottom = self.pixels()
        x, y, zoom = self.finest.left, self.finest.top, self.finest.zoom
        west, north = degrees_of(x + left / SIDE, y + top / SIDE, zoom)
        east, south = degrees_of(x + right / SIDE, y + bottom / SIDE, zoom)
        return west, south, east, north


@dataclass(frozen=True, slots=True)
class Quad:
    """Four tiles, those that the tile `zoom`, `x`, `y` is made of."""

    zoom: int  # of the parent; -1 for the one tile of zoom 0
    # x, y: column, and row from the north, of the parent; the column as `Pyramid` counts
    x: int
    y: int
    rgba: Bytes  # uint8 (512, 512, 4), something drawn

    def tiles(self) -> Iterator[tuple[int, int, Bytes]]:
        """Column, row from the north and pixels, uint8 (256, 256, 4), of its tiles where something is drawn.

        Columns are from 0 to the zoom's last one.
        """
        count = 2 ** (self.zoom + 1)
        for i in (0, 1):
            for j in (0, 1):
                tile = np.ascontiguousarray(self.rgba[i * SIDE : (i + 1) * SIDE, j * SIDE : (j + 1) * SIDE])
                if tile[..., 3].any():
                    yield (2 * self.x + j) % count, 2 * self.y + i, tile


class TileFile(Protocol):
    """A file that is being filled with tiles."""

    def begin(self, pyramid: Pyramid) -> None:
        """Called once, before the first quad."""

    def encode(self, quad: Quad) -> Any:
        """What is stored of a quad; called in other threads."""

    def store(self, quad: Quad, encoded: Any) -> None:
        """Store what `encode` returned, in the caller's thread, children before parents."""

    def end(self) -> None:
        """Called once, after the last quad."""


def draw_tiles(source: Path, files: Sequence[TileFile], progress: Tell | None = None) -> Pyramid:
    """Draw the tiles of a georeferenced RGBA raster and store them in files.

    Args:
        source: the raster, an orthoimage. files: what is filled. progress: called with blocks done and blocks in all.

    Returns:
        What was drawn.

    Raises:
        InputError: if the raster cannot be read.
        OrthoSwarmError: if the disk is full, or the raster shows nothing.
    """
    from rasterio.errors import RasterioError

    try:
        with ReducedRaster(source) as raster, ThreadPoolExecutor(_ENCODERS) as encoders:
            pyramid = _pyramid(raster.full)
            for file in files:
                file.begin(pyramid)
            waiting: deque[tuple[TileFile, Quad, Future[Any]]] = deque()

            def store(most: int) -> None:
                while len(waiting) > most:
                    file, quad, encoded = waiting.popleft()
                    file.store(quad, encoded.result())

            quad: Quad | None = None
            for quad in _Drawing(raster, pyramid, progress).quads():
                waiting.extend((file, quad, encoders.submit(file.encode, quad)) for file in files)
                store(_AHEAD)
            store(0)
            if quad is None:
                raise OrthoSwarmError(f"{source.name} shows nothing, so that it has no tiles; look at the map's report")
            for file in files:
                file.end()
            return pyramid
    except RasterioError as error:
        raise InputError(f"{source} cannot be read ({error}); make the map again") from None


def degrees_of(x: float, y: float, zoom: int) -> tuple[float, float]:
    """Longitude and latitude of a tile's north-western corner; x and y may be fractions."""
    n = 2**zoom
    return x / n * 360.0 - 180.0, math.degrees(math.atan(math.sinh(math.pi * (1.0 - 2.0 * y / n))))


def _pyramid(raster: Any) -> Pyramid:
    from rasterio.warp import transform_bounds

    west, south, east, north = transform_bounds(raster.crs, "EPSG:4326", *raster.bounds, densify_pts=21)
    east += 360.0 if east < west else 0.0
    latitude = math.radians(0.5 * (south + north))
    zoom = math.ceil(math.log2(WEB_MERCATOR_M * math.cos(latitude) / SIDE / raster.res[0]) - 0.3)
    zoom = min(max(zoom, 0), _DEEPEST)
    left, top = tile_of(west, north, zoom)
    right, bottom = tile_of(east, south, zoom)
    levels = [TileRange(zoom, left, right, top, bottom)]
    coarsest = 1 if east > 180.0 else 0  # at zoom 0 both sides are in the same tile
    while levels[-1].count > 1 and levels[-1].zoom > coarsest:
        levels.append(levels[-1].parent())
    return Pyramid((west, south, east, north), tuple(levels))


def tile_of(lon: float, lat: float, zoom: int) -> tuple[int, int]:
    """Column, and row from the north, of the tile at a place in degrees; beyond 180 columns go on."""
    n = 2**zoom
    x, y = _tiles_from_north_west(lon, lat, zoom)
    most = 2 * n - 1 if lon > 180.0 else n - 1
    return min(max(int(x), 0), most), min(max(int(y), 0), n - 1)


def _tiles_from_north_west(lon: float, lat: float, zoom: int) -> tuple[float, float]:
    n = 2**zoom
    return (lon + 180.0) / 360.0 * n, (1.0 - math.asinh(math.tan(math.radians(lat))) / math.pi) / 2.0 * n


class _Drawing:
    """Draws the tiles of one raster."""

    def __init__(self, raster: ReducedRaster, pyramid: Pyramid, progress: Tell | None) -> None:
        from pyproj import Transformer

        self._levels = {level.zoom: level for level in pyramid.levels}
        self._finest, self._root = pyramid.levels[0], pyramid.levels[-1]
        self._block_zoom = max(self._finest.zoom - _BLOCK_ZOOMS, self._root.zoom)
        self._from_mercator = Transformer.from_crs("EPSG:3857", raster.full.crs, always_xy=True)
        latitude = math.radians(0.5 * (pyramid.bounds[1] + pyramid.bounds[3]))
        pixel_m = WEB_MERCATOR_M * math.cos(latitude) / SIDE / 2**self._finest.zoom
        self._source = raster.at(pixel_m / raster.full.res[0])[0]
        self._progress, self._done, self._blocks = progress, 0, self._levels[self._block_zoom].count

    def quads(self) -> Iterator[Quad]:
        """All quads with something drawn; a coarsest tile is alone in its quad."""
        for x, y in self._root.tiles():
            tile = yield from self._below(self._root.zoom, x, y)
            if tile is not None:
                rgba = np.zeros((2 * SIDE, 2 * SIDE, 4), np.uint8)
                top, left = y % 2 * SIDE, x % 2 * SIDE
                rgba[top : top + SIDE, left : left + SIDE] = tile
                yield Quad(self._root.zoom - 1, x // 2, y // 2, rgba)

    def _below(self, zoom: int, x: int, y: int) -> Generator[Quad, None, Bytes | None]:
        """The quads of a tile and of all below it; returns the tile itself."""
        if zoom == self._block_zoom:
            return (yield from self._of_block(x, y))
        rgba: Bytes | None = None
        for i in (0, 1):
            for j in (0, 1):
                if self._levels[zoom + 1].has(2 * x + j, 2 * y + i):
                    tile = yield from self._below(zoom + 1, 2 * x + j, 2 * y + i)
                    if tile is not None:
                        rgba = np.zeros((2 * SIDE, 2 * SIDE, 4), np.uint8) if rgba is None else rgba
                        rgba[i * SIDE : (i + 1) * SIDE, j * SIDE : (j + 1) * SIDE] = tile
        if rgba is None:
            return None
        yield Quad(zoom, x, y, rgba)
        return reduce_rgba(rgba, 2)

    def _of_block(self, x: int, y: int) -> Generator[Quad, None, Bytes | None]:
        """The quads of a tile of the zoom that is warped, and of all below it; returns the tile itself."""
        rgba = self._warped(x, y)
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._blocks)
        if rgba is None:
            return None
        side = 2 * SIDE
        for zoom in range(self._finest.zoom - 1, self._block_zoom - 1, -1):
            across = 1 << (zoom - self._block_zoom)
            for i in range(across):
                for j in range(across):
                    part = rgba[i * side : (i + 1) * side, j * side : (j + 1) * side]
                    if part[..., 3].any():
                        yield Quad(zoom, x * across + j, y * across + i, np.ascontiguousarray(part))
            rgba = reduce_rgba(rgba, 2)
        return rgba

    def _warped(self, x: int, y: int) -> Bytes | None:
        """The pixels of the finest zoom below a tile of the zoom that is warped; None if nothing is there."""
        tiles = 1 << (self._finest.zoom - self._block_zoom)
        side_m = WEB_MERCATOR_M / 2**self._block_zoom
        share = np.linspace(0.0, 1.0, tiles * SIDE // _STEP + 1)
        east, north = np.meshgrid((x + share) * side_m - WEB_MERCATOR_M / 2, WEB_MERCATOR_M / 2 - (y + share) * side_m)
        nodes = np.stack(self._from_mercator.transform(east, north), -1)
        return _warp(self._source, nodes, _STEP)


# -- drawing ------------------------------------------------------------------------------------------------------

_LEAST_WEIGHT: Final = 1e-5
_FAR: Final = -1e9  # A place outside every raster, for points that the source's system does not have


def _warp(raster: Any, nodes: Array, step: int) -> Bytes | None:
    """Draw a raster on a target whose pixels are known at every `step`-th one, with a triangle filter.

    The filter is as wide as the larger of both pixels: bilinear interpolation where pixels grow, and its scaled form
    where they shrink (Turkowski, "Filters for Common Resampling Tasks", in Graphics Gems, 1990), as GDAL does it.

    Args:
        raster: open dataset with red, green, blue and alpha of 8 bits.
        nodes: coordinates in the raster's system of the target's pixel corners, float64 (rows / step + 1, columns /
            step + 1, 2): a corner for every `step` pixels; between them the map is taken as bilinear.
        step: pixels between nodes.

    Returns:
        The target, uint8 (rows, columns, 4); None if nothing is there. A pixel is drawn where any source pixel below
        its filter is.
    """
    from rasterio.windows import Window

    columns, rows = ~raster.transform * (nodes[..., 0], nodes[..., 1])
    places = np.nan_to_num(np.stack([columns, rows], -1), nan=_FAR, posinf=_FAR, neginf=_FAR)
    across, down = np.abs(np.diff(places, axis=1))[..., 0], np.abs(np.diff(places, axis=0))[..., 1]
    scale = np.maximum(1.0, np.array([np.median(across), np.median(down)]) / step)  # pixels of the source in one
    margin = np.ceil(scale) + 1.0
    first = np.maximum(np.floor(places.min((0, 1)) - margin), 0.0).astype(int)
    last = np.minimum(np.ceil(places.max((0, 1)) + margin), [raster.width, raster.height]).astype(int)
    if (last <= first).any():
        return None
    source = raster.read(window=Window(first[0], first[1], *(last - first)))
    if not source[3].any():
        return None
    out = np.empty(((nodes.shape[0] - 1) * step, (nodes.shape[1] - 1) * step, 4), np.uint8)
    _draw(source, places - first, step, float(scale[0]), float(scale[1]), out)
    return out


@in_place_kernel
def _draw(source, nodes, step, across, down, target):  # type: ignore[no-untyped-def]
    height, width = source.shape[1], source.shape[2]
    for i in range(target.shape[0]):
        k = i // step
        v = (i + 0.5 - k * step) / step
        for j in range(target.shape[1]):
            m = j // step
            u = (j + 0.5 - m * step) / step
            a, b, c, d = (1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u
            x = a * nodes[k, m, 0] + b * nodes[k, m + 1, 0] + c * nodes[k + 1, m, 0] + d * nodes[k + 1, m + 1, 0] - 0.5
            y = a * nodes[k, m, 1] + b * nodes[k, m + 1, 1] + c * nodes[k + 1, m, 1] + d * nodes[k + 1, m + 1, 1] - 0.5
            red, green, blue, opaque, total = 0.0, 0.0, 0.0, 0.0, 0.0
            for row in range(max(0, int(np.ceil(y - down))), min(height, int(np.floor(y + down)) + 1)):
                weight_y = 1.0 - abs(row - y) / down
                for col in range(max(0, int(np.ceil(x - across))), min(width, int(np.floor(x + across)) + 1)):
                    alpha = source[3, row, col]
                    if alpha > 0:
                        weight = weight_y * (1.0 - abs(col - x) / across)
                        total += weight
                        weight *= alpha
                        opaque += weight
                        red += weight * source[0, row, col]
                        green += weight * source[1, row, col]
                        blue += weight * source[2, row, col]
            if total > _LEAST_WEIGHT:
                target[i, j, 0] = np.uint8(red / opaque + 0.5)
                target[i, j, 1] = np.uint8(green / opaque + 0.5)
                target[i, j, 2] = np.uint8(blue / opaque + 0.5)
                target[i, j, 3] = np.uint8(opaque / total + 0.5)
            else:
                target[i, j, 0] = target[i, j, 1] = target[i, j, 2] = target[i, j, 3] = 0
