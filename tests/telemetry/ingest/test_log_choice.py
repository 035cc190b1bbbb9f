"""Photos beside several logs, and cameras whose clock is set during the flight: never a wrong place without a sign."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from telemetry.formats.log.flight_logs import read_log
from telemetry.ingest import log_ingest
from telemetry.ingest.ingest import load
from telemetry.ingest.pairing.event_pairing import pair
from tests.telemetry.formats.test_exposure_lists import STEPS, UTC_S, solution, write_mrk, write_pos
from tests.telemetry.ingest.test_photos import gps_exif, jpeg

METRE = 1.0 / 111_194.93
TAKEN_S = np.cumsum([5.0, *[1.0, 1.7, 2.2] * 8])
"""Seconds of a flight at which a photo was taken."""


def place(t, metres_east=0.0):
    """Where a vehicle is after so many seconds: to the north, then back beside its way, with 8 m/s."""
    north = 8.0 * (t if t < 30.0 else 60.0 - t)
    return 47.5 + north * METRE, 8.25 + (metres_east + (20.0 if t >= 30.0 else 0.0)) * METRE / np.cos(np.radians(47.5))


def track(path, *, metres_east=0.0, later_s=0.0):
    """A receiver's track, five positions a second."""
    moments = np.arange(0.0, 60.0, 0.2)
    rows = [(UTC_S + later_s + t, "{:.8f} {:.8f} 500.0".format(*place(t, metres_east))) for t in moments]
    return solution(path, rows)


def photos(folder, clock_s, *, metres_east=None, offset=None, prefix="P"):
    """Photos by a camera whose clock shows `clock_s(i, utc)`; without positions unless `metres_east` says whose."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, t in enumerate(TAKEN_S):
        moment = datetime.fromtimestamp(clock_s(i, UTC_S + t), UTC)
        where = (0.0, 0.0) if metres_east is None else place(t, metres_east)
        local, fraction = moment.strftime("%Y:%m:%d %H:%M:%S"), f"{moment.microsecond // 1000:03d}"
        name = f"{prefix}_{i:03d}.JPG"
        jpeg(folder / name, exif_bytes=gps_exif(*where, local=local, subsec=fraction, offset=offset))


def right(_, utc_s):
    return utc_s


def number(frame):
    return int(frame.image[-7:-4])


@pytest.mark.parametrize("own", ["a.pos", "b.pos"])
def test_of_two_logs_the_one_along_the_photos_positions_is_taken(tmp_path, own):
    photos(tmp_path / "card", lambda _, utc_s: utc_s + 4.0, metres_east=200.0)
    for name in ("a.pos", "b.pos"):
        track(tmp_path / "card" / name, metres_east=200.0 if name == own else 170.0)
    frames = load([tmp_path]).frames
    assert len(frames) == len(TAKEN_S)
    for frame in frames:
        assert own in frame.origin["time"]
        assert frame.time_s - UTC_S == pytest.approx(TAKEN_S[number(frame)], abs=0.2)


def test_logs_that_fit_equally_well_are_not_used_unless_one_is_named_like_the_photos(tmp_path):
    for folder in ("card", "b"):
        photos(tmp_path / folder, right)
    track(tmp_path / "a.pos")
    track(tmp_path / "b.pos", metres_east=200.0)
    found = load([tmp_path])
    assert len(found.frames) == len(found.rejected) == len(TAKEN_S)
    assert all("b.pos" in frame.origin["position"] and frame.vehicle == "b" for frame in found.frames)
    assert all("equally well" in rejection.reason for rejection in found.rejected)


def test_the_log_of_the_photos_time_is_taken_and_not_the_first(tmp_path):
    photos(tmp_path / "card", right, offset="+00:00")
    track(tmp_path / "card" / "a.pos", metres_east=500.0, later_s=-3600.0)
    track(tmp_path / "card" / "b.pos")
    frames = load([tmp_path]).frames
    assert len(frames) == len(TAKEN_S)
    for frame in frames:
        assert "b.pos" in frame.origin["position"]


def test_without_a_time_zone_none_of_two_flights_logs_is_likelier(tmp_path):
    photos(tmp_path / "card", right)
    track(tmp_path / "card" / "a.pos", metres_east=500.0, later_s=-3600.0)
    track(tmp_path / "card" / "b.pos")
    found = load([tmp_path])
    assert not found.frames and len(found.rejected) == len(TAKEN_S)


@pytest.mark.parametrize("again", [False, True])
def test_a_log_of_hours_places_photos_in_its_flight_and_names_other_zones_that_fit(tmp_path, again):
    """The vehicle waits for an hour before its flight and after it, or flies again; the clock shows local time."""
    photos(tmp_path / "card", lambda _, utc_s: utc_s + 3600.0)
    moments = np.arange(-3700.0, 7400.0)
    flown = np.clip(moments - 3600.0 * (again & (moments >= 1800.0)), 0.0, 60.0)
    rows = [(UTC_S + m, "{:.8f} {:.8f} 500.0".format(*place(f))) for m, f in zip(moments, flown, strict=True)]
    solution(tmp_path / "card" / "a.pos", rows)
    found = load([tmp_path])
    (said,) = [warning for warning in found.warnings if "by time" in warning]
    assert ("fit as well" in said) == again
    if not again:
        for frame in found.frames:
            assert frame.time_s - UTC_S == pytest.approx(TAKEN_S[number(frame)], abs=1e-3)


def two_flights(folder, hours, second_s=2400.0):
    """Photos of two flights by one clock that is off by some hours; when each was taken, by name."""
    photos(folder, lambda _, utc_s: utc_s + 3600.0 * hours)
    photos(folder, lambda _, utc_s: utc_s + 3600.0 * hours + second_s, prefix="Q")
    return {f"{prefix}_{i:03d}.JPG": (t, prefix) for prefix in "PQ" for i, t in enumerate(TAKEN_S)}


@pytest.mark.parametrize("hours", [0.0, 2.0, 5.75])
def test_photos_of_two_flights_beside_their_tracks_are_placed_where_one_zone_fits_all(tmp_path, hours):
    taken = two_flights(tmp_path / "card", hours)
    track(tmp_path / "card" / "a.pos")
    track(tmp_path / "card" / "b.pos", metres_east=500.0, later_s=2400.0)
    found = load([tmp_path])
    assert len(found.frames) == 2 * len(TAKEN_S)
    for frame in found.frames:
        t, prefix = taken[frame.image.rsplit("/", 1)[-1]]
        assert ("a.pos" if prefix == "P" else "b.pos") in frame.origin["position"]
        assert frame.fix.lat_deg == pytest.approx(place(t)[0], abs=1e-6)
    assert any("one time zone only" in warning for warning in found.warnings)


@pytest.mark.parametrize("trap", ["beside another vehicle's", "in two zones", "one flight unlogged"])
def test_photos_of_two_flights_get_no_place_without_evidence(tmp_path, trap):
    two_flights(tmp_path / "card", 0.0, second_s=3600.0)
    track(tmp_path / "card" / "a.pos")
    if trap != "one flight unlogged":
        track(tmp_path / "card" / "b.pos", metres_east=500.0, later_s=3600.0)
    if trap == "in two zones":
        track(tmp_path / "card" / "c.pos", metres_east=900.0, later_s=7200.0)
    elif trap != "one flight unlogged":
        track(tmp_path / "card" / "c.pos", metres_east=900.0, later_s=3600.0)
    found = load([tmp_path])
    assert not found.frames and len(found.rejected) == 2 * len(TAKEN_S)
    assert all("no log that is here" in rejection.reason for rejection in found.rejected)


def as_tlogs(monkeypatch, systems):
    """Read logs a and b as a ground station's, of these vehicles."""

    def read(path):
        return [
            replace(log, kind="tlog", vehicle=f"sysid{systems['ab'.index(path.name[0])]}") for log in read_log(path)
        ]

    monkeypatch.setattr(log_ingest, "read_log", read)


@pytest.mark.parametrize("systems", [(1, 1), (1, 2)])
def test_photos_of_one_vehicle_take_no_places_from_two(tmp_path, monkeypatch, systems):
    """Where one flight's log is missing, another vehicle that flew at the same time may have one."""
    as_tlogs(monkeypatch, systems)
    two_flights(tmp_path / "card", 0.0)
    track(tmp_path / "a.pos")
    track(tmp_path / "b.pos", metres_east=500.0, later_s=2400.0)
    used = [frame.origin["position"] for frame in load([tmp_path]).frames]
    assert len(used) == 2 * len(TAKEN_S) and len(set(used)) == 2 if systems == (1, 1) else not used


EACH = 18  # exposures of a flight


def exposure_list(path, moments, east_m):
    rows = [
        f"47.5 {8.25 + (east_m + 8.0 * (t - moments[0])) * METRE / np.cos(np.radians(47.5)):.8f} 500" for t in moments
    ]
    return solution(path, list(zip(moments, rows, strict=True)))


@pytest.mark.parametrize(
    ("one_clock", "beside", "systems"),
    [
        (True, "", None),
        (True, "", (1, 1)),
        (True, "", (1, 2)),
        (False, "", None),
        (True, "the same", None),
        (True, "another", None),
    ],
)
def test_photos_of_two_flights_are_paired_each_with_the_events_of_its_flight(
    tmp_path, monkeypatch, one_clock, beside, systems
):
    """Two lists of exposures whose clocks agree; where they do not, they may be of another vehicle.

    Beside them lie second lists of the same flights, or those of another vehicle that took pictures at the same times.
    """
    rng = np.random.default_rng(7)
    flights = [UTC_S + start + np.cumsum(rng.uniform(1.6, 3.1, EACH)) for start in (0.0, 1500.0)]
    (tmp_path / "card").mkdir()
    for k, moments in enumerate(flights):
        exposure_list(tmp_path / "card" / f"{'ab'[k]}_events.pos", moments, 300.0 * k)
        if beside:
            exposure_list(
                tmp_path / "card" / f"{'xy'[k]}_events.pos", moments, 300.0 * k + 900.0 * (beside == "another")
            )
        for i, t in enumerate(moments):
            shown = datetime.fromtimestamp(round(t + 7213.4 + (0.0 if one_clock else 40.0 * k), 2), UTC)
            local, fraction = shown.strftime("%Y:%m:%d %H:%M:%S"), f"{shown.microsecond // 10_000:02d}"
            jpeg(
                tmp_path / "card" / f"P_{EACH * k + i:03d}.JPG",
                exif_bytes=gps_exif(0.0, 0.0, local=local, subsec=fraction),
            )
    if systems is not None:
        as_tlogs(monkeypatch, systems)
    found = load([tmp_path])
    if not one_clock or beside == "another" or systems == (1, 2):
        assert not found.frames and "equally well" in found.rejected[0].reason
        return
    assert len(found.frames) == 2 * EACH and any("photos are of 2 flights" in warning for warning in found.warnings)
    for frame in found.frames:
        k, i = divmod(number(frame), EACH)
        assert frame.time_s == pytest.approx(flights[k][i], abs=2e-3)
        assert frame.origin["position"].split("(")[1][0] in ("ax", "by")[k]


def test_two_cameras_in_one_folder_are_both_placed(tmp_path):
    for prefix in "AB":
        photos(tmp_path / "card", right, prefix=prefix)
    track(tmp_path / "card" / "a.pos")
    assert len(load([tmp_path]).frames) == 2 * len(TAKEN_S)


@pytest.mark.parametrize("jump_s", [-15.0, 12.0, 3600.0])
def test_photos_after_the_clock_was_set_are_found_by_their_positions(tmp_path, jump_s):
    photos(tmp_path / "card", lambda i, utc_s: utc_s + jump_s * (i >= 14), metres_east=0.0)
    track(tmp_path / "card" / "a.pos")
    posed = [frame for frame in load([tmp_path]).frames if "a.pos" in frame.origin["time"]]
    assert len(posed) >= 20
    for frame in posed:
        assert frame.time_s - UTC_S == pytest.approx(TAKEN_S[number(frame)], abs=1.5)


def test_a_clock_that_was_set_back_places_no_photo(tmp_path):
    photos(tmp_path / "card", lambda i, utc_s: utc_s - 4.0 * (i >= 10))
    track(tmp_path / "card" / "a.pos")
    found = load([tmp_path])
    assert not found.frames
    assert all("set back during the flight" in rejection.reason for rejection in found.rejected)


def test_photos_before_the_clock_was_set_are_named_and_the_others_placed(tmp_path):
    photos(tmp_path / "card", lambda i, utc_s: utc_s if i >= 4 else 315_964_800.0 + 2.0 * i)
    track(tmp_path / "card" / "a.pos")
    found = load([tmp_path])
    assert len(found.frames) == len(TAKEN_S) - 4
    for frame in found.frames:
        assert frame.fix.lat_deg == pytest.approx(place(TAKEN_S[number(frame)])[0], abs=1e-6)
    assert all("before the camera's clock was set" in rejection.reason for rejection in found.rejected)


def test_photos_outside_a_log_are_not_said_to_have_an_unset_clock(tmp_path):
    """Four photos from 1980 and six from after the log's end, without positions; the others have positions."""
    clock = {**{i: 315_964_800.0 + 2.0 * i for i in range(4)}, **{i: UTC_S + 900.0 + 2.0 * i for i in range(19, 25)}}
    photos(tmp_path / "card", lambda i, utc_s: clock.get(i, utc_s), metres_east=0.0)
    for i in clock:
        moment = datetime.fromtimestamp(clock[i], UTC)
        exif = gps_exif(0.0, 0.0, local=moment.strftime("%Y:%m:%d %H:%M:%S"), subsec="0")
        jpeg(tmp_path / "card" / f"P_{i:03d}.JPG", exif_bytes=exif)
    track(tmp_path / "card" / "a.pos")
    found = load([tmp_path])
    assert len(found.frames) == len(TAKEN_S) - 10
    unset = {int(r.image[-7:-4]) for r in found.rejected if "clock was set" in r.reason}
    later = [r for r in found.rejected if int(r.image[-7:-4]) >= 19]
    assert unset == {0, 1, 2, 3}
    assert len(later) == 6 and len({r.reason for r in later}) == 1
    assert all("no log" in r.reason and "s after a.pos ends" in r.detail for r in later)


@pytest.mark.parametrize(("first_after", "jump_s"), [(20, 3600.0), (30, -7.0), (20, 15.0), (30, None)])
def test_camera_events_pair_with_photos_before_and_after_the_clock_was_set(first_after, jump_s):
    rng = np.random.default_rng(3)
    events = 1.7e9 + np.cumsum(rng.uniform(2.4, 3.9, 60))
    clock = events + 3.3 + rng.normal(0.0, 0.02, 60)
    if jump_s is None:  # it began in 1980
        clock[:first_after] += 315_964_800.0 - clock[0]
    else:
        clock[first_after:] += jump_s
    order = np.argsort(clock, kind="stable")
    numbers = [] if first_after == 20 else [int(i) + 1 for i in order]
    found = pair(clock[order].tolist(), events.tolist(), numbers)
    wrong = [i for i, j in found.pairs if order[i] != j]
    assert set(wrong) <= set(found.doubtful)
    assert len(found.pairs) - len(wrong) >= 57
    ((first, by_s),) = found.jumps
    assert order[first] == pytest.approx(first_after, abs=1)
    assert jump_s is None or by_s == pytest.approx(jump_s, abs=0.1)


@pytest.mark.parametrize(("seed", "unlogged"), [(0, 24), (0, 12), (3, 12), (7, 12), (11, 12)])
def test_photos_of_legs_that_no_log_recorded_take_no_events_of_later_legs(seed, unlogged):
    """Eight equal legs, the log begins at the third or fifth: the first ones have the rhythm of those that follow."""
    rng = np.random.default_rng(seed)
    gaps = [gap for _ in range(8) for gap in [*(5.0 + rng.normal(0.0, 0.1, 5)), 8.0 + rng.normal(0.0, 1.0)]]
    taken = 1.7e9 + np.cumsum(gaps)
    photos = taken + 0.3 + rng.normal(0.0, 0.02, 48)
    found = pair(photos.tolist(), taken[unlogged:].tolist(), list(range(48)))
    assert found.pairs == [(i, i - unlogged) for i in range(unlogged, 48)]
    assert not found.jumps


def test_a_list_of_exposures_and_the_ppk_solution_of_them_are_one_flights(tmp_path):
    write_mrk(tmp_path / "flight_Timestamp.MRK")
    write_pos(tmp_path / "flight_events.pos")
    for i, t in enumerate(STEPS):
        moment = datetime.fromtimestamp(UTC_S + t + 7200.0, UTC)  # the camera shows local time
        local, fraction = moment.strftime("%Y:%m:%d %H:%M:%S"), f"{moment.microsecond // 1000:03d}"
        jpeg(tmp_path / f"DJI_{i + 1:04d}.JPG", exif_bytes=gps_exif(0.0, 0.0, local=local, subsec=fraction))
    assert len(load([tmp_path]).frames) == len(STEPS)
