"""The first pass of a batch: one vehicle's photos that do not hold together do not cost the others theirs."""

import numpy as np
import pytest

from orthoswarm.model.errors import AdjustmentError
from orthoswarm.refine.strategy import swarm_refiner, vehicle_passes
from tests.kit.refine import refine_all
from tests.kit.scenes import scene_of, tiny_twin
from tests.refine.strategy.test_swarm_refiner import errors

BROKEN = "uav01"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return scene_of(tiny_twin(tmp_path_factory, 6))


@pytest.fixture
def opened(monkeypatch):
    """No vehicle can be followed, and matched photos that the test names do not hold together; what was asked for."""
    asked, breaks = [], []

    def singular(*_):
        raise AdjustmentError("the adjustment is singular")

    def sparse(units, *rest, **named):
        names = [unit[0].vehicle for unit in units]
        asked.append(names)
        if any(test(names) for test in breaks):
            raise AdjustmentError("the adjustment is singular")
        return open_together(units, *rest, **named)

    open_together = swarm_refiner.open_sparse_flights
    monkeypatch.setattr(vehicle_passes, "adjust_without_map", singular)
    monkeypatch.setattr(swarm_refiner, "open_sparse_flights", sparse)
    return asked, breaks


@pytest.mark.slow
def test_photos_that_do_not_hold_together_with_others_are_matched_by_vehicle(scene, opened):
    vehicles, grid, basemap, truth = scene
    asked, breaks = opened
    breaks.append(lambda names: len(names) > 1)
    refined = refine_all(vehicles, basemap, grid)
    assert asked == [list(vehicles), *([v] for v in vehicles)]
    for solution in refined.fine:
        assert {p.stage for p in solution.placed} == {"fine"}
        assert np.median(errors(solution, truth, grid)) < 0.5


@pytest.mark.slow
def test_a_vehicle_that_cannot_be_refined_stays_where_its_receiver_says(scene, opened):
    vehicles, grid, basemap, truth = scene
    _, breaks = opened
    breaks.append(lambda names: BROKEN in names)
    refined = refine_all(vehicles, basemap, grid)
    assert {s.vehicle for s in refined.fine} == {s.vehicle for s in refined.coarse} == set(vehicles)
    for solution in refined.fine:
        assert len(solution.placed) == len(vehicles[solution.vehicle])
        if solution.vehicle == BROKEN:
            assert {p.stage for p in solution.placed} == {"realtime"} and {g.state for g in solution.legs} == {"failed"}
            assert any("could not be refined (the adjustment is singular)" in w for w in solution.warnings)
        else:
            assert {p.stage for p in solution.placed} == {"fine"}
            assert np.median(errors(solution, truth, grid)) < 0.5


def test_where_no_vehicle_can_be_refined_the_reason_is_told(scene, opened):
    vehicles, grid, basemap, _ = scene
    opened[1].append(lambda names: True)
    with pytest.raises(AdjustmentError, match="singular"):
        refine_all(vehicles, basemap, grid)
