"""Chains of photos whose pictures show how far the vehicle went from one to the next.

Whole seconds do not show which of several exposures in a second a photo is; the ground's motion from picture to
picture does. In a chain the way of each photo is known up to a common shift (when in its second the first
one was taken) and a scale (metres a pixel, from height and lens). Both are hypotheses that the matching sums over.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Indices
from telemetry.formats.log.log_data import FlightLog
from telemetry.formats.log.mavlink_poses import fixed_camera
from telemetry.photos.photo_tags import Photo
from telemetry.photos.picture_motion import shifts_px
from telemetry.samples.course import ground_track
from telemetry.samples.sample import Sample
from telemetry.samples.timeline import Timeline

_MOST_CHAIN_PHOTOS: Final = 24  # longest chain whose motion is added up: errors of relief and scale grow
_PHASE_STEP_S: Final = 0.06  # step of the hypotheses for when in its second a chain's first photo was taken
_CHAIN_SCALES: Final = (0.96, 1.0, 1.04)  # scale of a chain over that of the flight: the height above ground varies
_LEAST_SPEED_M_S: Final = 0.3  # slowest speed by which errors of position become errors of time, m/s
SAME_EXPOSURE_SHARE: Final = 0.35  # a photo nearer to an event than this share of their usual distance is its exposure
_FALSE_MATCH: Final = 1e-3  # probability that the motion between two pictures is wrong although it looks right
_MOST_TILT_DEG: Final = 60.0  # pictures that look farther from nadir than this tell nothing of the distance flown


@dataclass(frozen=True, slots=True)
class PictureMotion:
    """What the pictures show of the way; they are read only where times do not decide."""

    path_m: Array  # (M,) way along the track to each event, of what the camera looks at, metres
    # for photos (indices, in order of time) the pixels that the ground moves from each to the next, NaN where the two
    # do not match
    shifts_px: Callable[[Sequence[int]], Array]

    def subset(self, photos: Sequence[int], events: Sequence[int]) -> "PictureMotion":
        """The same for some of the photos and events, numbered from 0."""
        return PictureMotion(self.path_m[list(events)], lambda some: self.shifts_px([photos[i] for i in some]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Chains:
    """Photos by chain; a photo without a measured step is a chain of its own without any evidence."""

    number: Indices  # (N,) of each photo's chain
    along_px: Array  # (N,) way from the middle of its chain
    path_m: Array  # (K,) way of each single event
    e: Array  # (K,) times of the events
    p: Array  # (N,) middle of each photo's interval
    resolution_s: float  # of the photos' clock
    metres_a_pixel: float  # of a photo's way, one sigma
    sigma_m: float  # of a photo's way, one sigma
    step_m: float  # usual way between events
    phases_s: Array  # (C,) hypotheses
    scales: Array  # (C,) hypotheses

    @property
    def linked(self) -> bool:
        """Whether there is any chain of more than one photo."""
        return len(np.unique(self.number)) < len(self.number)

    def starts(self, photo: int) -> bool:
        """Whether a photo is the first of its chain."""
        return photo == 0 or bool(self.number[photo - 1] != self.number[photo])

    def ends(self, photo: int) -> bool:
        """Whether a photo is the last of its chain."""
        return photo == len(self.number) - 1 or bool(self.number[photo + 1] != self.number[photo])

    def factors(self, photo: int, first: int, width: int, offset: Array, drift: Array) -> Array:
        """(H, C, width) how much more likely a photo's way is if it is the event `first` (and those after it).

        Against an exposure without an event at any time that the photo's clock allows.
        """
        found = self._expected(photo, offset, drift)
        if found is None:
            return np.ones((len(offset), len(self.phases_s), width))
        expected, speed = found
        there = self.path_m[np.clip(np.arange(first, first + width), 0, len(self.path_m) - 1)]
        apart = (there[None, None, :] - expected[:, :, None]) / self.sigma_m
        width_m = np.maximum(speed * self.resolution_s, np.sqrt(2.0 * np.pi) * self.sigma_m)[:, None, None]
        near = np.exp(-0.5 * apart**2) * width_m / (np.sqrt(2.0 * np.pi) * self.sigma_m)
        return np.asarray(_FALSE_MATCH + (1.0 - _FALSE_MATCH) * near)

    def alone(self, photo: int, offset: Array, drift: Array) -> Array:
        """(H, C) how likely it is that a photo has no event although one is where the photo was taken.

        Exposures do not come closer to each other than the camera takes them: such a photo is that event.
        """
        found = self._expected(photo, offset, drift)
        if found is None:
            return np.ones((len(offset), len(self.phases_s)))
        after = np.clip(np.searchsorted(self.path_m, found[0]), 1, len(self.path_m) - 1)
        nearest = np.minimum(np.abs(self.path_m[after] - found[0]), np.abs(self.path_m[after - 1] - found[0]))
        return np.where(nearest < SAME_EXPOSURE_SHARE * self.step_m, _FALSE_MATCH, 1.0)

    def _expected(self, photo: int, offset: Array, drift: Array) -> tuple[Array, Array] | None:
        """(H, C) way of a photo in metres, and (H,) speed; None if its chain has one photo only."""
        members = np.flatnonzero(self.number == self.number[photo])
        if len(members) < 2:
            return None
        times = (self.p[members][None, :] - offset[:, None]) / (1.0 + drift[:, None])
        ways = np.interp(times, self.e, self.path_m)
        span = times[:, -1] - times[:, 0]
        speed = np.maximum((ways[:, -1] - ways[:, 0]) / np.maximum(span, 1.0), _LEAST_SPEED_M_S)
        own = self.metres_a_pixel * self.scales * self.along_px[photo]
        return ways.mean(axis=1)[:, None] + own[None, :] + speed[:, None] * self.phases_s[None, :], speed


def chains_of(
    steps_px: Array, p: Array, e: Array, *, path_m: Array, resolution_s: float, offset: float, drift: float
) -> Chains | None:
    """Chains from the steps (N - 1,) in pixels between photos, NaN where unknown; None where there are too few.

    p, e, resolution_s: as in `Chains`. path_m: (K,) way of each event. offset, drift: a clock that is about right.
    """
    ways = np.interp((p - offset) / (1.0 + drift), e, path_m)
    scale = _scale(_split(steps_px), ways)
    if scale is None:
        return None
    # A step that is longer than the fastest flight in the time between is a false match of pictures.
    fastest = float(np.quantile(np.diff(path_m) / np.maximum(np.diff(e), 1e-3), 0.98))
    longest = 1.3 * fastest * (np.diff(p) + resolution_s) + 1.0
    steps_px = np.where(scale[0] * steps_px > longest, np.nan, steps_px)
    scale = _scale(_split(steps_px), ways)
    if scale is None:
        return None
    number, along = _split(steps_px)
    reach = np.arange(-0.55 * resolution_s, 0.55 * resolution_s + 1e-9, _PHASE_STEP_S)
    phases, scales = (part.ravel() for part in np.meshgrid(reach, _CHAIN_SCALES, indexing="ij"))
    step_m = float(np.median(np.diff(path_m)))
    return Chains(
        number=number, along_px=along, path_m=path_m, e=e, p=p, resolution_s=resolution_s, metres_a_pixel=scale[0],
        sigma_m=scale[1], step_m=step_m, phases_s=phases, scales=scales,
    )  # fmt: skip


def _split(steps_px: Array) -> tuple[Indices, Array]:
    """Number of each photo's chain, and its way from the chain's middle."""
    count = len(steps_px) + 1
    number, along = np.zeros(count, dtype=np.int64), np.zeros(count)
    length = 1
    for i, step in enumerate(steps_px.tolist(), 1):
        linked = step == step and length < _MOST_CHAIN_PHOTOS
        length = length + 1 if linked else 1
        number[i] = number[i - 1] + (not linked)
        along[i] = along[i - 1] + step if linked else 0.0
    means = np.bincount(number, along) / np.bincount(number)
    return number, along - means[number]


def _scale(chains: tuple[Indices, Array], ways: Array) -> tuple[float, float] | None:
    """Metres a pixel by regression over all chains, and the usual rest in metres."""
    number, along = chains
    means = np.bincount(number, ways) / np.bincount(number)
    ways = ways - means[number]
    if not float(along @ along) or (scale := float(along @ ways) / float(along @ along)) <= 0.0:
        return None
    rest = float(np.std(ways - scale * along))
    return scale, max(rest, 0.1)


def variants(chains: Chains) -> list[Chains]:
    """The same with other scales and errors, to choose from by evidence."""
    return [
        replace(chains, metres_a_pixel=chains.metres_a_pixel * scale, sigma_m=max(0.05, sigma * chains.step_m))
        for scale in np.arange(0.88, 1.121, 0.03)
        for sigma in (0.04, 0.08, 0.15, 0.3)
    ]


def picture_motion(photos: Sequence[Photo], log: FlightLog, timeline: Timeline, workers: int) -> PictureMotion | None:
    """Distances flown by the photos and by the log's positions; None if the log has none."""
    poses = [event.sample.merge(timeline.at(event.time_s or 0.0)) for event in log.events]
    if len(poses) < 2 or not all(pose.has_position for pose in poses):
        return None
    poses = poses if log.has_gimbal else [fixed_camera(pose) for pose in poses]
    return PictureMotion(_way_m(poses), lambda some: shifts_px([photos[i] for i in some], workers))


def _way_m(poses: Sequence[Sample]) -> Array:
    """(M,) way to what the camera looks at along the track: a nod moves the picture as the vehicle's motion does."""
    ground = ground_track(poses)
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
