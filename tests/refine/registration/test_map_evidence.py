"""When tie points are evidence that a flight lies on a map, and when any map would show as much."""

import numpy as np
import pytest

from orthoswarm.refine.registration.map_evidence import agreement_probability, false_matches_log10

REACH_M, PATCH_M = 14.0, 20.0


def evidence(shift, leg=None, ground=None, rng=None):
    count = len(shift)
    if ground is None:
        ground = np.column_stack([50.0 * np.arange(count), np.zeros(count)])
    leg = np.zeros(count, np.int32) if leg is None else leg
    return false_matches_log10(ground, shift, np.arange(count, dtype=float), leg=leg, reach_m=REACH_M, patch_m=PATCH_M)


def anywhere(count, seed):
    return np.random.default_rng(seed).uniform(-REACH_M, REACH_M, (count, 2))


@pytest.mark.parametrize("count", [5, 20, 80, 250])
def test_shifts_all_over_their_windows_are_no_evidence(count):
    found = [evidence(anywhere(count, seed), np.arange(count, dtype=np.int32) // 10) for seed in range(40)]
    assert min(found) > -2.0  # of 160 sets less than two may look as good as one in a hundred by chance


@pytest.mark.parametrize("count", [12, 40, 250])
def test_a_third_on_one_place_is_evidence(count):
    shift = anywhere(count, 1)
    right = np.arange(count) % 3 == 0
    shift[right] = np.array([4.0, -7.0]) + np.random.default_rng(2).normal(0, 0.2, (right.sum(), 2))
    assert evidence(shift) < (-4.0 if count > 12 else -2.0)


def test_a_drift_along_a_leg_is_followed():
    shift = anywhere(60, 3)
    shift[::2] = np.column_stack([0.15 * np.arange(0, 60, 2), np.full(30, -2.0)])
    assert evidence(shift) < -20.0


def test_ties_that_share_their_ground_count_once():
    shift = anywhere(6, 4)
    ground = np.column_stack([50.0 * np.arange(6), np.zeros(6)])
    assert evidence(np.repeat(shift, 8, 0), ground=np.repeat(ground, 8, 0)) > -2.0


def test_few_ties_prove_nothing():
    assert evidence(np.zeros((0, 2))) == 0.0
    assert evidence(np.ones((3, 2))) == 0.0


def test_a_leg_needs_more_ties_the_fewer_of_them_agree():
    assert agreement_probability(3, 3, 1.2, 5.0) < 1e-3
    assert agreement_probability(1, 1, 1.2, 5.0) > 0.01
    assert agreement_probability(3, 40, 1.2, 5.0) > 0.2
    assert agreement_probability(0, 0, 1.2, 5.0) == 1.0
