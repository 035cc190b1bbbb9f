"""Samples, in degrees, to the fixes of frames, in radians, and back: the only place where the two are converted."""

import math
from pathlib import Path

from orthoswarm.model.frame import Fix, Frame
from telemetry.samples.sample import Sample


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
        image=image,
        path=path,
        vehicle=vehicle,
        time_s=sample.time_s,
        fix=fix_of(sample),
        width=width,
        height=height,
        camera=camera or f"{width}x{height}",
        fov_hint_rad=_radians(sample.fov_deg),
        origin={"position": origin, "angles": origin} if origin else {},
    )


def fix_of(sample: Sample) -> Fix:
    """The fix that a sample records; latitude 0 and longitude 0 where it has no position."""
    return Fix(
        lat_deg=sample.lat_deg or 0.0,
        lon_deg=sample.lon_deg or 0.0,
        height_m=sample.height_m,
        altitude_m=sample.altitude_m,
        yaw_rad=_radians(sample.yaw_deg),
        pitch_rad=_radians(sample.pitch_deg),
        roll_rad=_radians(sample.roll_deg),
        flight_yaw_rad=_radians(sample.flight_yaw_deg),
        position_sigma_m=sample.sigma_m,
        height_is_ground=sample.height_is_ground and sample.height_m is not None,
    )


def sample_of(frame: Frame) -> Sample:
    """The sample that a frame's fix records, in degrees to 13 digits: angles recorded in degrees come back exactly."""
    fix = frame.fix
    return Sample(
        time_s=frame.time_s,
        lat_deg=fix.lat_deg,
        lon_deg=fix.lon_deg,
        height_m=fix.height_m,
        altitude_m=fix.altitude_m,
        yaw_deg=_degrees(fix.yaw_rad),
        pitch_deg=_degrees(fix.pitch_rad),
        roll_deg=_degrees(fix.roll_rad),
        flight_yaw_deg=_degrees(fix.flight_yaw_rad),
        fov_deg=_degrees(frame.fov_hint_rad),
        sigma_m=fix.position_sigma_m,
        height_is_ground=fix.height_is_ground,
        vehicle=frame.vehicle,
    )


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else float(f"{math.degrees(angle):.13g}")


def _radians(angle: float | None) -> float | None:
    return None if angle is None else math.radians(angle)
