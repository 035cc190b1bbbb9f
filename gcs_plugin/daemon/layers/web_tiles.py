"""Web map tiles (XYZ, web mercator, 256 pixels) of the layers, straight from their canvases.

A tile's pixels are brought to the area's grid by a bilinear patch of exact points (a tile of a city is so small that
it bends by less than a hundredth of a pixel), read from the canvas at the nearest finer power of two, and
interpolated with premultiplied alpha, so that edges do not darken.
"""

import hashlib
import math
import threading
from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from gcs_plugin.daemon.layers.layers import MapLayer
from gcs_plugin.daemon.store.daemon_events import AreaChanged
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.earth import WEB_MERCATOR_M
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.geo import GroundGrid, area_epsg
from orthoswarm.raster.basemap import Basemap

Bytes = NDArray[np.uint8]
Array = NDArray[np.float64]

SIDE: Final = 256
DEEPEST: Final = 24  # zoom: 1 cm at the equator
_HALF_WORLD_M: Final = 0.5 * WEB_MERCATOR_M
_NODES: Final = 9  # a side between which coordinates are interpolated
_CACHE_BYTES: Final = 64 << 20
_BOXES: Final = 20_000  # tiles whose ground is remembered (4 MB): those of some pages at several zooms
_local = threading.local()


@dataclass(frozen=True, slots=True)
class TileAddress:
    """A tile of the web mercator pyramid: zoom, column from the date line, row from the north."""

    z: int
    x: int
    y: int

    @property
    def valid(self) -> bool:
        """True if there is such a tile."""
        return 0 <= self.z <= DEEPEST and 0 <= self.x < 1 << self.z and 0 <= self.y < 1 << self.z

    @property
    def pixel_m(self) -> float:
        """Size of its pixels in web mercator metres (larger than on the ground except at the equator)."""
        return 2 * _HALF_WORLD_M / (SIDE << self.z)


def ground_patch(tile: TileAddress, epsg: int) -> tuple[Array, float]:
    """Grid coordinates of a tile's pixel centres, float64 (256, 256, 2), and its ground pixel in metres.

    Far from the area's zone coordinates are infinite; those pixels are empty.
    """
    nodes = np.linspace(-0.5, SIDE - 0.5, _NODES) + 0.5
    left, top = tile.x * SIDE * tile.pixel_m - _HALF_WORLD_M, _HALF_WORLD_M - tile.y * SIDE * tile.pixel_m
    east, north = np.meshgrid(left + nodes * tile.pixel_m, top - nodes * tile.pixel_m)
    corners = np.stack(_from_mercator(epsg).transform(east, north), -1)
    place = (np.arange(SIDE) + 0.5) / SIDE * (_NODES - 1)
    index = np.minimum(place.astype(np.intp), _NODES - 2)
    share = place - index
    with np.errstate(invalid="ignore"):
        rows = corners[index] * (1 - share)[:, None, None] + corners[index + 1] * share[:, None, None]
        patch = rows[:, index] * (1 - share)[None, :, None] + rows[:, index + 1] * share[None, :, None]
    middle = SIDE // 2
    step = patch[middle, middle] - patch[middle, middle - 1]
    gsd = float(np.hypot(*step))
    return np.asarray(patch), gsd if math.isfinite(gsd) and gsd > 0 else math.inf


def _from_mercator(epsg: int) -> Transformer:
    known: dict[int, Transformer] | None = getattr(_local, "transformers", None)
    if known is None:
        known = _local.transformers = {}
    if epsg not in known:
        known[epsg] = Transformer.from_crs(3857, epsg, always_xy=True)
    return known[epsg]


def _box(patch: Array) -> BoundingBox | None:
    if not np.isfinite(patch).all():
        return None
    return BoundingBox.around_points(patch)


@lru_cache(_BOXES)
def _box_of(tile: TileAddress, epsg: int) -> BoundingBox | None:
    """The ground of a tile, which takes 7 ms to compute: each page asks for its ETag with each change of the map."""
    return _box(ground_patch(tile, epsg)[0])


def canvas_tile(canvas: Canvas, tile: TileAddress) -> Bytes | None:
    """Colours of a canvas in a tile, uint8 (256, 256, 4); None where nothing is drawn."""
    patch, gsd = ground_patch(tile, canvas.grid.epsg)
    box = _box(patch)
    if box is None or not math.isfinite(gsd) or canvas.newest(box) == 0:
        return None
    margin = 2.0 * max(gsd, canvas.grid.gsd_m)
    source, grid = canvas.read_ground(box.grown(margin), gsd)
    return resampled(source, grid, patch)


def basemap_tile(basemap: Basemap, tile: TileAddress) -> Bytes | None:
    """Colours of the basemap in a tile; None where it has none."""
    patch, gsd = ground_patch(tile, basemap.epsg)
    box = _box(patch)
    if box is None or box.gap_m(basemap.bounds) > 0.0:
        return None
    pixel = max(gsd, basemap.native_gsd_m * 0.999)
    margin = 2.0 * pixel  # neighbouring tiles meet without a seam
    box = box.grown(margin).intersection(basemap.bounds)
    rgb, valid = basemap.rgb(box, pixel)
    grid = GroundGrid.around(basemap.epsg, box, pixel)
    return resampled(np.dstack([rgb, valid.astype(np.uint8) * np.uint8(255)]), grid, patch)


def resampled(source: Bytes, grid: GroundGrid, patch: Array) -> Bytes | None:
    """A picture (rows, columns, 4) on a grid, interpolated at ground points (256, 256, 2); None if all transparent."""
    import cv2

    if source.size == 0 or not source[..., 3].any():
        return None
    place = grid.to_pixel(patch).astype(np.float32)
    alpha = source[..., 3:].astype(np.float32) / 255.0
    weighted = np.concatenate([source[..., :3] * alpha, source[..., 3:].astype(np.float32)], -1)
    out = cv2.remap(weighted, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderValue=(0, 0, 0, 0))
    if not (out[..., 3] > 0.5).any():
        return None
    colour = out[..., :3] * (255.0 / np.maximum(out[..., 3:], 0.5))
    return _bytes(np.concatenate([colour, out[..., 3:]], -1))


def over(upper: Bytes | None, lower: Bytes | None) -> Bytes | None:
    """One picture over another, uint8 (rows, columns, 4)."""
    if upper is None or lower is None:
        return lower if upper is None else upper
    a, b = upper[..., 3:].astype(np.float32) / 255.0, lower[..., 3:].astype(np.float32) / 255.0
    alpha = a + b * (1 - a)
    colour = (upper[..., :3] * a + lower[..., :3] * b * (1 - a)) / np.maximum(alpha, 1e-3)
    return _bytes(np.concatenate([colour, alpha * 255.0], -1))


def _bytes(values: NDArray[np.float32]) -> Bytes:
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def encode(tile: Bytes | None, suffix: str) -> bytes:
    """A tile as WebP or PNG; None gives a transparent one."""
    import cv2

    picture = np.zeros((SIDE, SIDE, 4), np.uint8) if tile is None else tile
    options = [cv2.IMWRITE_WEBP_QUALITY, 85] if suffix == "webp" else [cv2.IMWRITE_PNG_COMPRESSION, 1]
    done, data = cv2.imencode("." + suffix, cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA), options)
    if not done:
        raise OrthoSwarmError(f"a tile could not be written as {suffix}; ask for png")
    return bytes(data)


class TileServer:
    """Encoded tiles with their ETags; recent ones are cached.

    Attributes:
        basemap: on the grid of the map's area, or of its own centre while there is none.

    Raises:
        InputError: the basemap cannot be used.
    """

    def __init__(self, layers: dict[str, MapLayer], basemap: Path | None = None) -> None:
        self.layers, self._file = layers, basemap
        self.basemap = None if basemap is None else open_basemap(basemap)
        self._lock = threading.Lock()
        self._cache: OrderedDict[tuple[str, str], bytes] = OrderedDict()
        self._bytes = 0

    def area_changed(self, event: AreaChanged) -> None:
        """Read the basemap on the area's grid."""
        if self._file is not None and (self.basemap is None or self.basemap.epsg != event.epsg):
            self.basemap = Basemap.open(self._file, event.epsg)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the layers."""
        return (*self.layers, "best", "basemap")

    def etag(self, name: str, tile: TileAddress) -> str:
        """A text that changes whenever the tile's content does."""
        if name == "basemap":
            stamp = "none" if self.basemap is None else f"{self.basemap.path}"
        else:
            stamp = " ".join(self._stamp(self.layers[part], tile) for part in self._parts(name))
        return hashlib.sha256(f"{name} {tile} {stamp}".encode()).hexdigest()[:24]

    def tile(self, name: str, tile: TileAddress, suffix: str) -> tuple[bytes, str]:
        """Encoded bytes and their ETag.

        The ETag is determined first: changes while the tile is read get another one at the next request.
        """
        etag = self.etag(name, tile)
        key = (etag, suffix)
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key], etag
        data = encode(self._picture(name, tile), suffix)
        with self._lock:
            if key not in self._cache:
                self._bytes += len(data)
            self._cache[key] = data
            while self._bytes > _CACHE_BYTES:
                self._bytes -= len(self._cache.popitem(last=False)[1])
        return data, etag

    def _picture(self, name: str, tile: TileAddress) -> Bytes | None:
        if name == "basemap":
            return None if self.basemap is None else basemap_tile(self.basemap, tile)
        picture: Bytes | None = None
        for part in self._parts(name):
            with self.layers[part].reading() as canvas:
                if canvas is not None:
                    picture = over(picture, canvas_tile(canvas, tile))
        return picture

    def _parts(self, name: str) -> tuple[str, ...]:
        """The layers that show in one, uppermost first."""
        return ("fine", "coarse", "realtime") if name == "best" else (name,)

    def _stamp(self, layer: MapLayer, tile: TileAddress) -> str:
        with layer.reading() as canvas:
            if canvas is None:
                return "-"
            box = _box_of(tile, canvas.grid.epsg)
            newest = canvas.newest(box) if box is not None else 0
            # an unchanged tile keeps its version through generations on one grid; another grid begins to count anew
            return f"{canvas.grid}/{newest}" if newest else "empty"


def open_basemap(path: Path) -> Basemap | None:
    """The basemap on the UTM grid of its own centre, for display before there is an area; None if that is unknown.

    Raises:
        InputError: it cannot be read, or lies nowhere.
    """
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.warp import transform_bounds

    if path.is_dir():
        return None
    try:
        with rasterio.open(path) as raster:
            if raster.crs is None:
                raise InputError(f"the basemap {path.name} has no coordinate system; give a georeferenced map")
            west, south, east, north = transform_bounds(raster.crs, 4326, *raster.bounds)
    except RasterioError as error:
        raise InputError(f"the basemap {path.name} cannot be read ({error}); check the file") from None
    basemap = Basemap.open(path, area_epsg([south, north], [west, east]))
    basemap.require_readable(basemap.bounds)  # check it now, not when the first vehicle completes
    return basemap
