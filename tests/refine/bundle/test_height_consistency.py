"""Recorded heights against the pictures, one name for unlike cameras, and the field of view's stated sigma."""

from dataclasses import replace

import numpy as np
import pytest

from orthoswarm.model.camera import fov_rad
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import WIDTH, F
from orthoswarm.refine.bundle.height_consistency import (
    UNKNOWN_HEIGHT_SIGMA_M,
    contradicted_heights,
    height_disagreement,
    log_focal_sigmas,
    offsets_without_height_prior,
    predicted_height_offset,
)
from orthoswarm.refine.flight.record_findings import height_findings
from orthoswarm.refine.flight.sparse_adjustment import solve_sparse, trusted_heights
from orthoswarm.refine.flight.sparse_start import (
    SparseStart,
    assemble,
    group_focal_lengths,
    lens_per_vehicle,
    read_photo_records,
    split_unlike_lenses,
)
from orthoswarm.refine.initial.initial_orientation import find_initial_orientation
from orthoswarm.refine.initial.pair_graph import PairGraphBuilder
from tests.kit.sparse_world import GRID, ORIGIN, World, lawnmower, make_world, without


def begin(world: World, frames) -> SparseStart:
    records = read_photo_records(frames, GRID, ORIGIN)
    tried = {(pair.first, pair.second): pair.match for pair in world.pairs}
    read = lambda frame: np.zeros((1, 1), np.uint8)  # noqa: E731
    builder = PairGraphBuilder(
        frames=frames, records=records, read_gray=read, features=list(world.features), tried=tried
    )
    start = find_initial_orientation(records, builder.pairs(), world.features)
    return assemble(builder, records, start)


def crosshatch(**options) -> World:
    one, yaw_one = lawnmower(3, 6, 30.0, 45.0, True)
    two, yaw_two = lawnmower(3, 6, 30.0, 45.0, False)
    return make_world(np.concatenate([one, two]), np.concatenate([yaw_one, yaw_two]), **options)


def solved(world: World, frames) -> tuple[Adjustment, SparseStart, list[str]]:
    start = begin(world, frames)
    adjustment = solve_sparse(start)
    return adjustment, start, height_findings(frames, start.records, start.plane, adjustment)


def recorded(frame, height_m):
    return replace(frame, fix=replace(frame.fix, height_m=height_m))


def fov_deg(adjustment: Adjustment) -> float:
    return float(np.degrees(fov_rad(float(adjustment.cameras.lens[0, F]), int(adjustment.cameras.lens[0, WIDTH]))))


def sigma_deg(adjustment: Adjustment) -> float:
    share = np.hypot(log_focal_sigmas(adjustment)[0], height_disagreement(adjustment))
    return float(np.degrees(np.sin(np.radians(fov_deg(adjustment))) * share))


def test_right_heights_are_believed_and_agree_with_the_pictures():
    world = crosshatch(tilt_deg=10.0)
    adjustment, _, found = solved(world, world.frames)
    offset, doubt = offsets_without_height_prior(adjustment)
    assert found == []
    assert not contradicted_heights(adjustment).any() and height_disagreement(adjustment) < 0.02
    assert (np.abs(offset) < 4.0 * np.hypot(doubt, 1.0)).all()


@pytest.mark.parametrize("factor", [0.6, 1.4, 2.0])
def test_wrong_heights_are_said_and_do_not_bend_the_field_of_view(factor):
    world = crosshatch(tilt_deg=10.0)
    frames = [recorded(f, f.fix.height_m * factor) for f in world.frames]
    adjustment, _, found = solved(world, frames)
    assert len(found) == 1 and "contradicts the pictures" in found[0]
    said = float(found[0].split("which say ")[1].split()[0])
    assert said == pytest.approx(60.0, rel=0.05)
    assert fov_deg(adjustment) == pytest.approx(80.0, abs=max(1.5, 2.0 * sigma_deg(adjustment)))


def test_the_height_that_an_adjustment_comes_to_is_predicted_while_it_still_has_the_prior():
    world = crosshatch(tilt_deg=10.0)
    offset_m, tolerance_m = predicted_height_offset(solved(world, world.frames)[0])
    assert abs(offset_m) < 2.0
    assert 0.15 * 55.0 < tolerance_m < 0.3 * 65.0


def test_heights_that_are_twice_too_much_are_not_believed_any_more():
    world = crosshatch(tilt_deg=10.0)
    adjustment, start, _ = solved(world, [recorded(f, 2.0 * f.fix.height_m) for f in world.frames])
    assert adjustment.priors.models[0].height_sigma == UNKNOWN_HEIGHT_SIGMA_M
    assert start.height_known.all() and not trusted_heights(adjustment, start).any()
    assert trusted_heights(*solved(world, world.frames)[:2]).all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_right_heights_of_a_noisy_record_are_not_called_wrong(seed):
    rng = np.random.default_rng(seed)
    world = crosshatch(tilt_deg=3.0, gps_sigma=5.0, seed=seed)

    def noisy(frame):
        yaw, pitch, roll = rng.normal(0.0, np.radians(2.0), 3)
        fix = frame.fix
        return replace(
            frame,
            fix=replace(
                fix, height_m=fix.height_m + rng.normal(0.0, 3.0), yaw_rad=fix.yaw_rad + yaw,
                pitch_rad=fix.pitch_rad + pitch, roll_rad=fix.roll_rad + roll,
            ),
        )  # fmt: skip

    adjustment, _, found = solved(world, [noisy(f) for f in world.frames])
    assert found == []
    assert abs(fov_deg(adjustment) - 80.0) < 3.0 * sigma_deg(adjustment) + 1.0


def test_without_heights_straight_down_the_sigma_says_that_the_field_of_view_is_not_known():
    xy, yaw = lawnmower(4, 6, 30.0, 45.0, True)
    world = make_world(xy, yaw, relief=0.2, gps_sigma=0.5)
    believed, *_ = solved(world, world.frames)
    free, _, found = solved(world, [without(f, "height_m", "altitude_m") for f in world.frames])
    assert "no height is recorded" in found[0]
    assert sigma_deg(free) > 1.1 * sigma_deg(believed)
    assert abs(fov_deg(free) - 80.0) < 3.0 * sigma_deg(free)


def test_sigmas_of_scattering_records_grow_and_of_good_ones_stay():
    world = crosshatch(tilt_deg=5.0, gps_sigma=0.8)
    rng = np.random.default_rng(4)
    rough = [recorded(f, f.fix.height_m + rng.normal(0.0, 4.0)) for f in world.frames]
    good, poor = (solve_sparse(begin(world, frames)) for frames in (world.frames, rough))
    assert np.median(good.priors.position_sigma[:, 2]) < 0.6
    assert 1.5 < np.median(poor.priors.position_sigma[:, 2]) < 8.0


def two_cameras(second_fov_deg: float):
    """Two vehicles under one camera name, each over its own half."""
    worlds = [crosshatch(tilt_deg=6.0, fov_deg=fov, seed=k) for k, fov in enumerate((80.0, second_fov_deg))]
    frames = [replace(f, vehicle=f"v{k}", camera="one name") for k, world in enumerate(worlds) for f in world.frames]
    first = len(worlds[0].frames)
    shifted = [replace(p, first=p.first + first, second=p.second + first) for p in worlds[1].pairs]
    return frames, worlds[0].features + worlds[1].features, worlds[0].pairs + shifted


@pytest.mark.parametrize(("second_fov_deg", "lenses"), [(80.0, 1), (95.0, 2)])
def test_unlike_cameras_of_one_name_get_lenses_of_their_own(second_fov_deg, lenses):
    frames, features, pairs = two_cameras(second_fov_deg)
    records = read_photo_records(frames, GRID, ORIGIN, share_lenses=True)
    assert records.lens.max() == 0
    kept = split_unlike_lenses(records, find_initial_orientation(lens_per_vehicle(records), pairs, features))
    assert int(kept.lens.max()) + 1 == lenses == len(kept.fov_hint)
    assert (kept is records) == (lenses == 1)


def test_focal_lengths_fall_into_groups_and_unsure_ones_join_the_nearest():
    log_focal = np.log([300.0, 248.0, 305.0, 400.0, 251.0])
    sigma = np.array([0.02, 0.02, 0.03, 0.03, 0.05])
    sure = np.array([True, True, True, False, True])
    group = group_focal_lengths(log_focal, sigma, sure)
    assert group[0] == group[2] == group[3] != group[1] == group[4]
