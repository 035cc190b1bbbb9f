"""A STAC collection (1.1.0) of a map in tiles: an item for each tile and one for each vehicle.

All links are relative, so that the folder may be moved, copied or uploaded as it is (a self-contained catalog).
"""

import json
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from orthoswarm.export.camera_folders import camera_of
from orthoswarm.export.catalog.tiled_raster import COLLECTION, FOLDER, VEHICLES, RasterTile, tiles_of
from orthoswarm.export.product_files import read_frames, write_json
from orthoswarm.export.sheets.stac_item import EXTENSIONS, joined_bbox, outline, raster_item, surface_assets
from orthoswarm.export.sheets.stated_accuracy import stated_accuracy
from orthoswarm.model.arrays import Array
from orthoswarm.model.geo import LocalGrid
from orthoswarm.mosaic.footprint import footprint

_TITLES = {"realtime.tif": "Real-time picture", "coarse.tif": "Coarse orthoimage", "orthoimage.tif": "Orthoimage"}
_LEAST_M = 0.1  # half the width of an outline that would have none


@dataclass(frozen=True, slots=True)
class _Picture:
    """A placed picture: vehicle, time (ISO 8601) or None, ring float64 (K, 2) of what it sees on the grid."""

    vehicle: str
    time: str | None
    ring: Array


def write_collection(folder: Path, made: str) -> int:
    """Write the collection of a map's folder, if rasters of it are in tiles.

    Args:
        folder: of the map, with frames.jsonl and report.json. made: when the map was made (ISO 8601), for pictures
            without a time.

    Returns:
        Number of items; 0 where no raster is in tiles, and nothing is written.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    rasters = {name: tiles for name in _TITLES if (tiles := tiles_of(folder, name))}
    if not rasters:
        return 0
    pictures = _placed_pictures(folder)
    top, name = folder / FOLDER, _slug(folder.resolve().name or "map")
    items: list[tuple[str, dict[str, Any]]] = []
    for raster, tiles in rasters.items():
        for tile in tiles:
            stem, part = Path(raster).stem, Path(tile.name).stem
            item = _tile_item(tile, f"{name}-{stem}-{part}", _TITLES[raster], pictures, made)
            items.append((f"{stem}/{part}.json", item))
    epsg = next(iter(rasters.values()))[0].grid.epsg
    items += _vehicle_items(pictures, epsg, name, made)
    for where, item in items:
        up = "../" * where.count("/")
        item["collection"] = name
        item["links"] = [
            {"rel": rel, "href": f"{up}{COLLECTION}", "type": "application/json"}
            for rel in ("root", "parent", "collection")
        ]
        write_json(top / where, item)
    write_json(top / COLLECTION, _collection(folder, name, items, list(rasters)))
    return len(items)


def _placed_pictures(folder: Path) -> list[_Picture]:
    """The pictures of frames.jsonl that see ground, with the outlines of footprints.gpkg."""
    level = float(json.loads((folder / "report.json").read_text(encoding="utf-8")).get("ground_z_m") or 0.0)
    pictures = []
    for row in read_frames(folder / "frames.jsonl"):
        if "focal_px" in row.get("camera", {}):
            ring = footprint(camera_of(row), level, inset_px=-0.5)
            if len(ring) >= 3:
                pictures.append(_Picture(str(row["vehicle"]), row.get("time"), ring))
    return pictures


def _tile_item(
    tile: RasterTile, identifier: str, title: str, pictures: Sequence[_Picture], made: str
) -> dict[str, Any]:
    west, south, east, north = tile.grid.bounds
    seen = [
        p for p in pictures
        if (p.ring.max(0) >= (west, south)).all() and (p.ring.min(0) <= (east, north)).all()
    ]  # fmt: skip
    properties = {"title": f"{title}, {Path(tile.name).stem}", **_times(seen or pictures, made)}
    return raster_item(
        tile.grid, identifier=identifier, href=tile.name, title=title, properties=properties,
        asset=Path(title.lower().replace(" ", "-")).name,
    )  # fmt: skip


def _vehicle_items(pictures: Sequence[_Picture], epsg: int, name: str, made: str) -> list[tuple[str, dict[str, Any]]]:
    """An item for each vehicle, with the hull of what its pictures see."""
    import shapely

    by_vehicle: defaultdict[str, list[_Picture]] = defaultdict(list)
    for picture in pictures:
        by_vehicle[picture.vehicle].append(picture)
    grid, items, used = LocalGrid(epsg), [], set[str]()
    for vehicle in sorted(by_vehicle):
        own = by_vehicle[vehicle]
        hull = shapely.convex_hull(shapely.multipoints(np.concatenate([p.ring for p in own])))
        around = hull if hull.geom_type == "Polygon" else shapely.buffer(hull, _LEAST_M)
        slug = _slug(vehicle)
        while slug in used:
            slug += "_"
        used.add(slug)
        assets = {
            "frames": {"href": "../../frames.jsonl", "type": "application/jsonl", "roles": ["metadata"],
                       "title": "Where each picture lies"},
            "footprints": {"href": "../../footprints.gpkg", "type": "application/geopackage+sqlite3",
                           "roles": ["metadata"], "title": "What each picture sees"},
        }  # fmt: skip
        item: dict[str, Any] = {
            "type": "Feature", "stac_version": "1.1.0", "stac_extensions": [], "id": f"{name}-vehicle-{slug}",
            **outline(grid.to_geographic(np.array(around.exterior.coords))),
            "properties": {"title": f"Pictures of {vehicle}", "orthoswarm:vehicle": vehicle,
                           "orthoswarm:pictures": len(own), **_times(own, made)},
            "assets": assets,
        }  # fmt: skip
        items.append((f"{VEHICLES}/{slug}.json", item))
    return items


def _times(pictures: Sequence[_Picture], made: str) -> dict[str, str]:
    times = sorted(p.time for p in pictures if p.time)
    if not times:
        return {"datetime": made}
    return {"datetime": times[0], "start_datetime": times[0], "end_datetime": times[-1]}


def _collection(
    folder: Path, name: str, items: Sequence[tuple[str, Mapping[str, Any]]], rasters: Sequence[str]
) -> dict[str, Any]:
    times = [item["properties"] for _, item in items]
    starts = sorted(p.get("start_datetime", p["datetime"]) for p in times)
    ends = sorted(p.get("end_datetime", p["datetime"]) for p in times)
    stated = stated_accuracy(folder)
    assets = {
        Path(raster).stem: {"href": f"../{Path(raster).stem}.vrt", "type": "application/x-ogc-vrt", "roles": ["data"],
                            "title": f"{_TITLES[raster]}, all tiles as one raster"}
        for raster in rasters
    }  # fmt: skip
    assets["report"] = {
        "href": "../report.html", "type": "text/html", "roles": ["metadata"], "title": "The map's accuracy",
    }  # fmt: skip
    assets |= (surface := surface_assets(folder, folder / FOLDER / COLLECTION))
    links = [{"rel": "root", "href": f"./{COLLECTION}", "type": "application/json"}]
    links += [{"rel": "item", "href": f"./{where}", "type": "application/geo+json"} for where, _ in items]
    return {
        "type": "Collection", "stac_version": "1.1.0", "stac_extensions": EXTENSIONS if surface else [], "id": name,
        "title": "Orthoimage of drone photos",
        "description": stated.sentence if stated else "An orthoimage of drone photos in tiles.",
        "license": "other",
        "extent": {
            "spatial": {"bbox": [joined_bbox([item["bbox"] for _, item in items])]},
            "temporal": {"interval": [[starts[0], ends[-1]]]},
        },
        "links": links, "assets": assets,
    }  # fmt: skip


def _slug(name: str) -> str:
    """A name of letters, digits, dots and hyphens, as file names and ids of STAC should be."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "map"
