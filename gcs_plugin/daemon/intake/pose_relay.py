"""Poses from files and links in the form of posted ones."""

from collections.abc import Mapping

from gcs_plugin.daemon.intake.posted_pose import PostedPose, pose_values
from orthoswarm.model.earth import distance_m
from orthoswarm.model.frame import Frame
from telemetry.live.live_poses import LinkPose
from telemetry.samples.sample_frame import sample_of


def apart_m(a: Mapping[str, float], b: Mapping[str, float]) -> float:
    """Metres between the places of two poses."""
    return distance_m(a["lat_deg"], a["lon_deg"], b["lat_deg"], b["lon_deg"])


def linked_pose(vehicle: str, name: str, time_s: float | None, linked: LinkPose | None) -> PostedPose | None:
    """What a vehicle's link and bus say as if it had been posted; None without a position."""
    values = None if linked is None else pose_values(linked.sample)
    return None if linked is None or values is None else PostedPose(vehicle, name, time_s, values, linked.origin)


def posted_frame(frame: Frame, vehicle: str, name: str) -> PostedPose:
    """A frame of a file as if it had been posted."""
    values = pose_values(sample_of(frame)) or {}
    if frame.damaged:
        values["damaged"] = True
    return PostedPose(vehicle, name, frame.time_s, values, dict(frame.origin))
