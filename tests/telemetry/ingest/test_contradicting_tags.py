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
