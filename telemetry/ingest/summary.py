"""The summary for `inspect`: sources, vehicles, legs and findings as plain data."""

from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.frame import Frame
from telemetry.ingest.discovery import natural_key
from telemetry.ingest.side_files import control_point_findings, raster_finding, read_control_points
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
    return {
        "id": vehicle,
        "frames": shown,
        **_flown(_thinned(ground_track(placed)), times),
        **_ranges(height_m=[s.height_m for s in samples], pitch_deg=[s.pitch_deg for s in samples]),
    }


def _thinned(ground: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions thinned to a least distance; the legs of a dense track are those of its thinned one."""
    spaced: list[int] = []
    for i, point in enumerate(ground):
        if not spaced or np.hypot(*(point - ground[spaced[-1]])) >= _THINNED_M:
            spaced.append(i)
    return ground[spaced] if spaced else np.zeros((0, 2))


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
