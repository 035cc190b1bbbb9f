"""Angles within half a turn, and the top of a curve between its samples: used everywhere, so tested once."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.model.angles import wrap_deg, wrap_rad
from orthoswarm.raster.subpixel_peak import vertex, vertices

angle = st.floats(-1e4, 1e4)


@given(angle, st.integers(-20, 20))
def test_whole_turns_do_not_matter(a, turns):
    apart = wrap_rad(wrap_rad(a + turns * 2.0 * math.pi) - wrap_rad(a))
    assert abs(apart) < 1e-9
    assert abs(wrap_deg(wrap_deg(a + 360.0 * turns) - wrap_deg(a))) < 1e-9


@given(angle)
def test_an_angle_comes_out_within_half_a_turn_and_the_same_in_both_units(a):
    assert -180.0 <= wrap_deg(a) < 180.0
    assert abs(wrap_deg(math.degrees(wrap_rad(math.radians(a))) - a)) < 1e-8


def test_arrays_are_wrapped_like_numbers_and_gaps_stay():
    a = np.array([190.0, -190.0, 180.0, -180.0, np.nan, 359.0])
    np.testing.assert_allclose(wrap_deg(a), [-170.0, 170.0, -180.0, -180.0, np.nan, -1.0])
    assert isinstance(wrap_rad(7.0), float)


@given(st.floats(-0.49, 0.49), st.floats(0.01, 10.0), st.floats(-1.0, 1.0))
def test_the_top_of_a_parabola_is_found_between_its_samples(top, bend, height):
    samples = [height - bend * (x - top) ** 2 for x in (-1.0, 0.0, 1.0)]
    assert abs(vertex(*samples) - top) < 1e-6


def test_where_nothing_bends_down_the_sample_itself_is_the_top():
    assert vertex(0.5, 0.5, 0.5) == 0.0
    assert vertex(1.0, 0.0, 1.0) == 0.0
    assert vertex(0.0, 0.2, 1.0) == 0.0
    assert vertex(0.99999, 1.0, -1.0) == vertices(*(np.array([v]) for v in (0.99999, 1.0, -1.0)))[0] <= -0.49
