"""Video files: which pose belongs to which picture.

One pass over the packets, without decoding, finds all metadata: SEI of each picture, KLV, DJI's djmd track, a
subtitle track; an SRT file may lie beside. What is carried in or with a picture's own packet (SEI, djmd) is bound to
that packet, and follows it through the decoder (`telemetry.extract`), so that B-frames and threads cannot mix it up.
What has times of its own (KLV, subtitles) is interpolated at the picture's time.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from telemetry import bitstream, djmd, klv, sei, srt
from telemetry.exif import parse_time
from telemetry.sample import Sample
from telemetry.timeline import Timeline

_MAX_PICTURES = 5_000_000
_HELD_AT_ENDS_S = 1.0


class NotAVideo(Exception):
    """A file with a video's suffix is none; the text is one sentence for the user."""


@dataclass(slots=True)
class PictureNote:
    """What was found with one picture's packet: its time in the video, its own sample, and who understood it."""

    video_s: float | None
    sample: Sample | None = None
    decoders: tuple[str, ...] = ()


@dataclass(slots=True)
class VideoScan:
    """All metadata of a video file.

    Attributes:
        path: the file. codec: of the pictures. width: columns; height: rows.
        rate: pictures a second, None if the file does not say.
        created_s: UTC epoch seconds of the container's creation time.
        pictures: one for each video packet, in order of the file.
        klv_packets: video time (None if unknown), number of video packets before it, packet.
        djmd_samples: video time and sample. cues: of a subtitle track. damaged: packets that could not be read.
    """

    path: Path
    codec: str
    width: int
    height: int
    rate: float | None = None
    created_s: float | None = None
    pictures: list[PictureNote] = field(default_factory=list)
    klv_packets: list[tuple[float | None, int, klv.Packet]] = field(default_factory=list)
    djmd_samples: list[tuple[float, Sample]] = field(default_factory=list)
    cues: srt.Subtitles = field(default_factory=srt.Subtitles)
    damaged: int = 0

    @property
    def sei_count(self) -> int:
        """Pictures with a SEI message that was recognised."""
        return sum(note.sample is not None for note in self.pictures)


def open_video(path: Path | str, **options: Any) -> Any:
    """Open a file or a URL with PyAV.

    Raises:
        NotAVideo: it cannot be opened or holds no video.
    """
    import av

    try:
        container = av.open(str(path), **options)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise NotAVideo(
            f"the file is no video that can be read ({_reason(error)}); check it with a player or leave it out"
        ) from None
    if not container.streams.video:
        container.close()
        raise NotAVideo("the file holds no pictures; name a video")
    return container


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).lower()


def scan(path: Path) -> VideoScan:
    """Read all metadata of a file, without decoding pictures.

    Raises:
        NotAVideo: it is no video.
    """
    if path.stat().st_size == 0:
        raise NotAVideo("the file is empty; copy it again")
    with open_video(path) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        result = VideoScan(path, context.name, context.width, context.height)
        result.rate = float(stream.average_rate) if stream.average_rate else None
        created = parse_time(str(container.metadata.get("creation_time", "")))
        result.created_s = created[0] if created is not None else None
        _scan_packets(container, stream, result)
    if not result.pictures:
        raise NotAVideo("the file holds no pictures; it may be cut off")
    return result


def demux(container: Any, streams: list[Any]) -> Iterator[Any]:
    """Packets of some streams; a damaged end of the file ends them instead of raising."""
    import av

    source = container.demux(*streams)
    failures = 0
    while True:
        try:
            packet = next(source)
        except StopIteration:
            return
        except (av.error.FFmpegError, ValueError):
            failures += 1
            if failures > 100:
                return
            continue
        yield packet


def _scan_packets(container: Any, stream: Any, result: VideoScan) -> None:
    form = bitstream.StreamFormat.of(result.codec, stream.codec_context.extradata)
    wanted = [s for s in container.streams if s is stream or s.type in ("data", "subtitle")]
    start = stream.start_time or 0
    base = float(stream.start_time * stream.time_base) if stream.start_time is not None else 0.0
    texts: list[tuple[float, float, str]] = []
    leftovers: dict[int, bytes] = {}
    for packet in demux(container, wanted):
        if packet.size == 0:
            continue
        seconds = None if packet.pts is None else float(packet.pts * packet.time_base) - base
        if packet.stream is stream:
            if len(result.pictures) >= _MAX_PICTURES:
                break
            seconds = None if packet.pts is None else float((packet.pts - start) * packet.time_base)
            result.pictures.append(_note(bytes(packet), form, seconds))
        elif packet.stream.type == "subtitle":
            if seconds is not None:
                length = float((packet.duration or 0) * packet.time_base)
                texts.append((seconds, seconds + length, _subtitle_text(bytes(packet))))
        else:
            _scan_data(packet, seconds, result, leftovers)
    if texts:
        result.cues = srt.parse_cues(texts)


def _note(data: bytes, form: bitstream.StreamFormat | None, seconds: float | None) -> PictureNote:
    reading = None if form is None else sei.read(bitstream.sei_messages(data, form))
    if reading is None:
        return PictureNote(seconds)
    return PictureNote(seconds, reading.sample, reading.decoders)


def _subtitle_text(data: bytes) -> str:
    """Text of a subtitle packet: MP4's timed text leads it with a 16-bit length."""
    if len(data) >= 2 and int.from_bytes(data[:2], "big") <= len(data) - 2 and data[0] == 0:
        data = data[2 : 2 + int.from_bytes(data[:2], "big")]
    return data.decode("utf-8", "replace")


def _scan_data(packet: Any, seconds: float | None, result: VideoScan, leftovers: dict[int, bytes]) -> None:
    """KLV (also where a set is spread over packets) or djmd, by content."""
    data = leftovers.pop(packet.stream.index, b"") + bytes(packet)
    found = list(klv.packets(data))
    if found:
        if found[-1].error == "the packet is cut off" and len(data) < 1 << 16:
            leftovers[packet.stream.index] = data[data.rfind(bytes.fromhex("060e2b3402")) :]
            found.pop()
        for item in found:
            result.klv_packets.append((seconds, len(result.pictures), item))
        return
    sample = djmd.read_djmd(data)
    if sample is not None and seconds is not None:
        result.djmd_samples.append((seconds, sample))


@dataclass(frozen=True, slots=True)
class Pose:
    """The merged sample of a picture and where its parts come from."""

    sample: Sample
    origin: str


class Poses:
    """The pose of each picture of a video: SEI, djmd, KLV and subtitles merged, the richer first."""

    def __init__(self, found: VideoScan, subtitles: srt.Subtitles | None = None) -> None:
        self._scan = found
        self.clock_offset_s: float | None = None
        self._interval = 1.0 / found.rate if found.rate else 1.0 / 30.0
        self._djmd = sorted(found.djmd_samples, key=lambda row: row[0])
        self._djmd_times = np.array([row[0] for row in self._djmd])
        times = np.array([self._time(i) for i in range(len(found.pictures))], dtype=np.float64)
        self._interpolated: list[tuple[str, list[Sample]]] = []
        for name, (timeline, clock) in (
            ("KLV", self._klv_timeline()),
            ("SRT", _cue_timeline(subtitles if subtitles is not None else found.cues)),
        ):
            if timeline is not None:
                samples = timeline.at_all(times)
                for sample in samples:
                    t = sample.time_s
                    sample.time_s = None if clock is None or t is None or t != t else t + clock
                self._interpolated.append((name, samples))

    def _time(self, index: int) -> float:
        """Video time of a packet's picture; NaN where it is not known."""
        t = self._scan.pictures[index].video_s
        if t is not None:
            return t
        return index * self._interval if self._scan.rate else float("nan")

    def of(self, index: int) -> Pose | None:
        """Pose of the picture of a packet (its index in `VideoScan.pictures`); None where nothing is known."""
        note = self._scan.pictures[index]
        t = self._time(index)
        parts: list[tuple[Sample, str]] = []
        if note.sample is not None:
            parts.append((note.sample, " + ".join(note.decoders)))
        own = self._own_djmd(t)
        if own is not None:
            parts.append((own, "djmd"))
        for name, samples in self._interpolated:
            if samples[index].has_position or samples[index].yaw_deg is not None:
                parts.append((samples[index], name))
        if self._scan.created_s is not None and t == t:
            parts.append((Sample(time_s=self._scan.created_s + t), "container"))
        if not parts:
            return None
        # What has a position leads; a bare time stamp only says when.
        parts.sort(key=lambda part: not part[0].has_position)
        merged, origin = parts[0]
        if note.sample is not None and note.sample.time_s is not None:
            merged = replace(merged, time_s=note.sample.time_s)
        for sample, _ in parts[1:]:
            merged = merged.merge(sample)
        return Pose(
            merged, " + ".join(dict.fromkeys([origin, *(name for _, name in parts[1:] if name != "container")]))
        )

    @property
    def has_positions(self) -> bool:
        """Whether any source of this video knows positions."""
        return (
            any(note.sample is not None and note.sample.has_position for note in self._scan.pictures)
            or any(sample.has_position for _, sample in self._djmd)
            or bool(self._interpolated)
        )

    def _own_djmd(self, t: float) -> Sample | None:
        """The djmd message with the picture's own time."""
        if not self._djmd:
            return None
        i = int(np.argmin(np.abs(self._djmd_times - t)))
        return self._djmd[i][1] if abs(self._djmd_times[i] - t) < 0.51 * self._interval else None

    def _klv_timeline(self) -> tuple[Timeline | None, float | None]:
        """KLV over video time, and what to add to video time for UTC."""
        rows: list[tuple[float | None, int, Sample]] = [
            (t, after, p.sample)
            for t, after, p in self._scan.klv_packets
            if p.sample is not None and p.sample.has_position
        ]
        if not rows:
            return None, None
        times = self._klv_times(rows)
        placed = [(t, s) for t, (_, _, s) in zip(times, rows, strict=True) if t is not None]
        offsets = [s.time_s - t for t, s in placed if s.time_s is not None]
        clock = float(np.median(offsets)) if offsets else None
        stamps = [
            n.sample.time_s - n.video_s
            for n in self._scan.pictures
            if n.sample is not None and n.sample.time_s is not None and n.video_s is not None
        ]
        if clock is not None and stamps:
            self.clock_offset_s = float(np.median(stamps)) - clock
        return _held_timeline([replace(s, time_s=t) for t, s in placed]), clock

    def _klv_times(self, rows: list[tuple[float | None, int, Sample]]) -> list[float | None]:
        """Video times of KLV packets: their own, else by UTC against the pictures' SEI times, else by place."""
        if all(t is not None for t, _, _ in rows):
            return [t for t, _, _ in rows]
        known = [
            (n.sample.time_s, n.video_s)
            for n in self._scan.pictures
            if n.sample is not None and n.sample.time_s is not None and n.video_s is not None
        ]
        utc = [s.time_s for _, _, s in rows if s.time_s is not None]
        if len(known) > 1 and len(utc) == len(rows):
            first, last = min(known)[0], max(known)[0]
            if sum(first - 1.0 <= t <= last + 1.0 for t in utc) > 0.5 * len(utc):
                shift = float(np.median([v - t for t, v in known]))
                return [t + shift for t in utc]
        notes = self._scan.pictures
        return [notes[min(after, len(notes) - 1)].video_s for _, after, _ in rows]


def _held_timeline(samples: list[Sample]) -> Timeline | None:
    """A timeline whose ends are held for one usual interval (at most a second): pictures stand between samples."""
    samples = sorted((s for s in samples if s.time_s is not None), key=lambda s: s.time_s or 0.0)
    if not samples:
        return None
    times = np.array([s.time_s for s in samples], dtype=np.float64)
    usual = float(np.median(np.diff(times))) if len(times) > 1 else _HELD_AT_ENDS_S
    usual = min(max(usual, 1e-3), _HELD_AT_ENDS_S)
    before = replace(samples[0], time_s=float(times[0]) - usual)
    after = replace(samples[-1], time_s=float(times[-1]) + usual)
    return Timeline([before, *samples, after], max_gap_s=max(2.0, 4.0 * usual))


def _cue_timeline(cues: srt.Subtitles) -> tuple[Timeline | None, float | None]:
    """Subtitles over video time, and what to add to video time for their clock."""
    placed = [(cue.start_s, cue.sample) for cue in cues.cues if cue.sample is not None and cue.sample.has_position]
    if not placed:
        return None, None
    offsets = [s.time_s - t for t, s in placed if s.time_s is not None]
    clock = float(np.median(offsets)) if offsets else None
    return _held_timeline([replace(s, time_s=t) for t, s in placed]), clock
