"""Maps of 7 m a pixel: vehicles are shifted onto them as one block, with a sigma; other ground is refused."""

import numpy as np
import pytest

from benchmarks.robustness.wrong_maps import altered, averaged, mirror_ew, mirror_ns, right
from orthoswarm.model.geo import local_origin
from orthoswarm.raster.basemap import Basemap
from orthoswarm.refine.strategy.swarm_refiner import SwarmRefiner
from tests.kit.refine import refine_all
from tests.kit.scenes import scene_of, tiny_twin
from tests.refine.strategy.test_joined_vehicles import biased, jump_m, place_errors

BIAS_M = 12.0


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return tiny_twin(tmp_path_factory, 3)


@pytest.fixture(scope="module")
def scene(twin):
    vehicles, grid, _, truth = scene_of(twin)
    return {v: biased(frames, grid, BIAS_M) for v, frames in vehicles.items()}, grid, truth


def on_map(twin, scene, folder, gsd_m, change=right, vehicles=None):
    """Solutions of the set, both receivers of which are off by as much, on a map of a ground pixel."""
    averaged(twin / "basemap.tif", folder / "averaged.tif", gsd_m)
    altered(folder / "averaged.tif", folder / "map.tif", change)
    given, grid, _ = scene
    return refine_all(vehicles or given, Basemap.open(folder / "map.tif", grid.epsg), grid).fine


@pytest.mark.slow
def test_all_vehicles_are_shifted_onto_a_coarse_map_together(twin, scene, tmp_path):
    _, grid, truth = scene
    solutions = on_map(twin, scene, tmp_path, 7.0)
    error = np.concatenate([place_errors(s, truth, grid) for s in solutions])
    sigma = np.array([p.sigma_m for s in solutions for p in s.placed])
    assert np.hypot(*error.mean(axis=0)) < 3.0
    assert 0.5 < np.median(sigma) < 3.0
    assert jump_m(*solutions, truth, grid) < 2.0
    assert {leg.state for s in solutions for leg in s.legs} == {"matched"}
    assert {p.stage for s in solutions for p in s.placed} == {"fine"}
    assert all(any("shifted onto it as a whole" in w for w in s.warnings) for s in solutions)
    assert all(0.0 <= s.false_matches < 1e-4 for s in solutions)


@pytest.mark.parametrize("change", [mirror_ns, mirror_ew])
def test_a_coarse_map_of_other_ground_is_refused(twin, scene, tmp_path, change):
    _, grid, truth = scene
    for solution in on_map(twin, scene, tmp_path, 7.0, change):
        assert {leg.state for leg in solution.legs} == {"failed"}
        assert {p.stage for p in solution.placed} == {"coarse"}
        assert place_errors(solution, truth, grid).mean(axis=0)[0] == pytest.approx(BIAS_M, abs=4.0)


def test_receivers_with_corrections_are_not_moved_onto_a_coarse_map(twin, scene, tmp_path):
    given, grid, truth = scene
    corrected = {v: biased(frames, grid, -BIAS_M, 0.02) for v, frames in given.items()}
    for solution in on_map(twin, scene, tmp_path, 7.0, vehicles=corrected):
        assert {p.stage for p in solution.placed} == {"coarse"}
        assert np.hypot(*place_errors(solution, truth, grid).mean(axis=0)) < 2.0
        assert not any("map" in warning for warning in solution.warnings)


def test_finer_maps_place_each_picture(twin, scene, tmp_path):
    _, grid, truth = scene
    for solution in on_map(twin, scene, tmp_path, 2.0):
        assert np.median(np.hypot(*place_errors(solution, truth, grid).T)) < 0.7
        assert not any("as a whole" in warning for warning in solution.warnings)


def test_one_vehicle_is_shifted_and_the_next_joins_it(twin, scene, tmp_path):
    given, grid, truth = scene
    averaged(twin / "basemap.tif", tmp_path / "map.tif", 7.0)
    basemap = Basemap.open(tmp_path / "map.tif", grid.epsg)
    first, second = given.values()
    refiner = SwarmRefiner(grid.epsg, local_origin(grid, first))
    one = refiner.refine(first, [], basemap)
    two = refiner.refine(second, [one], basemap)
    for solution in (one, two):
        assert {p.stage for p in solution.placed} == {"fine"}
        assert np.hypot(*place_errors(solution, truth, grid).mean(axis=0)) < 5.0
    assert jump_m(one, two, truth, grid) < 2.0
    again = refiner.again(one, [two], basemap)
    assert jump_m(again, two, truth, grid) < 2.0
    np.testing.assert_allclose(place_errors(again, truth, grid), place_errors(one, truth, grid), atol=1.0)
