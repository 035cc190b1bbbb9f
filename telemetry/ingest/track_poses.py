"""Poses of photos from a log's track, at the photos' times: for logs without camera events."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import PurePath
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Indices
from orthoswarm.model.earth import distance_m
from telemetry.formats.log.log_data import FlightLog
from telemetry.formats.log.mavlink_poses import fixed_camera
from telemetry.ingest.discovery import natural_key
from telemetry.ingest.log_choice import LogMatch, LogSource, best_log
from telemetry.ingest.pairing.clock_offset import (
    SPAN_MARGIN_S,
    ZONES_S,
    median_distance_m,
    offset_by_positions,
    offset_by_zone,
    zones_of_flight,
)
from telemetry.ingest.pairing.event_pairing import JUMP_LEAST_PHOTOS, LEAST_JUMP_S, Pairing
from telemetry.ingest.pairing.sequence_model import MOST_DRIFT
from telemetry.photos.flight_checks import number_of
from telemetry.photos.photo_tags import Photo
from telemetry.samples.course import ground_track, length_m
from telemetry.samples.findings import Finding, plural
from telemetry.samples.sample import Sample
from telemetry.samples.timeline import Timeline
from telemetry.samples.times import YEAR_2000_S, ZONE_UNKNOWN
from telemetry.samples.wild_fixes import TIME_RESOLUTION_S

_NO_LOG_THEN = "no log that is here was recorded when it was taken; give the log of that flight, or a geo.txt"
_NO_LOG_FITS = (
    "no log that is here covers the times of these photos in any time zone; give the log of their flight, or a geo.txt"
)
_CLOCK_UNSET = "it was taken before the camera's clock was set, so that no log can place it; put a geo.txt next to it"
_LEAST_PLACED = 5  # photos with positions that it takes to find the camera's clock by them

EVENT_FAR_M: Final = 60.0  # photos whose own position is farther than this from their camera event are reported
_TRACK_FAR_M: Final = 10.0  # photos nearer than this to a log's track at their times do not contradict it
_TRACK_FAR_TIMES: Final = 5.0  # photos farther from it than so many times their median distance contradict it
SHIFTED: Final = "shifted after a jump"
"""Said in the origin of a photo's time that was moved to follow the photos before it."""
CLOCK_JUMP_S: Final = 60.0  # a step back in the photos' times by more than this is a jump of the camera's clock
LOG_LEAST_SHARE: Final = 0.5  # a log belongs to photos if this share of the shorter of both is paired


def best_log_of(matches: Sequence[LogMatch], vehicle: str) -> LogMatch | Finding:
    """The log that fits a vehicle's photos best, or a finding that says why there is none; see `best_log`."""
    found = best_log(matches, f"the photos of {vehicle}", lambda log: _is_named_like(vehicle, log))
    return replace(found, vehicle=vehicle) if isinstance(found, Finding) else found


def _is_named_like(vehicle: str, log: FlightLog) -> bool:
    """Whether vehicle and log have one name or number (logs of a swarm are similar and can be confused)."""
    if log.path.stem.lower() == PurePath(vehicle).name.lower():
        return True
    number = number_of(vehicle)
    return number is not None and number in (number_of(log.path.name), number_of(log.vehicle))


def add_track(photos: Sequence[Photo], near: Sequence[LogSource], vehicle: str, findings: list[Finding]) -> None:
    """Fill what photos lack from the track that fits them best, the camera's clock found by positions or its zone.

    Photos whose own positions contradict the track at their times (the clock was set in between, or another flight
    began) are matched by themselves, and get nothing where that is not possible.
    """
    timed = [p for p in photos if p.time_s is not None and p.time_s >= YEAR_2000_S]
    early = [p for p in photos if p.time_s is not None and p.time_s < YEAR_2000_S]
    if early:
        text = f"{plural(len(early), 'photo')} from before the camera's clock was set: no log can place them by time"
        findings.append(Finding("clock-unset", text, vehicle))
        explain(early, _CLOCK_UNSET)
    while timed:
        placed = [p for p in timed if p.lat_deg is not None]
        by_positions = len(placed) >= _LEAST_PLACED
        if not by_positions and clock_went_back(timed):
            text = (
                "the camera's clock was set back during the flight, so that times do not tell where its photos were "
                "taken; give their positions (geo.txt) or a log with camera events"
            )
            findings.append(Finding("clock-jump", text, vehicle))
            explain(timed, text)
            return
        matches = _by_positions(placed, near) if by_positions else _by_zone(timed, near)
        if not matches and not by_positions and _add_tracks(timed, near, vehicle, findings):
            return
        if not matches:
            explain(timed, _NO_LOG_FITS)
            for part in _at_longest_pause(timed) if by_positions else ():
                if sum(p.lat_deg is not None for p in part) >= _LEAST_PLACED:
                    add_track(part, near, vehicle, findings)
            return
        best = best_log_of(matches, vehicle)
        if isinstance(best, Finding):
            findings.append(best)
            explain(timed, best.message)
            return
        also = [] if by_positions else _other_zones(timed, best)
        count, far = _fill_from(best, timed)
        if count:
            best.entry.used = True
            text = (
                f"{plural(count, 'photo')} got poses from the track of {best.entry.log.path.name} by time; the "
                f"camera's clock is {best.offset_s:+.1f} s off"
            )
            if also:
                text += f"; time zones of {', '.join(also)} from that fit as well: check their places"
            findings.append(Finding("posed-by-time", text, vehicle, note=by_positions))
        if far:
            text = (
                f"{plural(len(far), 'photo')} more than {_far_m(best):.0f} m from the track of "
                f"{best.entry.log.path.name} at that time ({far[0].path.name} first), without a pose from it: "
                "the camera's clock was set during the flight, or they are of another one"
            )
            findings.append(Finding("track-far", text, vehicle))
        timed = far if count and len(far) >= _LEAST_PLACED else []
        for photo in far if count and not timed else ():  # their positions are wrong, their clock is that of the others
            photo.time_s = (photo.time_s or 0.0) - best.offset_s
            photo.origin["time"] = f"track of {best.entry.name}"


def _add_tracks(photos: Sequence[Photo], near: Sequence[LogSource], vehicle: str, findings: list[Finding]) -> bool:
    """Fill photos of several flights from the tracks of their logs; False if their times do not tell which is which."""
    logs = [entry for entry in near if any(sample.has_position for sample in entry.log.samples)]
    times = np.array([p.time_s for p in photos], dtype=np.float64)
    zone = zone_of_all(times, [entry.timeline for entry in logs], zone_known=not _is_zone_unknown(photos))
    if zone is None:
        return False
    own = nearest_span(times - zone, [span for entry in logs if (span := entry.timeline.span) is not None])
    if not of_one_vehicle(logs[number].log for number in set(own.tolist())):
        return False
    used, count = list[str](), 0
    for number, entry in enumerate(logs):
        part = [photo for photo, of in zip(photos, own.tolist(), strict=True) if of == number]
        if part:
            match = LogMatch(entry=entry, offset_s=zone, how="by the time of the flight", rank=0, misfit=0.0)
            count += _fill_from(match, part)[0]
            entry.used = True
            used.append(entry.log.path.name)
    text = (
        f"{plural(count, 'photo')} of {len(used)} flights got poses from the tracks of {', '.join(used)} by time: in "
        f"one time zone only ({zone / 3600.0:+g} h) each photo lies in the flight of a log; check their places"
    )
    findings.append(Finding("posed-by-time", text, vehicle))
    return True


def _at_longest_pause(photos: Sequence[Photo]) -> list[Sequence[Photo]]:
    """Photos in order of time before and after their longest pause: two flights perhaps; none without a pause."""
    steps = np.diff([p.time_s or 0.0 for p in photos])
    longest = int(np.argmax(steps))
    if steps[longest] <= CLOCK_JUMP_S:
        return []
    return [photos[: longest + 1], photos[longest + 1 :]]


def _by_positions(photos: Sequence[Photo], near: Sequence[LogSource]) -> list[LogMatch]:
    times = np.array([p.time_s for p in photos], dtype=np.float64)
    places = np.array([[p.lat_deg, p.lon_deg] for p in photos], dtype=np.float64)
    matches = []
    for entry in near:
        offset = offset_by_positions(times, places, entry.timeline)
        apart = None if offset is None else median_distance_m(times - offset, places, entry.timeline)
        if offset is not None and apart is not None:
            how = "by their own positions"
            matches.append(LogMatch(entry=entry, offset_s=offset, how=how, rank=0, misfit=apart, by_positions=True))
    return matches


def _by_zone(photos: Sequence[Photo], near: Sequence[LogSource]) -> list[LogMatch]:
    times = np.array([p.time_s for p in photos], dtype=np.float64)
    unknown = _is_zone_unknown(photos)  # then no zone is likelier than another
    if unknown:
        zones = [(entry, next(iter(zones_of_flight(times, entry.timeline)), None)) for entry in near]
    else:
        zones = [(entry, offset_by_zone(times, entry.timeline)) for entry in near]
    return [
        LogMatch(
            entry=entry, offset_s=zone, how="by the time of the flight", rank=0, misfit=0.0 if unknown else abs(zone)
        )
        for entry, zone in zones
        if zone is not None and any(sample.has_position for sample in entry.log.samples)
    ]


def _is_zone_unknown(photos: Sequence[Photo]) -> bool:
    return any(ZONE_UNKNOWN in p.origin.get("time", "") for p in photos)


def _other_zones(photos: Sequence[Photo], match: LogMatch) -> list[str]:
    """Offsets in hours, from that of a match, of further zones under which photos lie in the log's flights."""
    if not _is_zone_unknown(photos):
        return []
    times = np.array([p.time_s for p in photos], dtype=np.float64)
    zones = zones_of_flight(times, match.entry.timeline)
    return [f"{(zone - match.offset_s) / 3600.0:+g} h" for zone in zones if zone != match.offset_s]


def _far_m(match: LogMatch) -> float:
    """Distance from the track from which on a photo's own position contradicts it, metres."""
    usual_m = match.misfit if match.by_positions else EVENT_FAR_M
    return min(EVENT_FAR_M, max(_TRACK_FAR_M, _TRACK_FAR_TIMES * usual_m))


def _fill_from(match: LogMatch, photos: Sequence[Photo]) -> tuple[int, list[Photo]]:
    """Fill photos from a log's track: how many got a pose, and those whose own positions contradict it."""
    log, far, count = match.entry.log, list[Photo](), 0
    limit_m = _far_m(match)
    times = np.array([p.time_s for p in photos], dtype=np.float64)
    for photo, pose in zip(photos, match.entry.timeline.at_all(times - match.offset_s), strict=True):
        if not pose.has_position:
            explain([photo], _NO_LOG_THEN, _not_in(match, photo))
            continue
        if photo.lat_deg is not None and photo.lon_deg is not None:
            apart = distance_m(photo.lat_deg, photo.lon_deg, *pose.place)
            if apart > limit_m:
                far.append(photo)
                continue
        count += 1
        pose = pose if log.has_gimbal else fixed_camera(pose)
        fill(photo, pose, f"track of {match.entry.name}", gimbal=log.has_gimbal)
    return count, far


def explain(photos: Sequence[Photo], why: str, detail: str = "") -> None:
    """Say why no log gives photos a position."""
    for photo in photos:
        photo.unplaced = why, detail


def _not_in(match: LogMatch, photo: Photo) -> str:
    """How a photo's time lies to a log that holds no position then."""
    log, span = match.entry.log.path.name, match.entry.timeline.span
    moment = (photo.time_s or 0.0) - match.offset_s
    if span is None or span[0] <= moment <= span[1]:
        return f"{log} has a gap there"
    if moment < span[0]:
        return f"{span[0] - moment:.0f} s before {log} begins"
    return f"{moment - span[1]:.0f} s after {log} ends"


def fill(photo: Photo, pose: Sample, origin: str, *, gimbal: bool) -> None:
    """Fill a photo's missing fields from a pose; its time replaces the camera's clock."""
    if photo.lat_deg is None and pose.has_position:
        photo.lat_deg, photo.lon_deg = pose.lat_deg, pose.lon_deg
        photo.position_sigma_m = pose.sigma_m
        photo.origin["position"] = origin
    if photo.height_m is None and pose.height_m is not None:
        photo.height_m, photo.height_is_ground = pose.height_m, pose.height_is_ground
        photo.origin["height"] = origin
    if photo.altitude_m is None:
        photo.altitude_m = pose.altitude_m
    if photo.camera_deg[0] is None and pose.yaw_deg is not None:
        photo.camera_deg = (pose.yaw_deg, pose.pitch_deg, pose.roll_deg)
        photo.yaw_is_stated = True
        photo.origin["angles"] = origin if gimbal else f"{origin}, camera fixed under the airframe"
    if photo.flight_deg[0] is None and pose.flight_yaw_deg is not None:
        photo.flight_deg = (pose.flight_yaw_deg, pose.flight_pitch_deg, pose.flight_roll_deg)
        photo.origin["flight_yaw"] = origin
    if pose.time_s is not None:
        photo.time_s, photo.origin["time"] = pose.time_s, origin


def in_order(photos: Sequence[Photo], vehicle: str, findings: list[Finding]) -> list[Photo]:
    """Sort photos by time, or by name where the clock jumped.

    Where the two orders differ, the one with the shorter track is used; times are then shifted after each jump so
    that they continue, which preserves intervals within each part.
    """
    by_name = sorted(photos, key=lambda p: natural_key(p.path.name))
    by_time = sorted(by_name, key=lambda p: float("inf") if p.time_s is None else p.time_s)
    if by_time == by_name or any(p.time_s is None or p.lat_deg is None for p in photos):
        return by_time
    times = np.array([p.time_s for p in by_name], dtype=np.float64)
    steps = np.diff(times)
    back = np.flatnonzero(steps < 0.0)
    if len(back) > 3 or steps[back].min() > -CLOCK_JUMP_S:
        return by_time
    if length_m(ground_track(by_name)) > 0.7 * length_m(ground_track(by_time)):
        return by_time
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    for at in back:
        shift = times[at] + usual - times[at + 1]
        times[at + 1 :] += shift
    for photo, time_s in zip(by_name, times.tolist(), strict=True):
        if photo.time_s != time_s:
            photo.time_s = time_s
            photo.origin["time"] = f"{photo.origin.get('time', 'camera clock')}, {SHIFTED}"
    text = (
        f"the camera's clock jumped back {plural(len(back), 'time')} during the flight; the order of the file names is "
        "used, and times after a jump are shifted"
    )
    findings.append(Finding("clock-jump", text, vehicle))
    return by_name


def clock_went_back(photos: Sequence[Photo]) -> bool:
    """Whether the clock was set back between photos: runs of names, in order within, of which two share some time.

    Runs one after the other are no sign of it: numbers begin anew after the last one.
    """
    series: dict[str, list[float]] = {}  # by the names without their number: two cameras in one folder are two
    for p in sorted(photos, key=lambda p: natural_key(p.path.name)):
        if p.time_s is not None:
            series.setdefault(re.sub(r"\d+\D*$", "", p.path.stem), []).append(p.time_s)
    return any(_went_back(np.array(times)) for times in series.values())


def _went_back(times: Array) -> bool:
    back = np.flatnonzero(np.diff(times) < -TIME_RESOLUTION_S) + 1
    if not 0 < len(back) <= 3:  # more: names that are not in the order of exposure
        return False
    spans = sorted((run.min(), run.max()) for run in np.split(times, back))
    return any(later[0] < earlier[1] for earlier, later in pairwise(spans))


def of_one_vehicle(logs: Iterable[FlightLog]) -> bool:
    """Whether logs may be of one vehicle: what a ground station recorded names it by its system id."""
    return len({log.vehicle for log in logs if log.kind == "tlog"}) < 2


def logs_of_one_clock(
    pairings: Mapping[int, Pairing],
    times: Array,
    *,
    pair_some: Callable[[int, Sequence[int]], Pairing],
    same_flight: Callable[[int, int], bool],
) -> list[int]:
    """The logs that find one clock for different photos; fewer than two if that is not certain.

    A log of a mission that was flown twice fits the photos of both flights: it is asked again about those that no other
    log has.

    Args:
        pairings: of all photos with the events of each log, by the log's key.
        times: (N,) of the photos by the camera, NaN where unknown.
        pair_some: pairs some photos with the events of a log.
        same_flight: whether two logs record one flight, by autopilot and ground station perhaps.

    Returns:
        Keys in order of time.
    """
    sure = {key: photos for key, pairing in pairings.items() if (photos := _sure(pairing))}
    groups = [_joined(key, sure, pairings, times) for key in sure]
    best = max(groups, key=lambda keys: sum(len(sure[key]) for key in keys), default=[])
    for key in [key for key in pairings if best and key not in best]:
        taken = {i for own in best for i in sure[own]}
        rest = [i for i in range(len(times)) if i not in taken]
        again = pair_some(key, rest) if len(rest) > 1 else Pairing()
        found = {**sure, key: [rest[i] for i in _sure(again)]}
        if found[key] and _same_clock(best[0], key, found, {**pairings, key: again}, times):
            sure, best = found, [*best, key]
    for key in pairings.keys() - set(best):  # another vehicle's log that fits the same photos
        fitting = {i for i, _ in pairings[key].pairs}
        for own in best:
            common = len(fitting.intersection(sure[own]))
            if common >= LOG_LEAST_SHARE * len(sure[own]) and not same_flight(key, own):
                return []
    return sorted(best, key=lambda key: float(np.median(times[sure[key]])))


def _sure(pairing: Pairing) -> list[int]:
    """The photos whose events are certain; none if they are few, or if more than one clock fits."""
    if pairing.how != "time" or pairing.offset_s is None or pairing.ambiguous or pairing.jumps:
        return []
    photos = [i for i, _ in pairing.pairs if i not in pairing.doubtful]
    return photos if len(photos) >= JUMP_LEAST_PHOTOS else []


def _joined(first: int, sure: Mapping[int, Sequence[int]], pairings: Mapping[int, Pairing], times: Array) -> list[int]:
    """A log and those that find its clock for other photos, the ones with most photos first."""
    joined = [first]
    for key in sorted(sure, key=lambda key: -len(sure[key])):
        taken = {i for other in joined for i in sure[other]}
        if key not in joined and taken.isdisjoint(sure[key]) and _same_clock(first, key, sure, pairings, times):
            joined.append(key)
    return joined


def _same_clock(
    a: int, b: int, sure: Mapping[int, Sequence[int]], pairings: Mapping[int, Pairing], times: Array
) -> bool:
    between_s = abs(float(np.median(times[sure[a]]) - np.median(times[sure[b]])))
    apart_s = abs((pairings[a].offset_s or 0.0) - (pairings[b].offset_s or 0.0))
    return apart_s <= LEAST_JUMP_S + MOST_DRIFT * between_s


def nearest_span(times: Array, spans: Sequence[tuple[float, float]]) -> Indices:
    """(N,) index of the span of time that each time lies in, or nearest to."""
    starts, ends = np.array(spans, dtype=np.float64).T
    apart = np.maximum(np.maximum(starts - times[:, None], times[:, None] - ends), 0.0)
    return np.asarray(np.argmin(apart, axis=1))


def zone_of_all(times: Array, timelines: Sequence[Timeline], *, zone_known: bool) -> float | None:
    """The only time zone under which each photo lies in the flight of exactly one log; None if there is no such one.

    Args:
        times: (N,) of the photos by the camera. timelines: of the logs.
        zone_known: whether the times are UTC already, so that no other zone is possible.
    """
    spans = [timeline.span for timeline in timelines]
    if len(spans) < 2 or any(span is None for span in spans):
        return None
    starts, ends = np.array(spans, dtype=np.float64).T
    zones = (0.0,) if zone_known else ZONES_S
    held = {}
    for zone in zones:
        at = (times - zone)[:, None]
        inside = (at >= starts - SPAN_MARGIN_S) & (at <= ends + SPAN_MARGIN_S)
        if inside.any(axis=1).all():
            held[zone] = bool((inside.sum(axis=1) == 1).all())
    if len(held) != 1:
        return None
    ((zone, only_one_each),) = held.items()
    return zone if only_one_each else None
