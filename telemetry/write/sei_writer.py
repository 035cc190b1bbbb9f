"""Inserts SEI into H.264 and H.265 without re-encoding, for simulated cameras and companion computers.

`add_sei` rewrites a file packet by packet: each picture's packet gets one more NAL unit before its first slice, all
else is unchanged, so every player shows the same pictures. `with_sei` does it for one packet of a live encoder.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from orthoswarm.model.errors import InputError
from telemetry.formats.video import bitstream, sei
from telemetry.samples.sample import Sample
from telemetry.videos.extraction import decoded
from telemetry.videos.video_file import NotAVideo, demux, open_video, picture_stream, scan

_RAW = frozenset({".h264", ".264", ".avc", ".h265", ".265", ".hevc"})

PoseOf = Callable[[int], Sample | bytes | None]
"""From a picture's number in order of presentation to its sample, or to a whole payload of type 5, or None."""


def with_sei(packet: bytes, sample: Sample | bytes, form: bitstream.StreamFormat) -> bytes:
    """An encoded picture with our SEI in it (or another payload of type 5, its UUID included)."""
    payload = sample if isinstance(sample, bytes) else sei.encode(sample)
    return bitstream.insert_unit(packet, bitstream.sei_unit(sei.USER_DATA_UNREGISTERED, payload, form), form)


def add_sei(source: Path, target: Path, pose_of: PoseOf) -> int:
    """Copy a video, adding SEI to its pictures; the target's suffix names its container.

    Args:
        source: an H.264 or H.265 video. target: path of the copy.
        pose_of: returns the sample for each picture, by its number in order of presentation from 0.

    Returns:
        Number of pictures that got one.

    Raises:
        InputError: the source is not an H.264 or H.265 video, or the target's container cannot hold it.
    """
    import av

    try:
        order = presentation_order(source)
    except NotAVideo as reason:
        raise InputError(f"{source.name}: {reason}") from None
    temporary = target.with_name(f".{target.stem}.part{target.suffix}")
    try:
        with open_video(source) as reader:
            stream = picture_stream(reader)
            form = bitstream.StreamFormat.of(stream.codec_context.name, stream.codec_context.extradata)
            if form is None:
                raise InputError(f"{source.name} is neither H.264 nor H.265; SEI cannot be put into it")
            if form.prefix and target.suffix.lower() in _RAW:
                raise InputError("an MP4 cannot become a raw stream here; choose .mp4, .mkv or .ts for the copy")
            packets = _packets(reader, stream, form, order, pose_of)
            write = _write_raw if target.suffix.lower() in _RAW else _write_container
            written = write(reader, stream, packets, temporary)
        os.replace(temporary, target)
    except av.error.FFmpegError as error:
        raise InputError(f"{target.name} cannot be written ({error.strerror}); choose .mp4, .mkv or .ts") from None
    finally:
        temporary.unlink(missing_ok=True)
    return written


def presentation_order(path: Path) -> list[int]:
    """For each video packet of a file its picture's number in order of presentation.

    Raises NotAVideo: it is not a video.
    """
    with open_video(path) as container:
        stream = picture_stream(container)
        times = [packet.pts for packet in demux(container, [stream]) if packet.size]
    if times and all(t is not None for t in times) and len(set(times)) == len(times):
        rank = {t: i for i, t in enumerate(sorted(times))}
        return [rank[t] for t in times]
    return _order_by_decoding(path, len(times))


def _order_by_decoding(path: Path, count: int) -> list[int]:
    """The order where the stream has no times (raw streams), from the decoder."""
    order = list(range(count))
    for number, index, _ in decoded(scan(path)):
        if index is not None and index < count:
            order[index] = number
    return order


def _packets(reader: Any, stream: Any, form: bitstream.StreamFormat, order: list[int], pose_of: PoseOf) -> Any:
    index = 0
    for packet in demux(reader, [s for s in reader.streams if s.type in ("video", "audio")]):
        if packet.size == 0:
            continue
        if packet.stream is not stream:
            yield packet, None, False
            continue
        pose = pose_of(order[index]) if index < len(order) else None
        index += 1
        data = bytes(packet)
        yield packet, data if pose is None else with_sei(data, pose, form), pose is not None


def _write_raw(_reader: Any, stream: Any, packets: Any, target: Path) -> int:
    written = 0
    with target.open("wb") as handle:
        for packet, data, marked in packets:
            if packet.stream is stream:
                handle.write(data)
                written += marked
    return written


def _write_container(reader: Any, _stream: Any, packets: Any, target: Path) -> int:
    import av

    written = 0
    with av.open(str(target), "w") as writer:
        outputs = {s.index: writer.add_stream_from_template(s) for s in reader.streams if s.type in ("video", "audio")}
        for packet, data, marked in packets:
            copy = packet
            if data is not None:
                copy = av.Packet(data)
                copy.pts, copy.dts, copy.duration = packet.pts, packet.dts, packet.duration
                copy.time_base = packet.time_base
                copy.is_keyframe = packet.is_keyframe
            copy.stream = outputs[packet.stream.index]
            writer.mux(copy)
            written += marked
    return written
