"""Selection of pairs, heights of a pair, and merging of the heights of many pairs."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.config import DEFAULT
from orthoswarm.model.camera import Lens
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain
from orthoswarm.stereo import rectified_pair
from orthoswarm.stereo.picture_pairs import choose_pairs
from orthoswarm.stereo.rectified_pair import PairPoints, PairView, match_pair
from orthoswarm.stereo.surface_cells import cell_heights, merge_heights
from tests.kit.mosaic_scene import EAST, NORTH, Flight, camera, hills, terrain_of

FLAT = Terrain.flat()
STEREO = DEFAULT.stereo
LENS = Lens(240, 180, 135.0, k1=-0.08, k2=0.01, cx=2.0, cy=-1.5)


def view(flight, index, factor=1):
    picture = flight.pictures[flight.frames[index].frame.image][..., 1]
    return PairView(flight.frames[index].camera, np.ascontiguousarray(picture), factor)


@pytest.mark.parametrize("yaws", [(0.0, 0.0), (40.0, 220.0), (90.0, 95.0)])
@pytest.mark.parametrize("towards", [(40.0, 0.0), (-25.0, 30.0), (0.0, -45.0)])
def test_heights_of_a_pair_are_true_for_all_headings_and_tilts(yaws, towards):
    flight = Flight()
    flight.take(camera(yaw_deg=yaws[0], pitch_deg=-86.0, roll_deg=3.0, lens=LENS), hills)
    flight.take(camera(*towards, height=103.0, yaw_deg=yaws[1], roll_deg=-4.0, lens=LENS), hills)
    found = match_pair(view(flight, 0), view(flight, 1), terrain_of(lambda p: 0.0 * p[..., 0]), STEREO)
    assert len(found.points) > 0.3 * 240 * 180
    error = found.points[:, 2] - hills(found.points[:, :2])
    assert abs(np.median(error)) < 0.5  # a pixel is 0.74 m, the waves of this ground are long
    assert np.quantile(np.abs(error), 0.68) < 0.8  # 0.3 of a pixel at a base of 0.4 is 0.6 m
    assert 0.2 < np.median(found.sigma_m) < 0.8


def slab(east_north):
    """Level ground with a platform 20 m high, 16 m wide, 30 m east of the first camera."""
    p = np.abs(np.asarray(east_north) - (EAST + 30.0, NORTH))
    return np.where(p.max(-1) < 8.0, 20.0, 0.0)


def test_of_a_wide_search_range_only_what_occurs_is_searched(monkeypatch):
    large = Lens(960, 720, 540.0)
    flight = Flight().take(camera(lens=large), slab).take(camera(east=45.0, lens=large), slab)
    searched = []
    create = cv2.StereoSGBM.create
    monkeypatch.setattr(cv2.StereoSGBM, "create", lambda **how: searched.append(how["numDisparities"]) or create(**how))
    found = match_pair(view(flight, 0), view(flight, 1), FLAT, STEREO).points
    half, narrow = searched
    monkeypatch.setattr(rectified_pair, "_WIDE_PX", 10_000)
    whole = match_pair(view(flight, 0), view(flight, 1), FLAT, STEREO).points
    assert half < 0.6 * searched[-1] and narrow < 0.7 * searched[-1]
    assert len(found) > 0.98 * len(whole)
    top = np.abs(found[:, :2] - (EAST + 30.0, NORTH)).max(1) < 5.0
    assert top.sum() > 1_000 and abs(np.median(found[top, 2]) - 20.0) < 0.5
    assert np.quantile(np.abs(found[:, 2] - slab(found[:, :2])), 0.9) < 0.5


def test_pictures_without_overlap_give_no_points():
    flight = Flight().take(camera(lens=LENS)).take(camera(east=900.0, lens=LENS))
    assert len(match_pair(view(flight, 0), view(flight, 1), FLAT, STEREO).points) == 0


def test_pairs_have_a_sufficient_base_and_similar_views():
    flight = Flight()
    for k in range(12):
        flight.take(camera(east=10.0 * k))
    flight.take(camera(east=20.0, north=10.0, pitch_deg=-30.0))  # looks elsewhere
    flight.take(camera(east=30.0, north=10.0), weak=True)
    damaged = replace(flight.frames[5], frame=replace(flight.frames[5].frame, damaged=True))
    flight.frames[5] = damaged
    pairs = choose_pairs(flight.frames, FLAT, STEREO.partners)
    assert pairs == sorted(set(pairs)) and all(i < j for i, j in pairs)
    used = {k for pair in pairs for k in pair}
    assert used == set(range(12)) - {5}
    base = [np.linalg.norm(flight.cameras[i].position - flight.cameras[j].position) / 100.0 for i, j in pairs]
    assert min(base) >= 0.2 and max(base) <= 0.61  # as near to 0.4 as there are


def test_a_single_picture_or_none_makes_no_pair():
    assert choose_pairs([], FLAT, STEREO.partners) == []
    assert choose_pairs(Flight().take(camera()).frames, FLAT, STEREO.partners) == []


def test_a_pair_gives_each_cell_the_median_of_its_points():
    grid = GroundGrid(epsg=32648, west=EAST, north=NORTH + 4.0, gsd_m=2.0, width=2, height=2)
    places = [(0.5, 3.5), (1.5, 2.5), (1.0, 3.0), (2.5, 0.5), (3.0, 1.0), (3.5, 1.5), (3.9, 3.9), (9.0, 1.0)]
    heights = [5.0, 6.0, 50.0, 1.0, 2.0, 3.0, 7.0, 8.0]
    points = np.column_stack([np.array(places) + np.array([EAST, NORTH]), heights])
    found = cell_heights(PairPoints(points, np.full(8, 0.3)), grid)
    assert found.cell.tolist() == [0, 3]  # one cell has a single point, one point lies outside
    assert found.height_m.tolist() == [6.0, 2.0]


def merged(columns, sigma=0.2):
    most = max(len(c) for c in columns)
    z = np.zeros((most, len(columns)), np.float32)
    for k, column in enumerate(columns):
        z[: len(column), k] = column
    return merge_heights(z, np.full(z.shape, sigma, np.float32), np.array([len(c) for c in columns], np.uint8))


def test_heights_that_agree_are_averaged_and_others_left_out():
    z, sigma, pairs = merged([[10.0, 10.2, 9.9, 30.0], [10.0], [], [5.0, 5.1]])
    assert z[0] == pytest.approx(10.033, abs=0.01) and pairs.tolist() == [3, 0, 0, 2]
    assert np.isnan(z[1:3]).all() and np.isnan(sigma[1:3]).all()
    assert sigma[0] < 0.2


@given(st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=8), st.floats(0.05, 1.0))
def test_more_scatter_never_makes_a_cell_surer(offsets, sigma):
    calm, rough = merged([[100.0] * len(offsets)], sigma), merged([[100.0 + o for o in offsets]], sigma)
    if rough[2][0] == len(offsets):
        assert rough[1][0] >= calm[1][0] - 1e-6
        assert 98.0 <= rough[0][0] <= 102.0
