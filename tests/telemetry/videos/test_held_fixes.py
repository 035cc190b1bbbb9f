"""A receiver that stands still while the vehicle flies: repeated, frozen, extrapolated, stale fixes of each source."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from orthoswarm.model.frame import Fix, Frame
from telemetry.ingest.ingest import LoadOptions, load, survey
from telemetry.live.live_poses import LivePoses
from telemetry.samples.held_fixes import LOST_SIGMA_M, held_fixes, measured_frames
from telemetry.samples.sample import Sample
from telemetry.samples.wild_fixes import sound_positions
from telemetry.write.sei_writer import add_sei
from tests.telemetry.formats.test_exposure_lists import solution
from tests.telemetry.formats.test_klv import NADIR, lat, local_set
from tests.telemetry.ingest.test_ingest import photo
from tests.telemetry.videos.video_files import METRE, north, write_srt, write_video

TIMES = np.arange(0.0, 200.0, 2.0)


def flown(seed=0, speed=5.0, noise=0.3):
    """East and north (100, 2) in metres of a flight to the north, two seconds apart, with a receiver's noise."""
    track = np.random.default_rng(seed).normal(scale=noise, size=(len(TIMES), 2))
    track[:, 1] += speed * TIMES
    return track


def turned():
    """The same to the north for 90 seconds, then to the east."""
    track = flown(speed=0.0)
    track[:, 1] += 5.0 * np.minimum(TIMES, 90.0)
    track[:, 0] += 5.0 * np.maximum(TIMES - 90.0, 0.0)
    return track


def held(track, times=TIMES):
    places = [(47.5 + n * METRE, 8.25 + e * METRE / np.cos(np.radians(47.5))) for e, n in track]
    return held_fixes(list(times), places)


def off_m(found, truth):
    """How far the places of held fixes are from where the vehicle was, metres."""
    at = np.c_[(found.lon_deg - 8.25) / METRE * np.cos(np.radians(47.5)), (found.lat_deg - 47.5) / METRE]
    return np.hypot(*(at - truth[found.index]).T)


@pytest.mark.parametrize("first,last", [(40, 42), (40, 46), (1, 9), (60, 80)])
def test_repeats_in_flight_lie_between_the_fixes_that_were_measured(first, last):
    truth = flown()
    track = truth.copy()
    track[first:last] = track[first]
    found = held(track)
    assert found.index == list(range(first + 1, last))
    assert off_m(found, truth).max() < 2.0  # it flew straight on
    assert found.longest_s == 2.0 * (last - first)


def test_a_turn_that_nobody_saw_is_within_the_stated_sigma():
    truth = turned()
    track = truth.copy()
    track[42:50] = track[42]
    found = held(track)
    assert found.index == list(range(43, 50))
    assert (off_m(found, truth) < 2.0 * found.sigma_m).all()


def test_a_receiver_that_measures_seldom_has_places_between_its_fixes():
    truth = flown()
    track = truth[np.arange(100) // 3 * 3]  # six seconds each
    found = held(track)
    assert found.index == [k for k in range(100) if k % 3]
    assert off_m(found, truth)[:-2].max() < 2.0


@given(seed=st.integers(0, 50), first=st.integers(5, 80), count=st.integers(3, 12), exact=st.booleans())
def test_standing_is_no_held_fix(seed, first, count, exact):
    """The vehicle stops for a while, its receiver wanders or says the same to the last digit; then it flies on."""
    track = flown(seed)
    pause = np.repeat(track[first : first + 1], count, axis=0)
    if not exact:
        pause = pause + np.random.default_rng(seed).normal(scale=0.1, size=pause.shape)
    times = np.r_[TIMES[: first + 1], TIMES[first] + 2.0 * np.arange(1, count + 1), TIMES[first + 1 :] + 2.0 * count]
    assert not held(np.r_[track[: first + 1], pause, track[first + 1 :]], times).index


def test_a_receiver_that_stays_frozen_tells_less_and_less():
    track = flown()
    track[90:] = track[90]
    found = held(track)
    assert found.index == list(range(91, 100))
    assert np.all(np.diff(found.sigma_m) > 8.0) and found.sigma_m[-1] == pytest.approx(90.0, rel=0.1)


@pytest.mark.parametrize("first,last", [(0, 10), (40, 46)])
def test_a_place_from_before_a_restart_is_not_used(first, last):
    truth = flown()
    track = truth.copy()
    track[first:last] = (-300.0, -700.0)
    found = held(track)
    assert found.index == list(range(first, last))
    assert (off_m(found, truth) < 2.0 * np.maximum(found.sigma_m, 1.0)).all()


def test_a_receiver_that_goes_on_straight_is_not_believed():
    truth = turned()
    track = truth.copy()
    track[42:56] = track[41] + np.arange(1, 15)[:, None] * (track[41] - track[40])
    found = held(track)
    assert found.index == list(range(42, 56))
    assert (off_m(found, truth) < 2.0 * found.sigma_m).all()


@pytest.mark.parametrize("rate", [1.0, 0.2])
def test_fixes_at_their_own_rate_are_none(rate):
    """Subtitles thirty times a second with the fixes of a receiver that has one or five a second."""
    times = np.arange(0.0, 60.0, 1.0 / 30.0)
    moved = 10.0 * rate * np.floor(times / rate)
    assert not held(np.c_[0.0 * moved, moved], times).index
    frozen = np.where((times >= 20.0) & (times < 32.0), moved[times >= 20.0][0], moved)
    assert len(held(np.c_[0.0 * moved, frozen], times)) == pytest.approx(12 * 30, abs=40)


def test_steps_of_coarse_coordinates_are_none():
    """Four decimals of a degree, at 1 m/s: the same eleven metres for eleven seconds."""
    places = [(round(47.5 + t * METRE, 4), 8.25) for t in range(120)]
    assert not held_fixes([float(t) for t in range(120)], places).index


def test_samples_of_a_frozen_receiver_have_a_sigma_or_no_position_and_no_other_does():
    times = np.arange(0.0, 300.0, 0.2)
    moved = 15.0 * np.where((times >= 270.0) & (times < 282.0), 270.0, times)
    samples = [Sample(lat_deg=47.5 + m * METRE, lon_deg=8.25) for m in moved]
    sound, (finding,) = sound_positions(samples, times.tolist(), "a.tlog")
    frozen = (times > 270.1) & (times < 282.0)
    assert [s is t for s, t in zip(samples, sound)] == (~frozen).tolist()
    middle = sound[int(276.0 / 0.2)]
    assert not middle.has_position and middle.sigma_m is None
    early = sound[int(272.0 / 0.2)]
    assert (early.lat_deg - 47.5) / METRE == pytest.approx(15.0 * 272.0, abs=1.0) and 4.0 < early.sigma_m < 8.0
    assert "the receiver stood still" in finding.message and "for up to 12 s" in finding.message


def test_photos_of_a_frozen_receiver_lie_between_their_neighbours_or_have_no_position(tmp_path):
    for k, (east, north_m) in enumerate(flown()[:40]):
        frozen = flown()[15] if 15 <= k < 19 else flown()[30] if k >= 30 else (east, north_m)
        photo(tmp_path / f"P_{k:02d}.JPG", 47.5 + frozen[1] * METRE, 8.25 + frozen[0] * METRE, 2 * k)
    found = load([tmp_path])
    frames = {int(f.image[2:4]): f for f in found.frames}
    for k in (16, 17, 18):
        assert (frames[k].fix.lat_deg - 47.5) / METRE == pytest.approx(10.0 * k, abs=2.0)
        assert frames[k].fix.position_sigma_m > 2.0 and "between" in frames[k].origin["position"]
    assert frames[15].fix.position_sigma_m is None and set(frames) == set(range(33))
    assert {r.image for r in found.rejected} == {f"P_{k}.JPG" for k in range(33, 40)}
    assert all("receiver stood still" in r.reason and r.lacks_position for r in found.rejected)
    assert len(found.unpositioned) == 7
    assert any("P_16.JPG first" in w and "the receiver stood still" in w for w in found.warnings)


def jumps(t):
    """Latitude to the north at 5 m/s; the receiver stands still from 8 to 14 s."""
    return north()(8.0 if 8.0 <= t < 14.0 else t)


def check(frames):
    """Places of pictures, by the seconds in which they were taken."""
    assert len(frames) >= 30
    for frame in frames:
        t = int(frame.image[-6:]) / 10
        off = abs((frame.fix.lat_deg - 47.0) / METRE - 5.0 * t)
        assert off < 3.0, (frame.image, off)
        if 10.0 < t < 12.0:
            assert frame.fix.position_sigma_m > 2.0


@pytest.mark.parametrize("source", ["srt", "klv", "sei"])
def test_pictures_of_a_video_are_where_they_flew(card, tmp_path, source):
    pytest.importorskip("av")
    if source == "srt":
        write_video(card / "a.mp4", count=200)
        write_srt(card / "a.srt", seconds=21, lat=jumps)
    elif source == "klv":
        write_video(card / "a.ts", count=200, klv=lambda t: local_set({**NADIR, 13: lat(jumps(t))}))
    else:
        write_video(tmp_path / "a.mp4", count=200)
        add_sei(tmp_path / "a.mp4", card / "a.mp4", lambda i: Sample(lat_deg=jumps(i / 10), lon_deg=8.0, height_m=90.0))
    found = survey([card], options=LoadOptions(cache=tmp_path / "cache", every_s=0.5))
    check(found.frames())
    assert any(f.code == "position-held" for s in found.sources for f in s.findings)


def test_photos_take_no_place_from_a_log_that_stood_still(tmp_path):
    moments = np.arange(0.0, 60.0, 0.2)
    rows = [(1.7e9 + t, f"{jumps(t):.8f} 8.25 500.0") for t in moments]
    solution(tmp_path / "a.pos", rows)
    found = survey([tmp_path])
    (track,) = [t for s in found.sources for t in s.tracks.values()]
    at = {round(s.time_s - 1.7e9, 1): s for s in track}
    assert (at[11.0].lat_deg - 47.0) / METRE == pytest.approx(55.0, abs=1.0) and at[11.0].sigma_m > 2.0
    assert at[20.0].sigma_m is None or at[20.0].sigma_m < 0.1
    assert any(f.code == "position-held" for s in found.sources for f in s.findings)


def live_position(t, place, speed):
    return mavlink.MAVLink_global_position_int_message(
        int(1000 * t), int(place * 1e7), int(8.0e7), 500_000, 50_000, int(100 * speed), 0, 0, 0
    )


@pytest.mark.parametrize("flies", [True, False])
def test_a_live_position_that_is_only_repeated_gets_older_until_it_is_none(flies):
    live = LivePoses("v1", clock=lambda: 0.0)
    for k in range(200):
        t = 0.2 * k
        live.feed(live_position(t, north()(min(t, 20.0)), 5.0 if t <= 20.0 or flies else 0.0), arrival_s=1.7e9 + t)
    now = 1.7e9
    assert live.at(now + 19.0).has_position and live.at(now + 19.0).sigma_m is None
    if flies:
        assert 8.0 < live.at(now + 22.0).sigma_m < 13.0
        assert not live.at(now + 20.0 + LOST_SIGMA_M / 5.0 + 1.0).has_position
    else:
        assert live.at(now + 39.0).has_position and live.at(now + 39.0).sigma_m is None


def test_a_live_source_without_a_speed_is_as_old_as_it_was_fast():
    live = LivePoses("v1", clock=lambda: 0.0)
    for k in range(100):
        t = 0.2 * k
        live.add(Sample(time_s=1.7e9 + t, lat_deg=north()(min(t, 10.0)), lon_deg=8.0), source="node 5")
    assert live.at(1.7e9 + 12.0).sigma_m == pytest.approx(10.0, abs=2.0)
    assert not live.at(1.7e9 + 16.0).has_position


def test_a_flight_that_tells_one_place_to_the_last_digit_has_none(tmp_path):
    for k in range(6):
        photo(tmp_path / f"P_{k}.JPG", 47.512345678, 8.256789, 2 * k)
    found = load([tmp_path])
    assert not found.frames and len(found.unpositioned) == 6
    assert any("all 6 photos tell one place to the last digit" in w for w in found.warnings)


def test_all_but_a_few_at_one_place_have_none(tmp_path):
    for k in range(20):
        photo(tmp_path / f"p{k:02d}.JPG", 47.5012345 if k < 18 else 47.5012345 + 3e-4 * k, 8.25, 2 * k)
    found = load([tmp_path])
    assert [frame.image for frame in found.frames] == ["p18.JPG", "p19.JPG"]
    assert any("18 of 20 photos tell one place" in warning for warning in found.warnings)


@pytest.mark.parametrize(("steps", "step_m"), [(1000, 111.2), (3600, 30.9)])
def test_coarse_coordinates_are_told_and_their_sigma_says_so(tmp_path, steps, step_m):
    for k in range(12):
        lat, lon = 47.5 + 3e-4 * k, 8.25 + 1e-3 * (k % 5)
        photo(tmp_path / f"p{k:02d}.JPG", round(lat * steps) / steps, round(lon * steps) / steps, 4 * k)
    found = load([tmp_path])
    sigma = [frame.fix.position_sigma_m for frame in found.frames]
    assert sigma == pytest.approx([np.hypot(1.5, step_m / np.sqrt(12.0))] * len(sigma), rel=0.02)
    assert any("written in steps of" in warning for warning in found.warnings)


def test_photos_at_one_place_in_coarse_coordinates_have_none(tmp_path):
    for k in range(12):
        photo(tmp_path / f"p{k:02d}.JPG", 47.5, 8.25, 4 * k)
    assert not load([tmp_path]).frames


def test_frames_that_came_live_are_refined_from_where_they_flew(tmp_path):
    """As companions and watched folders post them, one by one: later ones tell that the receiver stood still."""
    truth = flown()[:40]
    frames = []
    for k in range(len(truth)):
        east, north_m = truth[15] if 15 <= k < 24 else truth[k]
        fix = Fix(47.5 + north_m * METRE, 8.25 + east * METRE / np.cos(np.radians(47.5)), 80.0)
        frames.append(
            Frame(
                image=f"{k}.jpg", path=tmp_path / f"{k}.jpg", vehicle="v1", time_s=1.7e9 + 2.0 * k, fix=fix, width=64,
                height=48,
            )
        )  # fmt: skip
    sound = measured_frames(frames)
    assert [a is b for a, b in zip(frames, sound)] == [not 15 < k < 24 for k in range(40)]
    away = [(f.fix.lat_deg - 47.5) / METRE - t[1] for f, t in zip(sound, truth)]
    assert np.abs(away).max() < 2.0 and sound[19].fix.position_sigma_m > LOST_SIGMA_M
