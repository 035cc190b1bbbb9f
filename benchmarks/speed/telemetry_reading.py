"""How fast telemetry is read: photos, SEI with decoding, KLV. Prints CPU times; one thread.

python -m benchmarks.speed.telemetry_reading [--photos FOLDER] [--pictures 600]
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np


def video(path: Path, count: int) -> None:
    """640x480 H.264 with B-frames, a drifting texture as a drone sees it, about 2 Mbit/s."""
    import av
    import cv2

    rng = np.random.default_rng(0)
    ground = cv2.GaussianBlur(rng.integers(0, 255, (480 + 2 * count, 800, 3), np.uint8), (0, 0), 1.5)
    ground = cv2.normalize(ground, None, 0, 255, cv2.NORM_MINMAX)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 640, 480, "yuv420p", 2_000_000
        stream.options = {"preset": "veryfast", "bf": "2"}
        for i in range(count):
            seen = ground[2 * i : 2 * i + 480, :640] + rng.normal(0.0, 4.0, (480, 640, 1))  # the sensor's noise
            frame = av.VideoFrame.from_ndarray(seen.clip(0, 255).astype(np.uint8), format="rgb24")
            frame.pts = i
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def bench_video(count: int) -> None:
    """Decode, SEI parsing and binding; then the same with picking and JPEG writing."""
    import av
    from av.codec.context import Flags

    from telemetry.formats.video import bitstream, sei
    from telemetry.samples.sample import Sample
    from telemetry.videos.extraction import extract
    from telemetry.write.sei_writer import add_sei

    with tempfile.TemporaryDirectory() as folder:
        plain, marked = Path(folder, "plain.mp4"), Path(folder, "marked.mp4")
        video(plain, count)
        add_sei(
            plain,
            marked,
            lambda i: Sample(
                time_s=1.7e9 + i / 30, lat_deg=47.0 + 3e-6 * i, lon_deg=8.25, height_m=100.0, yaw_deg=0.0, vehicle="v"
            ),
        )
        megabits = marked.stat().st_size * 8 / 1e6 / (count / 30)
        found = 0
        start = time.process_time()
        with av.open(str(marked)) as container:
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            stream.codec_context.flags |= int(Flags.copy_opaque)
            form = bitstream.StreamFormat.of("h264", stream.codec_context.extradata)
            assert form is not None
            for packet in container.demux(stream):
                packet.opaque = sei.read(bitstream.sei_messages(bytes(packet), form)) if packet.size else None
                found += sum(frame.opaque is not None for frame in packet.decode())
        cpu = time.process_time() - start
        assert found == count
        print(f"decode + SEI, 640x480 H.264 at {megabits:.1f} Mbit/s: {count / cpu:7.0f} pictures/s a core")
        start = time.process_time()
        taken = extract(marked, "marked.mp4", Path(folder, "cache"))
        cpu = time.process_time() - start
        print(f"scan, decode, pick {len(taken.names)}, write JPEG:        {count / cpu:7.0f} pictures/s a core")


def bench_photos(folder: Path | None) -> None:
    """Tags of photos into frames."""
    from telemetry import load

    if folder is None or not folder.is_dir():
        return
    load([folder])
    start = time.process_time()
    frames = load([folder]).frames
    cpu = time.process_time() - start
    print(f"photos into frames, {folder.name}: {1e3 * cpu / max(1, len(frames)):.3f} ms a photo ({len(frames)})")


def bench_klv() -> None:
    """ST 0601 packets."""
    from telemetry.formats.video import klv

    body = b"\x0d\x04\x20\x00\x00\x00\x0e\x04\x05\x00\x00\x00\x0f\x02\x20\x00\x05\x02\x40\x00" + bytes.fromhex("0102")
    whole = klv.ST0601_KEY + bytes([len(body) + 2]) + body
    data = (whole + klv.checksum(whole).to_bytes(2, "big")) * 2000
    start = time.process_time()
    count = sum(packet.sample is not None for packet in klv.packets(data))
    cpu = time.process_time() - start
    print(f"KLV ST 0601: {count / cpu:.0f} packets/s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=Path, help="folder of photos")
    parser.add_argument("--pictures", type=int, default=600, help="length of the video")
    args = parser.parse_args()
    bench_photos(args.photos)
    bench_video(args.pictures)
    bench_klv()


if __name__ == "__main__":
    main()
