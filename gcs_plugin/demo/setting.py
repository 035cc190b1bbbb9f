"""The setting of the demonstration: the twin's city, the area to map, and the vehicles' pose errors."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from orthoswarm.twin.flights import FlightPlan
from orthoswarm.twin.presets import TwinSpec, spec
from orthoswarm.twin.site import Site

HEIGHT_M: Final = 90.0
FOV_MIN_DEG: Final = 75.0
_FOVS_DEG: Final = (85.0, 90.0, 95.0, 100.0)
_ALONG_M: Final = 290.0
_ACROSS_M: Final = 120.0
_STEP_M: Final = 5.0
_MARGIN_M: Final = 180.0
WIDTH, HEIGHT = 640, 480


@dataclass(frozen=True, slots=True)
class DemoSetting:
    """The demonstration's parameters.

    Attributes:
        vehicles: how many. seed: of city, disaster and errors. speed: simulated seconds per real second, at most.
    """

    vehicles: int = 3
    seed: int = 1
    speed: float = 6.0

    @property
    def twin(self) -> TwinSpec:
        """Parameters of the twin; the disaster covers about a tenth of the area, in its middle."""
        across, along = (0.4 * side for side in self.extent_m)
        plan = FlightPlan(
            columns=1, legs=2, photos=round((2.0 * along + 0.5 * across) / _STEP_M) + 1, spacing_m=_STEP_M,
            leg_spacing_m=0.5 * across, height_m=HEIGHT_M, width=WIDTH, height=HEIGHT,
        )  # fmt: skip
        return spec("debris", seed=self.seed, plan=plan, margin_m=_MARGIN_M + 0.3 * max(self.extent_m))

    @property
    def extent_m(self) -> tuple[float, float]:
        """Size of the area to map, east and north: two legs for each vehicle."""
        return _ACROSS_M * self.vehicles, _ALONG_M

    def area(self) -> dict[str, Any]:
        """The area to map, a GeoJSON polygon."""
        site = Site.of(self.twin)
        half = 0.5 * np.array(self.extent_m)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half + np.array(site.center)
        ring = [[float(lon), float(lat)] for lat, lon in site.grid.to_geographic(corners)]
        return {"type": "Polygon", "coordinates": [ring]}

    def home(self) -> tuple[float, float, float]:
        """Latitude, longitude (degrees) and altitude (metres) of the first vehicle, at the area's south-west corner."""
        site = Site.of(self.twin)
        east, north = (c - 0.5 * side for c, side in zip(site.center, self.extent_m, strict=True))
        lat, lon = (float(v) for v in site.grid.to_geographic([east, north]))
        return lat, lon, 500.0


@dataclass(frozen=True, slots=True)
class Errors:
    """Constant errors of one vehicle's recorded poses, and its true field of view; radians."""

    fov_rad: float
    yaw_rad: float
    pitch_rad: float
    roll_rad: float

    @classmethod
    def of(cls, setting: DemoSetting, system: int) -> "Errors":
        """The errors of a vehicle, constant during its flight."""
        rng = np.random.default_rng([setting.seed, 211, system])
        yaw, pitch, roll = np.radians(rng.normal(0.0, [2.0, 0.8, 0.8]))
        return cls(float(np.radians(rng.choice(_FOVS_DEG))), float(yaw), float(pitch), float(roll))
