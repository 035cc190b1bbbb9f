"""Photos of which nothing tells where they were taken, as one picture without coordinates."""

import shutil
import warnings
from pathlib import Path
from typing import Any, Final

from orthoswarm.batch.run_state import ORTHOIMAGE, PRODUCTS, UNREFERENCED
from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.catalog.tiled_raster import remove_product
from orthoswarm.export.product_files import write_json

PART: Final = "unreferenced.part"  # folder of a run whose products have coordinates that mean nothing
_KEPT: Final = ("frames", "left_out", "warnings", "wall_s", "cpu_s", "peak_rss_mb", "stages")  # of report.json
_HEADLINE: Final = (
    f"{UNREFERENCED} is a picture, not a map: nothing tells where the photos were taken, so it has no place, no scale "
    "and no north"
)


def keep_picture(out: Path, report: dict[str, Any]) -> dict[str, Any]:
    """Make `UNREFERENCED` and report.json in a folder out of a run's products in its folder `PART`, which goes.

    report: of that run. Returns what is in report.json.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    for name in PRODUCTS:  # of an earlier run, with positions
        remove_product(out, name)
    with atomic_write(out / UNREFERENCED) as part:
        _without_coordinates(out / PART / ORTHOIMAGE, part)
    kept = {name: report[name] for name in _KEPT} | {"headline": _HEADLINE}
    write_json(out / "report.json", kept)
    shutil.rmtree(out / PART, ignore_errors=True)
    return kept


def _without_coordinates(raster: Path, to: Path) -> None:
    import rasterio
    from rasterio.enums import ColorInterp, Resampling
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings(), rasterio.open(raster) as source:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        profile = source.profile | {"crs": None, "bigtiff": "if_safer"}
        profile.pop("transform")
        with rasterio.open(to, "w", **profile) as picture:
            picture.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
            for _, window in source.block_windows(1):
                picture.write(source.read(window=window), window=window)
            picture.build_overviews(source.overviews(1), Resampling.average)
