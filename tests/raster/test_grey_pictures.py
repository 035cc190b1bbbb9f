"""Decoded grey pictures on disk: each file is decoded once, whoever reads it."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from orthoswarm.model.frame import Fix, Frame
from orthoswarm.raster.grey_pictures import GreyPictures
from orthoswarm.raster.picture_file import PictureError, read_gray, read_rgb


@pytest.fixture
def photo(tmp_path: Path) -> Frame:
    return _photo(tmp_path, 320, 240)


def _photo(folder: Path, width: int, height: int) -> Frame:
    noise = np.random.default_rng(1).integers(96, 160, (height // 8, width // 8, 3), dtype=np.uint8)
    path = folder / "a.jpg"
    Image.fromarray(noise).resize((width, height), Image.Resampling.BICUBIC).save(path, quality=95)
    return Frame(image="a.jpg", path=path, vehicle="a", width=width, height=height, fix=Fix(51.0, 0.0), time_s=None)


def _store(tmp_path: Path, *photos: Frame) -> GreyPictures:
    store = GreyPictures.create(tmp_path / "pictures", photos, 100.0)
    assert store is not None
    return store


def test_a_picture_that_was_drawn_is_not_decoded_again(tmp_path: Path, photo: Frame) -> None:
    store = _store(tmp_path, photo)
    colors = store.rgb(photo.path, 320)
    np.testing.assert_array_equal(colors, read_rgb(photo.path))
    first = read_gray(photo.path)
    photo.path.unlink()
    gray = store.gray(photo)
    assert gray.shape == (240, 320)
    assert np.abs(gray.astype(int) - first).max() <= 2


def test_grey_values_do_not_depend_on_who_read_first(tmp_path: Path, photo: Frame) -> None:
    drawn, refined = _store(tmp_path, photo), GreyPictures(tmp_path / "other")
    refined.folder.mkdir()
    drawn.rgb(photo.path, 320)
    np.testing.assert_array_equal(drawn.gray(photo), refined.gray(photo))
    np.testing.assert_array_equal(refined.gray(photo), refined.gray(photo))


def test_large_pictures_are_stored_reduced(tmp_path: Path) -> None:
    photo = _photo(tmp_path, 4096, 3072)
    store = _store(tmp_path, photo)
    assert store.rgb(photo.path, 4096).shape == (3072, 4096, 3)
    small = store.rgb(photo.path, 1024)
    assert small.shape == (768, 1024, 3)
    decoded = read_gray(photo.path, 4)
    photo.path.unlink()
    assert np.abs(store.gray(photo).astype(int) - decoded).max() <= 2


def test_without_a_place_to_write_pictures_are_decoded(tmp_path: Path, photo: Frame) -> None:
    store = GreyPictures(tmp_path / "missing")
    np.testing.assert_array_equal(store.gray(photo), store.gray(photo))
    assert not store.folder.exists()


def test_a_torn_file_is_made_again(tmp_path: Path, photo: Frame) -> None:
    store = _store(tmp_path, photo)
    gray = store.gray(photo)
    for file in store.folder.iterdir():
        file.write_bytes(file.read_bytes()[:1000])
    np.testing.assert_array_equal(store.gray(photo), gray)


def test_a_damaged_picture_is_refused_as_without_a_store(tmp_path: Path, photo: Frame) -> None:
    photo.path.write_bytes(b"\xff\xd8 no picture")
    with pytest.raises(PictureError, match="damaged"):
        _store(tmp_path, photo).gray(photo)


def test_more_pictures_than_the_disk_is_meant_for_are_not_stored(tmp_path: Path, photo: Frame) -> None:
    assert GreyPictures.create(tmp_path / "pictures", [photo] * 2, 0.1) is None
    assert GreyPictures.create(tmp_path / "pictures", [photo], 0.1) is not None
