"""The ground below a plan, read from a height model."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Final

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
from orthoswarm.raster.height_model import DEM_MOST_NODES, HeightModel

_BESIDE_STEPS: Final = 2.0
"""The highest ground is read at so many steps within that distance at least, where the number of nodes allows it."""
DEM_MARGIN_M: Final = 50.0  # a height model is read so far beyond the places that are asked for (some of its nodes)


def read_ground(dem: Path, wanted: shapely.Geometry, grid: LocalGrid, starts: NDArray[np.float64]) -> GroundBelow:
    """The ground below what is to be flown, over that of the lowest start.

    Args:
        dem: a GeoTIFF with a CRS. wanted: area or lines, grid metres. grid: of it. starts: takeoff points (n, 2), grid
            metres, at least one.

    Raises:
        InputError: the model cannot be read, or has no heights there.
    """
    points = np.concatenate([shapely.get_coordinates(wanted), starts])
    bounds = BoundingBox.around_points(points, DEM_MARGIN_M)
    most, beside_m = DEM_MOST_NODES, active().planning.beside_m
    model = HeightModel.open(dem, grid.epsg, bounds, np.empty((0, 3)))
    found = model.window(bounds, most)
    terrain = found.terrain
    # One step around the outline, too: a small area may lie between nodes.
    within = _nodes_in(wanted.buffer(terrain.step_m), terrain)
    hull = shapely.MultiPoint(points).convex_hull.buffer(terrain.step_m)
    if not found.known[within | _nodes_in(hull, terrain)].all():
        raise InputError(
            f"{dem} has no heights on a part of the area or of the ways to it; give a height model without holes there"
        )
    zero = np.float32(terrain.height(starts).min())
    highest = model.highest(bounds, beside_m, _BESIDE_STEPS, most)
    highest = replace(highest, z=highest.z - zero)
    way_m = float(highest.z[_nodes_in(hull, highest)].max())
    z = terrain.z - zero
    ground = replace(terrain, z=z)
    return GroundBelow(ground, highest, float(z[within].min()), float(z[within].max()), way_m)


def _nodes_in(outline: shapely.Geometry, terrain: Terrain) -> NDArray[np.bool_]:
    """Which nodes (rows, columns) lie within an outline, grid metres."""
    rows, columns = terrain.z.shape
    east = terrain.west + terrain.step_m * np.arange(columns)
    north = terrain.south + terrain.step_m * np.arange(rows)
    shapely.prepare(outline)
    return np.asarray(shapely.contains_xy(outline, *np.meshgrid(east, north)))


def return_height_m(ground: GroundBelow) -> float:
    """Height above takeoff, whole metres, at which a straight way home passes over all ground and what stands on it."""
    return float(math.ceil(ground.way_m + active().planning.least_above_ground_m))


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
    return [
        f"the ground of the area lies {ground.low_m:.0f} to {ground.high_m:.0f} m over takeoff: {how}, "
        f"{over.least_m:.0f} to {over.most_m:.0f} m above ground, {over.way_least_m:.0f} m or more above the highest "
        f"within {active().planning.beside_m:g} m; side overlap {100 * over.side_overlap[0]:.0f} % or "
        f"more on 95 % of the legs, forward overlap at least {100 * over.forward_overlap:.0f} %",
        f"a vehicle that turns home by itself flies straight back: set its return height (ArduPilot RTL_ALT, "
        f"RTL_ALT_M from 4.7 on; PX4 RTL_RETURN_ALT) to {return_height_m(ground):.0f} m or more",
    ]
