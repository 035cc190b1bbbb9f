"""Pictures of every kind that cameras and programs write look as in a viewer, or are refused in one sentence."""

import io

import numpy as np
import pytest
from PIL import Image

from orthoswarm.raster.picture_file import PictureError, read_gray, read_rgb, read_rgba
from telemetry.ingest.ingest import load
from tests.telemetry.ingest.test_photos import gps_exif

Y, X = np.mgrid[:48, :64]
COLOURS = np.stack([X * 4, Y * 5, np.full_like(X, 60)], axis=-1).astype(np.uint8)
PICTURE = Image.fromarray(COLOURS)
SECOND = PICTURE.resize((32, 24))
KINDS = {
    "cmyk.jpg": (PICTURE.convert("CMYK"), "JPEG", {}),
    "grey.jpg": (PICTURE.convert("L"), "JPEG", {}),
    "progressive.jpg": (PICTURE, "JPEG", {"progressive": True}),
    "two.jpg": (PICTURE, "MPO", {"save_all": True, "append_images": [SECOND]}),
    "palette.png": (PICTURE.convert("P"), "PNG", {}),
    "alpha.png": (PICTURE.convert("RGBA"), "PNG", {}),
    "grey_alpha.png": (PICTURE.convert("LA"), "PNG", {}),
    "bits.png": (PICTURE.convert("1"), "PNG", {}),
    "palette.tif": (PICTURE.convert("P"), "TIFF", {}),
    "cmyk.tif": (PICTURE.convert("CMYK"), "TIFF", {}),
    "lzw.tif": (PICTURE, "TIFF", {"compression": "tiff_lzw"}),
    "jpeg.tif": (PICTURE, "TIFF", {"compression": "jpeg"}),
    "fax.tif": (PICTURE.convert("1"), "TIFF", {"compression": "group4"}),
    "colours.webp": (PICTURE, "WEBP", {}),
}


@pytest.mark.parametrize("name", KINDS)
def test_a_picture_looks_as_in_a_viewer(tmp_path, name):
    picture, kind, options = KINDS[name]
    picture.save(tmp_path / name, kind, **options)
    with Image.open(tmp_path / name) as viewed:
        shown = np.asarray(viewed.convert("RGB")).astype(float)
    for read in (read_rgb(tmp_path / name), read_rgba(tmp_path / name)[..., :3]):
        assert np.abs(read - shown).mean() < 4.0
    luma = shown @ [0.299, 0.587, 0.114]
    assert np.abs(read_gray(tmp_path / name) - luma).mean() < 4.0


@pytest.mark.parametrize("orientation", [2, 3, 6, 8])
def test_pixels_and_sizes_are_those_of_the_file_whatever_its_orientation_tag_says(tmp_path, orientation):
    """Cameras that look straight down write any orientation: recorded angles are of the pixels as stored."""
    tags = Image.Exif()
    tags.load(gps_exif())
    tags[0x112] = orientation
    PICTURE.save(tmp_path / "a.jpg", exif=tags.tobytes(), quality=95)
    (frame,) = load([tmp_path]).frames
    assert (frame.width, frame.height) == (64, 48)
    assert np.abs(read_rgb(frame.path).astype(float) - COLOURS).mean() < 4.0


def test_numbers_of_32_bits_are_stretched_and_whole_ones_are_no_colours(tmp_path):
    degrees = 10.0 + X.astype(np.float32) / 4.0
    degrees[5, 5] = np.nan
    Image.fromarray(degrees).save(tmp_path / "thermal.tif")
    gray = read_gray(tmp_path / "thermal.tif")
    assert gray.shape == degrees.shape and np.ptp(gray) > 250
    assert np.corrcoef(gray[10:].ravel(), degrees[10:].ravel())[0, 1] > 0.99
    assert (read_rgb(tmp_path / "thermal.tif") == gray[..., None]).all()
    Image.fromarray(X.astype(np.int32)).save(tmp_path / "counts.tif")
    with pytest.raises(PictureError, match="8 or 16 bits"):
        read_gray(tmp_path / "counts.tif")


def test_files_with_odd_names_and_the_first_of_two_pictures_are_mapped_beside_files_that_cannot_be(tmp_path):
    names = [
        "a b#c%20.jpg",
        "ü日本.jpg",
        "q'\"<&>.jpg",
        "new\nline.jpg",
        "x;y,z.jpg",
        "-dash.jpg",
        "$(x).jpg",
        "trail .JPG",
    ]
    for i, name in enumerate([*names, "two.jpg"]):
        tags = gps_exif(47.5 + 1e-4 * i, local=f"2024:05:06 12:00:{i:02d}")
        more = {"save_all": True, "append_images": [SECOND]} if name == "two.jpg" else {}
        PICTURE.save(tmp_path / name, "MPO" if more else "JPEG", exif=tags, **more)
    whole = io.BytesIO()
    PICTURE.save(whole, "JPEG")
    bad = {"cut.jpg": whole.getvalue()[:500], "empty.jpg": b"", "a.heic": b"\0\0\0\x18ftypheic" + bytes(40)}
    for name, content in bad.items():
        (tmp_path / name).write_bytes(content)
    found = load([tmp_path])
    assert {frame.image for frame in found.frames} == {*names, "two.jpg"}
    assert {rejection.image for rejection in found.rejected} == bad.keys()
    assert all("; co" in rejection.reason for rejection in found.rejected)  # "; copy it again", "; convert them"
    assert {(frame.width, frame.height) for frame in found.frames} == {(64, 48)}
