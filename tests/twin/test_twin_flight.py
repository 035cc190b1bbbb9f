"""Flights and their records: numbers of the paper, and the kinds of error."""

from dataclasses import replace

import numpy as np
import pytest

from orthoswarm.twin.flights import FOVS_DEG, FlightDeviations, FlightPlan, Noise, fly, record, smooth_noise
from orthoswarm.twin.presets import NOISES, PRESETS, spec

PLAN = FlightPlan()
CENTER = (400000.0, 3400000.0)


def flights(plan=PLAN, motion=None, seed=3):
    return [fly(plan, motion or FlightDeviations(), CENTER, vehicle=v, seed=seed) for v in range(plan.vehicles)]


def test_presets_have_the_papers_numbers_of_pictures():
    for name in ("debris", "water", "haze"):
        plan = PRESETS[name].plan
        assert plan.vehicles * plan.photos == 1017
        assert (plan.width, plan.height, plan.height_m) == (640, 480, 150.0)
    full = PRESETS["full"].plan
    assert full.vehicles * full.photos == 32544
    area = full.vehicles * full.legs * full.leg_spacing_m * full.leg_length_m
    assert area == pytest.approx(6.35e6, rel=0.02)
    assert PRESETS["tiny"].plan.vehicles * PRESETS["tiny"].plan.photos == 40


def test_legs_are_straight_and_pictures_evenly_spaced():
    flight = flights()[0]
    step = np.hypot(*np.diff(flight.planned[:, :2], axis=0).T)
    straight = np.abs(step - PLAN.spacing_m) < 1e-6
    assert straight.sum() >= PLAN.photos - 1 - 2 * (PLAN.legs - 1)
    assert step.max() < PLAN.spacing_m + 1e-6
    path = (PLAN.legs * PLAN.leg_length_m) + (PLAN.legs - 1) * PLAN.leg_spacing_m
    assert path == pytest.approx((PLAN.photos - 1) * PLAN.spacing_m)


def test_neighbouring_vehicles_keep_one_leg_spacing_apart():
    first, second = flights()[:2]
    gap = second.planned[:, 0].min() - first.planned[:, 0].max()
    assert gap == pytest.approx(PLAN.leg_spacing_m)


def test_cameras_are_those_of_the_paper():
    fovs = {round(float(np.degrees(f.lens.fov_rad)), 6) for s in range(8) for f in flights(seed=s)}
    assert fovs <= set(FOVS_DEG)
    assert len(fovs) >= 4
    mounts = np.degrees([f.mount_rad for s in range(8) for f in flights(seed=s)])
    assert np.abs(mounts[:, 0]).max() <= 30
    assert np.abs(mounts[:, 1]).max() <= 5
    assert np.ptp(mounts[:, 0]) > 25


def test_the_recorded_angles_contain_the_mounting():
    flight = flights()[0]
    yaw = (flight.angles[:, 0] - flight.body[:, 0] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(yaw, flight.mount_rad[0], atol=1e-9)
    exact = record(flight, Noise(), 0, 3)
    np.testing.assert_array_equal(exact.angles, flight.angles)


def test_paper_noise_grows_with_the_index_and_stays_in_bounds():
    ends = []
    for seed in range(6):
        for v, flight in enumerate(flights(seed=seed)):
            error = (record(flight, NOISES["paper"], v, seed).position - flight.position)[:, :2]
            index = np.arange(PLAN.photos)[:, None]
            assert (np.abs(error) <= 1.0 + 0.1 * index + 1e-9).all()
            ends.append(np.abs(error[-1]).max())
    assert 5.0 < np.median(ends) < 34.0


def test_hard_noise_has_biases_outliers_lag_and_a_height_offset():
    flight = flights()[0]
    heard = [record(flight, NOISES["hard"], v, 9) for v in range(24)]
    yaw = np.degrees([np.mean(r.angles[:, 0] - flight.angles[:, 0]) for r in heard])
    tilt = np.degrees([np.mean(r.angles[:, 1] - flight.angles[:, 1]) for r in heard])
    assert 1.8 < yaw.std() < 4.5
    assert 0.5 < tilt.std() < 1.6
    up = np.array([r.position[:, 2] - flight.position[:, 2] for r in heard])
    assert up.mean() == pytest.approx(1.0, abs=0.05)
    assert up.std() == pytest.approx(0.15, abs=0.03)
    far = [np.hypot(*(r.position - flight.position)[:, :2].T) for r in heard]
    jumps = np.mean([np.abs(d - np.median(d)) > 4.5 + 0.1 * PLAN.photos for d in far])
    assert jumps < 0.02  # beyond drift and jitter only outliers remain
    lone = replace(NOISES["hard"], drift_per_photo_m=0.0, position_m=0.0, lag_s=(0.0, 0.0))
    share = np.mean(
        [np.hypot(*(record(flight, lone, v, 9).position - flight.position)[:, :2].T) > 4.9 for v in range(24)]
    )
    assert share == pytest.approx(0.02, abs=0.006)
    late = replace(lone, outlier_share=0.0, lag_s=(0.3, 0.3))
    behind = record(flight, late, 0, 9).position[:, :2] - flight.position[:, :2]
    along = (behind * flight.velocity).sum(1) / np.hypot(*flight.velocity.T)
    assert np.median(along) == pytest.approx(-0.3 * PLAN.speed_m_s, rel=0.1)


def test_an_autopilot_that_follows_its_receiver_records_the_plan_and_leaves_it():
    chosen = spec("haze", seed=3, noise="drift")
    away, told = [], []
    for v, flight in enumerate(flights(motion=chosen.motion)):
        told.append(np.hypot(*(record(flight, chosen.noise, v, 3).position - flight.planned)[:, :2].T).max())
        away.append(np.hypot(*(flight.position - flight.planned)[:, :2].T).max())
    assert max(told) < 1.0
    assert max(away) > 8.0


def test_the_same_seed_flies_the_same_and_another_does_not():
    a, b, c = flights(seed=1)[1], flights(seed=1)[1], flights(seed=2)[1]
    np.testing.assert_array_equal(a.position, b.position)
    assert not np.allclose(a.position, c.position)


def test_smooth_noise_has_the_stated_size_and_length():
    curve = smooth_noise(np.random.default_rng(0), 20000, 10.0, 2.0)
    assert curve.std() == pytest.approx(2.0, rel=0.1)
    assert np.corrcoef(curve[:-5], curve[5:])[0, 1] > 0.8
    assert abs(np.corrcoef(curve[:-60], curve[60:])[0, 1]) < 0.2


def test_in_wind_vehicles_point_their_nose_into_it_and_keep_their_course():
    """12 m/s at 15 m/s through the air: up to 53 degrees of crab, 3 to 27 m/s over ground."""
    calm, windy = spec("debris", seed=7), spec("debris", seed=7, noise="wind")
    assert windy.motion.wind_m_s == 12.0
    courses, noses, speeds = [], [], []
    for heading in (0.0, 0.8, 1.6, 2.4):
        plan = replace(calm.plan, heading_rad=heading)
        flight = fly(plan, replace(windy.motion, attitude_deg=0.0, jitter_deg=0.0), CENTER, vehicle=0, seed=7)
        straight = slice(5, 60)
        way, seconds = np.diff(flight.planned[straight, :2], axis=0), np.diff(flight.time_s[straight])
        courses.append(np.arctan2(way[:, 0], way[:, 1]))
        noses.append(flight.body[straight, 0][1:])
        speeds.append(np.hypot(*way.T) / seconds)
    course, nose, speed = (np.concatenate(v) for v in (courses, noses, speeds))
    over_ground = speed[:, None] * np.stack([np.sin(course), np.cos(course)], -1)
    through_air = 15.0 * np.stack([np.sin(nose), np.cos(nose)], -1)
    wind = over_ground - through_air
    assert np.hypot(*wind.T) == pytest.approx(12.0, abs=0.05)
    assert np.ptp(wind, axis=0).max() < 0.1  # one wind for all courses
    assert np.ptp(speed) > 5.0


def test_curved_legs_have_a_radius_of_fifty_metres_and_stay_near_the_leg():
    flight = fly(
        FlightPlan(spacing_m=2.0, photos=1400), spec("debris", noise="curves").motion, CENTER, vehicle=0, seed=1
    )
    path = flight.planned[:200, :2]
    turns = np.diff(np.unwrap(np.arctan2(*np.diff(path, axis=0).T)))
    assert 2.0 / np.abs(turns).mean() == pytest.approx(50.0, rel=0.05)
    assert {int(v) for v in np.sign(turns[np.abs(turns) > 0.01])} == {-1, 1}
    assert np.ptp(path[:, 0]) == pytest.approx(2 * 50.0 * (1.0 - np.cos(np.pi / 6)), abs=0.3)


def test_kinds_without_wind_and_curves_fly_as_they_did():
    flight = fly(PLAN, FlightDeviations(), CENTER, vehicle=1, seed=3)
    assert np.array_equal(flight.time_s, 1_750_000_007.0 + PLAN.spacing_m / PLAN.speed_m_s * np.arange(PLAN.photos))
