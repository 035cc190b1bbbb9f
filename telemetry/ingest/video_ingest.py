"""Videos, their subtitles and the logs that fit them as sources of frames."""

import hashlib
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Bytes
from orthoswarm.model.frame import Rejection
from orthoswarm.model.task_runner import Progress
from orthoswarm.stores.local_copies import local_file
from telemetry.formats.video import srt
from telemetry.ingest.discovery import Discovery, Folder
from telemetry.ingest.log_choice import LogMatch, LogSource, best_log
from telemetry.ingest.pairing.clock_offset import (
    TURNING_MARGIN,
    median_distance_m,
    offset_by_positions,
    offset_by_turning,
    offset_by_zone,
    turning_of_pictures,
)
from telemetry.ingest.survey import LoadOptions, SourceInfo, Survey
from telemetry.photos.photo_frames import frames_of
from telemetry.photos.photo_tags import sensor_of_name
from telemetry.samples.findings import Finding, plural
from telemetry.samples.sample import Sample
from telemetry.samples.unreadable import Unreadable, read_or_reason, reason_of
from telemetry.samples.wild_fixes import sound_positions
from telemetry.videos.extraction import decoded, extract
from telemetry.videos.picture_choice import luma
from telemetry.videos.picture_poses import Poses
from telemetry.videos.video_file import VideoScan, scan

_NO_POSITION = "the video carries no position (SEI, KLV, djmd, subtitles); put an SRT next to it, or give its log, too"
_WHY_NOT = ("rate-unknown", "log-ambiguous", "log-unused", "srt-length", "srt-no-position", "unreadable")
"""Findings that say why a log or an SRT that is there gives no position, in this order."""
_BY_CREATION = "by the container's creation time"
_TURNING_RATE_HZ: Final = 4.0  # pictures a second of a video that are compared with a log's turns
_TURNING_WIDTH_PX: Final = 320  # width at which they are compared
_TURNING_LONGEST_S: Final = 600.0  # longest part of a video that is compared


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
        sees = sensor_of_name(path.stem), ""
        source = SourceInfo(path=name, kind="video", counts=Counter(frames=len(scanned.pictures)), sees=sees)
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
            matched = read_or_reason(_add_log, poses, scanned, near)
            unmatched = [Finding("log-unused", f"no log could be matched with {name}: {matched}")]
            poses.findings += unmatched if isinstance(matched, Unreadable) else matched
        if not options.decode:
            _look(found.videos[path], scanned, poses, source)
        elif poses.has_positions:
            told = None if progress is None else partial(progress, f"reading {path.name}")
            _take(scanned, poses, found.videos[path], options=options, progress=told, source=source, result=result)
        else:
            source.findings += poses.findings
            why = _without_position(source.findings)
            result.rejected.append(Rejection(name, why, found.videos[path], lacks_position=True))
    for path in (path for path in folder.subtitles if path not in taken):
        _lone_subtitles(path, found.name(path), result)


def cache_folder(root: Path) -> Path:
    """Folder for pictures of videos if the caller names none."""
    key = hashlib.sha1(str(root).encode(), usedforsecurity=False).hexdigest()[:12]
    return Path(tempfile.gettempdir()) / f"orthoswarm-video-{key}"


def _take(
    scanned: VideoScan,
    poses: Poses,
    vehicle: str,
    *,
    options: LoadOptions,
    progress: Callable[[int, int], None] | None,
    source: SourceInfo,
    result: Survey,
) -> None:
    """Extract pictures and make frames of them."""
    name = source.path
    try:
        extraction = extract(
            scanned.path, name, options.cache or cache_folder(result.root), poses=poses, every_m=options.every_m,
            every_s=options.every_s, progress=progress, found=scanned, vehicle=vehicle,
        )  # fmt: skip
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
    return next((f"it has no position: {found[code]}" for code in _WHY_NOT if code in found), _NO_POSITION)


def _look(vehicle: str, scanned: VideoScan, poses: Poses, source: SourceInfo) -> None:
    """Read only the metadata: the poses of all pictures, by vehicle."""
    source.findings += poses.findings
    lost = sum((pose := poses.of(i)) is None or not pose.sample.has_position for i in range(len(scanned.pictures)))
    if not poses.has_positions:
        source.findings.append(Finding("no-position", f"{source.path}: {_without_position(source.findings)}"))
    elif lost:
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
    source.tracks[path.stem], wild = sound_positions(samples, times, path.name)
    source.findings += wild
    source.shown[path.stem] = 0


def _add_log(poses: Poses, found: VideoScan, logs: Sequence[LogSource]) -> list[Finding]:
    """Assign a video's pictures the poses of the log that fits it best.

    The clocks are aligned by the video's own positions, else by the rotation of its pictures, else by the
    container's creation time. Where logs of several vehicles fit equally well, only a log that is named like the video
    is taken: the vehicles of a swarm fly at the same time.
    """
    name = found.path.name
    matches = _matches(poses, found, logs)
    if not matches:
        what = "fits its positions" if poses.has_positions else "fits how its pictures turn, or its creation time"
        return [Finding("log-unused", f"no log beside {name} could be aligned with it: none {what}")]
    best = best_log(matches, name, lambda log: log.path.stem.lower() == found.path.stem.lower())
    if isinstance(best, Finding):
        return [best]
    log = best.entry.log
    count = poses.add_track(f"track of {log.path.name}", best.entry.timeline, best.offset_s, has_gimbal=log.has_gimbal)
    if not count:
        return [Finding("log-unused", f"{log.path.name} has no position while {name} was recorded")]
    best.entry.used = True
    text = f"{plural(count, 'picture')} of {name} got poses from {log.path.name}; its clock was found {best.how}"
    return [Finding("posed-by-log", text, note=best.how != _BY_CREATION)]


def _matches(poses: Poses, found: VideoScan, logs: Sequence[LogSource]) -> list[LogMatch]:
    if poses.has_positions:
        times, places = poses.track()
        clocks = {clock for clock in (found.created_s, poses.clock_s) if clock is not None}
        return [m for entry in logs if (m := _by_positions(times, places, clocks, entry)) is not None]
    logs = [entry for entry in logs if any(sample.has_position for sample in entry.log.samples)]
    if not logs:
        return []
    times, rates = _picture_rates(found)
    matches = []
    for entry in logs:
        span = entry.timeline.span
        longest_s = 0.0 if span is None else span[1] - span[0]
        turning = offset_by_turning(times, rates, entry.timeline, search_s=longest_s)
        if turning is not None:
            offset_s, correlation = turning
            how = f"by how its pictures turn (correlation {correlation:.2f})"
            fit = LogMatch(entry=entry, offset_s=offset_s, how=how, rank=0, misfit=-correlation, margin=TURNING_MARGIN)
            matches.append(fit)
        elif found.created_s is not None:
            length = len(found.pictures) / (found.rate or 30.0)
            zone = offset_by_zone(np.array([found.created_s, found.created_s + length]), entry.timeline)
            if zone is not None:
                offset_s = zone - found.created_s
                matches.append(LogMatch(entry=entry, offset_s=offset_s, how=_BY_CREATION, rank=1, misfit=abs(zone)))
    return matches


def _by_positions(times: Array, places: Array, clocks: set[float], entry: LogSource) -> LogMatch | None:
    """The match under the clock (UTC of video time zero, in any zone) that brings the positions nearest to the log."""
    best: LogMatch | None = None
    for clock in clocks:
        offset = offset_by_positions(times + clock, places, entry.timeline, search_s=60.0)
        if offset is None:
            continue
        apart = median_distance_m(times + clock - offset, places, entry.timeline)
        if apart is not None and (best is None or apart < best.misfit):
            best = LogMatch(entry=entry, offset_s=offset - clock, how="by its own positions", rank=0, misfit=apart)
    return best


def _picture_rates(found: VideoScan) -> tuple[Array, Array]:
    """Video times and yaw rates (degrees a second) measured in the pictures of a file's first ten minutes."""
    import cv2

    rate = found.rate or 30.0
    every = max(1, round(rate / _TURNING_RATE_HZ))
    times: list[float] = []
    rates: list[float] = []
    before: tuple[float, Bytes] | None = None
    for number, index, frame in decoded(found):
        if number % every:
            continue
        note = found.pictures[index] if index is not None and index < len(found.pictures) else None
        t = note.video_s if note is not None and note.video_s is not None else number / rate
        if t > _TURNING_LONGEST_S:
            break
        gray = np.ascontiguousarray(luma(frame))
        scale = min(1.0, _TURNING_WIDTH_PX / gray.shape[1])
        small = np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        if before is not None:
            middle, turned = turning_of_pictures([before[1], small], np.array([before[0], t]))
            times += middle.tolist()
            rates += turned.tolist()
        before = t, small
    return np.array(times), np.array(rates)
