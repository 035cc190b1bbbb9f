"""The ground below a plan, from a height model: what its highest point means for spacing, clearance and pixel size."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.planning.area.area import Area
from orthoswarm.raster.height_model import HeightModel

LEAST_ABOVE_GROUND_M = 20.0
_LEVEL_STARTS_M = 2.0
_AROUND_M = 50.0


@dataclass(frozen=True, slots=True)
class GroundBelow:
    """Heights of the ground over the lowest takeoff, metres.

    Attributes:
        low_m: lowest ground of the area; high_m: highest. way_m: highest ground of the area and the ways to it.
    """

    low_m: float
    high_m: float
    way_m: float

    @classmethod
    def read(cls, dem: Path, area: Area, starts: NDArray[np.float64]) -> "GroundBelow":
        """Read a height model below an area.

        Args:
            dem: a GeoTIFF with a CRS. area: with its grid. starts: takeoff points (n, 2), grid metres, at least one.

        Raises:
            InputError: the model cannot be read or has gaps there, or starts lie at different heights.
        """
        points = np.concatenate([shapely.get_coordinates(area.ground), starts])
        bounds = BoundingBox.around_points(points, _AROUND_M)
        known = HeightModel.open(dem, area.grid.epsg, bounds, np.empty((0, 3))).window(
            bounds, active().raster.dem_most_nodes
        )
        terrain = known.terrain
        rows, columns = terrain.z.shape
        east = terrain.west + terrain.step_m * np.arange(columns)
        north = terrain.south + terrain.step_m * np.arange(rows)
        nodes = np.stack(np.meshgrid(east, north), -1)
        # One step around the outline, too: a small area may lie between nodes.
        within = shapely.contains_xy(area.ground.buffer(terrain.step_m), nodes[..., 0], nodes[..., 1])
        hull = shapely.MultiPoint(points).convex_hull.buffer(_AROUND_M)
        way = shapely.contains_xy(hull, nodes[..., 0], nodes[..., 1])
        if not known.known[within].all():
            raise InputError(f"{dem} has no heights on a part of the area; give a height model without holes there")
        level = terrain.height(starts)
        if float(np.ptp(level)) > _LEVEL_STARTS_M:
            raise InputError(
                f"the starts lie {np.ptp(level):.1f} m apart in height, and heights of a mission count from takeoff; "
                "start all vehicles at one level"
            )
        z = terrain.z - float(level.min())
        return cls(float(z[within].min()), float(z[within].max()), float(z[way].max()))

    def check(self, altitude_m: float) -> None:
        """Refuse legs and ways lower than 20 m above the ground.

        Raises:
            InputError: the altitude is too low.
        """
        if altitude_m - self.way_m < LEAST_ABOVE_GROUND_M:
            least = np.ceil(self.way_m + LEAST_ABOVE_GROUND_M)
            raise InputError(
                f"at {altitude_m:g} m above takeoff the flight would be {altitude_m - self.way_m:.0f} m above the "
                f"highest ground; give --altitude {least:.0f} or more, so that {LEAST_ABOVE_GROUND_M:g} m are kept"
            )

    def note(self, altitude_m: float) -> str:
        """The range of heights over ground, in words."""
        least, most = altitude_m - self.high_m, altitude_m - self.low_m
        return (
            f"the ground of the area lies {self.low_m:.0f} to {self.high_m:.0f} m over takeoff: lines are spaced for "
            f"{least:.0f} m above ground; pixels are up to {most / least:.2f} times as large over the lowest"
        )
