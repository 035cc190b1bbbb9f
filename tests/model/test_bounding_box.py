"""Bounds: what contains, meets and surrounds what, by points that are known to lie inside."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.model.bounding_box import BoundingBox

whole_metres = st.integers(-50, 50)
boxes = st.builds(
    lambda west, south, width, height: BoundingBox(west, south, west + width, south + height),
    whole_metres, whole_metres, st.integers(1, 40), st.integers(1, 40),
)  # fmt: skip


def cells(box):
    """The square metres of a box, by their lower left corners."""
    return {(x, y) for x in range(int(box.west), int(box.east)) for y in range(int(box.south), int(box.north))}


@given(boxes, boxes)
def test_boxes_behave_as_the_sets_of_their_square_metres(a, b):
    shared = a.intersection(b)
    assert cells(shared) == cells(a) & cells(b)
    assert shared.empty == (not cells(a) & cells(b)) == (not a.overlaps(b))
    assert a.contains(b) == (cells(b) <= cells(a))
    both = BoundingBox.around([a, b])
    assert both.contains(a) and both.contains(b)
    assert both == BoundingBox.around(np.array([a, b]))


@given(boxes, boxes, st.integers(1, 30))
def test_a_box_reaches_another_when_grown_by_the_gap(a, b, margin):
    assert a.gap_m(b) == b.gap_m(a)
    assert a.grown(margin).overlaps(b) == (a.gap_m(b) < margin)


def test_size_centre_and_shift():
    box = BoundingBox(10.0, 20.0, 40.0, 30.0)
    assert (box.width, box.height, box.center) == (30.0, 10.0, (25.0, 25.0))
    assert box.moved(5.0, -20.0) == BoundingBox(15.0, 0.0, 45.0, 10.0)
    points = np.array([[[12.0, 9.0], [3.0, 4.0]], [[5.0, 30.0], [8.0, 8.0]]])
    assert BoundingBox.around_points(points, margin_m=2.0) == BoundingBox(1.0, 2.0, 14.0, 32.0)


def test_a_box_goes_to_json_as_its_four_numbers():
    box = BoundingBox(1.0, 2.0, 3.0, 4.0)
    assert BoundingBox(*json.loads(json.dumps(box))) == box


def test_nothing_has_no_box():
    with pytest.raises(ValueError, match="zero-size"):
        BoundingBox.around([])
