"""DJI's `djmd` track: one protobuf message a picture with position and attitude.

The field numbers differ a little between models; messages are read by the layout that fits them:

    Mavic 3, Matrice 30, Mini 4 Pro   3-3-3 airframe, 3-3-4 position, 3-3-5 relative altitude, 3-4-3 gimbal
    Avata 2, Neo                      3-4-3 airframe, 3-4-4 position, 3-4-5 relative altitude
    Action cameras                    3-4-2 position, in it 6-1 UTC as text (YYYY-MM-DD hh:mm:ss)

Airframe 1-3: roll, pitch, yaw; gimbal 1-3: pitch, roll, yaw; both int64 in 0.1 degrees. Position 1: unit flag
(absent or 0: radians), latitude, longitude (double); 2: altitude in millimetres. Source: ExifTool's DJI tables.
"""

import math
import struct

from telemetry.samples.sample import CAMERA_ANGLES, FLIGHT_ANGLES, Sample, checked
from telemetry.samples.times import epoch_of

Fields = dict[int, int | float | bytes]
_MAX_FIELDS = 512


def parse_message(data: bytes) -> Fields:
    """The fields of one protobuf message, the last of each number; damage ends it. Never raises."""
    fields: Fields = {}
    at = 0
    for _ in range(_MAX_FIELDS):
        tag, at = _varint(data, at)
        if tag is None or tag >> 3 == 0:
            break
        kind = tag & 7
        if kind == 0:
            value, at = _varint(data, at)
            if value is None:
                break
            fields[tag >> 3] = value
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
            if at + size > len(data):
                break
            fields[tag >> 3] = struct.unpack_from("<d" if kind == 1 else "<f", data, at)[0]
            at += size
        elif kind == 2:
            length, at = _varint(data, at)
            if length is None or at + length > len(data):
                break
            fields[tag >> 3] = data[at : at + length]
            at += length
        else:
            break
    return fields


def _varint(data: bytes, at: int) -> tuple[int | None, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            return None, at
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if not byte & 0x80:
            return value & (2**64 - 1), at
    return None, at


def _inner(fields: Fields, *path: int) -> Fields:
    for number in path:
        value = fields.get(number)
        if not isinstance(value, bytes):
            return {}
        fields = parse_message(value)
    return fields


def _signed(value: int | float | bytes | None) -> float | None:
    if isinstance(value, int):
        return float(value - 2**64 if value >= 2**63 else value)
    return float(value) if isinstance(value, float) and math.isfinite(value) else None


def _scaled(fields: Fields, number: int, scale: float) -> float | None:
    value = _signed(fields.get(number))
    return None if value is None else value * scale


def read_djmd(data: bytes) -> Sample | None:
    """Pose of one message; None if it has none (action cameras without GPS, other data). Never raises."""
    body = _inner(parse_message(data), 3)
    if not body:
        return None
    airframe: Fields
    for base, position_at in ((3, 4), (4, 4), (4, 2)):
        block = _inner(body, base)
        place = _inner(block, position_at)
        coordinates = _inner(place, 1)
        if isinstance(coordinates.get(2), float) and isinstance(coordinates.get(3), float):
            airframe = _inner(block, 3) if position_at == 4 else {}
            break
    else:
        return None
    unit = 1.0 if coordinates.get(1) else 180.0 / math.pi
    gimbal = _inner(body, 4, 3) if base == 3 else {}
    sample = Sample(
        lat_deg=_scaled(coordinates, 2, unit), lon_deg=_scaled(coordinates, 3, unit),
        altitude_m=_scaled(place, 2, 1e-3), height_m=_scaled(_inner(block, 5), 1, 1e-3) if position_at == 4 else None,
        flight_roll_deg=_scaled(airframe, 1, 0.1), flight_pitch_deg=_scaled(airframe, 2, 0.1),
        flight_yaw_deg=_scaled(airframe, 3, 0.1), pitch_deg=_scaled(gimbal, 1, 0.1), roll_deg=_scaled(gimbal, 2, 0.1),
        yaw_deg=_scaled(gimbal, 3, 0.1),
    )  # fmt: skip
    # Protobuf omits zeros: where a gimbal or an airframe is present, a missing angle is zero.
    for name in (*(CAMERA_ANGLES if gimbal else ()), *(FLIGHT_ANGLES if airframe else ())):
        setattr(sample, name, getattr(sample, name) or 0.0)
    written = _inner(place, 6).get(1) if position_at == 2 else None
    sample.time_s = epoch_of(written.decode("ascii", "replace")) if isinstance(written, bytes) else None
    number = _inner(body, 1).get(1)
    sample.number = number if isinstance(number, int) else None
    return checked(sample)
