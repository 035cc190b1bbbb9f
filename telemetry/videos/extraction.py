"""Extracts pictures from a video: decoded once, selected, written as JPEG, each with the pose of its own packet."""

import hashlib
import json
import math
import os
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, astuple, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from telemetry.photos.photo_tags import Photo
from telemetry.samples.findings import Finding, plural
from telemetry.samples.sample import Sample
from telemetry.samples.times import ZONE_UNKNOWN
from telemetry.videos.packet_loss import Damage, transport_gaps
from telemetry.videos.picture_choice import DecodedPicture, Picker, on_ground
from telemetry.videos.picture_poses import PicturePose, Poses
from telemetry.videos.video_file import VideoScan, demux, open_video, parked, picture_stream, scan, square_size

_JPEG_QUALITY = 95
_LIST, _VERSION = "pictures.json", 5
"""The list of what the cache holds, and its version: it is valid until video, selection or poses change."""

_ZOOM_STEP: Final = 0.03  # natural logarithm of the field of view's change from which a video's lens counts as another


@dataclass(slots=True, kw_only=True)
class Extraction:
    """The pictures of a video as photos by vehicle, the number of each in the video, and findings."""

    photos: dict[str, list[Photo]] = field(default_factory=dict)
    names: dict[Path, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _WrittenPicture:
    """One picture in the cache folder."""

    number: int  # of the picture in the video, in order of presentation
    packet: int | None  # index of its packet, None if the decoder did not report it
    columns: int  # width in pixels
    rows: int  # height
    damaged: bool = False  # whether it lost parts

    @property
    def name(self) -> str:
        return f"{self.number:06d}.jpg"


@dataclass(slots=True)
class _Written:
    """The pictures in the cache folder, and what became of the others."""

    pictures: list[_WrittenPicture] = field(default_factory=list)  # the extracted ones
    seen: int = 0  # number decoded
    without_pose: int = 0  # number left out for lack of a position
    on_ground: int = 0  # number left out because they were taken on the ground
    damaged: int = 0  # number that lost parts or could not be decoded


def decoded(found: VideoScan, damage: Damage | None = None) -> Iterator[tuple[int, int | None, Any]]:
    """Every picture of a file in order of presentation: number, index of its packet, decoded frame.

    The packet's index passes through the decoder with the picture; if a decoder does not pass it on, the
    presentation time is used. Pictures that cannot be decoded are left out; they and losses are noted in `damage`.
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
                    damage.packet(index, is_key=packet.is_keyframe, is_lost=packet.is_corrupt or index in lost)
                    index += 1
                try:
                    frames = packet.decode()
                except (av.error.FFmpegError, ValueError):
                    damage.lost(max(0, index - 1))
                    damage.undecoded += 1
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
    known = [note.position for note in found.pictures if note.position is not None]
    if found.path.suffix.lower() not in (".ts", ".mts", ".m2ts") or len(known) < len(found.pictures):
        return set()
    lost: set[int] = set()
    for before, after in transport_gaps(found.path, stream.id):
        lost.update(range(max(0, bisect_right(known, before) - 1), min(bisect_right(known, after), len(known))))
    return lost


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
    written: _Written | None = None,
) -> Iterator[DecodedPicture]:
    """The selected pictures of a video, each with its pose.

    Args:
        found: the file's metadata. poses: of its packets.
        every_m: spacing in metres. every_s: in seconds; see `Picker` for the default.
        progress: called with pictures decoded and their number in the file. written: receives the counts.
    """
    picker = Picker(every_m, every_s)
    written = written if written is not None else _Written()
    damage, total = Damage(), len(found.pictures)
    placed_only, grounded = poses.has_positions, on_ground(found, poses)
    for number, index, frame in decoded(found, damage):
        written.seen += 1
        if progress is not None and number % 25 == 0:
            progress(number, total)
        lost = frame.is_corrupt or (index is not None and damage.is_damaged(index))
        written.damaged += lost
        pose = None if index is None or index >= total else poses.of(index)
        if placed_only and (pose is None or not pose.sample.has_position):
            written.without_pose += 1
            continue
        if index in grounded:
            written.on_ground += 1
            continue
        video_s = number / (found.rate or 30.0)
        if index is not None and index < total and (own := found.pictures[index].video_s) is not None:
            video_s = own
        sample, origin = (None, "") if pose is None else (pose.sample, pose.origin)
        yield from picker.push(
            DecodedPicture(
                number=number, frame=frame, sample=sample, video_s=video_s, origin=origin, packet=index, damaged=lost
            )
        )
    yield from picker.flush()
    written.damaged += damage.undecoded
    if progress is not None:
        progress(total, total)


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
        name: of the video relative to the inputs; names its folder in `cache`, the folder for the pictures.
        poses: of its pictures, including those from other files; None for those in the file itself.
        every_m: spacing in metres. every_s: in seconds. progress: called with pictures decoded and their number.
        found: the file's metadata if it was scanned already.
        vehicle: id of the vehicle if the metadata names none; None for the file's name.

    Raises:
        telemetry.videos.NotAVideo: it is not a video.
        OSError: a picture cannot be written.
    """
    found = found or scan(path)
    poses = poses or Poses(found)
    folder = cache / name.replace("/", "__")
    folder.mkdir(parents=True, exist_ok=True)
    key = _key_of(path, poses, len(found.pictures), (every_m, every_s, _JPEG_QUALITY))
    written = _recall(folder, key)
    if written is None:
        written = _Written()
        for picture in pictures(found, poses, every_m=every_m, every_s=every_s, progress=progress, written=written):
            rgb = found.turn.picture(to_rgb(picture.frame, found.aspect))
            rows, columns = rgb.shape[:2]
            written.pictures.append(_WrittenPicture(picture.number, picture.packet, columns, rows, picture.damaged))
            _write(folder / written.pictures[-1].name, encode_jpeg(rgb))
        document = {"key": key, **asdict(written), "pictures": [astuple(picture) for picture in written.pictures]}
        _write(folder / _LIST, json.dumps(document).encode())  # once all pictures are in the folder
    result, lens = Extraction(), _LensKey(found)
    for one in written.pictures:
        pose = None if one.packet is None else poses.of(one.packet)
        photo = _photo(folder / one.name, one, pose, lens)
        named = pose.sample.vehicle if pose is not None else None
        result.photos.setdefault(named or vehicle or path.stem, []).append(photo)
        result.names[photo.path] = one.number
    if written.damaged:
        text = (
            f"{plural(written.damaged, 'picture')} of {path.name} are damaged by losses; those of them that are "
            "selected count for their positions only and are drawn where no other picture sees"
        )
        result.findings.append(Finding("video-damaged", text))
    result.findings += poses.findings
    if len(lens.zooms) > 1:
        text = (
            f"the lens zooms during {path.name}, to {min(lens.zooms):.1f} to {max(lens.zooms):.1f} times its first "
            "focal length: each focal length is adjusted as a camera of its own, but the real-time picture is drawn "
            "with one"
        )
        result.findings.append(Finding("video-zoom", text))
    if written.without_pose:
        text = (
            f"{plural(written.without_pose, 'picture')} of {written.seen} in {path.name} have no position "
            "and are left out"
        )
        result.findings.append(Finding("pictures-without-pose", text))
    if written.on_ground:
        text = (
            f"{plural(written.on_ground, 'picture')} of {written.seen} in {path.name} were taken on the ground, "
            "before takeoff or after landing, and are left out"
        )
        result.findings.append(Finding("pictures-on-ground", text, note=True))
    return result


def _key_of(video: Path, poses: Poses, count: int, choice: Sequence[Any]) -> str:
    """Cache key of an extraction: the file, the selection of pictures, and the poses of all `count` packets."""
    stat = video.stat()
    digest = hashlib.sha256(f"{_VERSION} {stat.st_size} {stat.st_mtime_ns} {list(choice)!r}".encode())
    for index in range(count):
        digest.update(repr(poses.of(index)).encode())
    return digest.hexdigest()


def _recall(folder: Path, key: str) -> _Written | None:
    """What an earlier extraction with this key wrote; None if there is none or it is incomplete."""
    try:
        document = json.loads((folder / _LIST).read_text(encoding="utf-8"))
        if document.pop("key") != key:
            return None
        kept = [_WrittenPicture(*row) for row in document.pop("pictures")]
        return _Written(kept, **document) if all((folder / one.name).stat().st_size for one in kept) else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def encode_jpeg(rgb: NDArray[np.uint8]) -> bytes:
    """A picture, uint8 (rows, columns, 3), as JPEG."""
    import simplejpeg

    return bytes(
        simplejpeg.encode_jpeg(
            np.ascontiguousarray(rgb), quality=_JPEG_QUALITY, colorspace="RGB", colorsubsampling="420"
        )
    )


def _write(path: Path, data: bytes) -> None:
    """Write a file, which gets its name once it is complete."""
    temporary = path.with_name(f"{path.name}.part")
    temporary.write_bytes(data)
    os.replace(temporary, path)


class _LensKey:
    """Names the lens of a picture; a zoom (change of the field of view or focal length) starts another."""

    def __init__(self, found: VideoScan) -> None:
        self._base = f"video {found.width}x{found.height}"
        self._fov: float | None = None
        self._first_zoom: float | None = None
        self.zooms: set[float] = set()

    def of(self, sample: Sample | None) -> str:
        fov = None if sample is None else sample.fov_deg
        if fov is None:
            return self._base if sample is None or sample.zoom is None else self._zoomed(sample.zoom)
        if self._fov is None or abs(math.log(fov / self._fov)) > _ZOOM_STEP:
            self._fov = fov
        return f"{self._base} fov{self._fov:.1f}"

    def _zoomed(self, zoom: float) -> str:
        self._first_zoom = self._first_zoom or zoom
        times = math.exp(_ZOOM_STEP * round(math.log(zoom / self._first_zoom) / _ZOOM_STEP))
        self.zooms.add(times)
        return self._base if times == 1.0 else f"{self._base} x{times:.2f}"


def _photo(path: Path, picture: _WrittenPicture, pose: PicturePose | None, lens: _LensKey) -> Photo:
    photo = Photo(path=path, width=picture.columns, height=picture.rows)
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
    sources = set(pose.origin.split(" + "))
    photo.yaw_is_stated = not {"djmd", "SRT"} & sources
    photo.fov_hint_rad = None if sample.fov_deg is None else math.radians(sample.fov_deg)
    names = {
        "position": sample.lat_deg, "height": sample.height_m, "time": sample.time_s, "angles": sample.yaw_deg,
        "flight_yaw": sample.flight_yaw_deg, "fov_hint": sample.fov_deg,
    }  # fmt: skip
    photo.origin = {field: pose.origin for field, value in names.items() if value is not None}
    if "time" in photo.origin and "SRT" in sources and not sources - {"SRT", "djmd"}:
        photo.origin["time"] += f", {ZONE_UNKNOWN}"  # subtitles are written in local time
    return photo
