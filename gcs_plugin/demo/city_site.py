"""The digital twin's city around the position of a real vehicle, as the scene for its simulated camera."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orthoswarm.model.errors import InputError
from orthoswarm.twin.presets import TwinSpec, spec
from orthoswarm.twin.recorded_noise import Noise
from orthoswarm.twin.site import Site, disaster_zones, with_heading
from orthoswarm.twin.true_flight import FlightDeviations, FlightPlan

if TYPE_CHECKING:
    from orthoswarm.twin.imaging.ray_marching import PreparedScene

_FAR_M = 20_000.0


def set_there(folder: Path) -> bool:
    """Whether a folder holds a set already."""
    return (folder / "truth" / "manifest.json").is_file()


def read_spec(folder: Path) -> TwinSpec:
    """The parameters of a data set made by `orthoswarm twin make` or by this module.

    Raises:
        InputError: the folder holds no set, or one of another version.
    """
    path = folder / "truth" / "manifest.json"
    try:
        values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        values.pop("generator", None)
        parts = {"plan": FlightPlan, "motion": FlightDeviations, "noise": Noise}
        for name, kind in parts.items():
            values[name] = kind(**{key: _tuples(value) for key, value in values[name].items()})
        return TwinSpec(**{key: _tuples(value) for key, value in values.items()})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{folder} contains no readable data set ({error}); make one in an empty folder") from None


def _tuples(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def place_spec(preset: str, seed: int, lat_deg: float, lon_deg: float) -> TwinSpec:
    """A preset's city around a place."""
    return with_heading(spec(preset, seed=seed, lat_deg=lat_deg, lon_deg=lon_deg))


def write_set(world: TwinSpec, folder: Path, report: Callable[[str, int, int], None]) -> Path:
    """Write the map before the disaster, the truth after it and the area to map, but no photos.

    Returns:
        The area, a GeoJSON file with one polygon.

    Raises:
        InputError: the folder holds another set.
    """
    from orthoswarm.twin.dataset_files import write_atomic
    from orthoswarm.twin.make import make_twin

    make_twin(world, folder, only=0, progress=report)
    path = folder / "area.geojson"
    write_atomic(path, json.dumps(area_of(world)).encode())
    return path


def area_of(world: TwinSpec) -> dict[str, Any]:
    """The area that the set's own flight maps, a GeoJSON polygon; all footprints over it are inside the city."""
    site = Site.of(world)
    across, along = (0.5 * side for side in world.plan.extent_m)
    corners = np.array([[-across, -along], [across, -along], [across, along], [-across, along], [-across, -along]])
    places = site.grid.to_geographic(world.plan.to_grid(corners, site.center))
    return {"type": "Polygon", "coordinates": [[[float(lon), float(lat)] for lat, lon in places]]}


def build_world(world: TwinSpec) -> tuple["PreparedScene", Site]:
    """The city after the disaster, prepared for rendering, and its site."""
    from orthoswarm.twin.dataset_files import after_disaster

    site = Site.of(world)
    scene, slots = site.build(world)
    return after_disaster(world, scene, slots, disaster_zones(world, site)), site


def away_m(world: TwinSpec, lat_deg: float, lon_deg: float) -> float:
    """Distance of a position from the part of the city that a camera may fly over, metres; 0 inside."""
    site = Site.of(world)
    east, north = np.asarray(site.grid.to_grid(lat_deg, lon_deg)) - site.center
    if not (math.isfinite(east) and math.isfinite(north)):
        return _FAR_M
    reach = 0.5 * max(world.plan.extent_m) + world.margin_m
    return float(max(0.0, math.hypot(east, north) - reach))
