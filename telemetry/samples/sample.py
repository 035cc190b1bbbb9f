"""One telemetry sample: the content of a SEI message, KLV packet, subtitle or log record at one time."""

import math
from dataclasses import dataclass, fields

CAMERA_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
FLIGHT_ANGLES = ("flight_yaw_deg", "flight_pitch_deg", "flight_roll_deg")


@dataclass(slots=True, kw_only=True)
class Sample:
    """Position and attitude of a camera at one time, degrees and metres; None where unknown."""

    time_s: float | None = None  # UTC epoch seconds
    lat_deg: float | None = None  # latitude, WGS 84
    lon_deg: float | None = None  # longitude
    height_m: float | None = None  # height above takeoff, or above the ground where height_is_ground
    altitude_m: float | None = None  # absolute altitude
    yaw_deg: float | None = None  # of the picture's up direction at nadir, clockwise from true north
    pitch_deg: float | None = None  # -90 looks straight down
    roll_deg: float | None = None  # > 0 right side down
    flight_yaw_deg: float | None = None  # heading of the airframe
    flight_pitch_deg: float | None = None  # its attitude
    flight_roll_deg: float | None = None  # its attitude
    fov_deg: float | None = None  # horizontal field of view
    zoom: float | None = None  # focal length in a unit of the source, which is only comparable within one flight
    sigma_m: float | None = None  # one sigma of the horizontal position
    vehicle: str | None = None  # id of the vehicle
    height_is_ground: bool = False  # whether height_m is above the ground below
    number: int | None = None  # number of the picture or exposure as the source counts them

    @property
    def has_position(self) -> bool:
        """Whether it contains a position."""
        return self.lat_deg is not None and self.lon_deg is not None

    @property
    def place(self) -> tuple[float, float]:
        """Latitude and longitude, 0 where unknown."""
        return self.lat_deg or 0.0, self.lon_deg or 0.0

    def merge(self, other: "Sample") -> "Sample":
        """This sample with gaps filled from another; a position, a height and its kind stay together."""
        result = Sample()
        for name in _NAMES:
            own = getattr(self, name)
            setattr(result, name, own if own is not None else getattr(other, name))
        if not self.has_position:
            result.lat_deg, result.lon_deg = other.lat_deg, other.lon_deg
        result.height_is_ground = other.height_is_ground if self.height_m is None else self.height_is_ground
        return result


_NAMES = tuple(f.name for f in fields(Sample))


def checked(sample: Sample) -> Sample | None:
    """The sample without invalid values (not finite, out of range, 0, 0); None if nothing is left."""
    for name in _NAMES:
        value = getattr(sample, name)
        if isinstance(value, float) and not math.isfinite(value):
            setattr(sample, name, None)
    if sample.lat_deg is None or sample.lon_deg is None or not is_position(sample.lat_deg, sample.lon_deg):
        sample.lat_deg = sample.lon_deg = None
    for name in (*CAMERA_ANGLES, *FLIGHT_ANGLES):
        value = getattr(sample, name)
        if value is not None and abs(value) > 720.0:
            setattr(sample, name, None)
    if sample.time_s is not None and not 0.0 < sample.time_s < 7.3e9:
        sample.time_s = None
    for name in ("height_m", "altitude_m"):
        value = getattr(sample, name)
        if value is not None and abs(value) > 100_000.0:
            setattr(sample, name, None)
    if sample.fov_deg is not None and not 0.1 < sample.fov_deg < 179.0:
        sample.fov_deg = None
    if sample.zoom is not None and not sample.zoom > 0.0:
        sample.zoom = None
    if sample.sigma_m is not None and not 0.0 < sample.sigma_m < 100_000.0:
        sample.sigma_m = None
    if sample.vehicle is not None:
        sample.vehicle = "".join(c for c in sample.vehicle if c.isprintable()).strip()[:64] or None
    empty = all(getattr(sample, name) is None for name in _NAMES if name not in ("height_is_ground", "number"))
    return None if empty else sample


def is_position(lat_deg: float, lon_deg: float) -> bool:
    """Whether a pair can be a real position: finite, in range and not 0, 0."""
    return (
        math.isfinite(lat_deg)
        and math.isfinite(lon_deg)
        and abs(lat_deg) <= 90.0
        and abs(lon_deg) <= 180.0
        and (abs(lat_deg) > 1e-6 or abs(lon_deg) > 1e-6)
    )
