"""Mutated files through every reader: python -m benchmarks.robustness.reader_fuzz [--inputs N] [--only READER].

Each reader runs in a process of its own with limits of memory, processor seconds and time that hold inside C code, too:
a reader that exceeds them ends its process and counts as a failure. Prints, for each reader, inputs, exceptions other
than the reader's own, and microseconds an input. Exit code 1 if there was any failure.
"""

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from orthoswarm.model.errors import OrthoSwarmError
from telemetry.samples.unreadable import Unreadable

_MEMORY = 3 << 30
_SECONDS_AN_INPUT = 0.05
_LEAST_SECONDS = 600
_WAITING = 20
"""Seconds of time for each second of processor time: a reader that waits for itself uses none."""
Reader = Callable[[bytes, Path], Any]


def _seeds() -> dict[str, tuple[list[bytes], Reader]]:
    """What each reader is fed: a valid input, and how it reads one."""
    from telemetry.formats.log.flight_logs import read_log
    from telemetry.formats.photo import exif, xmp
    from telemetry.formats.photo.exif import parse_dji
    from telemetry.formats.table.geo_txt import read_geo_txt
    from telemetry.formats.table.pose_csv import read_pose_csv
    from telemetry.formats.video import bitstream, djmd, gpmf, klv, sei, srt
    from telemetry.photos.photo_tags import read_photo
    from telemetry.videos.extraction import pictures
    from telemetry.videos.picture_poses import Poses
    from telemetry.videos.video_file import scan
    from telemetry.write.sei_writer import add_sei
    from tests.telemetry.formats import test_can_logs, test_flight_logs, test_gpmf, test_klv, test_reader_fuzz, test_srt
    from tests.telemetry.formats.test_exposure_lists import write_mrk, write_pos
    from tests.telemetry.formats.test_tables import TABLES
    from tests.telemetry.ingest import test_photos
    from tests.telemetry.videos import test_video

    def file(read: Callable[[Path], Any], name: str) -> Reader:
        def run(data: bytes, folder: Path) -> None:
            (folder / name).write_bytes(data)
            read(folder / name)

        return run

    def made(write: Callable[[Path], Any], name: str) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder) / name)
            return (Path(folder) / name).read_bytes()

    def photo(path: Path) -> None:
        test_photos.jpeg(path, xmp_packet=test_photos.DJI_ATTRIBUTES, exif_bytes=test_photos.gps_exif())

    records = [("GPS", (3, 2e8 + 200 * i, 1850, 12, 80, 470000000, 80000000, 60, 460, 0, 0, 0.0, 200 * i))
               for i in range(20)]  # fmt: skip
    older = {"GPS": test_flight_logs.OLDER_GPS["time of week"]}

    def dataflash(path: Path) -> None:
        whole = [(name, tuple(int(v) if isinstance(v, float) and v else v for v in row)) for name, row in records]
        test_flight_logs.dataflash(path, older, whole)

    def bus(path: Path) -> None:
        test_can_logs.write(path, test_can_logs.bus_messages(1)[:80])

    def video(path: Path, codec: str = "libx264") -> None:
        with tempfile.TemporaryDirectory() as folder:
            plain = test_video.make_video(Path(folder) / path.name, codec, count=8)
            add_sei(plain, path, test_video.pose)

    def hevc(path: Path) -> None:
        video(path, "libx265")

    def decode(path: Path) -> None:
        found = scan(path)
        list(pictures(found, Poses(found)))

    form = bitstream.StreamFormat("h264")
    return {
        "SEI": (test_reader_fuzz.sei_packets(), lambda data, _: sei.read(bitstream.sei_messages(data, form))),
        "KLV": ([test_klv.local_set(test_klv.NADIR)], lambda data, _: list(klv.packets(data))),
        "SRT": (
            [b"1\n00:00:00,000 --> 00:00:01,000\n2017.08.05 14:11:51\nGPS(8.25,47.5,16) BAROMETER:1.9\n"],
            lambda data, _: srt.parse_srt(data.decode("utf-8", "replace")),
        ),
        "djmd": ([test_srt.djmd()], lambda data, _: djmd.read_djmd(data)),
        "GPMF": ([test_gpmf.gps5()], lambda data, _: gpmf.read_gpmf(data)),
        "EXIF": ([test_photos.gps_exif()[6:]], lambda data, _: exif.parse_tiff(data)),
        "XMP": ([test_photos.DJI_ATTRIBUTES], lambda data, _: xmp.properties(data)),
        "MakerNotes": ([b"\x02\0" + b"\1\0\2\0\4\0\0\0DJI\0" + b"\3\0\x0b\0\1\0\0\0\0\0\x80\x3f"],
                       lambda data, _: parse_dji(data)),
        "photo": ([made(photo, "a.jpg")], file(read_photo, "a.jpg")),
        "geo.txt": ([test_reader_fuzz.GEO], file(read_geo_txt, "geo.txt")),
        "tables": (
            [test_reader_fuzz.CSV, *(text.encode() for _, text, _ in TABLES.values())],
            file(read_pose_csv, "poses.csv"),
        ),
        "MRK": ([made(write_mrk, "a.MRK")], file(read_log, "a.MRK")),
        "GPX": ([test_reader_fuzz.GPX], file(read_log, "a.gpx")),
        "NMEA": ([test_reader_fuzz.NMEA], file(read_log, "a.nmea")),
        "pos": ([made(write_pos, "a.pos")], file(read_log, "a.pos")),
        "ULog": (
            [made(lambda path: test_flight_logs.ulog(path, seconds=1, events=1), "a.ulg")], file(read_log, "a.ulg")
        ),
        "DataFlash": ([made(dataflash, "a.BIN")], file(read_log, "a.BIN")),
        "tlog": ([made(lambda path: test_can_logs.tlog(path, seconds=2), "a.tlog")], file(read_log, "a.tlog")),
        **{
            f"CAN {suffix}": ([made(bus, f"a{suffix}")], file(read_log, f"a{suffix}"))
            for suffix in (".log", ".asc", ".blf", ".trc")
        },
        **{
            suffix[1:].upper(): ([made(video, f"a{suffix}")], file(scan, f"a{suffix}"))
            for suffix in (".mp4", ".mov", ".ts", ".mkv", ".flv", ".h264")
        },
        "H265": ([made(hevc, "a.h265")], file(scan, "a.h265")),
        "MP4 pictures": ([made(video, "a.mp4"), made(video, "b.mov")], file(decode, "a.mp4")),
        "MKV pictures": ([made(video, "a.mkv")], file(decode, "a.mkv")),
        "FLV pictures": ([made(video, "a.flv")], file(decode, "a.flv")),
        "H264 pictures": ([made(video, "a.h264")], file(decode, "a.h264")),
        "HEVC pictures": (
            [made(hevc, "a.mp4"), made(hevc, "b.mkv"), made(hevc, "c.ts"), made(hevc, "d.h265")], file(decode, "a.mp4")
        ),
        "TS pictures": ([made(video, "a.ts")], file(decode, "a.ts")),
    }  # fmt: skip


def _feed(name: str, inputs: int, seed: int, result: Any) -> None:
    """Feed one reader within limits; sends inputs done, failures, one failure as text and seconds."""
    from tests.telemetry.formats.test_reader_fuzz import mutated

    seconds = _seconds(inputs)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    seeds, read = _seeds()[name]
    rng = np.random.default_rng(seed)
    failures, example, start = 0, "", time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(inputs):
            data = mutated(seeds[int(rng.integers(len(seeds)))], rng)
            try:
                read(data, Path(folder))
            except (Unreadable, OrthoSwarmError):
                continue
            except Exception as error:
                failures += 1
                example = f"{type(error).__name__}: {error}"
    result.send((inputs, failures, example, time.process_time() - start))


def _seconds(inputs: int) -> int:
    return max(_LEAST_SECONDS, int(inputs * _SECONDS_AN_INPUT))


def main() -> int:
    """Feed every reader."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=50_000, help="inputs for each reader (default: 50,000)")
    parser.add_argument("--only", action="append", metavar="READER")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    context, bad = multiprocessing.get_context("spawn"), 0
    print("reader        inputs  exceptions   us an input")
    for name in args.only or _seeds():
        here, there = context.Pipe(duplex=False)
        process = context.Process(target=_feed, args=(name, args.inputs, args.seed, there))
        process.start()
        there.close()
        try:
            if not here.poll(_WAITING * _seconds(args.inputs)):
                process.kill()
            inputs, failures, example, seconds = here.recv()
            print(f"{name:12} {inputs:7,} {failures:11} {1e6 * seconds / inputs:13.0f}   {example}", flush=True)
        except EOFError:
            failures = 1
            print(f"{name:12} ended by a limit or a crash", flush=True)
        process.join()
        bad += failures
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
