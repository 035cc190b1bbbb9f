"""PMTiles 3: web tiles in one file that any file server can serve, written by Protomaps' own package."""

import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.model.errors import InputError

_FORMATS: Final = {"png": "PNG", "jpg": "JPEG", "webp": "WEBP"}
_TILE: Final = "SELECT tile_data FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?"


def write_pmtiles(mbtiles: Path, path: Path) -> None:
    """Write the tiles of an MBTiles file as PMTiles.

    Args:
        mbtiles: as `write_mbtiles` makes it (PNG, WebP or JPEG). path: the file; appears when it is complete.

    Raises:
        InputError: the MBTiles cannot be read.
        OrthoSwarmError: the disk is full.
    """
    from pmtiles.tile import zxy_to_tileid
    from pmtiles.writer import Writer

    try:
        with closing(sqlite3.connect(f"file:{mbtiles}?mode=ro", uri=True)) as database, atomic_write(path) as part:
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
