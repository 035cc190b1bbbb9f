"""Correlations and corners in compiled code are those of OpenCV."""

import cv2
import numpy as np
import pytest

from orthoswarm.raster.subpixel_peak import vertex
from orthoswarm.refine.features.patch_matching import (
    gradients,
    locate,
    locate_wanted,
    promising_blocks,
    template_of,
    window_of,
)
from orthoswarm.refine.features.shift_products import ROWS
from orthoswarm.refine.features.tracks import strongest


@pytest.mark.parametrize(("half", "reach"), [(15, 6), (20, 10), (18, 11), (8, 4), (20, 28)])
def test_a_patch_is_found_where_opencv_finds_it(half, reach):
    rng = np.random.default_rng(half + reach)
    n, size = 2 * half + 1, 2 * (half + reach) + 1
    fields = rng.normal(0.0, 1.0, (size, size, 2)).astype(np.float32)
    patch = fields[reach + 2 : reach + 2 + n, reach - 3 : reach - 3 + n] + rng.normal(0, 0.5, (n, n, 2))
    template, window = template_of(half), window_of(half, reach)
    template[:, ROWS - 1 : ROWS - 1 + n] = patch.transpose(2, 0, 1)
    window[:, :size, :size] = fields.transpose(2, 0, 1)
    score = cv2.matchTemplate(fields, patch.astype(np.float32), cv2.TM_CCORR_NORMED)
    row, column = np.unravel_index(score.argmax(), score.shape)
    sub = [
        vertex(*score[row, column - 1 : column + 2].astype(float)),
        vertex(*score[row - 1 : row + 2, column].astype(float)),
    ]
    rest = score.copy()
    rest[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4] = -1.0
    expected = column - reach + sub[0], row - reach + sub[1], score.max(), rest.max()
    np.testing.assert_allclose(locate(template, window, reach, 3), expected, atol=1e-4)


@pytest.mark.parametrize("seed", range(8))
def test_a_search_at_half_size_first_finds_the_same_peaks(seed):
    rng = np.random.default_rng(seed)
    half, reach, floor = 20, 28 - seed % 2, np.float32(1.0)
    size = 2 * (half + reach + 1) + 1
    seen = cv2.GaussianBlur(rng.normal(0.0, 300.0, (size, size)), (0, 0), 1.5).astype(np.float32) + 120
    row, column = rng.integers(3, 2 * reach - 3, 2)
    patch = seen[row : row + 2 * half + 3, column : column + 2 * half + 3].copy()
    patch += cv2.GaussianBlur(rng.normal(0.0, 150.0, patch.shape), (0, 0), 1.0).astype(np.float32)
    template, window = template_of(half), window_of(half, reach)
    gradients(patch, True, floor, template, ROWS - 1)
    gradients(seen, True, floor, window, 0)
    wanted = promising_blocks(patch, seen, reach, True, floor, 0.6)
    whole = locate(template, window, reach, 4)
    found = locate_wanted(template, window, reach, 4, wanted)
    assert wanted.mean() < 0.5
    np.testing.assert_allclose(whole[:2], (column - reach, row - reach), atol=0.3)
    np.testing.assert_allclose(found[:3], whole[:3], atol=1e-5)
    assert found[3] <= whole[3] + 1e-6


def test_the_strongest_corner_of_each_empty_cell_is_opencvs():
    rng = np.random.default_rng(5)
    gray = cv2.GaussianBlur(rng.integers(0, 255, (200, 333)).astype(np.uint8), (0, 0), 2.0)
    empty = rng.random((5, 8)) < 0.6
    uv = np.empty((40, 2), np.float32)
    count = strongest(gray, empty, 40, 0, 6, uv)
    score = cv2.cornerMinEigenVal(gray, 5, ksize=3)
    inner = np.zeros_like(score)
    inner[9:-9, 9:-9] = score[9:-9, 9:-9]
    expected = []
    for row, column in np.argwhere(empty):
        cell = inner[40 * row : 40 * row + 40, 6 + 40 * column : 46 + 40 * column]
        r, c = np.unravel_index(cell.argmax(), cell.shape)
        expected.append((6 + 40 * column + c, 40 * row + r))
    np.testing.assert_array_equal(uv[:count], expected)
