"""A raster in tiles: COGs in a folder, and a virtual raster (VRT) beside it that QGIS and GDAL open as one.

orthoimage.vrt
tiles/orthoimage/r000_c000.tif ...
"""

import contextlib
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal
from xml.sax.saxutils import escape

from pyproj import CRS

from orthoswarm.export.atomic_file import atomic_write, write_file
from orthoswarm.export.cog import PixelSource, write_cog
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid

_ONE_FILE_PX: Final = 4e9
"""A map of more pixels is written in tiles where the user does not say how: 40 square kilometres at 0.1 m; as one file
it has some 10 GB, which web servers, object storage and copying by radio handle badly."""
_TILE_PX: Final = 8192  # side of a tile, a multiple of 512: some 100 MB a file
FOLDER = "tiles"  # folder of all tiles and of the collection, within the map's
COLLECTION = "collection.json"
VEHICLES = "vehicles"
Tiles = Literal["auto", "yes", "no"]
_NAME = re.compile(r"r(\d+)_c(\d+)\.tif")
_WRITTEN = re.compile(rf"{FOLDER}/({COLLECTION}|{VEHICLES}/[^/]+\.json|[^/]+/r\d+_c\d+\.(tif|json))")


@dataclass(frozen=True, slots=True)
class RasterTile:
    """One file of a raster in tiles: its name in the raster's folder, and where it lies on the ground."""

    name: str
    grid: GroundGrid


def is_tile_or_collection(name: str) -> bool:
    """Whether a path in a map's folder is that of a tile, of an item or of the collection; others are not ours."""
    return _WRITTEN.fullmatch(name) is not None


def in_tiles(wanted: Tiles, window: tuple[int, int, int, int]) -> bool:
    """Whether rows and columns (row0, row1, col0, col1) of a raster are to be written in tiles."""
    row0, row1, col0, col1 = window
    return wanted == "yes" or (wanted == "auto" and (row1 - row0) * (col1 - col0) > _ONE_FILE_PX)


def product_file(folder: Path, name: str) -> Path | None:
    """The raster `name` (`orthoimage.tif`) of a map's folder, as one file or as the virtual raster of its tiles.

    Returns None if the folder holds neither.
    """
    single, virtual = folder / name, _virtual(folder, name)
    return single if single.exists() else virtual if virtual.exists() else None


def remove_product(folder: Path, name: str) -> None:
    """Remove a raster, in whichever form it is there."""
    (folder / name).unlink(missing_ok=True)
    remove_tiles(folder, name)


def remove_tiles(folder: Path, name: str) -> None:
    """Remove a raster's tiles and the virtual raster of them."""
    if _virtual(folder, name).exists():
        _virtual(folder, name).unlink()
        shutil.rmtree(_tiles(folder, name), ignore_errors=True)
    with contextlib.suppress(OSError):
        (folder / FOLDER).rmdir()  # if nothing is left in it


def remove_collection(folder: Path) -> None:
    """Remove the collection and its vehicles, not the tiles."""
    top = folder / FOLDER
    if (top / COLLECTION).exists():
        (top / COLLECTION).unlink()
        shutil.rmtree(top / VEHICLES, ignore_errors=True)
        with contextlib.suppress(OSError):
            top.rmdir()  # if nothing is left in it


def write_tiled(
    source: PixelSource, folder: Path, name: str, *, window: tuple[int, int, int, int], drawn: Iterable[BoundingBox],
    progress: Callable[[int, int], None] | None = None, threads: int = 2, time_s: float | None = None,
) -> None:  # fmt: skip
    """Write a raster in tiles; tiles without content are left out.

    Args:
        source: where the pixels come from. folder: the map's. name: the product, `orthoimage.tif`.
        window: rows and columns (row0, row1, col0, col1) to write, the first ones multiples of 512.
        drawn: parts of the ground that have content, metres.
        progress: called with tiles written and tiles in all. threads: how many blocks are compressed at once.
        time_s: UTC epoch seconds for the tag DateTime of the tiles, None to leave it out.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    side, grid = _TILE_PX, source.grid
    row0, row1, col0, col1 = window
    filled = {
        (r, c)
        for bounds in drawn
        for r, c in _touched(bounds, grid, (row0, col0), side)
        if row0 + r * side < row1 and col0 + c * side < col1
    }
    with atomic_write(_tiles(folder, name)) as part:
        part.mkdir()
        for done, (r, c) in enumerate(sorted(filled), 1):
            top, left = row0 + r * side, col0 + c * side
            inside = (top, min(top + side, row1), left, min(left + side, col1))
            write_cog(source, part / f"r{r:03d}_c{c:03d}.tif", window=inside, threads=threads, time_s=time_s)
            if progress is not None:
                progress(done, len(filled))
    raster = replace(
        grid, west=grid.west + col0 * grid.gsd_m, north=grid.north - row0 * grid.gsd_m, width=col1 - col0,
        height=row1 - row0,
    )  # fmt: skip
    write_file(_virtual(folder, name), _document(raster, _placed_tiles(folder, name, raster), Path(name).stem))
    (folder / name).unlink(missing_ok=True)


def copy_tiled(folder: Path, name: str, other: str) -> None:
    """Copy a raster in tiles to another name in the same folder."""
    with atomic_write(_tiles(folder, other)) as part:
        shutil.copytree(_tiles(folder, name), part)
    text = _virtual(folder, name).read_text(encoding="utf-8")
    write_file(_virtual(folder, other), text.replace(f"{FOLDER}/{Path(name).stem}/", f"{FOLDER}/{Path(other).stem}/"))
    (folder / other).unlink(missing_ok=True)


def tiles_of(folder: Path, name: str) -> list[RasterTile]:
    """The tiles of a raster, in order of their names; none if it is one file or absent."""
    import rasterio

    if not _virtual(folder, name).exists():
        return []
    with rasterio.open(_virtual(folder, name)) as raster:
        return list(_placed_tiles(folder, name, GroundGrid.of_raster(raster)))


def _virtual(folder: Path, name: str) -> Path:
    return folder / f"{Path(name).stem}.vrt"


def _tiles(folder: Path, name: str) -> Path:
    return folder / FOLDER / Path(name).stem


def _touched(
    bounds: BoundingBox, grid: GroundGrid, first: tuple[int, int], side: int
) -> Iterator[tuple[int, int]]:  # row and column of tiles
    west, south, east, north = bounds
    half = 0.5 * grid.gsd_m  # to the middles of the outermost pixels
    rows = [int((grid.north - y) / grid.gsd_m - first[0]) // side for y in (north - half, south + half)]
    cols = [int((x - grid.west) / grid.gsd_m - first[1]) // side for x in (west + half, east - half)]
    return ((r, c) for r in range(rows[0], rows[1] + 1) for c in range(cols[0], cols[1] + 1))


def _placed_tiles(folder: Path, name: str, raster: GroundGrid) -> Iterator[RasterTile]:
    """The tiles in a raster's folder, placed on its grid."""
    side = _TILE_PX
    for path in sorted(_tiles(folder, name).glob("*.tif")):
        if found := _NAME.fullmatch(path.name):
            row, column = int(found[1]) * side, int(found[2]) * side
            grid = replace(
                raster, west=raster.west + column * raster.gsd_m, north=raster.north - row * raster.gsd_m,
                width=min(side, raster.width - column), height=min(side, raster.height - row),
            )  # fmt: skip
            yield RasterTile(path.name, grid)


def _document(raster: GroundGrid, tiles: Iterable[RasterTile], stem: str) -> str:
    """The virtual raster: see https://gdal.org/en/stable/drivers/raster/vrt.html."""
    sources = []
    for tile in tiles:
        column = round((tile.grid.west - raster.west) / raster.gsd_m)
        row = round((raster.north - tile.grid.north) / raster.gsd_m)
        size = f'xSize="{tile.grid.width}" ySize="{tile.grid.height}"'
        sources.append(
            f'  <SimpleSource>\n   <SourceFilename relativeToVRT="1">{FOLDER}/{stem}/{tile.name}</SourceFilename>\n'
            "   <SourceBand>BAND</SourceBand>\n"
            f'   <SourceProperties RasterXSize="{tile.grid.width}" RasterYSize="{tile.grid.height}" DataType="Byte" '
            'BlockXSize="512" BlockYSize="512"/>\n'
            f'   <SrcRect xOff="0" yOff="0" {size}/>\n   <DstRect xOff="{column}" yOff="{row}" {size}/>\n'
            "  </SimpleSource>\n"
        )
    bands = "".join(
        f' <VRTRasterBand dataType="Byte" band="{n}">\n  <ColorInterp>{colour}</ColorInterp>\n'
        + "".join(source.replace("BAND", str(n), 1) for source in sources)
        + " </VRTRasterBand>\n"
        for n, colour in enumerate(("Red", "Green", "Blue", "Alpha"), 1)
    )
    step = repr(raster.gsd_m)
    wkt = escape(CRS.from_epsg(raster.epsg).to_wkt("WKT1_GDAL"))
    return (
        f'<VRTDataset rasterXSize="{raster.width}" rasterYSize="{raster.height}">\n'
        f" <!-- tiles of {_TILE_PX} pixels -->\n"
        f' <SRS dataAxisToSRSAxisMapping="1,2">{wkt}</SRS>\n'
        f" <GeoTransform>{raster.west!r}, {step}, 0.0, {raster.north!r}, 0.0, -{step}</GeoTransform>\n"
        f"{bands}</VRTDataset>\n"
    )
