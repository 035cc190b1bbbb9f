"""Videos and their subtitles as sources of frames."""

import hashlib
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from orthoswarm.model.frame import Rejection
from orthoswarm.model.task_runner import Progress
from orthoswarm.stores.local_copies import local_file
from telemetry.formats.video import srt
from telemetry.ingest.discovery import Discovery, Folder
from telemetry.ingest.log_choice import LogSource
from telemetry.ingest.survey import LoadOptions, SourceInfo, Survey
from telemetry.ingest.video_log_match import add_log
from telemetry.photos.photo_frames import frames_of
from telemetry.samples.findings import Finding
from telemetry.samples.sample import Sample
from telemetry.samples.unreadable import Unreadable, read_or_reason, reason_of
from telemetry.samples.wild_fixes import without_wild_fixes
from telemetry.videos.extraction import extract
from telemetry.videos.picture_poses import Poses
from telemetry.videos.video_file import VideoScan, scan

NO_POSITION = "the video carries no position (SEI, KLV, djmd, subtitles); put an SRT next to it, or give its log, too"
_WHY_NOT = ("rate-unknown", "log-ambiguous", "log-unused", "srt-length", "srt-no-position", "unreadable")
"""Findings that say why a log or an SRT that is there gives no position, in this order."""


def read_videos(
    folder: Folder,
    found: Discovery,
    logs: Sequence[LogSource],
    *,
    options: LoadOptions,
    progress: Progress | None,
    result: Survey,
) -> None:
    """Read the videos of a folder, each with the SRT of its name; SRT files without a video are only reported."""
    subtitle_files = {path.stem.lower(): path for path in folder.subtitles}
    taken: set[Path | None] = set()
    for path in folder.videos:
        name = found.name(path)
        subtitles = subtitle_files.get(path.stem.lower())
        taken.add(subtitles)
        copy = read_or_reason(local_file, path)
        scanned = copy if isinstance(copy, Unreadable) else read_or_reason(scan, copy)
        if isinstance(scanned, Unreadable):
            result.rejected.append(Rejection(name, str(scanned), found.videos[path]))
            continue
        source = SourceInfo(path=name, kind="video", counts=Counter(frames=len(scanned.pictures)))
        source.counts["sei"] = scanned.sei_count
        source.counts["klv"] = len(scanned.klv_packets)
        result.sources.append(source)
        cues = None if subtitles is None else _subtitles(subtitles, found.name(subtitles), source.findings)
        poses = read_or_reason(Poses, scanned, cues)
        if isinstance(poses, Unreadable):
            result.rejected.append(Rejection(name, str(poses), found.videos[path]))
            continue
        near = [entry for entry in logs if folder.path.is_relative_to(entry.folder)]
        if near and scanned.has_times and not (poses.has_positions and poses.has_angles):
            matched = read_or_reason(add_log, poses, scanned, near)
            unmatched = [Finding("log-unused", f"no log could be matched with {name}: {matched}")]
            poses.findings += unmatched if isinstance(matched, Unreadable) else matched
        if options.decode:
            _take(
                path,
                name,
                found.videos[path],
                scanned=scanned,
                poses=poses,
                options=options,
                progress=progress,
                source=source,
                result=result,
            )
        else:
            _look(found.videos[path], scanned, poses, source)
    for path in (path for path in folder.subtitles if path not in taken):
        _lone_subtitles(path, found.name(path), result)


def cache_folder(root: Path) -> Path:
    """Folder for pictures of videos if the caller names none."""
    key = hashlib.sha1(str(root).encode(), usedforsecurity=False).hexdigest()[:12]
    return Path(tempfile.gettempdir()) / f"orthoswarm-video-{key}"


def _take(
    path: Path,
    name: str,
    vehicle: str,
    *,
    scanned: VideoScan,
    poses: Poses,
    options: LoadOptions,
    progress: Progress | None,
    source: SourceInfo,
    result: Survey,
) -> None:
    """Extract pictures and make frames of them."""
    if not poses.has_positions:
        source.findings += poses.findings
        result.rejected.append(Rejection(name, _without_position(source.findings), vehicle, lacks_position=True))
        return
    try:
        extraction = extract(
            local_file(path),
            name,
            options.cache or cache_folder(result.root),
            poses=poses,
            every_m=options.every_m,
            every_s=options.every_s,
            progress=None if progress is None else lambda done, total: progress(f"reading {path.name}", done, total),
            found=scanned,
            vehicle=vehicle,
        )
    except OSError:  # the folder for the pictures cannot be written: that is not this video's fault
        raise
    except Exception as error:
        result.rejected.append(Rejection(name, str(reason_of(error)), vehicle))
        return
    source.findings += extraction.findings
    for who, photos in extraction.photos.items():
        source.frames += frames_of(photos, who, lambda jpeg: f"{name}#{extraction.names[jpeg]:06d}", source.findings)
        source.shown[who] = len(photos)


def _without_position(findings: Sequence[Finding]) -> str:
    """Why a video has no position, one sentence."""
    found = {finding.code: finding.message for finding in findings}
    return next((f"it has no position: {found[code]}" for code in _WHY_NOT if code in found), NO_POSITION)


def _look(vehicle: str, scanned: VideoScan, poses: Poses, source: SourceInfo) -> None:
    """Read only the metadata: the poses of all pictures, by vehicle."""
    source.findings += poses.findings
    if not poses.has_positions:
        source.findings.append(Finding("no-position", f"{source.path}: {_without_position(source.findings)}"))
    lost = sum((pose := poses.of(i)) is None or not pose.sample.has_position for i in range(len(scanned.pictures)))
    if poses.has_positions and lost:
        text = f"{lost} pictures of {len(scanned.pictures)} in {source.path} have no position and are not mapped"
        source.findings.append(Finding("pictures-without-position", text))
    order = sorted(range(len(scanned.pictures)), key=lambda i: (scanned.pictures[i].video_s or 0.0, i))
    for index in order:
        pose = poses.of(index)
        sample = pose.sample if pose is not None else Sample()
        vehicle = sample.vehicle or vehicle
        source.shown[vehicle] = source.shown.get(vehicle, 0) + 1
        source.tracks.setdefault(vehicle, []).append(sample)


def _subtitles(path: Path, name: str, findings: list[Finding]) -> srt.Subtitles | None:
    """Read an SRT file; None with a finding if it cannot be read."""
    copy = read_or_reason(local_file, path)
    cues = copy if isinstance(copy, Unreadable) else read_or_reason(srt.read_srt, copy)
    if isinstance(cues, Unreadable):
        findings.append(Finding("unreadable", f"{name} is not used: {cues}"))
        return None
    return cues


def _lone_subtitles(path: Path, name: str, result: Survey) -> None:
    source = SourceInfo(path=name, kind="srt")
    result.sources.append(source)
    cues = _subtitles(path, name, source.findings)
    if cues is None:
        return
    source.findings += [Finding(code, text, note=code == "srt-tuple-order") for code, text in cues.notes.items()]
    source.findings.append(Finding("no-video", f"{path.name} has no video of the same name next to it", note=True))
    source.counts["samples"] = len(cues.cues)
    samples = [cue.sample for cue in cues.cues if cue.sample is not None]
    times = [cue.start_s for cue in cues.cues if cue.sample is not None]
    source.tracks[path.stem], wild = without_wild_fixes(samples, times, path.name)
    source.findings += wild
    source.shown[path.stem] = 0
