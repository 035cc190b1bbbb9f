"""Pictures that are reduced while they are decoded show the same, at the same place."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from orthoswarm.raster.picture_file import read_gray, reduction


def ground(rows: int, cols: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    return cv2.GaussianBlur(rng.integers(0, 255, (rows, cols)).astype(np.float32), (0, 0), 6.0)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("factor", [1, 2, 4, 8])
def test_a_reduced_picture_lies_where_the_full_one_does(tmp_path: Path, suffix: str, factor: int) -> None:
    full = ground(480, 640)
    full = np.clip((full - full.mean()) * 8 + 127, 0, 255).astype(np.uint8)
    path = tmp_path / f"one{suffix}"
    assert cv2.imwrite(str(path), full)
    reduced = read_gray(path, factor)
    expected = cv2.resize(full, (640 // factor, 480 // factor), interpolation=cv2.INTER_AREA)
    assert reduced.shape == expected.shape and reduced.dtype == np.uint8
    shift, _ = cv2.phaseCorrelate(reduced.astype(np.float32), expected.astype(np.float32))
    assert np.hypot(*shift) < 0.02
    assert np.abs(reduced.astype(float) - expected).mean() < 2.5


@pytest.mark.parametrize(
    ("size", "longest", "factor"),
    [
        ((640, 480), 960, 1),
        ((1920, 1080), 960, 2),
        ((4000, 3000), 960, 4),
        ((5280, 3956), 960, 4),  # 3956 is not a multiple of 8
        ((8064, 6048), 960, 8),
        ((5471, 3647), 960, 1),  # odd sides: a reduced picture would not end where the full one does
    ],
)
def test_a_picture_is_reduced_as_far_as_the_work_allows(size: tuple[int, int], longest: int, factor: int) -> None:
    assert reduction(*size, longest) == factor
