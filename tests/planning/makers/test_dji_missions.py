"""Missions for DJI's Pilot 2: after DJI's documents, by a second reader, and read again by this program."""

import io
import json
import math
import warnings
import zipfile
from dataclasses import replace
from xml.etree import ElementTree

import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs_plugin.cli.main import main
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.makers.maker_files import DJI_DRONES, MAKERS, maker_file, read_mission_file
from gcs_plugin.mission.mission_builder import read_mission
from gcs_plugin.mission.mission_files import (
    DO_CHANGE_SPEED,
    DO_MOUNT_CONTROL,
    DO_SET_CAM_TRIGG_DIST,
    FRAME_TERRAIN,
    NAV_LOITER_TIME,
    NAV_TAKEOFF,
    NAV_WAYPOINT,
    FileItem,
    parse_mission,
    sortie_items,
)
from orthoswarm.model.earth import distance_m
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import Sortie, VehiclePlan, Waypoint
from tests.kit.plan_checks import on_globe, to_metres, write_geojson
from tests.planning.test_plan_files import small_plan

with warnings.catch_warnings():  # of the reader's own code, about what a later pydantic does
    warnings.simplefilter("ignore")
    from djikmz.model.action_group import ActionGroup
    from djikmz.model.mission_config import MissionConfig
    from djikmz.model.waypoint import Waypoint as DjiWaypoint

STOP, PASS = "toPointAndStopWithDiscontinuityCurvature", "coordinateTurn"
SQUARE = [(0, 0), (600, 0), (600, 400), (0, 400)]
HOLE = [(250, 150), (350, 150), (350, 250), (250, 250)]
FLAGS = ("--altitude", "60", "--fov-min", "60", "--start", "47.8525,9.001")


def number(low, high=math.inf):
    return lambda text: low <= float(text) <= high


def word(*words):
    return lambda text: text in words


FREE, FLAG, COUNT = (lambda text: True), word("0", "1"), number(0, 65535)
HEADING = {"waypointHeadingMode": word("followWayline"), "waypointHeadingPathMode": word("followBadArc")}
TURN = {"waypointTurnMode": word(STOP, PASS), "waypointTurnDampingDist?": number(0.01)}
PLACE = {
    "coordinates": lambda text: all(abs(float(v)) <= m for v, m in zip(text.split(","), (180.0, 90.0), strict=True))
}
GIMBAL = {
    **{f"gimbal{axis}Rotate{what}": FLAG if what == "Enable" else number(-180, 180)
       for axis in ("Pitch", "Roll", "Yaw") for what in ("Enable", "Angle")},
    "payloadPositionIndex": word("0"), "gimbalHeadingYawBase": word("north"), "gimbalRotateMode": word("absoluteAngle"),
    "gimbalRotateTimeEnable": FLAG, "gimbalRotateTime": number(0),
}  # fmt: skip
PHOTO = {
    "payloadPositionIndex": word("0"), "fileSuffix": FREE, "useGlobalPayloadLensIndex": FLAG,
    "payloadLensIndex?": word("wide", "zoom", "ir", "narrow_band", "visable"),
}  # fmt: skip
DOES = {"takePhoto": PHOTO, "gimbalRotate": GIMBAL, "hover": {"hoverTime": number(0.001)}}
GROUP = {
    "actionGroupId": COUNT, "actionGroupStartIndex": COUNT, "actionGroupEndIndex": COUNT,
    "actionGroupMode": word("sequence"),
    "actionTrigger": {
        "actionTriggerType": word("reachPoint", "multipleDistance"), "actionTriggerParam?": number(0.01),
    },
    "action*": {"actionId": COUNT, "actionActuatorFunc": word(*DOES), "actionActuatorFuncParam": "DOES"},
}  # fmt: skip
CONFIG = {
    "flyToWaylineMode": word("safely", "pointToPoint"), "finishAction": word("goHome", "noAction", "autoLand"),
    "exitOnRCLost": word("goContinue", "executeLostAction"), "executeRCLostAction": word("goBack", "landing", "hover"),
    "takeOffSecurityHeight": number(1.2, 1500), "globalTransitionalSpeed": number(0.01, 15),
    "droneInfo": {"droneEnumValue": COUNT, "droneSubEnumValue": COUNT},
    "payloadInfo": {"payloadEnumValue": COUNT, "payloadPositionIndex": word("0", "1", "2")},
}  # fmt: skip
TEMPLATE = {
    "missionConfig": CONFIG,
    "Folder": {
        "templateType": word("waypoint"), "templateId": COUNT, "autoFlightSpeed": number(0.01, 15),
        "waylineCoordinateSysParam": {"coordinateMode": word("WGS84"), "heightMode": word("relativeToStartPoint")},
        "gimbalPitchMode": word("manual", "usePointSetting"), "globalWaypointHeadingParam": HEADING,
        "globalWaypointTurnMode": word(STOP), "globalUseStraightLine": FLAG, "globalHeight": number(0),
        "payloadParam": {"payloadPositionIndex": word("0"), "imageFormat?": word("wide")},
        "Placemark*": {
            "Point": PLACE, "index": COUNT, "useGlobalHeight": word("0"), "ellipsoidHeight": FREE, "height": number(0),
            "useGlobalSpeed": FLAG, "useGlobalHeadingParam": FLAG, "useGlobalTurnParam": word("0"),
            "waypointTurnParam": TURN, "useStraightLine": FLAG, "actionGroup*": GROUP,
        },
    },
}  # fmt: skip
WAYLINES = {
    "missionConfig": CONFIG | {"globalRTHHeight": number(1)},
    "Folder": {
        "templateId": COUNT, "waylineId": COUNT, "autoFlightSpeed": number(0.01, 15),
        "executeHeightMode": word("WGS84", "relativeToStartPoint"),
        "Placemark*": {
            "Point": PLACE, "index": COUNT, "executeHeight": number(0), "waypointSpeed": number(0.01, 15),
            "waypointHeadingParam": HEADING, "waypointTurnParam": TURN, "useStraightLine": FLAG, "actionGroup*": GROUP,
        },
    },
}  # fmt: skip
"""After the tables of DJI's Cloud API (docs/en/60.api-reference/00.dji-wpml): required, or `?`; `*`: any number of."""


def check(node, schema):
    """Assert that an element holds what a schema asks for, and nothing else."""
    if callable(schema):
        assert not len(node) and schema(node.text or ""), (node.tag, node.text)
        return
    if schema == "DOES":
        raise AssertionError("checked with its action")
    named = {key.rstrip("?*"): (key, value) for key, value in schema.items()}
    tags = [child.tag for child in node]
    assert set(tags) <= named.keys(), set(tags) - named.keys()
    for tag, (key, _) in named.items():
        assert key.endswith("*") or tags.count(tag) == 1 or (key.endswith("?") and tag not in tags), (node.tag, tag)
    for child in node:
        wanted = named[child.tag][1]
        check(child, DOES[node.findtext("actionActuatorFunc")] if wanted == "DOES" else wanted)


def documents(kmz):
    """Both documents of a KMZ, by name, their tags without name spaces; and the name space of WPML."""
    with zipfile.ZipFile(io.BytesIO(kmz)) as archive:
        assert set(archive.namelist()) == {"wpmz/template.kml", "wpmz/waylines.wpml"}
        texts = {name: archive.read(name) for name in archive.namelist()}
    found, spaces = {}, set()
    for name, text in texts.items():
        root = ElementTree.fromstring(text)
        for node in root.iter():
            space, _, node.tag = node.tag.rpartition("}")
            spaces.add(space.strip("{"))
        found[name.partition("/")[2]] = root.find("Document")
    (wpml,) = spaces - {"http://www.opengis.net/kml/2.2"}
    return found, wpml


def as_dict(node):
    """An element as xmltodict gives it to djikmz."""
    plain = ("Point", "coordinates")
    if not len(node):
        return node.text
    return {(c.tag if c.tag in plain else f"wpml:{c.tag}"): as_dict(c) for c in node if c.tag != "actionGroup"}


def flown(end="rtl", pitch_deg=-90.0, **values):
    plan = replace(small_plan(end), gimbal_pitch_deg=pitch_deg, **values)
    return sortie_items(plan, plan.vehicles[0].sorties[0], "ardupilot")


def path(items):
    """Places and heights of a mission in order, points in one place once; pictures and waits at each."""
    found, every_m = [], 0.0
    for item in items:
        if item.command in (NAV_TAKEOFF, NAV_WAYPOINT, NAV_LOITER_TIME):
            here = [item.lat_deg, item.lon_deg, item.alt_m, every_m, 0.0]
            if found and distance_m(*found[-1][:2], *here[:2]) < 0.005 and abs(found[-1][2] - here[2]) < 0.005:
                here = found.pop()
            found.append(here)
            here[4] = item.params[0] if item.command == NAV_LOITER_TIME else here[4]
        elif item.command == DO_SET_CAM_TRIGG_DIST:
            every_m = found[-1][3] = item.params[0]
    return found


def assert_same_route(items, read):
    one, other = path(items), path(read)
    for a, b in zip(one, other, strict=True):
        assert distance_m(*a[:2], *b[:2]) < 0.01 and abs(a[2] - b[2]) < 0.05
        assert a[3:] == pytest.approx(b[3:], abs=0.002)
    for command in (DO_CHANGE_SPEED, DO_MOUNT_CONTROL):
        a, b = ([i.params[:2] for i in rows if i.command == command] for rows in (items, read))
        assert [pytest.approx(p) for p in a] == b


@pytest.mark.parametrize("drone", DJI_DRONES)
@pytest.mark.parametrize("end", ["rtl", "land", "hover"])
def test_both_files_are_as_dji_documents_them(drone, end):
    waits = [
        replace(w, wait_s=30.0) if k == 4 else w for k, w in enumerate(small_plan().vehicles[0].sorties[0].waypoints)
    ]
    sortie = replace(small_plan().vehicles[0].sorties[0], waypoints=tuple(waits))
    found, space = documents(maker_file(flown(end, vehicles=(VehiclePlan(1, (sortie,)),)), drone))
    check(found["template.kml"], TEMPLATE)
    check(found["waylines.wpml"], WAYLINES)
    assert space == f"http://www.dji.com/wpmz/{'1.0.6' if drone.startswith('m4') else '1.0.2'}"
    for document in found.values():
        marks = document.findall("Folder/Placemark")
        assert [int(mark.findtext("index")) for mark in marks] == list(range(len(marks)))
        ids = [int(group.findtext("actionGroupId")) for group in document.iter("actionGroup")]
        assert ids == list(range(len(ids)))
        assert document.findtext(".//finishAction") == {"rtl": "goHome", "land": "autoLand", "hover": "noAction"}[end]


@pytest.mark.parametrize("drone", sorted(DJI_DRONES.keys() - {"m4e", "m4t"}))  # which the reader does not know
def test_a_second_reader_finds_the_drone_the_places_and_what_is_done(drone):
    items = flown()
    document = documents(maker_file(items, drone))[0]["waylines.wpml"]
    config = MissionConfig.from_dict(as_dict(document.find("missionConfig")))
    assert config.drone_info.drone_model.value.lower() == drone.partition("-")[0]
    assert int(config.payload_info.payload_model) == DJI_DRONES[drone].camera
    assert config.take_off_height == 65.0 and config.finish_action.value == "goHome"
    points = [DjiWaypoint.from_dict(as_dict(mark)) for mark in document.iter("Placemark")]
    route = path(items)
    assert [(p.latitude, p.longitude) for p in points] == [pytest.approx(r[:2], abs=1e-8) for r in route]
    assert [p.waypoint_id for p in points] == list(range(len(points))) and {p.speed for p in points} == {8.0}
    assert {str(p.turn_param.waypoint_turn_mode) for p in points} == {STOP}  # it has no point amid a line
    groups = [ActionGroup.from_dict({**as_dict(g)}) for g in document.iter("actionGroup")]
    shots = [(g.start_waypoint_id, g.end_waypoint_id, g.trigger.param) for g in groups if g.trigger.param]
    assert shots == [(2, 3, 10.0), (4, 5, 10.0)]
    turns = [g.actions[0] for g in groups if not g.trigger.param]
    assert [a.gimbal_pitch_rotate_angle for a in turns] == [-90.0, -90.0]


def test_a_route_begins_above_its_takeoff_and_comes_home_above_all_ground():
    document = documents(maker_file(flown(), "m300", return_height_m=83.4))[0]["waylines.wpml"]
    first = document.find("Folder/Placemark")
    assert first.findtext("Point/coordinates") == "9.000000000,47.000000000"
    assert float(first.findtext("executeHeight")) == float(document.findtext(".//takeOffSecurityHeight")) == 65.0
    assert document.findtext(".//globalRTHHeight") == "84"
    alone = documents(maker_file(flown(), "m300"))[0]["waylines.wpml"]
    assert alone.findtext(".//globalRTHHeight") == "65"


def test_points_amid_a_line_are_passed_and_corners_are_stops():
    up = Waypoint(lat_deg=47.0015, lon_deg=9.001, height_m=70.0, above_ground_m=60.0, between=True)
    sortie = small_plan().vehicles[0].sorties[0]
    sortie = replace(sortie, waypoints=(*sortie.waypoints[:2], up, *sortie.waypoints[2:]))
    items = flown(vehicles=(VehiclePlan(1, (sortie,)),))
    marks = documents(maker_file(items, "m30"))[0]["waylines.wpml"].findall("Folder/Placemark")
    turns = [mark.findtext("waypointTurnParam/waypointTurnMode") for mark in marks]
    assert turns == [PASS if k == 3 else STOP for k in range(len(marks))]
    assert marks[3].findtext("executeHeight") == "70"
    assert float(marks[3].findtext("waypointTurnParam/waypointTurnDampingDist")) == 1.0
    assert_same_route(items, read_mission_file(maker_file(items, "m30")).items)


steps = st.tuples(st.floats(-300, 300), st.floats(-300, 300), st.floats(20, 120)).filter(
    lambda s: math.hypot(*s[:2]) > 2
)


@settings(deadline=None, max_examples=60)
@given(
    steps=st.lists(steps, min_size=3, max_size=20),
    home=st.tuples(st.floats(-70, 70), st.floats(-179.9, 179.9)),
    legs=st.sets(st.integers(0, 9)),
    wait_s=st.sampled_from([0.0, 45.0]),
    end=st.sampled_from(["rtl", "land", "hover"]),
    pitch_deg=st.sampled_from([None, -90.0, -60.5]),
    drone=st.sampled_from(sorted(MAKERS)),
    dialect=st.sampled_from(["ardupilot", "px4"]),
    starts_there=st.booleans(),
)
def test_a_mission_that_is_written_is_read_as_the_same_route(
    steps, home, legs, wait_s, end, pitch_deg, drone, dialect, starts_there
):
    points, (lat, lon) = [], home
    for k, (east, north, height_m) in enumerate(steps):
        lat, lon = lat + north / 111_000.0, lon + east / 111_000.0 / math.cos(math.radians(lat))
        lon = (lon + 180.0) % 360.0 - 180.0
        camera = (k % 2 == 0) if k // 2 in legs and 2 * (k // 2) + 1 < len(steps) else None
        points.append(Waypoint(lat_deg=lat, lon_deg=lon, height_m=height_m, camera=camera))
    points[-1] = replace(points[-1], wait_s=wait_s)
    climb_m = points[0].height_m if starts_there else 40.0
    home = (points[0].lat_deg, points[0].lon_deg) if starts_there else home
    sortie = Sortie(
        home_lat_deg=home[0], home_lon_deg=home[1], takeoff_height_m=climb_m, waypoints=tuple(points), start_s=0.0,
        time_s=0.0, length_m=0.0, turns=0, photos=0,
    )  # fmt: skip
    plan = replace(small_plan(end), gimbal_pitch_deg=pitch_deg, vehicles=(VehiclePlan(1, (sortie,)),))
    written = sortie_items(plan, sortie, dialect)
    read = read_mission_file(maker_file(written, drone))
    wanted = sortie_items(plan, sortie, "ardupilot")
    if drone == "litchi":
        assert read.items[-1].command == NAV_WAYPOINT  # the file does not say how the flight ends
    else:
        assert [i.command for i in read.items][-1] == wanted[-1].command
    assert_same_route(wanted, read.items)


def test_a_mission_of_a_makers_app_can_be_uploaded_and_followed(tmp_path):
    (tmp_path / "v1.kmz").write_bytes(maker_file(flown(), "m3e"))
    mission = read_mission(tmp_path / "v1.kmz", Autopilot.PX4)
    assert [item.command for item in mission.items][:4] == [NAV_TAKEOFF, DO_CHANGE_SPEED, 1001, 1000]
    out = tmp_path / "out"
    args = [
        "plan",
        str(tmp_path / "v1.kmz"),
        "--vehicles",
        "1",
        "--altitude",
        "60",
        "--fov-min",
        "60",
        "--out",
        str(out),
    ]
    assert main(args) == 0
    legs = [f for f in json.loads((out / "all.geojson").read_text())["features"] if f["properties"]["kind"] == "leg"]
    assert len(legs) == 2


def test_dji_drones_stand_in_the_plan_with_files_times_and_zones(tmp_path, capsys):
    area = write_geojson(tmp_path / "area.geojson", on_globe(SQUARE, [HOLE]))
    out = tmp_path / "out"
    (tmp_path / "out").mkdir()
    (out / "area.kmz").write_bytes(b"somebody's own")
    fleet = ["--autopilot", "m3e", "--autopilot", "ardupilot", "--autopilot", "litchi", "--vehicles", "3"]
    assert main(["plan", str(area), *fleet, *FLAGS, "--endurance", "14", "--json", "--out", str(out)]) == 0
    figures = json.loads(capsys.readouterr().out)
    files = {name for row in figures["vehicles"] for flight in row["flights"] for name in flight["files"]}
    assert {p.name for p in out.iterdir()} == {*files, "area.kmz", "all.geojson", "plan.json", "plan.png"}
    assert [row["autopilot"] for row in figures["vehicles"]] == ["m3e", "ardupilot", "litchi"]
    assert any("v1, v3" in text and "by hand" in text for text in figures["warnings"])
    assert "30 s off schedule" in figures["separation"]
    zone = shapely.Polygon(HOLE)
    for row, suffix in zip(figures["vehicles"], (".kmz", None, ".csv"), strict=True):
        for flight in row["flights"]:
            names = [name for name in flight["files"] if name.endswith((".kmz", ".csv"))]
            assert [name[-4:] for name in names] == ([suffix] if suffix else []) and flight["start_s"] >= 0.0
            for name in names:
                items = read_mission_file((out / name).read_bytes()).items
                assert_same_route(parse_mission((out / name).with_suffix(".waypoints").read_text()).items, items)
                line = shapely.LineString(to_metres([p[:2] for p in path(items)]))
                assert line.intersection(zone).length == 0.0
    assert main(["plan", str(area), "--dji", "--vehicles", "1", *FLAGS, "--out", str(out)]) == 0
    missions = {p.name for p in out.iterdir()} - {"all.geojson", "plan.json", "plan.png"}
    assert missions == {"area.kmz", "v1.kmz", "v1.plan", "v1.waypoints"}  # of the earlier plan none is left


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"frame": FRAME_TERRAIN}, "--terrain-items"),
        ({"command": 82}, "command 82"),
    ],
)
def test_what_a_dji_mission_cannot_say_is_refused(change, why):
    items = [replace(item, **change) if item.command == NAV_WAYPOINT else item for item in flown()]
    with pytest.raises(InputError, match=why):
        maker_file(items, "m300")


def test_a_speed_that_no_dji_mission_has_is_refused():
    with pytest.raises(InputError, match="15 m/s, not 20"):
        maker_file(flown(speed_m_s=20.0), "m300")
    with pytest.raises(InputError, match="fewer than two"):
        maker_file([FileItem(command=DO_CHANGE_SPEED, params=(1.0, 5.0, 0.0, 0.0))], "m300")


def zipped(**texts):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, text in texts.items():
            archive.writestr(f"wpmz/{name}.wpml", text)
    return data.getvalue()


def edited(old, new):
    with zipfile.ZipFile(io.BytesIO(maker_file(flown(), "m300"))) as archive:
        return zipped(waylines=archive.read("wpmz/waylines.wpml").decode().replace(old, new))


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"PK\x03\x04", "damaged ZIP"),
        (maker_file(flown(), "m300")[:-30], "damaged ZIP"),
        (zipped(other="<kml/>"), "no route"),
        (zipped(waylines="<kml>"), "no valid XML"),
        (zipped(waylines="<kml/>"), "holds 0 routes"),
        (edited("relativeToStartPoint", "WGS84"), "heights of the kind 'WGS84'"),
        (edited("9.000000000,47.000000000", "9.0"), "broken value"),
        (edited("9.000000000,47.000000000", "9.0,97.0"), "nobody can fly"),
        (edited("<wpml:executeHeight>65<", "<wpml:executeHeight>nan<"), "nobody can fly"),
        (edited("<wpml:takeOffSecurityHeight>65<", "<wpml:takeOffSecurityHeight><"), "broken value"),
    ],
)
def test_a_broken_route_is_refused_in_one_sentence(data, why, tmp_path, capsys):
    with pytest.raises(InputError, match=why):
        read_mission_file(data, "m.kmz")
    (tmp_path / "m.kmz").write_bytes(data)
    flags = ["--vehicles", "1", "--altitude", "60", "--fov-min", "60", "--out", str(tmp_path / "out")]
    assert main(["plan", str(tmp_path / "m.kmz"), *flags]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@settings(deadline=None, max_examples=200)
@given(st.binary(max_size=60), st.integers(0, 4000), st.integers(0, 255))
def test_any_bytes_are_read_or_refused(tail, place, value):
    whole = bytearray(maker_file(flown(), "m300"))
    whole[min(place, len(whole) - 1)] = value
    for data in (bytes(whole), b"PK\x03\x04" + tail):
        try:
            read_mission_file(data, "m.kmz")
        except InputError as error:
            assert "\n" not in str(error)
