"""A receiver that is somewhere else for a moment moves neither pictures nor the area."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from telemetry.ingest.ingest import LoadOptions, load, survey
from telemetry.samples.sample import Sample
from telemetry.samples.wild_fixes import wild_fixes
from telemetry.write.sei_writer import add_sei
from tests.telemetry.formats.test_klv import NADIR, lat, local_set
from tests.telemetry.ingest.test_ingest import photo
from tests.telemetry.videos.video_files import METRE, north, write_srt, write_video

AWAY_DEG = 5000.0 * METRE


def placed(count, **wild):
    """Positions of a flight to the north with 10 m/s, a second apart; those at `wild` indices are 5 km away."""
    return [(47.0 + (10.0 * t + 5000.0 * (t in wild["at"])) * METRE, 8.0) for t in range(count)]


@given(count=st.integers(20, 200), step_s=st.sampled_from([0.1, 1.0, 5.0]), speed=st.floats(0.0, 100.0), data=st.data())
def test_wild_fixes_anywhere_are_found_and_no_others(count, step_s, speed, data):
    wild = data.draw(st.sets(st.integers(0, count - 1), min_size=1, max_size=count // 20))
    away_m = 5000.0 + 130.0 * step_s * count
    track = [(47.0 + (speed * step_s * i + away_m * (i in wild)) * METRE, 8.0) for i in range(count)]
    assert sorted(wild_fixes([1.7e9 + step_s * i for i in range(count)], track).indices) == sorted(wild)


def test_two_flights_and_a_track_with_wrong_times_have_no_wild_fixes():
    there = [(47.0 + 1e-4 * i, 8.0) for i in range(50)]
    elsewhere = [(48.0 + 1e-4 * i, 8.0) for i in range(20)]
    assert not wild_fixes(list(np.arange(70.0)), there + elsewhere).indices
    assert not wild_fixes(list(np.arange(3000.0)), [(47.0 + i % 2, 8.0) for i in range(3000)]).indices
    assert not wild_fixes([None] * 70, there + elsewhere).indices


def read(folder, tmp_path):
    """Frames and the codes of all findings of a folder."""
    options = LoadOptions(cache=tmp_path / "cache", every_s=0.5)
    found = survey([folder], options=options)
    return found.frames(), [f for source in found.sources for f in source.findings if f.code == "wild-fix"]


def along(frames, metres_a_picture):
    for frame in frames:
        flown = metres_a_picture * int(frame.image[-6:])
        assert (frame.fix.lat_deg - 47.0) / METRE == pytest.approx(flown, abs=0.3)


def test_a_wild_block_of_an_srt_moves_no_picture(card, tmp_path):
    pytest.importorskip("av")
    write_video(card / "a.mp4", count=200)
    write_srt(card / "a.srt", seconds=21, lat=lambda t: north()(t) + AWAY_DEG * (t == 9))
    frames, (finding,) = read(card, tmp_path)
    assert len(frames) >= 35
    along(frames, 0.5)
    assert "1 position of a.mp4 (SRT) lies up to 4995 m away" in finding.message
    assert not finding.note


def test_a_wild_klv_packet_moves_no_picture(card, tmp_path):
    pytest.importorskip("av")
    write_video(
        card / "a.ts", count=100, klv=lambda t: local_set({**NADIR, 13: lat(north()(t) + AWAY_DEG * (4.0 < t < 4.05))}),
    )  # fmt: skip
    frames, _ = read(card, tmp_path)
    assert len(frames) >= 15
    assert max(frame.fix.lat_deg for frame in frames) < 47.001


def test_a_picture_whose_own_sei_is_wild_is_left_out(card, tmp_path):
    pytest.importorskip("av")
    write_video(tmp_path / "a.mp4", count=100)
    add_sei(
        tmp_path / "a.mp4", card / "a.mp4",
        lambda i: Sample(lat_deg=north()(i / 10) + AWAY_DEG * (i == 50), lon_deg=8.0, height_m=90.0),
    )  # fmt: skip
    frames, findings = read(card, tmp_path)
    assert len(frames) >= 15
    along(frames, 0.5)
    assert len(findings) == 1


@pytest.mark.parametrize("by_table", [False, True])
def test_a_photo_with_a_wild_position_is_rejected_with_its_reason(tmp_path, by_table):
    lines = ["image,lat_deg,lon_deg"]
    for i in range(12):
        place = 47.0 + 10.0 * i * METRE + AWAY_DEG * (i == 6)
        photo(tmp_path / f"P_{i}.JPG", 47.5 if by_table else place, 8.0, 2 * i)
        lines.append(f"P_{i}.JPG,{place:.7f},8.0")
    if by_table:
        (tmp_path / "poses.csv").write_text("\n".join(lines))
    found = load([tmp_path])
    (rejection,) = found.rejected
    assert rejection.image == "P_6.JPG"
    assert "than any aircraft flies" in rejection.reason
    assert len(found.frames) == 11
    assert any("P_6.JPG first" in warning for warning in found.warnings)


@pytest.mark.parametrize("kind", ["photos", "srt"])
def test_more_wild_positions_than_are_left_out_are_told(card, tmp_path, kind):
    """Three of twelve: no position is thrown away, but nobody has to find out by the map."""
    if kind == "photos":
        for i in range(12):
            photo(card / f"P_{i}.JPG", 47.0 + 10.0 * i * METRE + AWAY_DEG * (i in (3, 6, 9)), 8.0, 2 * i)
    else:
        pytest.importorskip("av")
        write_video(card / "a.mp4", count=120)
        write_srt(card / "a.srt", seconds=12, lat=lambda t: north()(t) + AWAY_DEG * (t in (3, 6, 9)))
    found = survey([card], options=LoadOptions(cache=tmp_path / "cache", every_s=0.5))
    findings = [f for s in found.sources for f in s.findings if f.code == "positions-unreachable"]
    assert len(findings) == 1 and not findings[0].note
    assert "3 of 12 photos" in findings[0].message or "a.mp4 (SRT)" in findings[0].message
    assert not found.rejected


def test_photos_of_a_clock_that_was_set_back_are_not_wild(tmp_path):
    """For 50 s photos of two places 800 m apart seem to alternate, 9 % of all."""
    for i in range(300):
        photo(tmp_path / f"P_{i}.JPG", 47.0 + 32.0 * i * METRE, 8.0, 2 * i - 51 * (i >= 150))
    assert not load([tmp_path]).rejected
