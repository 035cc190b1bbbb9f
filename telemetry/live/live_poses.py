"""A vehicle's recent poses from live MAVLink (or CAN), to be read at the moment of a picture.

Cheap enough for a hundred vehicles: a message costs a few microseconds, memory is bounded by the time that is kept.
"""

import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from orthoswarm.model.angles import wrap_deg
from telemetry.formats.log.mavlink_poses import CameraEvent, MavlinkPoses, fixed_camera
from telemetry.samples.sample import Sample

_POSITION = ("lat_deg", "lon_deg", "altitude_m", "sigma_m")
_FLIGHT = ("flight_yaw_deg", "flight_pitch_deg", "flight_roll_deg")
_CAMERA = ("yaw_deg", "pitch_deg", "roll_deg")
_HELD_S = 0.3
_ACCURATE_M = 0.5
_ACCURATE_FOR_S = 2.0
_TURNS = frozenset({"lon_deg", *_FLIGHT, *_CAMERA})


class _Series:
    """Values of some fields over time, in order of time, the oldest dropped."""

    __slots__ = ("_keep_s", "names", "times", "values")

    def __init__(self, names: tuple[str, ...], keep_s: float) -> None:
        self.names = names
        self.times: list[float] = []
        self.values: list[tuple[float | None, ...]] = []
        self._keep_s = keep_s

    def add(self, time_s: float, values: tuple[float | None, ...]) -> None:
        if not self.times or time_s > self.times[-1]:
            self.times.append(time_s)
            self.values.append(values)
        elif time_s < self.times[0] - self._keep_s:  # the clock was set back: begin anew
            self.times[:], self.values[:] = [time_s], [values]
        else:
            at = bisect_left(self.times, time_s)
            if self.times[at] != time_s:
                self.times.insert(at, time_s)
                self.values.insert(at, values)
        if self.times[-1] - self.times[0] > 1.25 * self._keep_s:
            old = bisect_left(self.times, self.times[-1] - self._keep_s)
            del self.times[:old], self.values[:old]

    def read(self, time_s: float, gap_s: float, sample: Sample) -> None:
        """Put the values at a moment into a sample, interpolated; the newest is held for a moment, no more."""
        at = bisect_right(self.times, time_s)
        if at == 0:
            return
        if at == len(self.times):
            if time_s - self.times[-1] <= _HELD_S:
                self._put(sample, self.values[-1])
            return
        before, after = self.times[at - 1], self.times[at]
        if after - before > gap_s and time_s != before:
            return
        share = (time_s - before) / (after - before)
        one, two = self.values[at - 1], self.values[at]
        self._put(sample, tuple(_between(n, a, b, share) for n, a, b in zip(self.names, one, two, strict=True)))

    def _put(self, sample: Sample, values: tuple[float | None, ...]) -> None:
        for name, value in zip(self.names, values, strict=True):
            if value is not None:
                setattr(sample, name, value)


def _between(name: str, a: float | None, b: float | None, share: float) -> float | None:
    if a is None or b is None:
        return a if share < 0.5 else b
    step = b - a
    if name in _TURNS:
        step = wrap_deg(step)
        return wrap_deg(a + share * step)
    return a + share * step


class LivePoses:
    """The recent poses of one vehicle.

    Attributes:
        vehicle: id. latest: the newest value of every field. last_event: the newest camera event.
    """

    def __init__(
        self, vehicle: str, *, keep_s: float = 300.0, max_gap_s: float = 2.0, clock: Callable[[], float] = time.time
    ) -> None:
        self.vehicle = vehicle
        self.latest = Sample(vehicle=vehicle)
        self.last_event: CameraEvent | None = None
        self._max_gap_s = max_gap_s
        self._clock = clock
        self._mavlink = MavlinkPoses()
        self._arrival_offset: float | None = None
        self._position = _Series(_POSITION, keep_s)
        self._flight = _Series(_FLIGHT, keep_s)
        self._camera = _Series(_CAMERA, keep_s)
        self._height = _Series(("height_m",), keep_s)
        self._ground = _Series(("height_m",), keep_s)
        self._accurate_s = float("-inf")

    def feed(self, message: Any, arrival_s: float | None = None) -> CameraEvent | None:
        """Take a MAVLink message of this vehicle; returns the camera event if it is one, with its pose complete.

        Args:
            message: decoded by pymavlink.
            arrival_s: UTC epoch seconds when it came, for vehicles that do not know UTC; None for now.
        """
        reboots = self._mavlink.reboots
        found = self._mavlink.feed(message)
        if self._mavlink.reboots != reboots:
            self._arrival_offset = None
        if found is None:
            return None
        if isinstance(found, CameraEvent):
            return self._event(found, arrival_s)
        boot_s = found.time_s or 0.0
        found.time_s = self._utc(boot_s, arrival_s)
        self.add(found)
        return None

    def add(self, sample: Sample) -> None:
        """Take a sample from any source (its time UTC)."""
        time_s = sample.time_s
        if time_s is None:
            return
        if sample.has_position and not self._is_outdone(sample):
            self._position.add(time_s, (sample.lat_deg, sample.lon_deg, sample.altitude_m, sample.sigma_m))
        elif sample.has_position:
            sample = replace(sample, lat_deg=None, lon_deg=None, altitude_m=None, sigma_m=None)
        if sample.height_m is not None:
            (self._ground if sample.height_is_ground else self._height).add(time_s, (sample.height_m,))
        if sample.flight_yaw_deg is not None:
            self._flight.add(time_s, (sample.flight_yaw_deg, sample.flight_pitch_deg, sample.flight_roll_deg))
        if sample.yaw_deg is not None:
            self._camera.add(time_s, (sample.yaw_deg, sample.pitch_deg, sample.roll_deg))
        self.latest = sample.merge(self.latest)
        self.latest.vehicle = self.vehicle

    def _is_outdone(self, sample: Sample) -> bool:
        """Whether a better receiver (RTK on the bus) tells the position at this time already."""
        time_s = sample.time_s or 0.0
        if sample.sigma_m is not None and sample.sigma_m <= _ACCURATE_M:
            self._accurate_s = time_s
            return False
        return abs(time_s - self._accurate_s) < _ACCURATE_FOR_S

    def at(self, time_s: float) -> Sample:
        """The pose at a moment (UTC), interpolated; fields are None where they are not known then.

        A camera whose own attitude is not reported is taken as fixed under the airframe.
        """
        sample = Sample(time_s=time_s, vehicle=self.vehicle)
        for series in (self._position, self._height, self._flight, self._camera):
            series.read(time_s, self._max_gap_s, sample)
        above = Sample()
        self._ground.read(time_s, self._max_gap_s, above)
        if above.height_m is not None:
            sample.height_m, sample.height_is_ground = above.height_m, True
        return sample if self._mavlink.has_gimbal else fixed_camera(sample)

    @property
    def has_gimbal(self) -> bool:
        """Whether any message told the camera's own attitude."""
        return self._mavlink.has_gimbal

    def _utc(self, boot_s: float, arrival_s: float | None) -> float:
        """UTC of a time since boot: by the vehicle's clock, else by the quickest arrival so far."""
        known = self._mavlink.utc(boot_s)
        if known is not None:
            return known
        offset = (self._clock() if arrival_s is None else arrival_s) - boot_s
        if self._arrival_offset is None or offset < self._arrival_offset:
            self._arrival_offset = offset
        return boot_s + self._arrival_offset

    def _event(self, event: CameraEvent, arrival_s: float | None) -> CameraEvent:
        if event.time_s is None:
            boot_s = event.boot_s
            now_s = self._clock() if arrival_s is None else arrival_s
            event.time_s = now_s if boot_s is None else self._utc(boot_s, arrival_s)
        event.sample.vehicle = self.vehicle
        event.sample.time_s = event.time_s
        around = self.at(event.time_s)
        if self._mavlink.has_gimbal:
            event.sample = event.sample.merge(around)
        else:
            event.sample = fixed_camera(event.sample).merge(around)
        self.last_event = event
        return event
