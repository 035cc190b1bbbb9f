"""A basemap fetched before the flight: XYZ tiles of a server over an area, in an MBTiles file that needs no internet.

What has come is kept beside the file until it is complete, so that the same command goes on where it stopped.
"""

import http.client
import json
import math
import sqlite3
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm import __version__
from orthoswarm.export.atomic_file import disk_error
from orthoswarm.export.tiles.mbtiles import TABLES
from orthoswarm.export.tiles.tile_pyramid import tile_of
from orthoswarm.model.arrays import Array
from orthoswarm.model.earth import DEGREE_M, WEB_MERCATOR_M
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.task_runner import Progress

_MOST_TILES: Final = 20_000  # 60 square km at 0.3 m; tile servers block who asks for more
_AT_ONCE: Final = 4  # requests at a time, as browsers do
_TRIES: Final = 4  # of a tile that the server did not give
_PAUSE_S: Final = 1.0  # before the second one; doubled each time
_TIMEOUT_S: Final = 20.0
_LEVELS: Final = 6  # zoom levels at most: the coarser ones are for looking at the whole
_DEEPEST: Final = 22  # zoom, of servers that do not say theirs
_SIGNATURES: Final = {b"\x89PNG": "png", b"\xff\xd8\xff": "jpg", b"RIFF": "webp"}
_LACKING: Final = "CREATE TABLE IF NOT EXISTS lacking (zoom_level integer, tile_column integer, tile_row integer);"


@dataclass(frozen=True, slots=True)
class TileSource:
    """Where tiles are: addresses with {z}, {x} and {y} ({-y} counts from the south), the deepest zoom, the licence."""

    template: str
    deepest: int = _DEEPEST
    attribution: str = ""


@dataclass(frozen=True, slots=True)
class Downloaded:
    """What was fetched. tiles: how many; lacking: how many the server does not have; zoom: the deepest with tiles."""

    tiles: int
    lacking: int
    zoom: int
    pixel_m: float


def tile_server(address: str) -> TileSource:
    """A server by the template of its tiles' addresses, or by the address of its TileJSON.

    Raises:
        InputError: it is neither, or cannot be reached.
    """
    if not address.startswith(("http://", "https://")):
        raise InputError(f"{address} is not an address; give https://.../{{z}}/{{x}}/{{y}}.png, or that of a TileJSON")
    if "{z}" in address:
        return TileSource(address)
    try:
        said = json.loads(_get(address) or b"")
        template = str(said["tiles"][0])
        template = template.replace("{y}", "{-y}") if said.get("scheme") == "tms" else template
        return TileSource(template, int(said.get("maxzoom", _DEEPEST)), str(said.get("attribution") or ""))
    except (OSError, ValueError, http.client.HTTPException, KeyError, TypeError, IndexError):
        raise InputError(f"{address} gives no TileJSON; give https://.../{{z}}/{{x}}/{{y}}.png") from None


def download(
    server: TileSource, corners: Array, path: Path, *, pixel_m: float, progress: Progress | None = None
) -> Downloaded:
    """Fetch the tiles over an area.

    Args:
        server: where they are. corners: float64 (n, 2), latitude and longitude in degrees of what is to be covered.
        path: the MBTiles file; appears when it is complete.
        pixel_m: largest ground pixel. progress: told of tiles.

    Raises:
        InputError: the area takes too many tiles, or the server has none of it.
        OrthoSwarmError: the server cannot be reached any more, or the disk is full.
    """
    (south, west), (north, east) = corners.min(0), corners.max(0)
    across = math.cos(math.radians((south + north) / 2))
    wanted = math.ceil(math.log2(WEB_MERCATOR_M * across / 256 / pixel_m))
    zoom = max(0, min(wanted, server.deepest, _DEEPEST))
    places = list(_places(zoom, west, south, east, north))
    if len(places) > _MOST_TILES:
        raise InputError(
            f"{len(places):,} tiles would be fetched, {_MOST_TILES:,} are the most; choose a smaller area or a "
            "larger pixel"
        )
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with closing(sqlite3.connect(part)) as database:
            there = _begun(database, server.template)
            _fetch_all(server, [place for place in places if place not in there], database, len(places), progress)
            tiles, lacking, zoom = _finished(database, path.stem, server.attribution, (west, south, east, north))
        if not tiles:
            part.unlink()
            raise InputError("the server has no tile of this area; check the address and the area")
        part.replace(path)
    except sqlite3.Error as error:
        raise OrthoSwarmError(f"{part} cannot be written ({error}); free some disk space and run again") from None
    except OSError as error:
        raise disk_error(error, path) from None
    return Downloaded(tiles, lacking, zoom, WEB_MERCATOR_M * across / 256 / 2**zoom)


def _places(zoom: int, west: float, south: float, east: float, north: float) -> Iterator[tuple[int, int, int]]:
    """Zoom, column and row from the north of the tiles over an area, the coarse ones first."""
    for z in range(max(0, zoom - _LEVELS + 1), zoom + 1):
        (left, top), (right, bottom) = tile_of(west, north, z), tile_of(east, south, z)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                yield z, column % 2**z, row


def _begun(database: sqlite3.Connection, template: str) -> set[tuple[int, int, int]]:
    """The file's tables, and the places that an earlier run asked for at the same server."""
    database.executescript(TABLES + _LACKING)
    if database.execute("SELECT value FROM metadata WHERE name = 'source'").fetchone() != (template,):
        database.executescript("DELETE FROM tiles; DELETE FROM lacking; DELETE FROM metadata;")
        database.execute("INSERT INTO metadata VALUES ('source', ?)", (template,))
    found = database.execute("SELECT * FROM lacking UNION SELECT zoom_level, tile_column, tile_row FROM tiles")
    return {(z, x, 2**z - 1 - y) for z, x, y in found}


def _fetch_all(
    server: TileSource, places: list[tuple[int, int, int]], database: sqlite3.Connection, total: int,
    progress: Progress | None,
) -> None:  # fmt: skip
    """Fetch tiles into the file; what came is kept when the server fails or the user stops it."""
    done, tell = total - len(places), progress or (lambda *_: None)
    tell("tiles", done, total)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        try:
            for (z, x, y), tile in zip(
                places, pool.map(lambda place: _tile(server.template, *place), places), strict=True
            ):
                row = (z, x, 2**z - 1 - y)
                if tile is None:
                    database.execute("INSERT INTO lacking VALUES (?, ?, ?)", row)
                else:
                    database.execute("INSERT OR REPLACE INTO tiles VALUES (?, ?, ?, ?)", (*row, tile))
                done += 1
                tell("tiles", done, total)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            database.commit()


def _finished(
    database: sqlite3.Connection, name: str, attribution: str, bounds: tuple[float, float, float, float]
) -> tuple[int, int, int]:
    """Write what viewers ask for; how many tiles there are and are lacking, and the deepest zoom."""
    tiles, first, last = database.execute("SELECT count(*), min(zoom_level), max(zoom_level) FROM tiles").fetchone()
    if not tiles:
        return 0, 0, 0
    lacking = database.execute("SELECT count(*) FROM lacking WHERE zoom_level = ?", (last,)).fetchone()[0]
    some = bytes(database.execute("SELECT tile_data FROM tiles LIMIT 1").fetchone()[0])
    rows = {
        "name": name,
        "type": "baselayer",
        "format": _kind(some) or "png",
        "attribution": attribution,
        "bounds": ",".join(f"{v:.7f}" for v in bounds),
        "minzoom": str(first),
        "maxzoom": str(last),
    }
    database.executemany("INSERT INTO metadata VALUES (?, ?)", rows.items())
    database.execute("DROP TABLE lacking")
    database.execute("DELETE FROM metadata WHERE name = 'source'")  # whoever gets the file does not get the key in it
    database.commit()
    return tiles, lacking, last


def _tile(template: str, z: int, x: int, y: int) -> bytes | None:
    """A tile, None where the server has none; tried again while the server is busy or unreachable.

    Raises:
        OrthoSwarmError: it stays so, or it refuses.
    """
    address = template.replace("{z}", str(z)).replace("{x}", str(x)).replace("{y}", str(y))
    address = address.replace("{-y}", str(2**z - 1 - y))
    for attempt in range(_TRIES):
        try:
            content = _get(address)
            return content if content is not None and _kind(content) else None
        except urllib.error.HTTPError as error:
            if error.code in (401, 403):
                raise OrthoSwarmError(
                    f"the server refuses its tiles ({error.code}); check the address and its key"
                ) from None
            why = f"it answers {error.code}"
        except (OSError, ValueError, http.client.HTTPException) as error:
            why = str(getattr(error, "reason", error))
        if attempt < _TRIES - 1:
            time.sleep(_PAUSE_S * 2**attempt)
    raise OrthoSwarmError(f"the server gives no more tiles ({why}); the same command goes on from there later")


def _get(address: str) -> bytes | None:
    """What is at an address, None if there is nothing."""
    asked = urllib.request.Request(address, headers={"User-Agent": f"OrthoSwarm/{__version__} (map for use offline)"})
    try:
        with urllib.request.urlopen(asked, timeout=_TIMEOUT_S) as reply:
            return bytes(reply.read()) or None
    except urllib.error.HTTPError as error:
        if error.code in (404, 410):
            return None
        raise


def _kind(content: bytes) -> str | None:
    """The format of a picture by its first bytes, None if it is none."""
    return next((kind for start, kind in _SIGNATURES.items() if content.startswith(start)), None)


def grown(shells: Sequence[Array], margin_m: float) -> Array:
    """South-west and north-east corner (2, 2) of areas (n, 2 each) with a margin: latitude and longitude in degrees.

    Longitudes go on beyond 180 for an area on both sides of it.
    """
    places = np.concatenate(shells)
    east_of_first = (places[:, 1] - places[0, 1] + 180.0) % 360.0 - 180.0
    places = np.column_stack([places[:, 0], places[0, 1] + east_of_first])
    north = margin_m / DEGREE_M
    margin = np.array([north, north / math.cos(math.radians(float(np.abs(places[:, 0]).max())))])
    corners = np.stack([places.min(0) - margin, places.max(0) + margin])
    corners[:, 1] += 360.0 if corners[0, 1] < -180.0 else 0.0
    return corners
