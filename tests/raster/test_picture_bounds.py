"""Pictures that would take gigabytes are refused by their header, whoever reads them."""

import io
import resource
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from PIL import Image

from orthoswarm.raster import picture_file
from orthoswarm.raster.picture_file import PictureError, picture_size, read_gray, read_rgb, read_rgba

SIDE = 19_000


def png_bomb(path):
    """A PNG of 19,000 x 19,000 pixels in some hundred kilobytes."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    row = bytes(1 + 3 * SIDE)
    body = b"".join(packer.compress(row) for _ in range(SIDE)) + packer.flush()
    head = struct.pack(">IIBBBBB", SIDE, SIDE, 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b""))
    return path


def jpeg_that_says(path, width, height):
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(buffer, "JPEG")
    data = bytearray(buffer.getvalue())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    path.write_bytes(bytes(data))
    return path


@pytest.mark.parametrize("read", [read_gray, read_rgb, read_rgba])
def test_a_small_file_with_a_huge_picture_is_refused(tmp_path, read):
    bomb = png_bomb(tmp_path / "bomb.png")
    assert bomb.stat().st_size < 2_000_000
    with pytest.raises(PictureError, match=r"bomb\.png has (19000 x 19000|more) pixels"):
        read(bomb)
    with pytest.raises(PictureError, match=r"big\.jpg has 40000 x 30000 pixels"):
        read(jpeg_that_says(tmp_path / "big.jpg", 40_000, 30_000))


@pytest.mark.slow
def test_refusing_takes_no_memory(tmp_path):
    png_bomb(tmp_path / "bomb.png")
    code = (
        "import resource, sys; from pathlib import Path; from orthoswarm.raster.picture_file import *\n"
        "import cv2, PIL.Image\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try: read_rgb(Path(sys.argv[1]))\n"
        "except PictureError: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    said = subprocess.run([sys.executable, "-c", code, str(tmp_path / "bomb.png")], capture_output=True, text=True)
    kilobytes = int(said.stdout)
    assert resource.getpagesize() and kilobytes < 50_000


def test_the_size_is_known_without_decoding():
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((6, 9), np.uint8)).save(buffer, "PNG")
    assert picture_size(buffer.getvalue()) == (9, 6, "PNG")
    with pytest.raises(PictureError, match="not a readable picture"):
        picture_size(b"P7 nothing")
    assert picture_file.MOST_PIXELS >= 151_000_000  # the largest drone cameras
