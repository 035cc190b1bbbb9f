"""Poses over time: interpolation without guessing beyond gaps.

Every field has its own times, so that a source which sends position at 5 Hz and attitude at 50 Hz needs no
joining. Positions are interpolated along the chord, angles over the shortest arc; nothing is extrapolated and no gap
longer than `max_gap_s` is bridged.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.arrays import Array
from telemetry.samples.sample import CAMERA_ANGLES, FLIGHT_ANGLES, Sample

_WRAPPED = (*CAMERA_ANGLES, *FLIGHT_ANGLES, "lon_deg")
_FIELDS = ("lat_deg", "height_m", "altitude_m", "fov_deg", "zoom", "sigma_m", *_WRAPPED)
_GROUND = "ground_m"  # name of the series of heights above the ground below


class Timeline:
    """Samples of one vehicle over time, which can be read at any time in between.

    Attributes:
        max_gap_s: neighbours further apart than this are not interpolated between.
    """

    def __init__(self, samples: Iterable[Sample], *, max_gap_s: float = 2.0) -> None:
        self.max_gap_s = max_gap_s
        rows = sorted((s for s in samples if s.time_s is not None), key=lambda s: s.time_s or 0.0)
        self._series = {name: _series(rows, name) for name in _FIELDS if name != "height_m"}
        # Heights above takeoff and above the ground are different quantities, even where both are recorded.
        self._series["height_m"] = _series([s for s in rows if not s.height_is_ground], "height_m")
        self._series[_GROUND] = _series([s for s in rows if s.height_is_ground], "height_m")
        self._times = np.array([s.time_s for s in rows], dtype=np.float64)
        self._vehicle = next((s.vehicle for s in rows if s.vehicle), None)

    def __len__(self) -> int:
        return len(self._times)

    @property
    def span(self) -> tuple[float, float] | None:
        """First and last time, None if it is empty."""
        return (float(self._times[0]), float(self._times[-1])) if len(self._times) else None

    def values(self, name: str, times: ArrayLike) -> Array:
        """A field at some times, float64, NaN where there are no neighbours within the gap."""
        t = np.asarray(times, dtype=np.float64)
        moments, values = self._series[name]
        if len(moments) == 0:
            return np.full(t.shape, np.nan)
        result = np.interp(t, moments, values)
        right = np.clip(np.searchsorted(moments, t, side="left"), 0, len(moments) - 1)
        left = np.clip(np.where(moments[right] > t, right - 1, right), 0, len(moments) - 1)
        bridged = moments[right] - moments[left] <= self.max_gap_s
        # At a sample's own time no interpolation is needed; before the first and after the last there is no value.
        held = (bridged & (t >= moments[0]) & (t <= moments[-1])) | (moments[right] == t)
        result = np.where(held, result, np.nan)
        if name in _WRAPPED:
            result = wrap_deg(result)
        return np.asarray(result)

    def at(self, time_s: float) -> Sample:
        """The pose at a time; unknown fields are None."""
        return self.at_all([time_s])[0]

    def at_all(self, times: ArrayLike) -> list[Sample]:
        """The poses at many times."""
        moments = np.asarray(times, dtype=np.float64)
        columns = [(name, self.values(name, moments).tolist()) for name in _FIELDS if len(self._series[name][0])]
        ground = self.values(_GROUND, moments).tolist()
        result = []
        for i, moment in enumerate(moments.tolist()):
            sample = Sample(time_s=moment, vehicle=self._vehicle)
            for name, column in columns:
                if column[i] == column[i]:
                    setattr(sample, name, column[i])
            if ground[i] == ground[i]:
                sample.height_m, sample.height_is_ground = ground[i], True
            if sample.lat_deg is None or sample.lon_deg is None:
                sample.lat_deg = sample.lon_deg = None
            result.append(sample)
        return result


def _series(rows: Sequence[Sample], name: str) -> tuple[Array, Array]:
    """Times and values of one field, times strictly increasing, angles unwrapped."""
    pairs = [(s.time_s, v) for s in rows if (v := getattr(s, name)) is not None]
    if not pairs:
        return np.zeros(0), np.zeros(0)
    times, values = np.array(pairs, dtype=np.float64).T
    times, first = np.unique(times, return_index=True)
    values = values[first]
    if name in _WRAPPED:
        values = np.degrees(np.unwrap(np.radians(values)))
    return times, values
