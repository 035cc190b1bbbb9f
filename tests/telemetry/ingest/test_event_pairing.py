"""Photos and camera events of a log brought together under any clock; what cannot be told is marked."""

import functools
import math
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.formats.log.flight_logs import read_log
from telemetry.ingest.ingest import load
from telemetry.ingest.pairing.event_pairing import by_time, pair
from telemetry.ingest.pairing.motion_chains import PictureMotion
from tests.telemetry.ingest.decidable import decided_by_times
from tests.telemetry.ingest.exposure_grid import exposures, flown_over, ground_of, scored
from tests.telemetry.ingest.test_photos import gps_exif, jpeg

mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
log_of = functools.cache(read_log)


# --- pairing ------------------------------------------------------------------------------------------------------


def uneven(count: int, seed: int) -> np.ndarray:
    """Exposure times with the rhythm of a flight: even on legs, pauses at turns."""
    rng = np.random.default_rng(seed)
    gaps = np.where(np.arange(count) % 9 == 8, rng.uniform(6, 15, count), 2.0 + rng.normal(0, 0.15, count))
    return 1.7e9 + np.cumsum(gaps)


@pytest.mark.slow
@given(
    seed=st.integers(0, 1000),
    count=st.integers(12, 80),
    offset=st.floats(-90_000, 90_000),
    dropped=st.sets(st.integers(0, 79), max_size=6),
    missing_first=st.integers(0, 3),
    whole=st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_photos_find_their_events_under_any_clock(seed, count, offset, dropped, missing_first, whole):
    events = uneven(count, seed)
    kept = [i for i in range(count) if i >= missing_first and i not in dropped]
    photos = events[kept] + offset
    photos = np.floor(photos) if whole else photos
    found = by_time(photos, events)
    certain = [(i, j) for i, j in found.pairs if i not in found.doubtful]
    assert all(kept[i] == j for i, j in certain)
    if not found.ambiguous:
        assert found.offset_s == pytest.approx(offset, abs=0.6)
    if not whole and len(kept) >= 12:  # a handful may fit elsewhere, too, if as many were lost
        assert len(certain) >= 0.95 * len(kept)


# Interval in seconds, whole seconds, share missing.
GRID = [
    (0.3, False, 0.3), (1.0, False, 0.3), (5.0, False, 0.3), (2.0, True, 0.1), (5.0, True, 0.3), (1.0, True, 0.1),
    (0.7, True, 0.0), (0.3, True, 0.1),
]  # fmt: skip


@pytest.mark.parametrize(("interval", "whole", "missing"), GRID)
def test_no_photo_is_given_a_wrong_event_without_a_mark(interval, whole, missing):
    placed, decidable = 0, 0
    for seed in range(2):
        flown = exposures(np.random.default_rng(seed), interval, whole=whole, missing=missing)
        found = by_time(flown.photos, flown.events)
        decided = [(i, j) for i, j in found.pairs if i not in found.doubtful]
        assert all(flown.of_photo[i] == flown.of_event[j] for i, j in decided)
        by_times = decided_by_times(flown, interval, whole=whole)
        placed, decidable = placed + len(by_times & {i for i, _ in decided}), decidable + len(by_times)
    assert placed >= 0.99 * decidable


def test_a_clock_that_is_off_by_one_interval_is_weighed_too():
    """Found in the grid: of two clocks within a second of each other only one was looked at."""
    flown = exposures(np.random.default_rng(1050846101), 0.7, whole=True, missing=0.3)
    score = scored(flown)
    assert (score.wrong_unmarked, score.decided) == (0, 0)


def test_a_photo_too_near_an_event_to_be_another_exposure_is_that_one():
    flown = exposures(np.random.default_rng(0), 1.0, whole=True, missing=0.1)
    score = scored(flown)
    assert score.wrong_unmarked == 0
    assert score.decided > 0.8 * score.both


def test_extra_photos_stay_alone():
    events = uneven(30, 1)
    photos = np.sort(np.concatenate([events + 15.0, [events[0] - 60.0, events[12] + 19.5]]))
    found = by_time(photos, events)
    assert found.offset_s == pytest.approx(15.0, abs=0.1)
    assert len(found.pairs) == 30
    assert 0 not in {i for i, _ in found.pairs}


def test_an_even_rhythm_is_ambiguous():
    events = 1.7e9 + 3.0 * np.arange(30)
    assert by_time(events[1:] + 4.0, events).ambiguous


def test_without_times_numbers_and_then_order_decide():
    found = pair([None] * 4, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [101, 102, 104, 106], [1, 2, 3, 4, 5, 6])
    assert (found.how, found.pairs) == ("number", [(0, 0), (1, 1), (2, 3), (3, 5)])
    found = pair([None] * 3, [1.0, 2.0, 3.0])
    assert (found.how, found.pairs, found.ambiguous) == ("order", [(0, 0), (1, 1), (2, 2)], False)
    assert pair([], [1.0]).pairs == []


@pytest.mark.parametrize("whole", [False, True])
def test_numbers_do_not_overrule_the_times_of_photos_of_which_most_are_of_another_flight(whole):
    events = uneven(100, 3)
    other_flight = events[-1] + 4000.0 + np.cumsum(np.random.default_rng(4).uniform(1.8, 2.6, 60))
    photos = np.concatenate([events[60:] + 3600.2, other_flight])
    numbers = list(range(1, 101))
    found = pair(list(np.floor(photos) if whole else photos), list(events), numbers, numbers)
    wrong = [i for i, j in found.pairs if j != i + 60]
    assert all(i in found.doubtful for i in wrong), "wrong and not marked"
    if not whole:
        assert found.pairs == [(i, i + 60) for i in range(40)]


def photos_of(events, folder, *, offset_s, skip=()):
    """JPEGs without position, their camera clock off by some seconds."""
    folder.mkdir(parents=True, exist_ok=True)
    for n, event in enumerate(events):
        if n not in skip:
            local = datetime.fromtimestamp(event.time_s + offset_s, UTC)
            exif = gps_exif(0.0, 0.0, local=local.strftime("%Y:%m:%d %H:%M:%S"), subsec="0")
            jpeg(folder / f"DSC{n:05d}.JPG", exif_bytes=exif)


@pytest.mark.parametrize("name", ["copter_cam_rtl_1x.BIN", "swarm_v2.tlog"])
def test_photos_beside_a_log_get_the_poses_of_its_camera_events(real_data, tmp_path, name):
    source = real_data("sitl_logs") / name
    (log,) = log_of(source)
    skip = {0, 7, 8}
    photos_of(log.events, tmp_path / "set" / "photos", offset_s=7200.0 + 15.0, skip=skip)
    (tmp_path / "set" / name).write_bytes(source.read_bytes())
    result = load([tmp_path / "set"])
    assert result.rejected == []
    assert len(result.frames) == len(log.events) - 3
    for frame in result.frames:
        event = log.events[int(frame.image[-9:-4])]
        assert frame.fix.lat_deg == pytest.approx(event.sample.lat_deg, abs=1e-9)
        assert frame.fix.height_m == pytest.approx(event.sample.height_m)
        assert frame.time_s == pytest.approx(event.time_s)
        assert math.degrees(frame.fix.pitch_rad) == pytest.approx(event.sample.flight_pitch_deg - 90.0, abs=1e-3)
        assert "camera fixed under the airframe" in frame.origin["angles"]
    assert any("3 camera events" in w and "1 of them before the first photo" in w for w in result.warnings)


def test_three_vehicles_find_their_own_logs(real_data, tmp_path):
    folder = real_data("sitl_logs")
    for n in (1, 2, 3):
        (log,) = log_of(folder / f"swarm_v{n}.tlog")
        photos_of(log.events, tmp_path / "day" / f"camera{n}", offset_s=3600.0 * n + n)
        (tmp_path / "day" / f"swarm_v{n}.tlog").write_bytes((folder / f"swarm_v{n}.tlog").read_bytes())
    result = load([tmp_path / "day"])
    assert len(result.frames) == 3 * 59
    for frame in result.frames:
        assert f"swarm_v{frame.vehicle[-1]}.tlog" in frame.origin["position"]


def test_photos_with_their_own_fields_keep_them(real_data, tmp_path):
    source = real_data("sitl_logs") / "swarm_v1.tlog"
    (log,) = log_of(source)
    (tmp_path / "s").mkdir()
    for n, event in enumerate(log.events[:20]):
        local = datetime.fromtimestamp(event.time_s + 4.0, UTC).strftime("%Y:%m:%d %H:%M:%S")
        lat, lon = event.sample.lat_deg + 1e-5, event.sample.lon_deg
        jpeg(tmp_path / "s" / f"P{n:03d}.JPG", exif_bytes=gps_exif(lat, lon, local=local, subsec="0"))
    (tmp_path / "s" / "v.tlog").write_bytes(source.read_bytes())
    frames = load([tmp_path / "s"]).frames
    assert len(frames) == 20
    for frame, event in zip(frames, log.events, strict=False):
        assert frame.fix.lat_deg == pytest.approx(event.sample.lat_deg + 1e-5, abs=1e-8)
        assert frame.origin["position"] == "EXIF GPS"
        assert frame.fix.height_m == pytest.approx(60.0, abs=0.5)


# Interval in seconds, share missing, least share of photos with an event that has to be placed without a doubt.
BY_PICTURES = [(0.3, 0.0, 0.5), (0.7, 0.3, 0.5)]


@pytest.mark.slow
@pytest.mark.parametrize(("interval", "missing", "least"), BY_PICTURES)
def test_pictures_tell_where_whole_seconds_do_not(real_data, tmp_path, interval, missing, least):
    ground = ground_of(real_data("autzen") / "autzen_ortho_0.3m_utm10.tif")
    rng = np.random.default_rng(4)
    flown = exposures(rng, interval, whole=True, missing=missing, count=60)
    by_times = scored(flown)
    by_pictures = scored(flown, flown_over(ground, flown, rng, interval, tmp_path))
    assert by_pictures.wrong_unmarked == 0
    assert by_pictures.decided > by_times.decided
    assert by_pictures.decided >= least * by_pictures.both


def test_pictures_are_read_only_where_times_do_not_decide():
    flown = exposures(np.random.default_rng(2), 5.0, whole=True, missing=0.0)
    asked = []

    def shifts(some):
        asked.extend(some)
        return np.full(len(some) - 1, np.nan)

    found = by_time(flown.photos, flown.events, PictureMotion(np.arange(float(len(flown.events))), shifts))
    assert not found.doubtful
    assert asked == []


def test_a_log_that_contradicts_the_pictures_does_not_decide_anything():
    rng = np.random.default_rng(5)
    flown = exposures(rng, 0.7, whole=True, missing=0.3, count=40)
    motion = PictureMotion(
        np.cumsum(rng.uniform(0.0, 8.0, len(flown.events))), lambda some: rng.uniform(1.0, 20.0, len(some) - 1)
    )
    assert scored(flown, motion).wrong_unmarked == 0


@pytest.mark.slow
def test_a_mission_that_was_flown_twice_is_paired_flight_by_flight(real_data, tmp_path):
    """The second log alone fits the photos of both flights; only the clock of the first tells which are its own."""
    poses = {}
    for name, later in (("swarm_v1.tlog", 0), ("copter_cam_rtl_1x.BIN", 100)):
        source = real_data("sitl_logs") / name
        (log,) = log_of(source)
        photos_of(log.events, tmp_path / "part", offset_s=3612.3)
        (tmp_path / "card").mkdir(exist_ok=True)
        for n, event in enumerate(log.events):
            poses[f"DSC{n + later:05d}.JPG"] = event.sample
            (tmp_path / "part" / f"DSC{n:05d}.JPG").rename(tmp_path / "card" / f"DSC{n + later:05d}.JPG")
        (tmp_path / "card" / name).write_bytes(source.read_bytes())
    frames = load([tmp_path / "card"]).frames
    assert len(frames) == len(poses)
    for frame in frames:
        assert frame.fix.lat_deg == pytest.approx(poses[frame.image].lat_deg, abs=1e-9) and not frame.ambiguous


@pytest.mark.slow
def test_photos_that_fit_a_log_in_two_ways_and_in_one_have_no_event_get_no_place(real_data, tmp_path):
    """A mission flown twice, the second log alone: its events may be those of either flight, at other legs, too."""
    for name, later in (("swarm_v1.tlog", 0), ("copter_cam_rtl_1x.BIN", 100)):
        (log,) = log_of(real_data("sitl_logs") / name)
        photos_of(log.events, tmp_path / "part", offset_s=3612.3)
        (tmp_path / "card").mkdir(exist_ok=True)
        for n in range(len(log.events)):
            (tmp_path / "part" / f"DSC{n:05d}.JPG").rename(tmp_path / "card" / f"DSC{n + later:05d}.JPG")
    source = real_data("sitl_logs") / "copter_cam_rtl_1x.BIN"
    (tmp_path / "card" / source.name).write_bytes(source.read_bytes())
    found = load([tmp_path / "card"])
    assert all(frame.ambiguous and frame.fix.position_sigma_m > 30.0 for frame in found.frames)
    assert sum("in more than one way" in rejection.reason for rejection in found.rejected) >= 14
    assert any("in more than one way" in warning for warning in found.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_photos_of_three_flights_are_paired_with_the_log_of_each(seed):
    """A log lasts a minute, the photos an hour: the last flight begins far after the first photo."""
    rng = np.random.default_rng(seed)
    flights = [1.7e9 + 1500.0 * k + np.cumsum(rng.uniform(1.6, 3.1, 30)) for k in range(3)]
    photos = np.round(np.concatenate(flights) + 7213.4, 2)
    for k, events in enumerate(flights):
        found = pair(photos.tolist(), events.tolist())
        assert found.pairs == [(30 * k + i, i) for i in range(30)] and not found.doubtful
        back = pair(events.tolist(), photos.tolist())  # and the other way: the log has all flights
        assert back.pairs == [(i, 30 * k + i) for i in range(30)]
