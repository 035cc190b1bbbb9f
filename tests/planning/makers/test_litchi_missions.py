"""Missions for Litchi: by a second reader, and what is refused."""

from dataclasses import replace

import pytest
from litchi_wp.enums import ActionType, AltitudeMode, GimbalMode
from litchi_wp.waypoint import Waypoint as LitchiWaypoint

from gcs_plugin.mission.makers.drone_route import DroneRoute, RoutePoint
from gcs_plugin.mission.makers.litchi import litchi_text
from gcs_plugin.mission.makers.maker_files import maker_file, read_mission_file
from gcs_plugin.mission.mission_files import DO_SET_CAM_TRIGG_DIST, NAV_LOITER_TIME, FileItem, sortie_items
from gcs_plugin.plans.area_files import read_shapes
from gcs_plugin.plans.plan_request import PlanRequest, make_plan
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import VehiclePlan
from tests.kit.plan_checks import on_globe, write_geojson
from tests.planning.test_plan_files import small_plan


def flown():
    plan = replace(small_plan("hover"), gimbal_pitch_deg=-90.0)
    sortie = plan.vehicles[0].sorties[0]
    last = replace(sortie.waypoints[-1], wait_s=12.5)
    sortie = replace(sortie, waypoints=(*sortie.waypoints[:-1], last))
    return sortie_items(replace(plan, vehicles=(VehiclePlan(1, (sortie,)),)), sortie, "ardupilot")


def test_a_second_reader_finds_each_row():
    header, *lines = maker_file(flown(), "litchi").decode().splitlines()
    assert header == LitchiWaypoint.get_header(line_break=None)
    points = [LitchiWaypoint.from_line(line) for line in lines]
    assert [(p.lat, p.lon) for p in points[:3]] == [(47.0, 9.0), (47.001, 9.0), (47.001, 9.001)]
    assert [p.altitude.value for p in points] == [65.0, 65.0, 60.0, 60.0, 60.0, 60.0]
    assert {p.altitude.mode for p in points} == {AltitudeMode.MSL}  # 0: above takeoff
    assert [p.heading for p in points] == pytest.approx([0.0, 90.0, 0.0, 90.0, 180.0, 180.0], abs=0.02)
    assert {(p.gimbal.mode, p.gimbal.pitchangle) for p in points} == {(GimbalMode.INTERPOLATE, -90.0)}
    assert {p.speed for p in points} == {8.0} and {p.curvesize for p in points} == {0.0}
    assert [p.photo.distance_interval for p in points] == [-1.0, -1.0, 10.0, -1.0, 10.0, -1.0]
    assert {p.photo.time_interval for p in points} == {-1.0} and {(p.poi.lat, p.poi.lon) for p in points} == {
        (0.0, 0.0)
    }
    assert [points[-1].actions[0].type, points[-1].actions[0].param] == [ActionType.STAY_FOR, 12_500.0]
    assert {a.type for p in points[:-1] for a in p.actions} == {ActionType.NO_ACTION}


def test_a_mission_of_litchis_gives_lines_to_follow_and_items(tmp_path):
    path = tmp_path / "m.csv"
    path.write_bytes(maker_file(flown(), "litchi"))
    lines = read_shapes(path).shapes.lines
    assert [line.tolist() for line in lines] == [[[47.001, 9.001], [47.002, 9.001]], [[47.002, 9.002], [47.001, 9.002]]]
    (wait,) = [i for i in read_mission_file(path.read_bytes()).items if i.command == NAV_LOITER_TIME]
    assert wait.params[0] == 12.5
    timed = path.read_text().replace(",-1,10.000", ",2.5,-1")
    triggers = [i.params[0] for i in read_mission_file(timed.encode()).items if i.command == DO_SET_CAM_TRIGG_DIST]
    assert triggers == [20.0, 0.0, 20.0, 0.0]  # a picture each 2.5 s at 8 m/s


def test_no_two_waypoints_are_two_kilometres_apart():
    far = [RoutePoint(60.0, 10.0, 60.0, every_m=5.0), RoutePoint(60.0, 10.1, 90.0, wait_s=3.0)]  # 5.6 km
    route = DroneRoute(points=tuple(far), speed_m_s=8.0, climb_m=60.0, pitch_deg=None, end="hover")
    points = [LitchiWaypoint.from_line(line) for line in litchi_text(route).splitlines()[1:]]
    assert [p.lon for p in points] == pytest.approx([10.0, 10.0 + 0.1 / 3, 10.0 + 0.2 / 3, 10.1])
    assert [p.altitude.value for p in points] == pytest.approx([60.0, 70.0, 80.0, 90.0])
    assert [p.photo.distance_interval for p in points] == [5.0, 5.0, 5.0, -1.0]
    assert [p.actions[0].type for p in points] == [ActionType.NO_ACTION] * 3 + [ActionType.STAY_FOR]


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("altitude(m)", "altitude(ft)", "in feet"),
        (",0,8,0,0,0,0,", ",1,8,0,0,0,0,", "Above Ground"),
        ("47.001000000,", ",", "without its numbers"),
        ("47.001000000,", "100,", "nobody can fly"),
        ("65.000", "inf", "nobody can fly"),
    ],
)
def test_a_file_that_cannot_be_flown_is_refused(old, new, why):
    text = maker_file(flown(), "litchi").decode()
    assert old in text
    with pytest.raises(InputError, match=why):
        read_mission_file(text.replace(old, new).encode(), "m.csv")
    with pytest.raises(InputError, match="no waypoints"):
        read_mission_file(text.splitlines()[0].encode(), "m.csv")


def test_flights_for_litchi_have_at_most_as_many_waypoints_as_it_takes(tmp_path):
    area = write_geojson(tmp_path / "area.geojson", on_globe([(0, 0), (1500, 0), (1500, 300), (0, 300)]))
    request = PlanRequest(area=area, vehicles=1, altitude_m=30.0, fov_min_deg=50.0, autopilots=["litchi"])
    plan, _ = make_plan(request)
    sorties = plan.vehicles[0].sorties
    assert len(sorties) > 1
    for sortie in sorties:
        rows = maker_file(sortie_items(plan, sortie, "ardupilot"), "litchi").decode().splitlines()
        assert len(rows) <= 1 + 99
    places = [replace(flown()[3], lat_deg=47.0 + 0.001 * k) for k in range(120)]
    speed = FileItem(command=178, params=(1.0, 5.0, -1.0, 0.0))
    with pytest.raises(InputError, match="takes 99 waypoints, not 120"):
        maker_file([speed, *places], "litchi")
