"""Features, matches, candidate pairs and tracks of single photos."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthoswarm.refine.features.pair_matching import (
    Pair,
    build_tracks,
    consecutive,
    match_features,
    nearby,
    thin_tracks,
)
from orthoswarm.refine.features.sift_features import SiftFeatures, detect, reduce_picture, spread
from tests.kit.sparse_world import texture


def crop(picture: np.ndarray, matrix: np.ndarray, size: tuple[int, int] = (480, 360)) -> np.ndarray:
    return cv2.warpAffine(picture, matrix, size, flags=cv2.INTER_LINEAR)


def similarity(scale: float, angle: float, dx: float, dy: float) -> np.ndarray:
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    return np.array([[c, -s, dx], [s, c, dy]])


@pytest.mark.parametrize("angle", [0.1, 1.7, 3.1])
def test_turned_shifted_zoomed_picture_matches_where_it_should(angle):
    ground = texture(1)
    move = similarity(1.15, angle, 240 - 1.15 * np.cos(angle) * 330 + 1.15 * np.sin(angle) * 330,
                      180 - 1.15 * np.sin(angle) * 330 - 1.15 * np.cos(angle) * 330)  # fmt: skip
    one, two = crop(ground, similarity(1, 0, -100, -150)), crop(ground, move)
    a, b = detect(one, 480, 360), detect(two, 480, 360)
    match = match_features(a, b)
    assert len(match) > 60
    on_ground = a.uv[match[:, 0]] + [100, 150]
    expected = on_ground @ move[:, :2].T + move[:, 2]
    error = np.hypot(*(b.uv[match[:, 1]] - expected).T)
    assert np.median(error) < 0.5
    assert (error < 3).mean() > 0.95


def test_pictures_of_other_places_do_not_match():
    a, b = detect(texture(2)[:360, :480], 480, 360), detect(texture(3)[:360, :480], 480, 360)
    assert match_features(a, b).shape == (0, 2)


def test_plain_and_tiny_pictures_have_no_features_and_match_nothing():
    plain = detect(np.full((360, 480), 90, np.uint8), 480, 360)
    assert len(plain) == 0
    assert match_features(plain, detect(texture(1), 900, 700)).shape == (0, 2)
    assert build_tracks([plain, plain], []).count == 0


def test_positions_are_in_full_pixels_whatever_size_was_decoded():
    full = cv2.resize(texture(4, 360, 480), (1920, 1440), interpolation=cv2.INTER_CUBIC)
    half = cv2.resize(full, (960, 720), interpolation=cv2.INTER_AREA)
    a, b = detect(full, 1920, 1440), detect(half, 1920, 1440)
    match = match_features(a, b)
    assert len(match) > 100
    assert np.abs(np.median(a.uv[match[:, 0]] - b.uv[match[:, 1]], axis=0)).max() < 0.3


def test_reduced_picture_is_never_enlarged():
    small = np.zeros((60, 80), np.uint8)
    reduced, step = reduce_picture(small, 80, 60, 480 * 360)
    assert reduced.shape == (60, 80)
    assert step == 1.0


@given(st.integers(0, 10_000), st.integers(1, 3000))
@settings(max_examples=30, deadline=None)
def test_kept_features_are_spread_over_the_cells(seed, count):
    rng = np.random.default_rng(seed)
    xy = (rng.uniform(0, 1, (count, 2)) ** 2 * [480, 360]).astype(np.float32)
    keep = spread(xy, rng.uniform(0, 1, count).astype(np.float32), 480, 360)
    cell = (xy[keep, 1] * 6 / 360).astype(int) * 8 + (xy[keep, 0] * 8 / 480).astype(int)
    assert len(keep) <= 600
    assert len(np.unique(keep)) == len(keep)
    assert np.bincount(cell).max() <= 16
    everywhere = (xy[:, 1] * 6 / 360).astype(int) * 8 + (xy[:, 0] * 8 / 480).astype(int)
    assert set(cell) == set(everywhere)


def test_consecutive_pairs_stay_in_their_group_and_end_at_a_pause():
    group = np.array([0, 1, 0, 1, 0])
    time = np.array([0.0, 0.0, 5.0, 5.0, 500.0])
    assert consecutive(group, time).tolist() == [[0, 2], [1, 3]]
    unknown = consecutive(group, np.full(5, np.nan))
    assert unknown.tolist() == [[0, 2], [1, 3], [2, 4]]


def test_nearby_pairs_lie_within_reach_on_all_sides_and_ask_other_legs():
    x, y = np.meshgrid(np.arange(12), np.arange(12))
    centre = (10.0 * x + 10.0j * y).ravel()
    group = y.ravel()
    pairs = nearby(centre, np.full(144, 32.0), group, 8)
    distance = np.abs(centre[pairs[:, 0]] - centre[pairs[:, 1]])
    assert distance.max() <= 32.0
    assert (pairs[:, 0] < pairs[:, 1]).all()
    middle = 6 * 12 + 6
    mine = pairs[(pairs == middle).any(1)]
    others = mine[mine != middle]
    assert len(np.unique(group[others])) >= 3
    assert (np.angle(centre[others] - centre[middle]) > 0).any()
    assert (np.angle(centre[others] - centre[middle]) < 0).any()


def test_a_thousand_photos_of_one_spot_do_not_make_a_million_pairs():
    pairs = nearby(np.zeros(1000, complex), np.full(1000, 30.0), np.zeros(1000, int), 8)
    assert len(pairs) <= 8000


def fake_features(count: int) -> SiftFeatures:
    uv = np.stack([np.arange(count), np.arange(count)], 1).astype(np.float32)
    return SiftFeatures(
        uv=uv,
        descriptor=np.zeros((count, 128), np.uint8),
        sigma_px=np.ones(count, np.float32),
        width=100,
        height=100,
        step_px=1.0,
    )


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_tracks_never_hold_two_points_of_a_photo_nor_more_than_the_longest(seed):
    rng = np.random.default_rng(seed)
    photos, count = 26, 12
    features = [fake_features(count) for _ in range(photos)]
    pairs = []
    for _ in range(90):
        a, b = sorted(rng.choice(photos, 2, replace=False).tolist())
        n = int(rng.integers(1, count))
        wrong = np.where(rng.uniform(size=n) < 0.1, rng.integers(0, count, n), -1)
        first = rng.permutation(count)[:n]
        second = np.where(wrong >= 0, wrong, first)
        pairs.append(Pair(a, b, np.stack([first, second], 1).astype(np.int32)))
    tracks = build_tracks(features, pairs)
    length = np.bincount(tracks.point)
    assert (length >= 2).all()
    assert (length <= 20).all()
    key = tracks.point.astype(np.int64) * photos + tracks.camera
    assert len(np.unique(key)) == len(key)


def test_chained_matches_become_one_track_with_the_photos_own_positions():
    features = [fake_features(5) for _ in range(3)]
    pairs = [Pair(0, 1, np.array([[2, 3]], np.int32)), Pair(1, 2, np.array([[3, 4]], np.int32))]
    tracks = build_tracks(features, pairs)
    assert tracks.count == 1
    assert tracks.camera.tolist() == [0, 1, 2]
    assert tracks.uv.tolist() == [[2, 2], [3, 3], [4, 4]]


def test_points_described_twice_for_two_orientations_are_one_observation():
    twice = fake_features(3)
    twice = replace(twice, uv=twice.uv[[0, 0, 2]].copy())
    pairs = [
        Pair(0, 1, np.array([[0, 1]], np.int32)),
        Pair(0, 2, np.array([[1, 1]], np.int32)),
    ]
    tracks = build_tracks([twice, fake_features(3), fake_features(3)], pairs)
    assert tracks.count == 1
    assert sorted(tracks.camera.tolist()) == [0, 1, 2]


def test_thinning_keeps_every_cell_that_was_covered():
    rng = np.random.default_rng(0)
    features = [
        SiftFeatures(uv=rng.uniform(0, 100, (400, 2)).astype(np.float32), descriptor=np.zeros((400, 128), np.uint8),
                 sigma_px=np.ones(400, np.float32), width=100, height=100, step_px=1.0) for _ in range(4)
    ]  # fmt: skip
    same = np.stack([np.arange(400)] * 2, 1).astype(np.int32)
    tracks = build_tracks(features, [Pair(0, 1, same), Pair(1, 2, same[:200]), Pair(2, 3, same[:100])])
    size = np.full(4, 100.0)
    thin = thin_tracks(tracks, size, size)
    assert len(thin.camera) < 0.8 * len(tracks.camera)

    def cells(t):
        at = (t.uv[:, 1] * 6 / 100).astype(int) * 8 + (t.uv[:, 0] * 8 / 100).astype(int)
        return set(zip(t.camera.tolist(), at.tolist()))

    assert cells(thin) == cells(tracks)
