"""A frame from a sample: for pictures whose pose is known already (live streams, camera events, posted pictures)."""

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
    """A frame of a picture with its pose; None where the sample has no position.

    Args:
        sample: the pose; its yaw is the picture's.
        image: name in all products.
        path: of the picture file.
        vehicle: id.
        width: columns of the picture.
        height: rows of the picture.
        camera: tells lenses of one vehicle apart.
        origin: where the pose is from.
    """
    if sample.lat_deg is None or sample.lon_deg is None:
        return None
    fix = Fix(
        lat_deg=sample.lat_deg,
        lon_deg=sample.lon_deg,
        height_m=sample.height_m,
        altitude_m=sample.altitude_m,
        yaw_rad=_radians(sample.yaw_deg),
        pitch_rad=_radians(sample.pitch_deg),
        roll_rad=_radians(sample.roll_deg),
        flight_yaw_rad=_radians(sample.flight_yaw_deg),
        position_sigma_m=sample.sigma_m,
        height_is_ground=sample.height_is_ground and sample.height_m is not None,
    )
    return Frame(
        image=image,
        path=path,
        vehicle=vehicle,
        time_s=sample.time_s,
        fix=fix,
        width=width,
        height=height,
        camera=camera or f"{width}x{height}",
        fov_hint_rad=_radians(sample.fov_deg),
        origin={"position": origin, "angles": origin} if origin else {},
    )


def _radians(angle: float | None) -> float | None:
    return None if angle is None else math.radians(angle)
