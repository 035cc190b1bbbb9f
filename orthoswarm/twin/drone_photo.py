"""A drone's photo: from light to a JPEG by its sensor, and the EXIF and XMP tags that a DJI camera writes.

The tags are without focal length and field of view: the camera is uncalibrated.
"""

from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.arrays import Bytes, Floats


class Sensor:
    """A small drone camera with automatic exposure.

    width: columns; height: rows. seed: of the noise array; each picture uses another part of it.
    """

    def __init__(self, width: int, height: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 101])
        self._bank = rng.normal(0.0, 1.0, (height + 257, width + 263, 3)).astype(np.float32)
        x = (np.arange(width, dtype=np.float32) - 0.5 * (width - 1)) / (0.5 * width)
        y = (np.arange(height, dtype=np.float32) - 0.5 * (height - 1)) / (0.5 * width)
        self._vignette = (1.0 - 0.13 * (x[None, :] ** 2 + y[:, None] ** 2))[..., None]

    def expose(self, light: Floats, rng: np.random.Generator) -> Bytes:
        """8-bit colours of a picture: slight blur, darker corners, exposure within 4 %, noise of 2 grey values."""
        import cv2

        image = cv2.GaussianBlur(light, (0, 0), 0.42)
        image *= self._vignette * np.float32(1.06 + rng.uniform(-0.04, 0.04))
        rows, cols = image.shape[:2]
        r, c = int(rng.integers(257)), int(rng.integers(263))
        image += 1.9 * self._bank[r : r + rows, c : c + cols]
        return np.asarray(np.clip(image, 0, 255).astype(np.uint8))

    def encode(self, image: Bytes, quality: int) -> bytes:
        """A baseline JPEG with halved chroma."""
        import simplejpeg

        return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality, "RGB", "420"))


_MODEL: Final = "TWIN"
_XMP: Final = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
    '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
    ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
    '  <rdf:Description rdf:about="DJI Meta Data"\n'
    '    xmlns:tiff="http://ns.adobe.com/tiff/1.0/"\n'
    '    xmlns:xmp="http://ns.adobe.com/xap/1.0/"\n'
    '    xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"\n'
    '   xmp:ModifyDate="{date}"\n'
    '   xmp:CreateDate="{date}"\n'
    '   tiff:Make="{make}"\n'
    '   tiff:Model="{model}"\n'
    '   drone-dji:AbsoluteAltitude="{altitude:+.3f}"\n'
    '   drone-dji:RelativeAltitude="{height:+.3f}"\n'
    '   drone-dji:GpsLatitude="{lat:.10f}"\n'
    '   drone-dji:GpsLongitude="{lon:.10f}"\n'
    '   drone-dji:GimbalRollDegree="{gimbal[2]:+.3f}"\n'
    '   drone-dji:GimbalYawDegree="{gimbal[0]:+.3f}"\n'
    '   drone-dji:GimbalPitchDegree="{gimbal[1]:+.3f}"\n'
    '   drone-dji:FlightRollDegree="{flight[2]:+.3f}"\n'
    '   drone-dji:FlightYawDegree="{flight[0]:+.3f}"\n'
    '   drone-dji:FlightPitchDegree="{flight[1]:+.3f}">\n'
    "  </rdf:Description>\n"
    " </rdf:RDF>\n"
    "</x:xmpmeta>\n"
    '<?xpacket end="w"?>'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoTags:
    """The tags of a photo: time, position, attitude and camera."""

    time_s: float  # UTC epoch seconds
    lat_deg: float  # latitude
    lon_deg: float  # longitude, WGS 84
    altitude_m: float  # absolute altitude
    height_m: float  # over takeoff
    gimbal_deg: tuple[float, float, float]  # the camera's yaw (from true north), pitch (-90 straight down), roll
    flight_deg: tuple[float, float, float]  # the airframe's yaw, pitch, roll


def with_tags(jpeg: bytes, tags: PhotoTags) -> bytes:
    """A JPEG with its EXIF and XMP segments; angles are wrapped to +-180 degrees."""
    xmp = b"http://ns.adobe.com/xap/1.0/\x00" + _xmp(tags)
    return jpeg[:2] + _segment(_exif(tags)) + _segment(xmp) + jpeg[2:]


def _segment(payload: bytes) -> bytes:
    return b"\xff\xe1" + (len(payload) + 2).to_bytes(2, "big") + payload


def _xmp(tags: PhotoTags) -> bytes:
    return _XMP.format(
        date=datetime.fromtimestamp(tags.time_s, UTC).isoformat(timespec="seconds"), make="DJI", model=_MODEL,
        altitude=tags.altitude_m, height=tags.height_m, lat=tags.lat_deg, lon=tags.lon_deg,
        gimbal=[wrap_deg(x) for x in tags.gimbal_deg], flight=[wrap_deg(x) for x in tags.flight_deg],
    ).encode()  # fmt: skip


def _exif(tags: PhotoTags) -> bytes:
    from PIL import Image

    moment = datetime.fromtimestamp(round(tags.time_s, 3), UTC)
    stamp, fraction = moment.strftime("%Y:%m:%d %H:%M:%S"), f"{moment.microsecond // 1000:03d}"
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0132] = "DJI", _MODEL, stamp
    detail = exif.get_ifd(0x8769)
    detail[0x9003] = detail[0x9004] = stamp
    detail[0x9291] = detail[0x9292] = fraction
    detail[0x9011] = "+00:00"
    gps = exif.get_ifd(0x8825)
    gps[0] = b"\x02\x03\x00\x00"
    gps[1], gps[2] = ("N" if tags.lat_deg >= 0 else "S"), _sexagesimal(tags.lat_deg)
    gps[3], gps[4] = ("E" if tags.lon_deg >= 0 else "W"), _sexagesimal(tags.lon_deg)
    gps[5], gps[6] = (b"\x00" if tags.altitude_m >= 0 else b"\x01"), _rational(abs(tags.altitude_m), 1000)
    return bytes(exif.tobytes())


def _rational(value: float, denominator: int) -> tuple[int, int] | Fraction:
    from PIL.TiffImagePlugin import IFDRational

    rational: Fraction = IFDRational(round(value * denominator), denominator)
    return rational


def _sexagesimal(angle_deg: float) -> tuple[object, object, object]:
    """Degrees, minutes and seconds of arc, rounded to 1e-6 seconds (3e-10 degrees)."""
    micro = round(abs(angle_deg) * 3.6e9)
    degrees, rest = divmod(micro, 3_600_000_000)
    minutes, seconds = divmod(rest, 60_000_000)
    return _rational(degrees, 1), _rational(minutes, 1), _rational(seconds / 1e6, 1_000_000)
