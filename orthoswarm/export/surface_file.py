"""The surface model as a cloud-optimised GeoTIFF."""

import warnings
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.export.cog import software
from orthoswarm.export.value_raster import write_values
from orthoswarm.model.placement import SurfaceModel

NO_DATA = -9999.0
"""What other programs expect for "no height"."""
_UNITS: Final = ("m", "m", "")
_DATUM: Final = "that of the altitudes in the photos: the ellipsoid, the geoid or another one, as their maker has it"
_NO_DATUM: Final = "none: heights are over the takeoff level"


def write_surface(
    path: Path, surface: SurfaceModel, takeoff_altitude_m: float | None, common_sigma_m: float | None = None
) -> None:
    """Write a COG, float32: band 1 height, band 2 one sigma, both metres, band 3 number of agreeing measurements.

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
        "measurements that agree": surface.measurements.astype(np.float32),
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
