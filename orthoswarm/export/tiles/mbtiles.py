"""The orthoimage as web map tiles in one file: MBTiles (SQLite) for tablets, PMTiles 3 for any file server."""

import contextlib
import errno
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.tiles.tile_pyramid import Pyramid, Quad, draw_tiles
from orthoswarm.model.arrays import Bytes
from orthoswarm.model.errors import InputError

Format = Literal["png", "webp", "jpg"]
Tile = tuple[int, int, bytes]
TABLES: Final = (
    "PRAGMA application_id=1297105496;"
    "CREATE TABLE IF NOT EXISTS metadata (name text, value text);"
    "CREATE TABLE IF NOT EXISTS tiles (zoom_level integer, tile_column integer, tile_row integer, tile_data blob);"
    "CREATE UNIQUE INDEX IF NOT EXISTS tile_index ON tiles (zoom_level, tile_column, tile_row);"
)
"""What makes a database an MBTiles file."""
_AT_ONCE: Final = "PRAGMA journal_mode=OFF; PRAGMA synchronous=OFF;"  # of a file that is written in one go
_FORMATS: Final = {"png": "PNG", "jpg": "JPEG", "webp": "WEBP"}
_TILE: Final = "SELECT tile_data FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?"


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
        source: the raster, an orthoimage. path: the file; appears when it is complete. name: shown by viewers.
        tile_format: "png" is read by all programs, "webp" is a third of its size, "jpg" has no transparency.
        quality: of webp and jpg. progress: called with parts done and parts in all.

    Raises:
        InputError: if the raster cannot be read.
        OrthoSwarmError: if the disk is full, or the raster shows nothing.
    """
    with mbtiles_file(path, name=name, tile_format=tile_format, quality=quality) as file:
        draw_tiles(source, [file], progress)


@contextlib.contextmanager
def mbtiles_file(
    path: Path, *, name: str = "orthoimage", tile_format: Format = "png", quality: int = 85
) -> "Iterator[MbtilesFile]":
    """An MBTiles file to fill by `draw_tiles`; see `write_mbtiles`. It appears when the block ends without an error."""
    with atomic_write(path) as part, closing(sqlite3.connect(part)) as database:
        try:
            yield MbtilesFile(database, name, tile_format, quality)
        except sqlite3.Error as error:
            full = error.sqlite_errorcode == sqlite3.SQLITE_FULL
            raise OSError(errno.ENOSPC if full else errno.EIO, str(error)) from None


class MbtilesFile:
    """An open MBTiles file. See `tile_pyramid.TileFile`."""

    def __init__(self, database: sqlite3.Connection, name: str, tile_format: Format, quality: int) -> None:
        self._database, self._name, self._format, self._quality = database, name, tile_format, quality

    def begin(self, pyramid: Pyramid) -> None:
        """Write the metadata."""
        self._database.executescript(_AT_ONCE + TABLES)
        west, south, east, north = pyramid.bounds
        finest, middle = pyramid.finest.zoom, (west + east) / 2
        bounds = pyramid.whole_pixel_bounds()
        if pyramid.crosses:  # bounds must not wrap around this meridian (TileJSON 3.0); the centre says where to look
            bounds = (-180.0, bounds[1], 180.0, bounds[3])
        rows = {
            "name": self._name,
            "format": self._format,
            "type": "overlay",
            "version": "1.0",
            "description": "orthoimage made by OrthoSwarm",
            "bounds": ",".join(f"{v:.10f}" for v in bounds),
            "center": f"{middle - 360.0 if middle >= 180.0 else middle:.6f},{(south + north) / 2:.6f},{finest - 1}",
            "minzoom": str(pyramid.levels[-1].zoom),
            "maxzoom": str(finest),
        }
        self._database.executemany("INSERT INTO metadata VALUES (?, ?)", rows.items())

    def encode(self, quad: Quad) -> list[Tile]:
        """Column, row from the north and bytes of the quad's tiles."""
        return [(x, y, encode_tile(rgba, self._format, self._quality)) for x, y, rgba in quad.tiles()]

    def store(self, quad: Quad, encoded: list[Tile]) -> None:
        """Insert tiles; MBTiles counts rows from the south."""
        zoom = quad.zoom + 1
        rows = [(zoom, x, 2**zoom - 1 - y, data) for x, y, data in encoded]
        self._database.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", rows)

    def end(self) -> None:
        """Commit."""
        self._database.commit()


def encode_tile(rgba: Bytes, tile_format: Format, quality: int = 85) -> bytes:
    """A tile uint8 (rows, columns, 4) as PNG, WebP or JPEG (white where transparent)."""
    import cv2

    if tile_format == "jpg":
        rgb = np.where(rgba[..., 3:] > 0, rgba[..., :3], 255).astype(np.uint8)
        image, options = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    else:
        opaque = bool((rgba[..., 3] == 255).all())
        image = cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA if not opaque else cv2.COLOR_RGBA2BGR)
        options = [cv2.IMWRITE_PNG_COMPRESSION, 4] if tile_format == "png" else [cv2.IMWRITE_WEBP_QUALITY, quality]
    return bytes(cv2.imencode("." + tile_format, image, options)[1])


def write_pmtiles(mbtiles: Path, path: Path) -> None:
    """Write the tiles of an MBTiles file as PMTiles, with Protomaps' own package.

    Args:
        mbtiles: as `write_mbtiles` makes it (PNG, WebP or JPEG). path: the file; appears when it is complete.

    Raises:
        InputError: the MBTiles cannot be read.
        OrthoSwarmError: the disk is full.
    """
    from pmtiles.tile import zxy_to_tileid
    from pmtiles.writer import Writer

    try:
        with (
            closing(sqlite3.connect(mbtiles.absolute().as_uri() + "?mode=ro", uri=True)) as database,
            atomic_write(path) as part,
        ):
            about = dict(database.execute("SELECT name, value FROM metadata"))
            places = database.execute("SELECT zoom_level, tile_column, tile_row FROM tiles")
            numbered = sorted((zxy_to_tileid(z, x, 2**z - 1 - row), z, x, row) for z, x, row in places)
            with part.open("wb") as file, tempfile.TemporaryFile(dir=part.parent) as tiles:
                writer = Writer(file)
                writer.tile_f.close()  # which lies where there may be no room for a map
                writer.tile_f = tiles
                for number, *place in numbered:
                    writer.write_tile(number, database.execute(_TILE, place).fetchone()[0])
                writer.finalize(_header(about), {"name": about["name"], "type": "overlay"})
    except (sqlite3.Error, KeyError) as error:
        raise InputError(f"{mbtiles} cannot be read ({error}); export it again") from None


def _header(about: dict[str, str]) -> dict[str, Any]:
    """What the header says of all tiles, from the metadata of MBTiles; the rest is the package's."""
    from pmtiles.tile import Compression, TileType

    lon, lat, zoom = about["center"].split(",")
    places = dict(zip(("min_lon", "min_lat", "max_lon", "max_lat"), about["bounds"].split(","), strict=True))
    places |= {"center_lon": lon, "center_lat": lat}
    return {
        **{f"{name}_e7": round(float(degrees) * 1e7) for name, degrees in places.items()},
        "center_zoom": int(zoom),
        "tile_type": TileType[_FORMATS[about["format"]]],
        "tile_compression": Compression.NONE,
    }
