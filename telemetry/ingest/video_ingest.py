"""Videos and their subtitles as sources of frames."""

import hashlib
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from orthoswarm.model.frame import Rejection
from telemetry.formats.video import srt
from telemetry.ingest.discovery import Discovery, Folder
from telemetry.ingest.log_ingest import LogSource
from telemetry.ingest.survey import LoadOptions, Progress, SourceInfo, Survey
from telemetry.ingest.video_log_match import add_log
from telemetry.photos.photo_frames import frames_of
from telemetry.samples.findings import Finding
from telemetry.samples.sample import Sample
from telemetry.video.extraction import extract
from telemetry.video.picture_poses import Poses
from telemetry.video.video_file import NotAVideo, VideoScan, scan

NO_POSITION = "the video carries no position (SEI, KLV, djmd, subtitles); put an SRT beside it or name a log, too"


def read_videos(
    folder: Folder,
    found: Discovery,
    logs: Sequence[LogSource],
    options: LoadOptions,
    progress: Progress | None,
    result: Survey,
) -> None:
    """Read the videos of a folder, each with the SRT of its name; SRT files without a video are named only."""
    beside = {path.stem.lower(): path for path in folder.subtitles}
    for path in folder.videos:
        name = found.name(path)
        subtitles = beside.pop(path.stem.lower(), None)
        try:
            scanned = scan(path)
        except (NotAVideo, OSError) as reason:
            result.rejected.append(Rejection(name, str(reason), found.videos[path]))
            continue
        source = SourceInfo(name, "video", Counter(frames=len(scanned.pictures)))
        source.counts["sei"] = scanned.sei_count
        source.counts["klv"] = len(scanned.klv_packets)
        result.sources.append(source)
        poses = Poses(scanned, srt.read_srt(subtitles) if subtitles is not None else None)
        near = [entry for entry in logs if folder.path.is_relative_to(entry.folder)]
        if near and not (poses.has_positions and poses.has_angles):
            poses.findings += add_log(poses, scanned, near)
        if options.decode:
            _take(path, name, found.videos[path], scanned, poses, options, progress, source, result)
        else:
            _look(found.videos[path], scanned, poses, source)
    for path in beside.values():
        _lone_subtitles(path, found.name(path), result)


def cache_folder(root: Path) -> Path:
    """Where pictures of videos go if the caller names no folder."""
    key = hashlib.sha1(str(root).encode(), usedforsecurity=False).hexdigest()[:12]
    return Path(tempfile.gettempdir()) / f"orthoswarm-video-{key}"


def _take(
    path: Path,
    name: str,
    vehicle: str,
    scanned: VideoScan,
    poses: Poses,
    options: LoadOptions,
    progress: Progress | None,
    source: SourceInfo,
    result: Survey,
) -> None:
    """Take pictures and make frames of them."""
    if not poses.has_positions:
        result.rejected.append(Rejection(name, NO_POSITION, vehicle))
        return
    taken = extract(
        path,
        name,
        options.cache or cache_folder(result.root),
        poses=poses,
        every_m=options.every_m,
        every_s=options.every_s,
        progress=None if progress is None else lambda done, total: progress(f"reading {path.name}", done, total),
        found=scanned,
        vehicle=vehicle,
    )
    source.findings += taken.findings
    for who, photos in taken.photos.items():
        source.frames += frames_of(photos, who, lambda jpeg: f"{name}#{taken.names[jpeg]:06d}", source.findings)
        source.shown[who] = len(photos)


def _look(vehicle: str, scanned: VideoScan, poses: Poses, source: SourceInfo) -> None:
    """Only the metadata: the poses of all pictures, by vehicle."""
    source.findings += poses.findings
    order = sorted(range(len(scanned.pictures)), key=lambda i: (scanned.pictures[i].video_s or 0.0, i))
    for index in order:
        pose = poses.of(index)
        sample = pose.sample if pose is not None else Sample()
        vehicle = sample.vehicle or vehicle
        source.shown[vehicle] = source.shown.get(vehicle, 0) + 1
        source.tracks.setdefault(vehicle, []).append(sample)


def _lone_subtitles(path: Path, name: str, result: Survey) -> None:
    source = SourceInfo(name, "srt")
    result.sources.append(source)
    try:
        cues = srt.read_srt(path)
    except OSError as error:
        source.findings.append(Finding("unreadable", f"{path.name} cannot be read ({error.strerror})"))
        return
    source.findings += [Finding(code, text, note=code == "srt-tuple-order") for code, text in cues.notes.items()]
    source.findings.append(Finding("no-video", f"{path.name} has no video of its name beside it", note=True))
    source.counts["samples"] = len(cues.cues)
    source.tracks[path.stem] = [cue.sample for cue in cues.cues if cue.sample is not None]
    source.shown[path.stem] = 0
