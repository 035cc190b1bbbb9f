"""Camera events against pictures: what has not arrived, what was not triggered, and events that say nothing."""

from collections.abc import Callable

import numpy as np

from orthoswarm.coverage.missing_pictures import CameraEvent, Cause, missing_by_events
from orthoswarm.coverage.view import View
from tests.kit.flown_area import FlownArea


def _views() -> list[View]:
    views = [View.of_frame(p) for p in FlownArea(vehicles=1).placed()]
    return [v for v in views if v.vehicle == views[0].vehicle]


def _events(views: list[View], keep: Callable[[int], bool] = lambda k: True, later_s: float = 0.0) -> list[CameraEvent]:
    return [
        CameraEvent(v.vehicle, 100 + k, (v.time_s or 0.0) + later_s, v.position) for k, v in enumerate(views) if keep(k)
    ]


def test_events_without_a_picture_have_not_arrived_and_are_named_by_number() -> None:
    views = _views()
    gone = range(30, 36)
    pictures, warnings = missing_by_events([v for k, v in enumerate(views) if k not in gone], _events(views))
    assert [m.view.image for m in pictures] == [f"event {100 + k}" for k in gone]
    assert {m.cause for m in pictures} == {Cause.NOT_ARRIVED} and not warnings
    assert np.allclose([m.view.position for m in pictures], [views[k].position for k in gone], atol=1.0)


def test_pictures_behind_a_dead_link_are_known_by_their_events_alone() -> None:
    views = _views()
    pictures, _ = missing_by_events(views[:40], _events(views))  # no picture follows, so there is no hole
    assert len(pictures) == len(views) - 40


def test_a_hole_without_events_was_not_triggered_whatever_the_numbers_of_the_files_say() -> None:
    views = _views()
    there = [v for k, v in enumerate(views) if k not in range(5, 9)]  # the files' numbers leave a hole
    pictures, _ = missing_by_events(there, _events(views, lambda k: k not in range(5, 9)))
    assert {m.cause for m in pictures} == {Cause.NOT_TRIGGERED} and len(pictures) == 4
    assert min(m.confidence for m in pictures) >= 0.9


def test_events_that_are_a_little_late_still_belong_to_their_pictures() -> None:
    views = _views()
    assert missing_by_events(views, _events(views, later_s=0.3))[0] == []


def test_events_of_another_time_are_not_used_with_a_warning() -> None:
    views = _views()
    pictures, warnings = missing_by_events(views, _events(views, later_s=86_400.0))
    assert pictures == [] and "do not match the times" in warnings[0]


def test_a_vehicle_of_which_no_picture_has_arrived_is_listed_by_its_events() -> None:
    views = _views()
    silent = [CameraEvent("silent", e.number, e.time_s, e.position) for e in _events(views, lambda k: k < 12)]
    pictures, _ = missing_by_events(views, [*_events(views), *silent])
    assert {(m.view.vehicle, m.cause) for m in pictures} == {("silent", Cause.NOT_ARRIVED)}
    assert [m.view.image for m in pictures] == [f"event {100 + k}" for k in range(12)]
    assert max(m.confidence for m in pictures) < 0.9  # its lens is not known
