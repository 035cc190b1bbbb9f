"""Refinement over a ground with relief whose height model is given: right, in part, of another place."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import rasterio

from orthoswarm.model.geo import local_origin
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.extent import placed_bounds
from orthoswarm.mosaic.recorded_pose import recorded_cameras
from orthoswarm.raster.height_model import HeightModel
from orthoswarm.refine.strategy.swarm_refiner import RefinerOptions, SwarmRefiner
from tests.kit.refine import refine_all, through_pickle
from tests.kit.scenes import scene_of, tiny_twin
from tests.refine.strategy.test_swarm_refiner import errors


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return tiny_twin(tmp_path_factory, 3, relief_m=8.0)


@pytest.fixture(scope="module")
def scene(twin):
    with rasterio.open(twin / "truth" / "dtm.tif") as dataset:
        heights, transform = dataset.read(1), dataset.transform
    return *scene_of(twin), (heights, transform)


def options(folder, scene, heights):
    """The refiner's options with a DEM of these heights (NaN for none), 37 m over the twin's own datum."""
    vehicles, grid, _, _, (_, transform) = scene
    path = folder / "dem.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=heights.shape[1], height=heights.shape[0], count=1, dtype="float32",
        crs=f"EPSG:{grid.epsg}", transform=transform, nodata=float("nan"),
    ) as dataset:  # fmt: skip
        dataset.write((heights + 37.0).astype(np.float32), 1)
    placed = recorded_cameras([f for frames in vehicles.values() for f in frames], grid).placed
    at = [p.camera.position for p in placed]
    return RefinerOptions(dem=HeightModel.open(path, grid.epsg, placed_bounds(placed, 0.0, 0.0), at))


def off_ground(refined, scene, terrain=None):
    """The bare ground under the pictures (or another) less the true one, about its median."""
    heights, transform = scene[4]
    xy = np.concatenate([[p.camera.nadir for p in s.placed] for s in refined.fine])
    column, row = (np.floor(v).astype(int) for v in ~transform * (xy[:, 0], xy[:, 1]))
    error = (terrain or refined.terrain.bare_ground()).height(xy) - heights[row, column]
    return error - np.median(error)


def all_errors(refined, scene):
    return np.concatenate([errors(s, scene[3], scene[1]) for s in refined.fine])


@pytest.fixture(scope="module")
def without(scene):
    vehicles, grid, basemap, _, _ = scene
    return refine_all(vehicles, basemap, grid)


@pytest.mark.slow
def test_a_right_model_gives_the_ground_and_the_map_is_as_good(scene, without, tmp_path):
    vehicles, grid, basemap, _, (heights, _) = scene
    given = options(tmp_path, scene, heights)
    refined = refine_all(vehicles, basemap, grid, options=given)
    assert refined.warnings == []
    assert np.abs(off_ground(refined, scene)).max() < 0.3
    assert np.percentile(np.abs(off_ground(refined, scene)), 90) < np.percentile(np.abs(off_ground(without, scene)), 90)
    assert np.median(all_errors(refined, scene)) < np.median(all_errors(without, scene)) + 0.05
    assert all(leg.state == "matched" for s in refined.fine for leg in s.legs)
    processes = refine_all(vehicles, basemap, grid, options=given, run=through_pickle)
    for one, other in zip(refined.fine, processes.fine, strict=True):
        assert len(pickle.dumps(one.state.surface)) < 60_000  # no raster travels
        for p, q in zip(one.placed, other.placed, strict=True):
            np.testing.assert_array_equal(p.camera.position, q.camera.position)
    np.testing.assert_array_equal(refined.terrain.z, processes.terrain.z)


@pytest.mark.slow
def test_the_ground_is_known_before_the_map_is_used(scene, without):
    (ground,) = {id(s.terrain): s.terrain for s in without.coarse}.values()
    for solution in without.fine:  # each vehicle on a level of its own
        one = replace(without, fine=[solution])
        flat = np.percentile(np.abs(off_ground(one, scene, Terrain.flat())), 90)
        assert flat > 1.0
        assert np.percentile(np.abs(off_ground(one, scene, ground)), 90) < 0.5 * flat


@pytest.mark.slow
def test_half_a_model_is_used_where_it_is(scene, without, tmp_path):
    vehicles, grid, basemap, _, (heights, _) = scene
    half = heights.copy()
    half[:, : heights.shape[1] // 2] = np.nan
    refined = refine_all(vehicles, basemap, grid, options=options(tmp_path, scene, half))
    assert any("elsewhere the ground is found from the pictures" in w for w in refined.warnings)
    assert np.median(all_errors(refined, scene)) < np.median(all_errors(without, scene)) + 0.05
    with_it, without_it = (
        [np.percentile(np.abs(off_ground(replace(r, fine=[s]), scene)), 90) for s in r.fine] for r in (refined, without)
    )  # of each vehicle about its own level: that of points and that of a model may differ by some decimetres
    assert max(with_it) < 0.1 * np.percentile(np.abs(off_ground(without, scene, Terrain.flat())), 90)
    assert min(with_it) < 0.7 * min(without_it)
    assert np.abs(off_ground(refined, scene)).max() < 1.0


def test_a_model_of_another_place_is_told_and_does_no_harm(scene, without, tmp_path):
    vehicles, grid, basemap, _, (heights, _) = scene
    refined = refine_all(vehicles, basemap, grid, options=options(tmp_path, scene, 3.0 * heights[::-1, ::-1]))
    assert any("contradicts" in w for w in refined.warnings)
    assert np.median(all_errors(refined, scene)) < np.median(all_errors(without, scene)) + 0.1
    assert np.abs(off_ground(refined, scene)).max() < np.abs(off_ground(without, scene)).max() + 0.5


def test_a_single_vehicle_is_refined_over_a_model_too(scene, tmp_path):
    vehicles, grid, basemap, truth, (heights, _) = scene
    origin = local_origin(grid, (f for frames in vehicles.values() for f in frames))
    name, frames = next(iter(vehicles.items()))
    refiner = SwarmRefiner(grid.epsg, origin, options(tmp_path, scene, heights))
    solution = refiner.refine(frames, [], basemap)
    assert solution.vehicle == name and np.median(errors(solution, truth, grid)) < 0.4
