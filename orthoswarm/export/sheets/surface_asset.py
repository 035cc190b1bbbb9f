"""The surface model of a map as an asset of its STAC item or collection."""

import json
import os
from pathlib import Path
from typing import Any, Final

SURFACE: Final = "dsm.tif"
"""Its name in a pack, whatever the run was asked to write."""
_BANDS: Final = (("height", "m"), ("sigma", "m"), ("pairs", None))


def surface_path(folder: Path) -> Path | None:
    """The surface model in a map's folder; None if its run made none, or wrote it elsewhere."""
    report = folder / "report.json"
    if not report.exists():
        return None
    made = json.loads(report.read_text(encoding="utf-8")).get("surface")
    names = [Path(made["file"]).name, SURFACE] if made else []
    return next((folder / name for name in names if (folder / name).is_file()), None)


def surface_assets(folder: Path, document: Path) -> dict[str, Any]:
    """The asset under its key; empty if the folder holds no surface model.

    Args:
        folder: of the map. document: the file that names the asset, relatively to itself.
    """
    import rasterio

    path = surface_path(folder)
    if path is None:
        return {}
    with rasterio.open(path) as raster:
        bands = [
            {"name": name, "data_type": "float32", "nodata": raster.nodata, "spatial_resolution": float(raster.res[0]),
             **({"unit": unit} if unit else {})}
            for name, unit in _BANDS
        ]  # fmt: skip
        described = [
            {"name": name, "description": text} for (name, _), text in zip(_BANDS, raster.descriptions, strict=True)
        ]
        return {
            "surface": {
                "href": Path(os.path.relpath(path, document.parent)).as_posix(),
                "type": "image/tiff; application=geotiff; profile=cloud-optimized",
                "roles": ["data"], "title": "Surface model", "proj:code": f"EPSG:{raster.crs.to_epsg()}",
                "proj:shape": [raster.height, raster.width], "proj:transform": list(raster.transform)[:6],
                "raster:bands": bands, "bands": described,
            }
        }  # fmt: skip
