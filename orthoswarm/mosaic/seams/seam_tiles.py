"""The seam lines of one tile, with those of its neighbours that are settled already held as they are."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.canvas.tile_store import Key, TileStore
from orthoswarm.model.arrays import Floats, Ints
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.kernels.drawn_heights import heights
from orthoswarm.mosaic.kernels.render_arrays import Shots
from orthoswarm.mosaic.seams.cell_candidates import Region, cell_candidates
from orthoswarm.mosaic.seams.feather import labels_around
from orthoswarm.mosaic.seams.previews import COLUMNS, read_previews
from orthoswarm.mosaic.seams.relaxation import FOREIGN, NONE, relax, to_pixels

BORDER_PX: Final = 32
"""Pixels around a tile that its seams are chosen together with, so that they go on well in the next tile; a multiple of
8."""
_CELL_PX: Final = (4, 8)
"""Least and greatest side of the cells, pixels, powers of two: finer cells cost time and do not improve seams (4
instead of 2: a third of the time, no difference to be seen on four sets)."""


@dataclass(frozen=True, slots=True)
class SeamCells:
    """What the seams of a tile are chosen by.

    Attributes:
        previews: file of the pictures' previews. rows: int32 (N,), the candidates' records there.
        tone: float32 (N, 6), factors of their brightness, see cell_candidates.
        cell_px: side of a cell. terrain: the ground of the tile and `BORDER_PX` around it.
    """

    previews: Path
    rows: Ints
    tone: Floats
    cell_px: int
    terrain: Terrain


def cell_size_px(picture_width: int, picture_gsd_m: float, gsd_m: float) -> int:
    """Side of the cells, pixels of the map (within `_CELL_PX`): about a pixel of the previews.

    picture_width: columns of the pictures. picture_gsd_m: their ground pixel at nadir. gsd_m: the map's.
    """
    wanted = picture_width / COLUMNS * picture_gsd_m / gsd_m
    size = 2 ** round(float(np.log2(max(wanted, 1.0))))
    least, most = _CELL_PX
    return int(min(max(size, least), most))


def seam_labels(
    store: TileStore, key: Key, shape: tuple[int, int], *, west: float, north: float, gsd_m: float,
    ids: Ints, shots: Shots, seams: SeamCells,
) -> Ints:  # fmt: skip
    """Labels of a tile's pixels (place in `ids` plus 1, 0 where no cell has a candidate), int32 of a shape.

    Args:
        store: tiles with labels (index + 1) of the neighbours that are settled; key: the tile.
        shape: rows and columns of the tile within the map.
        west: easting of its left edge. north: northing of its upper edge. gsd_m: ground pixel.
        ids: int32 (N,), rising indices of the candidates. shots: their cameras. seams: what else is known.
    """
    pixels = np.zeros(shape, np.int32)
    if len(ids) == 0:
        return pixels
    cell, border = seams.cell_px, BORDER_PX
    side_px = store.tile_px + 2 * border
    left, top = west - border * gsd_m, north + border * gsd_m
    lattice = heights(seams.terrain, left, top, gsd_m, side_px)
    region = Region(west=left, north=top, gsd_m=gsd_m, cell_px=cell, side=side_px // cell, lattice=lattice)
    cells = cell_candidates(region, shots, seams.tone, read_previews(seams.previews, seams.rows))
    label = relax(cells, _settled(store, key, cell, ids), _standing(seams.terrain, region))
    to_pixels(label, cells.candidate, cell, border // cell, pixels)
    return pixels


def _settled(store: TileStore, key: Key, cell: int, ids: Ints) -> Ints:
    """Labels of the cells around a tile that belong to neighbours that are settled, NONE elsewhere."""
    around = labels_around(store, key, BORDER_PX)[cell // 2 :: cell, cell // 2 :: cell] - 1
    place = np.searchsorted(ids, around).clip(0, len(ids) - 1)
    fixed = np.where(ids[place] == around, place, FOREIGN)
    return np.where(around < 0, NONE, fixed).astype(np.int32)


def _standing(terrain: Terrain, region: Region) -> Floats:
    """Height of the drawn surface over the bare ground at each cell's centre."""
    if terrain.bare is None:
        return np.zeros((region.side, region.side), np.float32)
    bare = heights(terrain.bare_ground(), region.west, region.north, region.gsd_m, region.side * region.cell_px)
    over = region.lattice - bare
    at = ((np.arange(region.side) + 0.5) * region.cell_px / (region.side * region.cell_px) * (len(over) - 1)).astype(
        int
    )
    return np.ascontiguousarray(over[np.ix_(at, at)])
