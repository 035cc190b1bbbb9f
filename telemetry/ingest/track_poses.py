"""Poses of photos from a log's track, at the photos' times: for logs without camera events."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import Final

import numpy as np

from orthoswarm.model.earth import distance_m
from telemetry.formats.log.log_data import FlightLog
from telemetry.formats.log.mavlink_poses import fixed_camera
from telemetry.ingest.log_choice import LogMatch, LogSource, best_log
from telemetry.ingest.pairing.clock_offset import (
    median_distance_m,
    offset_by_positions,
    offset_by_zone,
    zones_of_flight,
)
from telemetry.ingest.photo_order import CLOCK_JUMP_S, clock_went_back
from telemetry.ingest.several_flights import nearest_span, of_one_vehicle, zone_of_all
from telemetry.photos.flight_checks import number_of
from telemetry.photos.photo_tags import Photo
from telemetry.samples.findings import Finding, plural
from telemetry.samples.sample import Sample
from telemetry.samples.times import YEAR_2000_S, ZONE_UNKNOWN

_NO_LOG_THEN = "no log that is here was recorded when it was taken; give the log of that flight, or a geo.txt"
_NO_LOG_FITS = (
    "no log that is here covers the times of these photos in any time zone; give the log of their flight, or a geo.txt"
)
_CLOCK_UNSET = "it was taken before the camera's clock was set, so that no log can place it; put a geo.txt next to it"
_LEAST_PLACED = 5
"""Photos with positions that it takes to find the camera's clock by them."""

EVENT_FAR_M: Final = 60.0  # photos whose own position is farther than this from their camera event are reported
_TRACK_FAR_M: Final = 10.0  # photos nearer than this to a log's track at their times do not contradict it
_TRACK_FAR_TIMES: Final = 5.0  # photos farther from it than so many times their median distance contradict it


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
