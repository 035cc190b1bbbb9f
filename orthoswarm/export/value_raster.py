"""Rasters of values as cloud-optimised GeoTIFFs: of any, and how far an orthoimage can be trusted."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.cog import copy_dataset, software
from orthoswarm.model.arrays import Floats
from orthoswarm.model.geo import GroundGrid
from orthoswarm.mosaic.confidence import Confidence

_COG: Final = {
    "driver": "COG", "compress": "deflate", "predictor": "floating_point", "overview_resampling": "average",
    "bigtiff": "if_safer",
}  # fmt: skip


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
