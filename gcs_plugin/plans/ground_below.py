"""The ground below a plan, read from a height model."""

import math
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import Terrain
from orthoswarm.model.plan import Plan
from orthoswarm.planning.relief_plan import GroundBelow
from orthoswarm.raster.height_model import HeightModel


def read_ground(dem: Path, wanted: shapely.Geometry, grid: LocalGrid, starts: NDArray[np.float64]) -> GroundBelow:
    """The ground below what is to be flown, over that of the lowest start.

    Args:
        dem: a GeoTIFF with a CRS. wanted: area or lines, grid metres. grid: of it. starts: takeoff points (n, 2), grid
            metres, at least one.

    Raises:
        InputError: the model cannot be read, or has no heights there.
    """
    points = np.concatenate([shapely.get_coordinates(wanted), starts])
    bounds = BoundingBox.around_points(points, active().raster.dem_margin_m)
    found = HeightModel.open(dem, grid.epsg, bounds, np.empty((0, 3))).window(bounds, active().raster.dem_most_nodes)
    terrain = found.terrain
    rows, columns = terrain.z.shape
    east = terrain.west + terrain.step_m * np.arange(columns)
    north = terrain.south + terrain.step_m * np.arange(rows)
    nodes = np.stack(np.meshgrid(east, north), -1)
    # One step around the outline, too: a small area may lie between nodes.
    within = shapely.contains_xy(wanted.buffer(terrain.step_m), nodes[..., 0], nodes[..., 1])
    hull = shapely.MultiPoint(points).convex_hull.buffer(terrain.step_m)
    way = shapely.contains_xy(hull, nodes[..., 0], nodes[..., 1])
    if not found.known[way | within].all():
        raise InputError(
            f"{dem} has no heights on a part of the area or of the ways to it; give a height model without holes there"
        )
    z = terrain.z - np.float32(terrain.height(starts).min())
    ground = Terrain(terrain.west, terrain.south, terrain.step_m, z)
    return GroundBelow(ground, float(z[within].min()), float(z[within].max()), float(z[way].max()))


def relief_notes(plan: Plan, ground: GroundBelow) -> list[str]:
    """What to know about a plan over a height model, in words."""
    over = plan.over_ground
    if over is None:
        return []
    how = (
        f"legs follow the ground at {over.nominal_m:g} m"
        if over.follows
        else f"all legs are flown {plan.altitude_m:.0f} m above the lowest takeoff"
    )
    if over.by_vehicle:
        how += ", by the terrain data of the vehicles: the ground station must send it to them, or their card hold it"
    back = math.ceil(ground.way_m + active().planning.least_above_ground_m)
    return [
        f"the ground of the area lies {ground.low_m:.0f} to {ground.high_m:.0f} m over takeoff: {how}, "
        f"{over.least_m:.0f} to {over.most_m:.0f} m above ground; side overlap {100 * over.side_overlap[0]:.0f} % or "
        f"more on 95 % of the legs, forward overlap at least {100 * over.forward_overlap:.0f} %",
        f"a vehicle that turns home by itself flies straight back: set its return height (ArduPilot RTL_ALT, PX4 "
        f"RTL_RETURN_ALT) to {back} m or more",
    ]
