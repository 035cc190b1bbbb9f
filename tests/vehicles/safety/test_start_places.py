"""The check before a start: where vehicles stand, what else flies there, how long they can, and their fences."""

from dataclasses import replace

import pytest

from gcs_plugin.fleet.preflight import Level, Wanted, preflight
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.items import FRAME_GLOBAL
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from tests.vehicles.test_preflight import CHART, line

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])


def standing(make_world, autopilot, loaded, north=0.0):
    """A vehicle that stands so far from the origin and holds a mission."""
    world = make_world(SimVehicle(system=1, autopilot=autopilot, home=(*CHART.to_degrees(north, 0.0), 488.0)))
    world.wait(8.0)
    assert world.finish(world.fleet.upload(1, loaded))[0].ok
    return world


def item(world, name, wanted=Wanted()):  # noqa: B008
    check = preflight(world.fleet.vehicles[1], wanted, world.clock.now)
    return next(item for item in check.items if item.name == name)


@BOTH
@pytest.mark.parametrize(("north", "level"), [(0.0, Level.OK), (10.0, Level.OK), (40.0, Level.RED)])
def test_a_vehicle_that_stands_elsewhere_than_its_mission_takes_off_is_red(make_world, autopilot, north, level):
    loaded = line(autopilot, 10, 80)
    world = standing(make_world, autopilot, loaded, north)
    for wanted in (Wanted(), Wanted(mission=loaded)):
        found = item(world, "home", wanted)
        assert found.level is level, found
    assert level is Level.OK or "it stands 40 m from where its mission takes off" in found.reason


def test_a_vehicle_that_stands_higher_than_its_mission_says_is_red(make_world):
    loaded = line(AP, 10, 80)
    world = standing(make_world, AP, loaded)
    for altitude, level in ((480.0, Level.OK), (430.0, Level.RED)):
        planned = replace(loaded, items=(replace(loaded.items[0], z=altitude, frame=FRAME_GLOBAL), *loaded.items[1:]))
        found = item(world, "home", Wanted(mission=planned))
        assert found.level is level, found
    assert "58 m above where its mission takes off" in found.reason
