"""Vehicles of one start take off and land in turn, where there is time for it."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.track import Airspace
from orthoswarm.config import DEFAULT
from orthoswarm.planning.area.area import make_area
from orthoswarm.planning.lines.line_spacing import footprint
from orthoswarm.planning.planner import plan_area
from orthoswarm.planning.sorties import deconfliction
from orthoswarm.planning.sorties.assignment import PlanOptions
from orthoswarm.planning.sorties.deconfliction import Separation
from orthoswarm.planning.sorties.flight_time import Motion
from tests.kit.missions import sortie_mission
from tests.kit.plan_checks import on_globe
from tests.planning.test_plan_coverage import CONCAVE, HOLE, positions, start_at

FOOT = footprint(60.0, np.radians(60.0))
AREA = make_area([on_globe(CONCAVE, [HOLE])])


def planned(vehicles, starts, autopilot="ardupilot", end="rtl"):
    times = DEFAULT.times(autopilot)
    options = PlanOptions(
        motion=Motion(autopilot=times), starts=starts, end=end, separation=Separation(slack_s=times.schedule_slack_s)
    )
    return plan_area(AREA, vehicles, 60.0, FOOT, options=options), options


def pairs_that_met(plan, options, late_s, *, landing=False):
    """Pairs in the air less than 10 m apart and 4.5 m in height, if one is so many seconds late; or as both land."""
    tracks = [positions(plan, v.sorties[0], options.motion) for v in plan.vehicles]
    found = set()
    for (a, b), late in itertools.product(itertools.permutations(range(len(tracks)), 2), late_s):
        (_, p, begin_a), (_, q, begin_b) = tracks[a], tracks[b]
        i = np.arange(min(len(p), len(q) - round(late / 0.25)))
        j = i + round(late / 0.25)
        flying = (p[i, 2] > 2.0) & (q[j, 2] > 2.0) & (0.25 * i > begin_a) & (0.25 * j > begin_b)
        if landing:
            flying &= (i > begun(p)) & (j > begun(q))
        apart = np.hypot(*(p[i, :2] - q[j, :2]).T)
        if (flying & (apart < 10.0) & (np.abs(p[i, 2] - q[j, 2]) < 4.5)).any():
            found.add((a, b))
    return found


def begun(places):
    """The sample at which a vehicle has left its start."""
    return int(np.argmax(np.hypot(*(places[:, :2] - places[0, :2]).T) > 15.0))


@pytest.mark.parametrize(("autopilot", "end"), [("ardupilot", "rtl"), ("ardupilot", "land"), ("px4", "rtl")])
def test_vehicles_of_one_start_keep_apart_in_height_as_they_take_off_and_land(autopilot, end):
    plan, options = planned(5, [start_at(-60.0, 200.0)], autopilot, end)
    slack_s = options.motion.autopilot.takeoff_slack_s
    assert pairs_that_met(plan, options, (0.0, 1.0, slack_s)) == set()
    slack_s = options.motion.autopilot.landing_slack_s
    assert pairs_that_met(plan, options, (0.5 * slack_s, slack_s), landing=True) == set()
    assert plan.separation.partition("; ways")[0].endswith("take off and land in turn")
    assert not any("beside each other" in warning for warning in plan.warnings)


@pytest.mark.slow
def test_where_it_would_take_too_long_they_take_off_beside_each_other_and_the_plan_says_so():
    plan, options = planned(24, [start_at(-60.0, 200.0)])
    assert "take off and land 5 s after each other" in plan.separation
    [warning] = [text for text in plan.warnings if "beside each other" in text]
    assert float(warning.partition("at least ")[2].split()[0]) > 1.0
    assert pairs_that_met(plan, options, (0.0,))
    own, options = planned(24, [start_at(-60.0, 12.0 * k) for k in range(24)])
    assert own.makespan_s < plan.makespan_s
    assert own.warnings == () and pairs_that_met(own, options, (0.0,)) == set()


@pytest.mark.slow
@pytest.mark.parametrize("vehicles", [5, 24])
def test_taking_off_in_turn_is_tried_no_further_than_it_can_win(vehicles, monkeypatch):
    placed, place = [], deconfliction._Sky.place

    def count(sky, *args):
        placed.append(sky._in_turn)
        return place(sky, *args)

    monkeypatch.setattr(deconfliction._Sky, "place", count)
    plan, _ = planned(vehicles, [start_at(-60.0, 200.0)])
    in_turn, beside = sum(placed), len(placed) - sum(placed)
    if vehicles == 5:  # two orders, and nothing else where they are soon enough
        assert in_turn <= 10 and beside in (0, 5)
        assert "in turn" in plan.separation
    else:
        assert beside == vehicles and in_turn < vehicles
    monkeypatch.setattr(deconfliction, "_ORDERS_TRIED_SHARE", 0.0)
    monkeypatch.setattr(deconfliction._Placing, "soonest_s", 0.0)
    whole, _ = planned(vehicles, [start_at(-60.0, 200.0)])
    assert whole.vehicles == plan.vehicles


def test_starts_farther_apart_than_one_start_have_the_whole_allowance():
    """Their vehicles may cross each other's places as they come home."""
    plan, options = planned(6, [start_at(-60.0, 200.0 + 16.0 * k) for k in range(6)])
    assert pairs_that_met(plan, options, (-10.0, -5.0, 0.0, 5.0, 10.0)) == set()


def test_a_late_start_keeps_the_turn_that_the_plan_had():
    plan, _ = planned(4, [start_at(-60.0, 200.0)])
    sorties = {k: vehicle.sorties[0] for k, vehicle in enumerate(plan.vehicles, start=1)}
    missions = {k: sortie_mission(plan, sortie, Autopilot.ARDUPILOT) for k, sortie in sorties.items()}
    starts = {k: sortie.start_s for k, sortie in sorties.items()}
    airspace = Airspace.of(missions).as_planned(starts)
    assert airspace.in_turn and airspace.conflicts(starts) == []
    first, second, *_ = sorted(starts, key=lambda k: starts[k])
    late = {**starts, first: starts[second] - 1.0}  # takes off just before the next one
    assert any({first, second} == {one, other} for one, other, *_ in airspace.conflicts(late))
    moved = airspace.next_start(second, starts[second], {first: late[first]})
    assert moved > starts[second]
    assert airspace.conflicts({first: late[first], second: moved}) == []
    together = replace(airspace, in_turn=False)
    assert together.next_start(second, starts[second], {first: late[first]}) <= moved
