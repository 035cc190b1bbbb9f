"""The place where the map should lie, and the distance of pictures from it."""

import math
from dataclasses import dataclass

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import LocalGrid

_METRES_A_DEGREE = 111_195.0  # of a great circle of the mean Earth, 6,371,008.8 m


@dataclass(frozen=True, slots=True)
class Anchor:
    """The place where pictures are expected.

    Attributes:
        name: for messages: "the basemap". bounds: south, west, north, east in degrees.
    """

    name: str
    bounds: tuple[float, float, float, float]

    @classmethod
    def of_ground(cls, name: str, epsg: int, box: BoundingBox) -> "Anchor":
        """The anchor of a box on a UTM grid."""
        west, south, east, north = box
        ring = LocalGrid(epsg).to_geographic([[west, south], [west, north], [east, south], [east, north]])
        low, high = ring.min(0), ring.max(0)
        return cls(name, (float(low[0]), float(low[1]), float(high[0]), float(high[1])))

    def distance_m(self, lat_deg: float, lon_deg: float) -> float:
        """Distance of a position from the bounds in metres, to a hundredth; 0 inside."""
        south, west, north, east = self.bounds
        middle = 0.5 * (west + east)
        lon_deg = middle + (lon_deg - middle + 180.0) % 360.0 - 180.0
        return distance_m(lat_deg, lon_deg, min(max(lat_deg, south), north), min(max(lon_deg, west), east))


def distance_m(lat1_deg: float, lon1_deg: float, lat2_deg: float, lon2_deg: float) -> float:
    """Great-circle distance of two positions on a sphere, metres (haversine formula)."""
    lat1, lat2 = math.radians(lat1_deg), math.radians(lat2_deg)
    half_lat, half_lon = 0.5 * (lat2 - lat1), 0.5 * math.radians(lon2_deg - lon1_deg)
    h = math.sin(half_lat) ** 2 + math.cos(lat1) * math.cos(lat2) * math.sin(half_lon) ** 2
    return math.degrees(2.0 * math.asin(math.sqrt(min(1.0, h)))) * _METRES_A_DEGREE
