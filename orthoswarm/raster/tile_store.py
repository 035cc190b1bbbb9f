"""Where map tiles lie: in a folder z/x/y.png|jpg|webp, or in an MBTiles file; and which of them show no map."""

import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final, Protocol

from orthoswarm.model.errors import InputError
from orthoswarm.raster.map_check import UnreadableMapError
from orthoswarm.stores.local_copies import local_file

Tiles = dict[tuple[int, int], Any]
"""Column and row of a zoom level -> what `TileStore.read` needs to find the tile."""
Ranges = Callable[[int], tuple[int, int, int, int]]
"""Zoom -> first and last column, first and last row (from the north), inclusive."""

_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp")
_PART_BYTES: Final = 256  # of a tile's middle, by which tiles of one size are compared


class TileStore(Protocol):
    """A set of tiles."""

    def tiles(self, near: Ranges | None) -> dict[int, Tiles]:
        """Zoom -> its tiles, rows as the set counts them; where the set is large, only those of ranges."""

    def read(self, key: Any) -> bytes:
        """The content of a tile."""

    def signature(self, key: Any) -> tuple[int, bytes]:
        """Length and a part of a tile, by which two that are alike are found."""


def open_tiles(path: Path) -> TileStore:
    """The tiles of a folder or an MBTiles file."""
    return _Folder(path) if path.is_dir() else _Mbtiles(path)


def placeholders(store: TileStore, keys: Iterable[Any]) -> set[Any]:
    """Tiles that stand for what a server did not have: two photographs are never alike, these are."""
    signatures = {key: store.signature(key) for key in keys}
    count = Counter(signatures.values())
    return {key for key, signature in signatures.items() if count[signature] > 1 or not signature[0]}


def is_whole(data: bytes) -> bool:
    """Whether a tile was downloaded to its end; a half one is decoded into a picture with a plain rest."""
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in data[-1024:]
    if data.startswith(b"\x89PNG"):
        return b"IEND" in data[-64:]
    if data.startswith(b"RIFF"):
        return len(data) >= 8 + int.from_bytes(data[4:8], "little")
    return True


class _Folder:
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
        size = key.stat().st_size
        with key.open("rb") as file:
            file.seek(size // 2)
            return size, file.read(_PART_BYTES)


class _Mbtiles:
    """Rows are counted from the north, although the file counts them from the south."""

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


def no_tiles(path: Path) -> InputError:
    """That a set holds no tiles."""
    return InputError(f"{path} holds no map tiles z/x/y.png (or jpg, webp); give a map")
