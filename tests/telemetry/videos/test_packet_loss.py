"""Damage after lost packets, from the loss to the next recovery point, against the same video without losses."""

import numpy as np
import pytest

from telemetry.live.live_stream import open_stream
from telemetry.videos.extraction import decoded, extract
from telemetry.videos.packet_loss import Damage
from telemetry.videos.video_file import scan

av = pytest.importorskip("av")


def moving_video(path, codec):
    """A texture that moves, so that a lost reference shows."""
    options = {"g": "20", "bf": "0", "tune": "zerolatency"}
    if codec == "libx265":
        options = {"x265-params": "bframes=0:keyint=20:min-keyint=20:log-level=none", "tune": "zerolatency"}
    rng = np.random.default_rng(3)
    texture = rng.integers(0, 255, (60, 400)).repeat(4, axis=0).repeat(4, axis=1).astype(np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.options = 320, 240, "yuv420p", options
        for number in range(80):
            gray = texture[:, 5 * number : 5 * number + 320]
            frame = av.VideoFrame.from_ndarray(np.repeat(gray[:, :, None], 3, axis=2), format="rgb24")
            frame.pts = number
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def grays(path):
    """Picture and whether it counts as damaged, by its presentation time."""
    damage, found, pictures = Damage(), scan(path), {}
    for _, index, frame in decoded(found, damage):
        bad = frame.is_corrupt or (index is not None and damage.is_damaged(index))
        pictures[frame.pts] = frame.to_ndarray(format="gray").astype(np.int16), bad
    return pictures


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_no_smeared_picture_passes_as_sound(tmp_path, codec):
    whole = moving_video(tmp_path / "whole.ts", codec)
    data = np.frombuffer(whole.read_bytes(), np.uint8).reshape(-1, 188)
    pid = ((data[:, 1] & 0x1F).astype(int) << 8) | data[:, 2]
    truth = grays(whole)
    assert len(truth) == 80
    assert not any(bad for _, bad in truth.values())
    smeared = sound = 0
    for seed in range(6):
        lost = np.zeros(len(data), dtype=bool)
        lost[np.random.default_rng(seed).choice(np.flatnonzero(pid == 0x100)[20:], 2, replace=False)] = True
        (tmp_path / "lossy.ts").write_bytes(data[~lost].tobytes())
        for pts, (picture, bad) in grays(tmp_path / "lossy.ts").items():
            differs = pts not in truth or float(np.abs(picture - truth[pts][0]).mean()) > 1.0
            smeared += differs
            sound += not bad
            assert bad or not differs
    assert smeared > 20
    assert sound > 20


def lossy(path, whole, seed, count=2):
    """The same MPEG-TS file without some of its video's packets."""
    data = np.frombuffer(whole.read_bytes(), np.uint8).reshape(-1, 188)
    pid = ((data[:, 1] & 0x1F).astype(int) << 8) | data[:, 2]
    lost = np.zeros(len(data), dtype=bool)
    lost[np.random.default_rng(seed).choice(np.flatnonzero(pid == 0x100)[20:], count, replace=False)] = True
    path.write_bytes(data[~lost].tobytes())
    return path


@pytest.mark.slow
@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_no_smeared_picture_of_a_live_stream_passes_as_sound(tmp_path, codec):
    whole = moving_video(tmp_path / "whole.ts", codec)

    def watch(path):
        seen = open_stream(str(path), all_pictures=True, reconnect=False, clock=lambda: 0.0)
        return [(p.rgb.astype(np.int16), p.damaged) for p in seen]

    truth = watch(whole)
    assert len(truth) == 80
    assert not any(bad for _, bad in truth)
    smeared = sound = 0
    for seed in range(6):
        for picture, bad in watch(lossy(tmp_path / "lossy.ts", whole, seed)):
            differs = min(float(np.abs(picture - true).mean()) for true, _ in truth) > 1.0
            smeared += differs
            sound += not bad
            assert bad or not differs
    assert smeared > 20
    assert sound > 200


def test_damaged_pictures_of_a_file_are_kept_for_their_positions_with_a_mark(tmp_path):
    whole = moving_video(tmp_path / "whole.ts", "libx264")
    found = extract(lossy(tmp_path / "lossy.ts", whole, 0), "lossy.ts", tmp_path / "cache", every_s=0.1)
    photos = found.photos["lossy"]
    assert len(photos) >= 78
    assert 20 <= sum(photo.damaged for photo in photos) <= 40
    again = extract(tmp_path / "lossy.ts", "lossy.ts", tmp_path / "cache", every_s=0.1)  # from the cache
    assert [p.damaged for p in again.photos["lossy"]] == [p.damaged for p in photos]
    wide = extract(tmp_path / "lossy.ts", "lossy.ts", tmp_path / "wide", every_s=1.0)
    assert sum(p.damaged for p in wide.photos["lossy"]) < 0.4 * len(wide.photos["lossy"])


def test_damage_runs_from_a_loss_to_the_next_recovery_point():
    damage = Damage()
    for index in range(30):
        damage.packet(index, is_key=index % 10 == 0, is_lost=index in (4, 20))
    assert [i for i in range(30) if damage.is_damaged(i)] == [*range(4, 10), *range(20, 30)]
