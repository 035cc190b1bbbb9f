"""Footprints of frames as polygons in a GeoPackage, for QGIS."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.export.atomic_file import written_whole

Array = NDArray[np.float64]
Feature = tuple[Mapping[str, Any], Array]
"""What is known about a frame, and its outline."""

_COLUMNS: dict[str, type[np.generic]] = {
    "image": np.object_,
    "vehicle": np.object_,
    "time": np.object_,
    "stage": np.object_,
    "fov_deg": np.float64,
    "sigma_m": np.float64,
}
_AT_ONCE = 4096


def write_footprints(path: Path, features: Iterable[Feature], epsg: int) -> None:
    """Write polygons with what is known about their frames, some thousands at a time.

    Args:
        path: the GeoPackage; appears when it is complete.
        features: values by the names of columns (those of frames.jsonl), and float64 (K, 2) rings on the ground, not
            closed; an empty ring gives no feature.
        epsg: their grid.

    Raises:
        OrthoSwarmError: if the disk is full or the folder cannot be written.
    """
    import pyogrio

    shown = (feature for feature in features if len(feature[1]) >= 3)
    with written_whole(path) as part:
        try:
            batch = list(islice(shown, _AT_ONCE))
            while batch or not part.exists():
                _append(part, batch, epsg)
                batch = list(islice(shown, _AT_ONCE))
        except (pyogrio.errors.DataSourceError, RuntimeError) as error:
            # GDAL does not say why; a folder that takes a file of a page is not full and may be written.
            part.with_suffix(".probe").write_bytes(bytes(65536))
            part.with_suffix(".probe").unlink()
            raise OSError(0, str(error)) from None


def _append(part: Path, batch: Sequence[Feature], epsg: int) -> None:
    import pyogrio
    import shapely

    rings = [ring for _, ring in batch]
    points = np.concatenate([piece for ring in rings for piece in (ring, ring[:1])]) if rings else np.empty((0, 2))
    index = np.repeat(np.arange(len(rings)), [len(ring) + 1 for ring in rings])
    shapes = shapely.polygons(shapely.linearrings(points, indices=index)) if rings else np.empty(0, object)
    pyogrio.raw.write(
        str(part),
        shapely.to_wkb(shapes),
        [_column([row.get(name) for row, _ in batch], kind) for name, kind in _COLUMNS.items()],
        list(_COLUMNS),
        layer="footprints",
        driver="GPKG",
        geometry_type="Polygon",
        crs=f"EPSG:{epsg}",
        append=part.exists(),
    )


def _column(values: list[Any], kind: type[np.generic]) -> NDArray[Any]:
    if kind is np.float64:
        return np.array([np.nan if v is None else v for v in values], np.float64)
    column = np.empty(len(values), object)
    column[:] = values
    return column
