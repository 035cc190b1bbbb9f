"""Levels of vehicles on each other, and outside height models."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthoswarm.refine.surface.height_levels import level_corrections


def strip(east, offset, seed, count=600, surface=lambda xy: 0.0 * xy[:, 0]):
    """Ground points of a vehicle that covers 200 x 300 m from `east` on, its level off by `offset`."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((east, 0.0), (east + 200.0, 300.0), (count, 2))
    return np.c_[xy, surface(xy) + offset + rng.normal(0, 0.2, count)]


def swarm(offsets, overlap=60.0, **kwargs):
    return [strip(i * (200.0 - overlap), o, i, **kwargs) for i, o in enumerate(offsets)]


def test_differences_of_neighbours_are_undone():
    offsets = np.array([0.0, -0.4, -0.1, -0.5])
    correction = level_corrections(swarm(offsets))
    np.testing.assert_allclose(correction + offsets, 0.0, atol=0.1)


def test_with_a_small_spread_the_least_corrected_vehicle_stays():
    correction = level_corrections(swarm([-0.5, 0.0, -0.2]))
    assert correction.min() == pytest.approx(0.0, abs=1e-9)
    assert correction.argmin() == 1


def test_with_a_large_spread_the_mean_stays():
    correction = level_corrections(swarm([1.5, 0.0, -1.2]))
    assert correction.mean() == pytest.approx(0.0, abs=1e-6)


def test_the_anchor_does_not_jump_as_the_spread_grows():
    spreads = np.linspace(0.2, 2.4, 45)
    first = np.array([level_corrections(swarm([0.0, -s]))[0] for s in spreads])
    assert np.abs(np.diff(first)).max() < 0.2


def test_a_ring_is_adjusted_and_not_chained():
    rng = np.random.default_rng(3)
    corner = [(0, 0), (140, 0), (140, 240), (0, 240)]
    offset = [0.0, -0.3, -0.1, -0.2]
    ground = []
    for (e, n), o in zip(corner, offset, strict=True):
        xy = rng.uniform((e, n), (e + 200, n + 300), (700, 2))
        ground.append(np.c_[xy, np.full(700, o) + rng.normal(0, 0.2, 700)])
    correction = level_corrections(ground)
    np.testing.assert_allclose(correction + offset, 0.0, atol=0.08)


def test_relief_under_the_overlap_does_not_matter():
    surface = lambda xy: 6 * np.sin(xy[:, 0] / 60) + 0.03 * xy[:, 1]  # noqa: E731
    offsets = np.array([0.0, -0.4, -0.2])
    correction = level_corrections(swarm(offsets, surface=surface))
    np.testing.assert_allclose(correction + offsets, 0.0, atol=0.15)


def test_vehicles_without_common_ground_keep_their_level():
    ground = [*swarm([0.0, -0.5]), strip(5000.0, -3.0, 9), np.empty((0, 3))]
    correction = level_corrections(ground)
    assert correction[2] == 0.0 and correction[3] == 0.0
    assert correction[0] != correction[1]


def test_a_few_common_points_are_not_trusted():
    assert (level_corrections(swarm([0.0, -0.5], overlap=-10.0, count=60)) == 0.0).all()


def test_one_vehicle_is_a_network():
    correction = level_corrections([strip(0.0, 1.0, 0)])
    np.testing.assert_array_equal(correction, [0.0])


def test_roofs_among_the_points_do_not_move_the_level():
    ground = swarm([0.0, -0.5])
    ground[0][::5, 2] += 6.0
    correction = level_corrections(ground)
    assert correction[1] - correction[0] == pytest.approx(0.5, abs=0.15)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(-0.6, 0.0), min_size=2, max_size=6), st.floats(-30, 30))
def test_a_common_shift_changes_nothing(offsets, shift):
    a = level_corrections(swarm(offsets, count=200))
    b = level_corrections([g + np.array([0.0, 0.0, shift]) for g in swarm(offsets, count=200)])
    np.testing.assert_allclose(a, b, atol=1e-6)
