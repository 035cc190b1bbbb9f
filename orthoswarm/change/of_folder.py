"""The change of a finished map: reads its folder, compares, and writes the files."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import cv2

from orthoswarm.change.change_files import write_change
from orthoswarm.change.change_map import ComparedScene, map_change
from orthoswarm.change.changed_objects import find_objects
from orthoswarm.coverage.map_folder import MapFolder, read_map
from orthoswarm.coverage.view import View
from orthoswarm.export.catalog.tiled_raster import product_file
from orthoswarm.export.value_raster import GROUND, read_ground
from orthoswarm.model.arrays import Bytes
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.model.placement import Terrain
from orthoswarm.raster.basemap import Basemap
from orthoswarm.raster.picture_file import PictureError, read_gray, reduction
from orthoswarm.stores.addresses import path_of

WANT_M: Final = 2.0
_FINEST: Final = 0.7  # of a pixel on which structure is compared: pictures need not be finer


def change_of(
    folder: Path,
    out: Path,
    *,
    basemap: Path | None = None,
    want_m: float = WANT_M,
    threshold: float = 0.5,
    find: Callable[[str, str], Path | None] | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, of: None,
) -> dict[str, Any]:
    """Compare a finished map with the pre-disaster one, and write change.tif, change.gpkg and change.json.

    Args:
        folder: output of `orthoswarm mosaic`, or a workspace. out: where the files go.
        basemap: the pre-disaster map; None for the one that the pictures were laid on.
        want_m: side of a cell, metres. threshold: probability from which objects are listed.
        find: file of a picture by vehicle and name; None: where they were when the map was made.
        progress: called with what is done, how much, and of how much.

    Returns:
        The figures of `--json`, see change_files.figures_of.

    Raises:
        InputError: the folder holds no refined map, or the basemap cannot be used.
        OrthoSwarmError: the disk is full.
    """
    missing: set[str] = set()
    flown = read_map(folder)
    scene, warnings = scene_of(folder, flown, basemap=basemap, want_m=want_m, find=find, missing=missing)
    found = map_change(scene, want_m=want_m, progress=lambda done, of: progress("comparing", done, of))
    if missing:
        warnings.append(f"{len(missing)} pictures could not be read, the first is {min(missing)}")
    if not found.visible.any():
        warnings.append("nothing could be compared: the pictures are not where they were, or the map has no data here")
    objects = find_objects(found, flown.views, flown.ground_z_m, threshold)
    return write_change(out, found, objects, scene.basemap.path.name, warnings)


def scene_of(
    folder: Path,
    flown: MapFolder,
    *,
    basemap: Path | None = None,
    want_m: float = WANT_M,
    find: Callable[[str, str], Path | None] | None = None,
    missing: set[str] | None = None,
) -> tuple[ComparedScene, list[str]]:
    """What is compared, and warnings; arguments and errors as of `change_of`, `missing` takes pictures not readable."""
    import rasterio

    orthoimage = product_file(folder, "orthoimage.tif")
    if orthoimage is None:
        raise InputError(f"{folder} holds no orthoimage.tif; make the map with `orthoswarm mosaic` first")
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    if basemap is None and not report.get("basemap"):
        raise InputError("the map was made without a basemap; give the pre-disaster map with --basemap")
    with rasterio.open(orthoimage) as file:
        near = BoundingBox(*file.bounds)
    before = Basemap.open(path_of(str(report["basemap"])) if basemap is None else basemap, flown.epsg, near)
    warnings = list(flown.warnings)
    if any(not view.placed for view in flown.views) or not report.get("basemap"):
        warnings.append("pictures that were not laid on the map may lie metres beside it: what differs there may not")
    ground = folder / GROUND
    terrain = read_ground(ground) if ground.exists() else Terrain.flat(flown.ground_z_m)

    unread = set() if missing is None else missing
    pixel_m = 0.5 * max(want_m, before.native_gsd_m)

    def read(view: View) -> Bytes | None:
        """A picture as soft as the pixels on which it is drawn."""
        path = find(view.vehicle, view.image) if find else flown.root and flown.root / view.image
        lens, gsd = view.lens, (float(view.position[2]) - flown.ground_z_m) / view.lens.focal_px
        wanted = round(lens.width * min(1.0, gsd / (_FINEST * pixel_m)))
        try:
            if path is None:
                raise PictureError("it is not there")
            picture = read_gray(path, reduction(lens.width, lens.height, max(wanted, 64)))
        except (PictureError, ValueError):
            unread.add(view.image)
            return None
        sigma = 0.35 * pixel_m / max(gsd * lens.width / picture.shape[1], 1e-6)
        return picture if sigma < 0.6 else cv2.GaussianBlur(picture, (0, 0), sigma)

    east, north = report.get("map_lean_m_per_m") or (0.0, 0.0)
    lean = (float(east), float(north))
    scene = ComparedScene(
        views=flown.views, terrain=terrain, basemap=before, orthoimage=orthoimage, read=read, lean=lean
    )
    return scene, warnings
