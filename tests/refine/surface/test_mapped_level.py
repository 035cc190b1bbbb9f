"""The level that heights and homographies are stated on: that of the open ground, counted from takeoff."""

from dataclasses import replace

import numpy as np
import pytest

from orthoswarm.evaluation.true_cameras import read_truth
from orthoswarm.export.product_files import frame_row
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.extent import from_takeoff, solved_level
from orthoswarm.refine.surface.vehicle_ground import mapped_ground_level
from tests.kit.refine import refine_all
from tests.kit.scenes import scene_of, tiny_twin


def rubble(rng, xy, ground):
    """Heights of points half of which lie on things of up to 2 m."""
    raised = rng.uniform(0.0, 2.0, len(xy)) * (rng.random(len(xy)) < 0.5)
    return np.column_stack([xy, ground(xy) + raised + rng.normal(0.0, 0.05, len(xy))])


@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_the_level_is_that_of_the_open_ground_below_the_cameras(slope):
    rng = np.random.default_rng(1)

    def ground(xy):
        return slope * np.asarray(xy)[:, 0] - 0.4

    camera = np.column_stack([rng.uniform(-100, 100, (60, 2)), np.full(60, 90.0)])
    nodes = np.stack(np.meshgrid(np.arange(-300.0, 1000.0, 10.0), np.arange(-300.0, 310.0, 10.0)), -1)
    fitted = ground(nodes.reshape(-1, 2)).reshape(nodes.shape[:2]) + 0.3  # drawn through rubble
    terrain = Terrain(-300.0, -300.0, 10.0, fitted.astype(np.float32))
    points = rubble(rng, rng.uniform(-120, 120, (3000, 2)), ground)
    assert mapped_ground_level(terrain, camera, [points[:1000], points[1000:]]) == pytest.approx(-0.4, abs=0.1)
    assert mapped_ground_level(terrain, camera, []) == pytest.approx(-0.1, abs=0.1), "no point tells of rubble"
    assert mapped_ground_level(None, camera, [points]) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(("relief_m", "bar_m"), [(0.0, 0.25), (8.0, 0.4)])
def test_homographies_are_right_on_the_stated_plane(tmp_path_factory, relief_m, bar_m):
    """Over the whole picture, against the true cameras and the plane of that height over takeoff."""
    folder = tiny_twin(tmp_path_factory, 3, relief_m=relief_m)
    vehicles, grid, basemap, _ = scene_of(folder)
    true = read_truth(folder / "truth" / "frames.csv")
    refined = refine_all(vehicles, basemap, grid)
    placed = [p for s in refined.fine for p in s.placed]
    stated, level = from_takeoff(placed, solved_level(refined.fine), refined.terrain)
    square = []
    for p in stated:
        camera = true[p.frame.image][2]
        share = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 7)), -1).reshape(-1, 2)
        pixels = share * [camera.lens.width - 1, camera.lens.height - 1]
        mapped = np.column_stack([pixels, np.ones(len(pixels))]) @ np.array(frame_row(p, grid, level)["homography"]).T
        square.append(((mapped[:, :2] / mapped[:, 2:] - camera.to_ground(pixels, level)) ** 2).sum(1).mean())
    assert np.sqrt(np.mean(square)) < bar_m


def test_heights_count_from_takeoff_and_no_homography_moves(tmp_path_factory):
    vehicles, grid, _, _ = scene_of(tiny_twin(tmp_path_factory, 3))
    placed = [p for s in refine_all(vehicles, None, grid).coarse for p in s.placed]
    recorded = np.median([p.camera.position[2] - p.frame.fix.height_m for p in placed])
    ramp = Terrain(placed[0].camera.nadir[0] - 1e3, placed[0].camera.nadir[1] - 1e3, 2e3, np.zeros((2, 2), np.float32))
    hilly = Terrain(ramp.west, ramp.south, 2e3, np.array([[-400, 400], [-400, 400]], np.float32))
    moved, level = from_takeoff(placed, -0.43, ramp)
    assert level == pytest.approx(0.0, abs=0.05), "level ground: the vehicles took off from it"
    for before, after in zip(placed, moved, strict=True):
        np.testing.assert_allclose(after.camera.homography(level), before.camera.homography(-0.43), rtol=1e-12)
    moved, level = from_takeoff(placed, 1.5, hilly)
    assert level == pytest.approx(1.5 - recorded, abs=0.05), "hills: what was recorded tells where they took off"
    up = np.array([0.0, 0.0, 6.0])  # the refiner's zero lies 6 m below the place of takeoff
    raised = [replace(p, camera=replace(p.camera, position=p.camera.position + up)) for p in placed]
    moved, level = from_takeoff(raised, 7.5, hilly)
    assert level == pytest.approx(1.5 - recorded, abs=0.05), "hills: it may lie anywhere in the relief"
    assert from_takeoff(raised, 7.5, ramp) == (raised, 7.5), "level ground: such a zero is a gross error"
    assert from_takeoff(placed, -0.4, None) == (placed, -0.4)
    assert from_takeoff([], 0.0, ramp) == ([], 0.0)
