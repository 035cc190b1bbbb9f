"""The place where the map should lie, and the distance of pictures from it."""

from dataclasses import dataclass
from typing import Protocol

from gcs_plugin.daemon.layers.web_tiles import TileServer
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.earth import distance_m
from orthoswarm.model.geo import LocalGrid


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


class NewestPlan(Protocol):
    """The plans of a workspace."""

    def newest_bounds(self) -> tuple[float, float, float, float] | None:
        """South, west, north, east of the newest plan in degrees, None if there is none."""


@dataclass(frozen=True, slots=True)
class ExpectedPlace:
    """The location of the map before its first picture."""

    tiles: TileServer
    plans: NewestPlan

    def place(self) -> Anchor | None:
        """The basemap, else the newest plan; None if the pictures decide."""
        basemap = self.tiles.basemap
        if basemap is not None:
            return Anchor.of_ground("the basemap", basemap.epsg, basemap.bounds)
        found = self.plans.newest_bounds()
        return None if found is None else Anchor("the newest plan", found)
