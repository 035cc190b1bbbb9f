"""Files of GNSS receivers: solutions of RTKLIB and Emlid (.pos: exposures or the track), DJI's Timestamp.MRK.

.MRK: number, GPS seconds of week, [week], antenna offsets (mm), latitude, longitude, ellipsoidal height, standard
deviations, quality. Offsets are not added: DJI states the camera's position there. Source: DJI's documents for the
Phantom 4 RTK.

.pos: comment lines begin with %; the last one that begins with a time scale (GPST, UTC, JST) names the columns: date
and time or week and seconds of week; latitude, longitude (degrees, or degrees, minutes, seconds) and height, or x, y, z
of the earth; quality, satellites, standard deviations. `*_events.pos` holds the exposures. Source: RTKLIB manual 2.4.2,
appendix B.1 (Solution Format).
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from telemetry.formats.log.log_data import FlightLog, NotALog
from telemetry.formats.log.mavlink_poses import ExposureEvent
from telemetry.samples.sample import Sample, checked
from telemetry.samples.times import GPS_EPOCH_S, GPS_MINUS_UTC_S, WEEK_S, epoch_of
from telemetry.samples.unreadable import MOST_TEXT_BYTES

_NUMBER = r"\s*([+-]?\d+(?:\.\d+)?)"
_MARK = re.compile(
    rf"^(\d+)\s+(\d+\.\d+)\s+\[(\d+)\].*?{_NUMBER},Lat\s+{_NUMBER},Lon\s+{_NUMBER},Ellh\s+{_NUMBER},{_NUMBER}",
    re.MULTILINE,
)
_SCALES: Final = {"GPST": GPS_MINUS_UTC_S, "UTC": 0.0, "JST": 9 * 3600.0}  # seconds that a time scale is ahead of UTC
_FIXED, _FLOAT = 1.0, 2.0
_LEAST_EPOCHS = 10
_EVEN_S, _EVEN_SHARE = 0.005, 0.9
"""Epochs of a receiver follow each other evenly to a millisecond, apart from missing ones; a camera that takes pictures
every two seconds does so to some hundredths (chosen), or evenly, too, where its times were rounded."""
_MOST_STEP_S = 1.0  # receivers log one to twenty epochs a second; photos for a map are seldom taken that often


def read_exposure_list(path: Path) -> FlightLog:
    """Read a list of exposures, or a receiver's track. Raises OSError: it cannot be read; NotALog: it is neither."""
    with path.open("rb") as handle:
        text = handle.read(MOST_TEXT_BYTES).decode("utf-8-sig", "replace")
    if path.suffix.lower() == ".mrk":
        events = []
        for match in _MARK.finditer(text):
            number, seconds, week, lat, lon, height, sigma_north, sigma_east = (
                float(group) for group in match.groups()
            )
            time_s = GPS_EPOCH_S + week * WEEK_S + seconds - GPS_MINUS_UTC_S
            sigma = max(sigma_north, sigma_east) or None
            events += _event(time_s, int(number), Sample(lat_deg=lat, lon_deg=lon, altitude_m=height, sigma_m=sigma))
        log = FlightLog(path=path, kind="DJI MRK", vehicle=path.stem, events=events)
    else:
        log = _solution(path, text)
    if not log.events and not log.samples:
        raise NotALog("the file holds no exposure with a position; check that it is an exposure list")
    return log


def _solution(path: Path, text: str) -> FlightLog:
    columns = _PositionColumns(GPS_MINUS_UTC_S, 3, _degrees)
    positions = []
    for line in text.splitlines():
        if line.startswith("%"):
            columns = _header(_words(line[1:])) or columns
            continue
        sample = _sample(_words(line), columns)
        if sample is not None:
            positions.append(sample)
    if _is_track(path.stem, positions):
        # A photo's place on a track is as good as the camera's clock, not as the receiver's fix.
        samples = [replace(position, sigma_m=None) for position in positions]
        return FlightLog(path=path, kind="RTKLIB track", vehicle=path.stem, samples=samples)
    events = [event for i, s in enumerate(positions) for event in _event(s.time_s or 0.0, i + 1, s)]
    return FlightLog(path=path, kind="RTKLIB events", vehicle=path.stem, events=events)


def _event(time_s: float, number: int, sample: Sample) -> list[ExposureEvent]:
    found = checked(sample)
    if found is None or not found.has_position or not 0.0 < time_s < 7.3e9:
        return []
    return [ExposureEvent(time_s, None, number, found, "exposure")]


@dataclass(frozen=True, slots=True)
class _PositionColumns:
    """What the header says."""

    ahead_s: float  # time scale less UTC
    words: int  # number of words of a position
    # latitude, longitude (degrees), height (metres) of these words as numbers
    position: Callable[[Sequence[float]], tuple[float, float, float]]
    deviations: int = 2  # number of the standard deviations that say something about the horizontal position


def _is_track(stem: str, samples: Sequence[Sample]) -> bool:
    """Whether positions are a receiver's track, not exposures.

    RTKLIB ends the names of exposures' files in `_events`, and people add to that.
    """
    if "event" in stem.lower() or len(samples) < _LEAST_EPOCHS:
        return False
    steps = np.diff(np.array([s.time_s for s in samples], dtype=np.float64))
    usual = float(np.median(steps))
    if not 0.0 < usual <= _MOST_STEP_S + _EVEN_S:
        return False
    return float(np.mean(np.abs(steps - usual * np.round(steps / usual)) < _EVEN_S)) >= _EVEN_SHARE


def _words(line: str) -> list[str]:
    return line.replace(",", " ").replace(";", " ").split()


def _header(words: Sequence[str]) -> _PositionColumns | None:
    """The columns named by a comment line, None if it names none."""
    if not words or words[0] not in _SCALES:
        return None
    names = " ".join(words[1:])
    if "baseline" in names:
        raise NotALog(
            "the file states distances from a base station, not positions; write it again with latitude and longitude"
        )
    ahead_s = _SCALES[words[0]]
    if "ecef" in names:
        return _PositionColumns(ahead_s, 3, _geocentric, deviations=3)
    return _PositionColumns(ahead_s, 7, _minutes) if "latitude(d'" in names else _PositionColumns(ahead_s, 3, _degrees)


def _sample(words: Sequence[str], columns: _PositionColumns) -> Sample | None:
    end = 2 + columns.words
    if len(words) < end + 4:
        return None
    try:
        numbers = [float(word) for word in words[2 : end + 2 + columns.deviations]]
        written = epoch_of(" ".join(words[:2]))
        time_s = (
            GPS_EPOCH_S + int(words[0]) * WEEK_S + float(words[1]) if written is None else written
        ) - columns.ahead_s
        lat, lon, height = columns.position(numbers[: columns.words])
    except ValueError:
        return None
    quality, _, *deviations = numbers[columns.words :]
    spread = max(deviations)
    sigma = spread if quality in (_FIXED, _FLOAT) and spread > 0.0 else None
    sample = checked(Sample(time_s=time_s, lat_deg=lat, lon_deg=lon, altitude_m=height, sigma_m=sigma))
    return sample if sample is not None and sample.has_position and sample.time_s is not None else None


def _degrees(numbers: Sequence[float]) -> tuple[float, float, float]:
    lat, lon, height = numbers
    return lat, lon, height


def _minutes(numbers: Sequence[float]) -> tuple[float, float, float]:
    """Of degrees, minutes and seconds; the sign stands before the degrees, also where they are 0."""
    lat, lon = (
        math.copysign(abs(degrees) + minutes / 60.0 + seconds / 3600.0, degrees)
        for degrees, minutes, seconds in (numbers[:3], numbers[3:6])
    )
    return lat, lon, numbers[6]


def _geocentric(numbers: Sequence[float]) -> tuple[float, float, float]:
    """Of x, y, z in metres."""
    lon, lat, height = _geodetic().transform(*numbers)
    return float(lat), float(lon), float(height)


@cache
def _geodetic() -> Any:
    import pyproj

    return pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
