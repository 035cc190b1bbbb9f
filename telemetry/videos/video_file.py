"""All metadata of video files.

One pass over the packets, without decoding, finds all metadata: SEI of each picture, KLV, DJI's djmd track, a
subtitle track. `telemetry.videos.picture_poses` makes one pose for each picture of it.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from telemetry.formats.video import bitstream, djmd, gpmf, klv, sei, srt
from telemetry.samples.sample import Sample
from telemetry.samples.times import parse_time
from telemetry.samples.unreadable import Unreadable

_MAX_PICTURES = 5_000_000


class NotAVideo(Unreadable):
    """A file with a video's suffix is not a video; the text is one sentence for the user."""


@dataclass(slots=True)
class PictureNote:
    """Metadata of one picture's packet.

    Attributes:
        video_s: its time in the video. sample: its own pose. decoders: names of the decoders that understood it.
        position: offset of the packet in the file, None if the container does not give it.
    """

    video_s: float | None
    sample: Sample | None = None
    decoders: tuple[str, ...] = ()
    position: int | None = None


@dataclass(slots=True, kw_only=True)
class VideoScan:
    """All metadata of a video file.

    Attributes:
        path: the file. codec: of the pictures. width: columns; height: rows.
        rate: pictures a second, None if not given.
        created_s: UTC epoch seconds of the container's creation time.
        pictures: one for each video packet, in order of the file.
        klv_packets: video time (None if unknown), number of video packets before it, packet.
        djmd_samples, gpmf_samples: video time and sample. cues: of a subtitle track.
        damaged: packets that could not be read.
        unknown_sei: (UUID, size) -> number of private SEI messages without a decoder.
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
    gpmf_samples: list[tuple[float, Sample]] = field(default_factory=list)
    cues: srt.Subtitles = field(default_factory=srt.Subtitles)
    damaged: int = 0
    unknown_sei: Counter[tuple[str, int]] = field(default_factory=Counter)

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
        if "://" in str(path):
            raise NotAVideo(f"the stream {path} cannot be opened ({_reason(error)}); check its address") from None
        raise NotAVideo(
            f"the file is not a video that can be read ({_reason(error)}); check it with a player or leave it out"
        ) from None
    if not container.streams.video:
        container.close()
        raise NotAVideo("the file holds no pictures; name a video")
    if container.streams.video[0].codec_context is None:
        container.close()
        raise NotAVideo("its pictures are coded in a way that is not known here; convert the video to H.264 or H.265")
    return container


@contextmanager
def parked(context: Any) -> Iterator[None]:
    """Empty a decoder that holds `opaque` objects before it is freed.

    PyAV frees such an object with the interpreter lock held, in the thread that releases it last, and frees a
    decoder, which waits for the decoder's threads, while holding the same lock: a deadlock. After emptying, the threads
    hold no objects.
    """
    try:
        yield
    finally:
        context.flush_buffers()


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).lower()


def scan(path: Path) -> VideoScan:
    """Read all metadata of a file, without decoding pictures.

    Raises:
        NotAVideo: it is not a video.
    """
    if path.stat().st_size == 0:
        raise NotAVideo("the file is empty; copy it again")
    with open_video(path) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        result = VideoScan(path=path, codec=context.name, width=context.width, height=context.height)
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
            note = _note(bytes(packet), form, seconds, result.unknown_sei)
            note.position = packet.pos
            result.pictures.append(note)
        elif packet.stream.type == "subtitle":
            if seconds is not None:
                length = float((packet.duration or 0) * packet.time_base)
                texts.append((seconds, seconds + length, _subtitle_text(bytes(packet))))
        else:
            _scan_data(packet, seconds, result, leftovers)
    if texts:
        result.cues = srt.parse_cues(texts)


def _note(
    data: bytes, form: bitstream.StreamFormat | None, seconds: float | None, unknown: Counter[tuple[str, int]]
) -> PictureNote:
    messages = [] if form is None else bitstream.sei_messages(data, form)
    reading = sei.read(messages)
    unknown.update(sei.unknown(messages))
    if reading is None:
        return PictureNote(seconds)
    return PictureNote(seconds, reading.sample, reading.decoders)


def _subtitle_text(data: bytes) -> str:
    """Text of a subtitle packet: MP4's timed text leads it with a 16-bit length."""
    if len(data) >= 2 and int.from_bytes(data[:2], "big") <= len(data) - 2 and data[0] == 0:
        data = data[2 : 2 + int.from_bytes(data[:2], "big")]
    return data.decode("utf-8", "replace")


def _scan_data(packet: Any, seconds: float | None, result: VideoScan, leftovers: dict[int, bytes]) -> None:
    """KLV (also where a set is spread over packets), djmd or GPMF, by content."""
    if gpmf.is_gpmf(bytes(packet)):
        samples, length = gpmf.read_gpmf(bytes(packet)), float((packet.duration or 0) * packet.time_base) or 1.0
        if seconds is not None:
            result.gpmf_samples += [(seconds + length * i / len(samples), s) for i, s in enumerate(samples)]
        return
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
