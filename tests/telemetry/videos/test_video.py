"""Video: SEI written and read in every container, binding through B-frames, picking, damage."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gcs_plugin.cli.main import main
from orthoswarm.model.errors import InputError
from telemetry.ingest.ingest import LoadOptions, load, survey
from telemetry.samples.sample import Sample
from telemetry.videos.extraction import decoded, extract
from telemetry.videos.picture_choice import DecodedPicture, Picker
from telemetry.videos.picture_poses import Poses
from telemetry.videos.video_file import NotAVideo, scan
from telemetry.write.sei_writer import add_sei, presentation_order, with_sei

av = pytest.importorskip("av")

METRE = 1.0 / 111_194.93


def pose(number: int) -> Sample:
    """100 m up, 2 m further north each picture."""
    return Sample(
        time_s=1.7e9 + 0.1 * number + 0.0123456,
        lat_deg=47.0 + 2 * number * METRE,
        lon_deg=8.25,
        height_m=100.0,
        altitude_m=500.0 + number,
        yaw_deg=0.1 * number,
        pitch_deg=-90.0 + 0.01 * number,
        roll_deg=0.3,
        fov_deg=90.0,
        sigma_m=0.5,
        vehicle="uav7",
    )


def make_video(path: Path, codec="libx264", *, count=40, size=(160, 120), rate=10, b_frames=3) -> Path:
    """Pictures whose mean brightness tells their number."""
    options = {"bf": str(b_frames), "g": "15"}
    if codec == "libx265":
        options = {"x265-params": f"bframes={b_frames}:keyint=15:log-level=none"}
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.options = options
        noise = np.random.default_rng(1).integers(0, 20, (size[1], size[0], 3))
        for number in range(count):
            picture = np.clip(noise + 4 * number + 16, 0, 255).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = number
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


CASES = [
    ("libx264", ".mp4"), ("libx264", ".mkv"), ("libx264", ".ts"), ("libx264", ".h264"), ("libx264", ".flv"),
    ("libx265", ".mp4"), ("libx265", ".mkv"), ("libx265", ".ts"), ("libx265", ".h265"),
]  # fmt: skip


@pytest.mark.parametrize(("codec", "suffix"), CASES)
def test_sei_is_bound_to_its_own_picture_in_every_container(tmp_path, codec, suffix):
    source = make_video(tmp_path / f"source{suffix}", codec)
    target = tmp_path / f"target{suffix}"
    assert add_sei(source, target, pose) == 40
    found = scan(target)
    assert found.sei_count == 40
    poses = Poses(found)
    before = [frame.to_ndarray(format="gray") for _, _, frame in decoded(scan(source))]
    seen = 0
    for number, index, frame in decoded(found):
        assert poses.of(index).sample == pose(number)
        assert np.array_equal(frame.to_ndarray(format="gray"), before[number])
        seen += 1
    assert seen == 40


def test_b_frames_are_really_out_of_order(tmp_path):
    order = presentation_order(make_video(tmp_path / "a.mp4"))
    assert order != sorted(order)
    assert sorted(order) == list(range(40))


def test_a_live_encoders_packet_gets_its_sei():
    from telemetry.formats.video import bitstream, sei

    form = bitstream.StreamFormat("h264")
    packet = b"\0\0\0\1\x09\xf0\0\0\0\1\x65\x11\x22\x80"
    marked = with_sei(packet, pose(3), form)
    assert sei.read(bitstream.sei_messages(marked, form)).sample == pose(3)


def test_the_source_of_a_copy_must_be_h264_or_h265(tmp_path):
    with av.open(str(tmp_path / "a.avi"), "w") as container:
        stream = container.add_stream("mjpeg", rate=5)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for packet in [*stream.encode(av.VideoFrame(64, 48, "yuvj420p")), *stream.encode()]:
            container.mux(packet)
    with pytest.raises(InputError, match="neither"):
        add_sei(tmp_path / "a.avi", tmp_path / "b.mp4", pose)
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(InputError):
        add_sei(tmp_path / "text.mp4", tmp_path / "b.mp4", pose)
    assert not (tmp_path / "b.mp4").exists()


def test_frames_of_a_video_carry_poses_and_readable_pictures(tmp_path):
    source = make_video(tmp_path / "s.mp4")
    folder = tmp_path / "in"
    folder.mkdir()
    add_sei(source, folder / "flight.mp4", pose)
    result = load([folder], options=LoadOptions(cache=tmp_path / "cache", every_m=1.0))
    assert result.rejected == []
    assert [f.image for f in result.frames] == [f"flight.mp4#{n:06d}" for n in range(40)]
    for number, frame in enumerate(result.frames):
        expected = pose(number)
        assert frame.vehicle == "uav7"
        assert (frame.fix.lat_deg, frame.fix.height_m) == (expected.lat_deg, 100.0)
        assert np.degrees(frame.fix.pitch_rad) == pytest.approx(expected.pitch_deg)
        assert np.degrees(frame.fov_hint_rad) == pytest.approx(90.0)
        from orthoswarm.raster.picture_file import read_rgb

        rgb = read_rgb(frame.path)
        assert rgb.shape == (frame.height, frame.width, 3)
        assert rgb.mean() == pytest.approx(4 * number + 25.5, abs=4.0)


def test_distance_and_time_thin_a_video(tmp_path):
    source = make_video(tmp_path / "s.mp4")
    target = tmp_path / "t.mp4"
    add_sei(source, target, pose)
    by_distance = extract(target, "t.mp4", tmp_path / "c1", every_m=10.0)
    numbers = sorted(by_distance.names.values())
    assert numbers[0] == 0
    assert all(4 <= b - a <= 6 for a, b in zip(numbers, numbers[1:]))  # noqa: RUF007
    by_time = extract(target, "t.mp4", tmp_path / "c2", every_s=1.0)
    assert len(by_time.names) in (4, 5)
    default = extract(target, "t.mp4", tmp_path / "c3")  # 4 % of 100 m: every second picture
    assert 18 <= len(default.names) <= 25


class Blurred:
    """A decoded picture of a given sharpness."""

    width, height = 64, 64

    def __init__(self, sharp: float) -> None:
        self._sharp = sharp

    class format:
        name = "rgb24"

    def to_ndarray(self, format):
        rng = np.random.default_rng(0)
        return (128 + self._sharp * rng.standard_normal((64, 64))).clip(0, 255).astype(np.uint8)


def test_pictures_taken_before_are_used_again_until_something_changes(tmp_path):
    source = make_video(tmp_path / "s.mp4")
    target = tmp_path / "t.mp4"
    add_sei(source, target, pose)
    cache = tmp_path / "cache"

    def take(**choice):
        found = extract(target, "t.mp4", cache, **choice)
        photos = [photo for row in found.photos.values() for photo in row]
        return photos, {photo.path: photo.path.stat().st_mtime_ns for photo in photos}, found.findings

    first, written, _ = take(every_m=10.0)
    again, kept, _ = take(every_m=10.0)
    assert again == first and kept == written
    others, _, _ = take(every_m=5.0)
    assert len(others) > len(first)
    back, anew, _ = take(every_m=10.0)
    assert back == first and anew != written
    back[3].path.unlink()  # a folder that somebody has tidied up
    assert take(every_m=10.0)[0] == first
    add_sei(source, target, lambda number: replace(pose(number), height_m=50.0))
    assert all(photo.height_m == 50.0 for photo in take(every_m=10.0)[0])


def test_a_spacing_of_nothing_is_refused(tmp_path, capsys):
    for flag in ("--every-m", "--every-s"):
        assert main(["mosaic", str(tmp_path), "--out", str(tmp_path / "out"), flag, "0"]) == 2
        assert "larger than zero" in capsys.readouterr().err


def test_the_sharpest_of_neighbours_is_taken():
    picker = Picker(every_m=10.0)
    taken = []
    for number in range(40):
        sample = Sample(lat_deg=47.0 + number * METRE, lon_deg=8.0)
        sharp = 40.0 if number % 10 == 1 else 5.0
        taken += [
            c.number
            for c in picker.push(
                DecodedPicture(number=number, frame=Blurred(sharp), sample=sample, video_s=number / 10)
            )
        ]
    assert taken[:3] == [0, 11, 21]


def test_a_hovering_drone_gives_one_picture():
    picker = Picker(every_m=5.0)
    sample = Sample(lat_deg=47.0, lon_deg=8.0)
    taken = [
        c
        for n in range(100)
        for c in picker.push(DecodedPicture(number=n, frame=Blurred(1), sample=sample, video_s=n / 10))
    ]
    assert len([*taken, *picker.flush()]) == 1


def test_kwiver_counts_and_findings(real_data):
    folder = real_data("kwiver_klv")
    sources = {s.path: s for s in survey([folder], options=LoadOptions(decode=False)).sources}
    short, long = sources["aphill_short.ts"], sources["aphill_klv_10s.ts"]
    assert (short.counts["frames"], short.counts["sei"], short.counts["klv"]) == (96, 96, 48)
    assert (long.counts["klv"], long.counts["sei"]) == (300, 0)
    assert {"klv-eg0104", "sei-clock"} <= {f.code for f in short.findings}
    for name in ("h264_klv.ts", "h265_klv.ts"):
        assert (sources[name].counts["sei"], sources[name].counts["klv"]) == (30, 30)


def test_klv_without_times_is_bound_by_its_own_utc(real_data):
    found = scan(real_data("kwiver_klv") / "h264_klv.ts")
    poses = Poses(found)
    for index, (_, _, packet) in enumerate(found.klv_packets):
        own = poses.of(index).sample
        assert own.time_s == pytest.approx(packet.sample.time_s, abs=1e-3)
        assert own.lat_deg == pytest.approx(packet.sample.lat_deg, abs=1e-6)


@pytest.mark.parametrize("named", ["", "DJI_0001.MP4"], ids=["its folder is named", "it is named itself"])
def test_an_srt_beside_a_video_gives_interpolated_poses(tmp_path, named):
    make_video(tmp_path / "DJI_0001.MP4", rate=10, count=40)
    lines = []
    for second in range(4):
        lat = 47.0 + 20 * second * METRE
        text = (
            f"GPS (8.250000, {lat:.8f}, 15), D 10.0m, H 50.00m, F.PRY (0.0°, 0.0°, 10.0°), G.PRY (-90.0°, 0.0°, 9.0°)"
        )
        lines.append(f"{second + 1}\n00:00:0{second},000 --> 00:00:0{second + 1},000\n{text}\n")
    (tmp_path / "DJI_0001.SRT").write_text("\n".join(lines))
    result = load([tmp_path / named], options=LoadOptions(cache=tmp_path / "c", every_m=1.0))
    assert len(result.frames) >= 28
    frame = next(f for f in result.frames if f.image.endswith("#000015"))
    assert frame.fix.lat_deg == pytest.approx(47.0 + 30 * METRE, abs=1e-7)
    assert frame.fix.height_m == 50.0
    assert np.degrees(frame.fix.yaw_rad) == pytest.approx(9.0)
    assert frame.origin["position"] == "SRT"


def test_a_video_without_any_position_is_rejected_with_its_reason(tmp_path):
    make_video(tmp_path / "a.mp4", count=5)
    result = load([tmp_path])
    assert [(r.image, "no position" in r.reason) for r in result.rejected] == [("a.mp4", True)]


def test_nothing_is_left_where_no_picture_could_be_taken(tmp_path, capsys):
    make_video(tmp_path / "a.mp4", count=5)
    assert main(["frames", str(tmp_path / "a.mp4"), "--out", str(tmp_path / "out")]) == 2
    assert "no position" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", [b"", b"no video in here", b"\0\0\0\x18ftypisom" + b"\0" * 100])
def test_files_that_are_no_video_are_rejected(tmp_path, content):
    (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(NotAVideo):
        scan(tmp_path / "a.mp4")
    (rejection,) = load([tmp_path]).rejected
    assert rejection.image == "a.mp4"


@pytest.mark.parametrize("suffix", [".ts", ".h264", ".mkv"])
def test_truncated_and_flipped_videos_give_what_is_left(tmp_path, suffix):
    source = make_video(tmp_path / f"s{suffix}", size=(64, 48))
    target = tmp_path / f"t{suffix}"
    add_sei(source, target, pose)
    whole = target.read_bytes()
    rng = np.random.default_rng(3)
    for trial in range(6):
        data = bytearray(whole[: len(whole) * (trial + 4) // 10])
        for at in rng.integers(0, len(data), 3 * trial):
            data[at] ^= 1 << int(rng.integers(8))
        path = tmp_path / f"bad{trial}{suffix}"
        path.write_bytes(data)
        try:
            taken = extract(path, path.name, tmp_path / "c", every_m=1.0)
        except NotAVideo:
            continue
        for photos in taken.photos.values():
            for photo in photos:
                # A pose that is there is a true one: the checksum of the message holds it.
                number = round((photo.lat_deg - 47.0) / (2 * METRE))
                assert photo.lat_deg == pytest.approx(pose(number).lat_deg, abs=1e-9)


def test_a_zoom_begins_another_camera(tmp_path):
    source = make_video(tmp_path / "s.mp4")
    target = tmp_path / "t.mp4"

    def zooming(number: int) -> Sample:
        sample = pose(number)
        sample.fov_deg = 90.0 if number < 20 else 45.0
        return sample

    add_sei(source, target, zooming)
    frames = load([target], options=LoadOptions(cache=tmp_path / "c", every_m=1.0)).frames
    assert len({f.camera for f in frames[:20]}) == len({f.camera for f in frames[20:]}) == 1
    assert frames[0].camera != frames[-1].camera


def test_videos_of_one_name_in_two_folders_are_two_vehicles_and_no_picture_is_lost(tmp_path, capsys):
    for folder in ("one", "two"):
        (tmp_path / "in" / folder).mkdir(parents=True)
        make_video(tmp_path / "plain.mp4", count=3)
        moved = {"one": 0.0, "two": 1e-3}[folder]
        unnamed = replace(pose(0), vehicle=None, lat_deg=47.0 + moved)
        add_sei(tmp_path / "plain.mp4", tmp_path / "in" / folder / "DJI_0001.MP4", lambda _, s=unnamed: s)
    options = LoadOptions(cache=tmp_path / "c")
    assert {f.vehicle for f in load([tmp_path / "in"], options=options).frames} == {"one/DJI_0001", "two/DJI_0001"}
    assert {f.vehicle for f in load([tmp_path / "in" / "one"], options=options).frames} == {"DJI_0001"}
    for folder in ("one", "two"):  # the same again, of one vehicle by its metadata
        named = replace(pose(0), lat_deg=47.0 if folder == "one" else 47.001)
        add_sei(tmp_path / "plain.mp4", tmp_path / "in" / folder / "DJI_0001.MP4", lambda _, s=named: s)
    assert main(["frames", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--json"]) == 0
    written = json.loads(capsys.readouterr().out)["written"]
    assert len({row["image"] for row in written}) == len({row["file"] for row in written}) == len(written) > 1
    assert {row["vehicle"] for row in written} == {"uav7"}
