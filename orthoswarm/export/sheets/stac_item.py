"""A STAC item (STAC 1.1.0, extensions projection 2.0.0 and raster 1.1.0) beside the COG that it describes."""

import json
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np
from numpy.typing import ArrayLike

from orthoswarm.export.product_files import read_frames, write_json
from orthoswarm.export.sheets.stated_accuracy import stated_accuracy
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import GroundGrid, LocalGrid

EXTENSIONS: Final = [
    "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
    "https://stac-extensions.github.io/raster/v1.1.0/schema.json",
]
_COG: Final = "image/tiff; application=geotiff; profile=cloud-optimized"
_COLOURS: Final = ("red", "green", "blue", "alpha")
SURFACE: Final = "dsm.tif"  # its name in a pack, whatever the run was asked to write
_SURFACE_BANDS: Final = (("height", "m"), ("sigma", "m"), ("pairs", None))


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
    import rasterio
    from rasterio.errors import RasterioError

    source = copy_of or cog
    try:
        with rasterio.open(cog) as raster:
            grid, bands = GroundGrid.of_raster(raster), int(raster.count)
    except RasterioError as error:
        raise InputError(f"{cog} cannot be read ({error}); make the map again") from None
    item = raster_item(
        grid, identifier=f"{source.resolve().parent.name or 'map'}-{source.stem}", href=_relative(cog, path),
        title="Orthoimage", properties=_properties(source), asset="orthoimage", bands=bands,
    )  # fmt: skip
    item["assets"] |= surface_assets(cog.parent, path) | _change_asset(cog.parent, path)
    write_json(path, item)


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


def _relative(file: Path, document: Path) -> str:
    """How a document names a file, relatively to itself, as a URL."""
    return quote(Path(os.path.relpath(file, document.parent)).as_posix())


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


def time_span(folder: Path) -> str:
    """First and last minute of a map's pictures, as "2026-05-28 20:26 to 2026-05-28 20:31 UTC"; empty if not known."""
    first, last = (None if time is None else time[:16].replace("T", " ") for time in picture_times(folder))
    return "" if first is None else f"{first} to {last} UTC"


def _change_asset(folder: Path, document: Path) -> dict[str, Any]:
    """The asset of a change map beside the orthoimage; empty without one."""
    path = folder / "change.tif"
    if not path.is_file():
        return {}
    title = "Probability that the ground changed since the pre-disaster map, 0 to 255"
    return {"change": {"href": _relative(path, document), "type": _COG, "roles": ["data"], "title": title}}


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
            for name, unit in _SURFACE_BANDS
        ]  # fmt: skip
        described = [
            {"name": name, "description": text}
            for (name, _), text in zip(_SURFACE_BANDS, raster.descriptions, strict=True)
        ]
        return {
            "surface": {
                "href": _relative(path, document),
                "type": _COG, "roles": ["data"], "title": "Surface model", "proj:code": f"EPSG:{raster.crs.to_epsg()}",
                "proj:shape": [raster.height, raster.width], "proj:transform": list(raster.transform)[:6],
                "raster:bands": bands, "bands": described,
            }
        }  # fmt: skip


# -- outlines in GeoJSON (RFC 7946) ------------------------------------------------------------------------------------

_DECIMALS = 8  # of degrees: a millimetre


def outline(lat_lon: ArrayLike) -> dict[str, Any]:
    """The members `geometry` and `bbox` of a feature.

    Args:
        lat_lon: a ring in degrees, (K, 2), closed or not, less than 180 degrees wide.

    Returns:
        A Polygon, or a MultiPolygon of the parts on either side of the meridian of 180 degrees (RFC 7946, 3.1.9), with
        exterior rings counterclockwise; and west, south, east, north, where west > east says the same (5.2).
    """
    import shapely

    ring = np.asarray(lat_lon, np.float64)[:, ::-1].copy()
    if np.ptp(ring[:, 0]) > 180.0:
        ring[ring[:, 0] < 0.0, 0] += 360.0
    whole = shapely.Polygon(ring)
    west, south, east, north = (float(v) for v in np.r_[ring.min(0), ring.max(0)])
    bbox = [round(v, _DECIMALS) for v in (west, south, _turned(east), north)]
    if east <= 180.0:
        return {"geometry": {"type": "Polygon", "coordinates": [_ring(whole, 0.0)]}, "bbox": bbox}
    sides = [
        [_ring(part, shift)]
        for shift, (least, most) in ((0.0, (west - 1.0, 180.0)), (-360.0, (180.0, east + 1.0)))
        for part in shapely.get_parts(shapely.intersection(whole, shapely.box(least, south - 1.0, most, north + 1.0)))
        if part.geom_type == "Polygon" and part.area > 0.0
    ]
    return {"geometry": {"type": "MultiPolygon", "coordinates": sides}, "bbox": bbox}


def joined_bbox(boxes: Sequence[Sequence[float]]) -> list[float]:
    """The bbox of all of them, west > east where it lies on the meridian of 180 degrees.

    boxes: at least one, each west, south, east, north in degrees, all within 180 degrees of the first one.
    """
    west, south, east, north = np.array(boxes, np.float64).T
    east = east + np.where(east < west, 360.0, 0.0)
    turns = 360.0 * np.round((west[0] - west) / 360.0)
    least, most = float((west + turns).min()), float((east + turns).max())
    return [_turned(least), float(south.min()), _turned(most), float(north.max())]


def _turned(lon: float) -> float:
    """A longitude from -180 to 180 degrees."""
    return lon - 360.0 if lon > 180.0 else lon + 360.0 if lon < -180.0 else lon


def _ring(polygon: Any, shift: float) -> list[list[float]]:
    import shapely

    points = np.array(shapely.geometry.polygon.orient(polygon).exterior.coords) + np.array([shift, 0.0])
    return [[float(v) for v in point] for point in np.round(points, _DECIMALS)]
