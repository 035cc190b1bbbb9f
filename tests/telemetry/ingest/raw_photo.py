"""A raw photo as cameras write it: a DNG of one directory, a Bayer pattern of 16 bits without compression, and GPS."""

import struct
from pathlib import Path

import numpy as np

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _SIGNED = 1, 2, 3, 4, 5, 10
_CODES = {_BYTE: "B", _SHORT: "H", _LONG: "I", _RATIONAL: "I", _SIGNED: "i"}
_FROM_XYZ = (3.2405, -1.5371, -0.4985, -0.9693, 1.8760, 0.0416, 0.0556, -0.2040, 1.0572)  # of a sensor that sees sRGB


def write_dng(path: Path, rgb: np.ndarray, lat: float, lon: float) -> None:
    """Colours uint8 (rows, columns, 3), both even, as they come out of developing."""
    light = np.rint(np.where(rgb < 20, rgb / 255 / 4.5, ((rgb / 255 + 0.099) / 1.099) ** (1 / 0.45)) * 65535)
    rows, columns = rgb.shape[:2]
    bayer = light[..., 1].astype("<u2")
    bayer[::2, ::2], bayer[1::2, 1::2] = light[::2, ::2, 0], light[1::2, 1::2, 2]
    gps = [
        (1, _ASCII, "N" if lat >= 0 else "S"), (2, _RATIONAL, _dms(abs(lat))),
        (3, _ASCII, "E" if lon >= 0 else "W"), (4, _RATIONAL, _dms(abs(lon))),
    ]  # fmt: skip
    matrix = [n for value in _FROM_XYZ for n in (round(value * 10_000), 10_000)]
    main = [
        (254, _LONG, [0]), (256, _LONG, [columns]), (257, _LONG, [rows]), (258, _SHORT, [16]), (259, _SHORT, [1]),
        (262, _SHORT, [32803]), (271, _ASCII, "Made"), (272, _ASCII, "Up"), (273, _LONG, [8]), (277, _SHORT, [1]),
        (278, _LONG, [rows]), (279, _LONG, [bayer.nbytes]), (33421, _SHORT, [2, 2]), (33422, _BYTE, [0, 1, 1, 2]),
        (34853, _LONG, [0]), (50706, _BYTE, [1, 4, 0, 0]), (50708, _ASCII, "Made Up"), (50717, _LONG, [65535]),
        (50721, _SIGNED, matrix), (50728, _RATIONAL, [1, 1] * 3), (50778, _SHORT, [21]),
    ]  # fmt: skip
    at = 8 + bayer.nbytes
    length = len(_directory(main, at))
    main[14] = (34853, _LONG, [at + length])
    tail = _directory(main, at) + _directory(gps, at + length)
    path.write_bytes(b"II*\0" + struct.pack("<I", at) + bayer.tobytes() + tail)


def _dms(value: float) -> list[int]:
    seconds = round(value * 3600 * 10_000)
    return [seconds // 36_000_000, 1, seconds // 600_000 % 60, 1, seconds % 600_000, 10_000]


def _directory(entries: list, at: int) -> bytes:
    """A TIFF directory that begins at a place in the file, with its longer values after it."""
    head, values = struct.pack("<H", len(entries)), b""
    start = at + 2 + 12 * len(entries) + 4
    for tag, kind, value in entries:
        raw = value.encode() + b"\0" if isinstance(value, str) else struct.pack(f"<{len(value)}{_CODES[kind]}", *value)
        count = len(raw) if isinstance(value, str) else len(value) // (2 if kind in (_RATIONAL, _SIGNED) else 1)
        if len(raw) > 4:
            head += struct.pack("<HHII", tag, kind, count, start + len(values))
            values += raw + b"\0" * (len(raw) % 2)
        else:
            head += struct.pack("<HHI4s", tag, kind, count, raw)
    return head + bytes(4) + values
