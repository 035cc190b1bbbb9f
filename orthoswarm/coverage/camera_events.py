"""Comparison of camera events with pictures.

A camera event without a picture: the picture has not arrived (it is on the card, or the link is lost). A hole in a leg
without a camera event: the camera was not triggered.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.coverage.missing_pictures import Cause, Exposure, MissingPicture, missing_pictures
from orthoswarm.coverage.view import View

Array = NDArray[np.float64]

_MATCH_SHARE: Final = 0.45  # a picture's event is within this share of the usual time between them (below a half)
_LEAST_MATCHED: Final = 0.5  # share of a vehicle's pictures that must have an event: else its clocks disagree
_SURE: Final = 0.95  # confidence of a cause that camera events show
_BORROWED_LENS: Final = 0.6  # confidence in what a vehicle has seen of which no picture has arrived


@dataclass(frozen=True, slots=True)
class CameraEvent:
    """An exposure as a vehicle reported it.

    Attributes:
        vehicle: its id. number: as counted by the vehicle. time_s: UTC epoch seconds.
        position: float64 (3,), east, north in the grid of the views, and a height that is not used (vehicles count it
            from another level than maps do); None where the event has none.
    """

    vehicle: str
    number: int
    time_s: float
    position: Array | None = None


@dataclass(frozen=True, slots=True)
class Missing:
    """Missing pictures.

    Attributes:
        pictures: missing pictures; those that have not arrived are named by their event's number.
        warnings: reasons why events could not be used.
    """

    pictures: list[MissingPicture]
    warnings: list[str]


def missing_by_events(
    views: Sequence[View], events: Iterable[CameraEvent], rejected: Iterable[Exposure] = ()
) -> Missing:
    """Missing pictures of all vehicles; for vehicles without events only from holes in their legs.

    Args:
        views: pictures that were placed. events: in any order. rejected: files that could not be used.
    """
    lost = list(rejected)
    by_vehicle: dict[str, list[CameraEvent]] = defaultdict(list)
    for event in events:
        by_vehicle[event.vehicle].append(event)
    rows: dict[str, list[View]] = defaultdict(list)
    for view in views:
        rows[view.vehicle].append(view)
    found: list[MissingPicture] = []
    warnings: list[str] = []
    for vehicle, row in rows.items():
        own = sorted(by_vehicle[vehicle], key=lambda e: e.time_s)
        files = [e for e in lost if e.vehicle == vehicle]
        timed = sorted((v for v in row if v.time_s is not None), key=lambda v: v.time_s or 0.0)
        if len(own) < 2 or not timed:
            found += missing_pictures(row, files)
            continue
        without = _without_picture(own, np.array([*(v.time_s for v in timed), *(e.time_s for e in files)], float))
        if len(own) - len(without) < _LEAST_MATCHED * len(timed):
            warnings.append(f"the camera events of {vehicle} do not match the times of its pictures and are not used")
            found += missing_pictures(row, files)
            continue
        waiting = [_not_arrived(event, timed) for event in without]
        found += [picture for picture in waiting if picture is not None]
        matched = [replace(p.view, time_s=e.time_s) for p, e in zip(waiting, without, strict=True) if p is not None]
        holes = missing_pictures([*timed, *matched], files)
        found += [
            h if h.cause is Cause.REJECTED else replace(h, cause=Cause.NOT_TRIGGERED, confidence=_SURE) for h in holes
        ]
    for vehicle in sorted(set(by_vehicle) - set(rows)):
        found += _none_arrived(vehicle, by_vehicle[vehicle], views)
    return Missing(found, warnings)


def _none_arrived(vehicle: str, events: Sequence[CameraEvent], views: Sequence[View]) -> list[MissingPicture]:
    """The pictures of a vehicle of which none has arrived, with the camera of the nearest other vehicle's picture."""
    if not views:
        return []
    places = np.array([view.position[:2] for view in views])
    found = []
    for event in events:
        if event.position is None:
            continue
        near = views[int(np.hypot(*(places - event.position[:2]).T).argmin())]
        place = np.array([*event.position[:2], near.position[2]])
        view = replace(near.moved_to(place, f"event {event.number}", event.time_s), vehicle=vehicle)
        found.append(MissingPicture(view, "", Cause.NOT_ARRIVED, _BORROWED_LENS))
    return found


def _without_picture(events: Sequence[CameraEvent], times: Array) -> list[CameraEvent]:
    """Events without a picture; each picture is assigned to its nearest event."""
    at = np.array([e.time_s for e in events])
    slack = _MATCH_SHARE * float(np.median(np.diff(at)))
    nearest = np.abs(at[None, :] - times[:, None]).argmin(1)
    matched = {int(k) for k, t in zip(nearest, times, strict=True) if abs(at[k] - t) <= slack}
    return [event for k, event in enumerate(events) if k not in matched]


def _not_arrived(event: CameraEvent, timed: Sequence[View]) -> MissingPicture | None:
    """The picture of an event, with the vehicle's camera at its nearest picture; None without a position."""
    if event.position is None:
        return None
    times = np.array([v.time_s for v in timed], float)
    near = timed[int(np.abs(times - event.time_s).argmin())]
    before = max(0, int(np.searchsorted(times, event.time_s)) - 1)
    place = np.array([*event.position[:2], near.position[2]])
    view = near.moved_to(place, f"event {event.number}", event.time_s)
    return MissingPicture(view, timed[before].image, Cause.NOT_ARRIVED, _SURE)
