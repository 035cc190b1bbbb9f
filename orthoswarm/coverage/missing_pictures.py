"""Missing pictures: holes in the evenly spaced pictures of a straight leg, and camera events without a picture.

A camera event without a picture: the picture has not arrived (it is on the card, or the link is lost). A hole in a leg
without a camera event: the camera was not triggered.
"""

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np

from orthoswarm.coverage.view import View
from orthoswarm.model.arrays import Array

_HOLE_STEPS: Final = 1.6  # usual steps between two pictures from which on one is missing
_STRAIGHT_DEG: Final = 20.0  # steps of one straight leg differ by less than this in direction
_MOST_MISSING: Final = 400  # most missing pictures that are made up in one hole (for its time)
_SLACK_S: Final = 0.05  # camera events this near in time to a picture are its own
_MATCH_SHARE: Final = 0.45  # a picture's event is within this share of the usual time between them (below a half)
_LEAST_MATCHED: Final = 0.5  # share of a vehicle's pictures that must have an event: else its clocks disagree
_SURE: Final = 0.95  # confidence of a cause that camera events show
_BORROWED_LENS: Final = 0.6  # confidence in what a vehicle has seen of which no picture has arrived


class Cause(StrEnum):
    """Why ground was not seen, or not well."""

    NOT_FLOWN = "not flown"
    NOT_TRIGGERED = "not triggered"
    NOT_ARRIVED = "pictures not arrived"
    REJECTED = "pictures rejected"
    NARROW_LENS = "lens narrower than planned"
    NOT_PLANNED = "outside the plan"
    POOR = "seen poorly"


@dataclass(frozen=True, slots=True)
class Exposure:
    """A camera event recorded by the vehicle, or a picture file that could not be used."""

    vehicle: str
    time_s: float  # UTC epoch seconds
    image: str = ""  # name of the file, empty for an event without one


@dataclass(frozen=True, slots=True)
class MissingPicture:
    """A missing picture."""

    view: View  # its expected camera; its image is the name of the file where that is known
    after: str  # name of the picture before the hole
    cause: Cause  # why it is missing
    confidence: float  # 0 to 1


def missing_pictures(views: Sequence[View], exposures: Iterable[Exposure] = ()) -> list[MissingPicture]:
    """Holes in the legs.

    A hole is a distance of at least 1.6 times the vehicle's median spacing between two successive pictures that are in
    line with the flight before or after them. Its cause: exposures with a file were rejected, exposures without one
    have not arrived. Without recorded exposures the numbers in file names decide: skipped numbers mean pictures that
    have not arrived, consecutive ones that the camera was not triggered.

    views: pictures that were placed. exposures: of any vehicle, in any order, also of pictures that are in `views`.
    """
    known = {(v.vehicle, v.image) for v in views}
    lost: dict[str, list[Exposure]] = defaultdict(list)
    for exposure in exposures:
        if not exposure.image or (exposure.vehicle, exposure.image) not in known:
            lost[exposure.vehicle].append(exposure)
    rows: dict[str, list[View]] = defaultdict(list)
    for view in views:
        rows[view.vehicle].append(view)
    found: list[MissingPicture] = []
    for vehicle, row in rows.items():
        row.sort(key=lambda v: (v.time_s if v.time_s is not None else 0.0, v.image))
        found += _holes(row, lost[vehicle])
    return found


def _holes(row: Sequence[View], lost: Sequence[Exposure]) -> list[MissingPicture]:
    if len(row) < 4:
        return []
    at = np.array([v.position[:2] for v in row])
    way = np.diff(at, axis=0)
    step = np.hypot(*way.T)
    moving = step[step > 0.2]
    if not len(moving):
        return []
    usual = float(np.median(moving))
    heading = way / np.maximum(step, 1e-9)[:, None]
    found = []
    for i in np.flatnonzero(step > _HOLE_STEPS * usual).tolist():
        near = [k for k in (i - 1, i + 1) if 0 <= k < len(step) and step[k] > 0.2]
        if not any(float(heading[k] @ heading[i]) > np.cos(np.radians(_STRAIGHT_DEG)) for k in near):
            continue
        count = min(_MOST_MISSING, max(1, round(step[i] / usual) - 1))
        cause, confidence, names = _why(row[i], row[i + 1], count, lost)
        for k in range(count):
            share = (k + 1) / (count + 1)
            position = (1.0 - share) * row[i].position + share * row[i + 1].position
            name = names[k] if k < len(names) else f"{row[i].image}+{k + 1}"
            found.append(MissingPicture(row[i].moved_to(position, name), row[i].image, cause, confidence))
    return found


def _why(before: View, after: View, count: int, lost: Sequence[Exposure]) -> tuple[Cause, float, list[str]]:
    """Cause of a hole, its confidence (0 to 1), and names of its pictures where they are known."""
    if before.time_s is not None and after.time_s is not None:
        times = (before.time_s + _SLACK_S, after.time_s - _SLACK_S)
        within = [e for e in lost if times[0] < e.time_s < times[1]]
        files = [e.image for e in within if e.image]
        if within:
            return (Cause.REJECTED if files else Cause.NOT_ARRIVED), min(0.95, len(within) / count), files
    numbers = _number(before.image), _number(after.image)
    if numbers[0] is not None and numbers[1] is not None:
        left_out = numbers[1] - numbers[0] - 1
        if 0.5 * count <= left_out <= 2 * count:
            return Cause.NOT_ARRIVED, 0.8, []
        if left_out == 0:
            return Cause.NOT_TRIGGERED, 0.8, []
    return Cause.NOT_TRIGGERED, 0.5, []


def _number(image: str) -> int | None:
    digits = re.findall(r"\d+", image.rpartition("/")[2])
    return int(digits[-1]) if digits else None


@dataclass(frozen=True, slots=True)
class CameraEvent:
    """An exposure as a vehicle reported it."""

    vehicle: str
    number: int  # as counted by the vehicle
    time_s: float  # UTC epoch seconds
    # float64 (3,), east, north in the grid of the views, and a height that is not used (vehicles count it from another
    # level than maps do); None where the event has none
    position: Array | None = None


def missing_by_events(
    views: Sequence[View], events: Iterable[CameraEvent], rejected: Iterable[Exposure] = ()
) -> tuple[list[MissingPicture], list[str]]:
    """Missing pictures of all vehicles; for vehicles without events only from holes in their legs.

    views: pictures that were placed. events: in any order. rejected: files that could not be used.

    Returns the pictures, those that have not arrived named by their event's number, and why events could not be used.
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
    return found, warnings


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
