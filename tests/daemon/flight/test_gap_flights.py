"""Flights over gaps: which legs are over, how long batteries last, and what a plan over gaps takes into account."""

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gcs_plugin.daemon.flight_coverage.flown_legs import BatteryUse, FlownLegs, PlannedLegs
from gcs_plugin.daemon.flight_coverage.live_coverage import CoverageDocument, CoverageResult
from gcs_plugin.daemon.web_plans import GapFlights, Plans
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.geo import LocalGrid
from tests.daemon.on_links import OnLinks
from tests.kit.flown_area import CORNER, EPSG


def _row(vehicle: str, doing: str = "on mission", **more: Any) -> dict[str, Any]:
    lat, lon = LocalGrid(EPSG).to_geographic(CORNER)
    return {
        "id": vehicle, "state": "found", "armed": True, "battery": 0.8, "flight": {"state": doing},
        "mission": {"phase": "active"}, "lat_deg": float(lat), "lon_deg": float(lon),
        "home": [float(lat), float(lon)], "takeoff": None,
    } | more  # fmt: skip


def _landed(vehicle: str, **more: Any) -> dict[str, Any]:
    return _row(vehicle, "on ground", armed=False, mission={"phase": "complete"}, **more)


def _legs(count: int = 4) -> PlannedLegs:
    """Legs to the north, 50 m apart, 300 m long, flown by v1 and v2 in turn."""
    east = 50.0 * np.arange(count)
    ends = np.stack([np.stack([east, 0 * east], 1), np.stack([east, 0 * east + 300.0], 1)], 1)
    return PlannedLegs(ends, ["v1" if k % 2 == 0 else "v2" for k in range(count)], np.ones(count, np.int64))


def _fly(flown: FlownLegs, vehicle: str, path: list[tuple[float, float]]) -> None:
    for (a, b), (c, d) in itertools.pairwise(path):
        for t in np.linspace(0.0, 1.0, 40):
            flown.pass_by(vehicle, a + t * (c - a), b + t * (d - b))


def test_a_leg_is_over_once_it_was_left_after_its_end() -> None:
    flown = FlownLegs(legs=_legs(), reach_m=20.0, ahead_m=15.0)
    _fly(flown, "v1", [(0.0, -30.0), (0.0, 295.0)])
    assert not flown.over.any()
    _fly(flown, "v1", [(0.0, 300.0), (50.0, 330.0)])
    assert flown.over.tolist() == [True, False, False, False]


def test_a_leg_is_over_while_its_vehicle_waits_at_its_end() -> None:
    flown = FlownLegs(legs=_legs(), reach_m=20.0, ahead_m=15.0)
    _fly(flown, "v1", [(0.0, -30.0), (0.0, 290.0)])
    assert not flown.over.any()
    _fly(flown, "v1", [(0.0, 290.0), (0.0, 299.5), (0.0, 299.5)])
    assert flown.over.tolist() == [True, False, False, False]


def test_crossing_the_ends_of_legs_does_not_fly_them() -> None:
    flown = FlownLegs(legs=_legs(), reach_m=20.0, ahead_m=15.0)
    _fly(flown, "v1", [(-40.0, 0.0), (200.0, 0.0), (200.0, 300.0), (-40.0, 300.0)])
    assert not flown.over.any()


def test_legs_of_a_vehicle_that_came_home_early_are_over_and_offered_and_those_of_a_lost_one_only_while_it_is() -> None:
    flown = FlownLegs(legs=_legs(), reach_m=20.0, ahead_m=15.0)
    flown.look([_row("v1"), _row("v2")])
    assert not flown.over.any() and not flown.remaining()
    flown.look([_row("v1", "returning"), _row("v2", "lost", state="lost")])
    assert flown.over.all() and flown.remaining() == {"v1": [0, 2], "v2": [1, 3]}
    early = _row("v1", "on ground", armed=False, mission={"phase": "aborted"})
    flown.look([early, _row("v2")])
    assert flown.over.tolist() == [True, False, True, False] and flown.remaining() == {"v1": [0, 2]}


def test_a_mission_that_is_complete_leaves_no_leg_behind_though_its_turns_were_wide() -> None:
    flown = FlownLegs(legs=_legs(), reach_m=20.0, ahead_m=15.0)
    flown.look([_row("v1"), _row("v2")])
    _fly(flown, "v1", [(0.0, 40.0), (0.0, 330.0)])  # into its first leg too late
    flown.look([_landed("v1"), _row("v2")])
    assert flown.flown.tolist() == [True, False, True, False] and flown.remaining() == {"v1": []}


def test_what_is_over_survives_a_restart() -> None:
    flown = FlownLegs(legs=_legs(), reach_m=20.0, ahead_m=15.0)
    flown.look([_row("v1"), _row("v2")])
    _fly(flown, "v2", [(50.0, -30.0), (50.0, 330.0)])
    flown.look([_landed("v1"), _row("v2")])
    again = FlownLegs(legs=_legs(), reach_m=20.0, ahead_m=15.0)
    again.resume(json.loads(json.dumps(flown.state())))
    assert again.over.tolist() == flown.over.tolist() == [True, True, True, False]
    assert again.remaining() == flown.remaining()


def test_how_long_a_battery_lasts_is_known_from_the_flight_so_far_only() -> None:
    use = BatteryUse()
    use.look(_landed("v1", battery=1.0), False, 0.0)
    assert use.left("v1") == 1.0 and use.seconds("v1", 0.2) is None
    for k in range(1, 31):
        use.look(_row("v1", battery=1.0 - 0.01 * k), True, 20.0 * k)
    assert use.seconds("v1", 0.2) == pytest.approx((0.7 - 0.2) / (0.01 / 20.0), rel=0.05)
    use.look(_landed("v1", battery=0.99), False, 900.0)  # another battery
    assert use.seconds("v1", 0.2) == pytest.approx((0.99 - 0.2) / (0.01 / 20.0), rel=0.05)
    assert use.seconds("v2", 0.2) is None


class _Coverage:
    """Two gaps in the coverage of a plan."""

    def __init__(self, plan: str | None, no_fly: dict[str, Any] | None = None) -> None:
        self.battery = BatteryUse()
        self.no_fly = no_fly
        gaps = [self.square(0.0, 0.0, "not flown"), self.square(300.0, 200.0, "seen poorly")]
        document, features = CoverageDocument(plan=plan), {"type": "FeatureCollection", "features": gaps}
        self.result = CoverageResult(document, features, b"", [])

    @staticmethod
    def planning_fovs_deg(heights_over_level_ground: bool) -> dict[str, float]:
        return {"v1": 50.0, "v2": 48.0} if heights_over_level_ground else {"v1": 40.0, "v2": 38.0}

    @staticmethod
    def square(east: float, north: float, cause: str, side: float = 120.0) -> dict[str, Any]:
        corners = CORNER + np.array([east, north]) + side * np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])
        ring = [[float(lon), float(lat)] for lat, lon in LocalGrid(EPSG).to_geographic(corners)]
        geometry = {"type": "Polygon", "coordinates": [ring]}
        return {"type": "Feature", "properties": {"cause": cause}, "geometry": geometry}


class _Links:
    def __init__(self, rows: list[dict[str, Any]]) -> None:
        self._rows = rows

    def rows(self) -> list[dict[str, Any]]:
        return self._rows


def _flights(tmp_path: Path, rows: list[dict[str, Any]], **coverage: Any) -> GapFlights:
    plans = Plans(tmp_path / "plans", None, OnLinks())
    return GapFlights(_Coverage(None, **coverage), plans, _Links(rows))  # type: ignore[arg-type]


def test_the_plan_over_gaps_takes_the_solved_lens_and_each_vehicles_own_time(tmp_path: Path) -> None:
    flights = _flights(tmp_path, [_landed("v1"), _landed("v2")])
    made = flights.plan({"vehicles": {"v1": 4.0, "v2": 9.0}, "altitude_m": 60.0})
    assert made["footprint_m"][0] == pytest.approx(2 * 60 * np.tan(np.radians(48.0 / 2)), rel=1e-3)
    assert made["covered_share"] > 0.999 and made["method"] == "gaps"
    assert set(made["names"].values()) <= {"v1", "v2"} and made["names"]["v1"] == "v2"  # who can fly longest is first
    for part in made["vehicles"]:
        limit = 60 * {"v1": 4.0, "v2": 9.0}[made["names"][part["id"]]]
        assert all(flight["time_s"] <= limit for flight in part["flights"])
    assert not (tmp_path / "plans" / made["id"] / "area.geojson").exists()


def test_gaps_in_no_fly_zones_are_told_and_not_flown(tmp_path: Path) -> None:
    zone = {"type": "FeatureCollection", "features": [_Coverage.square(30.0, 30.0, "", 60.0)]}
    made = _flights(tmp_path, [_landed("v1")], no_fly=zone).plan({"vehicles": {"v1": 20.0}, "altitude_m": 60.0})
    assert any("no-fly zones and are not flown" in text for text in made["warnings"])


@pytest.mark.parametrize(
    ("row", "minutes", "error", "said"),
    [
        (_landed("v1"), None, InputError, "no figure is assumed"),
        (_row("v1"), 9.0, OrthoSwarmError, "still flying"),
        (_landed("v1", state="lost"), 9.0, OrthoSwarmError, "lost"),
        (_landed("v1"), True, InputError, "cannot fly for"),
        (_landed("v2"), 9.0, InputError, "not on the links"),
    ],
)
def test_who_cannot_or_must_not_fly_is_refused_in_a_sentence(
    tmp_path: Path, row: dict[str, Any], minutes: Any, error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        _flights(tmp_path, [row]).plan({"vehicles": {"v1": minutes}, "altitude_m": 60.0})


def test_a_vehicle_in_the_air_gets_another_mission_only_if_that_was_confirmed_for_it(tmp_path: Path) -> None:
    lat, lon = LocalGrid(EPSG).to_geographic(CORNER + np.array([600.0, 0.0]))
    flights = _flights(tmp_path, [_row("v1", home=[float(lat), float(lon)]), _row("v2", "landing")])
    assert [row["in_air"] for row in flights.vehicles()] == [True, False]
    wanted = {"vehicles": {"v1": 9.0}, "altitude_m": 60.0}
    with pytest.raises(OrthoSwarmError, match="still flying"):
        flights.plan(wanted)
    with pytest.raises(OrthoSwarmError, match="still flying"):
        flights.plan(wanted | {"vehicles": {"v2": 9.0}, "in_air": ["v2"]})
    made = flights.plan(wanted | {"in_air": ["v1"]})
    # 600 m to its home at 5 m/s are kept back: 9 min less 2
    assert max(f["time_s"] for f in made["vehicles"][0]["flights"]) <= 7 * 60.0
    with pytest.raises(InputError, match="bring it home now"):
        flights.plan(wanted | {"vehicles": {"v1": 1.5}, "in_air": ["v1"]})


def test_a_vehicle_whose_takeoff_is_due_gets_no_other_mission(tmp_path: Path) -> None:
    flights = _flights(tmp_path, [_landed("v1", takeoff={"in_s": 4.0})])
    with pytest.raises(OrthoSwarmError, match="about to take off"):
        flights.plan({"vehicles": {"v1": 9.0}, "altitude_m": 60.0})
