"""A survey of QGroundControl gives its height, overlaps, lens and direction, and what is left is named."""

import json
import math

import pytest

from gcs_plugin.cli.main import main
from gcs_plugin.mission.mission_files import parse_mission
from gcs_plugin.web.uploads import area_of
from tests.planning.test_plan_files import survey_plan

CAMERA = {
    "AdjustedFootprintFrontal": 11.786, "AdjustedFootprintSide": 15.725, "CameraName": "Custom Camera",
    "DistanceMode": 1, "DistanceToSurface": 50, "FixedOrientation": False, "FocalLength": 6, "FrontalOverlap": 70,
    "ImageDensity": 1.2923, "ImageHeight": 3040, "ImageWidth": 4056, "Landscape": True, "MinTriggerInterval": 0,
    "SensorHeight": 4.712, "SensorWidth": 6.287, "SideOverlap": 70, "ValueSetIsDistance": True, "version": 2,
}  # fmt: skip
LENS_DEG = math.degrees(2.0 * math.atan(6.287 / 12.0))


def surveyed(camera=None, style=None, **survey):
    document = survey_plan()
    entry = document["mission"]["items"][0]
    entry.update({"angle": 20, **survey})
    said = {key: value for key, value in {**CAMERA, **(camera or {})}.items() if value is not None}
    entry["TransectStyleComplexItem"].update({"CameraCalc": said, **(style or {})})
    return document


def settings_of(document):
    survey = parse_mission(json.dumps(document)).survey
    return {value.field: value.value for value in survey.values}, survey.left


def test_a_survey_says_how_it_is_flown():
    values, left = settings_of(surveyed(style={"TurnAroundDistance": 10}))
    assert values == pytest.approx(
        {"altitude_m": 50.0, "fov_min_deg": LENS_DEG, "aspect": 4056 / 3040, "side_overlap": 0.7,
         "forward_overlap": 0.7, "heading": 20.0, "run_in_m": 10.0}, abs=1e-3,
    )  # fmt: skip
    assert left == ("the speed of 5 m/s",)
    # the distances of lines and pictures that QGroundControl itself came to
    width_m = 2.0 * 50.0 * math.tan(math.radians(values["fov_min_deg"]) / 2.0)
    assert width_m * (1.0 - values["side_overlap"]) == pytest.approx(CAMERA["AdjustedFootprintSide"], rel=2e-3)
    height_m = width_m / values["aspect"]
    assert height_m * (1.0 - values["forward_overlap"]) == pytest.approx(CAMERA["AdjustedFootprintFrontal"], rel=2e-3)


@pytest.mark.parametrize(("kind", "told"), [(1, True), (22, True), (2, False), (13, False), (0, False)])
def test_that_a_survey_is_for_a_fixed_wing_or_vtol_is_told(kind, told):
    document = surveyed()
    document["mission"]["vehicleType"] = kind
    assert any("does not hover" in text for text in settings_of(document)[1]) == told


def test_an_upright_camera_lies_across_by_its_height():
    values, _ = settings_of(surveyed({"Landscape": False}))
    assert values["aspect"] == pytest.approx(3040 / 4056, abs=1e-4)
    assert values["fov_min_deg"] == pytest.approx(math.degrees(2.0 * math.atan(6.287 * 3040 / 4056 / 12.0)), abs=1e-3)


@pytest.mark.parametrize(
    ("camera", "style", "survey", "gone", "left"),
    [
        ({"DistanceMode": 2}, {}, {}, {"altitude_m"}, "50 m above the sea"),
        ({"DistanceMode": 3}, {}, {}, set(), "follows the ground"),
        ({"DistanceMode": None, "DistanceToSurfaceRelative": False}, {}, {}, {"altitude_m"}, "50 m above the sea"),
        ({}, {"FollowTerrain": True}, {}, set(), "follows the ground"),
        ({"FocalLength": 0}, {}, {}, {"fov_min_deg", "aspect", "side_overlap", "forward_overlap"}, "names no lens"),
        ({"SideOverlap": "70"}, {"HoverAndCapture": True}, {}, {"side_overlap"}, "stops for each picture"),
        ({}, {}, {"flyAlternateTransects": True, "angle": None}, {"heading"}, "every second line"),
    ],
)
def test_what_no_plan_is_made_of_is_named(camera, style, survey, gone, left):
    every = settings_of(surveyed())[0].keys()
    values, unused = settings_of(surveyed(camera, style, **survey))
    assert every - values.keys() == gone and any(left in text for text in unused)


def test_a_survey_without_a_camera_says_nothing():
    assert settings_of(survey_plan()) == ({}, ())


def planned(tmp_path, capsys, document, *flags):
    (tmp_path / "survey.plan").write_text(json.dumps(document))
    code = main(
        ["plan", str(tmp_path / "survey.plan"), "--vehicles", "1", *flags, "--json", "--out", str(tmp_path / "o")]
    )
    said = capsys.readouterr()
    return json.loads(said.out) if code == 0 else said.err


def test_a_plan_takes_from_a_survey_what_is_not_given_and_says_so(tmp_path, capsys):
    figures = planned(tmp_path, capsys, surveyed())
    assert figures["altitude_m"] == 50.0 and figures["fov_min_deg"] == pytest.approx(LENS_DEG, abs=1e-3)
    assert figures["footprint_m"] == pytest.approx([52.39, 39.27], abs=0.02)
    assert figures["trigger_m"] == pytest.approx(11.78, abs=0.02) and figures["spacing_m"] <= 15.73
    (note,) = [text for text in figures["warnings"] if "survey.plan" in text]
    assert "taken: height 50 m, Custom Camera (55.3 degrees)" in note and "not taken: the speed of 5 m/s" in note
    figures = planned(tmp_path, capsys, surveyed(), "--altitude", "80", "--fov-min", "60", "--method", "tmstc")
    assert figures["altitude_m"] == 80.0 and figures["fov_min_deg"] == 60.0
    assert figures["footprint_m"][0] / figures["footprint_m"][1] == pytest.approx(4 / 3, abs=1e-3)
    (note,) = [text for text in figures["warnings"] if "survey.plan" in text]
    assert (
        "taken: side overlap 70 %, forward overlap 70 %" in note and "lines at 20 degrees" in note.split("not taken")[1]
    )


def test_only_surveys_and_corridors_are_flown_over(tmp_path, capsys):
    document = surveyed()
    survey = document["mission"]["items"][0]
    tower = {
        "complexItemType": "StructureScan",
        "type": "ComplexItem",
        "polygon": [[47.0, 9.0], [47.1, 9.0], [47.0, 9.1]],
    }
    document["mission"]["items"] = [tower, survey]
    mission = parse_mission(json.dumps(document))
    assert len(mission.surveys) == 1 and "its StructureScan" in mission.survey.left
    document["mission"]["items"] = [tower]
    flags = ("--altitude", "60", "--fov-min", "60")
    assert "holds no polygon" in planned(tmp_path, capsys, document, *flags)


def test_a_camera_that_needs_time_between_pictures_is_heard(tmp_path, capsys):
    figures = planned(tmp_path, capsys, surveyed({"MinTriggerInterval": 3.0}))
    assert any("at most one picture in 3 s" in text for text in figures["warnings"])
    assert any("cameras take that need 3 s" in text for text in figures["warnings"])  # 11.8 m at 10 m/s
    assert not any("cameras take" in text for text in planned(tmp_path, capsys, surveyed())["warnings"])


def test_a_height_above_the_sea_is_said_where_the_height_is_asked_for(tmp_path, capsys):
    document = surveyed({"DistanceMode": None, "DistanceToSurfaceRelative": False})
    assert "the height of 50 m above the sea" in planned(tmp_path, capsys, document)


def test_what_neither_a_survey_nor_the_user_says_is_asked_for(tmp_path, capsys):
    assert "--altitude" in planned(tmp_path, capsys, survey_plan())
    assert "--fov-min" in planned(tmp_path, capsys, survey_plan(), "--altitude", "60")


def test_the_page_gets_what_has_a_field_and_the_rest_in_words():
    answer = area_of(json.dumps(surveyed(style={"TurnAroundDistance": 10})).encode(), "s.plan")
    assert answer["settings"] == pytest.approx(
        {"altitude_m": 50.0, "fov_min_deg": LENS_DEG, "side_overlap": 0.7, "forward_overlap": 0.7}, abs=1e-3
    )
    assert answer["unused"] == [
        *("pictures 1.33 times as wide as high", "lines at 20 degrees", "10 m to turn around", "the speed of 5 m/s"),
    ]
