"""One telemetry sample: the content of a SEI message, KLV packet, subtitle or log record at one time.

Samples have degrees, the fixes of frames radians: only here the two are converted.
"""

import math
from dataclasses import dataclass, fields
from pathlib import Path

from orthoswarm.model.frame import Fix, Frame

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


def frame_of(
    sample: Sample,
    *,
    image: str,
    path: Path,
    vehicle: str,
    width: int,
    height: int,
    camera: str = "",
    origin: str = "",
) -> Frame | None:
    """The frame of a picture of so many columns and rows with its pose; None if the sample has no position.

    Args:
        sample: the pose; its yaw is the picture's. image: name in all products.
        camera: distinguishes lenses of one vehicle. origin: source of the pose.
    """
    if sample.lat_deg is None or sample.lon_deg is None:
        return None
    return Frame(
        image=image, path=path, vehicle=vehicle, time_s=sample.time_s, fix=fix_of(sample), width=width, height=height,
        camera=camera or f"{width}x{height}", fov_hint_rad=_radians(sample.fov_deg),
        origin={"position": origin, "angles": origin} if origin else {},
    )  # fmt: skip


def fix_of(sample: Sample) -> Fix:
    """The fix that a sample records; latitude 0 and longitude 0 where it has no position."""
    return Fix(
        lat_deg=sample.lat_deg or 0.0, lon_deg=sample.lon_deg or 0.0, height_m=sample.height_m,
        altitude_m=sample.altitude_m, yaw_rad=_radians(sample.yaw_deg), pitch_rad=_radians(sample.pitch_deg),
        roll_rad=_radians(sample.roll_deg), flight_yaw_rad=_radians(sample.flight_yaw_deg),
        position_sigma_m=sample.sigma_m, height_is_ground=sample.height_is_ground and sample.height_m is not None,
    )  # fmt: skip


def sample_of(frame: Frame) -> Sample:
    """The sample that a frame's fix records, in degrees to 13 digits: angles recorded in degrees come back exactly."""
    fix = frame.fix
    return Sample(
        time_s=frame.time_s, lat_deg=fix.lat_deg, lon_deg=fix.lon_deg, height_m=fix.height_m, altitude_m=fix.altitude_m,
        yaw_deg=_degrees(fix.yaw_rad), pitch_deg=_degrees(fix.pitch_rad), roll_deg=_degrees(fix.roll_rad),
        flight_yaw_deg=_degrees(fix.flight_yaw_rad), fov_deg=_degrees(frame.fov_hint_rad), sigma_m=fix.position_sigma_m,
        height_is_ground=fix.height_is_ground, vehicle=frame.vehicle,
    )  # fmt: skip


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else float(f"{math.degrees(angle):.13g}")


def _radians(angle: float | None) -> float | None:
    return None if angle is None else math.radians(angle)
