"""Polygons in GeoPackages, for QGIS: footprints of frames, and which picture shows which ground."""

import contextlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.canvas.tile_store import Key
from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.model.arrays import Array, Ints
from orthoswarm.model.task_runner import Run, serial

Feature = tuple[Mapping[str, Any], Array]  # what is known about a frame, and its outline

Column = type[np.generic]
"""np.object_ for text, np.float64 for numbers, np.datetime64 for times (ISO 8601, UTC; kept to a millisecond)."""
_FRAME: dict[str, Column] = {
    "image": np.object_, "vehicle": np.object_, "time": np.datetime64, "stage": np.object_,
}  # fmt: skip
_FOOTPRINT = {**_FRAME, "fov_deg": np.float64, "sigma_m": np.float64}
_SEAMLINE = {**_FRAME, "sigma_m": np.float64, "area_m2": np.float64}
_AT_ONCE = 4096
_UTC = 100  # GDAL's number of the time zone


def write_footprints(path: Path, features: Iterable[Feature], epsg: int) -> None:
    """Write polygons with the attributes of their frames, some thousands at a time.

    Args:
        path: the GeoPackage; appears when it is complete.
        features: values by the names of columns (those of frames.jsonl), and float64 (K, 2) rings on the ground, not
            closed; an empty ring gives no feature. epsg: their grid.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    shown = (feature for feature in features if len(feature[1]) >= 3)
    with gpkg_file(path) as part:
        batch = list(islice(shown, _AT_ONCE))
        while batch or not part.exists():
            rows, rings = [row for row, _ in batch], [ring for _, ring in batch]
            append_polygons(part, "footprints", _polygons(rings), rows=rows, columns=_FOOTPRINT, epsg=epsg)
            batch = list(islice(shown, _AT_ONCE))


@contextlib.contextmanager
def gpkg_file(path: Path) -> Iterator[Path]:
    """A path to write a GeoPackage to, which appears under its name when it is complete.

    Raises OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    import pyogrio

    with atomic_write(path) as part:
        try:
            yield part
        except (pyogrio.errors.DataSourceError, RuntimeError) as error:
            # GDAL does not give the reason; if a small file can be written, the disk is not full and the folder is
            # writable.
            part.with_suffix(".probe").write_bytes(bytes(65536))
            part.with_suffix(".probe").unlink()
            raise OSError(0, str(error)) from None


def _polygons(rings: Sequence[Array]) -> NDArray[Any]:
    """Polygons of rings that are not closed."""
    import shapely

    if not rings:
        return np.empty(0, object)
    index = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    return np.asarray(shapely.polygons(shapely.linearrings(np.concatenate(rings), indices=index)))


def append_polygons(
    part: Path, layer: str, shapes: NDArray[Any], *, rows: Sequence[Mapping[str, Any]], columns: Mapping[str, Column],
    epsg: int,
) -> None:  # fmt: skip
    """Append (multi)polygons of shapely to a layer of a GeoPackage, made if absent.

    Args:
        part: the file. layer: its layer. shapes: one a feature. rows: values by column, None or absent for unknown.
        columns: names and kinds. epsg: the grid.
    """
    import pyogrio
    import shapely

    times = [name for name, kind in columns.items() if kind is np.datetime64]
    multi = len(shapes) > 0 and shapely.get_type_id(shapes[0]) == 6
    pyogrio.raw.write(
        str(part), shapely.to_wkb(shapes),
        [_column([row.get(name) for row in rows], kind) for name, kind in columns.items()], list(columns), layer=layer,
        driver="GPKG", geometry_type="MultiPolygon" if multi else "Polygon", crs=f"EPSG:{epsg}", append=part.exists(),
        gdal_tz_offsets={name: np.full(len(rows), _UTC) for name in times},
    )  # fmt: skip


def _column(values: list[Any], kind: type[np.generic]) -> NDArray[Any]:
    if kind is np.float64:
        return np.array([np.nan if v is None else v for v in values], np.float64)
    if kind is np.datetime64:
        return np.array([v.removesuffix("Z") if v else "NaT" for v in values], "datetime64[ms]")
    column = np.empty(len(values), object)
    column[:] = values
    return column


_JOINED_AT_ONCE = 64  # frames that one task joins; it changes the speed, not the result
_SQUARE_PX: Final = 4
"""Side of the squares of the map that outlines go round, pixels: seams are chosen in cells of at least that many, and
outlines of single pixels took a sixth of the drawing of full-size photos."""


def write_seamlines(
    path: Path, canvas: Canvas, describe: Sequence[Callable[[], Mapping[str, Any]]], *, run: Run = serial
) -> None:
    """Write a multipolygon for each picture that the orthoimage shows, of squares by what each shows at its middle.

    Args:
        path: the GeoPackage; appears when it is complete. canvas: rendered, with plane "frame".
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
    some = [[parts[i] for i in frames[k : k + _JOINED_AT_ONCE]] for k in range(0, len(frames), _JOINED_AT_ONCE)]
    joined = [whole for several in run(_joined, some) for whole in several]
    shapes = np.array([shapely.from_wkb(whole) for whole in joined], dtype=object)
    rows = [{**describe[i](), "area_m2": float(shapely.area(shape))} for i, shape in zip(frames, shapes)]
    with gpkg_file(path) as part:
        append_polygons(part, "seamlines", shapes, rows=rows, columns=_SEAMLINE, epsg=canvas.grid.epsg)


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
        labels: Ints = canvas.read_plane(
            row * t, min(grid.height, (row + 1) * t), col * t, min(grid.width, (col + 1) * t)
        )
    side = _SQUARE_PX
    rows, cols = (np.minimum(np.arange(side // 2, n + side // 2, side), n - 1) for n in labels.shape)
    labels = np.ascontiguousarray(labels[np.ix_(rows, cols)])
    left, top = grid.west + col * t * grid.gsd_m, grid.north - row * t * grid.gsd_m
    corner = from_origin(left, top, side * grid.gsd_m, side * grid.gsd_m)
    frames, polygons = [], []
    for shape, value in shapes(labels, mask=labels > 0, transform=corner):
        shell, *holes = shape["coordinates"]
        frames.append(int(value) - 1)
        polygons.append(shapely.Polygon(shell, holes))
    return frames, list(shapely.to_wkb(np.array(polygons, dtype=object))) if polygons else []
