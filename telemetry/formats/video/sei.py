"""SEI messages to poses: our own, MISB ST 0604 time, a gimbal camera's struct, JSON, DJI's type 245; and a registry.

A decoder of your own: a callable from the payload to a `Sample` (or None), registered with

        register(Decoder("mine", 5, bytes.fromhex("00112233445566778899aabbccddeeff"), my_function))

or named in the entry point group `orthoswarm.sei` of a package, as an object of type `Decoder`. For payload type 5
(user_data_unregistered) the function gets what follows the UUID, for other types the whole payload. It need not
guard against damaged bytes: an exception counts as "not understood".

Our payload, type 5, UUID 0470547e-ac27-4f00-856a-5455b0eaf430, big-endian:

    offset  size  content
    0       1     version, 1
    1       1     flags: bit 0 = the height is above the ground (else above takeoff)
    2       2     n, bytes of the vehicle's id (at most 64)
    4       88    eleven float64, NaN where unknown: time (UTC epoch seconds), latitude, longitude (degrees),
                  height, altitude (metres), yaw, pitch, roll (degrees; pitch -90 looks straight down),
                  flight yaw (degrees), horizontal field of view (degrees), position sigma (metres)
    92      n     vehicle's id, UTF-8
    92 + n  4     CRC-32 (zlib) of all before it, from the version on

A later version may append fields before the CRC; readers ignore fields that they do not know.
"""

import calendar
import json
import math
import re
import struct
import tomllib
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from orthoswarm.model.earth import DEGREE_M
from orthoswarm.model.errors import InputError
from telemetry.samples.sample import Sample, checked
from telemetry.samples.times import epoch_of, epoch_seconds

UUID = bytes.fromhex("0470547eac274f00856a5455b0eaf430")
USER_DATA_UNREGISTERED = 5
DJI_TYPE = 245
VERSION = 1
ENTRY_POINTS = "orthoswarm.sei"

_FIELDS = (
    "time_s", "lat_deg", "lon_deg", "height_m", "altitude_m", "yaw_deg", "pitch_deg", "roll_deg",
    "flight_yaw_deg", "fov_deg", "sigma_m",
)  # fmt: skip
_FIXED = struct.Struct(">BBH11d")
_MAX_VEHICLE = 64
_MAX_JSON = 1 << 16
_NUMBERS = frozenset(f.name for f in fields(Sample)) - {"vehicle", "height_is_ground", "number", "zoom"}
_FIELD = re.compile(r"(\w+)(?:\*([+-]?[\d.]+(?:e[+-]?\d+)?))?([+-][\d.]+)?", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Decoder:
    """One kind of SEI payload."""

    name: str  # shown as the origin of a picture's fields
    payload_type: int  # SEI payload type
    uuid: bytes | None  # the 16 bytes that lead a payload of type 5, None for other types (or for any UUID)
    # from the payload (after the UUID) to a sample, None where it is not understood
    decode: Callable[[bytes], Sample | None]


_REGISTRY: dict[tuple[int, bytes | None], Decoder] = {}


def register(decoder: Decoder) -> None:
    """Add a decoder, or replace the one of the same payload type and UUID."""
    _REGISTRY[decoder.payload_type, decoder.uuid] = decoder


def unregister(decoder: Decoder) -> None:
    """Remove a decoder again; nothing happens if another one has replaced it."""
    if _REGISTRY.get((decoder.payload_type, decoder.uuid)) is decoder:
        del _REGISTRY[decoder.payload_type, decoder.uuid]


@cache
def load_entry_points() -> None:
    """Register the decoders of installed packages, once a process."""
    from importlib.metadata import entry_points

    for point in entry_points(group=ENTRY_POINTS):
        try:
            decoder = point.load()
        except Exception:  # a user's broken plug-in must not stop the reading of other messages
            continue
        if isinstance(decoder, Decoder):
            register(decoder)


@dataclass(frozen=True, slots=True)
class Reading:
    """The content of the SEI messages of one picture: the sample, and the decoders that gave it."""

    sample: Sample
    decoders: tuple[str, ...]


def read(messages: Iterable[tuple[int, bytes]]) -> Reading | None:
    """Read a picture's SEI messages; None if none is recognised (an encoder's settings are not)."""
    load_entry_points()
    merged: Sample | None = None
    names: list[str] = []
    for kind, payload in messages:
        decoder, body = _find(kind, payload)
        if decoder is None:
            continue
        try:
            sample = decoder.decode(body)
            sample = None if sample is None else checked(sample)
        except Exception:  # damaged bytes, or a user's decoder that did not expect them
            sample = None
        if sample is not None:
            names.append(decoder.name)
            # A message with a position takes precedence over one with only a time.
            if merged is None:
                merged = sample
            elif sample.has_position and not merged.has_position:
                merged = sample.merge(merged)
            else:
                merged = merged.merge(sample)
    return None if merged is None else Reading(merged, tuple(names))


_ENCODER_SETTINGS = frozenset(
    {
        bytes.fromhex("dc45e9bde6d948b7962cd820d923eeef"),  # x264
        bytes.fromhex("2ca2de09b51747dbbb55a4fe7fc2fc4e"),  # x265
    }
)
_ENCODER_TEXTS = (b"x264", b"x265")  # some builds write their settings without a UUID


def unknown(messages: Iterable[tuple[int, bytes]]) -> list[tuple[str, int]]:
    """UUID and payload size of each private message without a decoder; an encoder's settings are not counted."""
    found = []
    for kind, payload in messages:
        if kind == USER_DATA_UNREGISTERED and len(payload) >= 16:
            decoder, _ = _find(kind, payload)
            settings = payload[:16] in _ENCODER_SETTINGS or payload.startswith(_ENCODER_TEXTS)
            if decoder is None and not settings:
                found.append((payload[:16].hex(), len(payload) - 16))
    return found


def _find(kind: int, payload: bytes) -> tuple[Decoder | None, bytes]:
    if kind != USER_DATA_UNREGISTERED:
        return _REGISTRY.get((kind, None)), payload
    if len(payload) < 16:
        return None, b""
    body = payload[16:]
    decoder = _REGISTRY.get((kind, payload[:16]))
    if decoder is None and body.lstrip()[:1] == b"{":
        decoder = _JSON
    return decoder, body


def encode(sample: Sample) -> bytes:
    """Our payload of type 5, the UUID included; see the module for its layout."""
    vehicle = (sample.vehicle or "").encode()
    while len(vehicle) > _MAX_VEHICLE:
        vehicle = vehicle[:_MAX_VEHICLE].decode("utf-8", "ignore").encode()
    numbers = (math.nan if (v := getattr(sample, name)) is None else float(v) for name in _FIELDS)
    body = _FIXED.pack(VERSION, int(sample.height_is_ground), len(vehicle), *numbers) + vehicle
    return UUID + body + struct.pack(">I", zlib.crc32(body))


def _decode_ours(body: bytes) -> Sample | None:
    if len(body) < _FIXED.size + 4 or body[0] < 1:
        return None
    if struct.unpack(">I", body[-4:])[0] != zlib.crc32(body[:-4]):
        return None
    _, flags, length, *numbers = _FIXED.unpack_from(body)
    vehicle = body[_FIXED.size : _FIXED.size + min(length, _MAX_VEHICLE)].decode("utf-8", "replace")
    values = {name: value for name, value in zip(_FIELDS, numbers, strict=True) if not math.isnan(value)}
    return Sample(**values, vehicle=vehicle or None, height_is_ground=bool(flags & 1))


_MISB_UUIDS = (
    b"MISPmicrosectime",
    bytes.fromhex("a8687dd4d7593758a5cef0338b6545f1"),
    bytes.fromhex("cf848278ee23306c9265e8fef22fb8b8"),
)


def _decode_misb_time(body: bytes) -> Sample | None:
    """MISB ST 0604 precision time stamp: status, then 8 bytes with FF between the pairs.

    The UUID names micro- or nanoseconds, but real encoders write nanoseconds under the UUID of microseconds: a value
    that would be later than the year 4000 in microseconds is read as nanoseconds.
    """
    if len(body) < 12 or not body[3] == body[6] == body[9] == 0xFF:
        return None
    value = int.from_bytes(body[1:3] + body[4:6] + body[7:9] + body[10:12], "big")
    return Sample(time_s=value * (1e-9 if value > 6.4e16 else 1e-6))


_GIMBAL_UUID = bytes.fromhex("a1b2c3d4e5f6a7b8c9daebfc1a2b3c4d")
_GIMBAL = struct.Struct("<ddfHBBBBfiii")


def _decode_gimbal_camera(body: bytes) -> Sample | None:
    """A gimbal camera's little-endian struct: lon, lat, alt, date, gimbal yaw, roll, pitch in 0.01 degrees."""
    if len(body) < _GIMBAL.size:
        return None
    lon, lat, altitude, year, month, day, hour, minute, second, yaw, roll, pitch = _GIMBAL.unpack_from(body)
    time_s = None
    if 1 <= month <= 12 and 1 <= day <= 31 and 2000 <= year < 2200 and math.isfinite(second):
        time_s = calendar.timegm((year, month, day, hour, minute, 0, 0, 0, 0)) + second
    return Sample(
        time_s=time_s, lat_deg=lat, lon_deg=lon, altitude_m=altitude, yaw_deg=yaw / 100.0, pitch_deg=pitch / 100.0,
        roll_deg=roll / 100.0,
    )  # fmt: skip


def _decode_dji(body: bytes) -> Sample | None:
    """DJI live streams, payload type 245: records of tag, length (u16 little-endian) and value, zero padded.

    Tag 4: camera attitude and position as metres from a home point; tag 10: sensor size and focal length.
    Source: published payloads of a Matrice 4TD (UAS4SAR); the angles' scale agrees with its resting gimbal.
    """
    sample, at, known = Sample(), 0, False
    while at + 4 <= len(body):
        tag, length = struct.unpack_from("<HH", body, at)
        value = body[at + 4 : at + 4 + length]
        if (tag == 0 and length == 0) or len(value) < length:
            break
        if tag == 4 and length >= 39:
            known = _dji_pose(value, sample)
        elif tag == 10 and length >= 13:
            width, _, focal = struct.unpack_from("<III", value, 1)
            if width and focal:
                sample.fov_deg = math.degrees(2.0 * math.atan(0.5 * width / focal))
                known = True
        at += 4 + length
    return sample if known else None


def _dji_pose(value: bytes, sample: Sample) -> bool:
    yaw, roll, tilt = struct.unpack_from("<iii", value, 3)
    low_north, low_east, low_down, north, east, down = struct.unpack_from("<HHHhhh", value, 15)
    lat, lon, home_altitude = struct.unpack_from("<iii", value, 27)
    home_lat, home_lon = lat * 180.0 / 2**32, lon * 360.0 / 2**32
    metres = [(high << 16 | low) / 1000.0 for high, low in ((north, low_north), (east, low_east), (down, low_down))]
    if abs(home_lat) > 89.0 or max(map(abs, metres)) > 50_000.0:
        return False
    sample.lat_deg = home_lat + metres[0] / DEGREE_M
    sample.lon_deg = home_lon + metres[1] / (DEGREE_M * math.cos(math.radians(home_lat)))
    sample.altitude_m = -metres[2]
    sample.height_m = -metres[2] + home_altitude / 1000.0  # home altitude is stored with the opposite sign
    sample.yaw_deg = yaw * 1e-7
    sample.pitch_deg = tilt * 1e-7 - 90.0
    sample.roll_deg = roll * 1e-7
    return True


_JSON_NAMES = {
    "time_s": ("time", "time_s", "timestamp", "ts", "utc"),
    "lat_deg": ("lat_deg", "lat", "latitude"),
    "lon_deg": ("lon_deg", "lon", "lng", "long", "longitude"),
    "height_m": ("height_m", "height", "rel_alt", "relative_altitude", "relativeAltitude", "alt_rel", "agl"),
    "altitude_m": ("altitude_m", "alt", "altitude", "abs_alt", "absolute_altitude", "alt_msl"),
    "yaw_deg": ("yaw_deg", "gimbal_yaw", "camera_yaw", "gimbalYaw", "yaw"),
    "pitch_deg": ("pitch_deg", "gimbal_pitch", "camera_pitch", "gimbalPitch", "pitch"),
    "roll_deg": ("roll_deg", "gimbal_roll", "camera_roll", "gimbalRoll", "roll"),
    "flight_yaw_deg": ("flight_yaw_deg", "flight_yaw", "heading", "heading_deg"),
    "fov_deg": ("fov_deg", "hfov", "fov"),
    "sigma_m": ("sigma_m", "hacc"),
}


def _decode_json(body: bytes) -> Sample | None:
    """A JSON object under any UUID: the names of our own API, and common ones of others; degrees and metres."""
    text = body.rstrip(b"\0 \r\n\x80").decode("utf-8")
    if len(text) > _MAX_JSON or text.count("{") + text.count("[") > 64:
        return None
    found = json.loads(text)
    if not isinstance(found, dict):
        return None
    flat = {**found}
    for inner in found.values():
        if isinstance(inner, dict):
            flat = {**inner, **flat}
    sample = Sample()
    for name, keys in _JSON_NAMES.items():
        for key in keys:
            value = _json_number(flat.get(key), name)
            if value is not None:
                setattr(sample, name, value)
                break
    vehicle = flat.get("vehicle", flat.get("drone"))
    sample.vehicle = str(vehicle) if isinstance(vehicle, str | int) else None
    if not sample.has_position and sample.time_s is None:
        return None  # some other JSON
    return sample


def _json_number(value: object, name: str) -> float | None:
    if isinstance(value, str):
        if name == "time_s":
            parsed = epoch_of(value)
            if parsed is not None:
                return parsed
        try:
            value = float(value)
        except ValueError:
            return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return epoch_seconds(value) if name == "time_s" else float(value)


_JSON = Decoder("SEI JSON", USER_DATA_UNREGISTERED, None, _decode_json)

for _built_in in (
    Decoder("SEI OrthoSwarm", USER_DATA_UNREGISTERED, UUID, _decode_ours),
    *(Decoder("SEI MISB time", USER_DATA_UNREGISTERED, uuid, _decode_misb_time) for uuid in _MISB_UUIDS),
    Decoder("SEI gimbal camera", USER_DATA_UNREGISTERED, _GIMBAL_UUID, _decode_gimbal_camera),
    Decoder("SEI DJI", DJI_TYPE, None, _decode_dji),
):
    register(_built_in)


def read_sei_layout(path: Path) -> Decoder:
    """A decoder for a manufacturer's private message, described by a TOML file instead of code.

        uuid = "00112233445566778899aabbccddeeff"     # or payload_type = 200
        struct = "<ddfHBBBBfiii"                       # Python's struct, of what follows the UUID
        fields = ["lon_deg", "lat_deg", "altitude_m", "", "", "", "", "", "", "yaw_deg*0.01", "roll_deg*0.01",
                  "pitch_deg*0.01"]

    Fields are those of a sample (`lat_deg`, `lon_deg`, `height_m`, `altitude_m`, `yaw_deg`, `pitch_deg`, `roll_deg`,
    `flight_yaw_deg`, `fov_deg`, `sigma_m`, `time_s`), each with a factor and an offset if its unit is another one
    ("pitch_deg*0.01-90"); "" leaves a value out. The payload may be longer than the struct.

    Raises InputError: the file cannot be read, or does not describe a message; names the wrong entry.
    """
    try:
        entries = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror}); check the path of --sei-layout") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path.name} is not a TOML file ({error}); see docs/telemetry.md for an example") from None
    kind, uuid = _message(entries, path)
    try:
        form = struct.Struct(str(entries.get("struct", "")))
        count = len(form.unpack(bytes(form.size)))
    except struct.error as error:
        raise InputError(f"{path.name}: struct is not a format of Python's struct ({error}); correct it") from None
    names = entries.get("fields")
    if not isinstance(names, list) or len(names) != count or count == 0:
        raise InputError(f"{path.name}: fields has to name each of the {count} values of struct; '' leaves one out")
    scaled = [_field(str(name), path) for name in names]

    def decode(payload: bytes) -> Sample | None:
        if len(payload) < form.size:
            return None
        sample = Sample()
        for wanted, value in zip(scaled, form.unpack_from(payload), strict=True):
            if wanted is not None and isinstance(value, int | float):
                name, factor, offset = wanted
                setattr(sample, name, float(value) * factor + offset)
        return sample

    return Decoder(f"SEI {path.stem}", kind, uuid, decode)


def _message(entries: dict[str, Any], path: Path) -> tuple[int, bytes | None]:
    """Payload type and UUID."""
    if "uuid" in entries:
        try:
            uuid = bytes.fromhex(str(entries["uuid"]).replace("-", ""))
        except ValueError:
            uuid = b""
        if len(uuid) != 16:
            raise InputError(f"{path.name}: uuid has to be 32 hexadecimal digits")
        return USER_DATA_UNREGISTERED, uuid
    kind = entries.get("payload_type")
    if not isinstance(kind, int) or kind < 0 or kind == USER_DATA_UNREGISTERED:
        raise InputError(f"{path.name} names neither a uuid nor a payload_type; add the one of the message")
    return kind, None


def _field(written: str, path: Path) -> tuple[str, float, float] | None:
    """Name, factor and offset; None for a value that is left out."""
    if not written:
        return None
    match = _FIELD.fullmatch(written.replace(" ", ""))
    if match is None or match[1] not in _NUMBERS:
        raise InputError(f"{path.name}: '{written}' is not a field; known are {', '.join(sorted(_NUMBERS))}")
    try:
        return match[1], float(match[2] or 1.0), float(match[3] or 0.0)
    except ValueError:
        raise InputError(f"{path.name}: '{written}' has a factor or offset that is not a number") from None
