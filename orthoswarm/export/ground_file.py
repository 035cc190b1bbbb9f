"""The ground that an orthoimage was drawn on: heights with what stands on it, bare, and up to what may stand there."""

from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.export.value_raster import write_values
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain

GROUND: Final = "ground.tif"
_NO_DATA: Final = -9999.0


def write_ground(path: Path, terrain: Terrain, epsg: int) -> None:
    """Write a terrain as a COG of three bands, float32, metres, on the datum of the stated cameras.

    Raises StorageError: if the disk is full or the folder cannot be written.
    """
    rows, columns = terrain.z.shape
    half, step = 0.5 * terrain.step_m, terrain.step_m
    grid = GroundGrid(
        epsg=epsg, west=terrain.west - half, north=terrain.south + (rows - 0.5) * step, gsd_m=step, width=columns,
        height=rows,
    )  # fmt: skip
    bare = terrain.z if terrain.bare is None else terrain.bare
    tops = terrain.z if terrain.tops is None else terrain.tops
    named = {"height of the drawn surface, metres": terrain.z, "bare ground": bare, "up to what may stand there": tops}
    bands = {name: np.ascontiguousarray(z[::-1], np.float32) for name, z in named.items()}
    write_values(path, grid, bands, no_data=_NO_DATA, units=("m", "m", "m"), tags={})


def read_ground(path: Path) -> Terrain:
    """The terrain of a file that `write_ground` wrote."""
    import rasterio

    with rasterio.open(path) as file:
        grid, bands = GroundGrid.of_raster(file), file.read(masked=False)
    south = grid.north - (grid.height - 0.5) * grid.gsd_m
    z, bare, tops = (np.ascontiguousarray(band[::-1]) for band in bands)
    return Terrain(grid.west + 0.5 * grid.gsd_m, south, grid.gsd_m, z, bare=bare, tops=tops)
