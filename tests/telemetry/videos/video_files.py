"""Videos of plain pictures with what cameras write beside them: subtitles in DJI's form, KLV in a transport stream."""

import struct
from collections.abc import Callable
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import numpy as np

METRE = 1.0 / 111_194.93
"""Degrees of latitude in a metre."""
PLACED = "[latitude: {lat:.6f}] [longitude: {lon:.6f}] [rel_alt: {height:.3f} abs_alt: 500.000]"


def north(metres_a_second: float = 5.0, start_m: float = 0.0) -> Callable[[float], float]:
    """Latitude over time of a flight to the north from latitude 47."""
    return lambda t: 47.0 + (start_m + metres_a_second * t) * METRE


NORTHWARD = north()


def write_video(
    path: Path,
    *,
    count: int,
    sizes: tuple[tuple[int, int], ...] = ((160, 120),),
    rate: int = 10,
    aspect: Fraction | None = None,
    created: str | None = None,
    klv: Callable[[float], bytes] | None = None,
    klv_every: int = 1,
    b_pictures: int = 2,
    shows: np.ndarray | None = None,
    codec: str = "libx264",
) -> Path:
    """A video with one stream of each size, and a KLV packet with every `klv_every`-th picture.

    `b_pictures`: how many in a row are coded by what precedes and what follows, and so stored out of order. `shows`:
    grey values of all pictures; by default plain ones that grow brighter.
    """
    import av

    with av.open(str(path), "w") as container:
        if created:
            container.metadata["creation_time"] = created
        streams = []
        for size in sizes:
            stream = container.add_stream(codec, rate=rate)
            stream.width, stream.height = size
            stream.pix_fmt, stream.options = "yuv420p", {"g": "15", "bf": str(b_pictures)}
            if aspect is not None:
                stream.codec_context.sample_aspect_ratio = aspect
            streams.append(stream)
        data = container.add_data_stream("klv") if klv else None
        for number in range(count):
            for stream in streams:
                plain = np.full((stream.height, stream.width), 16 + number % 200, np.uint8)
                frame = av.VideoFrame.from_ndarray(plain if shows is None else shows, format="gray").reformat(
                    format="yuv420p"
                )
                frame.pts = number
                container.mux(stream.encode(frame))
            if data is not None and klv is not None and number % klv_every == 0:
                packet = av.Packet(klv(number / rate))
                packet.pts = packet.dts = round(number / rate * 90_000)
                packet.time_base, packet.stream = Fraction(1, 90_000), data
                container.mux(packet)
        for stream in streams:
            container.mux(stream.encode())
    return path


def write_srt(
    path: Path,
    *,
    seconds: int,
    lat: Callable[[float], float] = NORTHWARD,
    height: Callable[[float], float] = lambda _: 100.0,
    more: Callable[[float], str] = lambda _: "",
    form: str = PLACED,
    utc_s: float = 1.7e9,
) -> Path:
    """DJI subtitles, a block a second, with positions at longitude 8.25."""
    blocks = []
    for t in range(seconds):
        values = {"lat": lat(t), "lon": 8.25, "height": height(t)}
        written = datetime.fromtimestamp(utc_s + t, UTC).strftime("%Y-%m-%d %H:%M:%S.000")
        times = f"{_cue(t)} --> {_cue(t + 1)}"
        blocks.append(f"{t + 1}\n{times}\nFrameCnt: {t + 1}\n{written}\n{form.format(**values)}{more(t)}\n\n")
    path.write_text("".join(blocks))
    return path


def _cue(t: int) -> str:
    return f"{t // 3600:02d}:{t // 60 % 60:02d}:{t % 60:02d},000"


def tell_players_to_turn(path: Path, clockwise_deg: int, *, mirrored: bool = False) -> None:
    """Write the display matrix of an MP4 with one track as a camera would (ISO/IEC 14496-12, 8.3.2: box `tkhd`)."""
    across, along = (round(65536 * f(np.radians(clockwise_deg))) for f in (np.cos, np.sin))
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    assert struct.unpack_from(">9i", data, at)[::4] == (65536, 65536, 1 << 30)
    flip = -1 if mirrored else 1
    struct.pack_into(">9i", data, at, flip * across, along, 0, -flip * along, across, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
