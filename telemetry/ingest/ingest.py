"""From inputs to frames: finds the sources, merges them field by field, decides between contradicting tags.

For each field the better source is used, and missing fields come from others: a geo.txt without angles leaves the
photos' angles, and an absolute altitude never becomes a height.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.earth import distance_m
from orthoswarm.model.frame import UNSTATED_SIGMA_M, Ingest, Rejection
from orthoswarm.model.task_runner import Progress
from orthoswarm.raster.picture_file import RAW_SUFFIX
from orthoswarm.stores.local_copies import local_file
from telemetry.formats.table import geo_txt, pose_csv
from telemetry.formats.table.pose_table import PoseTable, leave_out_folder, lookup, names_of, take_base_names
from telemetry.formats.video.sei import read_sei_layout, register
from telemetry.ingest.discovery import Discovery, Folder, discover, natural_key
from telemetry.ingest.log_choice import LogSource
from telemetry.ingest.log_ingest import add_logs, read_logs
from telemetry.ingest.strangers import (
    Reasons,
    copies_in_other_folders,
    of_other_kinds,
    of_other_sources,
    of_second_cameras,
    strangers,
)
from telemetry.ingest.summary import read_control_points
from telemetry.ingest.survey import LoadOptions, SourceInfo, Survey
from telemetry.ingest.track_poses import SHIFTED, clock_went_back, in_order
from telemetry.ingest.video_ingest import read_videos
from telemetry.photos.flight_checks import flight_findings, times_without_zone
from telemetry.photos.maker_angles import Angles
from telemetry.photos.photo_frames import frame_without_position, frames_of, settle_positions, void_fixes
from telemetry.photos.photo_tags import ALTITUDE_CONTRADICTS_M, Photo, read_photos, with_sidecar
from telemetry.samples.findings import Finding, metres, plural
from telemetry.samples.held_fixes import LOST_SIGMA_M, coarse_m, held_fixes, matters, one_fix, stated_sigma_m
from telemetry.samples.unreadable import Unreadable, read_or_reason
from telemetry.samples.wild_fixes import doubtful_finding, wild_fixes

__all__ = ["LoadOptions", "SourceInfo", "Survey", "load", "survey"]

_CONTRADICTION_M: Final = 500.0  # table that puts a photo so far from its tags, or from another table, contradicts them


_NOT_MEASURED: Final = (
    "the picture has no position: its receiver stood still or had no fix; put a geo.txt next to it, or give its log as "
    "well"
)
_FOOT_M: Final = 0.3048
_LIKE_FEET: Final = 0.05  # share by which altitudes in feet may be off: sea and ellipsoid, and barometers, differ
_COARSE_TOLD_M: Final = 3.0  # steps of coordinates that are more than receivers err
_ROUNDED: Final = 12.0**-0.5  # sigma of what was rounded, in its steps


def load(inputs: Sequence[Path], *, progress: Progress | None = None, options: LoadOptions | None = None) -> Ingest:
    """Read inputs into frames: folders of photos (recursive; each folder with photos is one vehicle), photos, videos.

    Raises InputError: an input does not exist or is of no known kind, or a SEI layout is wrong.
    """
    found = survey(inputs, progress=progress, options=options)
    told = [str(finding) for finding in found.findings if not finding.note]
    for source in found.sources:
        title = source.path.rsplit("/", 1)[-1]
        for finding in source.findings:
            if not finding.note:  # each says what it is about, also where its source is not named above it
                named = finding.vehicle or title in finding.message
                told.append(str(finding) if named else f"{source.path}: {finding}")
    return Ingest(found.frames(), found.rejected, list(dict.fromkeys(told)), found.unpositioned)


def survey(inputs: Sequence[Path], *, progress: Progress | None = None, options: LoadOptions | None = None) -> Survey:
    """The same as `load`, source by source, for `inspect`."""
    options = options or LoadOptions()
    for layout in options.sei_layouts:
        register(read_sei_layout(layout))
    found = discover([Path(path) for path in inputs], options.exclude)
    result = Survey(root=found.root, discovery=found)
    vehicles = {folder.path: folder.vehicle for folder in found.folders}
    for path, why in found.unreadable.items():
        text = f"the folder {found.name(path)} cannot be read ({why}); what it holds is left out: check its permissions"
        result.findings.append(Finding("folder-unreadable", text))
    for path, why, detail in found.left_out:
        result.rejected.append(Rejection(found.name(path), why, vehicles.get(path.parent, ""), detail=detail))
    result.findings += _copy_findings(found)
    tables = _tables(found, result)
    logs = read_logs(found, result)
    total = sum(len(folder.pictures) for folder in found.folders)
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress("reading photos", done, total)

    # One call for all folders: with one for each, processes would idle at the end of every folder.
    pictures = [picture for folder in found.folders for picture in folder.pictures]
    with closing(read_photos(pictures, workers=options.workers, run=options.run, progress=advance)) as tags:
        for folder in found.folders:
            if folder.pictures:
                own = islice(tags, len(folder.pictures))
                _photo_folder(folder, own, found, tables=tables, logs=logs, result=result, options=options)
            if folder.videos or folder.subtitles:
                read_videos(folder, found, logs, options=options, progress=progress, result=result)
    for source, lost in copies_in_other_folders(result.sources):
        source.frames = [frame for frame in source.frames if frame.image not in lost]
        source.counts["frames"] = len(source.frames)
        result.rejected += lost.values()
    for source, reason in of_other_sources(result.sources, options.camera, options.band):
        result.rejected += [Rejection(f.image, reason, f.vehicle, f.time_s) for f in source.frames]
        source.frames.clear()
        source.counts["frames"] = 0
    if result.unpositioned:  # then a table that nobody understands is no side issue
        result.findings = [replace(f, note=f.note and f.code != "table-unknown") for f in result.findings]
    result.findings += [*_logs_apart(found, logs), *_unread(found, needed=bool(result.unpositioned))]
    if not result.sources and not result.rejected:
        result.findings.append(Finding("nothing", "no picture was found in the inputs"))
    result.findings += times_without_zone(frame for source in result.sources for frame in source.frames)
    return result


def _unread(found: Discovery, *, needed: bool) -> list[Finding]:
    """What is said about files beside pictures that may hold their positions; needed: some pictures have none."""
    files: dict[str, list[Path]] = {}
    for folder in found.folders:
        for path in folder.unread:
            files.setdefault(path.suffix.lower(), []).append(path)
    if not files or not any(folder.pictures or folder.videos for folder in found.folders):
        return []
    named = [
        found.name(paths[0]) + (f" and {len(paths) - 1} more {suffix}" if paths[1:] else "")
        for suffix, paths in sorted(files.items())
    ]
    text = (
        f"not read, though it may hold positions: {', '.join(named)}; convert a track to GPX or NMEA, positions of "
        "photos to a geo.txt or CSV"
    )
    return [Finding("side-file-unread", text, note=not needed)]


def _logs_apart(found: Discovery, logs: Sequence[LogSource]) -> list[Finding]:
    """A finding on the logs that apply to no picture, as there is none in their folder or below."""
    places = [folder.path for folder in found.folders if folder.pictures or folder.videos]
    apart = [log for log in logs if not any(place.is_relative_to(log.folder) for place in places)]
    if not apart or not places:
        return []
    names = list(dict.fromkeys(log.source.path for log in apart))
    more = f" and {len(names) - 3} more" if names[3:] else ""
    text = (
        f"no picture lies in the folder of {', '.join(names[:3])}{more} or below it, so that none gets poses from "
        "there: put a log into the folder of its vehicle's pictures, or name it as an input of its own"
    )
    return [Finding("log-apart", text)]


def _copy_findings(found: Discovery) -> list[Finding]:
    """One finding for each two folders of which one holds copies of the other's photos."""
    counts = Counter((copy.parent, first.parent) for copy, first in found.copies.items())

    def name(folder: Path) -> str:
        return folder.name if folder == found.root else found.name(folder)

    findings = []
    for (there, here), count in counts.items():
        text = (
            f"{count} photos in {name(there)} are the same files as photos in {name(here)}; both are used, as two "
            "vehicles: leave one folder out if it is a backup"
        )
        findings.append(Finding("copies", text))
    return findings


def _tables(found: Discovery, result: Survey) -> list[tuple[Path, str, PoseTable]]:
    """Pose tables with the folder they apply to (and what lies below), innermost last."""
    tables: list[tuple[Path, str, PoseTable]] = []
    for folder in found.folders:
        for path in folder.tables:
            table: PoseTable | Unreadable | None
            copy = read_or_reason(local_file, path)
            if isinstance(copy, Unreadable):
                table, kind = copy, "table"
            elif geo_txt.is_geo_txt(copy):
                table, kind = read_or_reason(geo_txt.read_geo_txt, copy), "geo.txt"
            else:
                table = read_or_reason(pose_csv.read_pose_csv, copy)
                kind = "CSV" if path.suffix.lower() == ".csv" else "table"
            if isinstance(table, Unreadable):
                result.findings.append(Finding("table-unreadable", f"{found.name(path)} is not used: {table}"))
            elif table is None:
                assert isinstance(copy, Path)
                if pose_csv.names_pictures(copy) and read_control_points(copy) is None:
                    text = "names pictures, but is not a table of poses that is known; it is not used"
                    result.findings.append(Finding("table-unknown", f"{found.name(path)} {text}", note=True))
            else:
                where = found.scope(path)
                tables.append((where, kind, table))
                source = SourceInfo(path=found.name(path), kind=kind, counts=Counter(poses=len(table)))
                below = (p for f in found.folders for p in f.pictures if p.is_relative_to(where))
                pictures = [picture.relative_to(where).as_posix() for picture in below]
                source.findings += _match_pictures(path, table, pictures)
                source.findings += _table_findings(path, table, pictures)
                result.sources.append(source)
    return sorted(tables, key=lambda entry: len(entry[0].parts))


def _table_findings(path: Path, table: PoseTable, pictures: Sequence[str]) -> list[Finding]:
    """Findings on lines of a pose table that have no pose, or name missing pictures (paths from the table's folder)."""
    findings = []
    if table.useless:
        text = f"{plural(table.useless, 'line')} of {path.name} hold no valid position; they are not used"
        findings.append(Finding("table-lines", text))
    if table.doubt:
        findings.append(Finding("table-datum", f"{path.name}: {table.doubt}"))
    if table.refused:
        text = (
            f"{plural(table.refused, 'cell')} of {path.name} cannot be read as the values that their titles name, "
            f"'{table.first_refused}' first; they are not used"
        )
        findings.append(Finding("table-cells", text))
    names = {name for picture in pictures for name in names_of(picture)}
    absent = [name for name in table if name not in names]
    if absent:
        text = f"{plural(len(absent), 'line')} of {path.name} name pictures that are not here, {absent[0]} first"
        findings.append(Finding("table-pictures", text, note=len(absent) < len(table)))
    return findings


def _match_pictures(path: Path, table: PoseTable, pictures: Sequence[str]) -> list[Finding]:
    """Match lines to pictures where all paths are those of another place, and say so."""
    if any(name in table for picture in pictures for name in names_of(picture)):
        return []
    left_out = leave_out_folder(table, pictures)
    if left_out:
        text = f"the paths in {path.name} begin with '{left_out}', which is not here; they are read without it"
        return [Finding("table-folder", text, note=True)]
    matched = take_base_names(table, pictures)
    if not matched:
        return []
    text = (
        f"the paths in {path.name} lead elsewhere; {plural(matched, 'line')} are matched by the file's name, which "
        "only one picture has: check that they belong to these pictures"
    )
    return [Finding("table-base-names", text)]


def _photo_folder(
    folder: Folder,
    tags: Iterable[Photo | Unreadable | None],
    found: Discovery,
    *,
    tables: Sequence[tuple[Path, str, PoseTable]],
    logs: Sequence[LogSource],
    result: Survey,
    options: LoadOptions,
) -> None:
    """Make one source from a folder's photos with these tags."""
    named = folder.path.name if folder.path == found.root else found.name(folder.path)
    source = SourceInfo(path=named, kind="photos")
    groups: dict[str, list[Photo]] = {}
    seen, moved_m, raised_m, twice = 0, list[float](), list[tuple[float, float]](), 0
    finished = {path.with_suffix("") for path in folder.pictures if path.suffix.lower() != RAW_SUFFIX}
    for path, photo in zip(folder.pictures, tags, strict=True):
        if photo is None:
            continue
        if path.suffix.lower() == RAW_SUFFIX and path.with_suffix("") in finished:
            twice += 1
            continue
        seen += 1
        name = found.name(path)
        if isinstance(photo, Unreadable):
            result.rejected.append(Rejection(name, str(photo), folder.vehicle))
            continue
        if path in folder.sidecars:
            photo = _with_sidecar(photo, folder.sidecars[path], found, source)
        own_m = photo.altitude_m
        vehicle = _merge_tables(photo, path, tables, moved_m) or folder.vehicle
        if photo.altitude_m != own_m and photo.altitude_m is not None and own_m is not None:
            raised_m.append((photo.altitude_m, own_m))
        groups.setdefault(vehicle, []).append(photo)
    if twice:
        text = f"{plural(twice, 'raw picture')} not used: a finished picture of the same exposure lies beside each"
        source.findings.append(Finding("raw-pictures", text, note=True))
    if moved_m:
        text = (
            f"tables put {plural(len(moved_m), 'picture')} up to {max(moved_m) / 1000:.1f} km from where its tags or "
            "another table say; the last table by name counts: check it, or take it away"
        )
        source.findings.append(Finding("positions-contradict", text))
    source.findings += _altitudes_contradict(np.array(raised_m).reshape(-1, 2))
    for vehicle in sorted(groups, key=natural_key):
        photos = sorted(groups[vehicle], key=lambda p: natural_key(p.path.name))
        photos.sort(key=lambda p: math.inf if p.time_s is None else p.time_s)
        add_logs(photos, folder.path, vehicle, logs=logs, findings=source.findings, workers=options.workers)
        others = of_other_kinds(photos, options.camera, options.band)
        photos = _without(others, photos, vehicle, found, result)
        photos = _without(strangers(photos), photos, vehicle, found, result)
        photos = _without(of_second_cameras(photos), photos, vehicle, found, result)
        photos = _with_position(photos, vehicle, found, result)
        photos = in_order(photos, vehicle, source.findings)
        source.findings += settle_positions(photos, vehicle, found.name)
        photos = _where_it_can_be(photos, vehicle, found, source, result)
        source.sees = (photos[0].sensor, photos[0].band) if photos else source.sees
        frames = frames_of(photos, vehicle, found.name, source.findings)
        source.frames += frames
        source.findings += flight_findings(photos, frames, vehicle)
    source.counts["frames"] = len(source.frames)
    if seen:
        result.sources.append(source)


def _with_sidecar(photo: Photo, sidecar: Path, found: Discovery, source: SourceInfo) -> Photo:
    """A photo with the tags of an XMP file beside it; as it is, with a finding, if that cannot be read."""
    try:
        return with_sidecar(photo.path, local_file(sidecar))
    except (OSError, Unreadable) as error:
        source.findings.append(Finding("unreadable", f"{found.name(sidecar)} is not used: {error}"))
        return photo


def _without(odd: Reasons, photos: Sequence[Photo], vehicle: str, found: Discovery, result: Survey) -> list[Photo]:
    """Photos without some, which are rejected."""
    result.rejected += [
        Rejection(found.name(photos[i].path), why, vehicle, photos[i].time_s, detail=detail)
        for i, (why, detail) in odd.items()
    ]
    return [photo for i, photo in enumerate(photos) if i not in odd]


def _with_position(photos: Sequence[Photo], vehicle: str, found: Discovery, result: Survey) -> list[Photo]:
    """Keep photos with a position; the others are rejected, with the reason, and listed for surveyed points."""
    placed = []
    for photo in photos:
        if photo.lat_deg is not None and photo.lon_deg is not None:
            placed.append(photo)
        else:
            why, detail = photo.unplaced
            reason = f": {why}" if why else "; put a geo.txt next to it, or give its log as well"
            _leave_out(
                photo, vehicle, found.name(photo.path), f"the picture has no position{reason}", result, detail=detail
            )
    return placed


def _leave_out(photo: Photo, vehicle: str, name: str, reason: str, result: Survey, *, detail: str = "") -> None:
    """Reject a photo without a usable position, and list it for surveyed points."""
    result.rejected.append(Rejection(name, reason, vehicle, photo.time_s, True, detail=detail))
    result.unpositioned.append(frame_without_position(photo, vehicle, name))


def _where_it_can_be(
    photos: Sequence[Photo], vehicle: str, found: Discovery, source: SourceInfo, result: Survey
) -> list[Photo]:
    """Photos without those whose positions the aircraft cannot have reached; these are rejected like those without.

    Where the clock was set back, photos of two places seem to alternate, and nothing is known of speeds.
    """
    if clock_went_back(photos) or any(SHIFTED in p.origin.get("time", "") for p in photos):
        return list(photos)
    photos = _measured(photos, vehicle, found, source, result)
    wild = wild_fixes([p.time_s for p in photos], [(p.lat_deg or 0.0, p.lon_deg or 0.0) for p in photos])
    if wild.doubtful:
        source.findings.append(replace(doubtful_finding(wild.doubtful, plural(len(photos), "photo")), vehicle=vehicle))
    if not wild.indices:
        return list(photos)
    text = (
        f"{plural(len(wild.indices), 'picture')} up to {metres(wild.away_m)} away from the pictures before and after "
        f"({found.name(photos[wild.indices[0]].path)} first), farther than any aircraft flies in that time; their "
        "positions are wrong, and they are left out"
    )
    source.findings.append(Finding("position-astray", text, vehicle))
    reason = (
        "its position is farther from those before and after than any aircraft flies in that time; put a geo.txt "
        "with the right one next to it"
    )
    for i in wild.indices:
        _leave_out(photos[i], vehicle, found.name(photos[i].path), reason, result)
    return [photo for i, photo in enumerate(photos) if i not in set(wild.indices)]


def _measured(
    photos: Sequence[Photo], vehicle: str, found: Discovery, source: SourceInfo, result: Survey
) -> list[Photo]:
    """Photos whose receiver measured; others lie between those before and after, or are left out without a position."""
    places = [(p.lat_deg or 0.0, p.lon_deg or 0.0) for p in photos]
    void = void_fixes(photos)
    held = held_fixes([p.time_s for p in photos], places, void)
    lost = set(one_fix(places))
    if lost:
        many = f"all {len(photos)}" if len(lost) == len(photos) else f"{len(lost)} of {len(photos)}"
        text = f"{many} photos tell one place to the last digit: the receiver stood still, it is not used"
        source.findings.append(Finding("position-held", text, vehicle))
    lost |= void.difference(held.index)
    for i, lat, lon, sigma in held.each():
        if sigma > LOST_SIGMA_M:
            lost.add(i)
            continue
        photos[i].lat_deg, photos[i].lon_deg = lat, lon
        photos[i].position_sigma_m = stated_sigma_m(photos[i].position_sigma_m, sigma)
        photos[i].origin["position"] = "between the photos before and after, as the receiver did not measure"
    if held.index and (void or matters(held)):
        whose = f"{plural(len(photos), 'photo')} ({found.name(photos[held.index[0]].path)} first)"
        source.findings.append(replace(held.finding(whose, void=bool(void)), vehicle=vehicle))
    steps_m = coarse_m(places)
    if steps_m > _COARSE_TOLD_M:
        for photo in photos:
            photo.position_sigma_m = math.hypot(photo.position_sigma_m or UNSTATED_SIGMA_M, _ROUNDED * steps_m)
        text = (
            f"positions are written in steps of {metres(steps_m)}: they are known to half of that, as their sigma says"
        )
        source.findings.append(Finding("position-coarse", text, vehicle))
    for i in sorted(lost):
        _leave_out(photos[i], vehicle, found.name(photos[i].path), _NOT_MEASURED, result)
    return [photo for i, photo in enumerate(photos) if i not in lost]


def _altitudes_contradict(raised_m: Array) -> list[Finding]:
    """A finding where altitudes by tables and by photos' own tags (N, 2), metres, are far apart."""
    off_m = float(np.median(np.abs(raised_m[:, 0] - raised_m[:, 1]))) if len(raised_m) else 0.0
    if off_m <= ALTITUDE_CONTRADICTS_M:
        return []
    table_m, own_m = np.median(raised_m, axis=0)
    feet = "; these look like feet" if abs(table_m * _FOOT_M - own_m) < _LIKE_FEET * abs(own_m) else ""
    text = (
        f"tables put {plural(len(raised_m), 'picture')} at other altitudes than their tags, {table_m:.0f} m instead of "
        f"{own_m:.0f} m, {metres(off_m)} apart (medians){feet}; the tables count: check their unit"
    )
    return [Finding("altitudes-contradict", text)]


def _merge_tables(
    photo: Photo, path: Path, tables: Iterable[tuple[Path, str, PoseTable]], moved_m: list[float]
) -> str | None:
    """Overwrite the photo's own tags by table values, field by field; returns the vehicle's name if a table has one.

    How far a position contradicts the one before, if it does, is added to `moved_m`.
    """
    vehicle = None
    for where, kind, table in tables:
        if not path.is_relative_to(where):
            continue
        row = lookup(table, path.relative_to(where).as_posix())
        if row is None:
            continue
        vehicle = row.vehicle or vehicle
        if row.has_position:
            if photo.lat_deg is not None and photo.lon_deg is not None:
                away = distance_m(photo.lat_deg, photo.lon_deg, *row.place)
                if away > _CONTRADICTION_M:
                    moved_m.append(away)
            photo.lat_deg, photo.lon_deg = row.lat_deg, row.lon_deg
            photo.origin["position"] = kind
            photo.position_sigma_m = row.sigma_m if row.sigma_m is not None else photo.position_sigma_m
        if row.altitude_m is not None:
            photo.altitude_m = row.altitude_m
        if row.height_m is not None:
            photo.height_m, photo.origin["height"] = row.height_m, kind
        if row.time_s is not None:
            photo.time_s, photo.origin["time"] = row.time_s, kind
        if row.fov_deg is not None and 2.0 < row.fov_deg < 150.0:
            photo.fov_hint_rad, photo.origin["fov_hint"] = math.radians(row.fov_deg), kind
        angles: Angles = (row.yaw_deg, row.pitch_deg, row.roll_deg)
        if any(angle is not None for angle in angles):
            own = photo.camera_deg
            photo.camera_deg = (
                own[0] if angles[0] is None else angles[0],
                own[1] if angles[1] is None else angles[1],
                own[2] if angles[2] is None else angles[2],
            )
            photo.origin["angles"] = kind
            photo.yaw_is_stated |= angles[0] is not None
    return vehicle
