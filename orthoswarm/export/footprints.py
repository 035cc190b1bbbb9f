"""Footprints of frames as polygons in a GeoPackage, for QGIS."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.export.partial import written_whole

Array = NDArray[np.float64]

_COLUMNS: dict[str, type[np.generic]] = {
    "image": np.object_,
    "vehicle": np.object_,
    "time": np.object_,
    "stage": np.object_,
    "fov_deg": np.float64,
    "sigma_m": np.float64,
}


def write_footprints(path: Path, rows: Sequence[Mapping[str, Any]], polygons: Sequence[Array], epsg: int) -> None:
    """Write polygons with what is known about their frames.

    Args:
        path: the GeoPackage; appears when it is complete.
        rows: lines of frames.jsonl.
        polygons: float64 (K, 2) rings on the ground, not closed, one a row; an empty one gives no feature.
        epsg: their grid.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    import pyogrio
    import shapely

    kept = [(row, ring) for row, ring in zip(rows, polygons, strict=True) if len(ring) >= 3]
    rings = [ring for _, ring in kept]
    points = np.concatenate([part for ring in rings for part in (ring, ring[:1])]) if rings else np.empty((0, 2))
    index = np.repeat(np.arange(len(rings)), [len(ring) + 1 for ring in rings])
    shapes = shapely.polygons(shapely.linearrings(points, indices=index)) if rings else np.empty(0, object)
    fields = [_column([row.get(name) for row, _ in kept], kind) for name, kind in _COLUMNS.items()]
    with written_whole(path) as part:
        try:
            pyogrio.raw.write(
                str(part),
                shapely.to_wkb(shapes),
                fields,
                list(_COLUMNS),
                layer="footprints",
                driver="GPKG",
                geometry_type="Polygon",
                crs=f"EPSG:{epsg}",
            )
        except (pyogrio.errors.DataSourceError, RuntimeError) as error:
            # GDAL does not say why; a folder that takes a file of a page is not full and may be written.
            part.with_suffix(".probe").write_bytes(bytes(65536))
            part.with_suffix(".probe").unlink()
            raise OSError(0, str(error)) from None


def _column(values: list[Any], kind: type[np.generic]) -> NDArray[Any]:
    if kind is np.float64:
        return np.array([np.nan if v is None else v for v in values], np.float64)
    column = np.empty(len(values), object)
    column[:] = values
    return column
