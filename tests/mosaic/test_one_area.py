"""Positions on another continent are no part of a flight, however many they are."""

from pathlib import Path

import pytest

from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Fix, Frame, Ingest
from orthoswarm.mosaic.recorded_pose import in_one_area


def ingest(*places: tuple[float, float]) -> Ingest:
    frames = [
        Frame(image=f"{k}.jpg", path=Path("x"), vehicle="a", time_s=None, fix=Fix(*place), width=4, height=3)
        for k, place in enumerate(places)
    ]
    return Ingest(frames, [], [])


def line(count: int, lat: float, lon: float) -> list[tuple[float, float]]:
    return [(lat + 0.0002 * k, lon) for k in range(count)]


def test_the_smaller_group_is_left_out_and_told():
    found = in_one_area(ingest(*line(13, 47.4, 8.5), *line(12, 47.4, -8.5)))
    assert [f.image for f in found.frames] == [f"{k}.jpg" for k in range(13)]
    (warning,) = found.warnings
    assert "12 of a" in warning and "map each place by itself" in warning
    assert len(found.rejected) == 12 and "km from the others" in found.rejected[0].detail


@pytest.mark.parametrize("count", [1, 12])
def test_two_groups_of_one_size_are_refused_in_one_sentence(count):
    with pytest.raises(InputError, match="a lost E or W"):
        in_one_area(ingest(*line(count, 47.4, 8.5), *line(count, 47.4, -8.5)))


@pytest.mark.parametrize("places", [[(10.0, 179.9999), (10.0, -179.9999)], line(3, -0.0002, 9.0), line(200, 47.4, 8.5)])
def test_a_flight_in_one_place_is_left_as_it_is(places):
    same = ingest(*places)
    assert in_one_area(same) is same
