"""Aligns a flight log with a video that has no poses of its own."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from telemetry.ingest.log_choice import LogMatch, LogSource, best_log
from telemetry.ingest.pairing.clock_offset import (
    TURNING_MARGIN,
    median_distance_m,
    offset_by_positions,
    offset_by_turning,
    offset_by_zone,
    turning_of_pictures,
)
from telemetry.samples.findings import Finding, plural
from telemetry.videos.picture_poses import Poses
from telemetry.videos.video_file import VideoScan

Array = NDArray[np.float64]
_BY_CREATION = "by the container's creation time"

_TURNING_RATE_HZ: Final = 4.0  # pictures a second of a video that are compared with a log's turns
_TURNING_WIDTH_PX: Final = 320  # width at which they are compared
_TURNING_LONGEST_S: Final = 600.0  # longest part of a video that is compared


def add_log(poses: Poses, found: VideoScan, logs: Sequence[LogSource]) -> list[Finding]:
    """Assign a video's pictures the poses of the log that fits it best.

    The clocks are aligned by the video's own positions, else by the rotation of its pictures, else by the
    container's creation time. Where logs of several vehicles fit equally well, only a log that is named like the video
    is taken: the vehicles of a swarm fly at the same time.
    """
    name = found.path.name
    matches = _matches(poses, found, logs)
    if not matches:
        what = "fits its positions" if poses.has_positions else "fits how its pictures turn, or its creation time"
        return [Finding("log-unused", f"no log beside {name} could be aligned with it: none {what}")]
    best = best_log(matches, name, lambda log: log.path.stem.lower() == found.path.stem.lower())
    if isinstance(best, Finding):
        return [best]
    log = best.entry.log
    count = poses.add_track(f"track of {log.path.name}", best.entry.timeline, best.offset_s, has_gimbal=log.has_gimbal)
    if not count:
        return [Finding("log-unused", f"{log.path.name} has no position while {name} was recorded")]
    best.entry.used = True
    text = f"{plural(count, 'picture')} of {name} got poses from {log.path.name}; its clock was found {best.how}"
    return [Finding("posed-by-log", text, note=best.how != _BY_CREATION)]


def _matches(poses: Poses, found: VideoScan, logs: Sequence[LogSource]) -> list[LogMatch]:
    if poses.has_positions:
        times, places = poses.track()
        clocks = {clock for clock in (found.created_s, poses.clock_s) if clock is not None}
        return [m for entry in logs if (m := _by_positions(times, places, clocks, entry)) is not None]
    logs = [entry for entry in logs if any(sample.has_position for sample in entry.log.samples)]
    if not logs:
        return []
    margin = TURNING_MARGIN
    times, rates = picture_rates(found)
    matches = []
    for entry in logs:
        turning = offset_by_turning(times, rates, entry.timeline, search_s=_longest(entry))
        if turning is not None:
            how = f"by how its pictures turn (correlation {turning[1]:.2f})"
            matches.append(
                LogMatch(entry=entry, offset_s=turning[0], how=how, rank=0, misfit=-turning[1], margin=margin)
            )
        elif found.created_s is not None:
            length = len(found.pictures) / (found.rate or 30.0)
            zone = offset_by_zone(np.array([found.created_s, found.created_s + length]), entry.timeline)
            if zone is not None:
                matches.append(
                    LogMatch(entry=entry, offset_s=zone - found.created_s, how=_BY_CREATION, rank=1, misfit=abs(zone))
                )
    return matches


def _by_positions(times: Array, places: Array, clocks: set[float], entry: LogSource) -> LogMatch | None:
    """The match under the clock (UTC of video time zero, in any zone) that brings the positions nearest to the log."""
    best: LogMatch | None = None
    for clock in clocks:
        offset = offset_by_positions(times + clock, places, entry.timeline, search_s=60.0)
        if offset is None:
            continue
        apart = median_distance_m(times + clock - offset, places, entry.timeline)
        if apart is not None and (best is None or apart < best.misfit):
            best = LogMatch(entry=entry, offset_s=offset - clock, how="by its own positions", rank=0, misfit=apart)
    return best


def _longest(entry: LogSource) -> float:
    span = entry.timeline.span
    return 0.0 if span is None else span[1] - span[0]


def picture_rates(found: VideoScan) -> tuple[Array, Array]:
    """Video times and yaw rates (degrees a second) measured in the pictures of a file's first ten minutes."""
    import cv2

    from telemetry.videos.extraction import decoded
    from telemetry.videos.picture_choice import luma

    rate = found.rate or 30.0
    every = max(1, round(rate / _TURNING_RATE_HZ))
    times: list[float] = []
    rates: list[float] = []
    before: tuple[float, NDArray[np.uint8]] | None = None
    for number, index, frame in decoded(found):
        if number % every:
            continue
        note = found.pictures[index] if index is not None and index < len(found.pictures) else None
        t = note.video_s if note is not None and note.video_s is not None else number / rate
        if t > _TURNING_LONGEST_S:
            break
        gray = np.ascontiguousarray(luma(frame))
        scale = min(1.0, _TURNING_WIDTH_PX / gray.shape[1])
        small = np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        if before is not None:
            middle, turned = turning_of_pictures([before[1], small], np.array([before[0], t]))
            times += middle.tolist()
            rates += turned.tolist()
        before = t, small
    return np.array(times), np.array(rates)
