"""Live video with metadata: RTSP, RTMP, MPEG-TS over UDP or TCP; pictures with their poses as they arrive.

SEI belongs to its own picture as in files. KLV in its own stream is interpolated if the next packet
has arrived, else the last one is used for half a second at most. A lost link is reopened until `stop` is set.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telemetry.formats.video import bitstream, klv, sei
from telemetry.samples.sample import Sample
from telemetry.samples.timeline import Timeline
from telemetry.videos.display_turn import turn_of
from telemetry.videos.extraction import to_rgb
from telemetry.videos.packet_loss import LiveDamage
from telemetry.videos.picture_choice import DecodedPicture, Picker
from telemetry.videos.video_file import NotAVideo, open_video, parked, picture_stream, square_size

_HELD_S = 0.5
_KEPT_SAMPLES = 64
_RETRY_S = (0.5, 1.0, 2.0, 5.0)


@dataclass(slots=True, kw_only=True)
class LivePicture:
    """One picture of a live stream."""

    number: int  # counts the pictures since the stream was first opened
    rgb: NDArray[np.uint8]  # uint8 (rows, columns, 3)
    sample: Sample | None  # its pose, None if the stream has none
    origin: str  # source of the pose
    time_s: float  # UTC epoch seconds of the exposure by the stream, else of its arrival
    damaged: bool = False  # True if parts are predicted from lost data


def open_stream(
    url: str,
    *,
    every_m: float | None = None,
    every_s: float | None = None,
    all_pictures: bool = False,
    stop: threading.Event | None = None,
    reconnect: bool = True,
    timeout_s: float = 10.0,
    options: Mapping[str, str] | None = None,
    clock: Callable[[], float] = time.time,
    on_state: Callable[[str], None] | None = None,
) -> Iterator[LivePicture]:
    """Pictures of a live stream, thinned like those of a file (`telemetry.videos.picture_choice`).

    Args:
        url: rtsp://, rtmp://, udp://, tcp://, or a file.
        every_m: spacing in metres. every_s: in seconds. all_pictures: True to get every picture.
        stop: ends the iteration when set (within `timeout_s`).
        reconnect: True to reopen a lost link; False to end with the stream.
        timeout_s: of opening and of waiting for data. options: for FFmpeg, over the defaults.
        clock: gives the time of arrival. on_state: called with "open" and "lost: reason".

    Raises:
        NotAVideo: the first opening fails and `reconnect` is False.
    """
    stop = stop or threading.Event()
    picker = None if all_pictures else Picker(every_m, every_s)
    numbers = iter(range(1 << 62))
    attempt = 0
    while not stop.is_set():
        try:
            with open_video(url, timeout=timeout_s, options=_options(url, timeout_s, options)) as container:
                attempt = 0
                if on_state is not None:
                    on_state("open")
                yield from _read(container, picker, stop, numbers, clock)
            reason = "the stream ended"
        except NotAVideo as error:
            if not reconnect:
                raise
            reason = str(error)
        except _Lost as error:
            reason = str(error)
        if on_state is not None:
            on_state(f"lost: {reason}")
        if not reconnect:
            return
        stop.wait(_RETRY_S[min(attempt, len(_RETRY_S) - 1)])
        attempt += 1


class _Lost(Exception):
    """The link broke."""


def _options(url: str, timeout_s: float, changes: Mapping[str, str] | None) -> dict[str, str]:
    # Not "nobuffer": it discards what was read while probing, including the first key picture.
    options = {"flags": "low_delay", "analyzeduration": "1000000", "probesize": "1000000"}
    if "://" in url:  # PyAV's own timeout is off while streams are probed
        options["rw_timeout"] = str(round(timeout_s * 1e6))
    if url.startswith("rtsp"):
        options["rtsp_transport"] = "tcp"
    elif url.startswith("udp"):
        options |= {"fifo_size": "1000000", "overrun_nonfatal": "1"}
    return options | dict(changes or {})


def _read(
    container: Any, picker: Picker | None, stop: threading.Event, numbers: Iterator[int], clock: Callable[[], float]
) -> Iterator[LivePicture]:
    """Pictures of one connection."""
    import av
    from av.codec.context import Flags

    stream = picture_stream(container)
    context = stream.codec_context
    context.flags |= int(Flags.copy_opaque) | int(Flags.output_corrupt)
    form = bitstream.StreamFormat.of(context.name, context.extradata)
    damage = LiveDamage()
    wanted = [stream, *(s for s in container.streams if s.type == "data")]
    klv_samples: deque[Sample] = deque(maxlen=_KEPT_SAMPLES)
    source = container.demux(*wanted)
    now_s = 0.0
    with parked(context):
        while not stop.is_set():
            try:
                packet = next(source)
                is_video = packet.stream is stream
                if packet.size and packet.pts is not None:
                    seconds = float(packet.pts * packet.time_base)
                    now_s = seconds if is_video else now_s
                else:
                    seconds = now_s
                if not is_video:
                    klv_samples.extend(
                        replace(p.sample, time_s=seconds)
                        for p in klv.packets(bytes(packet))
                        if p.sample is not None and p.sample.has_position
                    )
                    continue
                if packet.size:
                    index = damage.packet(is_key=packet.is_keyframe, is_marked=packet.is_corrupt)
                    reading = None if form is None else sei.read(bitstream.sei_messages(bytes(packet), form))
                    packet.opaque = index, reading
                frames = packet.decode()
            except StopIteration:
                return
            except (av.error.InvalidDataError, ValueError):
                damage.failed()
                continue
            except (av.error.FFmpegError, OSError) as error:
                raise _Lost(str(getattr(error, "strerror", None) or error).lower()) from None
            for frame in frames:
                index, reading = frame.opaque if isinstance(frame.opaque, tuple) else (None, None)
                lost = damage.is_damaged(index, bool(frame.is_corrupt))
                yield from _offer(
                    frame,
                    reading,
                    lost,
                    aspect=float(stream.sample_aspect_ratio or 1),
                    klv_samples=klv_samples,
                    picker=picker,
                    number=next(numbers),
                    now_s=now_s,
                    clock=clock,
                )


def _offer(
    frame: Any,
    reading: sei.Reading | None,
    lost: bool,
    *,
    aspect: float,
    klv_samples: deque[Sample],
    picker: Picker | None,
    number: int,
    now_s: float,
    clock: Callable[[], float],
) -> Iterator[LivePicture]:
    seconds = float(frame.time) if frame.time is not None else now_s
    sample, origin = (reading.sample, " + ".join(reading.decoders)) if reading is not None else (None, "")
    if klv_samples and (sample is None or not sample.has_position):
        from_klv = _klv_at(klv_samples, seconds)
        if from_klv is not None:
            from_klv = replace(from_klv, time_s=None if sample is None else sample.time_s)
            sample = from_klv if sample is None else from_klv.merge(sample)
            origin = " + ".join(filter(None, ("KLV", origin)))
    if sample is not None:
        sample = turn_of(frame).sample(sample, *square_size(frame.width, frame.height, aspect))
    candidate = DecodedPicture(number=number, frame=frame, sample=sample, video_s=seconds, origin=origin, damaged=lost)
    for one in [candidate] if picker is None else picker.push(candidate):
        stated = None if one.sample is None else one.sample.time_s
        yield LivePicture(
            number=one.number,
            rgb=turn_of(one.frame).picture(to_rgb(one.frame, aspect)),
            sample=one.sample,
            origin=one.origin,
            time_s=clock() if stated is None else stated,
            damaged=one.damaged,
        )


def _klv_at(samples: deque[Sample], seconds: float) -> Sample | None:
    """KLV at a time of the stream: interpolated between two packets, or the last one."""
    last = max(samples, key=lambda s: s.time_s or 0.0)
    if last.time_s is None or seconds > last.time_s + _HELD_S:
        return None
    found = Timeline([*samples, replace(last, time_s=last.time_s + _HELD_S)]).at(seconds)
    return found if found.has_position else None
