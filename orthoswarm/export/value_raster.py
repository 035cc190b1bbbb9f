"""Rasters of values as cloud-optimised GeoTIFFs: confidence, the surface model, the ground that was drawn on."""

import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.cog import copy_dataset, software
from orthoswarm.model.arrays import Floats
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.confidence import Confidence
from orthoswarm.stereo.surface_cells import SurfaceModel

_COG: Final = {
    "driver": "COG", "compress": "deflate", "predictor": "floating_point", "overview_resampling": "average",
    "bigtiff": "if_safer",
}  # fmt: skip
GROUND: Final = "ground.tif"
_NO_DATA: Final = -9999.0
NO_DATA = -9999.0  # what other programs expect for "no height"
_UNITS: Final = ("m", "m", "")
_DATUM: Final = "that of the altitudes in the photos: the ellipsoid, the geoid or another one, as their maker has it"
_NO_DATUM: Final = "none: heights are over the takeoff level"


def write_values(
    path: Path,
    grid: GroundGrid,
    bands: Mapping[str, Floats],
    *,
    no_data: float,
    units: Sequence[str],
    tags: Mapping[str, str],
    overviews: str = "average",
) -> None:
    """Write a COG of float32 bands.

    Args:
        path: the file; appears when it is complete.
        bands: description -> float32 (rows, columns). no_data: what stands where there is no value.
        units: of each band. tags: of the file. overviews: how values are brought together in them.

    Raises:
        StorageError: if the disk is full or the folder cannot be written.
    """
    import rasterio

    profile = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "count": len(bands), "dtype": "float32",
        "crs": f"EPSG:{grid.epsg}", "transform": grid.affine(), "nodata": no_data, "tiled": True,
        "bigtiff": "if_safer",
    }  # fmt: skip
    with atomic_write(path) as part, tempfile.TemporaryDirectory(dir=path.parent, prefix=".values") as folder:
        plain = Path(folder) / "plain.tif"  # overviews are made of a whole file
        with rasterio.open(plain, "w", **profile) as file:
            for band, (name, values) in enumerate(bands.items(), start=1):
                file.write(values, band)
                file.set_band_description(band, name)
            file.units = tuple(units)
            file.update_tags(**tags)
        with rasterio.open(plain) as file:
            copy_dataset(file, part, **_COG | {"overview_resampling": overviews})


def write_confidence(path: Path, found: Confidence) -> None:
    """Write how far an orthoimage can be trusted, a COG; -1 where nothing is drawn.

    Raises StorageError: if the disk is full or the folder cannot be written.
    """
    bands = {
        "good to so many metres: 0.2, 0.5, 2; 99: only for orientation": found.good_to_m,
        "pictures that see the ground": found.pictures.astype(np.float32),
        "angle off nadir of the picture that is drawn, degrees": found.angle_deg,
        "error of its camera on the ground, one sigma of an axis, metres": found.sigma_m,
        "distance to what may stand before the ground in it, metres": found.lean_m,
        "1: that is drawn there, too": found.hidden.astype(np.float32),
        "1: its colours were changed by more than a half to fit the others": found.changed_tone.astype(np.float32),
    }
    undrawn = ~np.isfinite(found.good_to_m)
    values = {name: np.where(undrawn, np.float32(-1.0), band) for name, band in bands.items()}
    units, tags = ("m", "", "deg", "m", "m", "", ""), {"TIFFTAG_SOFTWARE": software()}
    write_values(path, found.grid, values, no_data=-1.0, units=units, tags=tags, overviews="nearest")


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


def write_surface(
    path: Path, surface: SurfaceModel, takeoff_altitude_m: float | None, common_sigma_m: float | None = None
) -> None:
    """Write a COG, float32: band 1 height, band 2 one sigma, both metres, band 3 number of agreeing pairs.

    The sigma is that of a height against those around. What is wrong with all heights alike stands in its description.

    Args:
        path: the file. surface: heights over the takeoff level.
        takeoff_altitude_m: altitude of that level as the receivers state it, added to the heights; None where unknown.
        common_sigma_m: one sigma that all heights have in common, metres; None where unknown.

    Raises:
        StorageError: if the disk is full or the folder cannot be written.
    """
    unknown = ~np.isfinite(surface.height_m)
    zero = "the takeoff level" if takeoff_altitude_m is None else "the zero of the receivers' altitudes"
    common = (
        "what all heights have in common is not known"
        if common_sigma_m is None
        else f"all heights together have {common_sigma_m:.2f} m besides (one sigma)"
    )
    bands = {
        f"height of the visible surface over {zero}, metres": surface.height_m + np.float32(takeoff_altitude_m or 0.0),
        f"one sigma of the height against those around, metres; {common}": surface.sigma_m,
        "pairs of pictures that agree": surface.pairs.astype(np.float32),
    }
    tags = {"HEIGHTS_FROM": zero, "VERTICAL_DATUM": _NO_DATUM, "TIFFTAG_SOFTWARE": software()}
    if takeoff_altitude_m is not None:
        tags |= {"TAKEOFF_ALTITUDE_M": f"{takeoff_altitude_m:.2f}", "VERTICAL_DATUM": _DATUM}
    known = {name: np.where(unknown, np.float32(NO_DATA), values) for name, values in bands.items()}
    write_values(path, surface.grid, known, no_data=NO_DATA, units=_UNITS, tags=tags)


def is_surface(path: Path) -> bool:
    """Whether a file is a surface model that `write_surface` wrote."""
    import rasterio
    from rasterio.errors import RasterioError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a photo has no coordinate system
            with rasterio.open(path) as file:
                return "HEIGHTS_FROM" in file.tags()
    except (RasterioError, OSError):
        return False
