"""Cloud-optimised GeoTIFFs, written in one pass from a source of windows: memory does not grow with the picture.

An existing raster is brought to another coordinate system, or to JPEG, by GDAL's own writer.

Layout as the OGC's COG standard (21-026) and GDAL's driver have it: header, all directories (full resolution first),
then tiles from the coarsest overview to full resolution. Tile positions are filled in at the end, which is possible
because the length of every table is known at the beginning. Transparent tiles take no room (offset and size 0).

A picture that cannot exceed 4 GiB even without compression is a classic TIFF, which all programs read; a larger one
is a BigTIFF.
"""

import struct
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from isal import isal_zlib

from orthoswarm import __version__
from orthoswarm.compute.jit import kernel
from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.model.arrays import Bytes
from orthoswarm.model.coordinate_system import require_map_system
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import GroundGrid

TILE_PX = 512
_LEVEL = 2  # of ISA-L's four: three times as fast as zlib's first level, and no larger
# GDAL's hints for readers; the last line's blank leaves room to say YES there.
_STRUCTURE = (
    b"LAYOUT=IFDS_BEFORE_DATA\nBLOCK_ORDER=ROW_MAJOR\nBLOCK_LEADER=SIZE_AS_UINT4\n"
    b"BLOCK_TRAILER=LAST_4_BYTES_REPEATED\nKNOWN_INCOMPATIBLE_EDITION=NO\n "
)


class PixelSource(Protocol):
    """The source of a COG's pixels, for example a canvas.canvas.Canvas."""

    grid: GroundGrid

    def read_reduced(self, factor: int, row0: int, row1: int, col0: int, col1: int) -> Bytes:
        """Colours uint8 (rows, columns, 4) of a window of the picture reduced by a power of two."""


CLASSIC_BYTES = 2**32 - 2**20  # size that a classic TIFF with its 32-bit offsets can have, with some room


def write_cog(
    source: PixelSource,
    path: Path,
    *,
    window: tuple[int, int, int, int] | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int = 2,
    classic_bytes: int = CLASSIC_BYTES,
    time_s: float | None = None,
) -> None:
    """Write a source as a COG: RGBA uint8, deflate, tiles of 512, overviews by powers of two.

    Args:
        source: where the pixels come from. path: the file; appears when it is complete.
        window: rows and columns (row0, row1, col0, col1) to write, the first ones multiples of TILE_PX; None for all.
        progress: called with tiles written and tiles in all. threads: how many tiles are compressed at once.
        classic_bytes: a file that may become larger is a BigTIFF.
        time_s: UTC epoch seconds for the tag DateTime, None to leave it out.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    row0, row1, col0, col1 = window or (0, source.grid.height, 0, source.grid.width)
    row1, col1 = max(row1, row0 + 1), max(col1, col0 + 1)
    levels = _levels(row1 - row0, col1 - col0)
    with atomic_write(path) as part, part.open("w+b") as file:
        tables = _write_directories(
            file, source.grid, (row0, col0), levels=levels, form=_form_of(levels, classic_bytes), time_s=time_s
        )
        done, total = 0, sum(level.tiles for level in levels)
        for level, table in reversed(list(zip(levels, tables, strict=True))):
            for i, data in enumerate(_compressed(source, (row0, col0), level, threads)):
                if data:
                    table.offsets[i], table.sizes[i] = file.tell() + 4, len(data)
                    file.write(struct.pack("<I", len(data)) + data + data[-4:])
                done += 1
                if progress is not None:
                    progress(done, total)
        for table in tables:
            table.fill_in(file)


class _Level:
    """One resolution: the picture reduced by a factor."""

    def __init__(self, factor: int, rows: int, cols: int) -> None:
        self.factor = factor
        self.rows, self.cols = -(-rows // factor), -(-cols // factor)
        self.tile_rows, self.tile_cols = -(-self.rows // TILE_PX), -(-self.cols // TILE_PX)
        self.tiles = self.tile_rows * self.tile_cols


def _levels(rows: int, cols: int) -> list[_Level]:
    levels = [_Level(1, rows, cols)]
    while max(levels[-1].rows, levels[-1].cols) > TILE_PX:
        levels.append(_Level(2 * levels[-1].factor, rows, cols))
    return levels


class _Table:
    """Offsets and sizes of the tiles of one level; its place in the file is reserved before they are written."""

    def __init__(self, count: int, form: "_Form") -> None:
        self.offsets = np.zeros(count, f"<u{form.word}")
        self.sizes = np.zeros(count, "<u4")
        self.offsets_at = self.sizes_at = 0

    def fill_in(self, file: BinaryIO) -> None:
        file.seek(self.offsets_at)
        file.write(self.offsets.tobytes())
        file.seek(self.sizes_at)
        file.write(self.sizes.tobytes())


def _compressed(source: PixelSource, first: tuple[int, int], level: _Level, threads: int) -> Iterator[bytes]:
    """The level's tiles in row order, compressed; empty where transparent."""
    pending: deque[Future[bytes]] = deque()
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for r in range(level.tile_rows):
            for c in range(level.tile_cols):
                pending.append(pool.submit(_deflate, _tile(source, first, level, r, c)))
                while len(pending) > 2 * threads:
                    yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def _tile(source: PixelSource, first: tuple[int, int], level: _Level, r: int, c: int) -> Bytes:
    """One full tile; beyond the picture it is transparent."""
    row, col = r * TILE_PX, c * TILE_PX
    rows, cols = min(TILE_PX, level.rows - row), min(TILE_PX, level.cols - col)
    top, left = first[0] // level.factor + row, first[1] // level.factor + col
    part = source.read_reduced(level.factor, top, top + rows, left, left + cols)
    if part.shape[:2] == (TILE_PX, TILE_PX):
        return part
    tile = np.zeros((TILE_PX, TILE_PX, 4), np.uint8)
    tile[:rows, :cols] = part
    return tile


def _deflate(tile: Bytes) -> bytes:
    """Horizontal differences (TIFF predictor 2) and deflate; nothing for a transparent tile."""
    differences = np.empty(tile.shape[:2], np.uint32)
    if not predict(np.ascontiguousarray(tile).view(np.uint32)[..., 0], differences):
        return b""
    return isal_zlib.compress(differences, _LEVEL)


_ALPHA = np.uint32(0xFF000000)
_NONE = np.uint32(0)
_HIGH, _LOW = np.uint32(0x80808080), np.uint32(0x7F7F7F7F)
"""The highest bit of each channel, and the others: by them all four channels are subtracted at once, without a borrow
from one to the next (Warren, Hacker's Delight, 2-18)."""


@kernel
def predict(tile, differences):  # type: ignore[no-untyped-def]
    """Each pixel's channels less those of the pixel to its left (TIFF predictor 2), transparent pixels as zeros.

    Args:
        tile: uint32 (rows, columns), R, G, B, A in memory order.
        differences: uint32 (rows, columns), is filled in the same order.

    Returns:
        Whether any pixel is drawn; if not, the differences mean nothing.
    """
    rows, columns = tile.shape
    drawn = _NONE
    clean = np.zeros(columns + 1, np.uint32)  # the first stands for what lies left of the row
    here, before = clean[1:], clean[:-1]
    for r in range(rows):
        pixels, row = tile[r], differences[r]
        for c in range(columns):
            here[c] = pixels[c] if pixels[c] & _ALPHA else _NONE
            drawn |= here[c]
        for c in range(columns):
            a, b = here[c], before[c]
            row[c] = ((a | _HIGH) - (b & _LOW)) ^ ((a ^ ~b) & _HIGH)
    return drawn != _NONE


# -- TIFF ---------------------------------------------------------------------------------------------------------

_SHORT, _LONG, _DOUBLE, _ASCII, _LONG8 = 3, 4, 12, 2, 16
_FORMATS = {_SHORT: "H", _LONG: "I", _DOUBLE: "d"}
_TILE_BYTES = TILE_PX * TILE_PX * 4
_WORST_TILE = _TILE_BYTES + _TILE_BYTES // 64 + 1024  # deflate stores what it cannot shrink, with some bytes a block


@dataclass(frozen=True, slots=True)
class _Form:
    """The two forms of a TIFF, which differ in the width of offsets and counts."""

    header: bytes  # of the file, without the offset of its first directory
    word: int  # bytes of an offset or of an entry's count
    count: str  # struct format of a directory's number of entries
    place: str  # struct format of an offset
    place_kind: int  # TIFF type of an offset

    @property
    def entry(self) -> int:
        """Bytes of a directory's entry: tag, type, count, and a value or its offset."""
        return 4 + 2 * self.word


_CLASSIC = _Form(struct.pack("<2sH", b"II", 42), 4, "<H", "<I", _LONG)
_BIG = _Form(struct.pack("<2sHHH", b"II", 43, 8, 0), 8, "<Q", "<Q", _LONG8)


def _form_of(levels: list[_Level], classic_bytes: int) -> _Form:
    """Classic TIFF if the file stays below this size at worst, else BigTIFF."""
    worst = sum(_WORST_TILE * level.tiles for level in levels)
    return _CLASSIC if worst < classic_bytes else _BIG


def _write_directories(
    file: BinaryIO, grid: GroundGrid, first: tuple[int, int], *, levels: list[_Level], form: "_Form",
    time_s: float | None,
) -> list[_Table]:  # fmt: skip
    """Write header and directories with room for the tile tables; the file is left at the first tile's offset."""
    ghost = b"GDAL_STRUCTURAL_METADATA_SIZE=%06d bytes\n" % len(_STRUCTURE) + _STRUCTURE
    ghost += bytes(len(ghost) % 2)  # GDAL's validator wants the first directory at the next even place
    at = len(form.header) + form.word + len(ghost)
    file.write(form.header + struct.pack(form.place, at) + ghost)
    tables = []
    for i, level in enumerate(levels):
        table = _Table(level.tiles, form)
        tags = _tags(level, grid if i == 0 else None, first)
        written = _date_time(time_s) if i == 0 else b""
        tags |= {306: (_ASCII, written)} if written else {}
        block = _directory(at, tags, table, form, last=i == len(levels) - 1)
        file.write(block)
        at += len(block)
        tables.append(table)
    return tables


def _tags(level: _Level, grid: GroundGrid | None, first: tuple[int, int]) -> dict[int, tuple[int, bytes | list[float]]]:
    """Tag -> type and values; the full resolution (grid given) also has the georeference."""
    tags: dict[int, tuple[int, bytes | list[float]]] = {
        254: (_LONG, [0 if grid else 1]),  # a reduced picture
        256: (_LONG, [level.cols]),
        257: (_LONG, [level.rows]),
        258: (_SHORT, [8] * 4),
        259: (_SHORT, [8]),  # deflate
        262: (_SHORT, [2]),  # RGB
        277: (_SHORT, [4]),
        284: (_SHORT, [1]),  # bands side by side
        317: (_SHORT, [2]),  # horizontal differences
        322: (_LONG, [TILE_PX]),
        323: (_LONG, [TILE_PX]),
        338: (_SHORT, [2]),  # the fourth band is alpha, not multiplied in
        339: (_SHORT, [1] * 4),
    }
    if grid is not None:
        west, north = grid.west + first[1] * grid.gsd_m, grid.north - first[0] * grid.gsd_m
        tags[305] = (_ASCII, software().encode() + b"\0")
        tags[33550] = (_DOUBLE, [grid.gsd_m, grid.gsd_m, 0.0])
        tags[33922] = (_DOUBLE, [0.0, 0.0, 0.0, west, north, 0.0])
        # GeoTIFF keys: projected, pixel is area, the CRS by its EPSG code, metres.
        tags[34735] = (_SHORT, [1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, grid.epsg, 3076, 0, 1, 9001])
    return tags


def _date_time(time_s: float | None) -> bytes:
    """The value of the tag DateTime, "YYYY:MM:DD HH:MM:SS" in UTC (TIFF knows no zone); empty if it is not known."""
    try:
        return b"" if time_s is None else datetime.fromtimestamp(time_s, UTC).strftime("%Y:%m:%d %H:%M:%S\0").encode()
    except (OverflowError, ValueError, OSError):  # no date
        return b""


def _directory(
    at: int, tags: dict[int, tuple[int, bytes | list[float]]], table: _Table, form: _Form, *, last: bool
) -> bytes:
    """One directory at a place in the file, with the values that do not fit into its entries after it."""
    number = struct.pack(form.count, len(tags) + 2)
    entries_at = at + len(number)
    values_at = entries_at + form.entry * (len(tags) + 2) + form.word
    values_at += -values_at % 8
    entries: list[bytes] = []
    values = bytearray()

    def add(tag: int, kind: int, count: int, data: bytes) -> int:
        """Write an entry; returns the offset of its data."""
        head = struct.pack("<HH", tag, kind) + struct.pack(form.place, count)
        if len(data) <= form.word:
            place = entries_at + form.entry * len(entries) + len(head)
            entries.append(head + data.ljust(form.word, b"\0"))
            return place
        values.extend(bytes(-len(values) % 8))
        place = values_at + len(values)
        values.extend(data)
        entries.append(head + struct.pack(form.place, place))
        return place

    pending = {**tags, 324: (form.place_kind, b""), 325: (_LONG, b"")}
    for tag in sorted(pending):
        kind, content = pending[tag]
        if tag == 324:
            table.offsets_at = add(tag, kind, len(table.offsets), table.offsets.tobytes())
        elif tag == 325:
            table.sizes_at = add(tag, kind, len(table.sizes), table.sizes.tobytes())
        elif isinstance(content, bytes):
            add(tag, kind, len(content), content)
        else:
            data = struct.pack(f"<{len(content)}{_FORMATS[kind]}", *content)
            add(tag, kind, len(content), data)
    values.extend(bytes(-len(values) % 8))
    following = struct.pack(form.place, 0 if last else values_at + len(values))
    block = number + b"".join(entries) + following
    return block + bytes(values_at - at - len(block)) + bytes(values)


# -- GDAL's own writer: another coordinate system, or JPEG with a mask -------------------------------------------------

_DATE = "TIFFTAG_DATETIME"


def convert_cog(source: Path, path: Path, *, epsg: int | None = None, jpeg_quality: int | None = None) -> str:
    """Write a raster as a COG; returns what is uncertain about its places in another coordinate system, else "".

    Args:
        source: a georeferenced RGBA raster. path: the file; appears when it is complete.
        epsg: its coordinate system; None keeps the source's.
        jpeg_quality: 1 to 100 for JPEG with a mask instead of the alpha band; None is lossless.

    Raises:
        InputError: if the raster cannot be read or brought to the coordinate system.
        OrthoSwarmError: if the disk is full.
    """
    import rasterio
    from rasterio.errors import CRSError, RasterioError
    from rasterio.vrt import WarpedVRT
    from rasterio.warp import transform_bounds

    lossless = {"compress": "DEFLATE", "predictor": 2}
    settings: dict[str, Any] = {
        "driver": "COG",
        "bigtiff": "IF_SAFER",  # by default GDAL never makes one of a compressed picture, and fails at 4 GB
        "overview_resampling": "AVERAGE",
        **(lossless if jpeg_quality is None else {"compress": "JPEG", "quality": jpeg_quality}),
    }
    doubt = ""
    try:
        with rasterio.open(source) as raster, atomic_write(path) as part, rasterio.Env(CHECK_DISK_FREE_SPACE=True):
            crs = raster.crs if epsg is None else rasterio.crs.CRS.from_epsg(epsg)
            if crs == raster.crs:
                copy_dataset(raster, part, **settings)
                return ""
            if epsg is not None:
                west, south, east, north = transform_bounds(raster.crs, 4326, *raster.bounds)
                doubt = require_map_system(epsg, [west, west, east, east], [south, north, south, north])
            with WarpedVRT(raster, crs=crs, resampling=rasterio.enums.Resampling.cubic, warp_mem_limit=64) as vrt:
                # A warped raster has none of its source's tags: it is copied by way of a description that has.
                date = raster.tags().get(_DATE)
                with tempfile.TemporaryDirectory(dir=part.parent, prefix=".warped") as folder:
                    described = Path(folder) / "warped.vrt"
                    copy_dataset(vrt, described, driver="VRT")
                    with rasterio.open(described, "r+") as file:
                        file.update_tags(TIFFTAG_SOFTWARE=software(), **({_DATE: date} if date else {}))
                    with rasterio.open(described) as file:
                        copy_dataset(file, part, **settings)
    except (CRSError, RasterioError) as error:
        raise InputError(f"{source.name} cannot be written as asked ({_first_line(error)}); check --epsg") from None
    return doubt


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def software() -> str:
    """What the TIFF tag "Software" says of a file that is made here."""
    return f"OrthoSwarm {__version__}"


def copy_dataset(dataset: Any, part: Path, **settings: Any) -> None:
    """Copy an open dataset by a driver of GDAL.

    Args:
        dataset: what is copied. part: the file. settings: driver and its creation options.

    Raises:
        InputError: the dataset cannot be read to its end.
        OSError: the file cannot be written; GDAL does not say why.
    """
    import rasterio.shutil
    from rasterio._err import CPLE_BaseError

    try:
        rasterio.shutil.copy(dataset, part, **settings)
    except CPLE_BaseError as error:  # which is none of rasterio's own errors, and may be of either file
        if not _is_whole(dataset):
            raise InputError(f"{dataset.name} cannot be read ({_first_line(error)}); make the map again") from None
        raise OSError(0, _first_line(error)) from None


def _is_whole(dataset: Any) -> bool:
    from rasterio.errors import RasterioError

    try:
        for _, window in dataset.block_windows(1):
            dataset.read(window=window)
    except RasterioError:
        return False
    return True
