"""The summary for `inspect`: sources, vehicles, legs and findings as plain data.

Control points and georeferenced rasters next to pictures are reported, not mapped.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.frame import Frame
from telemetry.ingest.discovery import natural_key
from telemetry.ingest.survey import SourceInfo, Survey
from telemetry.photos.picture_motion import heading_findings
from telemetry.samples.course import ground_track, length_m, straight_legs
from telemetry.samples.findings import Finding, plural
from telemetry.samples.sample import Sample

_COUNTS = ("frames", "sei", "klv", "camera_events")
_THINNED_M = 3.0


def summarise(found: Survey, *, pictures: bool = True) -> dict[str, Any]:
    """The document of `inspect --json`; with `pictures`, pairs of them are matched to confirm the recorded yaw."""
    sources = [_source(source, pictures=pictures) for source in found.sources]
    sources += _side_files(found)
    return {
        "root": str(found.root),
        "sources": sources,
        "rejected": [
            {"image": r.image, "reason": r.reason, **({"detail": r.detail} if r.detail else {})} for r in found.rejected
        ],
        "findings": [_plain(f) for f in found.findings],
    }


def iso(time_s: float | None) -> str | None:
    """ISO 8601 in UTC with milliseconds; None for None and for times outside the calendar."""
    if time_s is None or not 0.0 <= time_s < 7.3e9:
        return None
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _plain(finding: Finding) -> dict[str, Any]:
    return {
        "code": finding.code,
        "message": str(finding),
        "severity": "note" if finding.note else "warning",
        "vehicle": finding.vehicle,
    }


def _source(source: SourceInfo, *, pictures: bool) -> dict[str, Any]:
    findings = list(source.findings)
    by_vehicle: dict[str, list[Frame]] = {}
    for frame in source.frames:
        by_vehicle.setdefault(frame.vehicle, []).append(frame)
    if pictures:
        for vehicle, frames in by_vehicle.items():
            findings += heading_findings(frames, vehicle)
    vehicles = [_of_frames(vehicle, frames, source) for vehicle, frames in by_vehicle.items()]
    vehicles += [
        _of_samples(vehicle, samples, source.shown.get(vehicle, 0))
        for vehicle, samples in source.tracks.items()
        if vehicle not in by_vehicle
    ]
    return {
        "path": source.path,
        "kind": source.kind,
        "counts": {**dict.fromkeys(_COUNTS, 0), **source.counts},
        "vehicles": sorted(vehicles, key=lambda v: natural_key(v["id"])),
        "findings": [_plain(f) for f in findings],
    }


def _of_frames(vehicle: str, frames: Sequence[Frame], source: SourceInfo) -> dict[str, Any]:
    times = [f.time_s for f in frames if f.time_s is not None]
    ground = ground_track([f.fix for f in frames])
    return {
        "id": vehicle,
        "frames": source.shown.get(vehicle, len(frames)),
        **_flown(ground, times),
        "cameras": sorted({f.camera for f in frames}),
        "fields": _fields([f.origin for f in frames]),
        **_ranges(
            height_m=[f.fix.height_m for f in frames],
            pitch_deg=[None if f.fix.pitch_rad is None else float(np.degrees(f.fix.pitch_rad)) for f in frames],
        ),
    }


def _of_samples(vehicle: str, samples: Sequence[Sample], shown: int) -> dict[str, Any]:
    placed = [s for s in samples if s.lat_deg is not None and s.lon_deg is not None]
    times = [s.time_s for s in samples if s.time_s is not None]
    # The legs of a dense track are those of one thinned to a least distance.
    ground = ground_track(placed)
    spaced: list[int] = []
    for i, point in enumerate(ground):
        if not spaced or np.hypot(*(point - ground[spaced[-1]])) >= _THINNED_M:
            spaced.append(i)
    return {
        "id": vehicle,
        "frames": shown,
        **_flown(ground[spaced] if spaced else np.zeros((0, 2)), times),
        **_ranges(height_m=[s.height_m for s in samples], pitch_deg=[s.pitch_deg for s in samples]),
    }


def _flown(ground: NDArray[np.float64], times: Sequence[float]) -> dict[str, Any]:
    return {
        "legs": len(straight_legs(ground)),
        "start": iso(min(times)) if times else None,
        "end": iso(max(times)) if times else None,
        "length_m": round(length_m(ground), 1),
    }


def _ranges(**columns: Iterable[float | None]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, values in columns.items():
        known = [v for v in values if v is not None]
        # Adding zero makes -0.0 a plain 0.0.
        result[name] = [round(min(known), 2) + 0.0, round(max(known), 2) + 0.0] if known else None
    return result


def _fields(origins: Sequence[dict[str, str]]) -> dict[str, str]:
    """Field -> its most frequent source."""
    sources: dict[str, Counter[str]] = {}
    for origin in origins:
        for name, source in origin.items():
            sources.setdefault(name, Counter())[source] += 1
    return {name: counts.most_common(1)[0][0] for name, counts in sorted(sources.items())}


def _side_files(found: Survey) -> list[dict[str, Any]]:
    """Control points and georeferenced rasters beside the pictures."""
    if found.discovery is None:
        return []
    used = {frame.path for source in found.sources for frame in source.frames}
    refused = {rejection.image for rejection in found.rejected}
    widths = [frame.width for source in found.sources for frame in source.frames]
    sources = []
    for folder in found.discovery.folders:
        for path in folder.tables:
            points = read_control_points(path) if path.suffix.lower() == ".txt" else None
            if points is not None:
                sources.append(_bare(found, path, "control points", control_point_findings(path, points, widths)))
        for path in folder.pictures:
            if path.suffix.lower() in (".tif", ".tiff") and path not in used:
                finding = raster_finding(path) if found.discovery.name(path) not in refused else None
                if finding is not None:
                    sources.append(_bare(found, path, "raster", [finding]))
    return sources


def _bare(found: Survey, path: Path, kind: str, findings: list[Finding]) -> dict[str, Any]:
    assert found.discovery is not None
    return {
        "path": found.discovery.name(path),
        "kind": kind,
        "counts": dict.fromkeys(_COUNTS, 0),
        "vehicles": [],
        "findings": [_plain(f) for f in findings],
    }


def one_line(source: dict[str, Any]) -> str:
    """A source in a few words."""
    counts = [plural(count, noun) for name, noun in _NOUNS.items() if (count := source["counts"].get(name, 0))]
    flown = any(vehicle["length_m"] for vehicle in source["vehicles"])
    return f"{source['path']} ({source['kind']}): {', '.join(counts) or ('a track' if flown else 'nothing to map')}"


_NOUNS = {
    "frames": "picture", "sei": "SEI message", "klv": "KLV packet", "camera_events": "camera event", "poses": "pose",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ControlPoints:
    """Summary of an ODM control point file."""

    rows: int  # number of observations
    points: int  # number of points
    heights: tuple[float, ...]  # their z values
    widest: float  # largest column of a pixel
    images: frozenset[str]  # lower-case names of pictures


def read_control_points(path: Path) -> ControlPoints | None:
    """Read an ODM `gcp_list.txt` (projection, then x y z column row image); None if it is another file."""
    try:
        if path.stat().st_size > 8 << 20:
            return None
        lines = path.read_text("utf-8", "replace").splitlines()
    except OSError:
        return None
    points: dict[tuple[float, float], float] = {}
    images, widest, rows = set(), 0.0, 0
    for line in lines[1:]:
        words = line.split()
        try:
            x, y, z, column, _ = (float(word) for word in words[:5])
        except ValueError:
            continue
        if len(words) < 6 or Path(words[5]).suffix.lower() not in (".jpg", ".jpeg", ".tif", ".tiff", ".png", ".dng"):
            continue
        points[x, y] = z
        images.add(words[5].lower())
        widest, rows = max(widest, column), rows + 1
    return ControlPoints(rows, len(points), tuple(points.values()), widest, frozenset(images)) if rows else None


def control_point_findings(path: Path, points: ControlPoints, widths: Collection[int]) -> list[Finding]:
    """Findings on control points, given the widths of the pictures near them."""
    text = (
        f"{path.name} holds {points.points} ground control points in {points.rows} pictures; mosaic uses them where "
        "the file is given with --control"
    )
    found = [Finding("control-points", text, note=True)]
    width = max(widths, default=0)
    if width and points.widest > 1.05 * width:
        found.append(
            Finding(
                "control-points-scale",
                f"the pixels of {path.name} go up to column {points.widest:.0f}, but the pictures are {width} wide: "
                "they belong to larger originals and have to be scaled",
            )
        )
    if len(points.heights) > 2 and len(set(points.heights)) == 1:
        text = f"all control points of {path.name} have the same height, {points.heights[0]:g} m: it was not measured"
        found.append(Finding("control-points-height", text))
    return found


def raster_finding(path: Path) -> Finding | None:
    """Finding that describes a georeferenced raster; None if it cannot be read."""
    import rasterio
    from rasterio.errors import RasterioError

    try:
        with rasterio.open(path) as raster:
            gsd = abs(raster.transform.a)
            crs = raster.crs.to_string() if raster.crs else "no CRS"
            kind = raster.dtypes[0]
            unit = " m" if raster.crs and raster.crs.is_projected else ""
            what = "colours" if raster.count >= 3 and kind == "uint8" else "values, such as heights"
            use = "--basemap" if what == "colours" else "--dem"
            text = (
                f"{path.name} is a georeferenced raster and no picture of a camera: {raster.width} x {raster.height}, "
                f"{gsd:g}{unit} a pixel, {crs}, {raster.count} x {kind} {what}; give it with {use}"
            )
    except (RasterioError, OSError, ValueError):
        return None
    return Finding("raster", text, note=True)
