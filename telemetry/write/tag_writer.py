"""Poses written into JPEG files, as EXIF and XMP that OpenDroneMap, QGIS and our own reader understand.

EXIF: position, altitude, time (UTC, with sub-seconds; local where the zone is unknown), direction of the picture's up,
a focal length that gives the field of view. XMP: yaw, pitch (from nadir) and roll in Pix4D's Camera name space, which
ODM reads for every make, and RelativeAltitude or AboveGroundAltitude.
"""

import math
import struct
from datetime import UTC, datetime

from orthoswarm.model.frame import Frame
from telemetry.samples.times import ZONE_UNKNOWN

MAKE = "OrthoSwarm"
_NOMINAL_SENSOR_MM = 36.0

_ASCII, _SHORT, _LONG, _RATIONAL, _BYTE, _UNDEFINED = 2, 3, 4, 5, 1, 7
Entry = tuple[int, int, int, bytes]  # tag, type, count, value


def with_pose(jpeg: bytes, frame: Frame) -> bytes:
    """A JPEG with a frame's pose; existing EXIF and XMP are replaced, the picture data is unchanged.

    Raises ValueError: the bytes are not a JPEG.
    """
    if jpeg[:2] != b"\xff\xd8":
        raise ValueError("no JPEG")
    exif = b"Exif\0\0" + exif_of(frame)
    xmp = b"http://ns.adobe.com/xap/1.0/\0" + xmp_of(frame)
    return b"".join([jpeg[:2], _segment(exif), _segment(xmp), _without_tags(jpeg)])


def _segment(body: bytes) -> bytes:
    return b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body


def _without_tags(jpeg: bytes) -> bytes:
    """The bytes after the start marker, without APP1 segments."""
    at, segments = 2, []
    while at + 4 <= len(jpeg) and jpeg[at] == 0xFF and jpeg[at + 1] not in (0xDA, 0xD9):
        end = at + 2 + struct.unpack_from(">H", jpeg, at + 2)[0]
        if jpeg[at + 1] != 0xE1:
            segments.append(jpeg[at:end])
        at = end
    return b"".join([*segments, jpeg[at:]])


def xmp_of(frame: Frame) -> bytes:
    """The XMP packet of a frame's pose."""
    fix = frame.fix
    values: list[tuple[str, float | None, int]] = [
        ("Camera:Yaw", _degrees(fix.yaw_rad), 5),
        ("Camera:Pitch", None if fix.pitch_rad is None else math.degrees(fix.pitch_rad) + 90.0, 5),
        ("Camera:Roll", _degrees(fix.roll_rad), 5),
        ("Camera:AboveGroundAltitude" if fix.height_is_ground else "drone-dji:RelativeAltitude", fix.height_m, 3),
        ("drone-dji:FlightYawDegree", _degrees(fix.flight_yaw_rad), 5),
        ("Camera:GPSXYAccuracy", fix.position_sigma_m, 4),
    ]
    attributes = "".join(f'\n   {name}="{value:+.{digits}f}"' for name, value, digits in values if value is not None)
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n  <rdf:Description rdf:about=""\n'
        '   xmlns:Camera="http://pix4d.com/camera/1.0/" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"'
        f'{attributes}/>\n </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>'
    ).encode()


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else math.degrees(angle)


def exif_of(frame: Frame) -> bytes:
    """The TIFF structure of a frame's EXIF, little-endian."""
    main = [_text(0x010F, MAKE), _text(0x0110, frame.camera or "camera"), _text(0x0131, MAKE)]
    detail: list[Entry] = [(0x9000, _UNDEFINED, 4, b"0232")]
    gps = _gps(frame)
    if frame.time_s is not None:
        moment = datetime.fromtimestamp(round(frame.time_s, 6), UTC)
        stamp = moment.strftime("%Y:%m:%d %H:%M:%S")
        main.append(_text(0x0132, stamp))
        detail += [_text(0x9003, stamp), _text(0x9291, f"{moment.microsecond:06d}")]
        if ZONE_UNKNOWN not in frame.origin.get("time", ""):
            detail.append(_text(0x9011, "+00:00"))
            seconds = moment.second * 1_000_000 + moment.microsecond
            gps += [
                (7, _RATIONAL, 3, struct.pack("<6I", moment.hour, 1, moment.minute, 1, seconds, 1_000_000)),
                _text(29, moment.strftime("%Y:%m:%d")),
            ]
    if frame.fov_hint_rad is not None:
        # A 36 mm wide sensor: the focal length is then the 35 mm one, and the pixel pitch makes it exact.
        focal = 0.5 * _NOMINAL_SENSOR_MM / math.tan(0.5 * frame.fov_hint_rad)
        detail += [
            (0x920A, _RATIONAL, 1, struct.pack("<2I", round(focal * 1e6), 1_000_000)),
            (0xA20E, _RATIONAL, 1, struct.pack("<2I", frame.width * 10_000, round(_NOMINAL_SENSOR_MM * 10_000))),
            (0xA210, _SHORT, 1, struct.pack("<H", 4)),
            (0xA405, _SHORT, 1, struct.pack("<H", max(1, min(65535, round(focal))))),
        ]
    return _tiff(main, detail, gps)


def _gps(frame: Frame) -> list[Entry]:
    fix = frame.fix
    entries: list[Entry] = [
        (0, _BYTE, 4, b"\2\3\0\0"),
        _text(1, "N" if fix.lat_deg >= 0 else "S"),
        (2, _RATIONAL, 3, _sexagesimal(fix.lat_deg)),
        _text(3, "E" if fix.lon_deg >= 0 else "W"),
        (4, _RATIONAL, 3, _sexagesimal(fix.lon_deg)),
    ]
    if fix.altitude_m is not None:
        entries += [
            (5, _BYTE, 1, b"\1" if fix.altitude_m < 0 else b"\0"),
            (6, _RATIONAL, 1, struct.pack("<2I", round(abs(fix.altitude_m) * 1000), 1000)),
        ]
    if fix.yaw_rad is not None:
        direction = math.degrees(fix.yaw_rad) % 360.0
        entries += [_text(16, "T"), (17, _RATIONAL, 1, struct.pack("<2I", round(direction * 10_000), 10_000))]
    if fix.position_sigma_m is not None:
        entries.append((31, _RATIONAL, 1, struct.pack("<2I", round(fix.position_sigma_m * 10_000), 10_000)))
    return entries


def _text(tag: int, value: str) -> Entry:
    raw = value.encode("ascii", "replace") + b"\0"
    return tag, _ASCII, len(raw), raw


def _sexagesimal(angle_deg: float) -> bytes:
    """Degrees, minutes, seconds to 1e-7 of a second (3e-11 degrees)."""
    total = round(abs(angle_deg) * 3.6e10)
    degrees, rest = divmod(total, 36_000_000_000)
    minutes, seconds = divmod(rest, 600_000_000)
    return struct.pack("<6I", degrees, 1, minutes, 1, seconds, 10_000_000)


def _tiff(main: list[Entry], detail: list[Entry], gps: list[Entry]) -> bytes:
    """IFD0 with pointers to the EXIF and GPS directories, values after each directory."""
    main = [*main, (0x8769, _LONG, 1, b"\0\0\0\0"), (0x8825, _LONG, 1, b"\0\0\0\0")]
    detail_at = 8 + _size(main)
    gps_at = detail_at + _size(detail)
    pointers = {0x8769: detail_at, 0x8825: gps_at}
    main = [(t, k, n, struct.pack("<I", pointers[t]) if t in pointers else v) for t, k, n, v in main]
    return b"II*\0\x08\0\0\0" + _directory(main, 8) + _directory(detail, detail_at) + _directory(gps, gps_at)


def _size(entries: list[Entry]) -> int:
    return 6 + 12 * len(entries) + sum(len(v) + len(v) % 2 for *_, v in entries if len(v) > 4)


def _directory(entries: list[Entry], offset: int) -> bytes:
    entries = sorted(entries)
    at = offset + 6 + 12 * len(entries)
    table, values = struct.pack("<H", len(entries)), b""
    for tag, kind, count, value in entries:
        if len(value) > 4:
            table += struct.pack("<HHII", tag, kind, count, at + len(values))
            values += value + b"\0" * (len(value) % 2)
        else:
            table += struct.pack("<HHI", tag, kind, count) + value.ljust(4, b"\0")
    return table + b"\0\0\0\0" + values
