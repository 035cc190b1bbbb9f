"""Poses between samples, and the offset between the clocks of a camera and a vehicle."""

import math
from datetime import UTC, datetime
from zoneinfo import ZoneInfo, available_timezones

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.formats.log.flight_logs import read_log
from telemetry.ingest.ingest import LoadOptions, load
from telemetry.ingest.pairing.clock_offset import ZONES_S, offset_by_positions, offset_by_turning, offset_by_zone
from telemetry.samples.sample import Sample
from telemetry.samples.timeline import Timeline

mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")


# --- timeline and clocks ------------------------------------------------------------------------------------------


def test_interpolation_takes_the_short_way_and_leaves_gaps():
    rows = [
        Sample(time_s=0.0, lat_deg=47.0, lon_deg=179.9999, yaw_deg=170.0),
        Sample(time_s=1.0, lat_deg=47.001, lon_deg=-179.9999, yaw_deg=-170.0),
        Sample(time_s=11.0, lat_deg=47.002, lon_deg=-179.9997),
    ]
    timeline = Timeline(rows, max_gap_s=2.0)
    middle = timeline.at(0.5)
    assert middle.lat_deg == pytest.approx(47.0005)
    assert abs(middle.lon_deg) == pytest.approx(180.0)
    assert abs(middle.yaw_deg) == pytest.approx(180.0)
    assert timeline.at(5.0).lat_deg is None
    assert timeline.at(11.0).lat_deg == 47.002
    assert timeline.at(11.5).lat_deg is None
    assert timeline.at(-0.1).lat_deg is None


MICROSECONDS = st.floats(0, 1e6).map(lambda t: round(t, 6))  # no clock is finer


@given(st.lists(st.tuples(MICROSECONDS, st.floats(-80, 80)), min_size=1, max_size=30), st.floats(-10, 1e6 + 10))
@settings(max_examples=100, deadline=None)
def test_interpolated_values_lie_between_their_neighbours(rows, at):
    timeline = Timeline([Sample(time_s=t, lat_deg=v, lon_deg=1.0) for t, v in rows], max_gap_s=1e9)
    value = timeline.at(at).lat_deg
    inside = min(t for t, _ in rows) <= at <= max(t for t, _ in rows)
    assert (value is not None) == inside
    if inside:
        assert min(v for _, v in rows) - 1e-9 <= value <= max(v for _, v in rows) + 1e-9


def test_heights_above_takeoff_and_above_ground_are_not_mixed():
    rows = [Sample(time_s=float(t), height_m=50.0) for t in range(10)]
    rows += [Sample(time_s=t + 0.5, height_m=30.0, height_is_ground=True) for t in range(4)]
    timeline = Timeline(rows)
    assert (timeline.at(2.0).height_m, timeline.at(2.0).height_is_ground) == (30.0, True)
    assert (timeline.at(8.0).height_m, timeline.at(8.0).height_is_ground) == (50.0, False)


@pytest.fixture(scope="module")
def flown(real_data):
    (log,) = read_log(real_data("sitl_logs") / "swarm_v1.tlog")
    return log.timeline()


def test_the_clock_offset_is_found_from_positions_in_any_zone(flown):
    times = np.linspace(flown.span[0] + 70, flown.span[1] - 40, 40)
    places = np.stack([flown.values("lat_deg", times), flown.values("lon_deg", times)], axis=-1)
    offset = offset_by_positions(times - 5 * 3600 + 15.3, places, flown)
    assert offset == pytest.approx(-5 * 3600 + 15.3, abs=0.25)


def test_the_zone_alone_is_found_where_nothing_else_is_known(flown):
    times = np.linspace(flown.span[0] + 70, flown.span[1] - 40, 40)
    assert offset_by_zone(times + 7200, flown) == 7200
    assert offset_by_zone(times + 20700, flown) == 20700
    assert offset_by_zone(times + 86400 * 3, flown) is None


def test_the_zones_are_those_of_all_places_since_2010():
    names = available_timezones()
    if not names:
        pytest.skip("no time zone database")
    days = [datetime(year, month, 15, tzinfo=UTC) for year in range(2010, 2027) for month in (1, 4, 7, 10)]
    offsets = {day.astimezone(ZoneInfo(name)).utcoffset().total_seconds() for name in names for day in days}
    assert offsets <= set(ZONES_S)


def test_no_place_on_earth_explains_a_quarter_of_an_hour(flown):
    """Photos of a flight without a log, a quarter of an hour before the one that has one."""
    times = np.linspace(flown.span[0] + 70, flown.span[1] - 40, 40)
    assert offset_by_zone(times - 900, flown) is None


@pytest.mark.parametrize("offset", [-1.7e9, 15.0, 3600.0])
def test_the_clock_offset_is_found_from_turning(flown, offset):
    times = np.arange(flown.span[0] + 60, flown.span[1] - 30, 0.25)
    yaw = np.unwrap(np.radians(flown.values("flight_yaw_deg", times)))
    rates = np.degrees(np.gradient(yaw, 0.25)) + np.random.default_rng(0).normal(0, 2.0, len(times))
    found = offset_by_turning(times + offset, rates, flown, search_s=200.0)
    assert found is not None
    assert found[0] == pytest.approx(offset, abs=0.3)


def test_a_straight_flight_gives_no_offset():
    rows = [Sample(time_s=float(t), flight_yaw_deg=10.0) for t in range(200)]
    assert offset_by_turning(np.arange(0, 100, 0.25), np.zeros(400), Timeline(rows)) is None


@pytest.mark.slow
def test_a_video_beside_a_log_is_placed_by_how_its_pictures_turn(real_data, tmp_path):
    """Pictures of a textured ground under the logged flight, the video's clock unknown."""
    cv2 = pytest.importorskip("cv2")
    av = pytest.importorskip("av")
    source = real_data("sitl_logs") / "swarm_v1.tlog"
    (log,) = read_log(source)
    timeline = log.timeline()
    rng = np.random.default_rng(0)
    ground = cv2.GaussianBlur(rng.integers(0, 255, (1600, 1600), np.uint8), (0, 0), 2.0)
    ground = cv2.normalize(ground, None, 0, 255, cv2.NORM_MINMAX)
    start = log.events[2].time_s
    times = start + np.arange(0, 100, 0.2)
    lat0, lon0 = timeline.values("lat_deg", times[:1])[0], timeline.values("lon_deg", times[:1])[0]
    with av.open(str(tmp_path / "flight.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=5)
        stream.width, stream.height, stream.pix_fmt = 240, 180, "yuv420p"
        for n, sample in enumerate(timeline.at_all(times)):
            north = (sample.lat_deg - lat0) * 111_195.0
            east = (sample.lon_deg - lon0) * 111_195.0 * math.cos(math.radians(lat0))
            turn = cv2.getRotationMatrix2D((120, 90), sample.flight_yaw_deg, 1.0)  # counter-clockwise as seen
            scale = 2.0  # pixels a metre
            shift = np.array([[1, 0, 120 - 800 - scale * east], [0, 1, 90 - 800 + scale * north], [0, 0, 1.0]])
            picture = cv2.warpAffine(
                ground, (np.vstack([turn, [0, 0, 1]]) @ shift)[:2], (240, 180), borderMode=cv2.BORDER_WRAP
            )
            frame = av.VideoFrame.from_ndarray(picture, format="gray").reformat(format="yuv420p")
            frame.pts = n
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    (tmp_path / "flight.tlog").write_bytes(source.read_bytes())
    result = load([tmp_path], options=LoadOptions(cache=tmp_path / "c", every_s=5.0))
    assert len(result.frames) >= 18
    for frame in result.frames:
        at = start + int(frame.image[-6:]) * 0.2
        assert frame.time_s == pytest.approx(at, abs=0.4)
        assert frame.fix.lat_deg == pytest.approx(float(timeline.values("lat_deg", at)), abs=3e-5)
