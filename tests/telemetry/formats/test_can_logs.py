"""Logs of CAN buses: candump, Vector, PEAK; alone, and beside the autopilot's log and photos."""

import struct
import subprocess
import sys

import numpy as np
import pytest

import telemetry
from telemetry.formats.log.flight_logs import NotALog, read_log
from telemetry.ingest.ingest import survey
from tests.telemetry.ingest.test_ingest import photo

can = pytest.importorskip("can")
pytest.importorskip("dronecan")
mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")

from tests.kit.can_node import CanNode, attitude, camera_down, fix2  # noqa: E402

T0 = 1_700_000_000.0
LOGGER_OFF_S = -3.0  # the logger's clock behind UTC


def position(second):
    return 47.5 + 4e-5 * second, 8.25 + 1e-5 * second


def bus_messages(seconds=30, sigma_m=0.02):
    """Ten times a second: a receiver with RTK, a poor one, an attitude and a gimbal."""
    good, poor, frames = CanNode(42), CanNode(43), []
    for tenth in range(10 * seconds):
        utc_s = T0 + tenth / 10
        lat, lon = position(tenth / 10)
        said = [
            (poor, fix2(lat + 3e-5, lon, 520.0, utc_s, 2.0)), (good, attitude(30.0)), (good, camera_down(15.0)),
            (good, fix2(lat, lon, 512.0, utc_s, sigma_m)),
        ]  # fmt: skip
        for number, (node, message) in enumerate(said):
            frames += node.messages(message, utc_s + LOGGER_OFF_S + 0.01 * number)
    return frames


def write(path, frames):
    with can.Logger(str(path)) as log:
        for frame in frames:
            log.on_message_received(frame)


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".trc"])
def test_positions_and_angles_come_from_a_log_of_the_bus(tmp_path, suffix):
    path = tmp_path / f"bus{suffix}"
    write(path, bus_messages())
    (log,) = read_log(path)
    assert (log.kind, log.vehicle, log.has_gimbal) == ("DroneCAN", "bus", True)
    sample = log.timeline().at(T0 + 12.34)
    assert (sample.lat_deg, sample.lon_deg) == pytest.approx(position(12.34), abs=1e-8)
    assert sample.altitude_m == pytest.approx(512.0)
    assert sample.sigma_m == pytest.approx(0.02, rel=0.01)
    assert (sample.yaw_deg, sample.pitch_deg, sample.flight_yaw_deg) == pytest.approx((45.0, -90.0, 30.0), abs=0.2)
    found = survey([path])
    assert found.sources[0].kind == "DroneCAN"
    assert not [f for f in found.findings if not f.note]


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".trc"])
def test_a_damaged_log_gives_what_is_whole(tmp_path, suffix):
    path = tmp_path / f"bus{suffix}"
    write(path, bus_messages())
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    data = bytearray(whole[: int(0.9 * len(whole))])
    for at in rng.integers(2000, len(data), 0 if suffix == ".blf" else 5):  # BLF is compressed in a few large blocks
        data[at] = int(rng.integers(0, 128))
    path.write_bytes(data)
    (log,) = read_log(path)
    assert len([s for s in log.samples if s.has_position]) > (100 if suffix == ".blf" else 200)
    errors = [abs(s.lat_deg - position(s.time_s - T0)[0]) for s in log.samples if s.has_position]
    assert np.median(errors) < 1e-8


@pytest.mark.parametrize("version", [1, 2, 9])
def test_an_object_that_states_no_size_does_not_hold_the_reader_for_ever(tmp_path, version):
    path = tmp_path / "bus.blf"
    write(path, bus_messages(2))
    header = path.read_bytes()[: struct.unpack_from("<L", path.read_bytes(), 4)[0]]
    endless = struct.pack("<4sHHLL", b"LOBJ", 32, version, 0, 1) + bytes(64)
    container = struct.pack("<H6xL4x", 0, len(endless)) + endless
    path.write_bytes(header + struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(container), 10) + container)
    code = "import sys, pathlib, telemetry.formats.log.flight_logs as f; f.read_log(pathlib.Path(sys.argv[1]))"
    read = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=60)
    assert "NotALog" in read.stderr and read.stderr.count("object header") == 0


@pytest.mark.parametrize(("name", "text"), [("server.log", "12:00 started\n"), ("dem.asc", "ncols 4\nnrows 4\n")])
def test_other_files_of_these_suffixes_are_worth_a_note_only(tmp_path, name, text):
    photo(tmp_path / "a.jpg")
    (tmp_path / name).write_text(text)
    found = survey([tmp_path])
    assert [(f.code, f.note) for f in found.findings if name in f.message] == [("not-a-log", True)]
    with pytest.raises(NotALog, match="not the log of a CAN bus"):
        read_log(tmp_path / name)


def test_a_bus_without_positions_is_named(tmp_path):
    path = tmp_path / "bus.log"
    write(path, [can.Message(timestamp=T0, arbitration_id=0x123, data=[1, 2], is_extended_id=False)])
    with pytest.raises(NotALog, match="no DroneCAN position"):
        read_log(path)


def tlog(path, *, seconds=30, off_deg=1e-5, exposures=True):
    """An autopilot whose own position is a metre off, with an exposure each second."""
    packer, out = mavlink.MAVLink(None, 1, 1), bytearray()

    def put(message, time_s):
        out.extend(struct.pack(">Q", round(time_s * 1e6)) + message.pack(packer))

    for tenth in range(10 * seconds):
        at, (lat, lon) = T0 + tenth / 10, position(tenth / 10)
        place = (round((lat + off_deg) * 1e7), round(lon * 1e7))
        if tenth % 10 == 0:
            put(mavlink.MAVLink_system_time_message(round(at * 1e6), 100 * tenth), at)
        put(mavlink.MAVLink_global_position_int_message(100 * tenth, *place, 560000, 60000, 0, 0, 0, 0), at)
        put(mavlink.MAVLink_attitude_message(100 * tenth, 0.0, 0.0, np.radians(30.0), 0, 0, 0), at)
        if exposures and tenth % 10 == 5:
            put(
                mavlink.MAVLink_camera_feedback_message(
                    round(at * 1e6), 1, 0, tenth // 10, *place, 560.0, 60.0, 0.0, 0.0, 30.0, 0.0, 0
                ),
                at,
            )
    path.write_bytes(out)


def shoot(folder, count=28):
    """Photos with times and no position, at the exposures."""
    from datetime import UTC, datetime

    from PIL import Image

    folder.mkdir()
    for number in range(count):
        moment = datetime.fromtimestamp(T0 + number + 0.5, UTC)
        tags = Image.Exif()
        tags.get_ifd(0x8769).update({0x9003: moment.strftime("%Y:%m:%d %H:%M:%S"), 0x9291: "50", 0x9011: "+00:00"})
        Image.new("RGB", (64, 48), (number, 90, 90)).save(folder / f"{number:03d}.jpg", exif=tags)


@pytest.mark.parametrize("exposures", [True, False])
@pytest.mark.parametrize(("sigma_m", "used"), [(0.02, True), (3.0, False)])
def test_photos_get_the_buss_position_where_it_is_better(tmp_path, exposures, sigma_m, used):
    shoot(tmp_path / "photos")
    tlog(tmp_path / "flight.tlog", exposures=exposures)
    write(tmp_path / "bus.log", bus_messages(sigma_m=sigma_m))
    found = telemetry.load([tmp_path / "photos", tmp_path / "flight.tlog", tmp_path / "bus.log"])
    assert len(found.frames) == 28
    errors = [abs(f.fix.lat_deg - position(f.time_s - T0)[0]) * 111_000 for f in found.frames]
    assert (np.median(errors) < 0.02) == used
    assert all(("positions" in f.origin["position"]) == used for f in found.frames)
    assert all("bus.log" in f.origin["angles"] for f in found.frames)  # the autopilot reports no gimbal
    assert np.degrees([f.fix.yaw_rad for f in found.frames]) == pytest.approx(45.0, abs=0.3)
    assert all(f.fix.height_m == pytest.approx(60.0) for f in found.frames)
