"""Bytes between a JPEG's scan and its end: what holds no pixel is passed over, what is damaged is refused."""

import io

import numpy as np
import pytest
from PIL import Image

from orthoswarm.raster.picture_file import PictureError, read_gray, read_rgb, read_rgba

END = b"\xff\xd9"


@pytest.fixture(scope="module")
def jpeg():
    rng = np.random.default_rng(3)
    ground = rng.integers(0, 256, (30, 40, 3), np.uint8)
    picture = Image.fromarray(ground).resize((320, 240), Image.Resampling.BICUBIC)
    buffer = io.BytesIO()
    thumbnail = io.BytesIO()
    picture.resize((32, 24)).save(thumbnail, "JPEG")
    picture.save(buffer, "JPEG", quality=90, comment=thumbnail.getvalue())
    return buffer.getvalue()


def before_end(data, extra):
    at = data.rindex(END)
    return data[:at] + extra + data[at:]


def read(folder, data, reader=read_rgb):
    path = folder / "a.jpg"
    path.write_bytes(data)
    return reader(path)


@pytest.mark.parametrize("reader", [read_gray, read_rgb, read_rgba])
@pytest.mark.parametrize(
    "extra",
    [b"\0", b"\0\0\0", bytes(16), bytes(5000), b"\x7f", b"\xff" * 4, b"\0\1", b"\xff\0\x12\x34\x55", b"abcdefghijklm"],
)
def test_bytes_between_scan_and_end_change_no_pixel(tmp_path, jpeg, reader, extra):
    assert np.array_equal(read(tmp_path, before_end(jpeg, extra), reader), read(tmp_path, jpeg, reader))


def test_a_preview_behind_the_picture_has_an_end_of_its_own(tmp_path, jpeg):
    assert np.array_equal(read(tmp_path, before_end(jpeg, bytes(40)) + jpeg + b"maker's notes"), read(tmp_path, jpeg))


def scan(data, share):
    """The place of so large a share of the scan."""
    start = data.rindex(b"\xff\xda") + 14
    return start + int(share * (len(data) - start))


DAMAGES = {
    "zeros in the middle": lambda d, at: d[:at] + bytes(1500) + d[at + 1500 :],
    "zeros put in": lambda d, at: d[:at] + bytes(100) + d[at:],
    "zeros over the end": lambda d, _: d[:-202] + bytes(200) + d[-2:],
    "lost bytes": lambda d, at: d[:at] + d[at + 300 :],
    "cut off": lambda d, at: d[:at] + END,
    "without its end": lambda d, at: d[:at],
}


@pytest.mark.parametrize("filler", [b"", bytes(16), bytes(3000)])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_scan_is_refused_whatever_follows_it(tmp_path, jpeg, damage, share, filler):
    damaged = DAMAGES[damage](jpeg, scan(jpeg, share))
    with pytest.raises(PictureError, match="damaged JPEG"):
        read(tmp_path, before_end(damaged, filler) if damaged.endswith(END) else damaged + filler)


def test_bytes_before_a_restart_marker_are_refused(tmp_path):
    buffer = io.BytesIO()
    noise = np.random.default_rng(4).integers(0, 256, (64, 64), np.uint8)
    Image.fromarray(noise).save(buffer, "JPEG", restart_marker_rows=1)
    data = buffer.getvalue()
    assert read(tmp_path, data, read_gray).shape == (64, 64)
    with pytest.raises(PictureError, match="damaged JPEG"):
        read(tmp_path, data.replace(b"\xff\xd2", bytes(16) + b"\xff\xd2"), read_gray)
