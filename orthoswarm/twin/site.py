"""Site of a data set: place, flight direction, disaster zones, sun positions, relief displacement of the map."""

from dataclasses import dataclass, replace

import numpy as np

from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid, utm_epsg
from orthoswarm.twin.city.builder import ParkingPlace
from orthoswarm.twin.city.city import build_city
from orthoswarm.twin.city.scene import Scene, scene_grid
from orthoswarm.twin.city.sunlight import Sun
from orthoswarm.twin.disaster import SIZES_M, DamagedGround
from orthoswarm.twin.presets import TwinSpec


@dataclass(frozen=True, slots=True)
class Site:
    """Grid, centre (easting, northing) and flight direction of a data set."""

    grid: LocalGrid
    center: tuple[float, float]
    heading_rad: float

    @classmethod
    def of(cls, spec: TwinSpec) -> "Site":
        """The site of a set."""
        if spec.ground is not None:
            from orthoswarm.twin.city.photo_ground import ground_place

            epsg, center, _ = ground_place(spec.ground)
            return cls(LocalGrid(epsg), center, spec.plan.heading_rad)
        grid = LocalGrid(utm_epsg(spec.lat_deg, spec.lon_deg))
        east, north = np.round(grid.to_grid(spec.lat_deg, spec.lon_deg))
        return cls(grid, (float(east), float(north)), spec.plan.heading_rad)

    def build(self, spec: TwinSpec) -> tuple[Scene, list[ParkingPlace]]:
        """The scene before the disaster, without cars, and its parking places."""
        across, along = (0.5 * x + spec.margin_m for x in spec.plan.extent_m)
        c, s = abs(np.cos(spec.plan.heading_rad)), abs(np.sin(spec.plan.heading_rad))
        half = (float(across * c + along * s), float(across * s + along * c))
        if spec.ground is not None:
            from orthoswarm.twin.city.photo_ground import load_ground

            return load_ground(spec.ground, self.center, half), []
        return build_city(scene_grid(self.grid.epsg, self.center, *half), spec.seed, relief_m=spec.relief_m)


def disaster_zones(spec: TwinSpec, site: Site) -> dict[str, DamagedGround]:
    """Disaster zones by name: one near the middle of the area, or with `all` one in each third of it.

    Raises InputError: for a disaster that does not exist.
    """
    if spec.disaster == "none":
        return {}
    if spec.disaster == "all":
        thirds = zip(SIZES_M, (0.3, 0.0, -0.3), strict=True)
        return {name: _zone(spec, site, name, place) for name, place in thirds}
    if spec.disaster == "collapse":  # all over the area
        return {spec.disaster: DamagedGround(*site.center, *spec.plan.extent_m, 0.0)}
    if spec.disaster not in SIZES_M:
        raise InputError(f"there is no disaster '{spec.disaster}'; choose none, all, collapse, {', '.join(SIZES_M)}")
    return {spec.disaster: _zone(spec, site, spec.disaster, 0.0)}


def _zone(spec: TwinSpec, site: Site, disaster: str, place: float) -> DamagedGround:
    """A disaster's zone, parallel to the area's long side; `place`: its middle along that side, as a share of it."""
    alone = spec.disaster != "all"
    rng = np.random.default_rng([spec.seed, 53] if alone else [spec.seed, 53, list(SIZES_M).index(disaster)])
    across, along = SIZES_M[disaster]
    extent = np.array(spec.plan.extent_m)
    # the long side of the zone lies along the long side of the area; small areas get a smaller zone
    shrink = min(1.0, 0.8 * extent.max() / max(across, along), 0.8 * extent.min() / min(across, along))
    lengthwise = spec.plan.heading_rad + (np.pi / 2 if extent[0] >= extent[1] else 0.0)
    if across > along:
        lengthwise += np.pi / 2
    offset = rng.uniform(-0.12, 0.12, 2) * extent * (1.0 if alone else 0.3)
    offset[int(extent.argmax())] += place * extent.max()
    east, north = spec.plan.to_grid(offset, site.center)
    angle = np.pi / 2 - lengthwise + rng.uniform(-0.25, 0.25)
    return DamagedGround(float(east), float(north), across * shrink, along * shrink, float(angle))


def suns(seed: int) -> tuple[Sun, Sun]:
    """Sun positions of the map and of the photos: two different hours."""
    rng = np.random.default_rng([seed, 61])
    first = rng.uniform(0.6, 1.0)
    azimuth = rng.uniform(1.6, 4.6)
    turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.7, 1.6)
    return Sun(float(azimuth), float(first), 0.45), Sun(float(azimuth + turn), float(rng.uniform(0.6, 1.05)), 0.45)


def light_of(spec: TwinSpec, which: int) -> Sun:
    """The light of the map (0) or of the photos (1); a real orthoimage has shadows already, so they are weaker."""
    sun = suns(spec.seed)[which]
    return sun if spec.ground is None else replace(sun, ambient=0.72)


def map_lean(spec: TwinSpec) -> tuple[float, float]:
    """Relief displacement in the basemap (east, north), metres per metre of height."""
    rng = np.random.default_rng([spec.seed, 67])
    size, azimuth = rng.uniform(0.2, 0.35), rng.uniform(0.0, 360.0)
    size = spec.lean if spec.lean is not None else size
    azimuth = np.radians(spec.lean_deg if spec.lean_deg is not None else azimuth)
    return float(size * np.sin(azimuth)), float(size * np.cos(azimuth))


def with_heading(spec: TwinSpec) -> TwinSpec:
    """A spec with a random flight direction from its seed (the presets fly north)."""
    rng = np.random.default_rng([spec.seed, 97])
    quarter = float(rng.choice([0.0, np.pi / 2]))
    if spec.ground is not None:  # the long side of the area along the long side of the place
        from orthoswarm.twin.city.photo_ground import ground_place

        size = ground_place(spec.ground)[2]
        across, along = spec.plan.extent_m
        quarter = 0.0 if (across >= along) == (size[0] >= size[1]) else np.pi / 2
    heading = quarter + np.radians(rng.uniform(-12.0, 12.0))
    return replace(spec, plan=replace(spec.plan, heading_rad=float(heading)))
