"""Tags of one photo that contradict each other: two places, signs of all parts, several lenses, what is no photo."""

import math

import pytest
from PIL import Image

from telemetry import LoadOptions, load
from telemetry.formats.photo import exif
from telemetry.formats.photo.picture_container import NotAPicture
from telemetry.photos.photo_tags import read_photo
from tests.telemetry.ingest.test_photos import gps_exif, jpeg

TAGS = '<x:xmpmeta><a drone-dji:GpsLatitude="{:.6f}" drone-dji:GpsLongitude="{:.6f}"/></x:xmpmeta>'
LENS = '<x:xmpmeta><a drone-dji:CalibratedFocalLength="{}" drone-dji:CalibratedOpticalCenterX="200"/></x:xmpmeta>'


def with_tags(source, *, main=(), inner=(), gps=()):
    """EXIF with more tags in its three directories; None takes one away."""
    tags = Image.Exif()
    tags.load(source)
    for directory, more in ((tags, main), (tags.get_ifd(0x8769), inner), (tags.get_ifd(0x8825), gps)):
        directory.update(dict(more))
    return tags.tobytes()


def flight(folder, exif_place, xmp_place, count=6):
    """Photos 30 m apart; each place is a function of the true one and the photo's number."""
    for k in range(count):
        true = 47.5, 8.25 + 4e-4 * k
        packet = TAGS.format(*xmp_place(true, k)).encode()
        seconds = f"2024:05:06 12:00:{5 * k:02d}"
        jpeg(
            folder / f"{k}.jpg",
            xmp_packet=packet,
            exif_bytes=gps_exif(*exif_place(true, k), local=seconds, offset="+00:00"),
        )
    return load([folder])


def same(place, _):
    return place


def test_a_wrong_hemisphere_is_taken_from_the_tags_that_are_no_letter(tmp_path):
    ingest = flight(tmp_path, lambda place, _: (place[0], -place[1]), same)
    assert [frame.fix.lon_deg for frame in ingest.frames] == pytest.approx(
        [8.25 + 4e-4 * k for k in range(6)], abs=1e-6
    )
    assert any("hemispheres are taken from XMP" in warning for warning in ingest.warnings)


@pytest.mark.parametrize("wrong", ["exif", "xmp"])
def test_of_two_places_the_one_that_fits_the_neighbours_is_used(tmp_path, wrong):
    def astray(place, k):
        return (place[0] + 0.01, place[1]) if k in (2, 3) else place

    ingest = flight(tmp_path, *((astray, same) if wrong == "exif" else (same, astray)))
    assert [frame.fix.lat_deg for frame in ingest.frames] == pytest.approx([47.5] * 6, abs=1e-6)
    assert any("tags of 2 photos state two places, up to 1112 m apart" in warning for warning in ingest.warnings)


def test_where_nothing_tells_which_place_is_right_that_is_said(tmp_path):
    ingest = flight(tmp_path, lambda place, _: (place[0] + 0.01, place[1]), same)
    assert any("nothing tells which is right: give a geo.txt" in warning for warning in ingest.warnings)


@pytest.mark.parametrize(("stated", "altitude"), [("+1250.0", 250.0), ("-250.0", -250.0), ("+251.0", 250.0)])
def test_two_altitudes_of_one_photo_are_told(tmp_path, stated, altitude):
    tags = Image.Exif()
    tags.load(gps_exif())
    tags.get_ifd(0x8825)[6] = 250.0
    packet = f'<x:xmpmeta><a drone-dji:AbsoluteAltitude="{stated}"/></x:xmpmeta>'.encode()
    jpeg(tmp_path / "a.jpg", xmp_packet=packet, exif_bytes=tags.tobytes())
    ingest = load([tmp_path])
    assert ingest.frames[0].fix.altitude_m == altitude  # the number that states its sign counts
    told = any("state two altitudes" in warning for warning in ingest.warnings)
    assert told == (stated != "+251.0")


@pytest.mark.parametrize("signs", [(-1.0, -1.0, -1.0), (-1.0, 1.0, 1.0), (1.0, 1.0, 1.0)])
def test_degrees_minutes_and_seconds_may_all_have_a_sign(signs):
    west = tuple(sign * value for sign, value in zip(signs, (123.0, 4.0, 8.22), strict=True))
    _, lon = exif.gps_position({1: "N", 2: (47.0, 30.0, 0.0), 3: "W", 4: west})
    assert lon == pytest.approx(-123.06895, abs=1e-6)


def lens(tmp_path, *, calibrated=None, focal_35=None, plane=None, zoom=None):
    """Degrees of view of a photo of 400 x 300 pixels, and where they are from."""
    tags = Image.Exif()
    tags.load(gps_exif())
    inner = tags.get_ifd(0x8769)
    del inner[0xA405]
    inner[0x920A] = 16.0
    for tag, value in ((0xA405, focal_35), (0xA20E, plane), (0xA404, zoom)):
        if value is not None:
            inner[tag] = value
    packet = b"" if calibrated is None else LENS.format(calibrated).encode()
    photo = read_photo(jpeg(tmp_path / "a.jpg", xmp_packet=packet, exif_bytes=tags.tobytes(), size=(400, 300)))
    return math.degrees(photo.fov_hint_rad), photo.origin["fov_hint"]


@pytest.mark.parametrize(
    ("tags", "degrees"),
    [
        ({"focal_35": 24, "plane": 6492.0}, 71.7),  # an editor made the picture smaller, and left the sensor's pixels
        ({"calibrated": 270.3, "focal_35": 24, "zoom": 2.0}, 40.6),  # the calibration is that without digital zoom
        ({"calibrated": 900.0, "focal_35": 24, "plane": 423.3}, 73.7),  # two against one
        ({"focal_35": 24, "plane": 423.3}, 73.7),
        ({"calibrated": 276.8}, 71.7),
    ],
)
def test_lens_tags_are_weighed_by_whether_they_agree(tmp_path, tags, degrees):
    assert lens(tmp_path, **tags)[0] == pytest.approx(degrees, abs=0.5)


def test_a_panorama_is_no_photo(tmp_path):
    packet = b"<x:xmpmeta><a><GPano:ProjectionType>equirectangular</GPano:ProjectionType></a></x:xmpmeta>"
    with pytest.raises(NotAPicture, match="panorama"):
        read_photo(jpeg(tmp_path / "a.jpg", xmp_packet=packet, exif_bytes=gps_exif()))


SOURCES = {"V": "WideCamera", "Z": "ZoomCamera", "T": "InfraredCamera"}


def presses(folder, letters, *, xmp, together=True):
    """Photos of a camera with several sensors, in DJI's names; `xmp`: whether their tags tell the sensor, too."""
    for k in range(4):
        for letter in letters if together else letters[k % len(letters)]:
            packet = f'<x:xmpmeta><a drone-dji:ImageSource="{SOURCES[letter]}"/></x:xmpmeta>'.encode() if xmp else b""
            found = gps_exif(47.5, 8.25 + 4e-4 * k, local=f"2024:05:06 12:00:{5 * k:02d}", offset="+00:00")
            jpeg(folder / f"DJI_20240506120000_{k:04d}_{letter}.JPG", xmp_packet=packet, exif_bytes=found)


@pytest.mark.parametrize("xmp", [True, False])
@pytest.mark.parametrize(("letters", "camera", "mapped"), [("TV", "", "V"), ("TVZ", "", "V"), ("TV", "thermal", "T")])
def test_of_a_camera_with_several_sensors_one_is_mapped(tmp_path, letters, camera, mapped, xmp):
    presses(tmp_path, letters, xmp=xmp)
    ingest = load([tmp_path], options=LoadOptions(camera=camera))
    assert [frame.image[-5] for frame in ingest.frames] == 4 * [mapped]
    assert len(ingest.rejected) == 4 * (len(letters) - 1)
    assert all("pictures are mapped (--camera)" in r.reason for r in ingest.rejected)
    assert len({frame.camera for frame in ingest.frames}) == 1


def test_a_zoom_beside_a_wide_camera_at_other_moments_is_a_camera_of_its_own(tmp_path):
    presses(tmp_path, "VZ", xmp=True, together=False)
    assert len({frame.camera for frame in load([tmp_path]).frames}) == 2


NOON_S = 1_714_996_800.0  # 2024-05-06 12:00:00 UTC
STAMP = {7: (12.0, 0.0, 1.0), 29: "2024:05:06"}


def taken(folder, local, *, stamp=STAMP, **tags):
    """Seconds after noon UTC of a photo whose clock showed `local`, where that is from, and what is told."""
    source = with_tags(gps_exif(local=f"2024:05:06 {local}", subsec="25"), gps=stamp, **tags)
    jpeg(folder / "a.jpg", exif_bytes=source)
    ingest = load([folder / "a.jpg"])
    (frame,) = ingest.frames
    return frame.time_s - NOON_S, frame.origin["time"], [w for w in ingest.warnings if "time zone that" in w]


def test_the_zone_of_another_date_is_not_that_of_the_exposure(tmp_path):
    edited = {0x132: "2024:12:24 10:00:00"}
    winter = {0x9010: "+01:00", 0x9290: "99"}
    assert taken(tmp_path, "14:00:01", main=edited, inner=winter) == (1.25, "EXIF time, zone from GPS time", [])
    seconds, origin, _ = taken(tmp_path, "14:00:01", main=edited, inner=winter, stamp={})
    assert seconds == 7201.25 and "without zone" in origin
    same = {0x132: "2024:05:06 14:00:01"}
    assert taken(tmp_path, "14:00:01", main=same, inner={0x9010: "+02:00"}, stamp={})[0] == 1.25


@pytest.mark.parametrize("zone", ["+00:00", "+01:00", "-08:00", "+08:15"])
def test_the_gps_time_counts_where_the_stated_zone_contradicts_it(tmp_path, zone):
    seconds, origin, told = taken(tmp_path, "20:00:01", inner={0x9011: zone})
    assert seconds == 1.25 and "which the stated one contradicts" in origin
    assert len(told) == 1 and "the time zone that 1 photo state" in told[0]


@pytest.mark.parametrize(
    "stamp", [STAMP, {}, {**STAMP, 29: "2024:05:05"}, {**STAMP, 7: (11.0, 53.0, 0.0)}, {**STAMP, 29: "1980:01:06"}]
)
def test_a_stated_zone_counts_where_the_gps_time_gives_no_other(tmp_path, stamp):
    """The same, none, of another date, minutes old, or of a receiver without a fix."""
    assert taken(tmp_path, "20:00:01", inner={0x9011: "+08:00"}, stamp=stamp) == (1.25, "EXIF time with zone", [])


STEP_DEG = 2e-4  # 22 m in 5 s


def voided(folder, said, *, step_s=5, models=("A",)):
    """Photos to the north; those that say V tell a place 150 m astray. `said`: GPSStatus of each, "-" for none."""
    for k, status in enumerate(said):
        astray = 1.4e-3 if status == "V" else 0.0
        local = f"2024:05:06 12:00:{step_s * k:02d}"
        source = gps_exif(
            47.5 + STEP_DEG * k + astray + 1e-6 * k * k % 7e-6, local=local, model=models[k % len(models)]
        )
        jpeg(folder / f"{k:02d}.jpg", exif_bytes=with_tags(source, gps={} if status == "-" else {9: status}))
    return load([folder])


@pytest.mark.parametrize("other", ["A", "-"])
def test_positions_that_are_void_lie_between_those_that_are_not(tmp_path, other):
    ingest = voided(tmp_path, [*4 * other, "V", "V", *4 * other])
    places = [frame.fix.lat_deg for frame in ingest.frames]
    assert places == pytest.approx([47.5 + STEP_DEG * k for k in range(10)], abs=1e-5)
    assert [frame.fix.position_sigma_m is not None for frame in ingest.frames] == [k in (4, 5) for k in range(10)]
    (told,) = [w for w in ingest.warnings if "GPSStatus V" in w]
    assert "2 positions of 10 photos (04.jpg first) are void by the receiver's own word" in told


def test_positions_that_are_void_for_long_are_none(tmp_path):
    ingest = voided(tmp_path, [*"AAA", *6 * "V"])
    assert {r.image for r in ingest.rejected} == {f"{k:02d}.jpg" for k in range(3, 9)}
    assert all("had no fix" in r.reason and r.lacks_position for r in ingest.rejected)


@pytest.mark.parametrize(("said", "models"), [("VVVVVV", "A"), ("AVAVAV", "AB")])
def test_a_camera_that_always_says_void_is_believed_and_that_is_said(tmp_path, said, models):
    ingest = voided(tmp_path, said, models=tuple(models))
    assert len(ingest.frames) == 6 and not ingest.rejected
    (told,) = [w for w in ingest.warnings if "GPSStatus V" in w]
    assert f"the positions of {said.count('V')} photos are void" in told


def test_void_positions_do_not_matter_where_a_table_gives_others(tmp_path):
    rows = [f"{k:02d}.jpg 8.25 {47.5 + STEP_DEG * k}" for k in range(6)]
    (tmp_path / "geo.txt").write_text("\n".join(["EPSG:4326", *rows]))
    ingest = voided(tmp_path, "AAVVAA")
    assert [f.fix.lat_deg for f in ingest.frames] == pytest.approx([47.5 + STEP_DEG * k for k in range(6)])
    assert not any("GPSStatus" in w for w in ingest.warnings)


def datum(folder, name, place=(35.7, 139.7)):
    """The place of a photo that names a datum, and what is told of that."""
    jpeg(folder / "a.jpg", exif_bytes=with_tags(gps_exif(*place), gps={} if name is None else {18: name}))
    ingest = load([folder / "a.jpg"])
    return (ingest.frames[0].fix.lat_deg, ingest.frames[0].fix.lon_deg), [
        w for w in ingest.warnings if "GPSMapDatum" in w
    ]


@pytest.mark.parametrize(
    "name", [None, "", " ", "WGS-84", "WGS84", "WGS 84", "wgs-84", "WGS_1984", "World Geodetic System 1984"]
)
def test_wgs_84_in_any_spelling_is_as_it_is(tmp_path, name):
    place, told = datum(tmp_path, name)
    assert place == pytest.approx((35.7, 139.7), abs=1e-9) and not told


@pytest.mark.parametrize("name", ["TOKYO", "Tokyo"])
def test_a_known_datum_is_turned_into_wgs_84_and_that_is_said(tmp_path, name):
    place, (told,) = datum(tmp_path, name)
    assert place == pytest.approx((35.703235, 139.696771), abs=1e-4)  # by Japan's survey, +11.7" and -11.6" there
    assert name in told and "1 photo" in told


@pytest.mark.parametrize(
    "name", ["MY DATUM", "EPSG:32654", "NTF (Paris)", "\x01", "+proj=longlat +ellps=bessel", "x" * 900]
)
def test_a_datum_that_is_not_known_is_named(tmp_path, name):
    place, (told,) = datum(tmp_path, name)
    assert place == pytest.approx((35.7, 139.7), abs=1e-9)
    assert repr(name[:60]) in told and "WGS 84 is assumed" in told


def raised(folder, by_table, own, count=3):
    """What is told of photos at altitudes of their own and by a geo.txt."""
    rows = []
    for k in range(count):
        source = gps_exif(47.5 + STEP_DEG * k, local=f"2024:05:06 12:00:{5 * k:02d}")
        jpeg(folder / f"{k}.jpg", exif_bytes=with_tags(source, gps={} if own is None else {6: own + k}))
        rows.append(f"{k}.jpg 8.25 {47.5 + STEP_DEG * k} {by_table(own or 0.0)}")
    (folder / "geo.txt").write_text("\n".join(["EPSG:4326", *rows]))
    return [w for w in load([folder]).warnings if "other altitudes" in w]


@pytest.mark.parametrize(
    ("by_table", "own", "feet"),
    [
        (lambda m: m / 0.3048, 601.0, True),
        (lambda m: (m + 10.0) / 0.3048, 601.0, True),
        (lambda m: m + 900.0, 601.0, False),
    ],
)
def test_a_table_whose_altitudes_contradict_the_tags_is_told(tmp_path, by_table, own, feet):
    (told,) = raised(tmp_path, by_table, own)
    assert "3 pictures" in told and ("look like feet" in told) == feet
    assert f"{by_table(own):.0f} m instead of 602 m" in told


@pytest.mark.parametrize(("by_table", "own"), [(lambda m: m + 50.0, 601.0), (lambda m: 700.0, None)])
def test_a_table_in_another_height_system_contradicts_nothing(tmp_path, by_table, own):
    assert not raised(tmp_path, by_table, own)
