"""Mutated real bytes through every parser of telemetry, for a bounded time; a longer run is marked slow."""

import time
from pathlib import Path

import numpy as np
import pytest

from telemetry.formats.log.flight_logs import NotALog, read_log
from telemetry.formats.photo import exif, xmp
from telemetry.formats.photo.exif import parse_dji
from telemetry.formats.photo.picture_container import NotAPicture, read_container
from telemetry.formats.table import geo_txt, pose_csv
from telemetry.formats.video import bitstream, djmd, klv, sei, srt
from telemetry.photos.photo_tags import read_photo
from tests.telemetry.formats.test_sei import dji_payload, packet
from tests.telemetry.formats.test_srt import djmd as djmd_message

SLOWEST_S = 2.0


def mutated(seed: bytes, rng: np.random.Generator) -> bytes:
    """Flips, cuts, repeats, zeros and lengths that lie."""
    data = bytearray(seed)
    for _ in range(int(rng.integers(1, 6))):
        if not data:
            break
        at = int(rng.integers(len(data)))
        span = int(rng.integers(1, 64))
        kind = int(rng.integers(6))
        if kind == 0:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            del data[at : at + span]
        elif kind == 2:
            data[at:at] = data[at : at + span]
        elif kind == 3:
            data[at : at + span] = bytes(len(data[at : at + span]))
        elif kind == 4:
            data[at : at + 4] = rng.integers(0, 2**32, dtype=np.uint32).tobytes()[: len(data[at : at + 4])]
        else:
            data = data[: at + 1]
    return bytes(data)


def sei_packets() -> list[bytes]:
    from telemetry.samples.sample import Sample

    seeds = []
    for form in (bitstream.StreamFormat("h264"), bitstream.StreamFormat("hevc", 4)):
        whole = packet(form)
        for kind, payload in ((5, sei.encode(Sample(lat_deg=47.0, lon_deg=8.0, vehicle="v"))), (245, dji_payload())):
            whole = bitstream.insert_unit(whole, bitstream.sei_unit(kind, payload, form), form)
        seeds.append(whole)
    return seeds


def parse_sei(data: bytes) -> None:
    for form in (bitstream.StreamFormat("h264"), bitstream.StreamFormat("hevc", 4), bitstream.StreamFormat("h264", 2)):
        sei.read(bitstream.sei_messages(data, form))


def klv_seeds(real_data) -> list[bytes]:
    from tests.telemetry.formats.test_klv import NADIR, klv_of, local_set

    folder = real_data("kwiver_klv")
    streams = [klv_of((folder / name).read_bytes()) for name in ("aphill_short.ts", "h264_klv.ts")]
    return [local_set(NADIR), streams[0][:554], streams[1][:2422]]


PARSERS = {
    "sei": (lambda real: sei_packets(), parse_sei),
    "klv": (klv_seeds, lambda data: list(klv.packets(data))),
    "srt": (
        lambda real: [p.read_bytes()[:3000] for p in real("dji_srt_small").iterdir() if p.suffix.lower() == ".srt"],
        lambda data: srt.parse_srt(data.decode("utf-8", "replace")),
    ),
    "djmd": (lambda real: [djmd_message()], djmd.read_djmd),
    "makernotes": (
        lambda real: [
            read_container(real("sheffield_cross_800") / "DJI_0056.JPG").exif.exif[exif.MAKER_NOTE],
            read_container(real("jwcate_1200") / "DJI_0447.JPG").exif.exif[exif.MAKER_NOTE],
        ],
        parse_dji,
    ),
    "exif": (
        lambda real: [(real("brighton_beach_1600") / "DJI_0018.JPG").read_bytes()[30:4000]],
        lambda data: exif.parse_tiff(data),
    ),
    "xmp": (
        lambda real: [read_container(real("mirafiori_rtk") / "DJI_0010.JPG").xmp],
        lambda data: xmp.number(xmp.properties(data), "drone-dji:GimbalYawDegree"),
    ),
}


def fuzz(seeds: list[bytes], parse, budget_s: float, seed: int) -> int:
    rng = np.random.default_rng(seed)
    end = time.monotonic() + budget_s
    runs = 0
    while time.monotonic() < end:
        data = mutated(seeds[int(rng.integers(len(seeds)))], rng)
        start = time.process_time()
        parse(data)
        assert time.process_time() - start < SLOWEST_S
        runs += 1
    return runs


@pytest.mark.parametrize("name", PARSERS)
def test_mutated_bytes_are_survived(real_data, name):
    seeds, parse = PARSERS[name]
    assert fuzz(seeds(real_data), parse, 0.4, 1) > 20


@pytest.mark.slow
@pytest.mark.parametrize("name", PARSERS)
def test_mutated_bytes_are_survived_for_long(real_data, name):
    seeds, parse = PARSERS[name]
    assert fuzz(seeds(real_data), parse, 20.0, int(time.time())) > 1000


def test_an_element_full_of_blanks_takes_no_time():
    """Found by fuzzing: blanks around a value were tried in every split."""
    start = time.process_time()
    xmp.properties(b"<drone-dji:A>" + b" " * 100_000)
    xmp.properties((b"<drone-dji:A>" + b" " * 1000) * 200)
    assert time.process_time() - start < SLOWEST_S


def file_parser(name: str):
    def photo(path: Path) -> None:
        try:
            read_photo(path)
        except NotAPicture as reason:
            assert str(reason)

    def log(path: Path) -> None:
        try:
            read_log(path)
        except NotALog as reason:
            assert str(reason)

    def table(path: Path) -> None:
        from orthoswarm.model.errors import InputError

        try:
            geo_txt.read_geo_txt(path)
        except InputError as reason:
            assert str(reason)

    def poses(path: Path) -> None:
        from orthoswarm.model.errors import InputError

        try:
            pose_csv.read_pose_csv(path)
        except InputError as reason:  # another program's table, of a projection that it does not name
            assert str(reason)

    return {"photo": photo, "log": log, "table": table, "poses": poses}[name]


GEO = b"EPSG:32632\na b.JPG 465000.0 5260000.0 512.0 12 -89 1 0.02\nc.JPG 465010.0 5260000.0 512.0\n"
CSV = b"image,time,lat_deg,lon_deg,height_m,yaw_deg\na.jpg,2024-05-06T10:00:00Z,47.5,8.25,120,10\nb.jpg,5,47,8,1,2\n"

GPX = b"<gpx><trk><trkseg>" + b"<trkpt lat='47' lon='8'><ele>9</ele><time>2026-05-04T10:00:00Z</time></trkpt>" * 9
NMEA = (
    b"$GPRMC,100000.00,A,4403.327,N,12304.21,W,5.0,0.0,040526,,,A\n$GPGGA,100001.00,4403.3,N,12304.2,W,1,12,0.8,250.5\n"
)

FILES = {
    "a.gpx": ("log", lambda real: GPX),
    "a.nmea": ("log", lambda real: NMEA),
    "photo.jpg": (
        "photo",
        lambda real: (real("sheffield_cross_800") / "DJI_0056.JPG").read_bytes()[:8000] + b"\xff\xd9",
    ),
    "log.tlog": ("log", lambda real: (real("sitl_logs") / "swarm_v1.tlog").read_bytes()[:60000]),
    "log.BIN": ("log", lambda real: (real("sitl_logs") / "copter_cam_rtl_1x.BIN").read_bytes()[:150000]),
    "geo.txt": ("table", lambda real: GEO),
    "poses.csv": ("poses", lambda real: CSV),
}


def fuzz_file(path: Path, whole: bytes, parse, budget_s: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    end = time.monotonic() + budget_s
    while time.monotonic() < end:
        path.write_bytes(mutated(whole, rng))
        parse(path)


@pytest.mark.parametrize("name", FILES)
def test_mutated_files_are_survived(real_data, tmp_path, name):
    kind, seed = FILES[name]
    fuzz_file(tmp_path / name, seed(real_data), file_parser(kind), 0.5, 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_mutated_files_are_survived_for_long(real_data, tmp_path, name):
    kind, seed = FILES[name]
    fuzz_file(tmp_path / name, seed(real_data), file_parser(kind), 20.0, int(time.time()))
