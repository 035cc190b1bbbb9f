"""Map tiles in web Mercator, of a folder or an MBTiles file, read in windows on the area's grid."""

import re
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from pyproj import Transformer

from orthoswarm.model.arrays import Array, Bytes, Flags
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.earth import WEB_MERCATOR_M
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import GroundGrid
from orthoswarm.raster.empty_pixels import blank
from orthoswarm.raster.map_check import UnreadableMapError
from orthoswarm.stores.local_copies import local_file

_MARGIN_M: Final = 5000.0  # tiles this far from the flight belong to the map that is spoken of
_COARSEST_M: Final = 40.0  # pixels of a zoom level that a flight can be laid on at all
_COVERS_SHARE: Final = 0.5  # of what any level shows of the flight: a level with less is a rest of a download
_LEVELS: Final = 3  # a hole is filled from so many levels on either side; eight times coarser is no map of its place
_MOST_COMPARED: Final = 10_000  # tiles that are looked at for placeholders (time)
Tiles = dict[tuple[int, int], Any]
"""Column and row of a zoom level -> what `read` of the set needs to find the tile."""
Ranges = Callable[[int], tuple[int, int, int, int]]
"""Zoom -> first and last column, first and last row (from the north), inclusive."""

_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp")
_VECTOR_TILE: Final = (b"\x1f\x8b", b"\x1a")  # gzip, in which they are delivered, or their first layer
_PART_BYTES: Final = 256  # of a tile's middle, by which tiles of one size are compared
Place = tuple[int, int, int]
"""Zoom, column, and row from the north."""
_ORDERS: Final[tuple[Callable[[Place], Place], ...]] = (
    lambda place: place,
    lambda place: (place[0], place[1], 2 ** place[0] - 1 - place[2]),  # TMS: rows from the south
    lambda place: (place[0], place[2], place[1]),  # ArcGIS: rows before columns
)
_PLAIN_TILE: Final = 0.5  # share of one colour in a placeholder with a text that no other has ...
_PLAIN_GROUND: Final = 0.25  # ... over ground that the level above shows with less of one colour


class TileMap:
    """Tiles of one or several zoom levels; in the order of XYZ, TMS or ArcGIS, whichever fits the area.

    The finest level that covers the flight is the map; what it lacks comes from the levels beside it. Placeholders of
    a server, tiles of one colour and half downloads are lacking.

    native_gsd_m: ground size of a pixel of that level, metres. bounds: west, south, east, north of the tiles near the
    area, in its grid. attribution: whose they are, "" where nothing says it.
    """

    def __init__(self, path: Path, epsg: int, near: BoundingBox | None) -> None:
        self._path = path
        self._epsg = epsg
        self._source = _Folder(path) if path.is_dir() else _Mbtiles(path)
        around = None if near is None else near.grown(max(_MARGIN_M, near.width, near.height))
        levels = self._source.tiles(None if around is None else lambda zoom: self._tile_range(around, zoom))
        self._tiles: dict[Place, Any] = {(z, c, r): key for z, tiles in levels.items() for (c, r), key in tiles.items()}
        if not self._tiles:
            raise InputError(f"{path} holds no map tiles z/x/y.png (or jpg, webp); give a map")
        zooms = sorted(levels)
        order = _ORDERS[0] if near is None else self._order(near, zooms)
        self._tiles = {order(place): key for place, key in self._tiles.items()}
        compared = next((p for p in (self._within(around), self._within(near)) if len(p) <= _MOST_COMPARED), [])
        lacking = _placeholders(self._source, [self._tiles[place] for place in compared])
        self._tiles = {place: key for place, key in self._tiles.items() if key not in lacking}
        flown = self._within(near)
        self._size = self._tile_size(flown)
        self._zoom = zooms[-1] if near is None else self._covering(near, zooms, flown)
        self._zooms = [z for z in zooms if self._zoom - _LEVELS <= z <= self._zoom]
        self.bounds = self._ground_bounds(around)
        x, y = (near or self.bounds).center
        self.native_gsd_m = self._pixel_m(x, y, self._zoom)
        self.attribution = "" if isinstance(self._source, _Folder) else self._source.attribution()

    def _tile_size(self, places: Sequence[Place]) -> int:
        """Pixels of a tile's side, of the finest that can be decoded."""
        for place in sorted(places, reverse=True):
            tile = _decode(self._source.read(self._tiles[place]))
            if tile is not None:
                return len(tile)
        if any(self._source.read(self._tiles[place]).startswith(_VECTOR_TILE) for place in places):
            raise InputError(f"{self._path} holds vector tiles (pbf); give a map of raster tiles (png, jpg or webp)")
        if places:
            raise InputError(f"the map tiles of {self._path} cannot be decoded; download the tiles again")
        return 256

    def _covering(self, near: BoundingBox, zooms: Sequence[int], flown: Sequence[Place]) -> int:
        """The finest level that covers the flight as far as any does; the finest of all if none does."""
        share = {}
        for zoom in zooms:
            left, right, top, bottom = self._tile_range(near, zoom)
            here = sum(z == zoom for z, _, _ in flown)
            if here and self._pixel_m(*near.center, zoom) <= _COARSEST_M:
                share[zoom] = here / ((right - left + 1) * (bottom - top + 1))
        most = max(share.values(), default=0.0)
        return max((z for z, s in share.items() if s >= _COVERS_SHARE * most), default=zooms[-1])

    def _pixel_m(self, x: float, y: float, zoom: int) -> float:
        per_metre = np.diff(self._mercator(np.array([[x, y], [x + 100.0, y]])), axis=0)
        return float(WEB_MERCATOR_M / 2**zoom / self._size / np.hypot(*per_metre[0]) * 100.0)

    def _within(self, bounds: BoundingBox | None) -> list[Place]:
        """The tiles of all levels that bounds need; all tiles if None."""
        if bounds is None:
            return list(self._tiles)
        ranges = {zoom: self._tile_range(bounds, zoom) for zoom in {place[0] for place in self._tiles}}
        return [
            (z, c, r)
            for z, c, r in self._tiles
            if ranges[z][0] <= c <= ranges[z][1] and ranges[z][2] <= r <= ranges[z][3]
        ]

    def _mercator(self, east_north: Array) -> Array:
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

    def _order(self, near: BoundingBox, zooms: Sequence[int]) -> Callable[[Place], Place]:
        """The first order of numbers by which the area has tiles; as they are if it has none by any."""
        ranges = {zoom: self._tile_range(near, zoom) for zoom in zooms}

        def inside(place: Place) -> bool:
            left, right, top, bottom = ranges[place[0]]
            return left <= place[1] <= right and top <= place[2] <= bottom

        return next((order for order in _ORDERS if any(inside(order(place)) for place in self._tiles)), _ORDERS[0])

    def _ground_bounds(self, around: BoundingBox | None) -> BoundingBox:
        """Bounds of the used tiles in the grid, those within some kilometres of the area."""
        used = [place for place in self._within(around) if place[0] in self._zooms]
        used = used or [place for place in self._tiles if place[0] in self._zooms]
        if not used:
            raise InputError(f"the tiles of {self._path} are placeholders without a map; download them again")
        z, c, r = np.array(used, float).T
        side = WEB_MERCATOR_M / 2.0**z
        x = np.array([(c * side).min(), ((c + 1.0) * side).max()]) - WEB_MERCATOR_M / 2
        y = WEB_MERCATOR_M / 2 - np.array([((r + 1.0) * side).max(), (r * side).min()])
        corners = np.array([[a, b] for a in (*x, x.mean()) for b in (*y, y.mean())])
        east, north = _transformer(self._epsg).transform(corners[:, 0], corners[:, 1], direction="INVERSE")
        return BoundingBox.around_points(np.column_stack([east, north]))

    def gsds(self) -> list[float]:
        """A pixel size for each zoom level, metres."""
        return [self.native_gsd_m * 2 ** (self._zoom - zoom) for zoom in self._zooms]

    def require_complete(self, bounds: BoundingBox) -> None:
        """Does nothing: each tile is a separate file, and one that cannot be decoded is a hole in the map."""

    def read(self, grid: GroundGrid, gray: bool) -> tuple[Bytes, Flags]:
        """Colours uint8 (3, rows, columns), also where grey is enough, and validity of a window."""
        from rasterio.enums import Resampling
        from rasterio.transform import from_origin
        from rasterio.warp import reproject

        fine = max(0.0, float(np.log2(max(grid.gsd_m / self.native_gsd_m, 1e-9))))
        zoom = min((z for z in self._zooms if z >= self._zoom - fine + 1), default=self._zoom)
        shrink = max(1, 2 ** int(fine - (self._zoom - zoom) - 1))
        shrink = min(shrink, self._size)
        colours, origin, pixel = self._assemble(grid.bounds, zoom, shrink)
        out = np.zeros((4, grid.height, grid.width), np.uint8)
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
        return out[:3], (out[3] > 127) & ~blank(out[:3])

    def _assemble(self, bounds: BoundingBox, zoom: int, shrink: int) -> tuple[Bytes, tuple[float, float], float]:
        """The tiles under bounds as one RGBA picture (4, rows, columns), its upper left corner and pixel size."""
        left, right, top, bottom = self._tile_range(bounds, zoom)
        n = self._size // shrink
        side = WEB_MERCATOR_M / 2**zoom
        origin = (left * side - WEB_MERCATOR_M / 2, WEB_MERCATOR_M / 2 - top * side)
        canvas = np.zeros(((bottom - top + 1) * n, (right - left + 1) * n, 4), np.uint8)
        decoded: dict[Place, Bytes | None] = {}
        for c in range(left, right + 1):
            for r in range(top, bottom + 1):
                tile = self._tile((zoom, c, r), n, decoded)
                if tile is not None:
                    canvas[(r - top) * n : (r - top + 1) * n, (c - left) * n : (c - left + 1) * n] = tile
        return np.ascontiguousarray(canvas.transpose(2, 0, 1)), origin, side / n

    def _tile(self, place: Place, n: int, decoded: dict[Place, Bytes | None]) -> Bytes | None:
        """A tile of n pixels a side: its own, else of coarser levels, else of finer ones."""
        own = self._stored(place, decoded)
        if own is None:
            own = self._part_of_coarser(place, decoded)
        return self._of_finer(place, n, decoded, _LEVELS) if own is None else _resized(own, n)

    def _stored(self, place: Place, decoded: dict[Place, Bytes | None]) -> Bytes | None:
        key = self._tiles.get(place)
        if key is None:
            return None
        if place not in decoded:
            tile = _decode(self._source.read(key))
            if tile is not None and _plain_share(tile) > _PLAIN_TILE:
                above = self._part_of_coarser(place, decoded)
                tile = tile if above is None or _plain_share(above) > _PLAIN_GROUND else None
            decoded[place] = tile
        return decoded[place]

    def _part_of_coarser(self, place: Place, decoded: dict[Place, Bytes | None]) -> Bytes | None:
        zoom, c, r = place
        for up in range(1, _LEVELS + 1):
            tile = self._stored((zoom - up, c >> up, r >> up), decoded)
            if tile is not None:
                side = len(tile) >> up
                left, top = (c % 2**up) * side, (r % 2**up) * side
                return tile[top : top + side, left : left + side]
        return None

    def _of_finer(self, place: Place, n: int, decoded: dict[Place, Bytes | None], depth: int) -> Bytes | None:
        zoom, c, r = place
        half = n // 2
        if depth == 0 or half < 1:
            return None
        out = np.zeros((n, n, 4), np.uint8)
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            below = (zoom + 1, 2 * c + i, 2 * r + j)
            tile = self._stored(below, decoded)
            tile = self._of_finer(below, half, decoded, depth - 1) if tile is None else _resized(tile, half)
            if tile is not None:
                out[j * half : (j + 1) * half, i * half : (i + 1) * half] = tile
        return out if out.any() else None


@lru_cache(maxsize=8)
def _transformer(epsg: int) -> Transformer:
    return Transformer.from_crs(epsg, 3857, always_xy=True)


def _resized(tile: Bytes, n: int) -> Bytes:
    import cv2

    if len(tile) == n:
        return tile
    how = cv2.INTER_AREA if len(tile) > n else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(tile, (n, n), interpolation=how))


def _decode(data: bytes) -> Bytes | None:
    """A tile as RGBA uint8 (size, size, 4); None if it is damaged, cut short, or of one colour."""
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data and _is_whole(data) else None
    if image is None or (image == image[0, 0]).all():
        return None
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.ndim == 2:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGBA))
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGBA if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA))


def _plain_share(tile: Bytes) -> float:
    """Share of a tile's most common colour, in steps of what JPEG leaves alike."""
    coarse = tile[..., :3].astype(np.int32) >> 3
    colours = coarse[..., 0] << 10 | coarse[..., 1] << 5 | coarse[..., 2]
    return float(np.bincount(colours.ravel()).max() / colours.size)


def _placeholders(source: "_Folder | _Mbtiles", keys: Iterable[Any]) -> set[Any]:
    """Tiles that stand for what a server did not have: two photographs are never alike, these are."""
    signatures = {key: source.signature(key) for key in keys}
    count = Counter(signatures.values())
    return {key for key, signature in signatures.items() if count[signature] > 1 or not signature[0]}


def _is_whole(data: bytes) -> bool:
    """Whether a tile was downloaded to its end; a half one is decoded into a picture with a plain rest."""
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in data[-1024:]
    if data.startswith(b"\x89PNG"):
        return b"IEND" in data[-64:]
    if data.startswith(b"RIFF"):
        return len(data) >= 8 + int.from_bytes(data[4:8], "little")
    return True


class _Folder:
    """Tiles in a folder z/x/y; rows as it counts them."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def tiles(self, near: Ranges | None) -> dict[int, Tiles]:
        zooms = sorted(int(p.name) for p in self._path.iterdir() if p.is_dir() and p.name.isdigit())
        found = {zoom: dict(self._level(zoom)) for zoom in zooms}
        return {zoom: tiles for zoom, tiles in found.items() if tiles}

    def _level(self, zoom: int) -> Iterator[tuple[tuple[int, int], Path]]:
        for column in (self._path / str(zoom)).iterdir():
            if column.name.isdigit() and column.is_dir():
                for file in column.iterdir():
                    if file.stem.isdigit() and file.suffix.lower() in _SUFFIXES:
                        yield (int(column.name), int(file.stem)), file

    def read(self, key: Path) -> bytes:
        return key.read_bytes()

    def signature(self, key: Path) -> tuple[int, bytes]:
        """Length and a part of a tile, by which two that are alike are found."""
        size = key.stat().st_size
        with key.open("rb") as file:
            file.seek(size // 2)
            return size, file.read(_PART_BYTES)


class _Mbtiles:
    """Tiles of a file, of a large one those of ranges; rows from the north, though the file counts from the south."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @contextmanager
    def _query(self, text: str, *values: int) -> Iterator[sqlite3.Cursor]:
        uri = local_file(self._path).absolute().as_uri() + "?mode=ro"
        try:
            with closing(sqlite3.connect(uri, uri=True)) as file:
                yield file.execute(text, values)
        except (sqlite3.Error, OSError):
            raise UnreadableMapError(
                f"the basemap {self._path.name} cannot be read as a map; give a GeoTIFF, COG, MBTiles or XYZ folder"
            ) from None

    def attribution(self) -> str:
        """What the file says of its licence, without markup."""
        try:
            with self._query("SELECT value FROM metadata WHERE name = 'attribution'") as rows:
                return re.sub(r"<[^>]*>", "", str((rows.fetchone() or ("",))[0]))
        except UnreadableMapError:  # a file without metadata is a map, too
            return ""

    def tiles(self, near: Ranges | None) -> dict[int, Tiles]:
        with self._query("SELECT zoom_level, min(tile_column), max(tile_column), min(tile_row), max(tile_row)"
                         " FROM tiles GROUP BY zoom_level") as rows:  # fmt: skip
            extents = {zoom: extent for zoom, *extent in rows}
        found = {zoom: self._level(zoom, near) for zoom in extents}
        if any(found.values()):
            return {zoom: tiles for zoom, tiles in found.items() if tiles}
        # Nothing is near: the corners tell how far away the map is.
        return {zoom: {(c, 2**zoom - 1 - r): (zoom, c, r) for c, r in ((c0, r0), (c1, r1))}
                for zoom, (c0, c1, r0, r1) in extents.items()}  # fmt: skip

    def _level(self, zoom: int, near: Ranges | None) -> Tiles:
        last = 2**zoom - 1
        left, right, top, bottom = (0, last, 0, last) if near is None else near(zoom)
        text = (
            "SELECT tile_column, tile_row FROM tiles WHERE zoom_level = ? AND tile_column BETWEEN ? AND ?"
            " AND (tile_row BETWEEN ? AND ? OR tile_row BETWEEN ? AND ?)"
        )
        with self._query(text, zoom, left, right, last - bottom, last - top, top, bottom) as rows:
            return {(c, last - r): (zoom, c, r) for c, r in rows}

    def read(self, key: tuple[int, int, int]) -> bytes:
        return self._value("tile_data", key)[0] or b""

    def signature(self, key: tuple[int, int, int]) -> tuple[int, bytes]:
        size, part = self._value(f"length(tile_data), substr(tile_data, length(tile_data) / 2, {_PART_BYTES})", key)
        return int(size or 0), part or b""

    def _value(self, what: str, key: tuple[int, int, int]) -> Any:
        text = f"SELECT {what} FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?"
        with self._query(text, *key) as rows:
            return rows.fetchone() or (None, None)
