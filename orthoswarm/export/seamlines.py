"""Which picture shows which ground, as polygons in a GeoPackage: `seamlines.gpkg`."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.canvas.tile_store import Key
from orthoswarm.export.footprint_layer import Column, append_polygons, gpkg_file
from orthoswarm.model.task_runner import Run, serial

_COLUMNS: dict[str, Column] = {
    "image": np.object_,
    "vehicle": np.object_,
    "time": np.datetime64,
    "stage": np.object_,
    "sigma_m": np.float64,
    "area_m2": np.float64,
}
_AT_ONCE = 64
"""Frames that one task joins; it changes the speed, not the result."""


def write_seamlines(
    path: Path, canvas: Canvas, describe: Sequence[Callable[[], Mapping[str, Any]]], *, run: Run = serial
) -> None:
    """Write a multipolygon for each picture that the orthoimage shows.

    Args:
        path: the GeoPackage; appears when it is complete.
        canvas: rendered, with plane "frame".
        describe: for each frame of the rendering what is known about it, by the columns `image`, `vehicle`, `time`,
            `stage` and `sigma_m`; called for frames that are shown.
        run: where tiles are outlined; other processes need the canvas's folder under the same path.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    import shapely

    parts: dict[int, list[bytes]] = defaultdict(list)
    for frames, outlines in run(partial(_tile_polygons, canvas.path), sorted(canvas.changed_since(0))):
        for index, outline in zip(frames, outlines, strict=True):
            parts[index].append(outline)
    frames = sorted(parts)
    some = [[parts[i] for i in frames[k : k + _AT_ONCE]] for k in range(0, len(frames), _AT_ONCE)]
    joined = [whole for several in run(_joined, some) for whole in several]
    shapes = np.array([shapely.from_wkb(whole) for whole in joined], dtype=object)
    rows = [{**describe[i](), "area_m2": float(shapely.area(shape))} for i, shape in zip(frames, shapes)]
    with gpkg_file(path) as part:
        append_polygons(part, "seamlines", shapes, rows=rows, columns=_COLUMNS, epsg=canvas.grid.epsg)


def _joined(frames: Sequence[Sequence[bytes]]) -> list[bytes]:
    """For each of several frames the multipolygon (WKB) of its pieces (WKB) in all tiles."""
    import shapely

    whole = [shapely.get_parts(shapely.union_all(shapely.from_wkb(pieces))) for pieces in frames]
    return [shapely.to_wkb(shapely.multipolygons(own[shapely.get_type_id(own) == 3])) for own in whole]


def _tile_polygons(path: Path, key: Key) -> tuple[list[int], list[bytes]]:
    """Frame index and polygon (WKB) for each connected piece of a tile of the canvas in a folder."""
    import shapely
    from rasterio.features import shapes
    from rasterio.transform import from_origin

    row, col = key
    with Canvas.open(path, writable=False) as canvas:
        grid, t = canvas.grid, canvas.tile_px
        labels: NDArray[np.int32] = canvas.read_plane(
            row * t, min(grid.height, (row + 1) * t), col * t, min(grid.width, (col + 1) * t)
        )
    left, top = grid.west + col * t * grid.gsd_m, grid.north - row * t * grid.gsd_m
    corner = from_origin(left, top, grid.gsd_m, grid.gsd_m)
    frames, polygons = [], []
    for shape, value in shapes(np.ascontiguousarray(labels), mask=labels > 0, transform=corner):
        shell, *holes = shape["coordinates"]
        frames.append(int(value) - 1)
        polygons.append(shapely.Polygon(shell, holes))
    return frames, list(shapely.to_wkb(np.array(polygons, dtype=object))) if polygons else []
