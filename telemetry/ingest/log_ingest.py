"""Flight logs as sources: exposures for `inspect`, poses for photos and videos near them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.stores.local_copies import local_file
from telemetry.formats.log.can_log import SUFFIXES as CAN_LOGS
from telemetry.formats.log.can_log import is_can_log
from telemetry.formats.log.dataflash import has_dataflash_records
from telemetry.formats.log.flight_logs import FlightLog, read_log
from telemetry.formats.log.mavlink_poses import ExposureEvent, fixed_camera
from telemetry.ingest.discovery import Discovery
from telemetry.ingest.log_choice import LOG_SAME_EXPOSURE_S, LogMatch, LogSource, apart_m, bettered, same_flight
from telemetry.ingest.pairing.event_pairing import Pairing, pair
from telemetry.ingest.pairing.motion_chains import PictureMotion, picture_motion
from telemetry.ingest.survey import SourceInfo, Survey
from telemetry.ingest.track_poses import (
    EVENT_FAR_M,
    LOG_LEAST_SHARE,
    add_track,
    best_log_of,
    explain,
    fill,
    logs_of_one_clock,
    nearest_span,
    of_one_vehicle,
)
from telemetry.photos.flight_checks import number_of
from telemetry.photos.photo_tags import Photo
from telemetry.samples.course import Placed, local_metres
from telemetry.samples.findings import Finding, plural
from telemetry.samples.unreadable import Unreadable, read_or_reason
from telemetry.samples.wild_fixes import sound_positions

_BUS = "DroneCAN"
_SEVERAL_WAYS = (
    "photos fit the camera events of the log in more than one way, and in some of them it has none; put a geo.txt next "
    "to it, or give the logs of all flights"
)
_NO_EVENT = "it has no camera event in the log; put a geo.txt next to it, or give the log of its flight"

_LOG_SAME_FIT: Final = 0.05  # two logs whose misfits to photos differ by no more than this fit equally well
_FAR_SHARE: Final = 0.2  # up to this share of photos far from their camera events have wrong positions
_MOST_ZONE_S: Final = 54_000.0  # largest offset by a time zone: 14 hours (IANA), and one for error


def read_logs(found: Discovery, result: Survey) -> list[LogSource]:
    """All logs of the inputs, as sources; the same exposures in a second log are counted once."""
    logs: list[LogSource] = []
    for folder in found.folders:
        for path in folder.logs:
            copy = read_or_reason(local_file, path)
            vehicles = copy if isinstance(copy, Unreadable) else read_or_reason(read_log, copy)
            if isinstance(vehicles, Unreadable):
                # A .bin that is not a DataFlash log, a .log that is not a CAN log: a note, not a warning.
                suffix = path.suffix.lower()
                foreign = isinstance(copy, Path) and (
                    (suffix == ".bin" and not has_dataflash_records(copy))
                    or (suffix in CAN_LOGS and not is_can_log(copy))
                )
                result.findings.append(Finding("not-a-log", f"{found.name(path)}: {vehicles}", note=foreign))
                continue
            source = SourceInfo(path=found.name(path), kind=vehicles[0].kind)
            result.sources.append(source)
            for log in vehicles:
                source.findings += log.findings + _drop_wild_fixes(log)
                source.tracks[log.vehicle] = [s for s in log.samples if s.has_position]
                source.shown[log.vehicle] = 0
                logs.append(LogSource(folder=found.scope(path), log=log, source=source, timeline=log.timeline()))
    _count_once(logs)
    return _with_buses(logs)


def _drop_wild_fixes(log: FlightLog) -> list[Finding]:
    """Take the wild fixes, and those that were not measured, out of a log's track and exposures."""
    log.samples, found = sound_positions(log.samples, [s.time_s for s in log.samples], log.path.name)
    exposures = [replace(event.sample, time_s=event.time_s) for event in log.events]
    sound, more = sound_positions(exposures, [s.time_s for s in exposures], f"the exposures of {log.path.name}")
    log.events = [
        event if now is was else replace(event, sample=now)
        for event, was, now in zip(log.events, exposures, sound, strict=True)
    ]
    return found + more


def _with_buses(logs: Sequence[LogSource]) -> list[LogSource]:
    """The logs; CAN logs are merged into the logs of their vehicles' autopilots."""
    apart: list[LogSource] = []
    flown = [entry for entry in logs if entry.log.kind != _BUS]
    for bus in (entry for entry in logs if entry.log.kind == _BUS):
        distances = [apart_m(entry.log, bus.log) for entry in flown]
        near = [(distance, n) for n, distance in enumerate(distances) if distance is not None]
        entry = flown[min(near)[1]] if near else None
        found = None if entry is None else bettered(entry.log, bus.log)
        if entry is None or found is None:
            apart.append(bus)
            continue
        entry.log, better = found
        entry.timeline = entry.log.timeline()
        entry.better = f"{' and '.join(better)} of {bus.log.path.name}"
        text = f"{entry.better} are used in place of its own: their stated sigma is lower"
        entry.source.findings.append(Finding("dronecan-better", text, note=True))
    return [*flown, *apart]


def _count_once(logs: Sequence[LogSource]) -> None:
    """Count exposures; a log whose exposures are all in another log refers to that one instead."""
    counted: list[LogSource] = []
    for entry in sorted(logs, key=lambda e: (-len(e.log.events), e.log.kind != "DataFlash")):
        twin = next((other for other in counted if _same_exposures(entry.log, other.log)), None)
        if twin is None or not entry.log.events:
            entry.source.counts["camera_events"] += len(entry.log.events)
            counted.append(entry)
            continue
        text = (
            f"its {plural(len(entry.log.events), 'camera event')} are those of {twin.log.path.name}, where they are "
            "counted"
        )
        entry.source.findings.append(Finding("same-exposures", text, note=True))


def _same_exposures(a: FlightLog, b: FlightLog) -> bool:
    """Whether two logs hold the same exposures: same moments at the same places."""
    if not a.events or len(b.events) < len(a.events):
        return False
    times = np.array([e.time_s for e in b.events], dtype=np.float64)
    for event in a.events:
        i = int(np.argmin(np.abs(times - (event.time_s or 0.0))))
        other = b.events[i]
        if abs(times[i] - (event.time_s or 0.0)) > LOG_SAME_EXPOSURE_S or _apart_m(event.sample, other.sample) > 3.0:
            return False
    return True


def _apart_m(a: Placed, b: Placed) -> float:
    if a.lat_deg is None or b.lat_deg is None or a.lon_deg is None or b.lon_deg is None:
        return 0.0
    return float(np.hypot(*local_metres([a.lat_deg, b.lat_deg], [a.lon_deg, b.lon_deg])[1]))


def add_logs(
    photos: Sequence[Photo],
    folder: Path,
    vehicle: str,
    *,
    logs: Sequence[LogSource],
    findings: list[Finding],
    workers: int = 1,
) -> None:
    """Fill what photos of one vehicle, in order of time and name, lack from the log that fits them best.

    Args:
        folder: of the photos; logs there and above are considered.
        workers: threads that read photos if their times do not decide which camera event they belong to.
    """
    near = [entry for entry in logs if folder.is_relative_to(entry.folder)]
    complete = (p.lat_deg is not None and p.height_m is not None and p.camera_deg[0] is not None for p in photos)
    if not near or not photos or all(complete):
        return
    pairings: dict[int, Pairing] = {}
    matches = []
    for entry in near:
        pairing = _pair(photos, entry.log.events)
        if len(pairing.pairs) >= max(1.0, LOG_LEAST_SHARE * min(len(photos), len(entry.log.events))):
            pairings[id(entry)] = pairing
            match = LogMatch(entry=entry, offset_s=pairing.offset_s or 0.0, how="by their camera events", rank=0)
            matches.append(replace(match, misfit=_misfit(photos, pairing, entry), margin=_LOG_SAME_FIT))
    if not matches:
        add_track(photos, near, vehicle, findings)
        return
    times = np.array([math.nan if photo.time_s is None else photo.time_s for photo in photos])
    entries = {id(match.entry): match.entry for match in matches}
    flights = logs_of_one_clock(
        pairings,
        times,
        pair_some=lambda key, some: _pair([photos[i] for i in some], entries[key].log.events),
        same_flight=lambda a, b: same_flight(entries[a], entries[b]),
    )
    if len(flights) > 1 and of_one_vehicle(entries[key].log for key in flights):
        certain = next(pairings[key] for key in flights if not pairings[key].ambiguous)
        offset_s = certain.offset_s or 0.0
        part_of = nearest_span(times, [_event_span(entries[key].log, offset_s) for key in flights])
        names = ", ".join(entries[key].log.path.name for key in flights)
        text = (
            f"the photos are of {len(flights)} flights: {names} find one camera clock for different photos "
            f"({offset_s:+.1f} s off); each photo is paired with the log of its time"
        )
        findings.append(Finding("several-flights", text, vehicle))
        for number, key in enumerate(flights):
            part = [photo for photo, own in zip(photos, part_of.tolist(), strict=True) if own == number]
            _use_log(part, entries[key], _pair(part, entries[key].log.events), vehicle, findings, workers=workers)
        return
    best = best_log_of(matches, vehicle)
    if isinstance(best, Finding):
        findings.append(best)
        explain(photos, best.message)
        return
    _use_log(photos, best.entry, pairings[id(best.entry)], vehicle, findings, workers=workers)


def _event_span(log: FlightLog, offset_s: float) -> tuple[float, float]:
    """First and last exposure of a log by the camera's clock."""
    moments = [event.time_s for event in log.events if event.time_s is not None]
    return min(moments) + offset_s, max(moments) + offset_s


def _misfit(photos: Sequence[Photo], pairing: Pairing, entry: LogSource) -> float:
    """How badly a log fits photos: 0 if each has its event where it lies; leftovers, residuals and repeated use add."""
    events = entry.log.events
    share = len(pairing.pairs) / max(len(photos), len(events))
    apart = [_apart_m(photos[i], events[j].sample) for i, j in pairing.pairs if photos[i].lat_deg is not None]
    away = float(np.median(apart)) / EVENT_FAR_M if apart else 0.0
    clock = 0.5 * (pairing.how != "time") + 0.01 * math.log1p(pairing.residual_s)
    # No zone explains more: another flight of the same mission.
    other_day = 2.0 * _LOG_SAME_FIT * (abs(pairing.offset_s or 0.0) > _MOST_ZONE_S)
    return 1.0 - share + clock + other_day + 0.6 * entry.used + away


def _pair(photos: Sequence[Photo], events: Sequence[ExposureEvent], motion: PictureMotion | None = None) -> Pairing:
    return pair(
        [p.time_s for p in photos],
        [e.time_s for e in events],
        [number_of(p.path.name) for p in photos],
        [e.number for e in events],
        motion,
    )


def _use_log(
    photos: Sequence[Photo], entry: LogSource, pairing: Pairing, vehicle: str, findings: list[Finding], *,
    workers: int,
) -> None:  # fmt: skip
    """Assign photos the poses of a log's events; pictures are read where the times do not decide."""
    entry.used = True
    log = entry.log
    if pairing.doubtful and not pairing.jumps:
        motion = picture_motion(photos, log, entry.timeline, workers)
        pairing = _pair(photos, log.events, motion) if motion is not None else pairing
    far = list[tuple[Photo, float | None]]()
    explain(photos, _NO_EVENT, log.path.name)  # those that get a position below need no reason
    explain([photos[i] for i in pairing.open], _SEVERAL_WAYS, log.path.name)
    for i, j in pairing.pairs:
        if i in pairing.open:
            continue
        event = log.events[j]
        around = entry.timeline.at(event.time_s or 0.0)
        pose = event.sample.merge(around)
        if not log.has_gimbal:
            pose = fixed_camera(pose)
        photo = photos[i]
        if _apart_m(photo, pose) > EVENT_FAR_M:
            far.append((photo, event.time_s))
            continue
        origin = f"{event.kind} ({entry.name})"
        if i in pairing.doubtful:
            spread = max((_apart_m(pose, log.events[k].sample) for k in pairing.doubtful[i]), default=0.0)
            pose = replace(pose, sigma_m=max(spread, pose.sigma_m or 0.0) or None)
            origin += ", one of several that its time allows"
            photo.ambiguous = True
        fill(photo, replace(pose, time_s=event.time_s), origin, gimbal=log.has_gimbal)
    findings += [replace(f, vehicle=vehicle) for f in _pairing_findings(photos, pairing, log)]
    if len(far) <= _FAR_SHARE * len(pairing.pairs):  # the log is theirs, their positions are wrong
        for photo, time_s in far:
            photo.time_s, photo.origin["time"] = time_s, f"exposure ({entry.name})"
    if far:
        text = (
            f"{plural(len(far), 'photo')} more than {EVENT_FAR_M:.0f} m from the camera events of "
            f"{log.path.name}, without a position from it; the log may be that of another flight"
        )
        findings.append(Finding("pairing-distance", text, vehicle))


def _pairing_findings(photos: Sequence[Photo], pairing: Pairing, log: FlightLog) -> list[Finding]:
    used_photos, used_events = {i for i, _ in pairing.pairs}, {j for _, j in pairing.pairs}
    how = {"time": "by time", "number": "by their numbers", "order": "by order alone"}[pairing.how]
    count = f"{len(pairing.pairs) - len(pairing.open)} of {plural(len(photos), 'photo')}"
    text = f"{count} were paired with camera events of {log.path.name} {how}"
    if pairing.offset_s is not None and not pairing.jumps:
        offset_s = round(pairing.offset_s, 1) + 0.0  # no "-0.0"
        text += f"; the camera's clock is {offset_s:+.1f} s off (median residual {pairing.residual_s:.2f} s)"
    if pairing.by_pictures:
        text += "; where the times leave several events, the pictures' motion decided"
    found = [Finding("paired", text, note=True)]
    for first, jump_s in pairing.jumps:
        text = (
            f"the camera's clock was set by {jump_s:+.1f} s before {photos[first].path.name}; the photos before and "
            f"after it are paired with {log.path.name} each by their own clock"
        )
        found.append(Finding("clock-set", text))
    if len(used_events) < len(log.events):
        first = next((j for j in range(len(log.events)) if j in used_events), 0)
        missing = len(log.events) - len(used_events)
        where = f", {first} of them before the first photo" if first else ""
        text = f"{plural(missing, 'camera event')} of {log.path.name} have no photo{where}"
        found.append(Finding("photos-missing", text))
    if len(used_photos) < len(photos):
        text = f"{plural(len(photos) - len(used_photos), 'photo')} have no camera event in {log.path.name}"
        found.append(Finding("photos-extra", text))
    if pairing.open:
        text = (
            f"{plural(len(pairing.open), 'photo')} fit the camera events of {log.path.name} in more than one way, and "
            "in some of them have none, so that they get no place from it; give the logs of all flights, or a geo.txt"
        )
        found.append(Finding("pairing-open", text))
    elif pairing.ambiguous:
        text = f"photos fit the camera events of {log.path.name} in more than one way; check the map for a shift"
        found.append(Finding("pairing-ambiguous", text))
    elif pairing.doubtful:
        text = (
            f"{plural(len(pairing.doubtful), 'photo')} may belong to neighbouring camera events of {log.path.name} "
            "(neither times nor pictures decide); the sigma of their positions is the distance of these events"
        )
        found.append(Finding("pairing-doubtful", text))
    if not log.has_gimbal:
        text = f"{log.path.name} reports no gimbal: the camera counts as fixed under the airframe"
        found.append(Finding("fixed-camera", text, note=True))
    return found
