"""The mosaic on MAVProxy's map: one picture of the best layer, drawn under everything else.

MAVProxy's map has no object for a georeferenced picture, but draws any SlipObject by the object's own `draw`. Map and
tiles are both in Web Mercator, so three corners say where the picture goes. The object travels to the map's process
pickled, and is replaced when the layer has changed.
"""

import math
import urllib.error
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import numpy as np
from MAVProxy.modules.mavproxy_map.mp_slipmap_util import SlipObject
from numpy.typing import NDArray

from gcs_plugin.mavproxy.daemon_client import Client

KEY: Final = "orthoswarm mosaic"
LAYER: Final = "0 OrthoSwarm"
"""Sorts before MAVProxy's own layers, so that icons and missions stay visible."""
_TILE: Final = 256  # pixels a side
_MOST_TILES: Final = 48  # on the screen
_DEEPEST: Final = 21  # zoom

Pixels = NDArray[np.uint8]


class Mosaic(SlipObject):  # type: ignore[misc]
    """A picture on the map, of a version of the layer.

    Args:
        rgba: uint8 (rows, columns, 4), rows along Web Mercator's north-south.
        north, west, south, east: of its outer edges, degrees.
    """

    def __init__(self, rgba: Pixels, *, north: float, west: float, south: float, east: float, version: int) -> None:
        super().__init__(KEY, LAYER)
        self.rgba, self.version = rgba, version
        self.north, self.west, self.south, self.east = north, west, south, east

    def bounds(self) -> tuple[float, float, float, float] | None:
        """Latitude and longitude of the lower left corner, height and width, degrees."""
        return None if self.hidden else (self.south, self.west, self.north - self.south, self.east - self.west)

    def draw(self, img: Pixels, pixmapper: Any, bounds: Any) -> None:
        """Draw on the map's picture, uint8 RGB (rows, columns, 3), in place."""
        import cv2

        del bounds
        if self.hidden:
            return
        rows, cols = self.rgba.shape[:2]
        corners = [pixmapper(p) for p in ((self.north, self.west), (self.north, self.east), (self.south, self.west))]
        there = np.array(corners, np.float32) - 0.5  # edges of pixels, while cv2 counts their centres
        here = np.array([[0, 0], [cols, 0], [0, rows]], np.float32) - 0.5
        left, top = np.maximum(np.floor(there.min(0)).astype(int), 0)
        right, bottom = np.minimum(np.ceil(there.max(0)).astype(int) + 1, (img.shape[1], img.shape[0]))
        if right <= left or bottom <= top:
            return
        rgba, scale = self.rgba, float(np.hypot(*(there[1] - there[0]))) / cols
        if scale < 0.5:  # averaged, or it would shimmer
            small = (max(1, round(cols * scale)), max(1, round(rows * scale)))
            rgba = np.asarray(cv2.resize(rgba, small, interpolation=cv2.INTER_AREA), np.uint8)
            here = (here + 0.5) * np.array([small[0] / cols, small[1] / rows], np.float32) - 0.5
        turn = cv2.getAffineTransform(here.astype(np.float32), (there - (left, top)).astype(np.float32))
        drawn = cv2.warpAffine(rgba, turn, (int(right - left), int(bottom - top)), flags=cv2.INTER_LINEAR)
        part = img[top:bottom, left:right]
        share = drawn[..., 3:].astype(np.float32) / 255.0
        part[:] = np.rint(part * (1.0 - share) + drawn[..., :3] * share).astype(np.uint8)


def fetch_mosaic(client: Client) -> Mosaic | None:
    """A picture of the daemon's best layer; None while there is nothing on it.

    Raises:
        RuntimeError: the daemon does not answer.
    """
    row = next((r for r in client.ask("/api/layers") if r["name"] == "best"), None)
    if row is None or row["empty"] or row["bounds"] is None:
        return None
    west, south, east, north = row["bounds"]
    zoom, (x0, y0, x1, y1) = next(
        (z, box) for z in range(_DEEPEST, -1, -1) if _count(box := _tiles(z, west, south, east, north)) <= _MOST_TILES
    )
    rgba = np.zeros(((y1 - y0 + 1) * _TILE, (x1 - x0 + 1) * _TILE, 4), np.uint8)
    places = [(x, y) for y in range(y0, y1 + 1) for x in range(x0, x1 + 1)]
    with ThreadPoolExecutor(4) as pool:
        tiles = list(pool.map(lambda p: _tile(client, zoom, *p), places))
    for (x, y), tile in zip(places, tiles, strict=True):
        if tile is not None:
            top, left = (y - y0) * _TILE, (x - x0) * _TILE
            rgba[top : top + _TILE, left : left + _TILE] = tile
    n = 1 << zoom
    return Mosaic(
        rgba,
        north=_lat(y0, n),
        west=_lon(x0, n),
        south=_lat(y1 + 1, n),
        east=_lon(x1 + 1, n),
        version=int(row["version"]),
    )


def _tiles(zoom: int, west: float, south: float, east: float, north: float) -> tuple[int, int, int, int]:
    """Columns and rows of the tiles that cover a box: first column, first row, last column, last row."""
    n = 1 << zoom

    def column(lon: float) -> int:
        return min(n - 1, max(0, int((lon + 180.0) / 360.0 * n)))

    def row(lat: float) -> int:
        return min(n - 1, max(0, int((1.0 - math.asinh(math.tan(math.radians(lat))) / math.pi) / 2.0 * n)))

    return column(west), row(north), column(east), row(south)


def _count(box: tuple[int, int, int, int]) -> int:
    return (box[2] - box[0] + 1) * (box[3] - box[1] + 1)


def _lon(x: int, n: int) -> float:
    return x / n * 360.0 - 180.0


def _lat(y: int, n: int) -> float:
    return math.degrees(math.atan(math.sinh(math.pi * (1.0 - 2.0 * y / n))))


def _tile(client: Client, zoom: int, x: int, y: int) -> Pixels | None:
    import cv2

    try:
        data = client.fetch(f"/tiles/best/{zoom}/{x}/{y}.png")
    except (RuntimeError, urllib.error.URLError):
        return None
    if not data:
        return None
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.shape != (_TILE, _TILE, 4):
        return None
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGRA2RGBA), np.uint8)
