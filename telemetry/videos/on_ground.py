"""The pictures of a video from before takeoff and after landing."""

from typing import Final

import numpy as np

from telemetry.photos.photo_frames import LEAST_HEIGHT_M
from telemetry.videos.picture_poses import Poses
from telemetry.videos.video_file import VideoScan

_LEAST_FLOWN_HEIGHT_M: Final = 5.0  # a video whose heights reach this was recorded with heights


def on_ground(found: VideoScan, poses: Poses) -> frozenset[int]:
    """Packets whose pictures were taken on the ground: at its level until the first climb, or after the last descent.

    Empty if the heights never leave the ground: then they were never filled in. A flight that passes the takeoff's
    level in a valley is not interrupted.
    """
    order = sorted(range(len(found.pictures)), key=lambda i: (found.pictures[i].video_s or 0.0, i))
    sampled = [(i, pose.sample.height_m) for i in order if (pose := poses.of(i)) is not None]
    known = [(i, height) for i, height in sampled if height is not None]
    heights = np.abs([height for _, height in known])
    flown = np.flatnonzero(heights >= LEAST_HEIGHT_M)
    if not len(flown) or heights.max() < _LEAST_FLOWN_HEIGHT_M:
        return frozenset()
    first, last = int(flown[0]), int(flown[-1])
    return frozenset(i for n, (i, _) in enumerate(known) if n < first or n > last)
