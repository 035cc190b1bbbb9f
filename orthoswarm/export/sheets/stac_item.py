"""A STAC item (STAC 1.1.0, extensions projection 2.0.0 and raster 1.1.0) beside the COG that it describes."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.product_files import read_frames
from orthoswarm.export.sheets.geojson_outline import outline
from orthoswarm.export.sheets.stated_accuracy import stated_accuracy
from orthoswarm.export.sheets.surface_asset import surface_assets
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import GroundGrid, LocalGrid

EXTENSIONS: Final = [
    "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
    "https://stac-extensions.github.io/raster/v1.1.0/schema.json",
]
_COG: Final = "image/tiff; application=geotiff; profile=cloud-optimized"
_COLOURS: Final = ("red", "green", "blue", "alpha")


def write_stac_item(cog: Path, path: Path, *, copy_of: Path | None = None) -> None:
    """Write the item of an orthoimage.

    Time is that of its pictures (`frames.jsonl` beside it), accuracy what `report.json` beside it states. A surface
    model that the same run left beside it is a second asset.

    Args:
        cog: the orthoimage. path: the item, best in the same folder: it names the COG relatively to itself.
        copy_of: the map's raster of which `cog` is a copy in another folder; its map gives name, time and accuracy.

    Raises:
        InputError: the COG cannot be read.
        OrthoSwarmError: the disk is full.
    """
    import os

    import rasterio
    from rasterio.errors import RasterioError

    try:
        with rasterio.open(cog) as raster:
            grid = GroundGrid(
                epsg=int(raster.crs.to_epsg()), west=float(raster.bounds.left), north=float(raster.bounds.top),
                gsd_m=float(raster.res[0]), width=int(raster.width), height=int(raster.height),
            )  # fmt: skip
            bands = int(raster.count)
    except RasterioError as error:
        raise InputError(f"{cog} cannot be read ({error}); make the map again") from None
    item = raster_item(
        grid, identifier=_identifier(copy_of or cog), href=Path(os.path.relpath(cog, path.parent)).as_posix(),
        title="Orthoimage", properties=_properties(copy_of or cog), asset="orthoimage", bands=bands,
    )  # fmt: skip
    item["assets"] |= surface_assets(cog.parent, path)
    with atomic_write(path) as part:
        part.write_text(json.dumps(item, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def raster_item(
    grid: GroundGrid, *, identifier: str, href: str, title: str, properties: Mapping[str, Any], asset: str,
    bands: int = 4,
) -> dict[str, Any]:  # fmt: skip
    """The item of a COG, without links.

    Args:
        grid: where it lies. identifier: of the item. href: of the COG, relative to the item.
        title: of the asset. properties: of the item, times among them. asset: its key. bands: how many the COG has.
    """
    west, south, east, north = grid.bounds
    ring = np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])
    described = {
        "href": href, "type": _COG, "roles": ["data"],
        "title": title, "proj:shape": [grid.height, grid.width], "proj:transform": list(grid.affine()),
        "raster:bands": [
            {"name": name, "data_type": "uint8", "spatial_resolution": grid.gsd_m, "sampling": "area"}
            for name in _COLOURS[:bands]
        ],
        "bands": [{"name": name} for name in _COLOURS[:bands]],
    }  # fmt: skip
    return {
        "type": "Feature", "stac_version": "1.1.0", "stac_extensions": EXTENSIONS, "id": identifier,
        **outline(LocalGrid(grid.epsg).to_geographic(ring)),
        "properties": {**properties, "proj:code": f"EPSG:{grid.epsg}", "gsd": grid.gsd_m},
        "links": [], "assets": {asset: described},
    }  # fmt: skip


def _identifier(cog: Path) -> str:
    return f"{cog.resolve().parent.name or 'map'}-{cog.stem}"


def _properties(cog: Path) -> dict[str, Any]:
    """Time, platforms and accuracy."""
    first, last = picture_times(cog.parent)
    made = datetime.fromtimestamp(cog.stat().st_mtime, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    properties: dict[str, Any] = {"title": "Orthoimage", "created": made, "datetime": None}
    if first is None or last is None:
        properties["datetime"] = made
    else:
        properties |= {"datetime": first, "start_datetime": first, "end_datetime": last}
    stated = stated_accuracy(cog.parent, cog.stem)
    if stated is not None:
        properties["description"] = stated.sentence
        properties |= stated.values
    return properties


def picture_times(folder: Path) -> tuple[str | None, str | None]:
    """First and last moment of a map's pictures (ISO 8601, UTC); None where they say none."""
    lines = folder / "frames.jsonl"
    rows: list[Mapping[str, Any]] = list(read_frames(lines)) if lines.exists() else []
    times = sorted(str(row["time"]) for row in rows if row.get("time"))
    return (times[0], times[-1]) if times else (None, None)
