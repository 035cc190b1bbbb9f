"""Start values from pairs alone: tilt, field of view, headings, scale, positions; tags may lie."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.camera import fov_rad, rotation_from_angles
from orthoswarm.refine.flight.sparse_start import photo_legs, read_photo_records, split_segments
from orthoswarm.refine.initial.heading import circular_mode
from orthoswarm.refine.initial.initial_orientation import InitialOrientation, find_initial_orientation
from orthoswarm.refine.initial.planar_similarity import level_from_nadir, rotation_of
from tests.kit.sparse_world import GRID, ORIGIN, World, lawnmower, make_world, without


def crosshatch(**options) -> World:
    one, yaw_one = lawnmower(3, 6, 30.0, 45.0, True)
    two, yaw_two = lawnmower(3, 6, 30.0, 45.0, False)
    return make_world(np.concatenate([one, two]), np.concatenate([yaw_one, yaw_two]), **options)


def begin(world: World, frames=None) -> InitialOrientation:
    return find_initial_orientation(
        read_photo_records(frames or world.frames, GRID, ORIGIN), world.pairs, world.features
    )


def yaw_error_deg(start: InitialOrientation, world: World) -> float:
    axis_up = -world.cameras.rotation[:, :, 1]
    true = np.arctan2(axis_up[:, 0], axis_up[:, 1])
    return float(np.degrees(np.median(np.abs(wrap_rad(start.yaw - true)))))


def tilt_deg(start: InitialOrientation) -> float:
    return float(np.degrees(np.median(np.arccos(start.level[:, 2, 2]))))


def found_fov_deg(start: InitialOrientation, width: int = 800) -> float:
    return float(np.degrees(fov_rad(float(start.focal[0]), width)))


def position_error(start: InitialOrientation, world: World) -> float:
    true = world.cameras.position[:, 0] + 1j * world.cameras.position[:, 1]
    return float(np.median(np.abs(start.position - true)))


@pytest.mark.parametrize("tilt", [0.0, 8.0, 16.0])
def test_tilt_fov_and_headings_come_from_pairs_without_any_tag(tilt):
    world = crosshatch(tilt_deg=tilt, seed=int(tilt))
    bare = [without(f, "height_m", "yaw_rad", "pitch_rad", "roll_rad") for f in world.frames]
    start = begin(world, bare)
    assert tilt_deg(start) == pytest.approx(tilt, abs=1.0)
    assert yaw_error_deg(start, world) < 1.0
    assert position_error(start, world) < 1.5
    if tilt > 5.0:
        assert found_fov_deg(start) == pytest.approx(80.0, abs=3.0)
        assert np.median(start.height) == pytest.approx(60.0, rel=0.08)


def test_tags_that_say_nadir_do_not_hide_a_tilt():
    world = crosshatch(tilt_deg=15.0)
    start = begin(world)
    assert tilt_deg(start) == pytest.approx(15.0, abs=1.0)


def test_headings_ignore_yaw_tags_that_flip():
    world = crosshatch()
    flipped = [
        replace(f, fix=replace(f.fix, yaw_rad=f.fix.yaw_rad + np.pi)) if 6 <= k < 12 else f
        for k, f in enumerate(world.frames)
    ]
    start = begin(world, flipped)
    assert yaw_error_deg(start, world) < 1.0
    assert start.tags[0].source == "yaw"


def test_wrong_position_records_are_told_apart_and_replaced():
    world = crosshatch(gps_sigma=0.5)
    lat = 25.0 / 111_200.0
    frames = [
        replace(f, fix=replace(f.fix, lat_deg=f.fix.lat_deg + (lat if k in (4, 21) else 0.0)))
        for k, f in enumerate(world.frames)
    ]
    start = begin(world, frames)
    assert np.flatnonzero(~start.gps_ok).tolist() == [4, 21]
    true = world.cameras.position[:, 0] + 1j * world.cameras.position[:, 1]
    assert np.abs(start.position - true)[[4, 21]].max() < 3.0


def test_impossible_heights_do_not_decide_the_field_of_view():
    world = crosshatch(tilt_deg=12.0)
    frames = [replace(f, fix=replace(f.fix, height_m=900.0)) for f in world.frames]
    start = begin(world, frames)
    assert found_fov_deg(start) == pytest.approx(80.0, abs=4.0)
    assert np.median(start.height) == pytest.approx(60.0, rel=0.1)


def test_recorded_heights_decide_it_where_pictures_cannot():
    xy, yaw = lawnmower(3, 7, 30.0, 45.0, True)
    world = make_world(xy, yaw, tilt_deg=0.0)
    start = begin(world)
    assert np.median(start.height) == pytest.approx(60.0, rel=0.12)
    assert found_fov_deg(start) == pytest.approx(80.0, abs=8.0)
    assert start.focal_sigma[0] > 0.03


def test_barrel_distortion_is_found():
    world = crosshatch(k1=-0.15, fov_deg=70.0)
    start = begin(world)
    assert start.k1[0] == pytest.approx(-0.15, abs=0.05)


def test_photos_of_two_heights_get_their_own_scale_without_height_tags():
    low, yaw = lawnmower(3, 6, 30.0, 45.0, True)
    high, yaw_high = lawnmower(3, 6, 30.0, 45.0, False)
    height = np.repeat([55.0, 70.0], 18)
    world = make_world(np.concatenate([low, high]), np.concatenate([yaw, yaw_high]), height=height)
    start = begin(world, [without(f, "height_m") for f in world.frames])
    found = start.metres / np.median(start.metres[:18])
    true = world.cameras.position[:, 2] / np.median(world.cameras.position[:18, 2])
    assert np.median(found[18:]) == pytest.approx(float(np.median(true[18:])), rel=0.05)
    assert np.abs(found / true - 1.0).max() < 0.08


def test_parts_without_overlap_are_told_apart_and_both_placed():
    one, yaw = lawnmower(2, 5, 30.0, 45.0, True)
    world = make_world(np.concatenate([one, one + 400.0]), np.concatenate([yaw, yaw]))
    start = begin(world)
    assert sorted(np.bincount(start.component).tolist()) == [10, 10]
    assert yaw_error_deg(start, world) < 2.0


def test_no_pair_at_all_leaves_the_tags():
    world = crosshatch()
    start = find_initial_orientation(read_photo_records(world.frames, GRID, ORIGIN), [], world.features)
    assert not start.yaw_known.any()
    assert yaw_error_deg(start, world) < 2.0
    assert np.isfinite(start.position).all()
    assert np.isfinite(start.height).all()


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_level_rotation_puts_the_nadir_on_the_axis(right, up):
    level = level_from_nadir(complex(right, up), 1.0)
    moved = level @ np.array([right, -up, 1.0])
    assert np.allclose(moved[:2], 0.0, atol=1e-12)
    assert np.allclose(level @ level.T, np.eye(3), atol=1e-12)


@given(st.floats(-3.1, 3.1), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
def test_level_and_yaw_compose_to_the_recorded_attitude(yaw, pitch, roll):
    attitude = rotation_from_angles(yaw, pitch - np.pi / 2, roll)
    level = rotation_of(np.array([0.0]), np.eye(3)[None])[0].T @ rotation_from_angles(0.0, pitch - np.pi / 2, roll)
    assert np.allclose(rotation_of(np.array([yaw]), level[None])[0], attitude, atol=1e-12)


@given(st.floats(-3.1, 3.1), st.integers(0, 1000))
@settings(max_examples=30)
def test_circular_mode_finds_the_majority_across_the_wrap(angle, seed):
    rng = np.random.default_rng(seed)
    angles = wrap_rad(np.concatenate([angle + rng.normal(0, 0.02, 20), rng.uniform(-np.pi, np.pi, 9)]))
    assert abs(wrap_rad(circular_mode(angles, np.ones(29)) - angle)) < 0.1


def test_segments_end_at_pauses_climbs_and_gimbal_turns_but_not_at_one_wrong_tag():
    n = 20
    time = np.arange(n) * 5.0
    time[8:] += 300.0
    height = np.full(n, 60.0)
    height[12:] = 80.0
    height[3] = 5.0
    pitch = np.full(n, -1.57)
    pitch[16:] += 0.1
    segment = split_segments(np.zeros(n, int), time, height, pitch)
    assert segment.tolist() == [0] * 8 + [1] * 4 + [2] * 4 + [3] * 4


def test_segments_of_unknown_records_are_one_per_lens():
    nan = np.full(4, np.nan)
    assert split_segments(np.array([0, 1, 0, 1]), nan, nan, nan).tolist() == [0, 1, 0, 1]


def test_legs_of_far_apart_photos_break_at_turns_only():
    xy, _ = lawnmower(3, 4, 30.0, 45.0, True)
    leg = photo_legs(xy[:, 0] + 1j * xy[:, 1], np.zeros(12, np.int32), np.arange(12.0))
    assert leg.tolist() == [0] * 4 + [1] * 4 + [2] * 4
