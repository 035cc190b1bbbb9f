"""A photo and its tags: position, attitude, time and lens of its camera.

Tags are only collected here, with their values unchanged; `telemetry.photos.photo_frames` decides which of several
yaws is the picture's, and `telemetry.ingest` merges photos with other sources.
"""

import math
import re
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from orthoswarm.model.earth import distance_m
from orthoswarm.raster.picture_file import PictureError, raw_size
from orthoswarm.stores.addresses import is_stored
from orthoswarm.stores.listing import StoredFile, known
from orthoswarm.stores.local_copies import content, expect
from orthoswarm.stores.requests import CONNECTIONS
from telemetry.formats.photo import exif, xmp
from telemetry.formats.photo.exif import parse_dji
from telemetry.formats.photo.picture_container import Container, NotAPicture, read_container
from telemetry.photos.maker_angles import Angles, camera_angles, flight_angles
from telemetry.photos.map_datum import in_wgs84
from telemetry.samples.sample import is_position
from telemetry.samples.times import ZONE_UNKNOWN, epoch_of, parse_time
from telemetry.samples.unreadable import Unreadable, read_or_reason

Run = Callable[..., Iterator[Any]]  # maps a function over items, in order

HEMISPHERE_UNKNOWN = "without hemisphere, taken as north and east"
"""End of the origin of a position whose signs are not known."""

VOID = "void by the receiver's own word (GPSStatus V)"
"""Part of the origin of such a position: the receiver had no fix, or its camera always says so."""

_FULL_FRAME_DIAGONAL_MM = 43.2666
_SAME_LENS: Final = 0.1  # focal lengths by two tags differ by less (logarithm): rounding, crops of video modes
_CHUNK = 64

SENSORS: Final = {"wide": ("wide", "visible"), "zoom": ("zoom",), "thermal": ("infrared", "thermal")}
"""Sensors of cameras with several, the ones that are mapped first first, and what XMP calls them."""
_SENSOR_LETTER: Final = re.compile(r"_\d{4}_(?:D_)?([WVZT])(?:_|$)")  # DJI_20260504100000_0001_V_Waypoint3, DJI_0001_T
_SENSOR_WORD: Final = re.compile(r"[_-](thermal|infrared|visible|wide|zoom)$", re.IGNORECASE)
_BAND_NAME: Final = re.compile(r"_(?:MS_(G|R|RE|NIR)|(GRE|RED|REG|NIR))(?:_|$)")  # DJI's and Parrot's file names
_MICASENSE_NUMBER: Final = re.compile(r"IMG_\d{4}_(\d{1,2})$")
_MICASENSE_BANDS: Final = ("blue", "green", "red", "nir", "red edge")  # its RedEdge and Altum number them so
_SAME_BANDS: Final = {
    "g": "green", "gre": "green", "r": "red", "b": "blue", "re": "red edge", "reg": "red edge", "rededge": "red edge",
    "red-edge": "red edge", "near infrared": "nir", "near-infrared": "nir", "nearinfrared": "nir", "lwir": "thermal",
}  # fmt: skip
CONTRADICTS_M: Final = 30.0  # positions of one photo's tags that are farther apart are of two places
ALTITUDE_CONTRADICTS_M: Final = 120.0  # above sea and ellipsoid differ by at most 107 m (EGM96)
_MOST_HEIGHT_M: Final = 12_000.0  # recorded heights above this are not heights above ground


@dataclass(slots=True, kw_only=True)
class Photo:
    """One photo with its tags, and what tables and logs add to them."""

    path: Path  # the file
    width: int  # columns as stored
    height: int  # rows
    lat_deg: float | None = None  # latitude, None without a position
    lon_deg: float | None = None  # longitude
    # another latitude and longitude that the photo's tags state, far from that
    other_position: tuple[float, float] | None = None
    altitude_m: float | None = None  # absolute altitude
    other_altitude_m: float | None = None  # another one that the photo's tags state, far from that
    height_m: float | None = None  # height above takeoff
    height_is_ground: bool = False  # whether height_m is above the ground instead
    time_s: float | None = None  # UTC epoch seconds
    camera_deg: Angles = (None, None, None)  # yaw, pitch, roll of the camera (gimbal), pitch -90 looking straight down
    flight_deg: Angles = (None, None, None)  # yaw, pitch, roll of the airframe
    position_sigma_m: float | None = None  # horizontal, one sigma, where stated
    make: str = ""  # manufacturer
    model: str = ""  # of the camera
    camera: str = ""  # key of the lens (model, size, zoom, sensor)
    band: str = ""  # name of the spectral band, "" for a colour picture
    sensor: str = ""  # which of a camera's several took it, a key of SENSORS; "" if it has one
    fov_hint_rad: float | None = None  # horizontal field of view from focal length tags
    dewarp_k1: float | None = None  # radial distortion that the tags state for a picture which still has it
    yaw_is_stated: bool = False  # True if the source defines its yaw as the picture's, so that there is no choice
    origin: dict[str, str] = field(default_factory=dict)  # field -> its source
    damaged: bool = False  # True for a picture of a video that lost parts
    ambiguous: bool = False  # True where it may belong to another camera event of a log
    # why the logs that are there give it no position (one for all with that reason), and a detail
    unplaced: tuple[str, str] = ("", "")


def read_photo(path: Path) -> Photo | None:
    """Read the tags of one photo; None for a georeferenced raster, which is not a photo.

    Raises NotAPicture: the file is not a readable picture; its text is the reason.
    """
    container = read_container(path)
    if container.georeferenced:
        return None
    if b"GPano:ProjectionType" in (container.xmp or b""):
        raise NotAPicture("a panorama, which no single camera sees; use the photos that it was made of")
    if container.raw:
        try:
            container.width, container.height = raw_size(content(path))
        except PictureError as error:
            raise NotAPicture(str(error)) from None
    return tags_of(path, container)


def with_sidecar(path: Path, sidecar: Path) -> Photo:
    """The tags of a photo and of an XMP file beside it, which counts where both state something.

    Raises NotAPicture: the photo is not readable; OSError: the other file is not.
    """
    container = read_container(path)
    with sidecar.open("rb") as handle:
        container.xmp = container.xmp[: xmp.MAX_PACKET - 1] + b"\n" + handle.read(xmp.MAX_PACKET)
    return tags_of(path, container)


def read_photos(
    paths: Sequence[Path], *, workers: int = 4, run: Run | None = None, progress: Callable[[int], None] | None = None
) -> Generator[Photo | Unreadable | None, None, None]:
    """Read many photos in parallel, in order; for a file that cannot be read, the reason.

    Args:
        workers: threads, used without `run`, as reading from a slow disk is mostly waiting.
        run: maps a function over items in processes, in order, where the photos are many and the disk is fast.
        progress: called with the number of photos done since the last call.
    """
    chunks = []
    for i in range(0, len(paths), _CHUNK):
        own = paths[i : i + _CHUNK]
        chunks.append((own, {path: file for path in own if is_stored(path) and (file := known(path)) is not None}))
    with ThreadPoolExecutor(max(1, workers)) as pool:
        for result in (run or pool.map)(_read_chunk, chunks):
            if progress is not None:
                progress(len(result))
            yield from result


def _read_chunk(chunk: tuple[Sequence[Path], dict[Path, StoredFile]]) -> list[Photo | Unreadable | None]:
    """Read photos one after the other, with what is known about those in stores."""
    paths, stored = chunk
    if not any(map(is_stored, paths)):
        return [read_or_reason(read_photo, path) for path in paths]
    expect(stored)
    with ThreadPoolExecutor(CONNECTIONS) as pool:  # a request mostly waits for the network
        return list(pool.map(lambda path: read_or_reason(read_photo, path), paths))


def tags_of(path: Path, container: Container) -> Photo:
    """The tags in a picture container."""
    tags = container.exif
    found = xmp.properties(container.xmp) if container.xmp else {}
    photo = Photo(path=path, width=container.width, height=container.height)
    photo.make = exif.text(tags.main.get(exif.MAKE)) or found.get("tiff:Make", "")
    photo.model = exif.text(tags.main.get(exif.MODEL)) or found.get("tiff:Model", "")
    _position(photo, tags, found)
    _heights(photo, tags, found)
    _time(photo, tags, found)
    _angles(photo, tags, found)
    _lens(photo, tags, found)
    return photo


def _position(photo: Photo, tags: exif.Exif, found: xmp.Properties) -> None:
    position, other, source, datum = exif.gps_position(tags.gps), _xmp_position(found), "EXIF GPS", ""
    if position is not None:
        position, datum = in_wgs84(position, exif.text(tags.gps.get(18)))
    if position is None:
        position, other, source = other, None, "XMP position"
    elif not all(signs := exif.gps_signs(tags.gps)):
        if other is None:
            source = f"EXIF GPS {HEMISPHERE_UNKNOWN}"
        else:
            lat, lon = (a if known else math.copysign(a, b) for a, b, known in zip(position, other, signs, strict=True))
            position, source = (lat, lon), "EXIF GPS, hemisphere from XMP"
    elif other is not None and mirrored(position, other):  # a hemisphere is one wrong letter
        position, other, source, datum = other, position, "XMP position", ""
    if position is not None:
        photo.lat_deg, photo.lon_deg = position
        void = f", {VOID}" if exif.text(tags.gps.get(9)).upper() == "V" else ""
        photo.origin["position"] = f"{source}{void}{datum}"
        if other is not None and distance_m(*position, *other) > CONTRADICTS_M:
            photo.other_position = other
    flag = xmp.number(found, "drone-dji:RtkFlag")
    if flag in (34.0, 50.0):  # 50 fixed, 34 float; 16 is a single fix, whose deviations mean little
        parts = [xmp.number(found, f"drone-dji:RtkStd{axis}") for axis in ("Lat", "Lon")]
        known = [p for p in parts if p is not None and 0.0 < p < 100.0]
        if known:
            photo.position_sigma_m = max(known)
            photo.origin["position_sigma"] = "XMP RTK"
    if photo.position_sigma_m is None:
        stated = xmp.number(found, "Camera:GPSXYAccuracy", "sensefly:GPSXYAccuracy") or exif.number(tags.gps.get(31))
        if stated is not None and 0.0 < stated < 1000.0:
            photo.position_sigma_m = stated
            photo.origin["position_sigma"] = "stated accuracy"


def mirrored(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two positions differ by hemispheres, which no other error does: mirrored they are much nearer."""
    apart_m = distance_m(*one, *other)
    return apart_m > CONTRADICTS_M and distance_m(*map(abs, one), *map(abs, other)) < 0.01 * apart_m


def _xmp_position(found: xmp.Properties) -> tuple[float, float] | None:
    lat = xmp.number(found, *(f"{p}:{n}" for p in _POSITION_PREFIXES for n in ("GpsLatitude", "Latitude")))
    lon_names = ("GpsLongitude", "GpsLongtitude", "Longitude")
    lon = xmp.number(found, *(f"{p}:{n}" for p in _POSITION_PREFIXES for n in lon_names))
    if lat is None or lon is None:
        lat, lon = xmp.degrees(found, "exif:GPSLatitude"), xmp.degrees(found, "exif:GPSLongitude")
    return (lat, lon) if lat is not None and lon is not None and is_position(lat, lon) else None


def _heights(photo: Photo, tags: exif.Exif, found: xmp.Properties) -> None:
    altitude, other = exif.gps_altitude(tags.gps), xmp.number(found, *_ABSOLUTE_ALTITUDES)
    if altitude is None or (other is not None and abs(altitude + other) < 1.0):  # the reference is one wrong number
        altitude, other = other, altitude
    photo.altitude_m = altitude
    if altitude is not None and other is not None and abs(altitude - other) > ALTITUDE_CONTRADICTS_M:
        photo.other_altitude_m = other
    ground = xmp.number(found, "Camera:AboveGroundAltitude")
    if ground is not None and 0.0 < ground < _MOST_HEIGHT_M:
        photo.height_m, photo.height_is_ground = ground, True
        photo.origin["height"] = "XMP AboveGroundAltitude"
        return
    others = sorted(name for name in found if name.endswith(":RelativeAltitude"))  # makers that follow DJI's names
    relative = xmp.number(found, *_RELATIVE_ALTITUDES, *others)
    if relative is not None and abs(relative) < _MOST_HEIGHT_M:
        photo.height_m = relative
        photo.origin["height"] = "XMP RelativeAltitude"


_POSITION_PREFIXES = ("drone-dji", "drone", "drone-skydio")
_ABSOLUTE_ALTITUDES = (*(f"{prefix}:AbsoluteAltitude" for prefix in _POSITION_PREFIXES), "exif:GPSAltitude")
_RELATIVE_ALTITUDES = (
    *(f"{prefix}:RelativeAltitude" for prefix in ("drone-dji", "drone-parrot", "drone", "drone-skydio")),
    "drone-yuneec:AboveHomeAltitude",
)


def _time(photo: Photo, tags: exif.Exif, found: xmp.Properties) -> None:
    exact = epoch_of(found.get("drone-dji:UTCAtExposure", ""))
    exposed = (exact, "XMP UTCAtExposure") if exact is not None else exif.exposure_time(tags)
    if exposed is None:
        written = parse_time(found.get("exif:DateTimeOriginal") or found.get("xmp:CreateDate", ""))
        if written is not None:
            exposed = written[0], "XMP time" if written[1] else f"XMP time {ZONE_UNKNOWN}"
    if exposed is not None:
        photo.time_s, photo.origin["time"] = exposed


def _angles(photo: Photo, tags: exif.Exif, found: xmp.Properties) -> None:
    """Camera and airframe attitude: XMP, then DJI's maker note, then the EXIF direction."""
    camera, flight = camera_angles(found, photo.make), flight_angles(found)
    if camera is not None:
        photo.camera_deg, photo.origin["angles"] = camera[0], f"XMP {camera[1]}"
    if flight is not None:
        photo.flight_deg, photo.origin["flight_yaw"] = flight[0], f"XMP {flight[1]}"
    note = tags.exif.get(exif.MAKER_NOTE)
    if photo.camera_deg == (None, None, None) and isinstance(note, bytes):
        dji = parse_dji(note)
        if dji is not None:
            photo.camera_deg = (dji.yaw_deg, dji.pitch_deg, dji.roll_deg)
            photo.flight_deg = (dji.flight_yaw_deg, dji.flight_pitch_deg, dji.flight_roll_deg)
            photo.origin["angles"] = photo.origin["flight_yaw"] = "DJI MakerNotes"
    direction = exif.number(tags.gps.get(17))
    if (
        photo.camera_deg[0] is None
        and photo.flight_deg[0] is None
        and direction is not None
        and 0.0 <= direction <= 360.0
        and exif.text(tags.gps.get(16)) != "M"
    ):
        photo.camera_deg = (direction, photo.camera_deg[1], photo.camera_deg[2])
        photo.origin["angles"] = "EXIF GPSImgDirection"


def _lens(photo: Photo, tags: exif.Exif, found: xmp.Properties) -> None:
    focal = exif.number(tags.exif.get(exif.FOCAL_MM))
    focal_35 = exif.number(tags.exif.get(exif.FOCAL_35MM))
    zoom = exif.number(tags.exif.get(exif.DIGITAL_ZOOM)) or 1.0
    photo.band = _band(photo, found.get("Camera:BandName", found.get("drone-dji:BandName", "")))
    sensor = found.get("drone-dji:ImageSource", "")
    photo.sensor = _sensor(sensor, photo.path.stem)
    length, zoomed = f"{focal:.1f}mm" if focal else "", f"zoom{zoom:.1f}" if zoom > 1.0 else ""
    key = (photo.model or "camera", f"{photo.width}x{photo.height}", length, zoomed, sensor or photo.sensor, photo.band)
    photo.camera = " ".join(filter(None, key))
    photo.dewarp_k1 = _dewarp_k1(found)
    hints = list(_fov_hints(photo, found, tags, focal=focal, focal_35=focal_35, zoom=max(zoom, 1.0)))
    hints = [(fov, source) for fov, source in hints if math.radians(2.0) < fov < math.radians(150.0)]
    if hints:
        photo.fov_hint_rad, photo.origin["fov_hint"] = _confirmed(hints)


def _sensor(source: str, stem: str) -> str:
    """Which sensor took a picture, a key of SENSORS or "", by XMP's ImageSource, else by the end of the file's name."""
    said = source.lower()
    return next((sensor for sensor, words in SENSORS.items() if any(w in said for w in words)), sensor_of_name(stem))


def sensor_of_name(stem: str) -> str:
    """Which of a camera's sensors took a picture or video, by its name without suffix; "" if it does not say."""
    if word := _SENSOR_WORD.search(stem):
        return next(sensor for sensor, words in SENSORS.items() if word[1].lower() in words)
    match = _SENSOR_LETTER.search(stem)
    return {"W": "wide", "V": "wide", "Z": "zoom", "T": "thermal"}[match[1]] if match else ""


def _band(photo: Photo, said: str) -> str:
    """The spectral band, "" for colour, by XMP's BandName, else by the file's name as its maker's cameras write it."""
    if said.strip("{}").upper() in ("RGB", "R,G,B"):
        return ""
    if not said and photo.make.upper().startswith(("DJI", "PARROT")):
        match = _BAND_NAME.search(photo.path.stem)
        said = (match[1] or match[2]) if match else ""
    elif not said and photo.make.upper().startswith("MICASENSE"):
        match = _MICASENSE_NUMBER.search(photo.path.stem)
        said = (match and dict(enumerate(_MICASENSE_BANDS, 1)).get(int(match[1]), f"number {match[1]}")) or ""
    return band_name(said)


def band_name(said: str) -> str:
    """One name for a spectral band that is written in several ways ("RE", "Red edge"), in lower case."""
    return _SAME_BANDS.get(said.strip().lower(), said.strip().lower())


def _confirmed(hints: Sequence[tuple[float, str]]) -> tuple[float, str]:
    """The first hint that another one confirms: each of the tags is wrong in some pictures.

    Where none is, a calibrated one, or that of full frame: an editor that makes a picture smaller leaves the others as
    they were.
    """
    for k, (fov, source) in enumerate(hints):
        if any(_agree(fov, other) for other, _ in [*hints[:k], *hints[k + 1 :]]):
            return fov, source
    return hints[0] if hints[0][1].startswith("XMP") else hints[-1]


def _agree(fov_rad: float, other_rad: float) -> bool:
    return abs(math.log(math.tan(0.5 * fov_rad) / math.tan(0.5 * other_rad))) < _SAME_LENS


def _dewarp_k1(found: xmp.Properties) -> float | None:
    """k1 of DJI's "date;fx,fy,cx,cy,k1,k2,p1,p2,k3" where the picture was not dewarped by the camera."""
    if xmp.number(found, "drone-dji:DewarpFlag") != 0.0:
        return None
    numbers = found.get("drone-dji:DewarpData", "").partition(";")[2].split(",")
    try:
        return float(numbers[4])
    except (IndexError, ValueError):
        return None


def _fov_hints(
    photo: Photo,
    found: xmp.Properties,
    tags: exif.Exif,
    *,
    focal: float | None,
    focal_35: float | None,
    zoom: float,
) -> Iterator[tuple[float, str]]:
    """Horizontal field of view by several tags, the most trustworthy first."""
    for length, centre in (
        ("drone-dji:CalibratedFocalLength", "drone-dji:CalibratedOpticalCenterX"),
        ("drone-skydio:CalibratedFocalLength/X", "drone-skydio:CalibratedOpticalCenter/X"),
    ):
        # Of the full picture without digital zoom; its half width is the principal point: valid for a scaled copy, too.
        calibrated, middle = xmp.number(found, length), xmp.number(found, centre)
        if calibrated and middle and calibrated > 0 and middle > 0:
            yield 2.0 * math.atan(middle / (calibrated * zoom)), "XMP CalibratedFocalLength"
    perspective = xmp.number(found, "Camera:PerspectiveFocalLength") or focal
    per_unit = exif.number(tags.exif.get(exif.FOCAL_PLANE_X))
    unit = exif.number(tags.exif.get(exif.FOCAL_PLANE_UNIT))
    columns = exif.number(tags.exif.get(exif.PIXEL_X)) or photo.width
    if perspective and per_unit and perspective > 0 and per_unit > 0:
        pitch_mm = {3.0: 10.0, 4.0: 1.0}.get(unit or 0.0, 25.4) / per_unit
        yield 2.0 * math.atan(0.5 * columns * pitch_mm / perspective), "EXIF focal plane resolution"
    if focal_35 and focal_35 > 0:
        diagonal = math.hypot(photo.width, photo.height)
        if photo.make.upper().startswith("DJI") and photo.width > 1.7 * photo.height:
            diagonal = 1.25 * photo.width  # the 16:9 mode crops rows off a 4:3 sensor, to which the tag belongs
        pixels = focal_35 * zoom / _FULL_FRAME_DIAGONAL_MM * diagonal
        yield 2.0 * math.atan(0.5 * photo.width / pixels), "EXIF FocalLengthIn35mmFilm"
