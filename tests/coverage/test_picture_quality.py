"""Blur and damage, measured on real pictures and judged against their neighbours."""

import cv2
import numpy as np
import pytest

from orthoswarm.coverage.view import Flaw, picture_flaws
from orthoswarm.raster.picture_file import read_gray
from orthoswarm.raster.picture_quality import picture_quality


@pytest.fixture(scope="module")
def pictures(real_data) -> list[np.ndarray]:
    return [read_gray(p) for p in sorted(real_data("brighton_beach_1600").glob("*.JPG"))]


def test_nothing_is_wrong_with_a_good_flight(pictures: list[np.ndarray]) -> None:
    assert picture_flaws([picture_quality(p) for p in pictures]) == [Flaw(0)] * len(pictures)


def test_blurred_damaged_and_hazy_pictures_are_found(pictures: list[np.ndarray]) -> None:
    changed = list(pictures)
    changed[3] = cv2.GaussianBlur(pictures[3], (0, 0), 2.0)
    changed[7] = pictures[7].copy()
    changed[7][800:] = 128  # a JPEG that ends too early
    changed[11] = (0.1 * pictures[11] + 180).astype(np.uint8)
    flaws = picture_flaws([picture_quality(p) for p in changed])
    assert [i for i, f in enumerate(flaws) if f] == [3, 7, 11]
    assert Flaw.BLURRED in flaws[3] and Flaw.DAMAGED in flaws[7] and Flaw.HAZE in flaws[11]


def test_an_unmeasured_picture_has_no_flaw(pictures: list[np.ndarray]) -> None:
    assert picture_flaws([None, picture_quality(pictures[0]), None]) == [Flaw(0)] * 3


def test_colour_and_grey_measure_alike(pictures: list[np.ndarray]) -> None:
    colour = np.repeat(pictures[0][..., None], 3, axis=2)
    assert picture_quality(colour) == picture_quality(pictures[0])
