"""EXIF without a library: the tags of a TIFF structure (JPEG APP1, PNG eXIf, WebP EXIF, a TIFF file itself).

Own parser because it must take far less than a millisecond per photo and tolerate damaged files: every
offset is checked, every count is bounded, and bad data never raises. Source: EXIF 2.32 and 3.0, TIFF 6.0.
"""

import math
import mmap
import struct
from dataclasses import dataclass, field

from telemetry.samples.sample import Sample, is_position
from telemetry.samples.times import ZONE_CONTRADICTS, ZONE_UNKNOWN, epoch_of, parse_offset, parse_time

Value = str | bytes | tuple[float, ...]
Tags = dict[int, Value]
Buffer = bytes | mmap.mmap

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
_CODES = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 11: "f", 12: "d", 13: "I"}
_MAX_ENTRIES = 512
_MAX_TEXT = 4096
_MAX_BLOB = 1 << 20

WIDTH, HEIGHT, MAKE, MODEL, DATE_TIME = 0x100, 0x101, 0x10F, 0x110, 0x132
XMP, EXIF_IFD, GPS_IFD, DNG_VERSION = 0x2BC, 0x8769, 0x8825, 0xC612
PIXEL_SCALE, TIE_POINTS, GEO_TRANSFORM, GEO_KEYS = 0x830E, 0x8482, 0x85D8, 0x87AF
DATE_ORIGINAL, OFFSET_TIME, OFFSET_ORIGINAL, SUBSEC, SUBSEC_ORIGINAL = 0x9003, 0x9010, 0x9011, 0x9290, 0x9291
MAKER_NOTE, FOCAL_MM, FOCAL_PLANE_X, FOCAL_PLANE_UNIT = 0x927C, 0x920A, 0xA20E, 0xA210
PIXEL_X, FOCAL_35MM, DIGITAL_ZOOM = 0xA002, 0xA405, 0xA404

_WRITTEN_CHARACTERS = 19  # length of a time in EXIF, without the zero after it

_LARGE_MAIN = frozenset({XMP})
_LARGE_EXIF = frozenset({MAKER_NOTE})
# Strips, tiles and colour maps can be megabytes and are not needed here.
_SKIPPED = frozenset({0x111, 0x117, 0x140, 0x144, 0x145, 0x201, 0x202, 0x14A, 0x9286})
_MOST_NOTE_ENTRIES = 256


@dataclass(slots=True)
class Exif:
    """The tags of the three directories that are used, by number."""

    main: Tags = field(default_factory=dict)  # IFD0
    exif: Tags = field(default_factory=dict)  # the EXIF IFD
    gps: Tags = field(default_factory=dict)  # the GPS IFD


def parse_tiff(data: Buffer) -> Exif:
    """Read the directories of a TIFF structure; damaged entries are left out, nothing is raised."""
    head = bytes(data[:8])
    if len(head) < 8 or head[:4] not in (b"II*\0", b"MM\0*"):
        return Exif()
    order = "<" if head[:2] == b"II" else ">"
    main = _directory(data, order, struct.unpack(order + "I", head[4:8])[0], _LARGE_MAIN)
    result = Exif(main)
    pointer = number(main.get(EXIF_IFD))
    if pointer is not None:
        result.exif = _directory(data, order, int(pointer), _LARGE_EXIF)
    pointer = number(main.get(GPS_IFD))
    if pointer is not None:
        result.gps = _directory(data, order, int(pointer), frozenset())
    return result


def _directory(data: Buffer, order: str, offset: int, large: frozenset[int]) -> Tags:
    size = len(data)
    if not 8 <= offset <= size - 2:
        return {}
    (count,) = struct.unpack_from(order + "H", data, offset)
    count = min(count, _MAX_ENTRIES, (size - offset - 2) // 12)
    tags: Tags = {}
    entry = struct.Struct(order + "HHI4s")
    for i in range(count):
        tag, kind, length, inline = entry.unpack_from(data, offset + 2 + 12 * i)
        unit = _SIZES.get(kind)
        if unit is None or tag in _SKIPPED or length == 0:
            continue
        limit = _MAX_BLOB if tag in large else _MAX_TEXT
        total = unit * length
        if total > limit:
            continue
        if total <= 4:
            raw = inline[:total]
        else:
            (start,) = struct.unpack(order + "I", inline)
            raw = bytes(data[start : start + total])
            if len(raw) < total:
                continue
        value = _value(raw, order, kind, length)
        if value is not None and tag not in tags:
            tags[tag] = value
    return tags


def _value(raw: bytes, order: str, kind: int, length: int) -> Value | None:
    if kind == 2:
        return raw.split(b"\0", 1)[0].decode("utf-8", "replace").strip()
    if kind == 7 or (kind == 1 and length > 16):
        return raw
    if kind in (5, 10):
        pairs = struct.unpack(f"{order}{2 * length}{'I' if kind == 5 else 'i'}", raw)
        return tuple(n / d if d else math.nan for n, d in zip(pairs[::2], pairs[1::2], strict=True))
    return tuple(map(float, struct.unpack(f"{order}{length}{_CODES[kind]}", raw)))


def number(value: Value | None) -> float | None:
    """The first number of a tag, None where it is absent, text or not finite."""
    if isinstance(value, tuple) and value and math.isfinite(value[0]):
        return value[0]
    return None


def text(value: Value | None) -> str:
    """A tag as text, "" where it is absent or no text."""
    if isinstance(value, bytes):
        value = value.split(b"\0", 1)[0].decode("utf-8", "replace").strip()
    return value if isinstance(value, str) else ""


def gps_position(gps: Tags) -> tuple[float, float] | None:
    """Latitude and longitude in degrees of a GPS directory; None where absent or impossible.

    0, 0 counts as absent: receivers without a fix write it.
    """
    lat, lon = _sexagesimal(gps.get(2)), _sexagesimal(gps.get(4))
    if lat is None or lon is None:
        return None
    lat = -abs(lat) if text(gps.get(1)).upper().startswith("S") else lat
    lon = -abs(lon) if text(gps.get(3)).upper().startswith("W") else lon
    return (lat, lon) if is_position(lat, lon) else None


def gps_signs(gps: Tags) -> tuple[bool, bool]:
    """Whether a GPS directory states the hemisphere of its latitude, and of its longitude."""
    lat, lon = _sexagesimal(gps.get(2)), _sexagesimal(gps.get(4))
    return (
        text(gps.get(1)).upper()[:1] in ("N", "S") or (lat is not None and lat < 0.0),
        text(gps.get(3)).upper()[:1] in ("E", "W") or (lon is not None and lon < 0.0),
    )


def _sexagesimal(value: Value | None) -> float | None:
    """Degrees, minutes and seconds as degrees, negative if any is: some programs sign all three, others the first."""
    if not isinstance(value, tuple) or not value or not math.isfinite(value[0]):
        return None
    parts = [part for part in value[:3] if math.isfinite(part)]
    total = sum(abs(part) / scale for part, scale in zip(parts, (1.0, 60.0, 3600.0), strict=False))
    return -total if any(part < 0.0 for part in parts) else total


def gps_altitude(gps: Tags) -> float | None:
    """Altitude in metres, negative below the sea or the ellipsoid, whichever the camera counts from.

    EXIF 3.0 has four references: 0 and 1 above and below the ellipsoid, 2 and 3 above and below the sea. Earlier
    editions call the first two the sea's, so that they do not tell from what the camera counts.
    """
    altitude = number(gps.get(6))
    if altitude is None:
        return None
    ref = gps.get(5)
    code = ref[0] if isinstance(ref, tuple | bytes) and ref else 0
    return -abs(altitude) if code in (1, 3) else altitude


def gps_time(gps: Tags) -> float | None:
    """UTC epoch seconds of GPSDateStamp and GPSTimeStamp, None where either is missing."""
    stamp = gps.get(7)
    if not isinstance(stamp, tuple) or len(stamp) < 3 or not all(map(math.isfinite, stamp[:3])):
        return None
    day = epoch_of(text(gps.get(29))[:10] + " 00:00:00")
    return None if day is None else day + stamp[0] * 3600.0 + stamp[1] * 60.0 + stamp[2]


def exposure_time(exif: Exif) -> tuple[float, str] | None:
    """Time of exposure: UTC epoch seconds, and the source of the time zone.

    The camera's clock has sub-seconds but often no zone, the GPS stamp a zone but whole seconds and a lag: where
    both exist the stamp only determines the zone (to the quarter of an hour), unless the clock differs from it by more
    than two minutes or was never set (`_by_both`). A zone that is written counts where the stamp gives no other: it may
    be that of an editor, of another date in the file, or never set.
    """
    changed = text(exif.main.get(DATE_TIME))
    written = text(exif.exif.get(DATE_ORIGINAL)) or changed
    local = parse_time(written) or parse_time(written[:_WRITTEN_CHARACTERS])  # what follows is no part of it
    stamp = gps_time(exif.gps)
    if local is None:
        return None if stamp is None else (stamp, "EXIF GPS time")
    seconds, zoned = local
    own = written == changed  # SUBSEC and OFFSET_TIME belong to DATE_TIME
    subsec = text(exif.exif.get(SUBSEC_ORIGINAL)) or (text(exif.exif.get(SUBSEC)) if own else "")
    if subsec.isdigit() and seconds == int(seconds):
        seconds += float(f"0.{subsec[:9]}")
    zone = text(exif.exif.get(OFFSET_ORIGINAL)) or (text(exif.exif.get(OFFSET_TIME)) if own else "")
    offset = 0.0 if zoned else parse_offset(zone)
    exposed = None if stamp is None else _by_both(seconds, stamp)
    if offset is None:
        return exposed or (seconds, f"EXIF time {ZONE_UNKNOWN}")
    stated = seconds - offset
    if exposed and exposed[1] == _ZONE_OF_STAMP and abs(math.remainder(stated - exposed[0], _DAY_S)) > _MOST_LAG_S:
        return exposed[0], f"EXIF time, {ZONE_CONTRADICTS}"
    return stated, "EXIF time with zone"


_DAY_S, _QUARTER_S, _MOST_LAG_S = 86_400.0, 900.0, 120.0
_WEST, _EAST = -11 * 4, 14 * 4  # the time zones in which people live, in quarters of an hour east of UTC
_ROLLOVER_DAYS = 1024 * 7
"""A receiver that counts weeks with ten bits is early by so much when they overflow (IS-GPS-200, 20.3.3.3.1.1)."""
_YEAR_DAYS = 366
_ZONE_OF_STAMP = "EXIF time, zone from GPS time"


def _by_both(clock: float, stamp: float) -> tuple[float, str] | None:
    """UTC by the camera's clock and the receiver's stamp; None if nothing of the stamp can be believed.

    The stamp's time of day comes from the satellites, but its date may be wrong. Where both differ by more than a time
    zone, the days between them decide which of them is:

    - one day: the stamp has the local date, or not yet the new day's. The clock is right, if its minutes are.
    - The stamp is 1,024 weeks early, or a multiple: the receiver's week number rolled over. The same.
    - The stamp is more than a year early, but not so: the receiver had no fix.
    - Otherwise the clock was set wrongly, or never, as clocks start in a past year. The stamp is right.

    clock: the camera's time as if it were UTC, epoch seconds. stamp: GPSDateStamp and GPSTimeStamp, epoch seconds.
    """
    days = _days_early(clock - stamp)
    if days > _YEAR_DAYS:
        stamp += round(days / _ROLLOVER_DAYS) * _ROLLOVER_DAYS * _DAY_S
        days = _days_early(clock - stamp)
        if abs(days) > 1:
            return None
    if abs(days) <= 1:
        zone = round((clock - stamp) / _QUARTER_S) * _QUARTER_S
        if abs(clock - stamp - zone) < _MOST_LAG_S:
            return clock - zone + days * _DAY_S, _ZONE_OF_STAMP
    return stamp, "EXIF GPS time"


def _days_early(apart: float) -> int:
    """Days by which the stamp would have to be later for its difference from the clock, seconds, to be a time zone."""
    if _WEST <= round(apart / _QUARTER_S) <= _EAST:
        return 0
    # 13 h and more share their time of day with -11 h and less: where the date does not tell, the zone of more people.
    return math.ceil((apart - 13.0 * 3600.0 - _MOST_LAG_S) / _DAY_S)


def parse_dji(note: bytes) -> Sample | None:
    """Attitude in a DJI MakerNote, of models that write no XMP; None if it has none or is another note. Never raises.

    The note is a directory of 12-byte entries in a byte order of its own; tags 3-11 are single floats held in the entry
    itself: speed x, y, z; aircraft pitch, yaw, roll; camera pitch, yaw, roll (degrees; true north, camera pitch -90 =
    straight down). Source: ExifTool's DJI tag table, checked with photos that have both.
    """
    if len(note) < 14:
        return None
    # Software that rewrites the EXIF may change its byte order but not the note's, which the note's own count shows.
    order = "<" if note[1] == 0 else ">"
    (count,) = struct.unpack_from(order + "H", note)
    count = min(count, _MOST_NOTE_ENTRIES, (len(note) - 2) // 12)
    floats: dict[int, float] = {}
    is_dji = False
    for i in range(count):
        tag, kind, length, raw = struct.unpack_from(order + "HHI4s", note, 2 + 12 * i)
        if tag == 1 and kind == 2:
            is_dji = raw[:3] == b"DJI"
        elif 3 <= tag <= 11 and kind == 11 and length == 1:
            (value,) = struct.unpack(order + "f", raw)
            if math.isfinite(value) and abs(value) <= 720.0:
                floats[tag] = round(value, 4)
    if not is_dji or not floats:
        return None
    pitch, yaw, roll, camera_pitch, camera_yaw, camera_roll = (floats.get(tag) for tag in range(6, 12))
    return Sample(
        flight_pitch_deg=pitch, flight_yaw_deg=yaw, flight_roll_deg=roll, pitch_deg=camera_pitch, yaw_deg=camera_yaw,
        roll_deg=camera_roll,
    )  # fmt: skip
