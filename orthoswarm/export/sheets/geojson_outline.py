"""Outlines in GeoJSON (RFC 7946): cut where they lie on the meridian of 180 degrees, with a bbox that tells so."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

_DECIMALS = 8
"""Of degrees: a millimetre."""


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

    Args:
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
