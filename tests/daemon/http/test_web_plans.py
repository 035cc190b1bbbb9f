"""Plans as the page asks for them: for the autopilots that are on the links."""

import io
import json
import zipfile

import pytest

from gcs_plugin.daemon import web_plans
from gcs_plugin.daemon.web_plans import Plans
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.items import MOUNT_CONTROL, WAYPOINT
from gcs_plugin.mission.makers.maker_files import read_mission_file
from orthoswarm.model.errors import InputError
from tests.daemon.on_links import OnLinks
from tests.kit.plan_checks import on_globe

SQUARE = on_globe([(0, 0), (200, 0), (200, 200), (0, 200)])
AREA = {"type": "Polygon", "coordinates": [[[lon, lat] for lat, lon in [*SQUARE.shell, SQUARE.shell[0]]]]}
BODY = {"area": AREA, "vehicles": 2, "altitude_m": 60, "fov_min_deg": 60}


class Here:
    """A pool of workers that is this process."""

    def __init__(self, count):
        self.count = count

    def run(self, function, item):
        return function(item)

    def close(self):
        pass


@pytest.fixture(autouse=True)
def _in_this_process(request, monkeypatch):
    """One test plans in a process of its own, as the daemon does; the others need none."""
    if "request_names_others" not in request.node.name:
        monkeypatch.setattr(web_plans, "WorkerPool", Here)


@pytest.mark.parametrize(
    ("asked", "made"),
    [
        ({}, ["ardupilot", "px4"]),
        ({"autopilot": "px4"}, ["px4", "px4"]),
        ({"autopilot": ["px4", "ardupilot"]}, ["px4", "ardupilot"]),
    ],
)
def test_a_plan_is_made_for_the_autopilots_on_the_links_unless_the_request_names_others(asked, made, tmp_path):
    plans = Plans(tmp_path, None, OnLinks(kinds={"v2": "px4", "v7": "px4"}))
    figures = plans.make(BODY | asked)
    assert [vehicle["autopilot"] for vehicle in figures["vehicles"]] == made
    assert figures["warnings"] == []


def test_a_request_leaves_the_gimbal_alone_and_gives_lines_a_direction(tmp_path):
    plans = Plans(tmp_path, None, OnLinks(kinds={}))
    photos = {}
    for asked in ({}, {"heading": 90, "cross": True}, {"heading": "longest", "gimbal_pitch_deg": None}):
        made = plans.make(BODY | asked)
        photos[made["id"]] = sum(vehicle["photos"] for vehicle in made["vehicles"])
        assert made["gimbal_pitch_deg"] == asked.get("gimbal_pitch_deg", -90.0)
        mission = plans.mission({"plan": made["id"]}, "v1", Autopilot.ARDUPILOT)
        assert (MOUNT_CONTROL in [item.command for item in mission.items]) == ("gimbal_pitch_deg" not in asked)
    first, crossed, _ = photos.values()
    assert crossed > 1.8 * first
    for wrong in ("up", 10**400, True, [30]):
        with pytest.raises(InputError, match="heading is no number, wind or longest"):
            plans.make(BODY | {"heading": wrong})


@pytest.mark.parametrize("drone", ["m300", "litchi"])
def test_a_plan_is_had_as_files_for_a_makers_app_with_its_takeoff_times(tmp_path, drone):
    plans = Plans(tmp_path, None, OnLinks(places={"v1": SQUARE.shell[0], "v2": SQUARE.shell[0]}))
    made = plans.make(BODY | {"autopilot": ["ardupilot", "px4"]})
    with zipfile.ZipFile(io.BytesIO(plans.maker_files(made["id"], drone))) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    head, *rows = files.pop("takeoffs.csv").decode().splitlines()
    assert head == "file,takeoff_s,time_s" and [row.split(",")[0] for row in rows] == list(files)
    assert [float(row.split(",")[1]) for row in rows] == [v["flights"][0]["start_s"] for v in made["vehicles"]]
    for vehicle, data in zip(("v1", "v2"), files.values(), strict=True):
        flown = [(i.lat_deg, i.lon_deg) for i in read_mission_file(data).items if i.command == WAYPOINT]
        sent = plans.mission({"plan": made["id"]}, vehicle, Autopilot.PX4).items
        wanted = [(i.lat_deg, i.lon_deg) for i in sent if i.command == WAYPOINT]
        assert flown[: len(wanted)] == [pytest.approx(place, abs=1e-7) for place in wanted]
    for name, kind in (("plan-1", drone), (made["id"], "m5")):
        with pytest.raises(InputError, match=r"no such plan|none of m300"):
            plans.maker_files(name, kind)


def test_a_request_may_name_drones_of_a_makers_app(tmp_path):
    plans = Plans(tmp_path, None, OnLinks(kinds={}))
    made = plans.make(BODY | {"autopilot": ["m4e", "ardupilot"]})
    assert [v["autopilot"] for v in made["vehicles"]] == ["m4e", "ardupilot"]
    assert (tmp_path / made["id"] / "v1.kmz").is_file() and not (tmp_path / made["id"] / "v2.kmz").exists()
    assert any("by hand" in text for text in made["warnings"])


STANDING = {"v1": SQUARE.shell[0], "v2": SQUARE.shell[1]}


def test_a_plan_takes_off_where_its_vehicles_stand(tmp_path):
    plans = Plans(tmp_path, None, OnLinks(places=STANDING))
    made = plans.make(BODY)
    assert made["warnings"] == []
    mission = plans.mission({"plan": made["id"]}, "v2", Autopilot.ARDUPILOT)
    assert (mission.items[0].lat_deg, mission.items[0].lon_deg) == pytest.approx(STANDING["v2"], abs=1e-6)


@pytest.mark.parametrize(
    ("standing", "said"),
    [
        ({"v1": "in the air", "v2": "no position yet"}, "(v1: in the air; v2: no position yet)"),
        ({"v1": SQUARE.shell[0]}, "(v2: not on the links)"),
    ],
)
def test_a_plan_says_whose_place_is_not_known_and_that_takeoffs_lie_at_first_lines(standing, said, tmp_path):
    plans = Plans(tmp_path, None, OnLinks(places=standing))
    (warning,) = plans.make(BODY)["warnings"]
    assert said in warning and "where its first line begins" in warning and "plan again" in warning
    assert plans.all()[0]["warnings"] == [warning]  # also for a page that is opened later


@pytest.mark.parametrize("autopilot", ["betaflight", 4, [], ["px4", None]])
def test_other_autopilots_are_refused(autopilot, tmp_path):
    with pytest.raises(InputError, match="ardupilot, px4"):
        Plans(tmp_path, None, OnLinks()).make(BODY | {"autopilot": autopilot})
    assert not list(tmp_path.iterdir())


RING = on_globe([(80, 80), (120, 80), (120, 120), (80, 120)]).shell
ZONE = {"type": "Polygon", "coordinates": [[[lon, lat] for lat, lon in [*RING, RING[0]]]]}


@pytest.mark.parametrize(
    "no_fly",
    [
        ZONE,
        {"type": "MultiPolygon", "coordinates": [ZONE["coordinates"]]},
        {"type": "Feature", "properties": {}, "geometry": ZONE},
        {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": ZONE}]},
        {"type": "GeometryCollection", "geometries": [ZONE]},
    ],
    ids=lambda value: value["type"],
)
def test_no_fly_zones_of_any_geojson_are_kept(no_fly, tmp_path):
    made = Plans(tmp_path, None, OnLinks()).make(BODY | {"no_fly": no_fly})
    assert json.loads((tmp_path / made["id"] / "no-fly.geojson").read_text()) == no_fly  # the planner reads this file


@pytest.mark.parametrize(
    "no_fly",
    [
        {"type": "Point", "coordinates": [8.5, 47.4]},
        {"type": "Feature", "properties": {}, "geometry": None},
        {"type": "GeometryCollection", "geometries": [ZONE, {"type": "Point", "coordinates": [8.5, 47.4]}]},
        {"type": "Polygon", "coordinates": []},
        {"polygons": [ZONE]},
        [ZONE],
    ],
)
def test_no_fly_zones_that_cannot_be_kept_are_refused(no_fly, tmp_path):
    with pytest.raises(InputError, match="no_fly"):
        Plans(tmp_path, None, OnLinks()).make(BODY | {"no_fly": no_fly})
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("kind", [("MultiPolygon", "coordinates"), ("FeatureCollection", "features")])
def test_no_zones_are_no_zones(kind, tmp_path):
    made = Plans(tmp_path, None, OnLinks()).make(BODY | {"no_fly": {"type": kind[0], kind[1]: []}})
    assert not (tmp_path / made["id"] / "no-fly.geojson").exists()
