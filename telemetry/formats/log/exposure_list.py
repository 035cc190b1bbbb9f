"""Exposure lists of GNSS receivers: event files of RTKLIB and Emlid (.pos), DJI's Timestamp.MRK.

.pos: comment lines begin with %, the last of them names the time scale (GPST or UTC) and the columns; then date and
time, latitude, longitude (degrees), ellipsoidal height, quality, satellites, standard deviations north, east, up.
.MRK: number, GPS seconds of week, [week], antenna offsets (mm), latitude, longitude, ellipsoidal height, standard
deviations, quality. Offsets are not added: DJI states the camera's position there. Source: RTKLIB manual, appendix B;
DJI's documents for the Phantom 4 RTK.
"""

import re
from pathlib import Path

from telemetry.formats.log.log_data import FlightLog, NotALog
from telemetry.formats.log.mavlink_poses import CameraEvent
from telemetry.samples.sample import Sample, checked
from telemetry.samples.times import GPS_EPOCH_S, GPS_MINUS_UTC_S, WEEK_S, parse_time
from telemetry.samples.unreadable import MOST_TEXT_BYTES

_NUMBER = r"\s*([+-]?\d+(?:\.\d+)?)"
_MARK = re.compile(
    rf"^(\d+)\s+(\d+\.\d+)\s+\[(\d+)\].*?{_NUMBER},Lat\s+{_NUMBER},Lon\s+{_NUMBER},Ellh\s+{_NUMBER},{_NUMBER}",
    re.MULTILINE,
)
_FIXED, _FLOAT = 1.0, 2.0


def read_exposure_list(path: Path) -> FlightLog:
    """Read a list of exposures.

    Raises:
        OSError: it cannot be read. NotALog: it is not such a list.
    """
    with path.open("rb") as handle:
        text = handle.read(MOST_TEXT_BYTES).decode("utf-8-sig", "replace")
    is_marks = path.suffix.lower() == ".mrk"
    log = FlightLog(path=path, kind="DJI MRK" if is_marks else "RTKLIB events", vehicle=path.stem)
    log.events = _marks(text) if is_marks else _positions(text)
    if not log.events:
        raise NotALog("the file holds no exposure with a position; check that it is an exposure list")
    return log


def _marks(text: str) -> list[CameraEvent]:
    events = []
    for match in _MARK.finditer(text):
        number, seconds, week, lat, lon, height, sigma_north, sigma_east = (float(group) for group in match.groups())
        time_s = GPS_EPOCH_S + week * WEEK_S + seconds - GPS_MINUS_UTC_S
        sigma = max(sigma_north, sigma_east) or None
        events += _event(time_s, int(number), Sample(lat_deg=lat, lon_deg=lon, altitude_m=height, sigma_m=sigma))
    return events


def _positions(text: str) -> list[CameraEvent]:
    is_utc = False
    events: list[CameraEvent] = []
    for line in text.splitlines():
        if line.startswith("%"):
            is_utc = is_utc or "UTC" in line.split()[0:2]
            continue
        words = line.replace(",", " ").split()
        exposed = parse_time(" ".join(words[:2]))
        if exposed is None or len(words) < 9:
            continue
        try:
            lat, lon, height, quality, _, north, east = (float(word) for word in words[2:9])
        except ValueError:
            continue
        sigma = max(north, east) if quality in (_FIXED, _FLOAT) and max(north, east) > 0.0 else None
        sample = Sample(lat_deg=lat, lon_deg=lon, altitude_m=height, sigma_m=sigma)
        events += _event(exposed[0] - (0.0 if is_utc else GPS_MINUS_UTC_S), len(events) + 1, sample)
    return events


def _event(time_s: float, number: int, sample: Sample) -> list[CameraEvent]:
    found = checked(sample)
    if found is None or not found.has_position or not 0.0 < time_s < 7.3e9:
        return []
    return [CameraEvent(time_s, None, number, found, "exposure")]
