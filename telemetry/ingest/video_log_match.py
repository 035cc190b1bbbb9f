"""Aligns a flight log with a video that has no poses of its own."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from telemetry.ingest.log_ingest import LogSource
from telemetry.ingest.pairing.clock_offset import (
    offset_by_positions,
    offset_by_turning,
    offset_by_zone,
    turning_of_pictures,
)
from telemetry.samples.findings import Finding, plural
from telemetry.videos.picture_poses import Poses
from telemetry.videos.video_file import VideoScan

Array = NDArray[np.float64]


def add_log(poses: Poses, found: VideoScan, logs: Sequence["LogSource"]) -> list[Finding]:
    """Assign a video's pictures the poses of the log that fits it best.

    The clocks are aligned by the video's own positions, else by the rotation of its pictures, else by the
    container's creation time.
    """
    name = found.path.name
    for entry in logs:
        offset, how = _offset(poses, found, entry)
        if offset is None:
            continue
        log = entry.log
        count = poses.add_track(f"track of {log.path.name}", entry.timeline, offset, has_gimbal=log.has_gimbal)
        if not count:
            continue
        entry.used = True
        text = f"{plural(count, 'picture')} of {name} got poses from {log.path.name}; its clock was found {how}"
        return [Finding("posed-by-log", text, note=how != "by the container's creation time")]
    text = f"no log beside {name} could be aligned with it: it has no turns and no creation time"
    return [Finding("log-unused", text)]


def _offset(poses: Poses, found: VideoScan, entry: "LogSource") -> tuple[float | None, str]:
    """Video time minus UTC, and the method that found it."""
    if poses.has_positions:
        times, places = poses.track()
        clock = found.created_s or 0.0
        offset = offset_by_positions(times + clock, places, entry.timeline, search_s=60.0) if found.created_s else None
        return (None if offset is None else offset - clock), "by its own positions"
    times, rates = picture_rates(found)
    turning = offset_by_turning(times, rates, entry.timeline, search_s=_longest(entry))
    if turning is not None:
        return turning[0], f"by how its pictures turn (correlation {turning[1]:.2f})"
    if found.created_s is not None:
        length = len(found.pictures) / (found.rate or 30.0)
        zone = offset_by_zone(np.array([found.created_s, found.created_s + length]), entry.timeline)
        if zone is not None:
            return zone - found.created_s, "by the container's creation time"
    return None, ""


def _longest(entry: "LogSource") -> float:
    span = entry.timeline.span
    return 0.0 if span is None else span[1] - span[0]


def picture_rates(found: VideoScan) -> tuple[Array, Array]:
    """Video times and yaw rates (degrees a second) measured in the pictures of a file's first ten minutes."""
    config = active().ingest
    import cv2

    from telemetry.videos.extraction import decoded
    from telemetry.videos.picture_choice import luma

    rate = found.rate or 30.0
    every = max(1, round(rate / config.turning_rate_hz))
    times: list[float] = []
    rates: list[float] = []
    before: tuple[float, NDArray[np.uint8]] | None = None
    for number, index, frame in decoded(found):
        if number % every:
            continue
        note = found.pictures[index] if index is not None and index < len(found.pictures) else None
        t = note.video_s if note is not None and note.video_s is not None else number / rate
        if t > config.turning_longest_s:
            break
        gray = np.ascontiguousarray(luma(frame))
        scale = min(1.0, config.turning_width_px / gray.shape[1])
        small = np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        if before is not None:
            middle, turned = turning_of_pictures([before[1], small], np.array([before[0], t]))
            times += middle.tolist()
            rates += turned.tolist()
        before = t, small
    return np.array(times), np.array(rates)
