"""A manufacturer's private SEI message, described by a file instead of code.

A TOML file:

    uuid = "00112233445566778899aabbccddeeff"     # or payload_type = 200
    struct = "<ddfHBBBBfiii"                       # Python's struct, of what follows the UUID
    fields = ["lon_deg", "lat_deg", "altitude_m", "", "", "", "", "", "", "yaw_deg*0.01", "roll_deg*0.01",
              "pitch_deg*0.01"]

Fields are those of a sample (`lat_deg`, `lon_deg`, `height_m`, `altitude_m`, `yaw_deg`, `pitch_deg`, `roll_deg`,
`flight_yaw_deg`, `fov_deg`, `sigma_m`, `time_s`), each with a factor and an offset if its unit is another one
("pitch_deg*0.01-90"); "" leaves a value out. The payload may be longer than the struct.
"""

import re
import struct
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

from orthoswarm.model.errors import InputError
from telemetry.formats.video.sei import USER_DATA_UNREGISTERED, Decoder
from telemetry.samples.sample import Sample

_NUMBERS = frozenset(f.name for f in fields(Sample)) - {"vehicle", "height_is_ground", "number", "zoom"}
_FIELD = re.compile(r"(\w+)(?:\*([+-]?[\d.]+(?:e[+-]?\d+)?))?([+-][\d.]+)?", re.IGNORECASE)


def read_sei_layout(path: Path) -> Decoder:
    """A decoder for the message described by a file.

    Raises:
        InputError: the file cannot be read, or does not describe a message; names the wrong entry.
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
