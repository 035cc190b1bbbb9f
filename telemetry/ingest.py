"""From inputs to frames: finds the sources, merges them field by field, decides between contradicting tags.

The richer source wins a field, none throws away what another has: a geo.txt without angles leaves the photos'
angles, and an absolute altitude never becomes a height.
"""

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from orthoswarm.errors import InputError
from orthoswarm.frame import Fix, Frame, Ingest, Rejection
from telemetry import posetable
from telemetry.attitude import check_legs, decide
from telemetry.checks import flight_findings
from telemetry.container import NotAPicture
from telemetry.course import courses_deg, local_metres, straight_legs
from telemetry.discover import Discovery, Folder, discover, natural_key
from telemetry.findings import Finding, plural
from telemetry.order import in_order
from telemetry.photos import Angles, PhotoTags, read_photos
from telemetry.sample import Sample

if TYPE_CHECKING:
    from telemetry.ingest_logs import LogSource

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how many are done, how many there are."""

_LEAST_HEIGHT_M = 1.0
_BANDS = ("", "green", "red", "blue", "nir", "red edge", "rededge")
"""Spectral bands by how well they show the ground; "" is a colour picture."""


@dataclass(frozen=True, slots=True)
class LoadOptions:
    """How inputs are read.

    Attributes:
        every_m: distance between pictures taken from a video, metres; None for the default of `telemetry.picks`.
        every_s: seconds between pictures taken from a video.
        cache: folder for pictures taken from videos; None makes one under the system's temporary folder.
        exclude: files and folders that are left out (the output folder, for instance).
        workers: threads that read.
        decode: False to look at the metadata of videos only, without taking pictures (for `inspect`).
    """

    every_m: float | None = None
    every_s: float | None = None
    cache: Path | None = None
    exclude: tuple[Path, ...] = ()
    workers: int = field(default_factory=lambda: min(8, (os.cpu_count() or 1) * 2))
    decode: bool = True


@dataclass(slots=True)
class SourceInfo:
    """One source for `inspect`: a folder of photos, a video, a log or a table.

    Attributes:
        path: relative to the inputs' root. kind: "photos", "video", "geo.txt" and so on.
        counts: `frames`, `sei`, `klv`, `camera_events`. findings: what is suspicious.
        frames: the frames. tracks: for sources without frames, the poses of each vehicle in order.
        shown: number of pictures of each vehicle where that is not the number of its frames.
    """

    path: str
    kind: str
    counts: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    tracks: dict[str, list[Sample]] = field(default_factory=dict)
    shown: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class Survey:
    """Everything that was found out about a set of inputs."""

    root: Path
    discovery: Discovery | None = None
    sources: list[SourceInfo] = field(default_factory=list)
    rejected: list[Rejection] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def frames(self) -> list[Frame]:
        """All frames by vehicle, then time, then natural name order."""
        return sorted((frame for source in self.sources for frame in source.frames), key=_frame_key)


def _frame_key(frame: Frame) -> tuple[object, ...]:
    return (
        natural_key(frame.vehicle),
        frame.vehicle,
        math.inf if frame.time_s is None else frame.time_s,
        natural_key(frame.image),
    )


def load(inputs: Sequence[Path], *, progress: Progress | None = None, options: LoadOptions | None = None) -> Ingest:
    """Read inputs into frames.

    Args:
        inputs: folders of photos (recursive; each folder with photos is one vehicle), photos, videos.
        progress: called while reading.
        options: see LoadOptions.

    Raises:
        InputError: an input does not exist or is of no known kind, or a pose table is damaged.
    """
    found = survey(inputs, progress=progress, options=options)
    findings = [*found.findings, *(f for source in found.sources for f in source.findings)]
    warnings = dict.fromkeys(str(finding) for finding in findings if not finding.note)
    return Ingest(found.frames(), found.rejected, list(warnings))


def survey(inputs: Sequence[Path], *, progress: Progress | None = None, options: LoadOptions | None = None) -> Survey:
    """The same as `load`, source by source, for `inspect`."""
    from telemetry.ingest_logs import read_logs
    from telemetry.ingest_video import read_videos

    options = options or LoadOptions()
    found = discover([Path(path) for path in inputs], options.exclude)
    result = Survey(found.root, found)
    vehicles = {folder.path: folder.vehicle for folder in found.folders}
    for path, why in found.left_out:
        result.rejected.append(Rejection(found.name(path), why, vehicles.get(path.parent, "")))
    tables = _tables(found, result)
    logs = read_logs(found, result)
    total = sum(len(folder.pictures) for folder in found.folders)
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress("reading photos", done, total)

    for folder in found.folders:
        if folder.pictures:
            _photo_folder(folder, found, tables, logs, options, advance, result)
        if folder.videos or folder.subtitles:
            read_videos(folder, found, logs, options, progress, result)
    _check_vehicles(result)
    return result


def _tables(found: Discovery, result: Survey) -> list[tuple[Path, str, posetable.PoseTable]]:
    """Pose tables with the folder they apply to (and what lies below), innermost last."""
    tables: list[tuple[Path, str, posetable.PoseTable]] = []
    for folder in found.folders:
        for path in folder.tables:
            if posetable.is_geo_txt(path):
                table: posetable.PoseTable | None = posetable.read_geo_txt(path)
                kind = "geo.txt"
            elif path.suffix.lower() == ".csv":
                table, kind = posetable.read_pose_csv(path), "CSV"
            else:
                continue
            if table is not None:
                tables.append((folder.path, kind, table))
                source = SourceInfo(found.name(path), kind)
                source.findings += _table_findings(path, folder.path, table, found)
                result.sources.append(source)
    return sorted(tables, key=lambda entry: len(entry[0].parts))


def _table_findings(path: Path, folder: Path, table: posetable.PoseTable, found: Discovery) -> list[Finding]:
    """Lines of a pose table that say nothing, or are about pictures that are not there."""
    findings = []
    if table.useless:
        text = f"{plural(table.useless, 'line')} of {path.name} hold no position that can be one; they are not used"
        findings.append(Finding("table-lines", text))
    pictures = [p for f in found.folders for p in f.pictures if p.is_relative_to(folder)]
    names = {p.name.lower() for p in pictures} | {p.relative_to(folder).as_posix().lower() for p in pictures}
    absent = [name for name in table if name not in names]
    if absent:
        text = f"{plural(len(absent), 'line')} of {path.name} name pictures that are not here, {absent[0]} first"
        findings.append(Finding("table-pictures", text, note=len(absent) < len(table)))
    return findings


def _photo_folder(
    folder: Folder,
    found: Discovery,
    tables: Sequence[tuple[Path, str, posetable.PoseTable]],
    logs: "Sequence[LogSource]",
    options: LoadOptions,
    advance: Callable[[int], None],
    result: Survey,
) -> None:
    """Read one folder's photos into one source."""
    from telemetry.ingest_logs import add_logs

    name = found.name(folder.path)
    source = SourceInfo(folder.path.name if name == "." else name, "photos")
    groups: dict[str, list[PhotoTags]] = {}
    seen = 0
    for path, photo in zip(
        folder.pictures, read_photos(folder.pictures, workers=options.workers, progress=advance), strict=True
    ):
        if photo is None:
            continue
        seen += 1
        name = found.name(path)
        if isinstance(photo, NotAPicture):
            result.rejected.append(Rejection(name, str(photo), folder.vehicle))
            continue
        vehicle = _merge_tables(photo, path, tables) or folder.vehicle
        groups.setdefault(vehicle, []).append(photo)
    for vehicle in sorted(groups, key=natural_key):
        photos = sorted(groups[vehicle], key=_photo_key)
        add_logs(photos, folder.path, vehicle, logs, source.findings)
        photos = _with_position(_one_band(photos, vehicle, found, result), vehicle, found, result)
        photos = in_order(photos, vehicle, source.findings)
        frames = frames_of(photos, vehicle, found.name, source.findings)
        source.frames += frames
        source.findings += flight_findings(photos, frames, vehicle)
    source.counts["frames"] = len(source.frames)
    if seen:
        result.sources.append(source)


def _one_band(photos: Sequence[PhotoTags], vehicle: str, found: Discovery, result: Survey) -> list[PhotoTags]:
    """Of a multispectral camera's pictures the colour ones, else those of one band; the others are rejected."""
    bands = {photo.band for photo in photos}
    if len(bands) < 2:
        return list(photos)
    kept = next((band for band in _BANDS if band in {b.lower() for b in bands}), min(bands).lower())
    for photo in photos:
        if photo.band.lower() != kept:
            what = "the colour pictures" if not kept else f"band {kept}"
            reason = f"a picture of one spectral band ({photo.band or 'colour'}); of each exposure {what} is mapped"
            result.rejected.append(Rejection(found.name(photo.path), reason, vehicle, photo.time_s))
    return [photo for photo in photos if photo.band.lower() == kept]


def _with_position(photos: Sequence[PhotoTags], vehicle: str, found: Discovery, result: Survey) -> list[PhotoTags]:
    """Those that have a position; the others are rejected."""
    placed = []
    for photo in photos:
        if photo.lat_deg is not None and photo.lon_deg is not None:
            placed.append(photo)
        else:
            reason = "the picture has no position; put a geo.txt or a log beside it"
            result.rejected.append(Rejection(found.name(photo.path), reason, vehicle, photo.time_s))
    return placed


def _photo_key(photo: PhotoTags) -> tuple[object, ...]:
    return (math.inf if photo.time_s is None else photo.time_s, natural_key(photo.path.name))


def _merge_tables(photo: PhotoTags, path: Path, tables: Iterable[tuple[Path, str, posetable.PoseTable]]) -> str | None:
    """Put what tables say over the photo's own tags, field by field; returns a vehicle's name if one is given."""
    vehicle = None
    for where, kind, table in tables:
        if not path.is_relative_to(where):
            continue
        row = posetable.lookup(table, path.relative_to(where).as_posix())
        if row is None:
            continue
        vehicle = row.vehicle or vehicle
        if row.lat_deg is not None and row.lon_deg is not None:
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
        given: Angles = (row.yaw_deg, row.pitch_deg, row.roll_deg)
        if any(angle is not None for angle in given):
            own = photo.camera_deg
            photo.camera_deg = (
                own[0] if given[0] is None else given[0],
                own[1] if given[1] is None else given[1],
                own[2] if given[2] is None else given[2],
            )
            photo.origin["angles"] = kind
            photo.yaw_is_stated |= given[0] is not None
    return vehicle


def frames_of(
    photos: Sequence[PhotoTags], vehicle: str, name: Callable[[Path], str], findings: list[Finding]
) -> list[Frame]:
    """Frames of one vehicle's photos (in order of time), after its tags were weighed against each other.

    Args:
        photos: with positions.
        vehicle: id.
        name: from a file to its name in the products.
        findings: what was found is appended here.
    """
    ground = local_metres([p.lat_deg or 0.0 for p in photos], [p.lon_deg or 0.0 for p in photos])
    course = courses_deg(ground)
    heights = _heights(photos, findings, vehicle)
    chosen: dict[int, tuple[Angles, str]] = {}
    for model in sorted({p.model for p in photos}):
        index = [i for i, p in enumerate(photos) if p.model == model]
        decided = decide([photos[i] for i in index], course[index], vehicle)
        findings += decided.findings
        chosen.update((i, (angles, decided.yaw_origin)) for i, angles in zip(index, decided.angles, strict=True))
    yaw = np.array([math.nan if (y := chosen[i][0][0]) is None else y for i in range(len(photos))])
    findings += check_legs(yaw, straight_legs(ground, least_frames=4), vehicle)
    return [_frame(photo, vehicle, name(photo.path), heights[i], *chosen[i]) for i, photo in enumerate(photos)]


def _frame(
    photo: PhotoTags, vehicle: str, image: str, height_m: float | None, angles: Angles, yaw_origin: str
) -> Frame:
    def rad(value: float | None) -> float | None:
        return None if value is None else math.radians(value)

    origin = dict(photo.origin)
    if angles[0] is not None and yaw_origin:
        origin["yaw"] = f"{yaw_origin} ({origin.get('angles') or origin.get('flight_yaw', '')})"
    fix = Fix(
        lat_deg=photo.lat_deg or 0.0,
        lon_deg=photo.lon_deg or 0.0,
        height_m=height_m,
        altitude_m=photo.altitude_m,
        yaw_rad=rad(angles[0]),
        pitch_rad=rad(angles[1]),
        roll_rad=rad(angles[2]),
        flight_yaw_rad=rad(photo.flight_deg[0]),
        position_sigma_m=photo.position_sigma_m,
        height_is_ground=photo.height_is_ground,
    )
    return Frame(
        image=image,
        path=photo.path,
        vehicle=vehicle,
        time_s=photo.time_s,
        fix=fix,
        width=photo.width,
        height=photo.height,
        camera=photo.camera,
        fov_hint_rad=photo.fov_hint_rad,
        origin=origin,
    )


def _heights(photos: Sequence[PhotoTags], findings: list[Finding], vehicle: str) -> list[float | None]:
    """Heights that can be true; a height of nothing or below is not, and an altitude is none at all."""
    heights = [p.height_m if p.height_m is not None and math.isfinite(p.height_m) else None for p in photos]
    low = [h for h in heights if h is not None and h < _LEAST_HEIGHT_M]
    if low:
        findings.append(
            Finding(
                "height-implausible",
                f"the recorded height is below {_LEAST_HEIGHT_M:g} m in {plural(len(low), 'photo')} "
                f"(down to {min(low):.1f} m); these heights are ignored",
                vehicle,
            )
        )
    heights = [h if h is not None and h >= _LEAST_HEIGHT_M else None for h in heights]
    missing = sum(h is None for h in heights)
    if missing:
        findings.append(
            Finding(
                "height-missing",
                f"{plural(missing, 'photo')} of {len(photos)} have no height above ground; "
                "it is estimated from the distance flown",
                vehicle,
            )
        )
    altitudes = np.array([p.altitude_m for p in photos if p.altitude_m is not None], dtype=np.float64)
    wrong = altitudes[(altitudes < 0.0) | (altitudes > 15_000.0)]
    if len(wrong):
        findings.append(
            Finding(
                "altitude-implausible",
                f"the GPS altitude is {wrong.min():.0f} to {wrong.max():.0f} m in {plural(len(wrong), 'photo')}, "
                "which cannot be where it flew; altitudes are not used as heights",
                vehicle,
            )
        )
    return heights


def _check_vehicles(result: Survey) -> None:
    """Findings over all sources."""
    if not result.sources and not result.rejected:
        result.findings.append(Finding("nothing", "no picture was found in the inputs"))


def require_frames(ingest: Ingest) -> None:
    """Raise if there is nothing to map, saying why.

    Raises:
        InputError: no frame came out of the inputs.
    """
    if ingest.frames:
        return
    if not ingest.rejected:
        raise InputError("no picture was found in the input; name a folder of photos or a video")
    reasons = Counter(rejection.reason for rejection in ingest.rejected)
    reason, count = reasons.most_common(1)[0]
    raise InputError(f"none of the {plural(len(ingest.rejected), 'picture')} can be used; {count} because {reason}")
