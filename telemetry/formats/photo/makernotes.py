"""DJI MakerNotes: the airframe's and the camera's attitude of models that write no XMP.

The note is a directory of 12-byte entries in a byte order of its own; tags 3-11 are single floats
held in the entry itself: speed x, y, z; aircraft pitch, yaw, roll; camera pitch, yaw, roll (degrees; true north,
camera pitch -90 = straight down). Source: ExifTool's DJI tag table, checked with photos that have both.
"""

import math
import struct

from telemetry.samples.sample import Sample

_MAX_ENTRIES = 256


def parse_dji(note: bytes) -> Sample | None:
    """Attitude in a DJI maker note, None if it is another note or has no attitude. Never raises."""
    if len(note) < 14:
        return None
    # Software that rewrites the EXIF may change its byte order but not the note's, which the note's own count shows.
    order = "<" if note[1] == 0 else ">"
    (count,) = struct.unpack_from(order + "H", note)
    count = min(count, _MAX_ENTRIES, (len(note) - 2) // 12)
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
        flight_pitch_deg=pitch,
        flight_yaw_deg=yaw,
        flight_roll_deg=roll,
        pitch_deg=camera_pitch,
        yaw_deg=camera_yaw,
        roll_deg=camera_roll,
    )
