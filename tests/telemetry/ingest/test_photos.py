"""Photos in: EXIF, XMP, maker notes, containers, and what is refused."""

import io
import math
import struct
from datetime import UTC, datetime
from pathlib import Path

import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from telemetry.formats.photo import exif, xmp
from telemetry.formats.photo.exif import parse_dji
from telemetry.formats.photo.picture_container import NotAPicture, read_container
from telemetry.ingest.ingest import survey
from telemetry.photos.photo_tags import read_photo
from telemetry.samples.times import epoch_seconds, parse_offset, parse_time

DJI_ATTRIBUTES = b"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description rdf:about="DJI"
 xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:RelativeAltitude="+120.40"
 drone-dji:GimbalYawDegree="-12.5" drone-dji:GimbalPitchDegree="-90.00" drone-dji:GimbalRollDegree="+0.00"
 drone-dji:FlightYawDegree="-11.0" drone-dji:GpsLatitude="47.5" drone-dji:GpsLongtitude="8.25"
 drone-dji:RtkFlag="50" drone-dji:RtkStdLat="0.011" drone-dji:RtkStdLon="0.014"/></rdf:RDF></x:xmpmeta>"""


def jpeg(path: Path, *, xmp_packet: bytes = b"", exif_bytes: bytes = b"", size=(64, 48)) -> Path:
    buffer = io.BytesIO()
    extra = {"exif": exif_bytes} if exif_bytes else {}
    Image.new("RGB", size, (90, 120, 60)).save(buffer, "JPEG", **extra)
    data = buffer.getvalue()
    if xmp_packet:
        body = b"http://ns.adobe.com/xap/1.0/\0" + xmp_packet
        data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]
    path.write_bytes(data)
    return path


def gps_exif(
    lat=47.5, lon=8.25, *, local="2024:05:06 12:00:01", subsec="250", offset=None, gps_utc=None, make="DJI", model="FC1"
) -> bytes:
    tags = Image.Exif()
    tags[0x010F], tags[0x0110] = make, model
    inner = tags.get_ifd(0x8769)
    inner[0x9003], inner[0x9291] = local, subsec
    inner[0xA405] = 24
    if offset:
        inner[0x9011] = offset
    gps = tags.get_ifd(0x8825)
    gps[1], gps[3] = ("N" if lat >= 0 else "S"), ("E" if lon >= 0 else "W")
    for tag, value in ((2, abs(lat)), (4, abs(lon))):
        minutes = (value % 1) * 60
        gps[tag] = (float(int(value)), float(int(minutes)), round((minutes % 1) * 60, 6))
    if gps_utc:
        gps[7], gps[29] = gps_utc
    return tags.tobytes()


def test_the_height_of_makers_that_follow_djis_names_is_read(tmp_path):
    packet = b'<x:xmpmeta><a teal:GimbalPitchDegree="-70" teal:RelativeAltitude="60"/></x:xmpmeta>'
    photo = read_photo(jpeg(tmp_path / "a.jpg", xmp_packet=packet, exif_bytes=gps_exif(make="Teal")))
    assert (photo.height_m, photo.origin["height"]) == (60.0, "XMP RelativeAltitude")


def test_the_lens_of_a_skydio_is_read(tmp_path):
    packet = (
        b'<x:xmpmeta><drone-skydio:CalibratedFocalLength drone-skydio:X="3046.6" drone-skydio:Y="3046.6"/>'
        b'<drone-skydio:CalibratedOpticalCenter drone-skydio:X="2028.0" drone-skydio:Y="1520.0"/></x:xmpmeta>'
    )
    photo = read_photo(jpeg(tmp_path / "a.jpg", xmp_packet=packet, exif_bytes=gps_exif(make="Skydio")))
    assert photo.fov_hint_rad == pytest.approx(2.0 * math.atan(2028.0 / 3046.6))
    assert photo.origin["fov_hint"] == "XMP CalibratedFocalLength"


def test_xmp_attributes_and_elements_read_alike():
    elements = (
        b"<x:xmpmeta><drone-dji:GimbalYawDegree>+44.20</drone-dji:GimbalYawDegree>"
        b"<drone-dji:RelativeAltitude> +40.10 </drone-dji:RelativeAltitude>"
    )
    assert xmp.number(xmp.properties(elements), "drone-dji:GimbalYawDegree") == 44.2
    assert xmp.number(xmp.properties(elements), "drone-dji:RelativeAltitude") == 40.1
    assert xmp.number(xmp.properties(DJI_ATTRIBUTES), "drone-dji:GimbalYawDegree") == -12.5


MAKERS = {
    # maker: (EXIF make, XMP attributes, camera's yaw, pitch and roll, height and whether above ground, sigma)
    "parrot-anafi": (
        "Parrot",
        'drone-parrot:CameraYawDegree="31.5" drone-parrot:CameraPitchDegree="-88" drone-parrot:CameraRollDegree="0.5" '
        'drone-parrot:DroneYawDegree="30.0" drone-parrot:DronePitchDegree="-4.0" drone-parrot:DroneRollDegree="1.0" '
        'drone-parrot:RelativeAltitude="42.5"',
        (31.5, -88.0, 0.5), (42.5, False), None,
    ),
    "parrot-sequoia": (
        "Parrot",
        'Camera:Yaw="120.0" Camera:Pitch="2.0" Camera:Roll="-3.0" Camera:AboveGroundAltitude="61.0" '
        'Camera:GPSXYAccuracy="1.5"',
        (120.0, -88.0, -3.0), (61.0, True), 1.5,
    ),
    "autel-evo": (
        "Autel Robotics",
        'Camera:Yaw="-75.0" Camera:Pitch="-90.0" Camera:Roll="0.0" drone:RelativeAltitude="55.0"',
        (-75.0, -90.0, 0.0), (55.0, False), None,
    ),
    "autel-2021": (
        "Autel Robotics",
        'drone:GimbalYawDegree="31.5" drone:GimbalPitchDegree="-88" drone:GimbalRollDegree="0.5" Camera:Pitch="-88" '
        'drone:FlightYawDegree="30.0" drone:RelativeAltitude="55.0"',
        (31.5, -88.0, 0.5), (55.0, False), None,
    ),
    "autel-oblique": (
        "Autel Robotics", 'Camera:Yaw="-75.0" Camera:Pitch="-20.0" Camera:Roll="0.0"', (-75.0, -20.0, 0.0),
        (None, False), None,
    ),
    "wingtra-oblique": (
        "SONY", 'Camera:Yaw="10.0" Camera:Pitch="-44.0" Camera:Roll="0.0"', (10.0, -44.0, 0.0), (None, False), None,
    ),
    "skydio-x2": (
        "Skydio",
        '><drone-skydio:CameraOrientationNED drone-skydio:Roll="0.1" drone-skydio:Pitch="-45.5" '
        'drone-skydio:Yaw="120.0"/><drone-skydio:CameraOrientationFLU drone-skydio:Roll="1" drone-skydio:Pitch="2" '
        'drone-skydio:Yaw="3"/><x',
        (120.0, -45.5, 0.1), (None, False), None,
    ),
    "skydio-x10": (
        "Skydio",
        '><drone-skydio:CameraOrientationNED rdf:parseType="Resource"><drone-skydio:Roll>0.1</drone-skydio:Roll>'
        "<drone-skydio:Pitch>-89.5</drone-skydio:Pitch><drone-skydio:Yaw>-120.0</drone-skydio:Yaw>"
        "</drone-skydio:CameraOrientationNED><drone-skydio:CameraOrientationFLU><drone-skydio:Yaw>7</drone-skydio:Yaw>"
        "</drone-skydio:CameraOrientationFLU><x",
        (-120.0, -89.5, 0.1), (None, False), None,
    ),
    "yuneec": (
        "Yuneec",
        'drone-yuneec:GimbalYaw="73.230003" drone-yuneec:GimbalPitch="-89.95999" drone-yuneec:GimbalRoll="0.0" '
        'drone-yuneec:DroneYaw="96.699997" drone-yuneec:AboveHomeAltitude="69.84"',
        (73.230003, -89.95999, 0.0), (69.84, False), None,
    ),
    "teal, and whoever follows the names of DJI": (
        "Teal",
        'drone-teal:GimbalYawDegree="12.0" drone-teal:GimbalPitchDegree="-60.0" drone-teal:GimbalRollDegree="0.0"',
        (12.0, -60.0, 0.0), (None, False), None,
    ),
    "sensefly-older": (
        "senseFly",
        'sensefly:Yaw="189.428" sensefly:Pitch="12.5908" sensefly:Roll="-3.384" sensefly:GPSXYAccuracy="1.5"',
        (189.428, -77.4092, -3.384), (None, False), 1.5,
    ),
    "sensefly": (
        "senseFly",
        'Camera:Yaw="200.0" Camera:Pitch="5.0" Camera:Roll="4.0" Camera:GPSXYAccuracy="0.03"',
        (200.0, -85.0, -4.0), (None, False), 0.03,
    ),
    "micasense": (
        "MicaSense",
        'Camera:Yaw="10.0" Camera:Pitch="-3.0" Camera:Roll="1.0" Camera:BandName="Green"',
        (10.0, -93.0, 1.0), (None, False), None,
    ),
}  # fmt: skip


@pytest.mark.parametrize("maker", MAKERS)
def test_attitude_height_and_accuracy_are_read_as_each_maker_writes_them(tmp_path, maker):
    make, attributes, angles, height, sigma = MAKERS[maker]
    packet = f"<x:xmpmeta><rdf:Description {attributes}/></x:xmpmeta>".encode()
    photo = read_photo(jpeg(tmp_path / "a.jpg", xmp_packet=packet, exif_bytes=gps_exif(make=make)))
    assert photo is not None
    assert photo.camera_deg == pytest.approx(angles)
    assert (photo.height_m, photo.height_is_ground) == height
    assert photo.position_sigma_m == sigma
    assert photo.band == ("green" if maker == "micasense" else "")


def test_position_comes_from_xmp_where_exif_has_none(tmp_path):
    photo = read_photo(jpeg(tmp_path / "a.jpg", xmp_packet=DJI_ATTRIBUTES))
    assert (photo.lat_deg, photo.lon_deg) == (47.5, 8.25)
    assert photo.position_sigma_m == 0.014
    assert photo.height_m == 120.4
    assert photo.camera_deg == (-12.5, -90.0, 0.0)
    assert (photo.width, photo.height) == (64, 48)


@pytest.mark.parametrize(
    ("kwargs", "expected"),
    [
        ({}, 1714996801.25),
        ({"offset": "+02:00"}, 1714996801.25 - 7200),
        ({"gps_utc": ((10.0, 0.0, 0.0), "2024:05:06")}, 1714996801.25 - 7200),
    ],
)
def test_time_keeps_subseconds_and_takes_the_zone_where_it_is_known(tmp_path, kwargs, expected):
    photo = read_photo(jpeg(tmp_path / "a.jpg", exif_bytes=gps_exif(**kwargs)))
    assert photo.time_s == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("lat", "lon"), [(47.5, 8.25), (-33.9, 151.2), (12.25, -70.5)])
def test_hemispheres(tmp_path, lat, lon):
    photo = read_photo(jpeg(tmp_path / "a.jpg", exif_bytes=gps_exif(lat, lon)))
    assert (photo.lat_deg, photo.lon_deg) == pytest.approx((lat, lon), abs=1e-8)


def written(utc: float) -> str:
    return datetime.fromtimestamp(utc, UTC).strftime("%Y:%m:%d %H:%M:%S")


def time_of(folder, clock: float, stamp: float, date_from: float | None = None) -> tuple[float, str]:
    """Time and its origin of a photo with these times of its clock and receiver, and the date that the stamp names."""
    of_day = (float(stamp % 86400.0 // 3600.0), float(stamp % 3600.0 // 60.0), stamp % 60.0)
    date = written(stamp if date_from is None else date_from)[:10]
    photo = read_photo(jpeg(folder / "a.jpg", exif_bytes=gps_exif(local=written(clock), gps_utc=(of_day, date))))
    return photo.time_s, photo.origin["time"]


WEEKS_1024_S = 1024 * 7 * 86400.0


@given(
    utc=st.integers(1_200_000_000, 1_900_000_000),
    zone=st.integers(-40, 52),
    lag=st.integers(-100, 100),
    date=st.sampled_from(["right", "local", "a day late", "rolled over"]),
)
@settings(max_examples=100, deadline=None)
def test_a_stamp_with_a_wrong_date_gives_the_zone_and_the_camera_the_date(tmp_path_factory, utc, zone, lag, date):
    stamp, clock = float(utc - lag), utc + 900.0 * zone
    dates = {"right": stamp, "local": clock, "a day late": stamp - 86400.0, "rolled over": stamp - WEEKS_1024_S}
    if date in ("local", "a day late") and not -40 < zone < 52:
        return  # the day before in Hawaii is today in Kiribati, tomorrow in New Zealand is today in Samoa
    if date == "local" and clock // 86400 != (clock - lag) // 86400:
        return
    found, origin = time_of(tmp_path_factory.mktemp("t"), clock, stamp, dates[date])
    assert (found, origin) == (utc + 0.25, "EXIF time, zone from GPS time")


T0 = 1_715_000_000.0  # 2024-05-06


@pytest.mark.parametrize("clock", [0.0, 946_684_800.0, 1_420_070_400.0, T0 - 40 * 86400.0, T0 + 300 * 86400.0])
def test_a_clock_that_was_never_set_or_set_wrongly_gives_way_to_the_stamp(tmp_path, clock):
    for minutes in range(0, 15, 3):  # whether or not the minutes agree by chance
        assert time_of(tmp_path, clock + 60.0 * minutes + 7.0, T0) == (T0, "EXIF GPS time")


def test_a_clock_whose_minutes_are_wrong_gives_way_to_the_stamp(tmp_path):
    assert time_of(tmp_path, T0 + 7200.0 + 180.0, T0) == (T0, "EXIF GPS time")
    assert time_of(tmp_path, T0 + 7200.0 + 180.0, T0, T0 - WEEKS_1024_S) == (T0, "EXIF GPS time")


@pytest.mark.parametrize("date", [315_964_800.0, 946_684_800.0, 1_445_126_400.0])
def test_the_stamp_of_a_receiver_without_a_fix_is_not_believed(tmp_path, date):
    assert time_of(tmp_path, T0, T0, date) == (T0 + 0.25, "EXIF time without zone, taken as UTC")


def changed_gps(change, **kwargs) -> bytes:
    """EXIF whose GPS directory (tag -> value) a function changes."""
    tags = Image.Exif()
    tags.load(gps_exif(**kwargs))
    change(tags.get_ifd(0x8825))
    return tags.tobytes()


def without_refs(gps):
    del gps[1], gps[3]


SOUTH_WEST = (
    b'<x:xmpmeta><rdf:Description drone-dji:GpsLatitude="-33.9" drone-dji:GpsLongitude="-70.6" '
    b'drone-dji:RelativeAltitude="+80.1"/></x:xmpmeta>'
)


def test_a_gps_position_without_hemispheres_takes_them_from_the_xmp_of_its_photo(tmp_path):
    unsigned = changed_gps(without_refs, lat=-33.9, lon=-70.6)
    photo = read_photo(jpeg(tmp_path / "a.jpg", exif_bytes=unsigned, xmp_packet=SOUTH_WEST))
    assert (photo.lat_deg, photo.lon_deg) == pytest.approx((-33.9, -70.6))
    one = changed_gps(lambda gps: gps.pop(3), lat=33.9, lon=-70.6)
    photo = read_photo(jpeg(tmp_path / "b.jpg", exif_bytes=one, xmp_packet=SOUTH_WEST))
    assert (photo.lat_deg, photo.lon_deg) == pytest.approx((33.9, -70.6))


def test_gps_positions_whose_hemispheres_nobody_states_are_reported(tmp_path):
    jpeg(tmp_path / "a.jpg", exif_bytes=changed_gps(without_refs, lat=-33.9, lon=-70.6))
    jpeg(tmp_path / "b.jpg", exif_bytes=gps_exif(33.9, 70.6))
    (finding,) = [f for s in survey([tmp_path]).sources for f in s.findings if f.code == "position-hemisphere"]
    assert "1 photo " in finding.message
    assert not finding.note
    (tmp_path / "geo.txt").write_text("EPSG:4326\na.jpg -70.6 -33.9\n")
    assert not [f for s in survey([tmp_path]).sources for f in s.findings if f.code == "position-hemisphere"]


@pytest.mark.parametrize(("ref", "sign"), [(0, 1.0), (1, -1.0), (2, 1.0), (3, -1.0), (None, 1.0)])
def test_altitudes_below_the_sea_or_the_ellipsoid_are_negative(tmp_path, ref, sign):
    def altitude(gps):
        gps[6] = 12.5
        if ref is not None:
            gps[5] = bytes([ref])

    assert read_photo(jpeg(tmp_path / "a.jpg", exif_bytes=changed_gps(altitude))).altitude_m == sign * 12.5


def test_zero_zero_is_no_position(tmp_path):
    assert read_photo(jpeg(tmp_path / "a.jpg", exif_bytes=gps_exif(0.0, 0.0))).lat_deg is None


def test_maker_note_of_sheffield_has_the_attitude(real_data):
    photo = read_photo(real_data("sheffield_cross_800") / "DJI_0056.JPG")
    assert photo.camera_deg == pytest.approx((90.2, -75.1, 0.0), abs=1e-3)
    assert photo.flight_deg == pytest.approx((89.3, -2.4, 4.4), abs=1e-3)
    assert photo.height_m is None
    assert photo.altitude_m == pytest.approx(-5.477)


def test_maker_note_agrees_with_xmp_where_both_are_there(real_data):
    for path in sorted(real_data("brighton_beach_1600").glob("*.JPG")):
        photo, note = read_photo(path), parse_dji(read_container(path).exif.exif[exif.MAKER_NOTE])
        assert (note.yaw_deg, note.pitch_deg) == pytest.approx(photo.camera_deg[:2], abs=0.051)


def test_calibrated_focal_length_and_rtk_of_mirafiori(real_data):
    photo = read_photo(real_data("mirafiori_rtk") / "DJI_0030.JPG")
    assert photo.fov_hint_rad == pytest.approx(2 * math.atan(800 / 1913.333374))
    assert photo.position_sigma_m == pytest.approx(0.01481)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "empty"),
        (b"hello, I am no picture at all", "content"),
        (b"\xff\xd8\xff\xe0\x00\x10JFIF", "header"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "cut off"),
        (b"II*\0\x08\0\0\0", "cut off"),
    ],
)
def test_what_is_no_picture_is_refused_with_its_reason(tmp_path, content, word):
    path = tmp_path / "bad.jpg"
    path.write_bytes(content)
    with pytest.raises(NotAPicture, match=word):
        read_photo(path)


def test_a_truncated_jpeg_is_refused_and_trailing_data_is_not(tmp_path, real_data):
    whole = (real_data("brighton_beach_1600") / "DJI_0018.JPG").read_bytes()
    path = tmp_path / "a.jpg"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(NotAPicture, match="cut off"):
        read_photo(path)
    path.write_bytes(whole + b"\0" * 3_000_000)
    assert read_photo(path).width == 1600


def test_a_png_under_a_jpeg_name_is_read_by_content(tmp_path):
    Image.new("RGB", (30, 20)).save(tmp_path / "a.png")
    path = tmp_path / "a.jpg"
    path.write_bytes((tmp_path / "a.png").read_bytes())
    photo = read_photo(path)
    assert (photo.width, photo.height) == (30, 20)


@pytest.mark.parametrize("endianness", ["LITTLE", "BIG"])
def test_a_large_georeferenced_tiff_is_no_photo_and_a_plain_one_no_picture_of_a_camera(tmp_path, endianness):
    path = tmp_path / "map.tif"
    shape = {"driver": "GTiff", "width": 4, "height": 4, "count": 1, "dtype": "uint8"}
    place = {"crs": "EPSG:32632", "transform": rasterio.Affine(1, 0, 5e5, 0, -1, 5e6)}
    with rasterio.open(path, "w", **shape, **place, BIGTIFF="YES", ENDIANNESS=endianness):
        pass
    assert path.read_bytes()[:4] in (b"II+\0", b"MM\0+")
    assert read_photo(path) is None
    data = path.read_bytes()
    path.write_bytes(data.replace(struct.pack("<H" if endianness == "LITTLE" else ">H", 34735), b"\xf0\xf0"))
    with pytest.raises(NotAPicture, match="BigTIFF"):
        read_photo(path)


def test_a_georeferenced_tiff_is_no_photo(real_data):
    assert read_photo(real_data("brighton_derived") / "ortho_from_cloud_0.1m_utm15.tif") is None


@pytest.mark.parametrize("format_", ["PNG", "WEBP", "TIFF", "BMP"])
def test_sizes_of_other_formats(tmp_path, format_):
    path = tmp_path / f"a.{format_.lower()}"
    Image.new("RGB", (33, 21), (1, 2, 3)).save(path)
    photo = read_photo(path)
    assert (photo.width, photo.height) == (33, 21)


@given(st.binary(max_size=400))
@settings(max_examples=150, deadline=None)
def test_parsers_survive_any_bytes(data):
    exif.parse_tiff(data)
    exif.parse_tiff(b"II*\0\x08\0\0\0" + data)
    exif.parse_tiff(b"MM\0*\0\0\0\x08" + data)
    xmp.properties(data)
    parse_dji(data)
    parse_dji(b"\x05\0\x01\0\x02\0\x04\0\0\0DJI\0" + data)


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_damaged_photos_are_read_or_refused_but_never_break(tmp_path_factory, data):
    source = gps_exif()
    path = jpeg(tmp_path_factory.mktemp("fuzz") / "a.jpg", xmp_packet=DJI_ATTRIBUTES, exif_bytes=source)
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 8))):
        raw[data.draw(st.integers(2, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw[: data.draw(st.integers(0, len(raw)))])
    try:
        photo = read_photo(path)
    except NotAPicture as reason:
        assert str(reason)
    else:
        assert photo.lat_deg is None or exif.is_position(photo.lat_deg, photo.lon_deg)


def test_time_formats():
    assert parse_time("2024-05-06T12:00:01.5+02:00") == (1714996801.5 - 7200, True)
    assert parse_time("2024:05:06 12:00:01") == (1714996801.0, False)
    assert parse_time("0000:00:00 00:00:00") is None
    assert parse_time("2024-05-06 12:00:00-05") == (1714996800.0 + 5 * 3600, True)
    assert parse_time("2024-05-06T12:00Z") == parse_time("2024-05-06 12:00:00 UTC") == (1714996800.0, True)
    assert parse_offset("-05:30") == -19800.0
    assert parse_offset("+02") == 7200.0


@pytest.mark.parametrize("rest", ["+2", "+2:00", "+99:00", "+02:0", " PM", " CEST", "[Europe/Berlin]", ":30", "x"])
def test_a_time_with_a_rest_that_is_not_understood_is_none(rest):
    assert parse_time(f"2024-05-06 12:00:01{rest}") is None


def test_what_follows_a_time_in_exif_is_no_part_of_it(tmp_path):
    photo = read_photo(jpeg(tmp_path / "a.jpg", exif_bytes=gps_exif(local="2024:05:06 12:00:01 DST")))
    assert photo.time_s == 1714996801.25


@given(st.floats(1e9, 7e9), st.sampled_from([1.0, 1e3, 1e6, 1e9]))
def test_times_since_1970_are_read_in_any_unit(seconds, scale):
    assert epoch_seconds(seconds * scale) == pytest.approx(seconds)
