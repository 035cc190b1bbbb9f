"""Ground between the tracks of a flight, and what stands high above it, on rendered scenes of known shape."""

from types import SimpleNamespace

import numpy as np
import pytest

from orthoswarm.refine.surface.ground_densification import HIGH_FROM_M, HIGH_TO_SHARE, dense_points, spaced_pictures
from orthoswarm.refine.surface.vehicle_ground import GroundModel
from tests.kit.draped import HEIGHT, WIDTH, Pictures, rig_of

ROOF_M = 16.0


def hall(xy):
    """A roof of 70 m by 80 m whose walls slope a little, on level ground."""
    away = np.maximum(np.abs(xy[..., 0] - 30.0) - 35.0, np.abs(xy[..., 1] - 100.0) - 40.0)
    return ROOF_M * np.clip(-away / 6.0, 0.0, 1.0)


def flight_over(surface):
    """What `dense_points` asks of a flight: two legs at 100 m, their pictures rendered."""
    cameras, leg = rig_of()
    pictures = SimpleNamespace(gray=Pictures(cameras, surface), size=(WIDTH, HEIGHT))
    return SimpleNamespace(cameras=lambda: cameras, leg=leg, pictures=pictures)


@pytest.fixture(scope="module")
def found():
    return dense_points(flight_over(hall), GroundModel())


def test_a_roof_higher_than_the_ground_is_searched_is_found_apart_from_the_ground(found):
    points, sigma, high = found
    assert len(points) == len(sigma) > 100
    on_roof = hall(high[:, :2]) > 0.9 * ROOF_M
    assert on_roof.sum() >= 20
    assert np.median(np.abs(high[on_roof, 2] - ROOF_M)) < 0.5
    assert (np.abs(high[on_roof, 2] - ROOF_M) < 2.0).mean() > 0.9


def test_ground_beside_the_roof_stays_ground(found):
    points, _, high = found
    level = hall(points[:, :2]) == 0.0
    assert np.median(np.abs(points[level, 2])) < 0.2
    assert len(high[hall(high[:, :2]) == 0.0]) < 0.05 * level.sum()


def test_nothing_high_is_seen_over_level_ground():
    points, _, high = dense_points(flight_over(lambda xy: np.zeros(xy.shape[:-1])), GroundModel())
    assert len(high) < 0.02 * len(points)


def test_low_flights_search_nothing_between_the_two_ranges():
    cameras, leg = rig_of(height=0.9 * HIGH_FROM_M / HIGH_TO_SHARE)
    gray = Pictures(cameras, lambda xy: np.zeros(xy.shape[:-1]))
    flight = SimpleNamespace(
        cameras=lambda: cameras, leg=leg, pictures=SimpleNamespace(gray=gray, size=(WIDTH, HEIGHT))
    )
    assert len(dense_points(flight, GroundModel())[2]) == 0


def test_spaced_pictures_are_those_between_legs_and_some_of_each_leg():
    cameras, leg = rig_of(per_leg=24, spacing=5.0)
    leg = leg.copy()
    leg[[0, 24]] = -1
    some = spaced_pictures(SimpleNamespace(cameras=lambda: cameras, leg=leg), GroundModel())
    assert some[[0, 24]].all()
    for k in range(2):
        along = np.sort(cameras.position[some & (leg == k), 1])
        assert 5 <= len(along) < 14
        gaps = np.sort(np.diff(along))
        assert gaps[1] > 9.0 and gaps[-1] < 17.0  # the last picture of a leg may be near the one before it
