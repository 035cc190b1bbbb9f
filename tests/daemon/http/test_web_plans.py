"""Plans as the page asks for them: for the autopilots that are on the links."""

import pytest

from gcs_plugin.daemon.web_plans import Plans
from orthoswarm.model.errors import InputError
from tests.kit.plan_checks import on_globe

SQUARE = on_globe([(0, 0), (200, 0), (200, 200), (0, 200)])
AREA = {"type": "Polygon", "coordinates": [[[lon, lat] for lat, lon in [*SQUARE.shell, SQUARE.shell[0]]]]}
BODY = {"area": AREA, "vehicles": 2, "altitude_m": 60, "fov_min_deg": 60}


@pytest.mark.parametrize(
    ("asked", "made"),
    [
        ({}, ["ardupilot", "px4"]),
        ({"autopilot": "px4"}, ["px4", "px4"]),
        ({"autopilot": ["px4", "ardupilot"]}, ["px4", "ardupilot"]),
    ],
)
def test_a_plan_is_made_for_the_autopilots_on_the_links_unless_the_request_names_others(asked, made, tmp_path):
    plans = Plans(tmp_path, autopilots=lambda: {"v2": "px4", "v7": "px4"})
    figures = plans.make(BODY | asked)
    assert [vehicle["autopilot"] for vehicle in figures["vehicles"]] == made


@pytest.mark.parametrize("autopilot", ["betaflight", 4, [], ["px4", None]])
def test_other_autopilots_are_refused(autopilot, tmp_path):
    with pytest.raises(InputError, match="ardupilot, px4"):
        Plans(tmp_path).make(BODY | {"autopilot": autopilot})
    assert not list(tmp_path.iterdir())
