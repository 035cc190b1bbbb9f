"""Lists of exposures of GNSS receivers, beside photos that know only their time."""

from datetime import UTC, datetime

import numpy as np
import pytest

from telemetry.formats.log.flight_logs import NotALog, read_log
from telemetry.ingest.ingest import load, survey
from tests.telemetry.ingest.test_photos import gps_exif, jpeg

WEEK, TOW = 2264, 400_373.5
UTC_S = 315_964_800 + WEEK * 604_800 + TOW - 18
STEPS = np.cumsum([0.0, 2.1, 1.9, 2.0, 6.3, 2.2, 2.0, 1.8, 7.1, 2.0, 2.1, 1.9])


def write_mrk(path):
    rows = [
        f"{i + 1}\t{TOW + t:.6f}\t[{WEEK}]\t  -40,N\t   0,E\t  86,V\t{47.5 + t * 1e-5:.8f},Lat\t8.25000000,Lon\t"
        "359.494,Ellh\t0.011, 0.012, 0.025\t50,Q"
        for i, t in enumerate(STEPS)
    ]
    path.write_text("\n".join(rows) + "\n")


def write_pos(path):
    columns = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    lines = ["% program   : RTKPOST", f"%  GPST    {columns}"]
    for t in STEPS:
        moment = datetime.fromtimestamp(UTC_S + 18 + t, UTC)
        stamp = moment.strftime("%Y/%m/%d %H:%M:%S.%f")[:-3]
        lines.append(f"{stamp}   {47.5 + t * 1e-5:.9f}    8.250000000   359.4940   1  12   0.0110   0.0120   0.0250")
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("name", "write"), [("flight_Timestamp.MRK", write_mrk), ("flight_events.pos", write_pos)])
def test_photos_get_the_positions_of_their_exposures(tmp_path, name, write):
    write(tmp_path / name)
    (log,) = read_log(tmp_path / name)
    assert [event.time_s - UTC_S for event in log.events] == pytest.approx(STEPS, abs=2e-3)
    assert log.events[0].sample.sigma_m == 0.012
    for i, t in enumerate(STEPS):
        local = datetime.fromtimestamp(UTC_S + 7200 + t, UTC)
        stamp, fraction = local.strftime("%Y:%m:%d %H:%M:%S"), f"{local.microsecond // 10_000:02d}"
        jpeg(tmp_path / f"DJI_{i + 1:04d}.JPG", exif_bytes=gps_exif(0.0, 0.0, local=stamp, subsec=fraction))
    frames = load([tmp_path]).frames
    assert len(frames) == len(STEPS)
    for frame, t in zip(frames, STEPS, strict=True):
        assert frame.fix.lat_deg == pytest.approx(47.5 + t * 1e-5, abs=1e-8)
        assert frame.fix.position_sigma_m == 0.012
        assert name in frame.origin["position"]


LATITUDE_LONGITUDE = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"


def solution(path, rows, *, columns=LATITUDE_LONGITUDE, scale="GPST", ahead_s=18.0):
    """A solution of RTKLIB; rows are UTC seconds and the words of a position."""
    lines = ["% program   : RTKPOST", f"%  {scale}                  {columns}"]
    for t, position in rows:
        moment = datetime.fromtimestamp(round(t + ahead_s, 3), UTC)
        lines.append(
            f"{moment:%Y/%m/%d %H:%M:%S}.{moment.microsecond // 1000:03d}  {position} 1 12 0.01 0.012 0.02 0 0"
        )
    path.write_text("\n".join(lines) + "\n")
    return path


def north_m(t):
    """Metres flown north, to and fro on a line of 300 m at 8 m/s and less."""
    return 150.0 - 150.0 * np.cos((t - UTC_S) * 8.0 / 150.0)


def test_a_receivers_track_is_read_by_the_photos_times_not_as_exposures(tmp_path):
    """Photos taken every 1.6 to 2.6 s, and a solution at 5 Hz with a tenth of its epochs missing."""
    rng = np.random.default_rng(1)
    times = UTC_S + 20.0 + np.cumsum(rng.uniform(1.6, 2.6, 60))
    epochs = [t for t in np.round(UTC_S + np.arange(0.0, 230.0, 0.2), 3) if rng.random() > 0.1]
    rows = [(t, f"{47.5 + north_m(t) / 111195:.9f} 8.250000000 600.0") for t in epochs]
    (log,) = read_log(solution(tmp_path / "receiver.pos", rows))
    assert (log.kind, len(log.events), len(log.samples)) == ("RTKLIB track", 0, len(epochs))
    for i, t in enumerate(times):
        local = datetime.fromtimestamp(round(t + 7200, 2), UTC)
        stamp, fraction = local.strftime("%Y:%m:%d %H:%M:%S"), f"{local.microsecond // 10_000:02d}"
        jpeg(tmp_path / f"{i:03d}.jpg", exif_bytes=gps_exif(0.0, 0.0, local=stamp, subsec=fraction))
    frames = load([tmp_path]).frames
    assert len(frames) == len(times)
    for frame, t in zip(frames, times, strict=True):
        assert (frame.fix.lat_deg - 47.5) * 111195 == pytest.approx(north_m(t), abs=0.3)
        assert frame.fix.position_sigma_m is None


@pytest.mark.parametrize(
    ("name", "step_s", "jitter_s"),
    [
        ("flight_events.pos", 1.0, 0.0),
        ("flight_event.pos", 1.0, 0.0),
        ("Flight_Events_fixed.pos", 1.0, 0.0),
        ("flight.pos", 2.0, 0.0),
        ("flight.pos", 2.0, 0.03),
    ],
)
def test_a_camera_that_takes_pictures_at_an_interval_makes_no_track(tmp_path, name, step_s, jitter_s):
    times = UTC_S + step_s * np.arange(40) + jitter_s * np.random.default_rng(2).standard_normal(40)
    (log,) = read_log(solution(tmp_path / name, [(t, "47.5 8.25 600.0") for t in times]))
    assert (len(log.events), log.samples) == (40, [])


@pytest.mark.parametrize(
    ("scale", "ahead_s", "columns", "position"),
    [
        ("GPST", 18.0, LATITUDE_LONGITUDE, "-0.512345678 -70.251234567 612.500"),
        ("UTC", 0.0, LATITUDE_LONGITUDE.replace("  ", " ").replace(" ", ","), "-0.512345678,-70.251234567,612.500,"),
        ("JST", 32400.0, LATITUDE_LONGITUDE, "-0.512345678 -70.251234567 612.500"),
        (
            "GPST",
            18.0,
            "latitude(d'\") longitude(d'\")  height(m) Q ns",
            "  -0 30 44.44444  -70 15  4.44444   612.5000",
        ),
        ("GPST", 18.0, "x-ecef(m) y-ecef(m) z-ecef(m) Q ns", "2155271.1406 -6003334.0610 -56656.9895"),
    ],
)
def test_a_solution_is_read_by_its_header(tmp_path, scale, ahead_s, columns, position):
    path = solution(tmp_path / "a_events.pos", [(UTC_S, position)], columns=columns, scale=scale, ahead_s=ahead_s)
    (event,) = read_log(path)[0].events
    assert event.time_s == pytest.approx(UTC_S, abs=1e-3)
    assert (event.sample.lat_deg, event.sample.lon_deg) == pytest.approx((-0.512345678, -70.251234567), abs=2e-9)
    assert event.sample.altitude_m == pytest.approx(612.5, abs=1e-3)
    assert event.sample.sigma_m == (0.02 if "ecef" in columns else 0.012)


def test_a_solution_with_weeks_and_seconds_of_week_is_read(tmp_path):
    (tmp_path / "a.pos").write_text(f"%  GPST  {LATITUDE_LONGITUDE}\n{WEEK} {TOW:.3f} 47.5 8.25 600.0 5 9 1 1 2\n")
    (event,) = read_log(tmp_path / "a.pos")[0].events
    assert event.time_s == UTC_S


def test_a_solution_relative_to_a_base_station_is_named(tmp_path):
    columns = "e-baseline(m)  n-baseline(m)  u-baseline(m) Q ns sde(m) sdn(m) sdu(m)"
    with pytest.raises(NotALog, match="base station"):
        read_log(solution(tmp_path / "a.pos", [(UTC_S, "12.1234 -45.1234 80.5")], columns=columns))


def test_a_list_without_exposures_is_named(tmp_path):
    (tmp_path / "a.pos").write_text("% program : RTKPOST\n")
    with pytest.raises(NotALog, match="no exposure"):
        read_log(tmp_path / "a.pos")


def test_heic_pictures_are_named(tmp_path):
    (tmp_path / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    (rejection,) = survey([tmp_path]).rejected
    assert "convert them to JPEG" in rejection.reason
