"""A vehicle's recent poses from its MAVLink link and its CAN bus, read at the time of a picture.

Each source (MAVLink, each node of the bus) has its own series; at any time the one with the lowest stated sigma is
used. Fast enough for a hundred vehicles: a message costs a few microseconds, memory is bounded by the time span
stored.
"""

import math
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Final

from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.frame import TAGGED_TILT_SIGMA, UNSTATED_SIGMA_M
from telemetry.formats.log.mavlink_poses import ExposureEvent, MavlinkPoses, fixed_camera
from telemetry.samples.held_fixes import LOST_SIGMA_M, FixNews
from telemetry.samples.sample import CAMERA_ANGLES, FLIGHT_ANGLES, Sample

MAVLINK: Final = "MAVLink"  # the source that a vehicle's link is

_POSITION = ("lat_deg", "lon_deg", "altitude_m", "sigma_m")
_HELD_S = 0.3
_ALL_HEARD_S: Final = 0.5
_TURNS = frozenset({"lon_deg", *FLIGHT_ANGLES, *CAMERA_ANGLES})


class _Series:
    """Values of some fields in order of time, with the sigma used to compare sources; bounded in length."""

    __slots__ = ("_keep_s", "names", "times", "values")

    def __init__(self, names: tuple[str, ...], keep_s: float) -> None:
        self.names = names
        self.times: list[float] = []
        self.values: list[tuple[float | None, ...]] = []
        self._keep_s = keep_s

    def add(self, time_s: float, values: tuple[float | None, ...]) -> None:
        """Add the fields' values followed by the sigma."""
        if not self.times or time_s > self.times[-1]:
            self.times.append(time_s)
            self.values.append(values)
        elif time_s < self.times[0] - self._keep_s:  # the clock was set back: start again
            self.times[:], self.values[:] = [time_s], [values]
        else:
            at = bisect_left(self.times, time_s)
            if self.times[at] != time_s:
                self.times.insert(at, time_s)
                self.values.insert(at, values)
        if self.times[-1] - self.times[0] > 1.25 * self._keep_s:
            old = bisect_left(self.times, self.times[-1] - self._keep_s)
            del self.times[:old], self.values[:old]

    def at(self, time_s: float, gap_s: float) -> tuple[float | None, ...] | None:
        """The interpolated values at a time; the newest hold for a short time only. None if unknown."""
        at = bisect_right(self.times, time_s)
        if at == 0:
            return None
        if at == len(self.times):
            return self.values[-1] if time_s - self.times[-1] <= _HELD_S else None
        before, after = self.times[at - 1], self.times[at]
        if after - before > gap_s and time_s != before:
            return None
        share = (time_s - before) / (after - before)
        one, two = self.values[at - 1], self.values[at]
        return tuple(_between(n, a, b, share) for n, a, b in zip((*self.names, "sigma"), one, two, strict=True))


def _between(name: str, a: float | None, b: float | None, share: float) -> float | None:
    if a is None or b is None:
        return a if share < 0.5 else b
    return wrap_deg(a + share * wrap_deg(b - a)) if name in _TURNS else a + share * (b - a)


class _Sources:
    """One kind of value, with a series for each source."""

    def __init__(self, names: tuple[str, ...], keep_s: float) -> None:
        self._names, self._keep_s = names, keep_s
        self._series = {MAVLINK: _Series(names, keep_s)}  # first, so that it is used where others are no better
        self.filled = False

    def add(self, source: str, sample: Sample, sigma: float) -> None:
        """Add a sample's values."""
        if source not in self._series:
            self._series[source] = _Series(self._names, self._keep_s)
        self._series[source].add(sample.time_s or 0.0, (*(getattr(sample, name) for name in self._names), sigma))
        self.filled = True

    def __len__(self) -> int:
        return sum(len(series.times) for series in self._series.values())

    def read(self, time_s: float, gap_s: float, sample: Sample) -> str | None:
        """Store the values of the best source at a time in a sample; returns the source, None if there is none."""
        best: tuple[float, str, tuple[float | None, ...]] | None = None
        for source, series in self._series.items():
            values = series.at(time_s, gap_s)
            if values is not None and (best is None or (values[-1] or 0.0) < best[0]):
                best = values[-1] or 0.0, source, values
        if best is None:
            return None
        for name, value in zip(self._names, best[2], strict=False):
            if value is not None:
                setattr(sample, name, value)
        return best[1]


@dataclass(frozen=True, slots=True)
class LinkPose:
    """A pose at a time, and its sources."""

    sample: Sample  # the pose
    # source of its `position`, `height`, `angles` and `flight_yaw`, as far as known
    origin: dict[str, str] = field(default_factory=dict)


class LivePoses:
    """The recent poses of one vehicle; messages and readers may use different threads.

    Attributes:
        vehicle: id.
        latest: the newest value of every field, from any source.
    """

    def __init__(
        self, vehicle: str, *, keep_s: float = 300.0, max_gap_s: float = 2.0, clock: Callable[[], float] = time.time
    ) -> None:
        self.vehicle = vehicle
        self.latest = Sample(vehicle=vehicle)
        self._max_gap_s = max_gap_s
        self._clock = clock
        self._mavlink = MavlinkPoses()
        self._arrival_offset: float | None = None
        self._lock = threading.Lock()
        self._news: dict[str, FixNews] = {}
        self._position = _Sources(_POSITION, keep_s)
        self._flight = _Sources(FLIGHT_ANGLES, keep_s)
        self._camera = _Sources(CAMERA_ANGLES, keep_s)
        self._height = _Sources(("height_m",), keep_s)
        self._ground = _Sources(("height_m",), keep_s)

    def __len__(self) -> int:
        """Number of stored positions."""
        return len(self._position)

    def feed(self, message: Any, arrival_s: float | None = None) -> ExposureEvent | None:
        """Process a MAVLink message of this vehicle; if it is a camera event, returns it with its complete pose.

        Args:
            message: decoded by pymavlink, of any component of the vehicle.
            arrival_s: time of arrival, UTC epoch seconds, for vehicles that do not know UTC and components with
                clocks of their own; None for now.
        """
        arrival_s = self._clock() if arrival_s is None else arrival_s
        bases = self._mavlink.clocks.bases
        found = self._mavlink.feed(message, arrival_s)
        if self._mavlink.clocks.bases != bases:
            self._arrival_offset = None
        if found is None:
            return None
        if isinstance(found, ExposureEvent):
            return self._event(found, arrival_s)
        found.time_s = self._utc(found.time_s or 0.0, arrival_s)
        if found.has_position:
            speed = math.hypot(message.vx, message.vy) / 100.0
            self.add(found, sigma=self._mavlink.position_sigma_m, speed_m_s=speed)
        else:
            self.add(found)
        return None

    def add(
        self, sample: Sample, *, source: str = MAVLINK, sigma: float | None = None, speed_m_s: float | None = None
    ) -> None:
        """Add a sample, whose time is UTC; a position that its source only repeats gets older, and then is none.

        Args:
            source: its sender.
            sigma: one sigma stated by the source, metres for a position, degrees for angles; None if not stated.
            speed_m_s: over the ground, as the source states it.
        """
        if sample.time_s is None:
            return
        metres = sigma or UNSTATED_SIGMA_M
        degrees = sigma or math.degrees(TAGGED_TILT_SIGMA)
        with self._lock:
            if sample.has_position:
                held_m = self._news.setdefault(source, FixNews()).hear(sample.time_s, sample.place, speed_m_s)
                if held_m <= LOST_SIGMA_M:
                    metres = math.hypot(metres, held_m)
                    aged = replace(sample, sigma_m=metres) if held_m > UNSTATED_SIGMA_M else sample
                    self._position.add(source, aged, metres)
            if sample.height_m is not None:
                (self._ground if sample.height_is_ground else self._height).add(source, sample, metres)
            if sample.flight_yaw_deg is not None:
                self._flight.add(source, sample, degrees)
            if sample.yaw_deg is not None:
                self._camera.add(source, sample, degrees)
            self.latest = sample.merge(self.latest)
            self.latest.vehicle = self.vehicle

    def at(self, time_s: float) -> Sample:
        """The interpolated pose at a time (UTC); a camera without a reported attitude is fixed under the airframe."""
        return self.read(time_s).sample

    def read(self, time_s: float) -> LinkPose:
        """The pose with its sources."""
        sample, above = Sample(time_s=time_s, vehicle=self.vehicle), Sample()
        with self._lock:
            origin = {
                "position": self._position.read(time_s, self._max_gap_s, sample),
                "height": self._height.read(time_s, self._max_gap_s, sample),
                "flight_yaw": self._flight.read(time_s, self._max_gap_s, sample),
                "angles": self._camera.read(time_s, self._max_gap_s, sample),
            }
            ground = self._ground.read(time_s, self._max_gap_s, above)
        if ground is not None:
            sample.height_m, sample.height_is_ground, origin["height"] = above.height_m, True, ground
        if not self.has_gimbal and origin["angles"] is None and origin["flight_yaw"] is not None:
            sample = fixed_camera(sample)
            origin["angles"] = f"{origin['flight_yaw']}, camera fixed under the airframe"
        return LinkPose(sample, {name: source for name, source in origin.items() if source is not None})

    @property
    def has_gimbal(self) -> bool:
        """Whether any message contained the camera's own attitude."""
        return self._mavlink.has_gimbal or self._camera.filled

    def _utc(self, boot_s: float, arrival_s: float) -> float:
        """UTC of a time since boot: by the vehicle's clock, else by the quickest arrival so far."""
        known = self._mavlink.utc(boot_s)
        if known is not None:
            return known
        offset = arrival_s - boot_s
        if self._arrival_offset is None or offset < self._arrival_offset:
            self._arrival_offset = offset
        return boot_s + self._arrival_offset

    def _event(self, event: ExposureEvent, arrival_s: float) -> ExposureEvent:
        """Complete an exposure: the autopilot's values, replaced by more accurate ones of the bus."""
        if event.time_s is None:
            event.time_s = arrival_s if event.boot_s is None else self._utc(event.boot_s, arrival_s)
        own = event.sample
        own.vehicle, own.time_s = self.vehicle, event.time_s
        around = self.read(event.time_s)
        held = MAVLINK in self._news and self._news[MAVLINK].held_m > UNSTATED_SIGMA_M
        if held or around.origin.get("position", MAVLINK) != MAVLINK:
            own.lat_deg = own.lon_deg = own.altitude_m = own.sigma_m = None
        if not self.has_gimbal:
            own = fixed_camera(own)
        elif around.origin.get("angles", MAVLINK) != MAVLINK:
            own.yaw_deg = own.pitch_deg = own.roll_deg = None
        event.sample = own.merge(around.sample)
        return event


class LinkPoses:
    """The recent poses of all vehicles, by id."""

    def __init__(self) -> None:
        self._of: dict[str, LivePoses] = {}

    def of(self, vehicle: str) -> LivePoses:
        """The poses of a vehicle, for adding to them."""
        return self._of.setdefault(vehicle, LivePoses(vehicle))

    def at(self, vehicle: str, time_s: float) -> LinkPose | None:
        """The pose of a vehicle's camera at a time (UTC); None if its position is unknown."""
        known = self._of.get(vehicle)
        found = None if known is None else known.read(time_s)
        return found if found is not None and found.sample.has_position else None

    def origins(self) -> dict[str, dict[str, str]]:
        """Source of the newest pose of each vehicle, by the vehicle's id; see `LinkPose.origin`."""
        times = {vehicle: poses.latest.time_s for vehicle, poses in list(self._of.items())}
        return {v: self._of[v].read(time_s - _ALL_HEARD_S).origin for v, time_s in times.items() if time_s}
