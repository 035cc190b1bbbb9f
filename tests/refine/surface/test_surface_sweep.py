"""The sweep that measures the visible surface: narrowed heights, several references, and what is left out."""

from functools import partial

import numpy as np
import pytest

from orthoswarm.model.placement import Terrain
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.surface.plane_sweep import SweepCosts, SweepViews, measured, sweep_tasks
from orthoswarm.refine.surface.surface_model import _speckles, merge_heights
from tests.refine.surface.hall_flight import HEIGHT_M, MIDDLE, ROOF_M, HallFlight, away

CELL_M = 0.8
SHAPE = (140, 150)
CORNER = MIDDLE - CELL_M * np.array(SHAPE[::-1]) / 2
COSTS = SweepCosts(
    noise_levels=1.0, doubt=0.0, slope=0.15, edge=(0.2, 1.0), unlike=0.7, references=3, depth_m=10.0, narrow=True
)


@pytest.fixture(scope="module")
def flight() -> HallFlight:
    return HallFlight()


def swept(flight: HallFlight, some: np.ndarray | slice = slice(None), costs: SweepCosts = COSTS) -> np.ndarray:
    """Heights by each reference, (3, rows, columns), about ground that is assumed 2 m too low."""
    index = np.arange(len(flight.frames))[some]
    views = SweepViews(flight.cameras.take(index), [partial(flight.read, flight.frames[i]) for i in index])
    ground = Terrain(*CORNER, CELL_M, np.full(SHAPE, -2.0, np.float32))
    out = np.full((3, *SHAPE), np.nan, np.float32)
    for task in sweep_tasks(views, ground, np.full(SHAPE, 45.0, np.float32), height_m=HEIGHT_M, costs=costs):
        for (top, bottom, left, right), heights in measured(task):
            out[: len(heights), top:bottom, left:right] = heights - 2.0
    return out


def places() -> np.ndarray:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return CORNER + CELL_M * np.stack([columns, rows], -1)


def test_ground_and_roof_are_measured_by_each_reference(flight: HallFlight) -> None:
    off = away(places())
    inner = np.zeros(SHAPE, bool)
    inner[4:-4, 4:-4] = True
    for heights in swept(flight):
        for true, some in ((ROOF_M, off < -2.0), (0.0, (off > 2.0) & (off < 12.0) & inner)):
            known = some & np.isfinite(heights)
            assert known.sum() > 0.8 * some.sum()
            assert np.median(np.abs(heights[known] - true)) < 0.3 and (np.abs(heights[known] - true) < 1.0).mean() > 0.9


def test_what_is_known_of_the_rim_is_right(flight: HallFlight) -> None:
    """GIVEN pictures that show a part of the area only THEN a height that more of them show is not taken for it."""
    some = np.flatnonzero(flight.cameras.position[:, 1] < 60.0)
    z, _, number = merge_heights(swept(flight, some), 0.2)
    known = (number > 0) & (np.abs(away(places())) > 2.0)
    true = np.where(away(places()) < 0.0, ROOF_M, 0.0)
    assert 500 < known.sum() < 0.9 * known.size
    assert (np.abs(z[known] - true[known]) < 1.0).mean() > 0.9


def test_without_pictures_nothing_is_measured(flight: HallFlight) -> None:
    assert np.isnan(swept(flight, slice(0, 2))).all()
    nobody = CameraBlock(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int32), flight.cameras.lens)
    ground = Terrain(0.0, 0.0, CELL_M, np.zeros(SHAPE, np.float32))
    tallest = np.ones(SHAPE, np.float32)
    assert not list(sweep_tasks(SweepViews(nobody, []), ground, tallest, height_m=HEIGHT_M, costs=COSTS))


def test_heights_that_agree_are_averaged_and_others_left_out() -> None:
    heights = np.array(
        [[10.0, 10.0, np.nan, 5.0], [10.2, np.nan, np.nan, 9.0], [30.0, np.nan, np.nan, 1.0]], np.float32
    )
    z, sigma, number = (values[0] for values in merge_heights(heights[:, None], 0.2))
    assert z[0] == pytest.approx(10.1) and number.tolist() == [2, 0, 0, 0]
    assert np.isnan(z[1:]).all() and np.isnan(sigma[1:]).all() and 0.2 < sigma[0] < 0.3


def test_more_scatter_never_makes_a_cell_surer() -> None:
    calm, rough = (merge_heights(np.array([[[0.0]], [[d]], [[-d]]], np.float32), 0.3)[1][0, 0] for d in (0.0, 0.8))
    assert calm < rough


def test_small_regions_of_other_heights_are_speckles() -> None:
    z = np.zeros((30, 30), np.float32)
    z[10:15, 10:15] = 7.0
    z[:, 20:] = 5.0
    z[0, 0] = np.nan
    speckles = _speckles(z, 0.5)
    assert speckles[10:15, 10:15].all() and speckles.sum() == 25
