"""Vehicles without a map: their receivers differ by metres, their ground must not."""

from dataclasses import replace

import numpy as np
import pytest

from orthoswarm.model.geo import local_origin
from orthoswarm.refine.strategy import vehicle_passes
from orthoswarm.refine.strategy.swarm_refiner import SwarmRefiner
from tests.kit.refine import refine_all
from tests.kit.scenes import scene_of, tiny_twin
from tests.refine.strategy.test_swarm_refiner import true_camera

BIAS_M = 7.0


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    vehicles, grid, _, truth = scene_of(tiny_twin(tmp_path_factory, 1))
    return vehicles, grid, truth


def biased(frames, grid, east_m, sigma_m=None):
    """The frames as a receiver with a constant error would have recorded them."""
    out = []
    for frame in frames:
        east, north = grid.to_grid(frame.fix.lat_deg, frame.fix.lon_deg)
        lat, lon = grid.to_geographic([east + east_m, north])
        out.append(
            replace(frame, fix=replace(frame.fix, lat_deg=float(lat), lon_deg=float(lon), position_sigma_m=sigma_m))
        )
    return out


def error(placed, solution, ground, truth, grid):
    """Error (2,) of a place on the ground (2,) as a picture shows it, metres."""
    pixel = true_camera(truth[placed.frame.image], placed.frame, grid).project(np.array([[*ground, 0.0]]))
    return placed.camera.to_ground(pixel, solution.ground_z_m)[0] - ground


def place_errors(solution, truth, grid):
    """Error (n, 2) of the ground below each picture, metres."""
    nadirs = [true_camera(truth[p.frame.image], p.frame, grid).nadir for p in solution.placed]
    return np.array([error(p, solution, n, truth, grid) for p, n in zip(solution.placed, nadirs, strict=True)])


def jump_m(one, two, truth, grid):
    """How far a place lies apart in two vehicles' pictures: the median over the nearest pairs of pictures, metres."""
    pairs = []
    for p in one.placed:
        for q in two.placed:
            a, b = (true_camera(truth[x.frame.image], x.frame, grid).nadir for x in (p, q))
            pairs.append((float(np.hypot(*(a - b))), p, q, 0.5 * (a + b)))
    near = sorted(pairs, key=lambda pair: pair[0])[:20]
    apart = [error(p, one, g, truth, grid) - error(q, two, g, truth, grid) for _, p, q, g in near]
    return float(np.median(np.hypot(*np.array(apart).T)))


def test_ground_continues_from_vehicle_to_vehicle(scene):
    vehicles, grid, truth = scene
    first, second = vehicles
    moved = {first: vehicles[first], second: biased(vehicles[second], grid, BIAS_M)}
    plain, shifted = refine_all(vehicles, None, grid).fine, refine_all(moved, None, grid).fine
    assert jump_m(*shifted, truth, grid) < 1.0
    assert jump_m(*plain, truth, grid) < 1.0
    # both receivers place the block: it follows half of the one's bias
    middle = np.mean([place_errors(s, truth, grid).mean(0) for s in shifted], axis=0)
    before = np.mean([place_errors(s, truth, grid).mean(0) for s in plain], axis=0)
    assert middle[0] - before[0] == pytest.approx(0.5 * BIAS_M, abs=1.0)


def test_vehicles_follow_one_whose_receiver_had_corrections(scene):
    vehicles, grid, truth = scene
    first, second = vehicles
    moved = {first: biased(vehicles[first], grid, 0.0, 0.02), second: biased(vehicles[second], grid, BIAS_M)}
    alone = refine_all({first: moved[first]}, None, grid).fine[0]
    one, two = refine_all(moved, None, grid).fine
    assert jump_m(one, two, truth, grid) < 1.0
    np.testing.assert_allclose(place_errors(one, truth, grid), place_errors(alone, truth, grid), atol=0.3)


def test_a_vehicle_that_completes_later_joins_those_on_the_map_already(scene):
    vehicles, grid, truth = scene
    first, second = vehicles.values()
    refiner = SwarmRefiner(grid.epsg, local_origin(grid, first))
    one = refiner.refine(first, [], None)
    two = refiner.refine(biased(second, grid, BIAS_M), [one], None)
    assert jump_m(one, two, truth, grid) < 1.0


def test_a_vehicle_over_other_ground_stays_where_its_receiver_says(scene):
    vehicles, grid, truth = scene
    first, second = vehicles.values()
    far = biased(second, grid, 900.0)
    alone = refine_all({"far": far}, None, grid).fine[0]
    beside = refine_all({"near": first, "far": far}, None, grid).fine[1]
    np.testing.assert_allclose(place_errors(beside, truth, grid), place_errors(alone, truth, grid), atol=0.05)


def test_ground_continues_from_leg_to_leg_of_a_vehicle(scene, monkeypatch):
    """Corners are followed along the path only; without links the legs drift apart."""
    vehicles, grid, truth = scene
    name = sorted(vehicles)[0]

    def apart():
        solution = refine_all({name: vehicles[name]}, None, grid).fine[0]
        leg = solution.state.flight.leg
        legs = [replace(solution, placed=[p for p, k in zip(solution.placed, leg) if k == n]) for n in (0, 1)]
        return jump_m(*legs, truth, grid)

    linked = apart()
    monkeypatch.setattr(vehicle_passes, "link_own_legs", lambda flight, surface: surface)
    assert linked < 0.85 * apart()
