"""Poses from files and links as if they had been posted."""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from gcs_plugin.daemon.intake.posted_pose import PostedPose
from orthoswarm.model.frame import Fix, Frame
from telemetry.live.live_poses import LinkPose
from telemetry.samples.sample import Sample


def apart_m(a: Mapping[str, float], b: Mapping[str, float]) -> float:
    """Metres between the places of two poses."""
    north = (a["lat_deg"] - b["lat_deg"]) * 111_000.0
    east = (a["lon_deg"] - b["lon_deg"]) * 111_000.0 * math.cos(math.radians(a["lat_deg"]))
    return math.hypot(north, east)


def pose_values(sample: Sample) -> dict[str, float] | None:
    """What the journal keeps of a sample; None without a position."""
    if not sample.has_position:
        return None
    names = ("lat_deg", "lon_deg", "height_m", "altitude_m", "yaw_deg", "pitch_deg", "roll_deg", "flight_yaw_deg")
    values = {n: float(v) for n in (*names, "fov_deg") if (v := getattr(sample, n)) is not None}
    if sample.sigma_m is not None:
        values["position_sigma_m"] = float(sample.sigma_m)
    if sample.height_is_ground:
        values["height_is_ground"] = True
    return values


def linked_pose(vehicle: str, name: str, time_s: float | None, linked: LinkPose | None) -> PostedPose | None:
    """What a vehicle's link and bus say as if it had been posted; None without a position."""
    values = None if linked is None else pose_values(linked.sample)
    return None if linked is None or values is None else PostedPose(vehicle, name, time_s, values, linked.origin)


def posted_frame(frame: Frame, vehicle: str, name: str) -> PostedPose:
    """A frame of a file as if it had been posted."""
    values: dict[str, float] = {}
    for entry in fields(Fix):
        value: Any = getattr(frame.fix, entry.name)
        if value is not None and value is not False:
            degrees = entry.name.endswith("_rad")
            key = entry.name.removesuffix("_rad") + "_deg" if degrees else entry.name
            values[key] = math.degrees(value) if degrees else float(value)
    if frame.fov_hint_rad is not None:
        values["fov_deg"] = math.degrees(frame.fov_hint_rad)
    if frame.damaged:
        values["damaged"] = True
    return PostedPose(vehicle, name, frame.time_s, values, dict(frame.origin))
