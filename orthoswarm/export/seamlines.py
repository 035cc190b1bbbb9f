"""Which picture shows which ground, as polygons in a GeoPackage: `seamlines.gpkg`."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.export.footprint_layer import Column, append_polygons, gpkg_file

_COLUMNS: dict[str, Column] = {
    "image": np.object_,
    "vehicle": np.object_,
    "time": np.datetime64,
    "stage": np.object_,
    "sigma_m": np.float64,
    "area_m2": np.float64,
}


def write_seamlines(path: Path, canvas: Canvas, describe: Sequence[Callable[[], Mapping[str, Any]]]) -> None:
    """Write a multipolygon for each picture that the orthoimage shows.

    Args:
        path: the GeoPackage; appears when it is complete.
        canvas: rendered, with plane "frame".
        describe: for each frame of the rendering what is known about it, by the columns `image`, `vehicle`, `time`,
            `stage` and `sigma_m`; called for frames that are shown.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    import shapely

    parts: dict[int, list[Any]] = defaultdict(list)
    for index, polygon in _tile_polygons(canvas):
        parts[index].append(polygon)
    frames = sorted(parts)
    shapes = np.array([shapely.multipolygons(_pieces(shapely.union_all(parts[i]))) for i in frames], dtype=object)
    rows = [{**describe[i](), "area_m2": float(shapely.area(shape))} for i, shape in zip(frames, shapes)]
    with gpkg_file(path) as part:
        append_polygons(part, "seamlines", shapes, rows=rows, columns=_COLUMNS, epsg=canvas.grid.epsg)


def _pieces(shape: Any) -> list[Any]:
    import shapely

    return [piece for piece in shapely.get_parts(shape) if shapely.get_type_id(piece) == 3]


def _tile_polygons(canvas: Canvas) -> Iterator[tuple[int, Any]]:
    """Frame index and polygon for each connected piece of a tile."""
    import shapely
    from rasterio.features import shapes
    from rasterio.transform import from_origin

    grid, t = canvas.grid, canvas.tile_px
    for row, col in sorted(canvas.changed_since(0)):
        labels: NDArray[np.int32] = canvas.read_plane(
            row * t, min(grid.height, (row + 1) * t), col * t, min(grid.width, (col + 1) * t)
        )
        left, top = grid.west + col * t * grid.gsd_m, grid.north - row * t * grid.gsd_m
        corner = from_origin(left, top, grid.gsd_m, grid.gsd_m)
        for shape, value in shapes(np.ascontiguousarray(labels), mask=labels > 0, transform=corner):
            shell, *holes = shape["coordinates"]
            yield int(value) - 1, shapely.Polygon(shell, holes)
