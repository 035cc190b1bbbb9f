"""A map of other ground is refused; a right one that only looks otherwise is used."""

from functools import partial

import numpy as np
import pytest

from benchmarks.accuracy.other_dates import other_detail
from benchmarks.robustness.wrong_maps import altered, blank, darkened, mirror_ew, mirror_ns, noise, season
from orthoswarm.model.geo import local_origin
from orthoswarm.raster.basemap import Basemap
from orthoswarm.refine.registration.block_state import WorkArea
from orthoswarm.refine.strategy.vehicle_passes import RefinerOptions, refine_alone
from tests.kit.refine import refine_all
from tests.kit.scenes import scene_of, tiny_twin
from tests.refine.strategy.test_swarm_refiner import errors


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return tiny_twin(tmp_path_factory, 3)


@pytest.fixture(scope="module")
def scene(twin):
    return scene_of(twin)


@pytest.fixture(scope="module")
def without(scene):
    """The solutions without a map."""
    vehicles, grid, *_ = scene
    return refine_all(vehicles, None, grid).fine


def with_map(twin, scene, change, folder):
    vehicles, grid, _, truth = scene
    altered(twin / "basemap.tif", folder / "map.tif", change)
    return vehicles, grid, Basemap.open(folder / "map.tif", grid.epsg), truth


@pytest.mark.parametrize("change", [mirror_ns, mirror_ew, blank, noise])
def test_nothing_takes_its_place_from_a_map_of_other_ground(twin, scene, without, change, tmp_path):
    vehicles, grid, wrong, _ = with_map(twin, scene, change, tmp_path)
    for solution, own in zip(refine_all(vehicles, wrong, grid).fine, without, strict=True):
        assert {leg.state for leg in solution.legs} == {"failed"}
        assert {p.stage for p in solution.placed} == {"coarse"}
        assert any("no part of this flight was found on the map" in w for w in solution.warnings)
        away = [p.camera.nadir - q.camera.nadir for p, q in zip(solution.placed, own.placed, strict=True)]
        assert np.abs(away).max() < 0.5


@pytest.mark.parametrize("change", [darkened, season, partial(other_detail, share=0.85)])
def test_a_right_map_that_looks_otherwise_is_used(twin, scene, change, tmp_path):
    vehicles, grid, right, truth = with_map(twin, scene, change, tmp_path)
    for solution in refine_all(vehicles, right, grid).fine:
        assert {leg.state for leg in solution.legs} == {"matched"}
        assert np.median(errors(solution, truth, grid)) < 0.5


def test_in_flight_a_map_of_other_ground_is_refused_as_well(twin, scene, tmp_path):
    vehicles, grid, wrong, _ = with_map(twin, scene, mirror_ns, tmp_path)
    frames = next(iter(vehicles.values()))
    area = WorkArea(grid.epsg, local_origin(grid, frames), wrong)
    assert not refine_alone(frames[:20], area=area, options=RefinerOptions()).on_map
