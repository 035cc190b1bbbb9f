"""Pictures of the climb after the takeoff: heights that differ from the others' and are right all the same."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from orthoswarm.model.geo import local_origin
from orthoswarm.refine.bundle.flight_records import read_records
from orthoswarm.refine.features.flow_calibration import Calibration
from orthoswarm.refine.flight.relative_block import FIRST_HEIGHT_SIGMA_M, height_prior
from orthoswarm.refine.strategy.swarm_refiner import SwarmRefiner
from tests.kit.scenes import scene_of, tiny_twin
from tests.refine.strategy.test_swarm_refiner import errors

SHARES = (0.28, 0.46, 0.74)
"""How high the climb's pictures are taken, as shares of the height that is flown."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return scene_of(tiny_twin(tmp_path_factory, 4))


def climbing(frame, folder):
    """Pictures straight below a frame's place while its vehicle climbs to it: the middle of its own, enlarged."""
    picture = cv2.imread(str(frame.path))
    middle = np.array([0.5 * (frame.width - 1), 0.5 * (frame.height - 1)])
    out = []
    for k, share in enumerate(SHARES):
        closer = np.column_stack([np.eye(2) / share, middle - middle / share])
        path = folder / f"climb{k}.jpg"
        cv2.imwrite(str(path), cv2.warpAffine(picture, closer, (frame.width, frame.height), flags=cv2.INTER_CUBIC))
        fix = replace(frame.fix, height_m=share * frame.fix.height_m)
        time_s = frame.time_s - 3.0 * (len(SHARES) - k)
        out.append(replace(frame, image=path.name, path=path, time_s=time_s, fix=fix))
    return out


@pytest.mark.slow
def test_pictures_of_the_climb_do_not_cost_a_flight_its_scale(scene, tmp_path):
    vehicles, grid, basemap, truth = scene
    flown = vehicles["uav01"]
    climb = climbing(flown[0], tmp_path)
    refiner = SwarmRefiner(grid.epsg, local_origin(grid, flown))
    without = refiner.refine(flown, [], basemap)
    solution = refiner.refine([*climb, *flown], [], basemap)
    assert solution.warnings == without.warnings
    assert solution.fov_deg == pytest.approx(without.fov_deg, abs=2.0)
    placed = {p.frame.image: p for p in solution.placed}
    heights = [placed[f.image].camera.position[2] for f in (*climb, flown[0])]
    np.testing.assert_allclose(heights[:3], np.multiply(SHARES, heights[3]), atol=3.0)
    own = replace(solution, placed=[placed[f.image] for f in flown])
    assert {p.stage for p in own.placed} == {"fine"}
    assert np.median(errors(own, truth, grid)) < 0.3


@pytest.mark.slow
def test_heights_that_leave_those_around_them_are_as_doubtful_as_they_differ(scene):
    vehicles, grid, _, _ = scene
    frames = [replace(f, fix=replace(f.fix, height_m=90.0)) for f in vehicles["uav01"]]
    for k, height_m in ((0, 20.0), (9, 400.0), (15, 93.0)):
        frames[k] = replace(frames[k], fix=replace(frames[k].fix, height_m=height_m))
    records = read_records(frames, grid, local_origin(grid, frames))
    told = Calibration(
        focal_px=200.0, height_m=90.0, yaw_offset=np.zeros(len(frames)), trusted_height=True, pairs=6, warnings=[]
    )
    height, sigma = height_prior(records, told)
    expected = np.full(len(frames), FIRST_HEIGHT_SIGMA_M)
    expected[[0, 9]] = 70.0, 310.0
    np.testing.assert_allclose(sigma, expected)
    assert height[15] == 93.0 and (np.delete(height, 15) == 90.0).all()
    height, sigma = height_prior(records, replace(told, trusted_height=False, height_m=55.0))
    assert (height == 55.0).all() and (sigma == FIRST_HEIGHT_SIGMA_M).all()
