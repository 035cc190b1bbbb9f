"""A COG in another coordinate system, or compressed as JPEG with a mask, by GDAL's own writer."""

import tempfile
from pathlib import Path
from typing import Any

from orthoswarm import __version__
from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.model.errors import InputError

_DATE = "TIFFTAG_DATETIME"


def convert_cog(source: Path, path: Path, *, epsg: int | None = None, jpeg_quality: int | None = None) -> None:
    """Write a raster as a COG.

    Args:
        source: a georeferenced RGBA raster.
        path: the file; appears when it is complete.
        epsg: its coordinate system; None keeps the source's.
        jpeg_quality: 1 to 100 for JPEG with a mask instead of the alpha band; None is lossless.

    Raises:
        InputError: if the raster cannot be read or brought to the coordinate system.
        OrthoSwarmError: if the disk is full.
    """
    import rasterio
    from rasterio.errors import CRSError, RasterioError
    from rasterio.vrt import WarpedVRT

    lossless = {"compress": "DEFLATE", "predictor": 2}
    settings: dict[str, Any] = {
        "driver": "COG",
        "bigtiff": "IF_SAFER",  # by default GDAL never makes one of a compressed picture, and fails at 4 GB
        "overview_resampling": "AVERAGE",
        **(lossless if jpeg_quality is None else {"compress": "JPEG", "quality": jpeg_quality}),
    }
    try:
        with rasterio.open(source) as raster, atomic_write(path) as part, rasterio.Env(CHECK_DISK_FREE_SPACE=True):
            crs = raster.crs if epsg is None else rasterio.crs.CRS.from_epsg(epsg)
            if crs == raster.crs:
                copy_dataset(raster, part, **settings)
                return
            with WarpedVRT(raster, crs=crs, resampling=rasterio.enums.Resampling.cubic, warp_mem_limit=64) as vrt:
                _copy_warped(vrt, part, settings, raster.tags().get(_DATE))
    except (CRSError, RasterioError) as error:
        raise InputError(f"{source.name} cannot be written as asked ({_first_line(error)}); check --epsg") from None


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


def _copy_warped(vrt: Any, part: Path, settings: dict[str, Any], date: str | None) -> None:
    """Copy a warped raster, which has none of its source's tags, by way of a description that has."""
    import rasterio

    with tempfile.TemporaryDirectory(dir=part.parent, prefix=".warped") as folder:
        described = Path(folder) / "warped.vrt"
        copy_dataset(vrt, described, driver="VRT")
        with rasterio.open(described, "r+") as file:
            file.update_tags(TIFFTAG_SOFTWARE=software(), **({_DATE: date} if date else {}))
        with rasterio.open(described) as file:
            copy_dataset(file, part, **settings)
