"""Guesses of a flight's place on the map: each that tie points refuse makes the evidence for the next one weaker."""

from dataclasses import replace

import numpy as np
import pytest

from orthoswarm.model.geo import local_origin
from orthoswarm.refine.flight.relative_block import open_flight
from orthoswarm.refine.registration.absolute_orientation import confirmed
from orthoswarm.refine.registration.coarse_registration import coarse_fits
from orthoswarm.refine.strategy.vehicle_passes import adjust_without_map, read_frame
from tests.kit.scenes import scene_of, tiny_twin


@pytest.fixture(scope="module")
def flight_on_map(tmp_path_factory):
    vehicles, grid, basemap, _ = scene_of(tiny_twin(tmp_path_factory, 3))
    frames = vehicles[min(vehicles)][:12]
    origin = local_origin(grid, frames)
    flight = open_flight(frames, grid, origin, read_frame, float(np.radians(80.0)))
    surface = adjust_without_map(flight)
    return flight, surface, basemap, origin, next(coarse_fits(flight, basemap, origin))


@pytest.mark.slow
def test_refused_guesses_count_as_chances_to_agree(flight_on_map):
    flight, surface, basemap, origin, right = flight_on_map
    alone = flight.adjustment.copy()
    wrong = [replace(right, correction=right.correction + np.array([d, -d])) for d in (45.0, -60.0)]
    first = confirmed(flight, [right], basemap, origin, surface)
    flight.adjustment = alone.copy()
    third = confirmed(flight, [*wrong, right], basemap, origin, surface)
    assert third.fit is right
    ratio = np.log10(third.false_matches) - np.log10(first.false_matches)
    assert ratio == pytest.approx(np.log10(5.0), abs=1e-6)  # two sizes of patches for each refused guess, then one


def test_where_no_guess_is_confirmed_the_cameras_stay(flight_on_map):
    flight, surface, basemap, origin, right = flight_on_map
    before = flight.adjustment.cameras.position.copy()
    wrong = replace(right, correction=right.correction + np.array([50.0, 50.0]))
    assert confirmed(flight, [wrong], basemap, origin, surface) is None
    assert np.array_equal(flight.adjustment.cameras.position, before)
