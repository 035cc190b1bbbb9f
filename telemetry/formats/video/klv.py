"""MISB KLV metadata: ST 0601 local sets and EG 0104 universal sets, to samples.

Packets are found by their 16-byte keys, so it does not matter whether a transport stream carries them
asynchronously (bare) or synchronously (with access unit headers), nor how many are in one packet.
Sources: MISB ST 0601.17, EG 0104.5, ST 0107 (BER), SMPTE 336M. Latitudes are WGS 84, angles degrees.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

from telemetry.samples.rotations import airframe_ned, camera_angles_deg, euler_ned
from telemetry.samples.sample import Sample, checked

ST0601_KEY = bytes.fromhex("060e2b34020b01010e01030101000000")
EG0104_KEY = bytes.fromhex("060e2b34020101010e01010201010000")
_PREFIX = bytes.fromhex("060e2b34")

MAX_PACKET = 1 << 20


@dataclass(slots=True)
class KlvPacket:
    """One KLV packet."""

    kind: str  # "ST 0601" or "EG 0104"
    sample: Sample | None  # its pose, None if it has none or is damaged
    error: str = ""  # why it was refused, "" if it was not
    values: dict[str, float | str] = field(default_factory=dict)  # the values read, by name


def packets(data: bytes) -> Iterator[KlvPacket]:
    """Every ST 0601 and EG 0104 packet in a run of bytes; damaged ones with the reason. Never raises."""
    at = data.find(_PREFIX)
    while at >= 0:
        kind = _kind(data[at : at + 16])
        if kind is None:
            at = data.find(_PREFIX, at + 1)
            continue
        length, start = ber_length(data, at + 16)
        if length is None or length > MAX_PACKET or start + length > len(data):
            yield KlvPacket(kind, None, "the packet is cut off")
            at = data.find(_PREFIX, at + 4)
            continue
        packet_bytes = data[at : start + length]
        yield _read_0601(packet_bytes, start - at) if kind == "ST 0601" else _read_0104(packet_bytes, start - at)
        at = data.find(_PREFIX, start + length)


def _kind(key: bytes) -> str | None:
    # The version byte (the eighth) differs between editions.
    if key[:7] == ST0601_KEY[:7] and key[8:] == ST0601_KEY[8:]:
        return "ST 0601"
    if key[:7] == EG0104_KEY[:7] and key[8:14] == EG0104_KEY[8:14]:
        return "EG 0104"
    return None


def ber_length(data: bytes, at: int) -> tuple[int | None, int]:
    """A BER length (short or long form) and the offset after it; None if damaged."""
    if at >= len(data):
        return None, at
    first = data[at]
    if first < 0x80:
        return first, at + 1
    count = first & 0x7F
    if not 1 <= count <= 8 or at + 1 + count > len(data):
        return None, at
    return int.from_bytes(data[at + 1 : at + 1 + count], "big"), at + 1 + count


def _ber_oid(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for _ in range(5):
        if at >= len(data):
            break
        byte = data[at]
        value = value << 7 | (byte & 0x7F)
        at += 1
        if not byte & 0x80:
            break
    return value, at


def checksum(data: bytes) -> int:
    """The 16-bit running sum of ST 0601 over bytes (of a packet: up to and with the length byte of tag 1)."""
    return (sum(data[::2]) * 256 + sum(data[1::2])) & 0xFFFF


# Altitude and elevation (15, 25) are above mean sea level, ellipsoid heights (75, 78) are up to 100 m apart from them.
# tag -> (name, bytes, signed, scale per unit, offset); a signed value of -2^(n-1) means "out of range".
_ANGLE_16, _ANGLE_32, _LATITUDE_32 = 360.0 / 65535, 360.0 / 4294967294, 180.0 / 4294967294
_ALTITUDE = 19900.0 / 65535
_NUMBERS: dict[int, tuple[str, int, bool, float, float]] = {
    2: ("time_us", 8, False, 1.0, 0.0),
    5: ("platform_heading", 2, False, _ANGLE_16, 0.0),
    6: ("platform_pitch", 2, True, 40.0 / 65534, 0.0),
    7: ("platform_roll", 2, True, 100.0 / 65534, 0.0),
    13: ("sensor_latitude", 4, True, _LATITUDE_32, 0.0),
    14: ("sensor_longitude", 4, True, _ANGLE_32, 0.0),
    15: ("sensor_altitude", 2, False, _ALTITUDE, -900.0),
    16: ("horizontal_fov", 2, False, 180.0 / 65535, 0.0),
    17: ("vertical_fov", 2, False, 180.0 / 65535, 0.0),
    18: ("relative_azimuth", 4, False, 360.0 / 4294967295, 0.0),
    19: ("relative_elevation", 4, True, _ANGLE_32, 0.0),
    20: ("relative_roll", 4, False, 360.0 / 4294967295, 0.0),
    21: ("slant_range", 4, False, 5_000_000.0 / 4294967295, 0.0),
    22: ("target_width", 2, False, 10000.0 / 65535, 0.0),
    23: ("frame_center_latitude", 4, True, _LATITUDE_32, 0.0),
    24: ("frame_center_longitude", 4, True, _ANGLE_32, 0.0),
    25: ("frame_center_elevation", 2, False, _ALTITUDE, -900.0),
    50: ("angle_of_attack", 2, True, 40.0 / 65534, 0.0),
    52: ("sideslip", 2, True, 40.0 / 65534, 0.0),
    65: ("version", 1, False, 1.0, 0.0),
    75: ("sensor_ellipsoid_height", 2, False, _ALTITUDE, -900.0),
    78: ("frame_center_ellipsoid_height", 2, False, _ALTITUDE, -900.0),
    90: ("platform_pitch_full", 4, True, _LATITUDE_32, 0.0),
    91: ("platform_roll_full", 4, True, _LATITUDE_32, 0.0),
}
_TEXTS = {3: "mission", 4: "tail_number", 10: "platform", 59: "call_sign"}
# Item 10 is the model, which all vehicles of a fleet share: it names none of them.


def _read_0601(packet_bytes: bytes, start: int) -> KlvPacket:
    packet = KlvPacket("ST 0601", None)
    values = packet.values
    at, size, seen_checksum = start, len(packet_bytes), False
    while at < size:
        tag, at = _ber_oid(packet_bytes, at)
        length, at = ber_length(packet_bytes, at)
        if length is None or at + length > size:
            packet.error = "an item is longer than its packet"
            return packet
        raw = packet_bytes[at : at + length]
        at += length
        if tag == 1:
            seen_checksum = True
            if length != 2 or checksum(packet_bytes[: at - 2]) != int.from_bytes(raw, "big"):
                packet.error = "the checksum is wrong"
                return packet
        elif tag in _NUMBERS:
            name, width, signed, scale, offset = _NUMBERS[tag]
            number = int.from_bytes(raw, "big", signed=signed)
            if length == width and not (signed and number == -(1 << (8 * width - 1))):
                values[name] = number * scale + offset
        elif tag in _TEXTS:
            values[_TEXTS[tag]] = raw[:64].decode("utf-8", "replace").strip("\0 ")
    if not seen_checksum:
        packet.error = "the checksum is missing"
        return packet
    packet.sample = _sample(values)
    return packet


# Bytes 8 to 15 of an item's key (byte 7, a version, and those before are left aside) -> name.
_UNIVERSAL = {
    bytes.fromhex(key): name
    for key, name in {
        "0702010101050000": "time_us",
        "0701020102040200": "sensor_latitude",
        "0701020102060200": "sensor_longitude",
        "0701020102020000": "sensor_altitude",
        "0701100104000000": "platform_roll",
        "0701100105000000": "platform_pitch",
        "0701100106000000": "platform_heading",
        "0420020101080000": "horizontal_fov",
        "04200201010a0100": "vertical_fov",
        "0701080101000000": "slant_range",
        "0701100101000000": "sensor_roll",
        "0701100102000000": "angle_to_north",
        "0701100103000000": "obliquity",
        "0701020103020000": "frame_center_latitude",
        "0701020103040000": "frame_center_longitude",
        "0701020103160000": "frame_center_elevation",
        "0701090201000000": "target_width",
        "0101200100000000": "platform",
        "0105050000000000": "mission",
    }.items()
}
_UNIVERSAL_TEXTS = frozenset({"platform", "mission"})


def _read_0104(packet_bytes: bytes, start: int) -> KlvPacket:
    packet = KlvPacket("EG 0104", None)
    values = packet.values
    at, size = start, len(packet_bytes)
    while at + 17 <= size:
        if packet_bytes[at : at + 4] != _PREFIX:
            packet.error = "an item has no key"
            return packet
        name = _UNIVERSAL.get(packet_bytes[at + 8 : at + 16])
        length, at = ber_length(packet_bytes, at + 16)
        if length is None or at + length > size:
            packet.error = "an item is longer than its packet"
            return packet
        raw = packet_bytes[at : at + length]
        at += length
        if name in _UNIVERSAL_TEXTS:
            values[name] = raw[:64].decode("utf-8", "replace").strip("\0 ")
        elif name == "time_us":
            values[name] = float(int.from_bytes(raw, "big")) if length == 8 else 0.0
        elif name is not None and length in (4, 8):
            values[name] = struct.unpack(">f" if length == 4 else ">d", raw)[0]
    packet.sample = _sample(values)
    return packet


def _sample(values: dict[str, float | str]) -> Sample | None:
    """A sample of the values of either set."""
    v = {name: value for name, value in values.items() if isinstance(value, float)}
    sample = Sample(
        lat_deg=v.get("sensor_latitude"),
        lon_deg=v.get("sensor_longitude"),
        altitude_m=v.get("sensor_altitude", v.get("sensor_ellipsoid_height")),
        fov_deg=v.get("horizontal_fov"),
        flight_yaw_deg=v.get("platform_heading"),
        flight_pitch_deg=v.get("platform_pitch_full", v.get("platform_pitch")),
        flight_roll_deg=v.get("platform_roll_full", v.get("platform_roll")),
    )
    if v.get("time_us"):
        sample.time_s = v["time_us"] * 1e-6
    name = values.get("tail_number") or values.get("call_sign")
    sample.vehicle = name if isinstance(name, str) else None
    elevation = _attitude(v, sample)
    if "sensor_altitude" in v and "frame_center_elevation" in v:
        height = v["sensor_altitude"] - v["frame_center_elevation"]
    elif "sensor_ellipsoid_height" in v and "frame_center_ellipsoid_height" in v:
        height = v["sensor_ellipsoid_height"] - v["frame_center_ellipsoid_height"]
    elif "slant_range" in v and elevation is not None and elevation < -5.0:
        height = -v["slant_range"] * math.sin(math.radians(elevation))
    else:
        height = 0.0
    if height > 1.0:
        sample.height_m, sample.height_is_ground = height, True
    return checked(sample)


def _attitude(v: dict[str, float], sample: Sample) -> float | None:
    """Camera angles into the sample; returns the elevation of the optical axis in degrees."""
    body = airframe_ned(sample)
    if "relative_azimuth" in v and "relative_elevation" in v and body is not None:
        sensor = euler_ned(v["relative_azimuth"], v["relative_elevation"], v.get("relative_roll", 0.0))
        sample.yaw_deg, sample.pitch_deg, sample.roll_deg = camera_angles_deg(body @ sensor)
    elif "angle_to_north" in v and "obliquity" in v:
        elevation = -abs(v["obliquity"])  # written as a depression by some, as an elevation by others
        rotation = euler_ned(v["angle_to_north"], elevation, v.get("sensor_roll", 0.0))
        sample.yaw_deg, sample.pitch_deg, sample.roll_deg = camera_angles_deg(rotation)
    return sample.pitch_deg
