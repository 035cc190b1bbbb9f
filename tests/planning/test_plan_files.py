import json
import math
from dataclasses import replace

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs_plugin.mission.mission_files import (
    DO_SET_CAM_TRIGG_DIST,
    NAV_LAND,
    NAV_RTL,
    NAV_TAKEOFF,
    NAV_WAYPOINT,
    FileItem,
    parse_mission,
    plan_text,
    sortie_items,
    waypoints_text,
)
from gcs_plugin.plans.plan_files import geojson, mission_files, report
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import Plan, Sortie, VehiclePlan, Waypoint
from orthoswarm.planning.area.area import make_area
from orthoswarm.planning.lines.line_spacing import footprint
from orthoswarm.planning.planner import plan_area
from orthoswarm.planning.sorties.assignment import PlanOptions
from tests.kit.plan_checks import on_globe, to_metres

# After QGroundControl's "Plan file format": what its reader asks for, and nothing it does not know.
NUMBER = {"type": "number"}
POSITION = {"type": "array", "items": NUMBER, "minItems": 3, "maxItems": 3}
ITEM = {
    "type": "object",
    "required": ["type", "autoContinue", "command", "doJumpId", "frame", "params"],
    "properties": {
        "type": {"const": "SimpleItem"},
        "autoContinue": {"type": "boolean"},
        "command": {"type": "integer", "minimum": 16},
        "doJumpId": {"type": "integer", "minimum": 1},
        "frame": {"enum": [0, 2, 3]},
        "params": {"type": "array", "items": {"type": ["number", "null"]}, "minItems": 7, "maxItems": 7},
        "AMSLAltAboveTerrain": {"type": ["number", "null"]},
        "Altitude": NUMBER,
        "AltitudeMode": {"enum": [0, 1, 2, 3, 4]},
    },
    "additionalProperties": False,
}
PLAN = {
    "type": "object",
    "required": ["fileType", "version", "groundStation", "mission", "geoFence", "rallyPoints"],
    "properties": {
        "fileType": {"const": "Plan"},
        "version": {"const": 1},
        "groundStation": {"type": "string"},
        "geoFence": {
            "type": "object",
            "required": ["circles", "polygons", "version"],
            "properties": {"circles": {"type": "array"}, "polygons": {"type": "array"}, "version": {"const": 2}},
        },
        "rallyPoints": {
            "type": "object",
            "required": ["points", "version"],
            "properties": {"points": {"type": "array"}, "version": {"const": 2}},
        },
        "mission": {
            "type": "object",
            "required": [
                *("version", "firmwareType", "vehicleType", "cruiseSpeed", "hoverSpeed", "plannedHomePosition"),
                *("globalPlanAltitudeMode", "items"),
            ],
            "properties": {
                "version": {"const": 2},
                "firmwareType": {"enum": [3, 12]},
                "vehicleType": {"const": 2},
                "cruiseSpeed": NUMBER,
                "hoverSpeed": NUMBER,
                "plannedHomePosition": POSITION,
                "globalPlanAltitudeMode": {"enum": [0, 1, 2, 3, 4]},
                "items": {"type": "array", "items": ITEM, "minItems": 1},
            },
            "additionalProperties": False,
        },
    },
    "additionalProperties": False,
}


def small_plan(end="rtl"):
    points = (
        Waypoint(lat_deg=47.001, lon_deg=9.0, height_m=65.0),
        Waypoint(lat_deg=47.001, lon_deg=9.001, height_m=60.0, camera=True),
        Waypoint(lat_deg=47.002, lon_deg=9.001, height_m=60.0, camera=False),
        Waypoint(lat_deg=47.002, lon_deg=9.002, height_m=60.0, camera=True),
        Waypoint(lat_deg=47.001, lon_deg=9.002, height_m=60.0, camera=False),
        *([] if end == "hover" else [Waypoint(lat_deg=47.0, lon_deg=9.0, height_m=60.0)]),
    )
    sortie = Sortie(
        home_lat_deg=47.0,
        home_lon_deg=9.0,
        takeoff_height_m=65.0,
        waypoints=points,
        start_s=0.0,
        time_s=100.0,
        length_m=500.0,
        turns=4,
        photos=24,
    )
    return Plan(
        method="bcd",
        vehicles=(VehiclePlan(1, (sortie,)),),
        altitude_m=60.0,
        speed_m_s=8.0,
        trigger_m=10.0,
        spacing_m=40.0,
        footprint_m=(70.0, 50.0),
        end=end,
        epsg=32632,
        area_m2=1e4,
        covered_share=1.0,
        gaps=(),
        separation="",
        warnings=(),
    )


@pytest.fixture(scope="module")
def concave():
    shell = [(0, 0), (900, 0), (900, 700), (600, 700), (600, 300), (300, 300), (300, 700), (0, 700)]
    area = make_area([on_globe(shell, [[(700, 350), (820, 380), (800, 520), (690, 480)]])])
    return area, plan_area(area, 3, 60.0, footprint(60.0, math.radians(60.0)))


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
@pytest.mark.parametrize("end", ["rtl", "land", "hover"])
def test_plan_files_fit_the_schema(autopilot, end):
    plan = small_plan(end)
    document = json.loads(mission_files(plan, [autopilot])["v1.plan"])
    jsonschema.validate(document, PLAN)
    mission = document["mission"]
    assert mission["firmwareType"] == {"ardupilot": 3, "px4": 12}[autopilot]
    assert mission["plannedHomePosition"] == [47.0, 9.0, 0.0]
    assert [i["doJumpId"] for i in mission["items"]] == list(range(1, len(mission["items"]) + 1))
    assert mission["items"][0]["command"] == NAV_TAKEOFF
    assert mission["items"][0]["params"][6] == 65.0
    assert mission["items"][-1]["command"] == {"rtl": NAV_RTL, "land": NAV_LAND, "hover": NAV_WAYPOINT}[end]
    for item in mission["items"]:
        if item["command"] in (NAV_WAYPOINT, NAV_TAKEOFF, NAV_LAND):  # yaw 0 turns PX4 north
            assert item["params"][3] == (None if autopilot == "px4" else 0.0)


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_waypoint_file_leaves_the_yaw_to_px4_as_the_plan_does(tmp_path, autopilot):
    from pymavlink import mavwp  # by which MAVProxy reads such files

    plan = small_plan()
    sortie = plan.vehicles[0].sorties[0]
    waits = replace(sortie.waypoints[0], wait_s=30.0)
    plan = replace(plan, vehicles=(VehiclePlan(1, (replace(sortie, waypoints=(waits, *sortie.waypoints[1:])),)),))
    texts = mission_files(plan, [autopilot])
    (tmp_path / "v1.waypoints").write_text(texts["v1.waypoints"])
    loader = mavwp.MAVWPLoader()
    loader.load(str(tmp_path / "v1.waypoints"))
    yaws = [item["params"][3] for item in json.loads(texts["v1.plan"])["mission"]["items"]]
    read = [loader.wp(k).param4 for k in range(1, loader.count())]  # without home
    assert [None if math.isnan(yaw) else yaw for yaw in read] == yaws
    assert (None in yaws) == (autopilot == "px4")


def test_the_trigger_follows_a_legs_first_waypoint_and_stops_at_its_last():
    items = sortie_items(small_plan(), small_plan().vehicles[0].sorties[0], "ardupilot")
    triggers = [(k, i.params) for k, i in enumerate(items) if i.command == DO_SET_CAM_TRIGG_DIST]
    assert [p[0] for _, p in triggers] == [10.0, 0.0, 10.0, 0.0]
    assert [p[2] for _, p in triggers] == [1.0, 0.0, 1.0, 0.0]
    before = [(items[k - 1].lat_deg, items[k - 1].lon_deg) for k, _ in triggers]
    assert before == [(47.001, 9.001), (47.002, 9.001), (47.002, 9.002), (47.001, 9.002)]


@pytest.mark.parametrize(
    ("autopilot", "turning"),
    [
        ("ardupilot", [(205, [-60.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0])]),
        ("px4", [(1001, [-2.0, -2.0, -1.0, -1.0, 0.0, 0.0, 0.0]), (1000, [-60.0, 0.0, None, None, 12.0, 0.0, 0.0])]),
    ],
)
def test_a_mission_turns_the_gimbal_before_its_first_waypoint_in_its_autopilots_words(autopilot, turning):
    plain, aimed = small_plan(), replace(small_plan(), gimbal_pitch_deg=-60.0)
    document = json.loads(mission_files(aimed, [autopilot])["v1.plan"])
    jsonschema.validate(document, PLAN)
    items = document["mission"]["items"]
    count = 2 + len(turning)
    assert [(item["command"], item["params"]) for item in items[2:count]] == turning
    assert all(item["frame"] == 2 for item in items[2:count]) and items[count]["command"] == NAV_WAYPOINT
    without = json.loads(mission_files(plain, [autopilot])["v1.plan"])["mission"]["items"]
    rest = [{**item, "doJumpId": 0} for item in items[:2] + items[count:]]
    assert rest == [{**item, "doJumpId": 0} for item in without]


def test_waypoint_files_begin_with_home_and_have_twelve_columns():
    lines = mission_files(small_plan(), ["ardupilot"])["v1.waypoints"].splitlines()
    assert lines[0] == "QGC WPL 110"
    rows = [line.split("\t") for line in lines[1:]]
    assert {len(r) for r in rows} == {12}
    assert [int(r[0]) for r in rows] == list(range(len(rows)))
    assert [int(r[1]) for r in rows] == [1] + [0] * (len(rows) - 1)
    assert rows[0][2:4] == ["0", "16"] and [float(v) for v in rows[0][8:11]] == [47.0, 9.0, 0.0]
    assert int(rows[1][3]) == NAV_TAKEOFF and int(rows[-1][3]) == NAV_RTL


positions = st.tuples(st.floats(-89, 89), st.floats(-179, 179)).filter(lambda p: abs(p[0]) + abs(p[1]) > 0.01)
flown_items = st.builds(
    lambda command, place, height, p1: FileItem(
        command=command, frame=3, params=(p1, 0.0, 0.0, 0.0), lat_deg=place[0], lon_deg=place[1], alt_m=height
    ),
    st.sampled_from([NAV_WAYPOINT, NAV_TAKEOFF, NAV_LAND]),
    positions,
    st.floats(0, 500),
    st.floats(0, 100),
)
do_items = st.builds(
    lambda command, p1: FileItem(command=command, frame=2, params=(p1, 0.0, 1.0, 0.0)),
    st.sampled_from([178, 206]),
    st.floats(0, 99),
)


def same(a, b):
    assert (a.command, a.frame, a.autocontinue) == (b.command, b.frame, b.autocontinue)
    assert a.params == pytest.approx(b.params, rel=1e-6, nan_ok=True)
    assert (a.lat_deg, a.lon_deg) == pytest.approx((b.lat_deg, b.lon_deg), abs=1e-8)
    assert a.alt_m == pytest.approx(b.alt_m, abs=1e-3)


@settings(deadline=None)
@given(st.lists(flown_items | do_items, min_size=1, max_size=12), positions, st.sampled_from(["ardupilot", "px4"]))
def test_what_is_written_is_read_again(items, home, autopilot):
    for text in (plan_text(items, (*home, 5.0), autopilot, 9.0), waypoints_text(items, (*home, 5.0))):
        mission = parse_mission(text)
        assert mission.home == pytest.approx((*home, 5.0), abs=1e-8)
        for a, b in zip(items, mission.items, strict=True):
            same(a, b)


@settings(deadline=None)
@given(st.text(max_size=300), st.sampled_from(["", "QGC WPL 110\n", '{"fileType": "Plan", "mission": ', "{"]))
def test_any_text_is_read_or_refused(text, head):
    try:
        parse_mission(head + text, "m.plan")
    except InputError as error:
        assert "\n" not in str(error).strip()


@pytest.mark.parametrize(
    "text",
    [
        "QGC WPL 100\n",
        "QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t47\t9\t0\n",
        "QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\tx\t47\t9\t0\t1\n",
        "QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t97\t9\t0\t1\n",
        '{"fileType": "GeoFence"}',
        '{"fileType": "Plan", "mission": {"items": [{"type": "SimpleItem", "command": 16, "frame": 3, "params": []}]}}',
        '{"fileType": "Plan", "mission": {"items": [{"command": 1e999, "frame": 3, "params": [0, 0, 0, 0, 0, 0, 0]}]}}',
        "QGC WPL 110\n0\t1\t0\tinf\t0\t0\t0\t0\t47\t9\t0\t1\n",
        '{"fileType": ' + "[" * 100_000,
        "hello",
    ],
)
def test_broken_missions_are_refused(text):
    with pytest.raises(InputError, match=r"m\.plan"):
        parse_mission(text, "m.plan")


def survey_plan():
    survey = {
        "type": "ComplexItem",
        "complexItemType": "survey",
        "version": 5,
        "angle": 0,
        "polygon": [[47.0, 9.0], [47.0, 9.01], [47.005, 9.01], [47.005, 9.0]],
        "TransectStyleComplexItem": {
            "version": 2,
            "Items": [{"type": "SimpleItem", "command": 16, "frame": 3, "params": [0, 0, 0, None, 47.001, 9.001, 50]}],
        },
    }
    circle = {"inclusion": False, "circle": {"center": [47.002, 9.005], "radius": 30}, "version": 1}
    fence = {"inclusion": False, "polygon": [[47.001, 9.001], [47.001, 9.002], [47.002, 9.002]], "version": 1}
    allowed = {"inclusion": True, "polygon": [[46.0, 8.0], [46.0, 10.0], [48.0, 10.0]], "version": 1}
    mission = {"version": 2, "items": [survey], "plannedHomePosition": [47.0, 9.0, 400], "hoverSpeed": 5}
    return {
        "fileType": "Plan",
        "version": 1,
        "mission": mission,
        "geoFence": {"version": 2, "polygons": [fence, allowed], "circles": [circle]},
    }


def test_a_survey_gives_its_outline_and_exclusion_fences():
    mission = parse_mission(json.dumps(survey_plan()))
    assert mission.surveys == (((47.0, 9.0), (47.0, 9.01), (47.005, 9.01), (47.005, 9.0)),)
    assert len(mission.no_fly) == 2 and mission.speed_m_s == 5.0
    centre = to_metres([(47.002, 9.005)])[0]
    radii = [math.dist(p, centre) for p in to_metres(mission.no_fly[1])]
    assert min(radii) >= 30.0 and max(radii) < 31.0


def test_lines_of_a_mission_are_its_triggered_stretches_if_it_has_any():
    plan = small_plan()
    items = sortie_items(plan, plan.vehicles[0].sorties[0], "ardupilot")
    mission = parse_mission(waypoints_text(items, (47.0, 9.0, 0.0)))
    assert mission.lines() == (((47.001, 9.001), (47.002, 9.001)), ((47.002, 9.002), (47.001, 9.002)))
    quiet = [i for i in items if i.command != DO_SET_CAM_TRIGG_DIST]
    (line,) = parse_mission(waypoints_text(quiet, (47.0, 9.0, 0.0))).lines()
    assert len(line) == 6 and line[0] == (47.001, 9.0)


def test_the_geojson_holds_area_zones_legs_and_ways(concave):
    area, plan = concave
    features = json.loads(geojson(plan, area))["features"]
    kinds = {}
    for feature in features:
        kinds.setdefault(feature["properties"]["kind"], []).append(feature["geometry"])
    assert len(kinds["area"]) == 1 and len(kinds["no-fly zone"]) == 1 and len(kinds["start"]) == 3
    assert len(kinds["leg"]) == sum(len(s.legs) for v in plan.vehicles for s in v.sorties)
    assert all(len(leg["coordinates"]) == 2 for leg in kinds["leg"])
    ring = kinds["area"][0]["coordinates"][0]
    assert ring[0] == ring[-1]


def test_the_report_has_the_promised_keys_and_adds_up(concave):
    _, plan = concave
    figures = json.loads(json.dumps(report(plan, ["px4"], 60.0), allow_nan=False))
    assert {"covered_share", "makespan_s", "vehicles"} <= figures.keys()
    for vehicle in figures["vehicles"]:
        assert {"id", "length_m", "turns", "time_s", "sorties", "photos"} <= vehicle.keys()
        assert vehicle["sorties"] == len(vehicle["flights"])
    assert figures["makespan_s"] == max(v["time_s"] for v in figures["vehicles"])
    lengths = [v["length_m"] for v in figures["vehicles"]]
    assert figures["balance"] == pytest.approx(max(lengths) * len(lengths) / sum(lengths), abs=1e-3)


def test_sorties_of_one_vehicle_get_a_file_each():
    area = make_area([on_globe([(0, 0), (900, 0), (900, 700), (0, 700)])])
    plan = plan_area(area, 1, 60.0, footprint(60.0, math.radians(60.0)), options=PlanOptions(endurance_s=900.0))
    names = mission_files(plan, ["ardupilot"])
    count = len(plan.vehicles[0].sorties)
    assert count > 1
    assert set(names) == {f"v1-sortie{k + 1}.{kind}" for k in range(count) for kind in ("plan", "waypoints")}
