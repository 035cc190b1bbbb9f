"""The way flown by photos and by a log, for photos whose times leave several camera events."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from telemetry.formats.log.log_data import FlightLog
from telemetry.formats.log.mavlink_poses import fixed_camera
from telemetry.ingest.pairing.motion_chains import PictureMotion
from telemetry.photos.photo_tags import PhotoTags
from telemetry.photos.picture_motion import PictureFile, shifts_px
from telemetry.samples.course import local_metres
from telemetry.samples.sample import Sample
from telemetry.samples.timeline import Timeline

Array = NDArray[np.float64]

_MOST_TILT_DEG: Final = 60.0  # pictures that look farther from nadir than this tell nothing of the distance flown


def picture_motion(
    photos: Sequence[PhotoTags], log: FlightLog, timeline: Timeline, workers: int
) -> PictureMotion | None:
    """Distances flown by the photos and by the log's positions; None if the log has none."""
    poses = [event.sample.merge(timeline.at(event.time_s or 0.0)) for event in log.events]
    if len(poses) < 2 or not all(pose.has_position for pose in poses):
        return None
    poses = poses if log.has_gimbal else [fixed_camera(pose) for pose in poses]
    files = [PictureFile(photo.path, photo.width, photo.height) for photo in photos]
    return PictureMotion(_way_m(poses), lambda some: shifts_px([files[i] for i in some], workers=workers))


def _way_m(poses: Sequence[Sample]) -> Array:
    """(M,) way to what the camera looks at along the track: a nod moves the picture as the vehicle's motion does."""
    ground = local_metres([pose.lat_deg or 0.0 for pose in poses], [pose.lon_deg or 0.0 for pose in poses])
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ground, axis=0).T))])
    around = np.gradient(ground, axis=0)
    course = np.degrees(np.arctan2(around[:, 0], around[:, 1]))
    for i, pose in enumerate(poses):
        if pose.height_m is None or pose.pitch_deg is None or pose.yaw_deg is None:
            continue
        tilt = pose.pitch_deg + 90.0
        if abs(tilt) < _MOST_TILT_DEG:
            way[i] += pose.height_m * np.tan(np.radians(tilt)) * np.cos(np.radians(pose.yaw_deg - course[i]))
    return way
