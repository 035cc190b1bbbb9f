"""DJI subtitles: telemetry in an SRT file next to a video, or in its subtitle track.

At least six layouts are in use. They are distinguished by the content of each block, not by model:

    [latitude: 41.42] [longitude: 2.23] [rel_alt: 1.3 abs_alt: 117.0] [gb_yaw: 90 gb_pitch: -90 gb_roll: 0]
    GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M                                      latitude first
    HOME(149.02,-20.25) 2017.08.05 14:11:51 / GPS(149.02,-20.25,16) BAROMETER:1.9      longitude first
    GPS (-58.85, -34.23, 15), HOME (...), D 698.70m, H 85.80m, F.PRY (..), G.PRY (..)  longitude first
    GPS (8.2090, 47.4692, 18), D 49.21m, H 45.60m, H.S ..., V.S ...               longitude first
    (no position at all)

The order of a GPS tuple is determined once per file: by range, by the distance to HOME written in the same block,
else by layout. `altitude` is not used as a height, because its meaning differs between models.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Final

from orthoswarm.model.earth import DEGREE_M
from telemetry.samples.findings import plural
from telemetry.samples.sample import Sample, checked
from telemetry.samples.times import epoch_of
from telemetry.samples.unreadable import MOST_TEXT_BYTES

_MAX_BLOCK = 4096

_CUE = re.compile(r"(\d{1,3}):(\d{2}):(\d{2})[,.](\d{1,3})\s*-->\s*(\d{1,3}):(\d{2}):(\d{2})[,.](\d{1,3})")
_PAIR = re.compile(r"\b([A-Za-z_]{2,24})\s*:\s*([+-]?\d+(?:\.\d+)?)")
_NUMBER = r"\s*([+-]?\d+(?:\.\d+)?)"
_TUPLE = re.compile(rf"GPS\s*\({_NUMBER}\s*,{_NUMBER}\s*(?:,{_NUMBER}\s*(M?))?[^)]{{0,16}}\)", re.IGNORECASE)
_HOME = re.compile(rf"HOME\s*\({_NUMBER}\s*,{_NUMBER}")
_DISTANCE = re.compile(rf"\bD{_NUMBER}\s*m\b")
_HEIGHT = re.compile(rf"\b(?:H{_NUMBER}\s*m\b|Hb\s*:{_NUMBER})")
_BAROMETER = re.compile(rf"BAROMETER\s*(?::{_NUMBER}|\({_NUMBER}\s*M?\))", re.IGNORECASE)
_GIMBAL = re.compile(rf"\bG\.PRY\s*\({_NUMBER}°?\s*,{_NUMBER}°?\s*,{_NUMBER}")
_FLIGHT = re.compile(rf"\bF\.PRY\s*\({_NUMBER}°?\s*,{_NUMBER}°?\s*,{_NUMBER}")
_DATE = re.compile(r"\d{4}[-./]\d{2}[-./]\d{2}[ T]\d{1,2}:\d{2}:\d{2}(?:[.,]\d{1,6}(?:[.,]\d{1,3})?)?")
_COMMA_PAIR = re.compile(r"\b(?:latitude|longt?itude)\s*:\s*[+-]?\d+,\d", re.IGNORECASE)
_COMMA_TUPLE = re.compile(r"\bGPS\s*\((?:\s*[+-]?\d+\s*,){3}\s*[+-]?\d", re.IGNORECASE)
"""Four whole numbers where two or three numbers belong: two of them are decimals behind a comma."""
_DECIMAL_COMMA = re.compile(r"(\d+),(\d+)")
_COUNT = re.compile(r"\b(?:FrameCnt|SrtCnt)\s*:\s*(\d{1,9})")

_SUBTITLE_RESTART_S: Final = 5.0  # subtitles whose times go back by more than this are those of another recording


@dataclass(slots=True)
class Cue:
    """One block: start and end in seconds of the video, its text, and the sample in it, None if there is none."""

    start_s: float
    end_s: float
    text: str
    sample: Sample | None = None


@dataclass(slots=True)
class Subtitles:
    """The content of an SRT file."""

    cues: list[Cue] = field(default_factory=list)  # in order of the file
    latitude_first: bool | None = None  # order of the GPS tuples, None where there are none
    notes: dict[str, str] = field(default_factory=dict)  # irregularities by code, one sentence each
    # times at which the subtitles of another recording begin, where the file joins several
    joints_s: list[float] = field(default_factory=list)

    @property
    def has_positions(self) -> bool:
        """Whether any block has a position."""
        return any(cue.sample is not None and cue.sample.has_position for cue in self.cues)


def read_srt(path: Path) -> Subtitles:
    """Read an SRT file; blocks that are not understood are left out. Raises OSError: the file cannot be read."""
    with path.open("rb") as handle:
        data = handle.read(MOST_TEXT_BYTES)
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    return parse_srt(data.decode(encoding, "replace"))


def parse_srt(text: str) -> Subtitles:
    """Read the text of an SRT file."""
    return _read(list(_blocks(text)))


def parse_cues(texts: list[tuple[float, float, str]]) -> Subtitles:
    """Read the packets of a subtitle track: start and end in seconds of the video, and text."""
    return _read([Cue(start, end, text[:_MAX_BLOCK]) for start, end, text in texts])


def _blocks(text: str) -> Iterator[Cue]:
    cues = list(_CUE.finditer(text))
    if not cues:
        yield from _undated_blocks(text)
    for i, cue in enumerate(cues):
        end = cues[i + 1].start() if i + 1 < len(cues) else len(text)
        h, m, s, ms, h2, m2, s2, ms2 = (int(g) for g in cue.groups())
        start_s = h * 3600 + m * 60 + s + ms / 1000.0
        end_s = h2 * 3600 + m2 * 60 + s2 + ms2 / 1000.0
        yield Cue(start_s, max(end_s, start_s), text[cue.end() : min(end, cue.end() + _MAX_BLOCK)])


def _undated_blocks(text: str) -> Iterator[Cue]:
    """Blocks of a file without cue times, timed by their dates relative to the first one."""
    first: float | None = None
    for block in re.split(r"\n\s*\n", text.replace("\r", "")):
        date = _DATE.search(block)
        moment = None if date is None else _local_time(date[0])
        if moment is not None:
            first = moment if first is None else first
            yield Cue(moment - first, moment - first, block[:_MAX_BLOCK])


def _read(blocks: list[Cue]) -> Subtitles:
    joints_s = _join(blocks)
    if any(_COMMA_PAIR.search(block.text) or _COMMA_TUPLE.search(block.text) for block in blocks):
        for block in blocks:
            block.text = _DECIMAL_COMMA.sub(r"\1.\2", block.text)
    result = Subtitles(cues=blocks, latitude_first=_latitude_first(blocks), joints_s=joints_s)
    for block in blocks:
        block.sample = _sample(block.text, result.latitude_first)
    _note_oddities(result)
    return result


def _join(blocks: list[Cue]) -> list[float]:
    """Put the recordings that a file joins one after the other; returns where each but the first begins, seconds.

    Each counts its times from zero. Blocks that are only out of order go back by less. A block with a damaged time
    tells neither where a recording begins nor where it ends.
    """
    starts_s = [block.start_s for block in blocks]
    joints_s: list[float] = []
    shift_s = before_s = end_s = 0.0
    for index, block in enumerate(blocks):
        damaged = _stands_out(starts_s, index)
        if not damaged:
            if block.start_s < min(before_s - _SUBTITLE_RESTART_S, _SUBTITLE_RESTART_S):
                shift_s = end_s
                joints_s.append(shift_s)
            before_s = block.start_s
        block.start_s += shift_s
        block.end_s += shift_s
        if not damaged:
            end_s = max(end_s, block.end_s)
    return joints_s


def _stands_out(values: list[float], index: int) -> bool:
    """Whether the two values nearest to one in the list are closer to each other than to it."""
    first = max(0, min(index - 1, len(values) - 3))
    near = [values[i] for i in range(first, min(first + 3, len(values))) if i != index]
    return len(near) == 2 and abs(near[0] - near[1]) < min(abs(values[index] - value) for value in near)


def _latitude_first(blocks: list[Cue]) -> bool | None:
    """Order of the GPS tuples of a file; None where there are none."""
    votes = {True: 0.0, False: 0.0}
    layout: bool | None = None
    for block in blocks[:: max(1, len(blocks) // 500)]:
        match = _TUPLE.search(block.text)
        if match is None:
            continue
        a, b = float(match[1]), float(match[2])
        if abs(a) > 90.0 or abs(b) > 90.0:
            return abs(b) > 90.0
        if layout is None:
            layout = bool(match[4]) and _BAROMETER.search(block.text) is not None
        home, distance = _HOME.search(block.text), _DISTANCE.search(block.text)
        if home is not None and distance is not None and float(distance[1]) > 20.0:
            da, db, flown = float(home[1]) - a, float(home[2]) - b, float(distance[1])
            for order, (dlat, dlon, lat) in ((True, (da, db, a)), (False, (db, da, b))):
                metres = DEGREE_M * math.hypot(dlat, dlon * math.cos(math.radians(lat)))
                votes[order] += abs(metres - flown) / flown
    if votes[True] != votes[False]:
        return votes[True] < votes[False]
    return layout


def _sample(text: str, latitude_first: bool | None) -> Sample | None:
    sample = Sample()
    pairs = {name.lower(): float(value) for name, value in _PAIR.findall(text)}
    sample.lat_deg = pairs.get("latitude")
    sample.lon_deg = pairs.get("longitude", pairs.get("longtitude"))
    if "focal_len" in pairs or "dzoom_ratio" in pairs:
        sample.zoom = pairs.get("focal_len", 1.0) * pairs.get("dzoom_ratio", 1.0)
    sample.height_m = pairs.get("rel_alt")
    sample.altitude_m = pairs.get("abs_alt", pairs.get("altitude"))
    sample.yaw_deg, sample.pitch_deg, sample.roll_deg = (pairs.get(f"gb_{n}") for n in ("yaw", "pitch", "roll"))
    if "gb_yaw" in pairs:
        sample.flight_yaw_deg = pairs.get("yaw", pairs.get("drone_yaw"))
    match = _TUPLE.search(text)
    if match is not None and sample.lat_deg is None:
        a, b = float(match[1]), float(match[2])
        sample.lat_deg, sample.lon_deg = (a, b) if latitude_first else (b, a)
    height = _HEIGHT.search(text) or _BAROMETER.search(text)
    if height is not None:
        sample.height_m = float(height[1] or height[2])
    gimbal, flight = _GIMBAL.search(text), _FLIGHT.search(text)
    if gimbal is not None:
        sample.pitch_deg, sample.roll_deg, sample.yaw_deg = (float(gimbal[i]) for i in (1, 2, 3))
    if flight is not None:
        sample.flight_pitch_deg, sample.flight_roll_deg, sample.flight_yaw_deg = (float(flight[i]) for i in (1, 2, 3))
    date = _DATE.search(text)
    if date is not None:
        sample.time_s = _local_time(date[0])
    count = _COUNT.search(text)
    sample.number = int(count[1]) if count else None
    return checked(sample)


def _local_time(written: str) -> float | None:
    """Epoch seconds of "2022-08-07 13:40:40,774,808" (milliseconds, microseconds); the zone is not written."""
    head, _, fraction = written.replace(".", "-", 2 if "." in written[:10] else 0).replace(",", ".").partition(".")
    digits = fraction.replace(".", "").replace("-", "")
    return epoch_of(f"{head}.{digits}" if digits else head)


def _note_oddities(result: Subtitles) -> None:
    samples = [cue.sample for cue in result.cues]
    placed = [s for s in samples if s is not None and s.has_position]
    if not result.cues:
        result.notes["srt-empty"] = "the subtitles hold no block with times"
        return
    if not placed:
        result.notes["srt-no-position"] = "the subtitles hold no position"
        return
    if result.latitude_first is not None:
        order = "latitude, longitude" if result.latitude_first else "longitude, latitude"
        result.notes["srt-tuple-order"] = f"the GPS tuple is read as {order}"
    if len(placed) < len(samples):
        missing = len(samples) - len(placed)
        result.notes["srt-gaps"] = f"{missing} of {len(samples)} blocks hold no position"
    decimals = max(
        (len(m[1].partition(".")[2]) for b in result.cues[:50] if (m := _TUPLE.search(b.text)) is not None), default=9
    )
    if decimals <= 4:
        result.notes["position-coarse"] = (
            f"positions have {decimals} decimals only, steps of {DEGREE_M * 10.0**-decimals:.0f} m"
        )
    if all(s.yaw_deg is None and s.flight_yaw_deg is None for s in placed):
        result.notes["srt-no-attitude"] = "the subtitles hold no yaw; it has to come from the course and the pictures"
    tuples = [_TUPLE.search(block.text) is not None for block in result.cues]
    if 0 < sum(t and s is not None and s.has_position for t, s in zip(tuples, samples)) < len(placed):
        result.notes["srt-mixed"] = "the subtitles mix two layouts: recordings of two cameras were joined"
    starts = [cue.start_s for cue in result.cues]
    if any(later < earlier for earlier, later in pairwise(starts)):
        result.notes["time-backwards"] = "the times of the subtitles go backwards; they are put in order"
    if result.joints_s:
        result.notes["srt-joined"] = (
            f"the times of the subtitles start again {plural(len(result.joints_s), 'time')}: the subtitles of "
            "joined recordings, read one after the other; they fit only a video that joins the same recordings"
        )
    if starts[0] > 60.0:
        result.notes["srt-late-start"] = f"the subtitles begin at {starts[0]:.0f} s, they are a part of a longer file"
