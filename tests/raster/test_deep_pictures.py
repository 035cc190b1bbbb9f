"""16-bit pictures of cameras with fewer bits are seen, and alike from picture to picture."""

import cv2
import numpy as np
import pytest

from orthoswarm.raster.kept_ranges import grown
from orthoswarm.raster.picture_file import read_gray, read_rgb, read_rgba


def ramp(low: float, high: float) -> np.ndarray:
    return np.linspace(low, high, 64 * 48).reshape(48, 64).astype(np.uint16)


@pytest.mark.parametrize(("suffix", "name"), [("tif", "flight"), ("png", "flight"), ("tif", "01")])
def test_fourteen_bits_are_stretched_by_one_range_for_the_folder(tmp_path, suffix, name):
    tmp_path = tmp_path / name
    tmp_path.mkdir()
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"{k}.{suffix}"), ramp(7200 + 100 * k, 7900 + 100 * k))
    first, last = (read_gray(tmp_path / f"{k}.{suffix}").astype(float) for k in (0, 3))
    assert first.min() == 0 and last.max() == 255 and first.max() > 150
    level = 255.0 / 1000.0
    assert np.median(last - first) == pytest.approx(300 * level, rel=0.1)  # the same value is the same grey
    assert (
        np.ptp(read_rgb(tmp_path / f"1.{suffix}")) > 150 and np.ptp(read_rgba(tmp_path / f"1.{suffix}")[..., :3]) > 150
    )


def test_all_sixteen_bits_are_divided(tmp_path):
    cv2.imwrite(str(tmp_path / "full.tif"), ramp(0, 65535))
    assert np.abs(read_gray(tmp_path / "full.tif").astype(float) - ramp(0, 65535) / 256.0).max() <= 1.0


def test_a_ground_stations_pictures_do_not_depend_on_what_else_has_come(tmp_path):
    """It spreads them over folders by their digest: a range of these would differ from folder to folder."""
    grey = []
    for k, name in enumerate(("00", "ab", "f3")):
        (tmp_path / name).mkdir()
        path = tmp_path / name / f"{name}{k:062x}.png"
        cv2.imwrite(str(path), np.vstack([np.full((24, 64), 3200, np.uint16), ramp(0, 999 * k)]))
        grey.append(int(read_gray(path)[0, 0]))
    assert set(grey) == {3200 // 256}


def test_a_kept_range_grows_with_what_leaves_it_and_is_one_for_each_kind():
    ranges = grown({}, ramp(300, 800), ".png")
    low, high = ranges["64x48.png"]
    assert 300 <= low < 320 and 780 < high <= 800
    assert grown(ranges, ramp(350, 750), ".png") is None
    more = grown(ranges, ramp(300, 1000), ".png")["64x48.png"]
    assert more[0] == low and more[1] > 1000
    both = grown(ranges, ramp(7000, 7900), ".tif")
    assert both["64x48.png"] == (low, high) and both["64x48.tif"][0] >= 7000
    assert grown(ranges, ramp(0, 65535), ".png")["64x48.png"] is None
