"""Parts of pictures on disk: what comes back, and what does not."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from orthoswarm.raster.picture_parts import Box, PictureParts

PICTURE = np.random.default_rng(1).integers(0, 256, (60, 80, 3)).astype(np.uint8)
DRAWN = Box(left=20, right=39, top=10, bottom=29)
PATH = Path("photos/a.jpg")


def test_a_part_comes_back_with_a_border_and_nothing_beyond_it(tmp_path):
    parts = PictureParts.create(tmp_path / "parts", 1, 2000.0)
    parts.keep(PATH, PICTURE, DRAWN)
    part = parts.get(PATH, replace(DRAWN, left=14))
    assert part.corner == (12, 2)  # a tenth of 80 pixels around it
    assert np.array_equal(part.cut(DRAWN), PICTURE[10:30, 20:40])
    assert np.array_equal(part.pixels, PICTURE[2:38, 12:48])
    for beyond in ({"left": 11}, {"right": 48}, {"top": 1}, {"bottom": 38}):
        assert parts.get(PATH, replace(DRAWN, **beyond)) is None


def test_what_is_too_large_unfinished_or_of_another_file_is_not_there(tmp_path):
    parts = PictureParts.create(tmp_path / "parts", 1, 2000.0)
    assert parts.get(PATH, DRAWN) is None
    replace(parts, most_bytes=1000).keep(PATH, PICTURE, DRAWN)
    assert not any(parts.folder.iterdir())
    parts.keep(PATH, PICTURE, DRAWN)
    (file,) = parts.folder.iterdir()
    file.write_bytes(file.read_bytes()[:-1])  # as a killed process leaves it
    assert parts.get(PATH, DRAWN) is None
    assert parts.get(Path("photos/b.jpg"), DRAWN) is None


def test_more_pictures_have_smaller_parts(tmp_path):
    few, many = (PictureParts.create(tmp_path / str(n), n, 2000.0) for n in (1_000, 30_000))
    assert few.most_bytes // many.most_bytes == 30
