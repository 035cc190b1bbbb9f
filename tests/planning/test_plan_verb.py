"""`orthoswarm plan` from the command line: products, formats of the area, and refusals that leave nothing behind."""

import argparse
import json
import os
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import shapely

from gcs_plugin.cli.main import main
from gcs_plugin.cli.verbs.plan import configure
from gcs_plugin.plans.plan_request import PlanRequest
from tests.kit.plan_checks import GRID, ORIGIN, crossed, fly, on_globe, seen_by, to_metres, write_geojson
from tests.planning.test_plan_files import survey_plan

CONCAVE = [(0, 0), (900, 0), (900, 700), (600, 700), (600, 300), (300, 300), (300, 700), (0, 700)]
HOLE = [(700, 350), (820, 380), (800, 520), (690, 480)]
FLAGS = ["--altitude", "60", "--fov-min", "60"]


@pytest.fixture
def area(tmp_path):
    return write_geojson(tmp_path / "area.geojson", on_globe(CONCAVE, [HOLE]))


def plan(*arguments):
    return main(["plan", *map(str, arguments)])


def kml_of(polygon):
    ring = " ".join(f"{lon:.9f},{lat:.9f},0" for lat, lon in [*polygon.shell, polygon.shell[0]])
    outer = f"<outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs>"
    polygon_text = f"<Placemark><Polygon>{outer}</Polygon></Placemark>"
    return f'<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document>{polygon_text}</Document></kml>'


def test_the_defaults_of_the_command_are_those_of_a_request(tmp_path):
    """The page and MAVProxy plan with a request's own defaults; the command states its defaults in its help."""
    parser = argparse.ArgumentParser()
    configure(parser)
    args = parser.parse_args(["area.geojson", "--vehicles", "3", *FLAGS, "--out", "out"])
    request = PlanRequest(area=args.area, vehicles=3, altitude_m=60.0, fov_min_deg=60.0)
    stated = (args.separation, args.height_step, args.side_overlap, args.forward_overlap, args.run_in, args.swap)
    assert stated == (
        request.separation_m, request.height_step_m, request.side_overlap, request.forward_overlap, request.run_in_m,
        request.swap_min,
    )  # fmt: skip


def test_thresholds_of_a_file_are_used_and_stand_in_the_report(area, tmp_path, capsys):
    config = tmp_path / "config.toml"
    config.write_text("[planning]\nmost_corners = 6\n")
    assert plan(area, "--vehicles", 2, *FLAGS, "--out", tmp_path / "out", "--config", config) == 2
    assert "at most 6" in capsys.readouterr().err
    config.write_text("[planning]\nclearance_m = 3\n")
    assert plan(area, "--vehicles", 2, *FLAGS, "--out", tmp_path / "out", "--config", config, "--json") == 0
    assert json.loads(capsys.readouterr().out)["config"] == {"planning": {"clearance_m": 3}}
    assert plan(area, "--vehicles", 2, *FLAGS, "--out", tmp_path / "again", "--json") == 0
    assert "config" not in json.loads(capsys.readouterr().out)
    config.write_text("[planning]\nclearance = 3\n")
    assert plan(area, "--vehicles", 2, *FLAGS, "--out", tmp_path / "none", "--config", config) == 2
    assert "no setting planning.clearance;" in capsys.readouterr().err and not (tmp_path / "none").exists()


@pytest.mark.parametrize("method", ["columns", "bcd", "tmstc"])
def test_eight_vehicles_get_missions_a_report_and_a_picture(method, area, tmp_path, capsys):
    out = tmp_path / "out"
    assert plan(area, "--vehicles", 8, *FLAGS, "--method", method, "--out", out, "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["covered_share"] >= 0.999 and figures["balance"] <= 1.25
    missions = {p.name for p in out.iterdir() if p.suffix in (".plan", ".waypoints")}
    assert missions == {f"v{k}.{kind}" for k in range(1, 9) for kind in ("plan", "waypoints")}
    assert {p.name for p in out.iterdir()} - missions == {"all.geojson", "plan.json", "plan.png"}
    assert json.loads((out / "plan.json").read_text()) == figures
    assert (out / "plan.png").read_bytes().startswith(b"\x89PNG")
    seen, width, height = [], *figures["footprint_m"]
    for vehicle in figures["vehicles"]:
        mission = fly((out / f"{vehicle['id']}.waypoints").read_text())
        assert crossed(mission, [HOLE]) == 0.0
        assert mission.length_m == pytest.approx(vehicle["length_m"], abs=1.0)
        seen.append(seen_by(mission, width, height))
    ground = shapely.Polygon(CONCAVE, [HOLE])
    assert ground.difference(shapely.union_all(seen)).area < 1e-3 * ground.area


def test_both_files_of_a_sortie_hold_the_same_mission(area, tmp_path):
    from gcs_plugin.mission.mission_files import parse_mission

    out = tmp_path / "out"
    assert plan(area, "--vehicles", 2, *FLAGS, "--out", out) == 0
    for name in ("v1", "v2"):
        one, other = (parse_mission((out / f"{name}.{kind}").read_text()) for kind in ("plan", "waypoints"))
        assert one.home == other.home and len(one.items) == len(other.items)
        assert [i.command for i in one.items] == [i.command for i in other.items]


def test_the_same_call_gives_the_same_files(area, tmp_path):
    for name in ("a", "b"):
        assert plan(area, "--vehicles", 3, *FLAGS, "--start", "47.853,9.005", "--out", tmp_path / name) == 0
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_an_area_may_come_as_kml_kmz_survey_and_without_suffix(tmp_path, capsys):
    square = on_globe([(0, 0), (500, 0), (500, 400), (0, 400)])
    kml = tmp_path / "area.kml"
    kml.write_text(kml_of(square))
    kmz = tmp_path / "area.kmz"
    with zipfile.ZipFile(kmz, "w") as archive:
        archive.write(kml, "doc.kml")
    geojson = write_geojson(tmp_path / "area", square)
    shares = []
    for number, path in enumerate((kml, kmz, geojson)):
        assert plan(path, "--vehicles", 2, *FLAGS, "--out", tmp_path / f"o{number}", "--json") == 0
        figures = json.loads(capsys.readouterr().out)
        shares.append((figures["area_m2"], figures["makespan_s"]))
    assert np.ptp([a for a, _ in shares]) < 1.0 and np.ptp([s for _, s in shares]) < 1.0
    survey = tmp_path / "survey.plan"
    survey.write_text(json.dumps(survey_plan()))
    assert plan(survey, "--vehicles", 2, *FLAGS, "--out", tmp_path / "o9", "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["area_m2"] == pytest.approx(760 * 556, rel=0.02) and figures["covered_share"] >= 0.999
    kinds = {f["properties"]["kind"] for f in json.loads((tmp_path / "o9/all.geojson").read_text())["features"]}
    assert "no-fly zone" in kinds


def test_lines_and_missions_are_followed(tmp_path, capsys):
    line = GRID.to_geographic(ORIGIN + np.array([(0, 0), (400, 0), (400, 15), (0, 15)], float))
    geometry = {"type": "LineString", "coordinates": [[lon, lat] for lat, lon in line.tolist()]}
    path = tmp_path / "road.geojson"
    path.write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": geometry}))
    assert plan(path, "--vehicles", 1, *FLAGS, "--out", tmp_path / "o1", "--json") == 0
    assert json.loads(capsys.readouterr().out)["covered_share"] is None
    legs = fly((tmp_path / "o1/v1.waypoints").read_text()).legs
    assert np.allclose(legs, [[(0, 0), (400, 0)], [(400, 15), (0, 15)]], atol=0.02)
    for number, kind in enumerate(("plan", "waypoints"), start=2):
        out = tmp_path / f"o{number}"
        assert plan(tmp_path / f"o1/v1.{kind}", "--vehicles", 1, *FLAGS, "--out", out) == 0
        assert np.allclose(fly((out / "v1.waypoints").read_text()).legs, legs, atol=0.05)


def test_lines_with_a_no_fly_zone_go_home_around_it(tmp_path):
    line = GRID.to_geographic(ORIGIN + np.array([(0, 0), (0, 600), (60, 600)], float))
    geometry = {"type": "LineString", "coordinates": [[lon, lat] for lat, lon in line.tolist()]}
    path = tmp_path / "road.geojson"
    path.write_text(json.dumps(geometry))
    zone = [(10, 200), (300, 200), (300, 400), (10, 400)]
    fence = write_geojson(tmp_path / "zone.geojson", on_globe(zone))
    start = ",".join(f"{v:.8f}" for v in GRID.to_geographic(ORIGIN + np.array([200.0, 0.0])))
    out = tmp_path / "out"
    assert plan(path, "--vehicles", 1, *FLAGS, "--no-fly", fence, "--start", start, "--out", out) == 0
    mission = fly((out / "v1.waypoints").read_text())
    assert crossed(mission, [zone]) == 0.0 and len(mission.legs) == 2
    assert plan(path, "--vehicles", 1, *FLAGS, "--no-fly", path, "--out", tmp_path / "no") == 2


@pytest.mark.parametrize("clearance", [8, 25])
def test_a_further_no_fly_zone_is_kept_clear(clearance, area, tmp_path):
    zone = [(100, 200), (180, 200), (180, 330), (100, 330)]
    fence = write_geojson(tmp_path / "zone.geojson", on_globe(zone))
    assert (
        plan(area, "--vehicles", 3, *FLAGS, "--no-fly", fence, "--clearance", clearance, "--out", tmp_path / "out") == 0
    )
    for path in (tmp_path / "out").glob("*.waypoints"):
        way = shapely.LineString(fly(path.read_text()).path)
        for hole in (zone, HOLE):
            assert way.distance(shapely.Polygon(hole)) > clearance - 0.1


def test_a_run_in_lies_in_line_with_each_leg_before_its_first_picture(area, tmp_path):
    start = ["--start", "47.853,9.005"]
    assert plan(area, "--vehicles", 2, *FLAGS, *start, "--run-in", 20, "--endurance", 9, "--out", tmp_path / "out") == 0
    for path in (tmp_path / "out").glob("*.waypoints"):
        flown = fly(path.read_text())
        assert crossed(flown, [HOLE]) == 0.0
        for begin, end in flown.legs:
            at = int(np.argmin(np.hypot(*(flown.path - begin).T)))
            along = (end - begin) / np.hypot(*(end - begin))
            run_in = shapely.LineString([begin - 20.0 * along, begin])
            if run_in.distance(shapely.Polygon(HOLE)) > 1.2:
                assert np.allclose(flown.path[at - 1], begin - 20.0 * along, atol=0.1)


BAD_AREAS = {
    "crossing.geojson": '{"type":"Polygon","coordinates":[[[9,47],[9.01,47.01],[9.01,47],[9,47.01],[9,47]]]}',
    "flat.geojson": '{"type":"Polygon","coordinates":[[[9,47],[9.01,47],[9.02,47],[9,47]]]}',
    "garbage.geojson": "this is not an area",
    "truncated.geojson": '{"type":"Polygon","coordinates":[[[9,47],[9.01',
    "kml.geojson": "<kml></kml>",
    "geojson.kml": '{"type":"Polygon","coordinates":[[[9,47],[9.01,47],[9.01,47.01],[9,47]]]}',
    "empty.kml": "",
    "image.geojson": b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR\xff\xfe",
    "point.geojson": '{"type":"Point","coordinates":[9,47]}',
    "utm.geojson": '{"type":"Polygon","coordinates":[[[500000,5300000],[500100,5300000],[500100,5300100]]]}',
    "fake.kmz": b"PK\x03\x04nothing",
    "other.plan": '{"fileType":"GeoFence"}',
    "hole.geojson": (
        '{"type":"Polygon","coordinates":[[[9,47],[9.01,47],[9.01,47.01],[9,47]],'
        "[[9.02,47],[9.021,47],[9.021,47.001],[9.02,47]]]}"
    ),
}


@pytest.mark.parametrize("name", BAD_AREAS)
def test_bad_areas_get_one_sentence_and_no_files(name, tmp_path, capsys):
    path = tmp_path / name
    content = BAD_AREAS[name]
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    before = sorted(os.listdir(tmp_path))
    assert plan(path, "--vehicles", 2, *FLAGS, "--out", tmp_path / "out") == 2
    refused(tmp_path, before, capsys)


@pytest.mark.parametrize(
    "flags",
    [
        ["--altitude", "0"],
        ["--altitude", "-5"],
        ["--altitude", "nan"],
        ["--altitude", "1e9"],
        ["--fov-min", "9"],
        ["--fov-min", "151"],
        ["--vehicles", "0"],
        ["--vehicles", "200"],
        ["--vehicles", "60", "--altitude", "120"],
        ["--speed", "0"],
        ["--speed", "inf"],
        ["--clearance", "inf"],
        ["--run-in", "-1"],
        ["--endurance", "1"],
        ["--endurance", "-4"],
        ["--start", "47.1"],
        ["--start", "nan,9"],
        ["--start", "9.0,47.85"],
        ["--side-overlap", "1"],
        ["--aspect", "wide"],
        ["--ceiling", "20"],
        ["--height-step", "0"],
        ["--swap", "-1"],
        ["--swap", "inf"],
        ["--no-fly", "nowhere.geojson"],
        ["--method", "spiral"],
        ["--altitude", "high"],
    ],
)
def test_bad_arguments_get_one_sentence_and_no_files(flags, area, tmp_path, capsys):
    before = sorted(os.listdir(tmp_path))
    assert plan(area, "--vehicles", "2", *FLAGS, "--out", tmp_path / "out", *flags) == 2
    refused(tmp_path, before, capsys, usage="invalid" in " ".join(flags) or flags[-1] in ("spiral", "high"))


def refused(folder, before, capsys, usage=False):
    captured = capsys.readouterr()
    assert sorted(os.listdir(folder)) == before, "something was left behind"
    assert captured.out == ""
    if not usage:
        assert captured.err.startswith("orthoswarm: ") and captured.err.count("\n") == 1


def test_missing_files_and_unusable_folders_are_refused(area, tmp_path, capsys):
    assert plan(tmp_path / "none.geojson", "--vehicles", 2, *FLAGS, "--out", tmp_path / "out") == 2
    assert plan(tmp_path, "--vehicles", 2, *FLAGS, "--out", tmp_path / "out") == 2
    assert plan(area, "--vehicles", 2, *FLAGS, "--out", area) == 2
    assert plan(area, "--vehicles", 2, *FLAGS, "--out", area / "below") == 2
    assert capsys.readouterr().err.count("orthoswarm: ") == 4


def test_a_new_plan_replaces_an_old_one_but_no_foreign_missions(area, tmp_path, capsys):
    out = tmp_path / "out"
    assert plan(area, "--vehicles", 5, *FLAGS, "--out", out) == 0
    (out / "notes.txt").write_text("mine")
    assert plan(area, "--vehicles", 2, *FLAGS, "--out", out) == 0
    assert sorted(p.name for p in out.glob("*.plan")) == ["v1.plan", "v2.plan"]
    assert (out / "notes.txt").read_text() == "mine"
    (out / "my survey.plan").write_text(json.dumps(survey_plan()))
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    assert plan(area, "--vehicles", 3, *FLAGS, "--out", out) == 2
    assert "my survey.plan" in capsys.readouterr().err
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_a_failure_while_writing_leaves_the_old_plan(area, tmp_path, monkeypatch):
    from gcs_plugin.plans import plan_files

    out = tmp_path / "out"
    assert plan(area, "--vehicles", 2, *FLAGS, "--out", out) == 0
    before = {p.name: p.read_bytes() for p in out.iterdir()}

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(plan_files.os, "fsync", full)
    assert plan(area, "--vehicles", 3, *FLAGS, "--out", out) == 2
    monkeypatch.undo()
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["area.geojson", "out"]


def test_the_end_and_the_autopilot_are_as_asked(area, tmp_path):
    for end, last in (("rtl", 20), ("land", 21), ("hover", 16)):
        out = tmp_path / end
        assert plan(area, "--vehicles", 1, *FLAGS, "--end", end, "--autopilot", "px4", "--out", out) == 0
        mission = json.loads((out / "v1.plan").read_text())["mission"]
        assert mission["firmwareType"] == 12 and mission["items"][-1]["command"] == last
        rows = [line.split("\t") for line in (out / "v1.waypoints").read_text().splitlines()[1:]]
        assert int(rows[-1][3]) == last
        if end != "hover":
            home, over = ([float(v) for v in row[8:10]] for row in (rows[0], rows[-2]))
            assert np.hypot(*(to_metres([home])[0] - to_metres([over])[0])) < 0.1


def test_help_is_quick_and_shows_an_example():
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "gcs_plugin.cli", "plan", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "example:" in done.stdout and "--fov-min" in done.stdout
    heavy = {"numpy", "numba", "shapely", "matplotlib", "pymavlink", "torch"}
    assert not heavy & {line.split("|")[-1].strip() for line in done.stderr.splitlines()}


def test_vehicles_are_given_autopilots_in_turn(area, tmp_path, capsys):
    out = tmp_path / "out"
    start = "--start={},{}".format(*on_globe([(-50.0, -50.0)]).shell[0])
    flags = [*FLAGS, "--vehicles", "3", start, "--out", out, "--json"]
    assert plan(area, *flags, "--autopilot", "ardupilot", "--autopilot", "px4") == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["autopilot"] == "mixed"
    assert [vehicle["autopilot"] for vehicle in figures["vehicles"]] == ["ardupilot", "px4", "ardupilot"]
    kinds = [json.loads((out / f"v{k}.plan").read_text())["mission"]["firmwareType"] for k in (1, 2, 3)]
    assert kinds[0] == kinds[2] != kinds[1]
    assert "even 20 s off schedule" in figures["separation"]  # the most that one of them needs
