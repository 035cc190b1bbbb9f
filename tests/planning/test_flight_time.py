"""Times of a flight, against flights of real autopilots in simulation, and by their properties."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.config import DEFAULT
from orthoswarm.planning.sorties.flight_time import Motion

SLOW = (1.0, 3.0, 5.0, 10.0, 15.0)

# Points (east, north, height over takeoff, metres) and when each was passed, seconds after it left the ground.
FLIGHTS = {
    "ardupilot out low": (
        [[0, 0, 0], [0, 0, 60], [-10, -15, 60], [-10, -15, 40], [-10, -90, 40], [26, -90, 40], [26, 210, 40],
         [0, 0, 40], [0, 0, 0]],
        [0.0, 26.7, 34.0, 47.7, 58.7, 65.5, 98.5, 123.5, 175.0],
    ),
    "ardupilot out high": (
        [[0, 0, 0], [0, 0, 60], [38, 210, 60], [38, 210, 40], [38, -90, 40], [74, -90, 40], [74, -15, 40], [0, 0, 40],
         [0, 0, 0]],
        [0.0, 26.7, 53.1, 67.4, 100.9, 107.6, 117.6, 128.1, 179.7],
    ),
    "px4 short lines": (
        [[0, 0, 0], [0, 0, 45], [45, 34, 45], [45, 34, 40], [-45, 34, 40], [-45, 60, 40], [195, 60, 40], [195, 86, 40],
         [-45, 86, 40], [-45, 86, 45], [0, 0, 45], [0, 0, 0]],
        [0.0, 26.3, 37.5, 41.9, 57.4, 66.0, 97.9, 106.8, 138.1, 143.8, 159.5, 203.5],
    ),
    "px4 long lines": (
        [[0, 0, 0], [0, 0, 40], [180, -17, 40], [-60, -17, 40], [-60, 9, 40], [180, 9, 40], [180, 34, 40], [30, 34, 40],
         [0, 0, 40], [0, 0, 0]],
        [0.0, 22.5, 47.4, 81.8, 90.8, 121.6, 130.2, 151.6, 161.5, 205.2],
    ),
    "px4 triangle": (
        [[0, 0, 0], [0, 0, 65], [-55, 135, 65], [-55, 135, 60], [205, 135, 60], [0, 0, 60], [0, 0, 0]],
        [0.0, 31.1, 53.1, 57.8, 91.0, 126.8, 179.7],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FLIGHTS)
def test_times_are_those_of_real_flights(name):
    points, flown_s = FLIGHTS[name]
    autopilot = name.partition(" ")[0]
    times = Motion(autopilot=DEFAULT.times(autopilot)).times(np.array(points, float))
    allowed_s = {"ardupilot": 3.0, "px4": 7.0}[autopilot]
    assert np.abs(times - flown_s).max() < allowed_s
    assert allowed_s < DEFAULT.times(autopilot).schedule_slack_s


def lines(length, height, last):
    """Lines 25 m apart and back to the start: the way that the next flights took, with a right angle at each end."""
    ends = [(x, 20 + 25 * k) for k in range(last) for x in ((10, 10 + length) if k % 2 == 0 else (10 + length, 10))]
    return [[0, 0, 0], [0, 0, height], *([x, y, height] for x, y in ends), [0, 0, height], [0, 0, 0]]


# Autopilot, speed in m/s, points, when each was passed, and what is allowed in seconds; LAND at the end.
SPEEDS = {
    "ardupilot, 5 m/s, 17 turns": (
        "ardupilot", 5.0, lines(60, 30, 8),
        [0.0, 14.3, 21.7, 34.0, 39.6, 52.0, 57.5, 69.9, 75.5, 88.0, 93.4, 105.9, 111.4, 123.9, 129.4, 141.8, 147.4,
         159.8, 200.0, 237.4], 2.0,
    ),
    "ardupilot, 8 m/s, 17 turns": (
        "ardupilot", 8.0, lines(80, 30, 8),
        [0.0, 14.3, 21.7, 33.2, 38.8, 50.5, 56.0, 67.6, 73.2, 84.9, 90.4, 102.1, 107.6, 119.3, 124.8, 136.5, 142.1,
         153.7, 180.3, 217.9], 2.0,
    ),
    "px4, 8 m/s": ("px4", 8.0, lines(299, 30, 2), [0.0, 14.3, 25.1, 67.9, 77.7, 120.6, 132.1, 156.0], 5.0),
    "px4, 10 m/s, 600 m": ("px4", 10.0, lines(598, 40, 2), [0.0, 22.2, 33.0, 98.7, 110.3, 176.6, 187.1, 226.0], 8.0),
}  # fmt: skip


@pytest.mark.parametrize("name", SPEEDS)
def test_times_hold_at_other_speeds_however_many_turns_there_are(name):
    autopilot, speed, points, flown_s, allowed_s = SPEEDS[name]
    motion = Motion(speed, autopilot=DEFAULT.times(autopilot), lands=True)
    times = motion.times(np.array(points, float))
    assert np.abs(times - flown_s).max() < allowed_s
    assert replace(motion, lands=False).times(np.array(points, float))[-1] > times[-1] + 5.0


# Seconds after it left the ground, distance from its start and height over it, metres; and what is allowed in metres.
# The way: up, to (10, 20), a line of 300 m.
SET_OFF = {
    "ardupilot, 5 m/s": (
        5.0, 30,
        [(4.4, 0, 10), (8.4, 0, 20), (12.0, 0, 28), (16.0, 0.5, 30), (16.8, 2, 30), (17.8, 5, 30), (19.0, 10, 30)], 2.0,
    ),
    "ardupilot, 10 m/s": (
        10.0, 40,
        [(4.4, 0, 10), (8.4, 0, 20), (16.0, 0, 38), (20.0, 0.5, 40), (20.9, 2, 40), (21.9, 5, 40), (23.1, 10, 40)], 2.0,
    ),
    "px4, 5 m/s": (
        5.0, 40,
        [(3.8, 0, 2), (6.0, 0, 5), (10.0, 0, 10), (14.2, 0, 20), (20.5, 0, 38), (23.8, 1, 40), (25.0, 5, 40)], 6.0,
    ),
    "px4, 8 m/s": (
        8.0, 30,
        [(2.9, 0, 2), (5.1, 0, 5), (8.4, 0, 10), (12.2, 0, 20), (17.2, 0, 28), (20.2, 1, 30), (21.5, 5, 30)], 6.0,
    ),
    "px4, 10 m/s": (
        10.0, 40,
        [(3.3, 0, 2), (6.5, 0, 5), (9.7, 0, 10), (14.0, 0, 20), (20.9, 0, 38), (25.4, 1, 40), (27.8, 5, 40)], 6.0,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SET_OFF)
def test_a_vehicle_is_where_real_ones_were_as_it_climbs_and_sets_off(name):
    """They climb slowly at first or at last, stand still above their start, and gather speed."""
    speed, height, flown, allowed_m = SET_OFF[name]
    motion = Motion(speed, autopilot=DEFAULT.times(name.partition(",")[0]))
    places = motion.places(np.array(lines(300, height, 2), float), None, 0.1)
    for seconds, away, up in flown:
        place = places[round(seconds / 0.1)]
        assert np.hypot(*place[:2]) == pytest.approx(away, abs=allowed_m), seconds
        assert place[2] == pytest.approx(up, abs=allowed_m), seconds


def test_a_vehicle_is_where_a_real_one_was_as_it_comes_home():
    """An ArduCopter at 10 m/s from 40 m: it slows down and waits above home, and comes down slowly at last."""
    flown = [(104.0, 40.0), (110.0, 40.0), (113.0, 40.0), (116.0, 38.3), (119.0, 34.0), (128.0, 20.3), (137.0, 9.4),
             (146.0, 4.9), (155.0, 0.4)]  # fmt: skip
    places = Motion(autopilot=DEFAULT.times("ardupilot")).places(np.array(lines(299, 40, 2), float), None, 0.1)
    for seconds, up in flown:
        place = places[round(seconds / 0.1)]
        assert place[2] == pytest.approx(up, abs=2.0), seconds
        assert np.hypot(*place[:2]) < 7.0


@given(
    st.lists(st.tuples(*[st.floats(-500.0, 500.0)] * 2, st.floats(20.0, 100.0)), min_size=1, max_size=6),
    st.sampled_from(["ardupilot", "px4"]),
    st.floats(1.0, 20.0),
    st.booleans(),
    st.integers(0, 6),
)
def test_a_course_keeps_to_the_path_and_its_times(points, autopilot, speed, lands, wait_at):
    path = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 50.0), *points, (0.0, 0.0, 40.0), (0.0, 0.0, 0.0)])
    motion = Motion(speed, autopilot=DEFAULT.times(autopilot), lands=lands)
    waits = np.zeros(len(path))
    waits[min(wait_at, len(path) - 2)] = 7.0
    times, places = motion.course(path, waits)
    assert (np.diff(times) >= 0.0).all() and times[-1] == pytest.approx(motion.times(path)[-1] + 7.0)
    assert np.array_equal(places[0], path[0]) and places[-1] == pytest.approx(path[-1])
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert moved == pytest.approx(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    in_step = np.diff(times) > 1e-6
    rates = np.linalg.norm(np.diff(places, axis=0)[in_step], axis=1) / np.diff(times)[in_step]
    assert rates.max() <= 1.01 * math.hypot(speed, motion.climb_m_s)


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_turn_takes_no_more_than_a_stop_and_the_less_the_slower(autopilot):
    config = DEFAULT.times(autopilot)
    shares = [Motion(v, autopilot=config).turn_s(np.array(math.pi)) / Motion(v, autopilot=config).stop_s for v in SLOW]
    assert shares == sorted(shares) and shares[-1] <= 1.0
    assert Motion(0.5 * config.corner_m_s or 1.0, autopilot=config).turn_s(np.array(0.0)) == 0.0


@given(
    st.lists(st.tuples(*[st.floats(-500.0, 500.0)] * 2, st.floats(20.0, 100.0)), min_size=1, max_size=8),
    st.sampled_from(["ardupilot", "px4"]),
    st.floats(1.0, 20.0),
)
def test_times_grow_along_a_path_and_are_never_shorter_than_at_constant_speed(points, autopilot, speed):
    path = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 50.0), *points])
    times = Motion(speed, autopilot=DEFAULT.times(autopilot)).times(path)
    steps = np.diff(path, axis=0)
    assert (np.diff(times) >= np.hypot(steps[:, 0], steps[:, 1]) / speed - 1e-9).all()


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_landing_takes_longer_the_higher_it_begins(autopilot):
    motion = Motion(autopilot=DEFAULT.times(autopilot))
    low, high = (motion.times(np.array([[0, 0, 0], [0, 0, h], [99, 0, h], [0, 0, h], [0, 0, 0]]))[-1] for h in (30, 60))
    assert high - low == pytest.approx(30 / motion.climb_m_s + 30 / motion.descent_m_s)
    assert motion.landing_s(60.0) > 0.0


def test_without_turns_only_turns_take_no_time():
    motion = Motion()
    assert motion.without_turns().turn_s(np.array(math.pi)) == 0.0
    assert motion.without_turns().landing_s(50.0) == motion.landing_s(50.0)
