"""Pictures in a folder that are not of its flight are left out with the reason, and copies count once."""

import shutil

import pytest
from PIL import Image

from telemetry import load
from tests.telemetry.ingest.test_photos import gps_exif, jpeg

HEIGHT = b'<x:xmpmeta><a drone-dji:RelativeAltitude="+80.0" drone-dji:GimbalPitchDegree="-90.0"/></x:xmpmeta>'


def local(k, day):
    return f"2024:05:{day:02d} 12:{k // 12:02d}:{5 * k % 60:02d}"


def flight(folder, count=24, *, day=6, size=(64, 48), **more):
    """Photos 30 m apart to the east."""
    folder.mkdir(exist_ok=True)
    return [
        jpeg(
            folder / f"DJI_{k:04d}.JPG",
            size=size,
            xmp_packet=HEIGHT + b"%04d" % k,
            exif_bytes=gps_exif(
                47.5,
                8.25 + 4e-4 * k,
                local=f"2024:05:{day:02d} 12:{k // 12:02d}:{5 * k % 60:02d}",
                offset="+00:00",
                **more,
            ),
        )
        for k in range(count)
    ]


def left_out(folder):
    found = load([folder])
    return {r.image: r.text for r in found.rejected}, found


@pytest.mark.parametrize("name", ["{} (1)", "{}(2)", "{} - Copy", "{}_copy", "Kopie von {}", "north of {}"])
def test_copies_within_a_folder_count_once(tmp_path, name):
    photos = flight(tmp_path / "card")
    for photo in photos[3:5]:
        shutil.copy(photo, photo.with_name(f"{name.format(photo.stem)}.JPG"))
    reasons, found = left_out(tmp_path / "card")
    assert {f.image for f in found.frames} == {photo.name for photo in photos}
    assert set(reasons.values()) == {f"a copy of another photo in its folder (DJI_000{k}.JPG)" for k in (3, 4)}


def test_an_equal_file_under_an_unrelated_name_counts_once(tmp_path):
    photos = flight(tmp_path / "card")
    shutil.copy(photos[3], tmp_path / "card" / "best.JPG")
    reasons, found = left_out(tmp_path / "card")
    assert reasons == {"best.JPG": "a copy of another photo in its folder (DJI_0003.JPG)"} and len(found.frames) == 24


@pytest.mark.parametrize("name", ["{}_edited.JPG", "{}.tif", "{}.JPEG"])
@pytest.mark.parametrize("tagged", [True, False])
def test_other_files_of_an_exposure_are_left_out(tmp_path, name, tagged):
    photos = flight(tmp_path / "card")
    for photo in photos[3:5]:
        with Image.open(photo) as picture:
            exif = {"exif": picture.getexif()} if tagged else {}
            picture.convert("RGB").save(photo.with_name(name.format(photo.stem)), **exif)
    reasons, found = left_out(tmp_path / "card")
    assert {f.image for f in found.frames} == {photo.name for photo in photos}
    assert len(reasons) == 2 and not found.unpositioned


def test_thumbnails_in_folders_of_their_own_are_left_out(tmp_path):
    flight(tmp_path / "card")
    flight(tmp_path / "card" / "thumbnails", size=(32, 24))
    flight(tmp_path / "card" / "@eaDir")
    reasons, found = left_out(tmp_path / "card")
    assert {f.image for f in found.frames} == {f"DJI_{k:04d}.JPG" for k in range(24)}
    assert reasons["thumbnails/DJI_0003.JPG"].startswith("a smaller picture of the same exposure as one in another")


def test_copies_without_tags_are_told_by_their_names_and_equal_pictures_are_none(tmp_path):
    for name in ("a.jpg", "a (1).jpg", "b.jpg"):
        jpeg(tmp_path / name)
    (tmp_path / "geo.txt").write_text("EPSG:4326\n" + "".join(f"{n} 8.25 47.5 90\n" for n in ("a.jpg", "b.jpg")))
    reasons, found = left_out(tmp_path)
    assert set(reasons) == {"a (1).jpg"} and len(found.frames) == 2


def test_a_screenshot_is_no_photo_of_the_flight(tmp_path):
    flight(tmp_path / "card")
    jpeg(tmp_path / "card" / "Screenshot_20240506.jpg", size=(120, 60))
    reasons, found = left_out(tmp_path / "card")
    assert "no camera's tags" in reasons["Screenshot_20240506.jpg"] and not found.unpositioned
    assert len(found.frames) == 24


def test_smaller_pictures_of_the_same_exposures_are_left_out(tmp_path):
    flight(tmp_path / "card")
    small = flight(tmp_path / "small", size=(32, 24))
    for photo in small:
        shutil.move(photo, tmp_path / "card" / f"{photo.stem}_thumb.JPG")
    reasons, found = left_out(tmp_path / "card")
    assert {f.width for f in found.frames} == {64} and len(reasons) == 24
    assert reasons["DJI_0003_thumb.JPG"] == "a smaller picture of the same exposure as another one here (DJI_0003.JPG)"


@pytest.mark.parametrize("count,left", [(1, True), (2, True), (3, False)])
def test_the_odd_photo_of_a_phone_is_left_out(tmp_path, count, left):
    flight(tmp_path / "card", 40)
    for k in range(count):
        exif = gps_exif(47.5001, 8.255 + 1e-5 * k, local=f"2024:05:06 12:01:{3 + k:02d}", offset="+00:00", make="Apple")
        jpeg(tmp_path / "card" / f"IMG_{k}.JPG", exif_bytes=exif)
    reasons, found = left_out(tmp_path / "card")
    assert len(found.frames) == 40 + count * (not left)
    assert [("another camera" in r and "Apple FC1" in r) for r in reasons.values()] == [True] * count * left


def test_a_second_camera_that_knows_where_it_looks_stays(tmp_path):
    flight(tmp_path / "card", 40)
    exif = gps_exif(47.5001, 8.251, local="2024:05:06 12:01:03", offset="+00:00", make="Sony")
    jpeg(tmp_path / "card" / "S.JPG", exif_bytes=exif, xmp_packet=HEIGHT)
    assert len(load([tmp_path / "card"]).frames) == 41


def test_few_photos_of_another_day_elsewhere_are_left_out_and_a_flight_of_another_day_is_told(tmp_path):
    flight(tmp_path / "card", 40)
    for k in range(2):
        exif = gps_exif(47.52, 8.25 + 4e-4 * k, local=f"2024:03:02 12:00:{k:02d}", offset="+00:00")
        jpeg(tmp_path / "card" / f"OLD_{k}.JPG", exif_bytes=exif, xmp_packet=HEIGHT)
    reasons, found = left_out(tmp_path / "card")
    assert set(reasons.values()) == {"taken on another day and elsewhere than the others here (2024-03-02)"}
    assert len(found.frames) == 40
    for k, photo in enumerate(flight(tmp_path / "more", 12, day=9)):
        shutil.move(photo, tmp_path / "card" / f"DJI_1{k:03d}.JPG")
    _, found = left_out(tmp_path / "card")
    assert len(found.frames) == 52
    (said,) = [w for w in found.warnings if "map each day by itself" in w]
    assert "40 of 2024-05-06, 12 of 2024-05-09" in said
