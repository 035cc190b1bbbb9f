"""Videos as they come from the cards of several drones: joined, cut, zoomed, with two cameras."""

from fractions import Fraction

import numpy as np
import pytest

from telemetry.ingest.ingest import LoadOptions, survey
from tests.telemetry.formats.test_klv import NADIR, lat, local_set
from tests.telemetry.videos.video_files import METRE, north, write_srt, write_video

pytest.importorskip("av")


def metres(frame) -> float:
    return (frame.fix.lat_deg - 47.0) / METRE


def number(frame) -> int:
    return int(frame.image[-6:])


def klv_at(place, utc_s):
    return lambda t: local_set({**NADIR, 13: lat(place(t)), 2: round((utc_s + t) * 1e6).to_bytes(8, "big")})


@pytest.mark.parametrize("klv_every", [1, 4, 10])
@pytest.mark.parametrize("count", [96, 101])
@pytest.mark.parametrize("b_pictures", [0, 2])
def test_joined_recordings_keep_their_own_places_and_times(card, tmp_path, mapped, klv_every, count, b_pictures):
    """Two transport streams in one file, both with times from zero, a kilometre and a day apart."""
    first, second = north(5.0), north(-5.0, 1000.0)
    parts = [
        write_video(
            tmp_path / f"{name}.ts", count=count, klv=klv_at(place, utc_s), klv_every=klv_every, b_pictures=b_pictures
        )
        for name, place, utc_s in (("a", first, 1.7e9), ("b", second, 1.7e9 + 86_400))
    ]
    (card / "ab.ts").write_bytes(b"".join(part.read_bytes() for part in parts))
    frames = mapped(card, 0.5).frames
    numbers = [number(frame) for frame in frames]
    assert numbers == sorted(numbers)
    assert len(set(numbers)) == len(numbers) > 0.2 * count
    assert min(numbers) < 10
    assert max(numbers) > 2 * count - 10
    held_m = 5.0 * klv_every / 10 + 0.2  # the last packet's position holds until the end of its part
    for frame in frames:
        part, t = divmod(number(frame), count)
        assert metres(frame) == pytest.approx((5.0 * t / 10, 1000.0 - 5.0 * t / 10)[part], abs=held_m)
        assert frame.time_s == pytest.approx(1.7e9 + 86_400 * part + t / 10, abs=0.25)


def test_a_recording_of_one_piece_keeps_its_times(card):
    write_video(card / "a.ts", count=60, klv=klv_at(north(), 1.7e9))
    (source,) = survey([card], options=LoadOptions(decode=False)).sources
    assert "times-restart" not in {f.code for f in source.findings}


def test_the_larger_of_two_videos_in_a_file_is_mapped_and_the_other_named(card, mapped):
    write_video(card / "wide.mp4", count=50, sizes=((160, 128), (320, 240)))
    write_srt(card / "wide.srt", seconds=5)
    found = mapped(card)
    assert {(frame.width, frame.height) for frame in found.frames} == {(320, 240)}
    assert any("160x128 not" in warning for warning in found.warnings)


@pytest.mark.parametrize(("aspect", "size"), [((4, 3), (213, 120)), ((8, 9), (160, 135)), ((1000, 1), (160, 120))])
def test_pixels_that_are_not_square_are_made_square(card, mapped, aspect, size):
    write_video(card / "a.mp4", count=30, aspect=Fraction(*aspect))
    write_srt(card / "a.srt", seconds=3)
    frames = mapped(card).frames
    assert {(frame.width, frame.height) for frame in frames} == {size}
    from orthoswarm.raster.picture_file import read_rgb

    assert read_rgb(frames[0].path).shape == (size[1], size[0], 3)


def test_pictures_on_the_ground_are_left_out(card, mapped):
    """15 s on the ground, climb, 20 s flight, landing; a meadow at takeoff height is crossed in between."""
    heights = np.concatenate(
        [np.zeros(15), np.arange(5.0, 60.0, 11.0), np.full(10, 60.0), [0.2, 0.0], np.full(8, 60.0)]
    )
    heights = np.concatenate([heights, [30.0, 8.0], np.full(8, 0.3)])
    write_video(card / "a.mp4", count=10 * len(heights))
    write_srt(card / "a.srt", seconds=len(heights), height=lambda t: heights[t])
    found = mapped(card)
    flown = {int(metres(frame) / 5.0 + 1e-6) for frame in found.frames}
    assert min(flown) in (14, 15)
    assert max(flown) in (41, 42)
    assert flown >= set(range(20, 40))
    (source,) = survey([card], options=LoadOptions(cache=card.parent / "c", every_s=1.0)).sources
    assert "pictures-on-ground" in {f.code for f in source.findings}


def test_heights_that_were_never_filled_in_leave_no_picture_out(card, mapped):
    write_video(card / "a.mp4", count=50)
    write_srt(card / "a.srt", seconds=5, height=lambda _: 0.0)
    assert len(mapped(card).frames) >= 5


def test_a_digital_zoom_begins_another_camera_and_going_back_the_first(card, mapped):
    write_video(card / "a.mp4", count=300)
    write_srt(
        card / "a.srt", seconds=30, more=lambda t: f" [focal_len: 24.00] [dzoom_ratio: {2 if 10 <= t < 20 else 1:.2f}]"
    )
    found = mapped(card)
    cameras = {int(metres(f) / 5.0): f.camera for f in found.frames if int(metres(f) / 5.0) % 10 not in (9, 0)}
    assert len({cameras[t] for t in cameras if t < 9}) == 1
    assert {cameras[t] for t in cameras if t < 9} == {cameras[t] for t in cameras if t > 20}
    assert {cameras[t] for t in cameras if 10 < t < 19}.isdisjoint(cameras[t] for t in cameras if t < 9)
    assert any("zooms" in warning for warning in found.warnings)


def test_subtitles_longer_than_their_video_are_told(card, mapped):
    """The start of a video was cut off; where its pictures lie cannot be known."""
    write_video(card / "a.mp4", count=100)
    write_srt(card / "a.srt", seconds=60)
    assert any("last 60 s, its pictures 10 s" in warning for warning in mapped(card).warnings)
    write_srt(card / "a.srt", seconds=11)
    assert not any("last" in warning for warning in mapped(card).warnings)


def test_one_srt_serves_all_videos_of_its_name(card, mapped):
    for name in ("DJI_0001.MP4", "DJI_0001.MOV"):
        write_video(card / name, count=20)
    write_srt(card / "DJI_0001.SRT", seconds=2)
    found = mapped(card)
    assert not found.rejected
    assert {frame.image.split("#")[0] for frame in found.frames} == {"DJI_0001.MP4", "DJI_0001.MOV"}


def test_a_files_track_counts_if_the_srt_beside_it_has_no_positions(card, tmp_path, mapped):
    import av

    write_video(tmp_path / "v.mkv", count=50)
    write_srt(tmp_path / "v.srt", seconds=5)
    with (
        av.open(str(tmp_path / "v.mkv")) as video,
        av.open(str(tmp_path / "v.srt")) as text,
        av.open(str(card / "a.mkv"), "w") as out,
    ):
        outputs = [out.add_stream_from_template(source.streams[0]) for source in (video, text)]
        packets = [(i, p) for i, source in enumerate((video, text)) for p in source.demux() if p.size]
        for i, packet in sorted(
            packets, key=lambda row: (row[1].pts if row[1].dts is None else row[1].dts) * row[1].time_base
        ):
            packet.stream = outputs[i]
            out.mux(packet)
    (card / "a.srt").write_text("1\n00:00:00,000 --> 00:00:05,000\nOur holidays\n\n")
    assert len(mapped(card).frames) >= 5


def test_two_drones_of_one_model_are_two_vehicles(card, mapped):
    for name, place in (("a", north()), ("b", north(5.0, 300.0))):
        model = {**NADIR, 10: b"Matrice 30"}
        del model[4]
        write_video(card / f"{name}.ts", count=20, klv=lambda t, p=place, m=model: local_set({**m, 13: lat(p(t))}))
    assert {frame.vehicle for frame in mapped(card).frames} == {"a", "b"}


def test_a_call_sign_names_a_vehicle(card, mapped):
    items = {key: value for key, value in NADIR.items() if key != 4} | {59: b"EAGLE 2"}
    write_video(card / "a.ts", count=20, klv=lambda t: local_set({**items, 13: lat(north()(t))}))
    assert {frame.vehicle for frame in mapped(card).frames} == {"EAGLE 2"}


def test_a_video_whose_camera_lost_power_says_what_is_missing(card, tmp_path, mapped):
    whole = write_video(tmp_path / "a.mp4", count=50).read_bytes()
    (card / "a.mp4").write_bytes(whole[: len(whole) // 2])
    (rejection,) = mapped(card).rejected
    assert "index" in rejection.reason
    assert "card again" in rejection.reason


def test_warnings_say_which_video_they_are_about(card, mapped):
    write_video(card / "a.mp4", count=60)
    write_srt(card / "a.srt", seconds=2)
    warnings = mapped(card).warnings
    (yaw,) = [warning for warning in warnings if "hold no yaw" in warning]
    assert yaw.startswith("a.mp4: ")
    assert any("pictures of 60 in a.mp4 have no position" in warning for warning in warnings)
