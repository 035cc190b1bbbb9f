"""Times of a flight, against flights of real autopilots in simulation, and by their properties."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.planning.sorties.flight_time import Motion, autopilot_config

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
    times = Motion(autopilot=autopilot_config(autopilot)).times(np.array(points, float))
    allowed_s = {"ardupilot": 3.0, "px4": 7.0}[autopilot]
    assert np.abs(times - flown_s).max() < allowed_s
    assert allowed_s < autopilot_config(autopilot).schedule_slack_s


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
    motion = Motion(speed, autopilot=autopilot_config(autopilot), lands=True)
    times = motion.times(np.array(points, float))
    assert np.abs(times - flown_s).max() < allowed_s
    assert replace(motion, lands=False).times(np.array(points, float))[-1] > times[-1] + 5.0


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_turn_takes_no_more_than_a_stop_and_the_less_the_slower(autopilot):
    config = autopilot_config(autopilot)
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
    times = Motion(speed, autopilot=autopilot_config(autopilot)).times(path)
    steps = np.diff(path, axis=0)
    assert (np.diff(times) >= np.hypot(steps[:, 0], steps[:, 1]) / speed - 1e-9).all()


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_landing_takes_longer_the_higher_it_begins(autopilot):
    motion = Motion(autopilot=autopilot_config(autopilot))
    low, high = (motion.times(np.array([[0, 0, 0], [0, 0, h], [99, 0, h], [0, 0, h], [0, 0, 0]]))[-1] for h in (30, 60))
    assert high - low == pytest.approx(30 / motion.climb_m_s + 30 / motion.descent_m_s)
    assert motion.landing_s(60.0) > 0.0


def test_without_turns_only_turns_take_no_time():
    motion = Motion()
    assert motion.without_turns().turn_s(np.array(math.pi)) == 0.0
    assert motion.without_turns().landing_s(50.0) == motion.landing_s(50.0)
