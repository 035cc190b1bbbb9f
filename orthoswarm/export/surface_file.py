"""The surface model as a GeoTIFF."""

from pathlib import Path

import numpy as np

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.stereo.surface_cells import SurfaceModel

NO_DATA = -9999.0
"""What other programs expect for "no height"."""


def write_surface(path: Path, surface: SurfaceModel, takeoff_altitude_m: float | None) -> None:
    """Write a tiled GeoTIFF, float32: band 1 height, band 2 one sigma, both metres, band 3 number of agreeing pairs.

    Args:
        path: the file. surface: heights over the takeoff level.
        takeoff_altitude_m: altitude of that level as the receivers state it, added to the heights; None where unknown.

    Raises:
        StorageError: if the disk is full or the folder cannot be written.
    """
    import rasterio

    grid = surface.grid
    profile = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "count": 3, "dtype": "float32",
        "crs": f"EPSG:{grid.epsg}", "transform": grid.affine(), "nodata": NO_DATA, "compress": "deflate",
        "predictor": 3, "tiled": True,
    }  # fmt: skip
    unknown = ~np.isfinite(surface.height_m)
    zero = "the takeoff level" if takeoff_altitude_m is None else "the zero of the receivers' altitudes"
    bands = {
        f"height of the visible surface over {zero}, metres": surface.height_m + np.float32(takeoff_altitude_m or 0.0),
        "one sigma of the height, metres": surface.sigma_m,
        "pairs of pictures that agree": surface.pairs.astype(np.float32),
    }
    with atomic_write(path) as part, rasterio.open(part, "w", **profile) as file:
        for band, (name, values) in enumerate(bands.items(), start=1):
            file.write(np.where(unknown, np.float32(NO_DATA), values), band)
            file.set_band_description(band, name)
        file.update_tags(HEIGHTS_FROM=zero)
        if takeoff_altitude_m is not None:
            file.update_tags(TAKEOFF_ALTITUDE_M=f"{takeoff_altitude_m:.2f}")
