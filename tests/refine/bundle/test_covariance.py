"""The error that a refined picture states of itself."""

import numpy as np
import pytest

from orthoswarm.config import active
from orthoswarm.refine.bundle.covariance import (
    common_map_sigma,
    map_distortion_variance,
    systematic_tie_offset,
)

BUNDLE = active().bundle


def test_one_and_two_stated_sigmas_are_honest_by_axis_and_by_length():
    error = np.random.default_rng(0).normal(0.0, 1.0, (20000, 2))
    length = np.hypot(*error.T)
    for k, low, high in ((1, 0.50, 0.85), (2, 0.85, 0.99)):
        assert low < (np.abs(error) < k * BUNDLE.stated_sigma_factor).mean() < high
        assert low < (length < k * BUNDLE.stated_sigma_factor).mean() < high


def test_a_map_that_scatters_its_ties_is_doubted_more():
    residual = np.random.default_rng(1).normal(0.0, 1.0, (400, 2))
    given = np.full(400, 0.1)
    good, bad = common_map_sigma(0.03 * residual, given, 0.5), common_map_sigma(0.5 * residual, given, 0.5)
    assert good == pytest.approx(np.hypot(BUNDLE.map_floor_px * 0.5, BUNDLE.tie_scatter_share * 0.03), rel=0.1)
    assert bad == pytest.approx(BUNDLE.tie_scatter_share * 0.5, rel=0.1)


def test_wrong_ties_make_no_doubt_of_the_others():
    residual = np.random.default_rng(2).normal(0.0, 0.05, (400, 2))
    given = np.full(400, 0.1)
    clean = common_map_sigma(residual, given, 0.5)
    residual[:40] += 4.0
    assert common_map_sigma(residual, given, 0.5) < 1.25 * clean


def test_few_ties_that_were_followed_are_not_believed_to_be_exact():
    doubt = np.hypot(BUNDLE.map_floor_px * 0.5, BUNDLE.tie_scatter_share * 0.35)
    assert common_map_sigma(np.zeros((10, 2)), np.full(10, 0.35), 0.5) == pytest.approx(doubt, rel=0.02)
    assert common_map_sigma(np.zeros((0, 2)), np.zeros(0), 2.0) == pytest.approx(BUNDLE.map_floor_px * 2.0)


def test_ties_that_agree_on_another_place_are_told_and_a_lone_wrong_one_is_not():
    leg, camera = np.zeros(40, np.int32), np.repeat(np.arange(40), 2)
    residual = np.random.default_rng(3).normal(0.0, 0.05, (80, 2))
    residual[7] += 3.0
    residual[camera >= 25] += (0.0, 1.0)
    off = systematic_tie_offset(leg, camera, residual)
    assert off[:15].max() < 0.1
    assert off[32:].min() > 0.8


def test_a_distorted_map_is_told_from_one_whose_ties_only_scatter():
    """What neighbouring ties have in common is the map's distortion; what differs from tie to tie is not."""
    rng = np.random.default_rng(3)
    place = rng.uniform(0.0, 600.0, (400, 2))
    noise = rng.normal(0.0, 0.2, (400, 2))
    waves = 1.5 * np.sin(place[:, ::-1] / 100.0)
    assert map_distortion_variance(place, noise, 150.0) < 0.15**2
    found = map_distortion_variance(place, noise + waves, 150.0)
    assert 0.5 * waves.var() < found / BUNDLE.distortion_followed < 1.5 * waves.var()
    ripples = 1.5 * np.sin(place[:, ::-1] / 5.0)
    assert map_distortion_variance(place, noise + ripples, 150.0) < 0.2 * ripples.var(), "averages out in a picture"
    wrong = noise + waves
    wrong[::10] += 8.0
    assert map_distortion_variance(place, wrong, 150.0) == pytest.approx(found, rel=0.5)
    assert map_distortion_variance(place[:5], noise[:5], 150.0) == 0.0
