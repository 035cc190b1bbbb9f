"""Which pictures of a video are used: one every few metres or seconds, the sharpest of its neighbours, in flight."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.earth import MEAN_RADIUS_M
from telemetry.photos.photo_frames import LEAST_HEIGHT_M
from telemetry.samples.sample import Sample
from telemetry.videos.picture_poses import Poses
from telemetry.videos.video_file import VideoScan

_VIDEO_HEIGHT_SHARE: Final = 0.04
"""Distance between the pictures used of a video, as a share of the height: 96 % overlap at 60 degrees."""
_VIDEO_EVERY_S: Final = 0.5  # time between them where no height is known
_VIDEO_EARLY: Final = 0.8  # from this share of that distance on, pictures are candidates, of which the sharpest is used
_VIDEO_LATE: Final = 1.2  # to this share
_VIDEO_CANDIDATES: Final = 6  # candidates at most (memory)
_LEAST_FLOWN_HEIGHT_M: Final = 5.0  # a video whose heights reach this was recorded with heights


@dataclass(slots=True, kw_only=True)
class DecodedPicture:
    """A picture of a video as decoded, that may be selected."""

    number: int  # in order of presentation
    frame: Any  # as decoded
    sample: Sample | None  # its pose
    video_s: float  # its time in the video
    origin: str = ""  # source of the pose
    packet: int | None = None  # index of its packet, None if the decoder did not report it
    damaged: bool = False  # whether it lost parts


class Picker:
    """Selects pictures from a stream, at most one per spacing.

    Among the pictures whose progress is near the spacing, the sharpest undamaged one is selected. Where pictures are
    further apart than the spacing (a slow camera, a thinned video), all are selected.

    Args:
        every_m: spacing in metres; with neither this nor every_s 4 % of the height, else half a second.
        every_s: spacing in seconds.
    """

    def __init__(self, every_m: float | None = None, every_s: float | None = None) -> None:
        self._every_m, self._every_s = every_m, every_s
        self._last: DecodedPicture | None = None
        self._waiting: list[DecodedPicture] = []

    def push(self, candidate: DecodedPicture) -> Iterator[DecodedPicture]:
        """Offer the next picture; yields the selected ones."""
        if self._last is None:
            self._last = candidate
            yield candidate
            return
        progress = self._progress(candidate, self._last)
        if progress < _VIDEO_EARLY:
            return
        if progress <= _VIDEO_LATE and len(self._waiting) < _VIDEO_CANDIDATES:
            self._waiting.append(candidate)
            return
        if not self._waiting:
            self._last = candidate
            yield candidate
            return
        yield self._take()
        yield from self.push(candidate)

    def flush(self) -> Iterator[DecodedPicture]:
        """At the end: yields the remaining selection."""
        if self._waiting:
            yield self._take()

    def _take(self) -> DecodedPicture:
        best = self._waiting[0]
        if len(self._waiting) > 1:
            sound = [c for c in self._waiting if not c.damaged]
            best = max(sound or self._waiting, key=lambda c: sharpness(c.frame))
        self._waiting.clear()
        self._last = best
        return best

    def _progress(self, new: DecodedPicture, last: DecodedPicture) -> float:
        """Distance of a picture from the last selected one, in units of the spacing."""
        seconds = abs(new.video_s - last.video_s)
        if self._every_s is not None and self._every_m is None:
            return seconds / max(self._every_s, 1e-6)
        metres = _distance_m(new.sample, last.sample)
        spacing = self._every_m
        if spacing is None and new.sample is not None and new.sample.height_m is not None:
            spacing = _VIDEO_HEIGHT_SHARE * max(new.sample.height_m, 5.0)
        if metres is None or spacing is None:
            return seconds / (self._every_s or _VIDEO_EVERY_S)
        by_time = seconds / self._every_s if self._every_s else 0.0
        return max(metres / max(spacing, 1e-6), by_time)


def _distance_m(a: Sample | None, b: Sample | None) -> float | None:
    if a is None or b is None or not (a.has_position and b.has_position):
        return None
    (lat, lon), (other_lat, other_lon) = a.place, b.place
    north = np.radians(lat - other_lat)
    east = np.radians(wrap_deg(lon - other_lon)) * np.cos(np.radians(lat))
    return float(MEAN_RADIUS_M * np.hypot(north, east))


def sharpness(frame: Any) -> float:
    """Variance of the Laplacian of a decoded picture's luma at half size: larger is sharper."""
    import cv2

    gray = luma(frame)[::2, ::2]
    return float(cv2.Laplacian(np.ascontiguousarray(gray), cv2.CV_16S, ksize=3).var())


def luma(frame: Any) -> Any:
    """Grey values, uint8 (rows, columns), of a decoded picture; of a planar format its Y plane, not converted."""
    name = frame.format.name
    if name.startswith(("yuv4", "yuvj4", "nv12", "nv21")) and not name.endswith(("le", "be")):
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        return rows[: frame.height, : frame.width]
    return frame.to_ndarray(format="gray")


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
