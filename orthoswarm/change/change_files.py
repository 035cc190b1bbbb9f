"""The files of a change map: change.tif, change.gpkg, change.json; and the map as a picture over another."""

import io
import json
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm.change.change_map import ChangeMap
from orthoswarm.change.changed_objects import ChangedObject
from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.cog import copy_dataset, software
from orthoswarm.export.footprint_layer import append_polygons, gpkg_file
from orthoswarm.export.product_files import write_json
from orthoswarm.model.arrays import Bytes
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid

RASTER, OBJECTS, FIGURES = "change.tif", "change.gpkg", "change.json"
FILES: Final = (RASTER, OBJECTS, FIGURES)
_LARGEST: Final = 10
_LISTED: Final = 500
_COG: Final = {"driver": "COG", "compress": "deflate", "overview_resampling": "average", "blocksize": "256"}
_COLUMNS: Final = {
    "area_m2": np.float64, "probability": np.float64, "kind": np.object_, "photos": np.object_,
}  # fmt: skip
_LOW, _HIGH = (255, 176, 0), (214, 0, 84)  # colours of what is just likely enough, and of what is certain
_HIDDEN: Final = (90, 100, 115, 110)  # where nothing can be said
_ALPHA: Final = 175
_OVERLAY_PX: Final = 2048


def write_change(
    folder: Path, found: ChangeMap, objects: Sequence[ChangedObject], basemap: str, warnings: Sequence[str]
) -> dict[str, Any]:
    """Write the three files and return the figures of `--json`.

    Args:
        folder: made if absent. found, objects: the map and its objects. basemap: its name. warnings: for the user.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    from shapely import MultiPolygon

    folder.mkdir(parents=True, exist_ok=True)
    _write_raster(folder / RASTER, found)
    rows = [
        {"area_m2": one.area_m2, "probability": round(one.probability, 3), "kind": one.kind,
         "photos": " ".join(image for _, image in one.photos)}
        for one in objects
    ]  # fmt: skip
    with gpkg_file(folder / OBJECTS) as part:
        shapes = np.array([MultiPolygon(getattr(one.outline, "geoms", [one.outline])) for one in objects], object)
        append_polygons(part, "change", shapes, rows=rows, columns=_COLUMNS, epsg=found.grid.epsg)
    figures = figures_of(found, objects) | {"basemap": basemap, "warnings": list(warnings)}
    write_json(folder / FIGURES, figures)
    return figures


def _write_raster(path: Path, found: ChangeMap) -> None:
    import rasterio

    profile = {
        "driver": "GTiff", "width": found.grid.width, "height": found.grid.height, "count": 1, "dtype": "uint8",
        "crs": f"EPSG:{found.grid.epsg}", "transform": found.grid.affine(), "tiled": True,
    }  # fmt: skip
    with atomic_write(path) as part, tempfile.TemporaryDirectory(dir=path.parent, prefix=".change") as scratch:
        plain = Path(scratch) / "plain.tif"  # overviews are made of a whole file
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
            with rasterio.open(plain, "w", **profile) as file:
                hidden = found.inside & ~found.visible  # masked, and not the 0 of what lies outside
                file.write(np.where(found.visible, found.probability, hidden).astype(np.uint8), 1)
                file.write_mask(found.visible)
                file.set_band_description(1, "probability that the ground changed, 0 to 255")
                file.update_tags(TIFFTAG_SOFTWARE=software())
            with rasterio.open(plain) as file:
                copy_dataset(file, part, **_COG)


def figures_of(found: ChangeMap, objects: Sequence[ChangedObject]) -> dict[str, Any]:
    """Shares and the list of objects, as JSON values; `largest` has the ten largest, `objects` more."""
    grid, visible = LocalGrid(found.grid.epsg), found.visible
    inside, seen = int(found.inside.sum()), int(visible.sum())
    changed = int((visible & (found.probability > 127)).sum())
    rows = []
    for one in objects[:_LISTED]:
        west, south, east, north = one.outline.bounds
        places = grid.to_geographic(np.array([[west, south], [east, north], one.place[:2]]))
        (least_lat, least_lon), (most_lat, most_lon), (lat, lon) = ([round(float(v), 7) for v in p] for p in places)
        rows.append({
            "area_m2": round(one.area_m2, 1), "probability": round(one.probability, 3), "kind": one.kind,
            "lat_deg": lat, "lon_deg": lon, "bounds": [least_lon, least_lat, most_lon, most_lat],
            "photos": [{"vehicle": vehicle, "image": image} for vehicle, image in one.photos],
        })  # fmt: skip
    return {
        "changed_share": changed / max(seen, 1),
        "not_visible_share": 1.0 - seen / max(inside, 1),
        "changed_m2": changed * found.grid.gsd_m**2,
        "area_m2": inside * found.grid.gsd_m**2,
        "cell_m": found.grid.gsd_m,
        "epsg": found.grid.epsg,
        "count": len(objects),
        "largest": rows[:_LARGEST],
        "objects": rows,
        "time": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
    }


def painted(chance: Bytes, visible: Bytes, inside: Bytes, threshold: float) -> Bytes:
    """Colours and opacity, uint8 (rows, columns, 4).

    Args:
        chance: 0 to 255. visible, inside: 0 where it cannot be said, and outside what was compared.
        threshold: probability from which ground is shown as changed.
    """
    share = np.clip((chance / 255.0 - threshold) / max(1.0 - threshold, 1e-3), 0.0, 1.0)[..., None]
    out = np.zeros((*chance.shape, 4), np.uint8)
    colors = np.array(_LOW) * (1.0 - share) + np.array(_HIGH) * share
    changed = (visible > 0) & (chance >= 255.0 * threshold)
    out[changed, :3], out[changed, 3] = colors[changed], _ALPHA
    out[(visible == 0) & (inside > 0)] = _HIDDEN
    return out


def change_overlay(folder: Path, threshold: float = 0.5) -> tuple[bytes, list[list[float]]]:
    """The change map of a folder as a PNG.

    Returns:
        The PNG, at most _OVERLAY_PX on its longer side; and the longitude and latitude of its corners in degrees: top
        left, top right, bottom right, bottom left.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    from PIL import Image

    picture, corners = overlay_pixels(folder, threshold)
    data = io.BytesIO()
    Image.fromarray(picture, "RGBA").save(data, "PNG")
    return data.getvalue(), corners


def overlay_pixels(folder: Path, threshold: float, bounds: tuple[float, ...] | None = None,
                   size: tuple[int, int] | None = None) -> tuple[Bytes, list[list[float]]]:  # fmt: skip
    """The pixels of `change_overlay`, of a window (west, south, east, north) in (rows, columns) if these are given."""
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.windows import from_bounds

    try:
        with rasterio.open(folder / RASTER) as file:
            step = max(1.0, max(file.shape) / _OVERLAY_PX)
            shape = size or tuple(max(1, round(side / step)) for side in file.shape)
            window = None if bounds is None else from_bounds(*bounds, file.transform)
            how: dict[str, Any] = {"out_shape": shape, "window": window, "resampling": Resampling.nearest}
            chance = file.read(1, boundless=window is not None, fill_value=0, **how)
            # Outside the flight there is nothing to say either; the band's value tells it from ground that is hidden.
            visible = file.read_masks(1, boundless=window is not None, **how)
            box, epsg = file.bounds, file.crs.to_epsg()
    except rasterio.errors.RasterioError as error:
        raise InputError(f"{RASTER} of {folder} cannot be read ({error}); run `orthoswarm change` again") from None
    ring = [[box.left, box.top], [box.right, box.top], [box.right, box.bottom], [box.left, box.bottom]]
    corners = [[float(lon), float(lat)] for lat, lon in LocalGrid(epsg).to_geographic(ring)]
    return painted(chance, visible, ((visible == 0) & (chance > 0)).astype(np.uint8), threshold), corners


def figures_in(folder: Path) -> dict[str, Any] | None:
    """The figures of a folder's change map; None if it has none, or another version's."""
    try:
        figures = json.loads((folder / FIGURES).read_text(encoding="utf-8"))
        return figures if isinstance(figures, dict) and "objects" in figures else None
    except (OSError, ValueError):
        return None
