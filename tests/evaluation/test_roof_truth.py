"""The benchmark of wide roofs: on a hall that is drawn two metres off, beside ground and a house that are not."""

import re
import sys

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from benchmarks.accuracy.roof_truth import main, wide_and_beside

CELL_M, SIZE, OFF_M = 0.5, 240, 2.0
HALL, HOUSE = np.s_[80:160, 80:160], np.s_[20:36, 20:36]


def heights():
    over = np.zeros((SIZE, SIZE), np.float32)
    over[HALL], over[HOUSE] = 9.0, 6.0
    return over


def texture(seed):
    noise = np.random.default_rng(seed).normal(0.0, 60.0, (SIZE, SIZE))
    return np.clip(128.0 + cv2.GaussianBlur(noise, (0, 0), 1.2) * 2.5, 1, 255).astype(np.uint8)


def write(path, values):
    path.parent.mkdir(exist_ok=True)
    profile = {"driver": "GTiff", "width": SIZE, "height": SIZE, "count": 1, "dtype": values.dtype, "crs": "EPSG:32648"}
    with rasterio.open(path, "w", transform=from_origin(3e5, 3.4e6, CELL_M, CELL_M), **profile) as file:
        file.write(values, 1)


@pytest.fixture
def scene(tmp_path):
    """A set's truth, and an orthoimage in which the hall lies OFF_M east of its place."""
    ground, roof, off = texture(1), texture(2), round(OFF_M / CELL_M)
    reference, ortho = ground.copy(), ground.copy()
    reference[HALL] = roof[HALL]
    ortho[80:160, 80 + off : 160 + off] = roof[HALL]
    write(tmp_path / "truth" / "reference.tif", reference)
    write(tmp_path / "truth" / "dsm.tif", heights())
    write(tmp_path / "truth" / "dtm.tif", np.zeros((SIZE, SIZE), np.float32))
    write(tmp_path / "out" / "orthoimage.tif", ortho)
    return tmp_path


def test_a_displaced_hall_is_measured_apart_from_the_ground_beside_it(scene, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["roof_truth", str(scene), str(scene / "out")])
    main()
    lines = capsys.readouterr().out.splitlines()
    found = {line.split()[1]: float(re.search(r"median (\S+) m", line)[1]) for line in lines}
    assert abs(found["roofs"] - OFF_M) < 0.15
    assert found["beside"] < 0.15


def test_a_house_is_not_wide_and_what_stands_is_not_ground():
    over = heights()
    over[90:100, 164:170] = 1.0
    wide, beside = wide_and_beside(over, CELL_M)
    assert wide[HALL][20:60, 20:60].all() and not wide[HOUSE].any()
    assert not (wide & beside).any()
    assert beside[120, 175] and not beside[90:100, 164:170].any() and not beside[0:40, 0:40].any()
