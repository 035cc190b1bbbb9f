"""Files of GNSS receivers: solutions of RTKLIB and Emlid (.pos: exposures or the track), DJI's Timestamp.MRK.

.MRK: number, GPS seconds of week, [week], antenna offsets (mm), latitude, longitude, ellipsoidal height, standard
deviations, quality. Offsets are not added: DJI states the camera's position there. Source: DJI's documents for the
Phantom 4 RTK.
"""

import re
from dataclasses import replace
from pathlib import Path

from telemetry.formats.log.log_data import FlightLog, NotALog
from telemetry.formats.log.mavlink_poses import CameraEvent
from telemetry.formats.log.rtklib_solution import is_track, read_solution
from telemetry.samples.sample import Sample, checked
from telemetry.samples.times import GPS_EPOCH_S, GPS_MINUS_UTC_S, WEEK_S
from telemetry.samples.unreadable import MOST_TEXT_BYTES

_NUMBER = r"\s*([+-]?\d+(?:\.\d+)?)"
_MARK = re.compile(
    rf"^(\d+)\s+(\d+\.\d+)\s+\[(\d+)\].*?{_NUMBER},Lat\s+{_NUMBER},Lon\s+{_NUMBER},Ellh\s+{_NUMBER},{_NUMBER}",
    re.MULTILINE,
)


def read_exposure_list(path: Path) -> FlightLog:
    """Read a list of exposures, or a receiver's track.

    Raises:
        OSError: it cannot be read. NotALog: it is neither.
    """
    with path.open("rb") as handle:
        text = handle.read(MOST_TEXT_BYTES).decode("utf-8-sig", "replace")
    if path.suffix.lower() == ".mrk":
        log = FlightLog(path=path, kind="DJI MRK", vehicle=path.stem, events=_marks(text))
    else:
        log = _solution(path, text)
    if not log.events and not log.samples:
        raise NotALog("the file holds no exposure with a position; check that it is an exposure list")
    return log


def _solution(path: Path, text: str) -> FlightLog:
    positions = read_solution(text)
    if is_track(path.stem, positions):
        # A photo's place on a track is as good as the camera's clock, not as the receiver's fix.
        samples = [replace(position, sigma_m=None) for position in positions]
        return FlightLog(path=path, kind="RTKLIB track", vehicle=path.stem, samples=samples)
    events = [event for i, s in enumerate(positions) for event in _event(s.time_s or 0.0, i + 1, s)]
    return FlightLog(path=path, kind="RTKLIB events", vehicle=path.stem, events=events)


def _marks(text: str) -> list[CameraEvent]:
    events = []
    for match in _MARK.finditer(text):
        number, seconds, week, lat, lon, height, sigma_north, sigma_east = (float(group) for group in match.groups())
        time_s = GPS_EPOCH_S + week * WEEK_S + seconds - GPS_MINUS_UTC_S
        sigma = max(sigma_north, sigma_east) or None
        events += _event(time_s, int(number), Sample(lat_deg=lat, lon_deg=lon, altitude_m=height, sigma_m=sigma))
    return events


def _event(time_s: float, number: int, sample: Sample) -> list[CameraEvent]:
    found = checked(sample)
    if found is None or not found.has_position or not 0.0 < time_s < 7.3e9:
        return []
    return [CameraEvent(time_s, None, number, found, "exposure")]
