"""Videos of cameras that were not held upright: pictures and angles as a player shows them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.raster.picture_file import read_gray
from telemetry.ingest.ingest import LoadOptions, survey
from telemetry.live.live_stream import open_stream
from telemetry.samples.sample import Sample
from telemetry.videos.display_turn import Turn
from telemetry.write.sei_writer import add_sei
from tests.telemetry.videos.video_files import tell_players_to_turn, write_srt, write_video

pytest.importorskip("av")

UPRIGHT = np.full((96, 128), 60, np.uint8)
UPRIGHT[:32, :48] = 230
UPRIGHT[64:, 64:] = 130
"""Bright at the upper left, grey at the lower right."""
TURNS = [Turn(1, 0, 0, 1), Turn(0, -1, 1, 0), Turn(-1, 0, 0, -1), Turn(0, 1, -1, 0)]
"""By 0, 90, 180 and 270 degrees clockwise."""


def held(path, clockwise_deg, *, mirrored=False):
    """A video that players show upright once they have turned its pictures (and then mirrored them)."""
    coded = np.rot90(UPRIGHT[:, ::-1] if mirrored else UPRIGHT, clockwise_deg // 90)
    write_video(path, count=20, sizes=((coded.shape[1], coded.shape[0]),), shows=np.ascontiguousarray(coded))
    tell_players_to_turn(path, clockwise_deg, mirrored=mirrored)
    return path


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("clockwise_deg", [0, 90, 180, 270])
def test_pictures_are_turned_as_players_show_them(card, mapped, clockwise_deg, mirrored):
    held(card / "a.mp4", clockwise_deg, mirrored=mirrored)
    write_srt(card / "a.srt", seconds=2, more=lambda _: " [gb_yaw: 30.0 gb_pitch: -90.0 gb_roll: 0.0]")
    frames = mapped(card).frames
    assert len(frames) >= 2
    for frame in frames:
        assert (frame.width, frame.height) == (128, 96)
        assert np.abs(read_gray(frame.path).astype(float) - UPRIGHT).mean() < 6.0
        assert math.degrees(frame.fix.yaw_rad) == pytest.approx(
            30.0
        )  # the gimbal's: of the picture that it holds level
    (source,) = survey([card], options=LoadOptions(decode=False)).sources
    assert ("pictures-turned" in {f.code for f in source.findings}) == (clockwise_deg != 0 or mirrored)


def test_a_live_stream_is_turned_too(tmp_path):
    for picture in open_stream(str(held(tmp_path / "a.mp4", 90)), reconnect=False, all_pictures=True):
        assert np.abs(picture.rgb[..., 0].astype(float) - UPRIGHT).mean() < 6.0


def test_a_pose_within_the_stream_is_that_of_the_picture_as_coded(card, tmp_path, mapped):
    """The encoder knows neither the file nor how it is shown: its yaw of 20 degrees is that of the coded picture."""
    held(tmp_path / "plain.mp4", 90)
    told = Sample(lat_deg=47.0, lon_deg=8.0, height_m=90.0, yaw_deg=20.0, pitch_deg=-90.0, roll_deg=0.0, fov_deg=60.0)
    add_sei(tmp_path / "plain.mp4", card / "a.mp4", lambda _: told)
    for frame in mapped(card).frames:
        assert (frame.width, frame.height) == (128, 96)
        assert math.degrees(frame.fix.yaw_rad) == pytest.approx(-70.0)  # what was left is up now
        assert focal_px(frame.fov_hint_rad, 128) == pytest.approx(focal_px(math.radians(60.0), 96))


@given(
    turn=st.sampled_from(TURNS), yaw=st.floats(-180, 180), pitch=st.floats(-130, -50), roll=st.floats(-30, 30),
    pixel=st.tuples(st.integers(0, 127), st.integers(0, 95)),
)  # fmt: skip
def test_a_pixel_shows_the_same_ground_before_and_after(turn, yaw, pitch, roll, pixel):
    coded = Sample(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll, fov_deg=40.0)
    shown = turn.sample(coded, 128, 96)
    marks = np.zeros((96, 128), np.uint8)
    marks[pixel[1], pixel[0]] = 1
    turned = turn.picture(marks)
    row, column = np.argwhere(turned)[0]
    before = camera(coded, 128, 96).to_ground(np.array(pixel, float))
    after = camera(shown, turned.shape[1], turned.shape[0]).to_ground(np.array([column, row], float))
    assert after == pytest.approx(before, abs=1e-6, nan_ok=True)


def camera(sample, columns, rows):
    angles = (math.radians(value) for value in (sample.yaw_deg, sample.pitch_deg, sample.roll_deg))
    lens = Lens(columns, rows, focal_px(math.radians(sample.fov_deg), columns))
    return Camera(np.array([0.0, 0.0, 100.0]), rotation_from_angles(*angles), lens)


def test_what_is_not_known_of_a_pose_stays_unknown():
    turned = TURNS[1].sample(Sample(yaw_deg=10.0), 128, 96)
    assert (turned.yaw_deg, turned.pitch_deg, turned.roll_deg) == (pytest.approx(-80.0), None, None)
    turned = TURNS[2].sample(Sample(pitch_deg=-60.0), 128, 96)
    assert turned.yaw_deg is None
    assert turned.fov_deg is None
