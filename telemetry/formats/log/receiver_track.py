"""Tracks of GPS loggers, phones and watches: GPX, and NMEA 0183 sentences.

GPX: track points with their times; it is searched, not parsed, so that a file which was not closed still gives what it
holds. NMEA: RMC has the date, GGA the altitude; a GGA is dated by the RMC or ZDA before it, over midnight. Sources: GPX
1.1 schema (Topografix), NMEA 0183 4.11.
"""

import re
from collections.abc import Iterator
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Final

from telemetry.formats.log.log_data import FlightLog, NotALog, add_sample
from telemetry.samples.findings import Finding, plural
from telemetry.samples.times import epoch_of
from telemetry.samples.unreadable import MOST_TEXT_BYTES

TRACK_SUFFIXES: Final = frozenset({".gpx", ".nmea", ".nma"})
_MAX_GAP_S: Final = 10.0
"""Fixes so far apart are interpolated between: loggers write one in some seconds, or where the way bends."""
_DAY_S: Final = 86_400.0
_POINT = re.compile(r"<(?:\w+:)?trkpt\b([^>]{0,1000}[^>/])>(.{0,2000}?)</(?:\w+:)?trkpt\s*>", re.DOTALL)
_ATTRIBUTE = re.compile(r"""\b(lat|lon)\s*=\s*["']\s*([^"']*?)\s*["']""")
_CHILD = re.compile(r"<(?:\w+:)?(time|ele)\b[^>]{0,100}>([^<]{0,99})")
_SENTENCE = re.compile(r"\$([A-Z]{2})(RMC|GGA|GNS|ZDA),([^*$\r\n]*)(?:\*([0-9A-Fa-f]{2}))?")


def read_track(path: Path) -> FlightLog:
    """Read a GPX file or NMEA sentences. Raises OSError: it cannot be read; NotALog: it holds no dated position."""
    with path.open("rb") as handle:
        text = handle.read(MOST_TEXT_BYTES).decode("utf-8-sig", "replace")
    gpx = path.suffix.lower() == ".gpx"
    log = FlightLog(path=path, kind="GPX" if gpx else "NMEA", vehicle=path.stem, max_gap_s=_MAX_GAP_S)
    undated = _gpx(log, text) if gpx else _nmea(log, text)
    if not log.samples:
        raise NotALog(
            "its positions have no times, so that no picture can be placed by them; export the track with its times"
            if undated
            else "the file holds no position of a track; check that it is the right one"
        )
    if undated:
        text = f"{plural(undated, 'position')} of {path.name} have no time and are not used"
        log.findings.append(Finding("track-without-time", text))
    return log


def is_nmea(path: Path) -> bool:
    """Whether a file begins with sentences of a receiver."""
    with path.open("rb") as handle:
        return re.search(rb"\$(?:G[PNLABQI]|BD)[A-Z]{3},", handle.read(1024)) is not None


def _gpx(log: FlightLog, text: str) -> int:
    """Add the points of all tracks; returns how many have no time."""
    undated = 0
    for attributes, body in _POINT.findall(text):
        place, said = dict(_ATTRIBUTE.findall(attributes)), dict(_CHILD.findall(body))
        moment = epoch_of(said.get("time", ""))
        lat, lon = _number(place.get("lat", "")), _number(place.get("lon", ""))
        if moment is None:
            undated += lat is not None and lon is not None
        elif lat is not None and lon is not None:
            add_sample(log, moment, lat_deg=lat, lon_deg=lon, altitude_m=_number(said.get("ele", "")))
    return undated


def _nmea(log: FlightLog, text: str) -> int:
    """Add the positions of all sentences, those of one time once; returns how many have no date."""
    day_s: float | None = None
    before_s, undated = 0.0, 0
    fixes: dict[float, tuple[float, float]] = {}
    altitudes: dict[float, float | None] = {}
    for kind, words in _sentences(log, text):
        clock_s = _clock_s(words[0])
        if clock_s is None:
            continue
        if day_s is not None and clock_s < before_s - 0.5 * _DAY_S:
            day_s += _DAY_S
        before_s = clock_s
        stated = _date_s(words, kind)
        day_s = day_s if stated is None else stated
        at = {"RMC": 2, "GGA": 1, "GNS": 1}.get(kind)
        fixed = words[1] == "A" if kind == "RMC" else words[5] not in ("", "0", "N", "NN", "NNN")
        if at is None or not fixed:
            continue
        lat, lon = _degrees(words[at], words[at + 1]), _degrees(words[at + 2], words[at + 3])
        if lat is None or lon is None:
            continue
        if day_s is None:
            undated += 1
            continue
        fixes[day_s + clock_s] = lat, lon
        if kind != "RMC":
            altitudes[day_s + clock_s] = _number(words[8])
    for time_s, (lat, lon) in fixes.items():
        add_sample(log, time_s, lat_deg=lat, lon_deg=lon, altitude_m=altitudes.get(time_s))
    return undated


def _sentences(log: FlightLog, text: str) -> Iterator[tuple[str, list[str]]]:
    """Kinds and words of the sentences whose checksums are right; of all, if none is."""
    found = _SENTENCE.findall(text)
    right = [
        not given or int(given, 16) == reduce(xor, f"{t}{k},{body}".encode("latin-1", "replace"), 0)
        for t, k, body, given in found
    ]
    if not any(right) and found:
        log.findings.append(Finding("checksum-wrong", f"no checksum of {log.path.name} is right; they are not heeded"))
    elif not all(right):
        lost = plural(len(right) - sum(right), "damaged sentence")
        log.findings.append(Finding("checksum-wrong", f"left out of {log.path.name}: {lost}"))
    for (_, kind, body, _), sound in zip(found, right, strict=True):
        if sound or not any(right):
            yield kind, [*body.split(","), *[""] * 12]


def _clock_s(word: str) -> float | None:
    """Seconds since midnight of hhmmss.ss."""
    value = _number(word[4:])
    if value is None or not word[:4].isdecimal():
        return None
    return int(word[:2]) * 3600.0 + int(word[2:4]) * 60.0 + value


def _date_s(words: list[str], kind: str) -> float | None:
    """Midnight of the date in an RMC (ddmmyy) or ZDA (dd, mm, yyyy), epoch seconds; None without one."""
    if kind == "RMC" and len(words[8]) == 6 and words[8].isdecimal():
        day, month, year = words[8][:2], words[8][2:4], f"20{words[8][4:]}"
    elif kind == "ZDA" and all(word.isdecimal() for word in words[1:4]):
        day, month, year = words[1:4]
    else:
        return None
    return epoch_of(f"{year}-{month}-{day} 00:00:00")


def _degrees(word: str, hemisphere: str) -> float | None:
    """Degrees of (d)ddmm.mmmm and a hemisphere."""
    value = _number(word)
    if value is None or hemisphere not in ("N", "S", "E", "W"):
        return None
    degrees = value // 100.0 + value % 100.0 / 60.0
    return -degrees if hemisphere in ("S", "W") else degrees


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
