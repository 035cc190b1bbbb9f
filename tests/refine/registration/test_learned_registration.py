"""Flights that edges do not find on the map: learned matching asks for them in one process, then they are settled."""

import numpy as np
import pytest

from orthoswarm.model.geo import local_origin
from orthoswarm.refine.strategy import vehicle_passes
from orthoswarm.refine.strategy.swarm_refiner import SwarmRefiner
from tests.kit.refine import refine_all, through_pickle
from tests.kit.scenes import scene_of, tiny_twin
from tests.refine.strategy.test_swarm_refiner import errors

LOST = "uav01"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return scene_of(tiny_twin(tmp_path_factory, 5))


@pytest.fixture
def blind(monkeypatch):
    """Edges do not find one vehicle, learned matching does (here: edges again); gives the vehicles it was asked for."""
    by_edges, asked = vehicle_passes.coarse_fits, []

    def first(flight, basemap, origin):
        return () if flight.frames[0].vehicle == LOST else by_edges(flight, basemap, origin)

    def second(flight, basemap, origin, _device):
        asked.append(flight.frames[0].vehicle)
        return next(by_edges(flight, basemap, origin))

    monkeypatch.setattr(vehicle_passes, "coarse_fits", first)
    monkeypatch.setattr(vehicle_passes, "learned_fit", second)
    return asked


@pytest.mark.slow
def test_a_flight_that_only_learned_matching_finds_is_mapped_as_well(scene, blind):
    vehicles, grid, basemap, truth = scene
    steps = []
    refined = refine_all(
        vehicles, basemap, grid, run=through_pickle, progress=lambda what, done, of: steps.append((what, done, of))
    )
    assert blind == [LOST]
    assert ("learned registration", 1, 1) in steps
    lost = next(s for s in refined.fine if s.vehicle == LOST)
    assert any(leg.state == "matched" for leg in lost.legs)
    assert not any("no part of this flight" in w for w in lost.warnings)
    assert np.median(errors(lost, truth, grid)) < 0.3


def test_a_flight_that_nothing_finds_is_told_of_once(scene, blind, monkeypatch):
    vehicles, grid, basemap, _ = scene
    monkeypatch.setattr(vehicle_passes, "learned_fit", lambda *_: None)
    refined = refine_all({LOST: vehicles[LOST]}, basemap, grid)
    assert sum("no part of this flight" in w for w in refined.fine[0].warnings) == 1
    assert {leg.state for leg in refined.fine[0].legs} == {"failed"}


def test_a_single_vehicle_asks_at_once(scene, blind):
    vehicles, grid, basemap, truth = scene
    origin = local_origin(grid, vehicles[LOST])
    solution = SwarmRefiner(grid.epsg, origin).refine(vehicles[LOST], [], basemap)
    assert blind == [LOST]
    assert np.median(errors(solution, truth, grid)) < 0.5
