"""What the narrowest camera sees from the planned height, and the distances between lines and pictures from it."""

from dataclasses import dataclass, replace
from math import cos, isfinite, radians, sin, tan

from orthoswarm.model.errors import InputError

SMALLEST_FOV_DEG, LARGEST_FOV_DEG = 10.0, 150.0
HIGHEST_M = 10_000.0


@dataclass(frozen=True, slots=True)
class Footprint:
    """Ground covered by one picture of the narrowest camera, straight down, its width across the leg."""

    width_m: float  # across the leg, 2 h tan(FoV / 2)
    height_m: float  # along the leg, width over the aspect ratio
    spacing_m: float  # largest distance between neighbouring lines, width (1 - side overlap)
    trigger_m: float  # distance between pictures on a leg, height (1 - forward overlap)
    # how much less far pictures see along the leg at its strip's edge, as they are turned against it
    slant_m: float = 0.0

    @property
    def overshoot_m(self) -> float:
        """How far a leg must go beyond what it shall cover, for any phase of the trigger; 0 from 50 % overlap on."""
        return max(0.0, self.trigger_m - 0.5 * self.height_m + self.slant_m)

    @property
    def reach_m(self) -> float:
        """How far pictures are certain to see beyond a leg's ends, for any phase of the trigger."""
        return max(0.0, 0.5 * self.height_m - self.trigger_m - self.slant_m)

    def turned(self, crab_rad: float) -> "Footprint":
        """The footprint of pictures that are turned against the leg by up to an angle, as a vehicle crabs in wind.

        A turned picture w x h covers a chord at the offset y from the leg. Its length is h / cos(a), and falls to 0
        between y = (w cos a - h sin a) / 2 and (w cos a + h sin a) / 2, from one end; its other end lies
        y tan(a) + h / (2 cos a) further along. Pictures d apart leave nothing out where the chord is at least d.
        """
        a, h = crab_rad, self.height_m
        if a == 0.0:
            return self
        most = self.width_m * cos(a) + h * sin(a)
        width = min(self.width_m, most - 2.0 * self.trigger_m * sin(a) * cos(a))
        chord = min(h / cos(a), 0.5 * (most - width) / (sin(a) * cos(a)))
        slant = 0.5 * h - chord + 0.5 * h / cos(a) + 0.5 * width * tan(a)
        spacing = self.spacing_m * width / self.width_m
        return replace(self, width_m=width, spacing_m=spacing, slant_m=max(0.0, slant))


def footprint(
    altitude_m: float, fov_min_rad: float, aspect: float = 4 / 3, side: float = 0.4, forward: float = 0.8
) -> Footprint:
    """The footprint of theta-hat, the field of view below the smallest that any camera of the swarm has (paper III.A).

    Args:
        altitude_m: height of the legs above ground, metres. fov_min_rad: theta-hat, horizontal, radians.
        aspect: picture's width over its height. side: overlap of neighbouring lines' pictures, 0 to 0.95.
        forward: overlap of consecutive pictures, 0 to 0.95.

    Raises:
        InputError: a value outside its range.
    """
    if not (isfinite(altitude_m) and altitude_m > 0.0):
        raise InputError(f"the altitude is {altitude_m:g} m; give a height above the takeoff point larger than 0")
    if altitude_m > HIGHEST_M:
        raise InputError(f"the altitude is {altitude_m:g} m; give metres, at most {HIGHEST_M:g}")
    if not radians(SMALLEST_FOV_DEG) - 1e-9 <= fov_min_rad <= radians(LARGEST_FOV_DEG) + 1e-9:
        raise InputError(
            f"the field of view is outside {SMALLEST_FOV_DEG:g} to {LARGEST_FOV_DEG:g} degrees; "
            "give the smallest horizontal field of view in the swarm, in degrees"
        )
    for name, overlap in (("side", side), ("forward", forward)):
        if not 0.0 <= overlap <= 0.95:
            raise InputError(f"the {name} overlap is {overlap:g}; give a share from 0 to 0.95")
    if not 0.2 <= aspect <= 5.0:
        raise InputError(f"the aspect ratio is {aspect:g}; give the picture's width over its height, such as 1.333")
    width = 2.0 * altitude_m * tan(0.5 * fov_min_rad)
    height = width / aspect
    return Footprint(width, height, width * (1.0 - side), height * (1.0 - forward))
