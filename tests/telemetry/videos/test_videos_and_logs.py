"""Videos beside the logs of a whole swarm: the log of another vehicle is never taken."""

import shutil
import struct
from datetime import UTC, datetime

import numpy as np
import pytest

from telemetry.formats.log.flight_logs import read_log
from tests.telemetry.videos.video_files import write_srt, write_video

pytest.importorskip("av")


def number(frame) -> int:
    return int(frame.image[-6:])


SWARM = tuple(f"swarm_v{k}.tlog" for k in (1, 2, 3))
TAKEN_S = 1_795_226_100.0
"""All three vehicles fly at this time."""


@pytest.fixture
def swarm(real_data, card):
    """A card with the logs of three vehicles that flew at the same time."""
    for name in SWARM:
        shutil.copy(real_data("sitl_logs") / name, card)
    return card


def created(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%dT%H:%M:%S.000000Z")


def flown(real_data, name):
    return read_log(real_data("sitl_logs") / name)[0].timeline()


def test_a_video_that_any_vehicle_may_have_taken_gets_no_pose(swarm, mapped):
    write_video(swarm / "a.mp4", count=300, created=created(TAKEN_S))
    found = mapped(swarm)
    assert not found.frames
    (rejection,) = found.rejected
    assert "equally well" in rejection.reason
    assert "folder" in rejection.reason


def test_the_log_of_the_videos_name_is_taken(swarm, real_data, mapped):
    write_video(swarm / "swarm_v2.mp4", count=300, created=created(TAKEN_S))
    at = flown(real_data, "swarm_v2.tlog").at
    for frame in mapped(swarm).frames:
        truth = at(TAKEN_S + number(frame) / 10)
        assert (frame.fix.lat_deg, frame.fix.lon_deg) == pytest.approx((truth.lat_deg, truth.lon_deg), abs=1e-6)


def test_the_logs_of_autopilot_and_ground_station_are_no_rivals(card, real_data, mapped):
    for suffix in ("tlog", "BIN"):
        shutil.copy(real_data("sitl_logs") / f"copter_cam_rtl_1x.{suffix}", card)
    span = flown(real_data, "copter_cam_rtl_1x.BIN").span
    write_video(card / "a.mp4", count=200, created=created(np.mean(span)))
    assert len(mapped(card).frames) >= 20


def without_positions(source, path):
    """Write what a device that knows no position sends, from a vehicle's tlog: attitudes and clocks."""
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(str(source))
    with path.open("wb") as file:
        while (message := link.recv_match(type=["HEARTBEAT", "SYSTEM_TIME", "ATTITUDE"])) is not None:
            file.write(struct.pack(">Q", round(message._timestamp * 1e6)) + bytes(message.get_msgbuf()))
    link.close()


def test_a_log_without_positions_is_no_rival(card, real_data, mapped):
    shutil.copy(real_data("sitl_logs") / "swarm_v2.tlog", card)
    without_positions(card / "swarm_v2.tlog", card / "gimbal.tlog")
    write_video(card / "a.mp4", count=300, created=created(TAKEN_S))
    assert len(mapped(card).frames) >= 25


@pytest.mark.parametrize("zone_s", [0.0, 7200.0])
def test_positions_choose_the_log_also_without_a_creation_time(swarm, real_data, mapped, zone_s):
    at = flown(real_data, "swarm_v2.tlog").at
    write_video(swarm / "b.mkv", count=300)
    form = "[latitude: {lat:.7f}] [longitude: 149.16]"
    write_srt(
        swarm / "b.srt", seconds=30, lat=lambda t: at(TAKEN_S + t).lat_deg, form=form, utc_s=TAKEN_S + zone_s,
        more=lambda t: f" [longitude: {at(TAKEN_S + t).lon_deg:.7f}]",
    )  # fmt: skip
    frames = mapped(swarm).frames
    assert frames
    for frame in frames:
        assert "swarm_v2.tlog" in frame.origin["height"]
        assert frame.fix.yaw_rad is not None
