"""Polygons and lines of GeoPackages and shapefiles, read by OGR (pyogrio) and transformed to WGS 84."""

import warnings
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from orthoswarm.model.errors import InputError
from orthoswarm.planning.area.shape_files import Polygon, Ring, Shapes, refuse_many_corners, ring

if TYPE_CHECKING:
    from pyproj import Transformer


def read_geopackage(path: Path, name: str) -> Shapes:
    """Polygons and lines of all layers of a GeoPackage.

    Args:
        path: the file. name: how to call it in an error.

    Raises:
        InputError: OGR cannot read it, it says no coordinate system, or its coordinates are of no use.
    """
    return _shapes(str(path), name)


def read_zipped_shapefile(path: Path, name: str) -> Shapes:
    """Polygons and lines of the shapefiles in a ZIP, in whatever folder.

    Args:
        path: the ZIP. name: how to call it in an error.

    Raises:
        InputError: OGR cannot read it, a `.prj` is missing, or its coordinates are of no use.
    """
    with zipfile.ZipFile(path) as archive:
        inside = [entry for entry in archive.namelist() if entry.lower().endswith(".shp")]
    found = [_shapes(f"/vsizip/{{{path}}}/{entry}", name) for entry in inside]
    return Shapes(
        tuple(polygon for shapes in found for polygon in shapes.polygons),
        tuple(line for shapes in found for line in shapes.lines),
    )


def _shapes(source: str, name: str) -> Shapes:
    from pyogrio import list_layers
    from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError, GeometryError
    from pyogrio.raw import read

    polygons: list[Polygon] = []
    lines: list[Ring] = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of OGR, about what it reads all the same
            layers = [read(source, layer=layer, columns=[], force_2d=True) for layer, _ in list_layers(source)]
            parts = [(m["crs"], part) for m, _, g, _ in layers for part in shapely.get_parts(shapely.from_wkb(g))]
    except (DataSourceError, DataLayerError, FeatureError, FieldError, GeometryError, shapely.GEOSException):
        needs = "a shapefile's ZIP needs .shp, .shx, .dbf and .prj"
        raise InputError(f"{name} is damaged or incomplete; export it again ({needs})") from None
    to_degrees = {crs: _transformer(crs, name) for crs, _ in parts}  # made once: it takes as long as a thousand points
    for crs, part in parts:
        if part.geom_type == "Polygon" and not part.is_empty:
            shell, *holes = [_degrees(r.coords, to_degrees[crs], name) for r in (part.exterior, *part.interiors)]
            polygons.append(Polygon(shell, tuple(holes)))
        elif part.geom_type == "LineString" and not part.is_empty:
            lines.append(_degrees(part.coords, to_degrees[crs], name, 2))
    refuse_many_corners([*polygons, *lines], name)
    return Shapes(tuple(polygons), tuple(lines))


def _transformer(crs: str | None, name: str) -> "Transformer":
    """From a coordinate system to longitude and latitude of WGS 84.

    Raises:
        InputError: the system is not said, or not known.
    """
    from pyproj import Transformer
    from pyproj.exceptions import CRSError

    if crs is None:
        raise InputError(f"{name} does not say its coordinate system; export it in WGS 84 (EPSG:4326), with its .prj")
    try:
        return Transformer.from_crs(crs, 4326, always_xy=True)
    except CRSError:
        raise InputError(f"{name} has an unknown coordinate system; export it in WGS 84 (EPSG:4326)") from None


def _degrees(points: object, to_degrees: "Transformer", name: str, least: int = 3) -> Ring:
    """A ring or line in latitude and longitude of WGS 84."""
    array = np.asarray(points, dtype=np.float64)[:, :2]
    lon, lat = to_degrees.transform(array[:, 0], array[:, 1])
    return ring(np.column_stack([lat, lon]), name, least)
