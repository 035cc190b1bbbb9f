"""The ground surface: what it follows, what it ignores, and when it is taken for a plane."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.placement import Terrain
from orthoswarm.refine.strategy.vehicle_group import coarse_terrain
from orthoswarm.refine.surface.smooth_surface import FitSettings, fit_nodes
from orthoswarm.refine.surface.terrain import fit_terrain, lower_flank
from orthoswarm.refine.surface.vehicle_ground import GroundModel

BOUNDS = BoundingBox(0.0, 0.0, 900.0, 700.0)


def level(xy):
    return np.zeros(len(xy))


def relief(xy):
    return 5 * np.sin(xy[:, 0] / 110 + 1) * np.cos(xy[:, 1] / 140) + 3 * np.sin(xy.sum(1) / 200)


def step(xy):
    return np.where(xy[:, 0] > 450, 3.0, 0.0)


def town(ground, count=3000, seed=0, built=0.3, rubble=0.4):
    """Points on a ground with houses of 3 to 12 m on blocks of 35 m, rubble, noise and a few gross errors."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((30, 30), (870, 670), (count, 2))
    z = ground(xy)
    block = (xy // 35).astype(int)
    lot = (block[:, 0] * 7919 + block[:, 1] * 104729) % 1000 / 1000
    house = (lot < built) & (rng.random(count) < 0.6)
    z = z + np.where(house, 3 + 9 * (lot * 37 % 1), 0.0)
    z = z + np.where(house, 0.0, rubble * rng.exponential(1, count) * (rng.random(count) < 0.5))
    sigma = rng.choice([0.15, 0.3, 0.6, 1.2], count, p=[0.4, 0.3, 0.2, 0.1])
    gross = np.where(rng.random(count) < 0.02, rng.normal(0, 6, count), 0.0)
    return np.c_[xy, z + rng.normal(0, sigma) + gross], sigma


def probe(margin=60.0):
    east, north = np.meshgrid(np.arange(margin, 900 - margin, 9.0), np.arange(margin, 700 - margin, 9.0))
    return np.c_[east.ravel(), north.ravel()]


@pytest.mark.parametrize("seed", range(3))
def test_flat_ground_under_houses_and_rubble_stays_flat_and_low(seed):
    fit = fit_terrain(*town(level, seed=seed), BOUNDS)
    error = fit.terrain.height(probe())
    assert fit.shrink == 0.0
    assert abs(np.median(error)) < 0.1
    assert np.abs(error).max() < 0.3
    np.testing.assert_allclose(fit.prior(0.25).z, 0.25)
    assert abs(fit.ground_m) < 0.12


@pytest.mark.parametrize("seed", range(3))
def test_relief_is_followed_through_a_town(seed):
    fit = fit_terrain(*town(relief, seed=seed), BOUNDS)
    error = fit.terrain.height(probe()) - relief(probe())
    assert fit.shrink > 0.0
    assert np.median(np.abs(error)) < 0.12
    assert np.percentile(np.abs(error), 95) < 0.4
    assert abs(fit.median_m - np.median(relief(probe(30)))) < 0.4


def test_more_tolerance_of_the_hold_out_gives_a_smoother_surface():
    points, sigma = town(relief)
    kappa = [
        fit_terrain(points, sigma, BOUNDS, settings=FitSettings(held_out_se=k)).kappa for k in (0.0, 0.5, 1.0, 8.0)
    ]
    assert kappa == sorted(kappa, reverse=True)
    assert kappa[-1] < kappa[0]


def test_a_terrace_is_not_smoothed_away():
    fit = fit_terrain(*town(step), BOUNDS)
    xy = probe()
    far = np.abs(xy[:, 0] - 450) > 45
    error = (fit.terrain.height(xy) - step(xy))[far]
    assert np.percentile(np.abs(error), 95) < 0.6


def test_beyond_the_points_the_surface_goes_on_level():
    rng = np.random.default_rng(0)
    xy = rng.uniform((300, 200), (600, 500), (1500, 2))
    points = np.c_[xy, 0.1 * (xy[:, 0] - 450) + rng.normal(0, 0.1, len(xy))]
    fit = fit_terrain(points, np.full(len(xy), 0.1), BOUNDS, kappa=0.4)
    west, east = fit.terrain.height(np.array([[5.0, 350.0], [895.0, 350.0]]))
    assert -15 - 4 < west < -15 + 2  # the slope ends at -15 and +15 m and does not run on to -45 and +45
    assert 15 - 2 < east < 15 + 4
    inside = fit.terrain.height(xy) - points[:, 2]
    assert np.median(np.abs(inside)) < 0.1


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("bounds", [BoundingBox(0.0, 0.0, 900.0, 700.0), BoundingBox(0.0, 0.0, 870.0, 900.0)])
def test_the_axes_are_not_confused(axis, bounds):
    fit = fit_terrain(*town(lambda xy: 0.05 * xy[:, axis]), bounds)
    error = fit.terrain.height(probe()) - 0.05 * probe()[:, axis]
    assert np.percentile(np.abs(error), 99) < 1.0
    inside = probe(90)
    assert np.percentile(np.abs(fit.terrain.height(inside) - 0.05 * inside[:, axis]), 95) < 0.4


def test_points_outside_the_bounds_do_not_count():
    points, sigma = town(level)
    outside = np.array([[-500.0, 0.0, 50.0], [450.0, 5000.0, 50.0], [450.0, 350.0, np.nan]])
    fit = fit_terrain(np.r_[points, outside], np.r_[sigma, [0.1] * 3], BOUNDS)
    np.testing.assert_allclose(fit.terrain.z, fit_terrain(points, sigma, BOUNDS).terrain.z, atol=0.05)


def test_no_point_is_an_error_that_says_what_to_do():
    with pytest.raises(OrthoSwarmError, match="--dem"):
        fit_terrain(np.empty((0, 3)), np.empty(0), BOUNDS)


def test_few_points_give_a_level_surface():
    points = np.array([[100.0, 100.0, 1.0], [500.0, 300.0, 1.0], [800.0, 600.0, 1.2]])
    fit = fit_terrain(points, np.full(3, 0.3), BOUNDS)
    assert np.isfinite(fit.terrain.z).all()
    assert np.abs(fit.terrain.z - 1.0).max() < 0.5


def test_rendering_keeps_the_median_and_shrinks_about_it():
    fit = fit_terrain(*town(lambda xy: relief(xy) + 20.0), BOUNDS)
    shown = fit.rendering()
    assert abs(np.median(shown.height(probe())) - np.median(fit.terrain.height(probe()))) < 0.05
    assert shown.height(probe()).std() < fit.terrain.height(probe()).std()
    assert abs(np.median(fit.prior(0.0).height(probe(30)))) < 0.5


def test_a_height_prior_moved_by_the_pull_lets_the_ground_settle_at_zero():
    points, sigma = town(level, built=0.2, rubble=0.8)
    fit = fit_terrain(points, sigma, BOUNDS)
    z = points[:, 2] - fit.ground_m
    centre = np.median(z)
    for _ in range(50):  # what a robust prior of 2 m around a plane holds at the plane
        w = 1 / (1 + ((z - centre) / 2) ** 2) ** 2
        centre = (w * z).sum() / w.sum()
    assert fit.points_above_m == pytest.approx(centre, abs=0.03)


@settings(max_examples=25, deadline=None)
@given(st.floats(-200, 200), st.floats(0.02, 0.5), st.integers(0, 1000))
def test_the_lower_flank_of_a_symmetric_peak_is_its_mode(centre, noise, seed):
    z = np.random.default_rng(seed).normal(centre, noise, 4000)
    assert abs(lower_flank(z, np.full(4000, noise)) - centre) < 0.08 + 0.25 * noise


def test_the_lower_flank_stays_down_where_rubble_smears_the_mode():
    rng = np.random.default_rng(0)
    z = rng.normal(0, 0.1, 5000) + np.where(rng.random(5000) < 0.7, rng.uniform(0, 1.0, 5000), 0.0)
    assert abs(lower_flank(z, np.full(5000, 0.1))) < 0.12


def test_finer_nodes_can_be_asked_for():
    fit = fit_terrain(*town(relief), BOUNDS, settings=FitSettings(step_m=20.0))
    assert fit.terrain.step_m == 20.0
    error = fit.terrain.height(probe()) - relief(probe())
    assert np.percentile(np.abs(error), 95) < 0.4


def test_large_areas_are_solved_in_tiles_without_seams():
    rng = np.random.default_rng(0)
    xy = rng.uniform((20, 20), (2180, 880), (9000, 2))
    points = np.c_[xy, relief(xy) + rng.normal(0, 0.2, len(xy))]
    sigma, bounds = np.full(len(xy), 0.2), BoundingBox(0.0, 0.0, 2200.0, 900.0)
    tiled = fit_nodes(points, sigma, bounds, 0.8, FitSettings())
    whole = fit_nodes(points, sigma, bounds, 0.8, FitSettings(), tile_nodes=1000)
    assert tiled is not None and whole is not None
    assert np.abs(tiled.z - whole.z).max() < 0.1
    np.testing.assert_array_equal(tiled.support, whole.support)


def test_tiles_without_points_go_on_from_their_neighbours():
    rng = np.random.default_rng(0)
    xy = rng.uniform((20, 20), (600, 600), (2000, 2))
    fit = fit_terrain(np.c_[xy, np.full(len(xy), 5.0)], np.full(len(xy), 0.2), BoundingBox(0.0, 0.0, 4000.0, 900.0))
    np.testing.assert_allclose(fit.terrain.z, 5.0, atol=0.2)


def test_the_ground_is_the_lowest_of_several_modes():
    rng = np.random.default_rng(0)
    z = np.r_[rng.normal(0, 0.15, 1000), rng.normal(1.3, 0.12, 1300), rng.uniform(3, 12, 500), rng.normal(-2, 1, 40)]
    assert abs(lower_flank(z, np.full(len(z), 0.15))) < 0.12


def test_before_the_map_each_place_has_the_ground_of_the_nearest_camera():
    def vehicle(east, ground):
        surface = GroundModel(fit=None if ground is None else SimpleNamespace(rendering=lambda: ground))
        path = np.column_stack([np.full(9, east), np.linspace(0.0, 400.0, 9), np.full(9, 100.0)])
        return SimpleNamespace(coarse=SimpleNamespace(position=path), coarse_surface=surface)

    slope = Terrain(-200.0, -200.0, 30.0, np.tile(np.arange(40, dtype=np.float32), (40, 1)))
    both = coarse_terrain([vehicle(0.0, slope), vehicle(300.0, Terrain.flat(-2.0)), vehicle(600.0, None)])
    assert both.step_m == 30.0
    at = np.array([[10.0, 50.0], [100.0, 390.0], [250.0, 10.0], [380.0, 200.0], [600.0, 200.0]])
    np.testing.assert_allclose(both.height(at), [7.0, 10.0, -2.0, -2.0, 0.0], atol=1e-3)
    assert coarse_terrain([vehicle(0.0, None)]) is None
