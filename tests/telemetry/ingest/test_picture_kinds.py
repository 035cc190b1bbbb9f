"""Of cameras with several sensors one kind of picture is mapped, whatever files and folders are called."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from telemetry import LoadOptions, load
from tests.telemetry.ingest.test_photos import gps_exif, jpeg


def press(k, *names, make="DJI", model="M3T", sizes=((400, 300), (320, 256)), late_s=0):
    """The k-th exposure: a picture a name, of these sizes in turn; the second was taken so much later."""
    for n, name in enumerate(names):
        now = datetime(2024, 5, 6, 12, tzinfo=UTC) + timedelta(seconds=4 * k + n * late_s)
        local = f"{now:%Y:%m:%d %H:%M:%S}"
        exif = gps_exif(47.5 + 3e-4 * k + 1e-5 * n, 8.25, local=local, offset="+00:00", make=make, model=model)
        Path(name).parent.mkdir(exist_ok=True)
        jpeg(Path(name), exif_bytes=exif, size=sizes[n % len(sizes)])


DJI = "DJI_20240506120000_{0:04d}"
NAMES = {
    "Mavic 2 Enterprise": ("DJI", "DJI_{0:04d}_W.JPG", "DJI_{0:04d}_T.JPG"),
    "a waypoint's name": ("DJI", f"{DJI}_V_Point{{0}}.JPG", f"{DJI}_T_Point{{0}}.JPG"),
    "words": ("DJI", "site_{0}_visible.JPG", "site_{0}_thermal.JPG"),
    "Autel": ("Autel Robotics", "MAX_{0:04d}.JPG", "IRX_{0:04d}.JPG"),
    "a second camera": ("FLIR", "DJI_{0:04d}.JPG", "20240506_{0:04d}.jpg"),
    "folders": ("DJI", "a/DJI_{0:04d}_W.JPG", "b/DJI_{0:04d}_T.JPG"),
}


@pytest.mark.parametrize("late_s", [0, 1])
@pytest.mark.parametrize("name", NAMES)
def test_thermal_pictures_beside_colour_are_left_out(tmp_path, name, late_s):
    make, colour, thermal = NAMES[name]
    for k in range(8):
        press(k, tmp_path / colour.format(k), tmp_path / thermal.format(k), make=make, late_s=late_s)
    found = load([tmp_path])
    assert [frame.image for frame in found.frames] == [colour.format(k) for k in range(8)]
    assert len(found.rejected) == 8 and all("camera" in entry.reason for entry in found.rejected)


def test_two_cameras_that_flew_one_after_the_other_are_both_mapped(tmp_path):
    for k in range(6):
        press(k, tmp_path / f"A{k}.JPG", model="one")
        press(k + 40, tmp_path / f"B{k}.JPG", model="two", sizes=((320, 256),))
    assert len(load([tmp_path]).frames) == 12


BANDS = {
    "MicaSense": ("IMG_{0:04d}_1.jpg", "IMG_{0:04d}_2.jpg", "IMG_{0:04d}_4.jpg"),
    "Parrot": ("IMG_240506_{0:04d}_RED.JPG", "IMG_240506_{0:04d}_GRE.JPG", "IMG_240506_{0:04d}_NIR.JPG"),
    "DJI": (f"{DJI}_MS_R.JPG", f"{DJI}_MS_G.JPG", f"{DJI}_MS_NIR.JPG"),
}


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize(("band", "index"), [("", 1), ("nir", 2)])
@pytest.mark.parametrize("make", BANDS)
def test_the_band_that_is_asked_for_is_mapped(tmp_path, make, band, index, apart):
    names = [f"{n}/{name}" if apart else name for n, name in enumerate(BANDS[make])]
    for k in range(4):
        press(k, *(tmp_path / name.format(k) for name in names), make=make, sizes=((400, 300),))
    found = load([tmp_path], options=LoadOptions(band=band))
    assert [frame.image for frame in found.frames] == [names[index].format(k) for k in range(4)]
    assert {frame.camera.rpartition(" ")[2] for frame in found.frames} == {band or "green"}
    assert len(found.rejected) == 8 and all("spectral band" in entry.reason for entry in found.rejected)


def test_colour_is_mapped_before_any_band(tmp_path):
    for k in range(4):
        names = (tmp_path / f"{DJI.format(k)}_{tail}.JPG" for tail in ("D", "MS_G", "MS_RE"))
        press(k, *names, sizes=((400, 300),))
    assert [frame.image for frame in load([tmp_path]).frames] == [f"{DJI.format(k)}_D.JPG" for k in range(4)]
