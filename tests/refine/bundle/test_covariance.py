"""The error that a refined picture states of itself."""

from dataclasses import replace

import numpy as np
import pytest

from orthoswarm.model.camera import ground_jacobian, rotation_from_angles
from orthoswarm.model.placement import STATED_SIGMA_FACTOR
from orthoswarm.model.plane_similarity import Similarity
from orthoswarm.refine.bundle.adjustment import Adjustment, HeightPrior, MapTies
from orthoswarm.refine.bundle.covariance import (
    MAP_FLOOR_PX,
    RECEIVER_BIAS_SIGMA_M,
    TIE_SCATTER_SHARE,
    TIED_COVARIANCE_SHARE,
    common_map_sigma,
    receiver_sigma,
    stated_errors,
    systematic_tie_offset,
    with_distance_errors,
)
from orthoswarm.refine.flight.relative_block import first_points
from tests.kit.swarm_block import make_block


def test_one_and_two_stated_sigmas_are_honest_by_axis_and_by_length():
    error = np.random.default_rng(0).normal(0.0, 1.0, (20000, 2))
    length = np.hypot(*error.T)
    for k, low, high in ((1, 0.50, 0.85), (2, 0.85, 0.99)):
        assert low < (np.abs(error) < k * STATED_SIGMA_FACTOR).mean() < high
        assert low < (length < k * STATED_SIGMA_FACTOR).mean() < high


def test_a_map_that_scatters_its_ties_is_doubted_more():
    residual = np.random.default_rng(1).normal(0.0, 1.0, (400, 2))
    given = np.full(400, 0.1)
    good, bad = common_map_sigma(0.03 * residual, given, 0.5), common_map_sigma(0.5 * residual, given, 0.5)
    assert good == pytest.approx(np.hypot(MAP_FLOOR_PX * 0.5, TIE_SCATTER_SHARE * 0.03), rel=0.1)
    assert bad == pytest.approx(TIE_SCATTER_SHARE * 0.5, rel=0.1)


def test_wrong_ties_make_no_doubt_of_the_others():
    residual = np.random.default_rng(2).normal(0.0, 0.05, (400, 2))
    given = np.full(400, 0.1)
    clean = common_map_sigma(residual, given, 0.5)
    residual[:40] += 4.0
    assert common_map_sigma(residual, given, 0.5) < 1.25 * clean


def test_few_ties_that_were_followed_are_not_believed_to_be_exact():
    doubt = np.hypot(MAP_FLOOR_PX * 0.5, TIE_SCATTER_SHARE * 0.35)
    assert common_map_sigma(np.zeros((10, 2)), np.full(10, 0.35), 0.5) == pytest.approx(doubt, rel=0.02)
    assert common_map_sigma(np.zeros((0, 2)), np.zeros(0), 2.0) == pytest.approx(MAP_FLOOR_PX * 2.0)


def test_ties_that_agree_on_another_place_are_told_and_a_lone_wrong_one_is_not():
    leg, camera = np.zeros(40, np.int32), np.repeat(np.arange(40), 2)
    residual = np.random.default_rng(3).normal(0.0, 0.05, (80, 2))
    residual[7] += 3.0
    residual[camera >= 25] += (0.0, 1.0)
    off = systematic_tie_offset(leg, camera, residual)
    assert off[:15].max() < 0.1
    assert off[32:].min() > 0.8


def test_what_the_focal_length_makes_up_for_moves_a_camera_along_its_axis():
    """The ground in the middle of the picture stays where it is, and the distance has the error that was added."""
    angles = np.radians([[30.0, -90.0, 0.0], [30.0, -60.0, 2.0]])
    rotation = rotation_from_angles(*angles.T)
    own = np.repeat(np.diag([0.01, 0.02, 0.04, 1e-6, 1e-6, 1e-7]).astype(np.float32)[None], 2, axis=0)
    more = with_distance_errors(own, rotation, np.array([2.0, 3.0]))
    for before, after, r, sigma in zip(own, more, rotation, (2.0, 3.0), strict=True):
        axis = r[:, 2]
        added = (after - before)[:3, :3]
        assert axis @ added @ axis == pytest.approx(sigma**2, rel=1e-5)
        j = ground_jacobian(r, 80.0, 0.2)
        np.testing.assert_allclose(j @ after @ j.T, j @ before @ j.T, atol=1e-5)
        np.testing.assert_array_equal(after[3:], before[3:])


def test_a_solved_principal_point_does_not_move_the_ground_in_the_pictures_middle():
    """Rotations make up for it: the stated error is the scatter of repeated flights, not that of the optical axis."""
    errors, stated = [], []
    for seed in range(8):
        block = make_block(seed=seed, per_leg=15, legs=2)
        sigma = block.priors.lens_sigma.copy()
        sigma[:, 4:] = 8.0
        chosen = np.arange(0, len(block.points), 10, dtype=np.int32)
        noise = np.random.default_rng(seed + 99).normal(0, 0.05, (len(chosen), 2))
        ties = MapTies(chosen, block.points[chosen, :2] + noise, np.full(len(chosen), 0.05))
        priors = replace(block.priors, lens_sigma=sigma)
        adj = Adjustment.begin(block.start, block.tracks, priors, first_points(block.start, block.tracks))
        heights = HeightPrior(np.zeros(len(adj.points)), 1.0, 20.0, c=9.0)
        for c in (1e4, 1e4, 100.0, 100.0, 9.0, 9.0, 9.0):
            adj.step(c, heights, ties)
        for i in (7, 22):
            true, found = (cameras.camera(i, np.zeros(2)) for cameras in (block.true, adj.cameras))
            middle = np.array([0.5 * (true.lens.width - 1), 0.5 * (true.lens.height - 1)])
            errors.append(found.to_ground(middle) - true.to_ground(middle))
        said = stated_errors(adj, 9.0, heights, ties=ties, tie_c=6.0, floor_m=0.0).sigma_m
        stated.append(said / (STATED_SIGMA_FACTOR * TIED_COVARIANCE_SHARE))
    ratio = np.sqrt(np.mean(np.square(errors))) / np.sqrt(np.mean(np.square(stated)))
    assert 0.5 < ratio < 1.7


def test_a_receiver_that_drifts_east_is_not_doubted_in_the_north():
    block = make_block()
    adj = Adjustment.begin(block.start, block.tracks, block.priors, first_points(block.start, block.tracks))
    first, knots = adj.layout.offset[0] + 5, adj.layout.knots[0]
    adj.common[first : first + 2 * knots : 2] = np.linspace(-9.0, 9.0, knots)
    east, north = receiver_sigma(adj)
    assert north == pytest.approx(RECEIVER_BIAS_SIGMA_M)
    assert east == pytest.approx(np.hypot(RECEIVER_BIAS_SIGMA_M, 9.0), rel=0.1), (
        "an even drift of 18 m since the receiver was right"
    )


def test_places_are_weighed_by_axis():
    at = np.array([[0.0, 0.0], [100.0, 0.0]])
    away = np.array([[3.0, 0.0], [0.0, 3.0]])
    sigma = np.array([[0.1, 10.0], [10.0, 0.1]])
    held = np.array([100.0, 100.0, 1e-6, 1e-6])
    found = Similarity.between(at, at + away, sigma, middle=at.mean(axis=0), prior_sigma=held)
    np.testing.assert_allclose(found.values[:2], [3.0, 3.0], atol=0.01)
