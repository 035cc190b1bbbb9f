"""All metadata of video files.

One pass over the packets, without decoding, finds all metadata: SEI of each picture, KLV, DJI's djmd track, a
subtitle track. `telemetry.videos.picture_poses` makes one pose for each picture of it. In recordings joined end to end,
and where an encoder was restarted, the clock of the packets starts again.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Final

from telemetry.formats.video import bitstream, djmd, gpmf, klv, sei, srt
from telemetry.samples.sample import Sample
from telemetry.samples.times import epoch_of
from telemetry.samples.unreadable import Unreadable
from telemetry.videos.display_turn import AS_CODED, Turn, turn_of

_MAX_PICTURES = 5_000_000
_MOST_BOXES = 1000
_RAW_FORMATS = frozenset({"h264", "hevc"})
"""FFmpeg's names of streams without a container, which give no times to their pictures."""
_MOST_BEFORE_FIRST = 100
"""Packets within which a picture is decoded, unless the file is damaged (decoders hold back up to 16)."""
_SQUARE_WITHIN: Final = 0.01  # pixels whose width and height differ by no more are square
_MOST_ASPECT: Final = 4.0  # a ratio of a pixel's sides beyond this is damage (anamorphic lenses have 2, DV has 16:11)
_RESTART_S: Final = 1.0  # a stream whose decoding times go back by more than this starts its clock again


class _JoinedTimes:
    """Continues the pictures' clock where it starts again; metadata keeps the part of the file that it belongs to.

    Each stream shows by its own decoding times where a part ends: what lies side by side in a file at that place may
    belong to different parts.

    Args:
        pictures: the stream of pictures, whose first presentation is time zero. interval_s: between two, usually.

    Attributes:
        joints_s: times at which a part begins, without the first.
    """

    def __init__(self, pictures: Any, interval_s: float) -> None:
        self._pictures = pictures
        self._start = pictures.start_time or 0
        self._base_s = float(pictures.start_time * pictures.time_base) if pictures.start_time is not None else 0.0
        self._interval_s = interval_s
        self._shifts_s = [0.0]
        self.joints_s: list[float] = []
        self._latest_s = 0.0
        self._part: dict[int, int] = {}
        self._decoded_s: dict[int, float] = {}

    @property
    def parts(self) -> int:
        """Number of parts whose pictures have begun."""
        return len(self._shifts_s)

    def place(self, packet: Any) -> tuple[int, float | None]:
        """The part of the next packet of the file and its seconds within it, None if it has no time."""
        stream = packet.stream.index
        part = self._part.get(stream, 0)
        if packet.dts is not None:
            decoded_s = float(packet.dts * packet.time_base)
            part += decoded_s < self._decoded_s.get(stream, decoded_s) - _RESTART_S
            self._decoded_s[stream] = decoded_s
        if packet.stream is not self._pictures:  # what follows the first picture of a part belongs to it, or to a later
            part = max(part, len(self.joints_s))
        self._part[stream] = part
        if packet.pts is None:
            return part, None
        if packet.stream is self._pictures:
            return part, float((packet.pts - self._start) * packet.time_base)
        return part, float(packet.pts * packet.time_base) - self._base_s

    def picture(self, part: int, seconds: float | None) -> float | None:
        """Time of a picture in the whole file; the first one of a part begins it after all before."""
        if part >= len(self._shifts_s):
            self.joints_s.append(self._latest_s + self._interval_s)
            self._shifts_s.append(self.joints_s[-1] - (seconds or 0.0))
        return self._moment(part, seconds)

    def metadata(self, part: int, seconds: float | None) -> float | None:
        """Time of metadata in the whole file, never before its part begins.

        Parts whose pictures never begin count as the last one that did.
        """
        part = min(part, len(self._shifts_s) - 1)
        moment = self._moment(part, seconds)
        return max(moment, self.joints_s[part - 1]) if part and moment is not None else moment

    def _moment(self, part: int, seconds: float | None) -> float | None:
        if seconds is None:
            return None
        self._latest_s = max(self._latest_s, seconds + self._shifts_s[part])
        return seconds + self._shifts_s[part]


class NotAVideo(Unreadable):
    """A file with a video's suffix is not a video; the text is one sentence for the user."""


@dataclass(slots=True)
class PictureNote:
    """Metadata of one picture's packet."""

    video_s: float | None  # its time in the video
    sample: Sample | None = None  # its own pose
    decoders: tuple[str, ...] = ()  # names of the decoders that understood it
    position: int | None = None  # offset of the packet in the file, None if the container does not give it


@dataclass(slots=True, kw_only=True)
class VideoScan:
    """All metadata of a video file."""

    path: Path  # the file
    codec: str  # of the pictures
    width: int  # columns
    height: int  # rows
    rate: float | None = None  # pictures a second, None if not given
    created_s: float | None = None  # UTC epoch seconds of the container's creation time
    pictures: list[PictureNote] = field(default_factory=list)  # one for each video packet, in order of the file
    # video time (None if unknown), number of video packets before it, packet
    klv_packets: list[tuple[float | None, int, klv.KlvPacket]] = field(default_factory=list)
    djmd_samples: list[tuple[float, Sample]] = field(default_factory=list)  # video time and sample
    gpmf_samples: list[tuple[float, Sample]] = field(default_factory=list)  # video time and sample
    cues: srt.Subtitles = field(default_factory=srt.Subtitles)  # of a subtitle track
    # (UUID, size) -> number of private SEI messages without a decoder
    unknown_sei: Counter[tuple[str, int]] = field(default_factory=Counter)
    # times at which the file's clock starts again (recordings joined); times continue over them
    joints_s: list[float] = field(default_factory=list)
    aspect: float = 1.0  # width of a pixel over its height
    others: list[tuple[int, int]] = field(default_factory=list)  # width and height of other video streams
    turn: Turn = AS_CODED  # how a player turns the pictures

    @property
    def has_times(self) -> bool:
        """Whether it is known when in the video any picture is shown; not of raw streams that state no rate."""
        return self.rate is not None or any(note.video_s is not None for note in self.pictures)

    @property
    def sei_count(self) -> int:
        """Pictures with a SEI message that was recognised."""
        return sum(note.sample is not None for note in self.pictures)


def open_video(path: Path | str, **options: Any) -> Any:
    """Open a file or a URL with PyAV. Raises NotAVideo: it cannot be opened or holds no video."""
    import av

    try:
        container = av.open(str(path), **options)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        if "://" in str(path):
            raise NotAVideo(f"the stream {path} cannot be opened ({_reason(error)}); check its address") from None
        if _lacks_index(Path(path)):
            raise NotAVideo(
                "the video is cut off: its index, which cameras write last, is missing; copy it from the card again "
                "or have it repaired with an intact video of the same camera"
            ) from None
        raise NotAVideo(
            f"the file is not a video that can be read ({_reason(error)}); check it with a player or leave it out"
        ) from None
    if not container.streams.video:
        container.close()
        raise NotAVideo("the file holds no pictures; name a video")
    if picture_stream(container).codec_context is None:
        container.close()
        raise NotAVideo("its pictures are coded in a way that is not known here; convert the video to H.264 or H.265")
    return container


def picture_stream(container: Any) -> Any:
    """The stream that is mapped: the one with most pixels, without cover pictures; the first of equals."""
    return max(moving_streams(container), key=_pixels)


def moving_streams(container: Any) -> list[Any]:
    """The video streams of a file; cover pictures, which cameras store as a stream, count if there is nothing else."""
    from av.stream import Disposition

    streams = list(container.streams.video)
    return [s for s in streams if not s.disposition & Disposition.attached_pic] or streams


def _pixels(stream: Any) -> int:
    context = stream.codec_context
    return -1 if context is None else context.width * context.height


def square_size(columns: int, rows: int, aspect: float) -> tuple[int, int]:
    """Columns and rows of a picture once its pixels are square; none is lost."""
    if abs(aspect - 1.0) <= _SQUARE_WITHIN or not 1.0 / _MOST_ASPECT <= aspect <= _MOST_ASPECT:
        return columns, rows
    return (round(columns * aspect), rows) if aspect > 1.0 else (columns, round(rows / aspect))


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


def _lacks_index(path: Path) -> bool:
    """Whether a file is an MP4 or MOV without the box `moov` (ISO/IEC 14496-12, 4.2: size, type, content)."""
    kinds: list[bytes] = []
    try:
        with path.open("rb") as handle:
            while len(kinds) < _MOST_BOXES and len(head := handle.read(16)) >= 8:
                size = int.from_bytes(head[:4], "big")
                size = int.from_bytes(head[8:16], "big") if size == 1 else size
                kinds.append(head[4:8])
                if size < 8:
                    break
                handle.seek(size - len(head), 1)
    except (OSError, OverflowError, ValueError):
        return False
    return kinds[:1] == [b"ftyp"] and b"moov" not in kinds


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).lower()


def scan(path: Path) -> VideoScan:
    """Read all metadata of a file, without decoding pictures. Raises NotAVideo: it is not a video."""
    if path.stat().st_size == 0:
        raise NotAVideo("the file is empty; copy it again")
    with open_video(path) as container:
        stream = picture_stream(container)
        context = stream.codec_context
        result = VideoScan(path=path, codec=context.name, width=context.width, height=context.height)
        result.aspect = float(stream.sample_aspect_ratio or 1)
        contexts = [s.codec_context for s in moving_streams(container) if s is not stream]
        result.others = [(c.width, c.height) for c in contexts if c is not None]
        stated = context.framerate if container.format.name in _RAW_FORMATS else stream.average_rate
        result.rate = float(stated) if stated else None  # of a raw stream without a rate FFmpeg would assume 25
        result.created_s = epoch_of(str(container.metadata.get("creation_time", "")))
        _scan_packets(container, stream, result)
    if not result.pictures:
        raise NotAVideo("the file holds no pictures; it may be cut off")
    result.turn = _turn(path)
    return result


def _turn(path: Path) -> Turn:
    """How the pictures are turned, by the first one that can be decoded: some containers tell it by nothing else."""
    import av

    with open_video(path) as container:
        stream = picture_stream(container)
        for packet in islice(demux(container, [stream]), _MOST_BEFORE_FIRST):
            try:
                frames = packet.decode()
            except (av.error.FFmpegError, ValueError):
                continue
            if frames:
                return turn_of(frames[0])
    return AS_CODED


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
    times = _JoinedTimes(stream, 1.0 / (result.rate or 30.0))
    texts: list[tuple[float, float, str]] = []
    leftovers: dict[int, bytes] = {}
    ahead: list[tuple[Any, int, float | None]] = []  # metadata of a part whose pictures have not begun

    def read(packet: Any, seconds: float | None) -> None:
        if packet.stream.type == "data":
            _scan_data(packet, seconds, result, leftovers)
        elif seconds is not None:
            data = bytes(packet)
            if len(data) >= 2 and data[0] == 0 and int.from_bytes(data[:2], "big") <= len(data) - 2:
                data = data[2 : 2 + int.from_bytes(data[:2], "big")]  # MP4's timed text leads it with its length
            length = float((packet.duration or 0) * packet.time_base)
            texts.append((seconds, seconds + length, data.decode("utf-8", "replace")))

    for packet in demux(container, wanted):
        if packet.size == 0:
            continue
        part, seconds = times.place(packet)
        if packet.stream is not stream:
            if part < times.parts:
                read(packet, times.metadata(part, seconds))
            else:
                ahead.append((packet, part, seconds))
            continue
        if len(result.pictures) >= _MAX_PICTURES:
            break
        parts = times.parts
        note = PictureNote(times.picture(part, seconds), position=packet.pos)
        messages = [] if form is None else bitstream.sei_messages(bytes(packet), form)
        result.unknown_sei.update(sei.unknown(messages))
        if (reading := sei.read(messages)) is not None:
            note.sample, note.decoders = reading.sample, reading.decoders
        result.pictures.append(note)
        if times.parts > parts:
            for other, its_part, moment in (each for each in ahead if each[1] < times.parts):
                read(other, times.metadata(its_part, moment))
            ahead = [each for each in ahead if each[1] >= times.parts]
    for other, its_part, moment in ahead:
        read(other, times.metadata(its_part, moment))
    result.joints_s = times.joints_s
    if texts:
        result.cues = srt.parse_cues(texts)


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
        result.klv_packets += [(seconds, len(result.pictures), item) for item in found]
        return
    sample = djmd.read_djmd(data)
    if sample is not None and seconds is not None:
        result.djmd_samples.append((seconds, sample))
