"""Extracts pictures from a video: decoded once, selected, written as JPEG, each with the pose of its own packet."""

import math
import os
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from telemetry.photos.photo_tags import PhotoTags
from telemetry.samples.findings import Finding, plural
from telemetry.samples.sample import Sample
from telemetry.samples.times import ZONE_UNKNOWN
from telemetry.videos.extraction_cache import CachedExtraction, CachedPicture, key_of, recall, remember
from telemetry.videos.on_ground import on_ground
from telemetry.videos.packet_loss import Damage, transport_gaps
from telemetry.videos.picture_choice import Candidate, Picker
from telemetry.videos.picture_poses import PicturePose, Poses
from telemetry.videos.video_file import VideoScan, demux, open_video, parked, picture_stream, scan, square_size

JPEG_QUALITY = 95

_ZOOM_STEP: Final = 0.03  # natural logarithm of the field of view's change from which a video's lens counts as another


@dataclass(slots=True, kw_only=True)
class Picture:
    """A picture extracted from a video.

    Attributes:
        number: of the picture in the video, in order of presentation, from 0.
        sample: its pose, None if unknown. origin: source of the pose.
        rgb: uint8 (rows, columns, 3). video_s: its time in the video.
        packet: index of its packet, None if the decoder did not report it.
        damaged: whether parts of it are predicted from lost data.
    """

    number: int
    sample: Sample | None
    origin: str
    rgb: NDArray[np.uint8]
    video_s: float
    packet: int | None = None
    damaged: bool = False


@dataclass(slots=True, kw_only=True)
class Extraction:
    """The result of an extraction: photos by vehicle, findings, counts."""

    photos: dict[str, list[PhotoTags]] = field(default_factory=dict)
    names: dict[Path, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    pictures: int = 0
    without_pose: int = 0
    on_ground: int = 0
    damaged: int = 0


def decoded(
    found: VideoScan, counter: list[int] | None = None, damage: Damage | None = None
) -> Iterator[tuple[int, int | None, Any]]:
    """Every picture of a file in order of presentation: number, index of its packet, decoded frame.

    The packet's index passes through the decoder with the picture; if a decoder does not pass it on, the
    presentation time is used. Pictures that cannot be decoded are left out and counted in counter[0]; losses are
    noted in `damage`.
    """
    import av
    from av.codec.context import Flags

    times = [] if found.joints_s else [note.video_s for note in found.pictures]  # joined: not those of the packets
    by_time = {round(t, 6): i for i, t in enumerate(times) if t is not None}
    rank = _presentation_rank(found)
    with open_video(found.path) as container:
        stream = picture_stream(container)
        start = stream.start_time or 0
        context = stream.codec_context
        context.thread_type = "AUTO"
        context.flags |= int(Flags.copy_opaque)
        with parked(context):
            number, index = 0, 0
            damage = damage if damage is not None else Damage()
            lost = _lost_packets(found, stream)
            for packet in demux(container, [stream]):
                if packet.size:
                    packet.opaque = index
                    is_lost = packet.is_corrupt or index in lost
                    damage.packet(index, is_key=packet.is_keyframe, is_lost=is_lost)
                    index += 1
                try:
                    frames = packet.decode()
                except (av.error.FFmpegError, ValueError):
                    damage.lost(max(0, index - 1))
                    if counter is not None:
                        counter[0] += 1
                    continue
                for frame in frames:
                    own = frame.opaque if isinstance(frame.opaque, int) else None
                    if own is None and frame.pts is not None:
                        own = by_time.get(round(float((frame.pts - start) * stream.time_base), 6))
                    if own is not None and rank is not None and own < len(rank):
                        number = max(number, rank[own])  # pictures that were lost keep their numbers
                    if own is not None and frame.is_corrupt:
                        damage.lost(own)
                    yield number, own, frame
                    number += 1


def _lost_packets(found: VideoScan, stream: Any) -> set[int]:
    """Indices of packets with a gap in or before them, in MPEG-TS."""
    starts = [note.position for note in found.pictures]
    if not _is_transport(found.path) or any(start is None for start in starts):
        return set()
    known = [start for start in starts if start is not None]
    lost: set[int] = set()
    for before, after in transport_gaps(found.path, stream.id):
        lost.update(range(max(0, bisect_right(known, before) - 1), min(bisect_right(known, after), len(known))))
    return lost


def _is_transport(path: Path) -> bool:
    return path.suffix.lower() in (".ts", ".mts", ".m2ts")


def _presentation_rank(found: VideoScan) -> list[int] | None:
    """Number in order of presentation of each packet's picture; None if times are missing or repeated."""
    times = [note.video_s for note in found.pictures]
    known = [t for t in times if t is not None]
    if len(set(known)) != len(times):
        return None
    place = {t: i for i, t in enumerate(sorted(known))}
    return [place[t] for t in times if t is not None]


def pictures(
    found: VideoScan,
    poses: Poses,
    *,
    every_m: float | None = None,
    every_s: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    result: Extraction | None = None,
) -> Iterator[Picture]:
    """The selected pictures of a video, each with its pose.

    Args:
        found: the file's metadata.
        poses: of its packets.
        every_m: spacing in metres.
        every_s: spacing in seconds; see `Picker` for the default.
        progress: called with pictures decoded and their number in the file.
        result: receives the counts.
    """
    picker = Picker(every_m, every_s)
    result = result if result is not None else Extraction()
    damaged, damage = [0], Damage()
    total = len(found.pictures)
    placed_only, grounded = poses.has_positions, on_ground(found, poses)
    for number, index, frame in decoded(found, damaged, damage):
        result.pictures += 1
        if progress is not None and number % 25 == 0:
            progress(number, total)
        lost = frame.is_corrupt or (index is not None and damage.is_damaged(index))
        damaged[0] += lost
        pose = None if index is None or index >= total else poses.of(index)
        if placed_only and (pose is None or not pose.sample.has_position):
            result.without_pose += 1
            continue
        if index in grounded:
            result.on_ground += 1
            continue
        video_s = number / (found.rate or 30.0)
        if index is not None and index < total and (own := found.pictures[index].video_s) is not None:
            video_s = own
        sample, origin = (None, "") if pose is None else (pose.sample, pose.origin)
        for chosen in picker.push(
            Candidate(
                number=number, frame=frame, sample=sample, video_s=video_s, origin=origin, packet=index, damaged=lost
            )
        ):
            yield _picture(chosen, found)
    for chosen in picker.flush():
        yield _picture(chosen, found)
    result.damaged = damaged[0]
    if progress is not None:
        progress(total, total)


def _picture(chosen: Candidate, found: VideoScan) -> Picture:
    return Picture(
        number=chosen.number,
        sample=chosen.sample,
        origin=chosen.origin,
        rgb=found.turn.picture(to_rgb(chosen.frame, found.aspect)),
        video_s=chosen.video_s,
        packet=chosen.packet,
        damaged=chosen.damaged,
    )


def to_rgb(frame: Any, aspect: float = 1.0) -> NDArray[np.uint8]:
    """A decoded frame's colours, uint8 (rows, columns, 3); unmarked pictures of 720 rows or more are BT.709.

    Cameras have one focal length for both directions: pictures whose pixels are not square (`aspect`, width over
    height) get more columns, or more rows. They are not turned (`display_turn`).
    """
    from av.video.reformatter import ColorRange, Colorspace

    columns, rows = square_size(frame.width, frame.height, aspect)
    if frame.format.is_rgb:
        return np.asarray(frame.reformat(width=columns, height=rows, format="rgb24").to_ndarray())
    source = Colorspace.ITU709 if frame.height >= 720 or int(frame.colorspace) == 1 else Colorspace.ITU601
    return np.asarray(
        frame.reformat(
            width=columns,
            height=rows,
            format="rgb24",
            src_colorspace=source,
            dst_colorspace=source,
            dst_color_range=ColorRange.JPEG,
        ).to_ndarray()
    )


def extract(
    path: Path,
    name: str,
    cache: Path,
    *,
    poses: Poses | None = None,
    every_m: float | None = None,
    every_s: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    found: VideoScan | None = None,
    vehicle: str | None = None,
) -> Extraction:
    """Extract the pictures of a video into a folder of JPEG files.

    Pictures of an earlier call are used again if video, selection and poses are unchanged.

    Args:
        path: the video.
        name: its name relative to the inputs; names its folder in the cache.
        cache: folder for the pictures.
        poses: of its pictures, including those from other files; None for those in the file itself.
        every_m: spacing in metres.
        every_s: spacing in seconds.
        progress: called with pictures decoded and their number.
        found: the file's metadata if it was scanned already.
        vehicle: id of the vehicle if the metadata names none; None for the file's name.

    Raises:
        telemetry.videos.NotAVideo: it is not a video.
        OSError: a picture cannot be written.
    """
    found = found or scan(path)
    poses = poses or Poses(found)
    result = Extraction()
    folder = cache / name.replace("/", "__")
    folder.mkdir(parents=True, exist_ok=True)
    key = key_of(path, poses, len(found.pictures), (every_m, every_s, JPEG_QUALITY))
    cached = recall(folder, key)
    if cached is None:
        written = []
        for picture in pictures(found, poses, every_m=every_m, every_s=every_s, progress=progress, result=result):
            rows, columns = picture.rgb.shape[:2]
            written.append(CachedPicture(picture.number, picture.packet, columns, rows, picture.damaged))
            write_jpeg(folder / written[-1].name, picture.rgb)
        cached = CachedExtraction(written, result.pictures, result.without_pose, result.on_ground, result.damaged)
        remember(folder, key, cached)
    result.pictures, result.without_pose, result.damaged = cached.seen, cached.without_pose, cached.damaged
    result.on_ground = cached.on_ground
    lens = _LensKey(found)
    for one in cached.pictures:
        pose = None if one.packet is None else poses.of(one.packet)
        photo = _photo(folder / one.name, one, pose, lens)
        named = pose.sample.vehicle if pose is not None else None
        result.photos.setdefault(named or vehicle or path.stem, []).append(photo)
        result.names[photo.path] = one.number
    if result.damaged:
        result.findings.append(
            Finding(
                "video-damaged",
                f"{plural(result.damaged, 'picture')} of {path.name} are damaged by losses; those of them that are "
                "selected count for their positions only and are drawn where no other picture sees",
            )
        )
    result.findings += poses.findings
    if len(lens.zooms) > 1:
        text = (
            f"the lens zooms during {path.name}, to {min(lens.zooms):.1f} to {max(lens.zooms):.1f} times its first "
            "focal length: each focal length is adjusted as a camera of its own, but the real-time picture is drawn "
            "with one"
        )
        result.findings.append(Finding("video-zoom", text))
    if result.without_pose:
        result.findings.append(
            Finding(
                "pictures-without-pose",
                f"{plural(result.without_pose, 'picture')} of {result.pictures} in {path.name} have no position "
                "and are left out",
            )
        )
    if result.on_ground:
        text = (
            f"{plural(result.on_ground, 'picture')} of {result.pictures} in {path.name} were taken on the ground, "
            "before takeoff or after landing, and are left out"
        )
        result.findings.append(Finding("pictures-on-ground", text, note=True))
    return result


def encode_jpeg(rgb: NDArray[np.uint8], *, quality: int = JPEG_QUALITY) -> bytes:
    """A picture, uint8 (rows, columns, 3), as JPEG."""
    import simplejpeg

    return bytes(
        simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), quality=quality, colorspace="RGB", colorsubsampling="420")
    )


def write_jpeg(path: Path, rgb: NDArray[np.uint8], *, quality: int = JPEG_QUALITY) -> None:
    """Write a picture as JPEG; the file gets its name once it is complete.

    Raises:
        OSError: it cannot be written.
    """
    temporary = path.with_suffix(".part")
    temporary.write_bytes(encode_jpeg(rgb, quality=quality))
    os.replace(temporary, path)


class _LensKey:
    """Names the lens of a picture; a zoom (change of the field of view or focal length) starts another."""

    def __init__(self, found: VideoScan) -> None:
        self._base = f"video {found.width}x{found.height}"
        self._fov: float | None = None
        self._first_zoom: float | None = None
        self.zooms: set[float] = set()

    def of(self, sample: Sample | None) -> str:
        step = _ZOOM_STEP
        fov = None if sample is None else sample.fov_deg
        if fov is None:
            return self._base if sample is None or sample.zoom is None else self._zoomed(sample.zoom, step)
        if self._fov is None or abs(math.log(fov / self._fov)) > step:
            self._fov = fov
        return f"{self._base} fov{self._fov:.1f}"

    def _zoomed(self, zoom: float, step: float) -> str:
        self._first_zoom = self._first_zoom or zoom
        times = math.exp(step * round(math.log(zoom / self._first_zoom) / step))
        self.zooms.add(times)
        return self._base if times == 1.0 else f"{self._base} x{times:.2f}"


def _photo(path: Path, picture: CachedPicture, pose: PicturePose | None, lens: _LensKey) -> PhotoTags:
    photo = PhotoTags(path=path, width=picture.columns, height=picture.rows)
    photo.damaged = picture.damaged
    photo.camera = lens.of(None if pose is None else pose.sample)
    if pose is None:
        return photo
    sample = pose.sample
    photo.lat_deg, photo.lon_deg = sample.lat_deg, sample.lon_deg
    photo.altitude_m, photo.height_m = sample.altitude_m, sample.height_m
    photo.height_is_ground = sample.height_is_ground
    photo.time_s = sample.time_s
    photo.camera_deg = (sample.yaw_deg, sample.pitch_deg, sample.roll_deg)
    photo.flight_deg = (sample.flight_yaw_deg, sample.flight_pitch_deg, sample.flight_roll_deg)
    photo.position_sigma_m = sample.sigma_m
    # DJI's sources use "gimbal yaw" with different meanings; all others define the picture's.
    photo.yaw_is_stated = not {"djmd", "SRT"} & set(pose.origin.split(" + "))
    photo.fov_hint_rad = None if sample.fov_deg is None else math.radians(sample.fov_deg)
    names = {
        "position": sample.lat_deg, "height": sample.height_m, "time": sample.time_s, "angles": sample.yaw_deg,
        "flight_yaw": sample.flight_yaw_deg, "fov_hint": sample.fov_deg,
    }  # fmt: skip
    photo.origin = {field: pose.origin for field, value in names.items() if value is not None}
    sources = set(pose.origin.split(" + "))
    if "time" in photo.origin and "SRT" in sources and not sources - {"SRT", "djmd"}:
        photo.origin["time"] += f", {ZONE_UNKNOWN}"  # subtitles are written in local time
    return photo
