"""PMTiles 3 (Protomaps, "PMTiles Version 3 Specification"): web tiles in one file that any file server can serve."""

import gzip
import json
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.model.errors import InputError

_HEADER_BYTES: Final = 127
_ROOT_BYTES: Final = 16_384 - _HEADER_BYTES
"""Readers fetch the first 16 kiB at once: the header and the root directory must fit."""
_GZIP: Final = 2
_TYPES: Final = {"png": 2, "jpg": 3, "webp": 4}


@dataclass(frozen=True, slots=True)
class _Entry:
    """Tiles `number` to `number + run - 1` hold the same bytes; run 0: a leaf directory from `number` on."""

    number: int
    offset: int
    length: int
    run: int


def write_pmtiles(mbtiles: Path, path: Path) -> None:
    """Write the tiles of an MBTiles file as PMTiles.

    Args:
        mbtiles: as `write_mbtiles` makes it (PNG, WebP or JPEG). path: the file; appears when it is complete.

    Raises:
        InputError: the MBTiles cannot be read.
        OrthoSwarmError: the disk is full.
    """
    try:
        with closing(sqlite3.connect(f"file:{mbtiles}?mode=ro", uri=True)) as database, atomic_write(path) as part:
            about = dict(database.execute("SELECT name, value FROM metadata"))
            _write(database, about, part)
    except (sqlite3.Error, KeyError) as error:
        raise InputError(f"{mbtiles} cannot be read ({error}); export it again") from None


def _write(database: sqlite3.Connection, about: dict[str, str], path: Path) -> None:
    numbered = sorted((tile_number(z, x, y), z, x, y) for z, x, y in _addresses(database))
    entries: list[_Entry] = []
    places: dict[bytes, tuple[int, int]] = {}
    tiles = path.with_name(path.name + ".tiles")
    try:
        with tiles.open("wb") as out:
            for number, z, x, y in numbered:
                data = _tile(database, z, x, y)
                at = places.get(data) if len(data) < 1000 else None  # an empty sea repeats, a picture does not
                if at is None:
                    at = out.tell(), len(data)
                    out.write(data)
                    if len(data) < 1000:
                        places[data] = at
                last = entries[-1] if entries else None
                if last and (last.offset, last.length) == at and last.number + last.run == number:
                    entries[-1] = _Entry(last.number, *at, last.run + 1)
                else:
                    entries.append(_Entry(number, *at, 1))
        root, leaves = _directories(entries)
        metadata = gzip.compress(json.dumps({"name": about["name"], "type": "overlay"}).encode(), mtime=0)
        sections = [root, metadata, leaves]
        header = _header(about, [len(s) for s in sections], tiles.stat().st_size, len(numbered), len(entries))
        with path.open("wb") as file, tiles.open("rb") as source:
            file.write(header)
            for section in sections:
                file.write(section)
            while block := source.read(1 << 20):
                file.write(block)
    finally:
        tiles.unlink(missing_ok=True)


def _addresses(database: sqlite3.Connection) -> Iterator[tuple[int, int, int]]:
    """Zoom, column, and row from the north of all tiles."""
    for zoom, x, row in database.execute("SELECT zoom_level, tile_column, tile_row FROM tiles"):
        yield zoom, x, 2**zoom - 1 - row


def _tile(database: sqlite3.Connection, zoom: int, x: int, y: int) -> bytes:
    query = "SELECT tile_data FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?"
    return bytes(database.execute(query, (zoom, x, 2**zoom - 1 - y)).fetchone()[0])


def tile_number(zoom: int, x: int, y: int) -> int:
    """A tile's number: all tiles of coarser zooms, then the position on the zoom's Hilbert curve.

    Args:
        zoom: from 0. x: column. y: row from the north.
    """
    number: int = (4**zoom - 1) // 3
    side = 2**zoom >> 1
    while side:
        right, below = int(x & side > 0), int(y & side > 0)
        number += side * side * ((3 * right) ^ below)
        if not below:
            if right:
                x, y = side - 1 - (x & (side - 1)), side - 1 - (y & (side - 1))
            x, y = y, x
        x, y = x & (side - 1), y & (side - 1)
        side >>= 1
    return number


def _directories(entries: Sequence[_Entry]) -> tuple[bytes, bytes]:
    """The root directory and the leaves; without leaves if the root holds all."""
    single = _directory(entries)
    if len(single) <= _ROOT_BYTES:
        return single, b""
    size = 4096
    while True:
        leaves, root = b"", list[_Entry]()
        for first in range(0, len(entries), size):
            leaf = _directory(entries[first : first + size])
            root.append(_Entry(entries[first].number, len(leaves), len(leaf), 0))
            leaves += leaf
        packed = _directory(root)
        if len(packed) <= _ROOT_BYTES:
            return packed, leaves
        size *= 2


def _directory(entries: Sequence[_Entry]) -> bytes:
    out = bytearray(_varint(len(entries)))
    last = 0
    for entry in entries:
        out += _varint(entry.number - last)
        last = entry.number
    for entry in entries:
        out += _varint(entry.run)
    for entry in entries:
        out += _varint(entry.length)
    end = -1
    for entry in entries:
        out += _varint(0 if entry.offset == end else entry.offset + 1)
        end = entry.offset + entry.length
    return gzip.compress(bytes(out), mtime=0)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def _header(about: dict[str, str], sizes: Sequence[int], tile_bytes: int, tiles: int, entries: int) -> bytes:
    root, metadata, leaves = sizes
    west, south, east, north = (round(float(v) * 1e7) for v in about["bounds"].split(","))
    lon, lat, zoom = about["center"].split(",")
    at = _HEADER_BYTES
    return struct.pack(
        "<7sB11Q6B4iB2i", b"PMTiles", 3, at, root, at + root, metadata, at + root + metadata, leaves,
        at + root + metadata + leaves, tile_bytes, tiles, entries, entries, 1, _GZIP, 1, _TYPES[about["format"]],
        int(about["minzoom"]), int(about["maxzoom"]), west, south, east, north, int(zoom),
        round(float(lon) * 1e7), round(float(lat) * 1e7),
    )  # fmt: skip
