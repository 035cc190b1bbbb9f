"""The adjustment finds what a flight's records hide, and says how well."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import lapack

from orthoswarm.refine.bundle import adjustment, normal_equations
from orthoswarm.refine.bundle.adjustment import Adjustment, HeightPrior, MapTies
from orthoswarm.refine.bundle.banded_solver import factorise, solve_factored
from orthoswarm.refine.bundle.block_arrays import exp_rotation, log_rotation
from orthoswarm.refine.flight.relative_block import first_points
from tests.kit.swarm_block import make_block


def level(points, sigma=1.0):
    zero = np.zeros(points)
    return HeightPrior(zero, sigma, 20.0, c=9.0)


def solved(block, free=None, ties=None, schedule=(1e4, 1e4, 100.0, 100.0, 9.0, 9.0, 9.0)):
    adj = Adjustment.begin(block.start, block.tracks, block.priors, first_points(block.start, block.tracks), free)
    for c in schedule:
        adj.step(c, level(len(adj.points)), ties)
    return adj


def test_focal_length_distortion_and_attitude_bias_are_found():
    block = make_block()
    adj = solved(block)
    f, k1, k2 = adj.cameras.lens[0, :3]
    assert f == pytest.approx(300.0, abs=1.5)
    assert k1 == pytest.approx(-0.05, abs=0.004)
    assert k2 == pytest.approx(0.01, abs=0.004)
    bias, _, _ = adj.group_values(0)
    np.testing.assert_allclose(np.degrees(bias), np.degrees(block.bias), atol=0.1)


def test_a_wrong_compass_is_found_where_the_camera_leans_with_the_airframe():
    """The error turns the heading about the vertical, which is another axis of the camera as it leans."""
    block = make_block(lean_deg=35.0)
    turn = exp_rotation(np.radians([[0.0, 0.0, 4.0]]))[0]
    recorded = turn @ block.priors.rotation
    wrong = replace(
        block,
        priors=replace(block.priors, rotation=recorded),
        start=replace(block.start, rotation=recorded.copy()),
    )
    adj = solved(wrong)
    off = np.degrees(log_rotation(np.swapaxes(block.true.rotation, 1, 2) @ adj.cameras.rotation))
    assert np.median(np.linalg.norm(off, axis=1)) < 0.3


def test_positions_are_relatively_better_than_their_records():
    block = make_block()
    adj = solved(block)
    error = (adj.cameras.position - block.true.position)[:, :2]
    recorded = (block.priors.position - block.true.position)[:, :2]
    assert (error - error.mean(0)).std() < 0.5 * (recorded - recorded.mean(0)).std()


def test_a_late_receiver_is_noticed():
    adj = solved(make_block(lag_s=0.4))
    assert adj.group_values(0)[2] == pytest.approx(0.4, abs=0.08)


def test_ties_bring_a_drifting_flight_to_its_place():
    block = make_block()
    chosen = np.arange(0, len(block.points), 12, dtype=np.int32)
    ties = MapTies(chosen, block.points[chosen, :2], np.full(len(chosen), 0.2))
    adj = solved(block, ties=ties)
    error = np.hypot(*(adj.cameras.position - block.true.position)[:, :2].T)
    assert np.median(error) < 0.15
    assert np.hypot(*adj.tie_residual.T).max() < 1.0


def test_held_cameras_stay_where_they_are():
    block = make_block()
    free = np.arange(len(block.start)) % 3 != 0
    held = replace(block.start, position=block.true.position.copy(), rotation=block.true.rotation.copy())
    adj = Adjustment.begin(held, block.tracks, block.priors, first_points(held, block.tracks), free)
    for c in (1e4, 100.0, 9.0):
        adj.step(c, level(len(adj.points)))
    np.testing.assert_array_equal(adj.cameras.position[~free], block.true.position[~free])
    assert np.abs(adj.cameras.position[free] - block.true.position[free]).max() > 0


def test_a_copy_is_as_it_was_whatever_becomes_of_the_other():
    block = make_block(per_leg=15, legs=2)
    adj = solved(block, schedule=(1e4, 100.0))
    before = adj.copy()
    position, information = adj.cameras.position.copy(), adj.information.copy()
    adj.step(9.0, level(len(adj.points)))
    assert np.abs(adj.cameras.position - position).max() > 1e-3
    np.testing.assert_array_equal(before.cameras.position, position)
    np.testing.assert_array_equal(before.information, information)
    before.step(9.0, level(len(before.points)))
    for name in ("points", "common", "obs_weight", "point_inverse", "information"):
        np.testing.assert_array_equal(getattr(before, name), getattr(adj, name))
    np.testing.assert_array_equal(before.cameras.rotation, adj.cameras.rotation)


def test_points_without_parallax_are_not_thrown_farther_than_the_limit(monkeypatch):
    block = make_block(per_leg=15, legs=1)
    adj = Adjustment.begin(block.start, block.tracks, block.priors, first_points(block.start, block.tracks))
    before = adj.points.copy()
    adj.points[:, 2] = -400.0
    before = adj.points.copy()
    monkeypatch.setattr(adjustment, "POINT_STEP_LIMIT_M", 7.0)
    adj.step(1e4, level(len(adj.points)))
    assert np.linalg.norm(adj.points - before, axis=1).max() == pytest.approx(7.0)


def test_a_wild_observation_does_not_bend_the_block():
    block = make_block()
    uv = block.tracks.uv.copy()
    wild = np.arange(0, len(uv), 20)
    uv[wild] += 40.0
    adj = solved(replace(block, tracks=replace(block.tracks, uv=uv)))
    assert adj.cameras.lens[0, 0] == pytest.approx(300.0, abs=2.0)
    order = np.lexsort((block.tracks.camera, block.tracks.point))
    assert np.median(adj.obs_weight[np.isin(order, wild)]) < 0.01


def test_stated_covariance_is_the_scatter_of_repeated_flights():
    errors, stated = [], []
    for seed in range(12):
        block = make_block(seed=seed, per_leg=15, legs=2)
        chosen = np.arange(0, len(block.points), 10, dtype=np.int32)
        noise = np.random.default_rng(seed + 99).normal(0, 0.2, (len(chosen), 2))
        ties = MapTies(chosen, block.points[chosen, :2] + noise, np.full(len(chosen), 0.2))
        adj = solved(block, ties=ties)
        middle = np.array([7, 22])
        covariance, _, _ = adj.covariance(middle, 9.0, level(len(adj.points)), ties)
        errors.append((adj.cameras.position - block.true.position)[middle, :2])
        stated.append(np.sqrt(covariance[:, [0, 1], [0, 1]]))
    ratio = np.sqrt(np.mean(np.square(errors))) / np.sqrt(np.mean(np.square(stated)))
    assert 0.5 < ratio < 1.7


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_jacobians_are_the_derivatives(seed):
    rng = np.random.default_rng(seed)
    position, rotation = (
        rng.normal(0, 1, 3) + np.array([0, 0, 100.0]),
        exp_rotation(rng.normal(0, 0.2, (1, 3)))[0] @ np.diag([1.0, -1, -1]),
    )
    lens = np.array([300.0, -0.08, 0.02, 0.005, 1.5, -2.0, 640, 480])
    point = np.array([rng.uniform(-60, 60), rng.uniform(-60, 60), rng.uniform(-5, 20)])

    def residual(p, r, ln, x):
        out, jc, jp, jl = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3)), np.zeros((2, 6))
        assert normal_equations.linearise(p, r, ln, *x, 0.0, 0.0, out, jc, jp, jl)
        return -out, jc, jp, jl

    base, jc, jp, jl = residual(position, rotation, lens, point)
    h = 1e-6
    for a in range(3):
        e = np.eye(3)[a] * h
        np.testing.assert_allclose(
            (residual(position + e, rotation, lens, point)[0] - base) / h, jc[:, a], atol=2e-3, rtol=1e-4
        )
        np.testing.assert_allclose(
            (residual(position, rotation, lens, point + e)[0] - base) / h, jp[:, a], atol=2e-3, rtol=1e-4
        )
        turned = rotation @ exp_rotation(e[None])[0]
        np.testing.assert_allclose(
            (residual(position, turned, lens, point)[0] - base) / h, jc[:, 3 + a], atol=5e-2, rtol=1e-4
        )
    for a, column in enumerate((None, 1, 2, 3, 4, 5)):
        moved = lens.copy()
        if column is None:
            moved[0] *= np.exp(h)
        else:
            moved[column] += h
        np.testing.assert_allclose(
            (residual(position, rotation, moved, point)[0] - base) / h, jl[:, a], atol=5e-2, rtol=1e-4
        )


@given(st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3))
def test_rotation_vectors_survive(vector):
    v = np.array([vector])
    np.testing.assert_allclose(log_rotation(exp_rotation(v)), v, atol=1e-7)


@pytest.mark.parametrize(("size", "width"), [(130, 90), (900, 640), (700, 700)])
def test_a_wide_band_is_solved_in_blocks_as_lapack_solves_it(size, width):
    rng = np.random.default_rng(size)
    band = np.zeros((width, size), order="F")
    band[0] = 3.0 * np.sqrt(width)
    for k in range(1, width):
        band[k, : max(size - k, 0)] = rng.normal(size=max(size - k, 0))
    factor = factorise(band)
    right = rng.normal(size=(size, 7))
    assert np.allclose(solve_factored(factor, right), lapack.dpbtrs(factor, right, lower=1)[0], rtol=1e-9, atol=1e-12)
