"""The offset between a camera's clock and a vehicle's, from what both recorded of the flight.

All functions return camera time minus vehicle time in seconds, or None if nothing fits.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Bytes
from telemetry.samples.course import local_metres
from telemetry.samples.timeline import Timeline

_QUARTER_S = 900.0
_HALF_HOURS = (-9.5, -4.5, -3.5, -2.5, 3.5, 4.5, 5.5, 5.75, 6.5, 8.5, 8.75, 9.5, 10.5, 11.5, 12.75, 13.75)
ZONES_S = tuple(3600.0 * hours for hours in sorted([*range(-12, 15), *_HALF_HOURS]))
"""Offsets of local times from UTC that were in use anywhere from 2010 on, seconds (IANA time zone database)."""
SPAN_MARGIN_S = 2.0  # photos may lie so far outside a log's span, seconds: times are in whole seconds
_MOVED_M = 2.0  # A vehicle moved that is farther away at the next photo, metres (chosen: receivers at rest wander less)
_LEAST_MOVED = 0.8
"""Zones under which a vehicle moved less often, by this share of the most, are not the photos' (chosen)."""

_TURNING_STEP_S: Final = 0.1  # of the clocks that are compared by turns
TURNING_MARGIN: Final = 0.1  # a video's turns decide between two clocks, or logs, if correlations differ by more


def offset_by_zone(times: Array, timeline: Timeline) -> float | None:
    """The time zone under which all photos fall into the log; the smallest of several."""
    return next(iter(_fitting_zones(times, timeline)), None)


def zones_of_flight(times: Array, timeline: Timeline) -> list[float]:
    """The time zones, smallest first, under which all photos fall into the log, and into its flights.

    A log may last for hours: under a wrong zone photos lie where the vehicle stood before or after its flight. So of
    several zones those count under which it moved between most photos.
    """
    zones = _fitting_zones(times, timeline)
    moved = [_moved_share(np.sort(times) - zone, timeline) for zone in zones]
    return [zone for zone, share in zip(zones, moved, strict=True) if share >= _LEAST_MOVED * max(moved)]


def _fitting_zones(times: Array, timeline: Timeline) -> list[float]:
    span = timeline.span
    if span is None:
        return []
    first, last = span[0] - SPAN_MARGIN_S, span[1] + SPAN_MARGIN_S
    fits = (zone for zone in ZONES_S if times.min() - zone >= first and times.max() - zone <= last)
    return sorted(fits, key=abs)


def _moved_share(times: Array, timeline: Timeline) -> float:
    """Share of photos between which and the one before a vehicle moved."""
    lat, lon = timeline.values("lat_deg", times), timeline.values("lon_deg", times)
    known = ~np.isnan(lat)
    if known.sum() < 2:
        return 0.0
    steps = np.hypot(*np.diff(local_metres(lat[known], lon[known]), axis=0).T)
    return float((steps > _MOVED_M).sum()) / len(times)


def offset_by_positions(times: Array, lat_lon: Array, timeline: Timeline, *, search_s: float = 30.0) -> float | None:
    """The offset that brings a camera's own times (N,) and positions (N, 2), degrees, onto the vehicle's track.

    Any zone is possible; besides whole quarter hours the clocks differ by `search_s` at most.
    """
    if timeline.span is None or len(times) < 3:
        return None
    best: tuple[float, float] | None = None
    for quarters in range(-56, 57):
        base = quarters * _QUARTER_S
        if times.max() - base + search_s < timeline.span[0] or times.min() - base - search_s > timeline.span[1]:
            continue
        for shift in np.arange(-search_s, search_s + 0.01, 1.0):
            error = median_distance_m(times - base - shift, lat_lon, timeline)
            if error is not None and (best is None or error < best[0]):
                best = error, base + float(shift)
    if best is None or best[0] > 50.0:
        return None
    fine = [
        (median_distance_m(times - best[1] - s, lat_lon, timeline), best[1] + s) for s in np.arange(-1.0, 1.01, 0.1)
    ]
    return float(min((e, o) for e, o in fine if e is not None)[1])


def median_distance_m(times: Array, lat_lon: Array, timeline: Timeline) -> float | None:
    """Median distance in metres between positions and a track; None if the track covers too few of them."""
    lat, lon = timeline.values("lat_deg", times), timeline.values("lon_deg", times)
    known = ~np.isnan(lat)
    if known.sum() < max(3, 0.6 * len(times)):
        return None
    ours = local_metres(
        np.concatenate([lat[known], lat_lon[known, 0]]), np.concatenate([lon[known], lat_lon[known, 1]])
    )
    half = int(known.sum())
    return float(np.median(np.hypot(*(ours[:half] - ours[half:]).T)))


def offset_by_turning(
    picture_times: Array, picture_rates: Array, timeline: Timeline, *, search_s: float = 120.0
) -> tuple[float, float] | None:
    """The offset for which the pictures rotate when the vehicle turns.

    Args:
        picture_times: (N,) video seconds. picture_rates: (N,) yaw rate measured in the pictures, degrees a second.
        timeline: the vehicle's; its flight yaw (or camera yaw) is read.
        search_s: largest difference of the clocks after their beginnings are aligned.

    Returns:
        Offset and the correlation there (0 to 1), None if the flight has too few turns.
    """
    if timeline.span is None or len(picture_times) < 10 or np.std(picture_rates) < 0.5:
        return None
    first, last = timeline.span
    grid = np.arange(first, last, _TURNING_STEP_S)
    if len(grid) < 20:
        return None
    yaw = timeline.values("flight_yaw_deg", grid)
    if np.isnan(yaw).all():
        yaw = timeline.values("yaw_deg", grid)
    known = ~np.isnan(yaw)
    if known.sum() < 20:
        return None
    rate = np.gradient(np.degrees(np.unwrap(np.radians(np.interp(grid, grid[known], yaw[known])))), _TURNING_STEP_S)
    if np.std(rate) < 0.3:
        return None
    start = picture_times[0] - first
    best: list[tuple[float, float]] = []
    for offset in np.arange(start - search_s, start + search_s, _TURNING_STEP_S):
        at = picture_times - offset
        inside = (at >= first) & (at <= last)
        if inside.sum() < max(10, 0.5 * len(at)):
            continue
        theirs = np.interp(at[inside], grid, rate)
        ours = picture_rates[inside]
        if np.std(theirs) < 0.3 or np.std(ours) < 0.3:
            continue
        best.append((float(np.corrcoef(ours, theirs)[0, 1]), float(offset)))
    if not best:
        return None
    correlation, offset = max(best)
    rivals = [c for c, o in best if abs(o - offset) > 3.0]
    if correlation < 0.5 or (rivals and max(rivals) > correlation - TURNING_MARGIN):
        return None
    return offset, correlation


def turning_of_pictures(grays: Sequence[Bytes], times: Array) -> tuple[Array, Array]:
    """Rotation rate of consecutive pictures about their centre: times between them and degrees a second.

    A picture that rotates clockwise over the ground (yaw grows) shows the ground rotating the other way.
    """
    import cv2

    middle, rates = [], []
    for i in range(len(grays) - 1):
        points = cv2.goodFeaturesToTrack(grays[i], 200, 0.01, 8)
        if points is None or len(points) < 12 or times[i + 1] <= times[i]:
            continue
        moved, status, _ = cv2.calcOpticalFlowPyrLK(grays[i], grays[i + 1], points, None, winSize=(21, 21), maxLevel=4)
        good = status.ravel() == 1
        if good.sum() < 12:
            continue
        model, inliers = cv2.estimateAffinePartial2D(points[good], moved[good], ransacReprojThreshold=2.0)
        if model is None or inliers.sum() < 10:
            continue
        # Rows point down: a positive angle of the model looks clockwise, which is the camera turning left.
        angle = np.degrees(np.arctan2(model[1, 0], model[0, 0]))
        middle.append(0.5 * (times[i] + times[i + 1]))
        rates.append(-angle / (times[i + 1] - times[i]))
    return np.array(middle), np.array(rates)
