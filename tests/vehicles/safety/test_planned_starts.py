"""A plan's start in the daemon: what cancels it during its check and while vehicles wait, what is checked again."""

import json
import math
import threading
from dataclasses import replace

import pytest

from gcs_plugin.daemon import start_checks
from gcs_plugin.daemon.takeoffs import Takeoffs
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.mission_builder import read_mission
from gcs_plugin.sim.simulated_swarm import make_swarm
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.model.errors import OrthoSwarmError
from tests.vehicles.test_fleet_cli import HOME, folder  # noqa: F401
from tests.vehicles.test_vehicle_links import PlanFolder, open_links, ready, upload_all, wait  # noqa: F401

ONE_PATH = {name: ["separation"] for name in ("v1", "v2", "v3")}  # all have one mission, some seconds apart
AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4


class SlowPlans(PlanFolder):
    """Plans whose missions are read only when the test allows it: the check is under way until then."""

    def __init__(self, path):
        super().__init__(path)
        self.asked, self.go_on = threading.Event(), threading.Event()

    def mission(self, body, vehicle, autopilot):
        self.asked.set()
        assert self.go_on.wait(120.0)
        return super().mission(body, vehicle, autopilot)


class SlowToRead(SimVehicle):
    """A vehicle that sends no item of its mission while the test holds it."""

    held = False

    def handle(self, message, sender, now):
        of_mission = message.get_type() == "MISSION_REQUEST_INT" and message.mission_type == 0
        return [] if self.held and of_mission else super().handle(message, sender, now)


def beginning(takeoffs, said):
    """A thread that gives a start; what it says is added to a list."""

    def begin():
        try:
            said.append(takeoffs.begin("plan-1", override=ONE_PATH))
        except OrthoSwarmError as error:
            said.append(str(error))

    return threading.Thread(target=begin)


def apart(folder, count, seconds):  # noqa: F811
    """The plan with `count` vehicles that take off so many seconds after each other."""
    document = json.loads((folder / "plan.json").read_text())
    document["vehicles"] = document["vehicles"][:count]
    for number, vehicle in enumerate(document["vehicles"]):
        vehicle["flights"][0]["start_s"] = seconds * number
    (folder / "plan.json").write_text(json.dumps(document))


@pytest.mark.parametrize("verb", ["pause", "rtl", "land"])
def test_a_command_to_stop_during_the_check_cancels_the_start(open_links, folder, verb):  # noqa: F811
    apart(folder, 2, 2.0)
    vehicles = make_swarm(2, home=HOME)
    links = open_links(vehicles)
    ready(links, 2)
    upload_all(links, folder)
    plans, said = SlowPlans(folder), []
    takeoffs = Takeoffs(links, plans, lambda _: None)

    thread = beginning(takeoffs, said)
    thread.start()
    assert plans.asked.wait(120.0)
    rows = links.commands(verb)
    assert [row["outcome"] for row in rows] == ["done"] * 2 and "start" in rows[0]["reason"]
    plans.go_on.set()
    thread.join(120.0)
    assert said == ["v1, v2 was told to stop during the check; no vehicle was started"]
    assert takeoffs.waiting.rows() == {} and not any(v.flight.armed for v in vehicles)
    takeoffs.close()


def test_a_command_to_stop_counts_though_the_check_begins_at_that_moment(open_links, folder, monkeypatch):  # noqa: F811
    """The start copies the numbers of stops between the command's own count and its look at what is being checked."""
    apart(folder, 1, 0.0)
    vehicles = make_swarm(1, home=HOME)
    links = open_links(vehicles)
    ready(links, 1)
    upload_all(links, folder)
    plans, said = SlowPlans(folder), []
    takeoffs = Takeoffs(links, plans, lambda _: None)
    cancel = links.waiting.cancel

    def late(vehicle, fleet):
        thread.start()
        assert plans.asked.wait(120.0)
        return cancel(vehicle, fleet)

    thread = beginning(takeoffs, said)
    monkeypatch.setattr(links.waiting, "cancel", late)
    (row,) = links.commands("pause")
    assert row["outcome"] == "done" and "cancelled" in row["reason"]
    plans.go_on.set()
    thread.join(120.0)
    assert said == ["v1 was told to stop during the check; no vehicle was started"]
    assert not vehicles[0].flight.armed
    takeoffs.close()


def test_a_mission_that_takes_long_to_read_is_red_until_it_is_read(open_links, folder, monkeypatch):  # noqa: F811
    """A check goes on with what an earlier one has begun to read; then a start finds the mission read."""
    monkeypatch.setattr(start_checks, "_READ_S", 0.3)
    apart(folder, 1, 0.0)
    vehicle = SlowToRead(system=1, home=HOME)
    links = open_links([vehicle])
    ready(links, 1)
    upload_all(links, folder)
    wait(lambda: not links.fleet.reads(1))
    links.fleet.vehicles[1].read_s, vehicle.held = -math.inf, True  # it was read long ago
    plans = PlanFolder(folder)
    takeoffs = Takeoffs(links, plans, lambda _: None)

    def reason():
        (row,) = takeoffs.preflight("plan-1")
        return next(i["reason"] for i in row["items"] if i["name"] == "mission")

    assert "still being read" in reason()
    with pytest.raises(OrthoSwarmError, match="still being read"):
        takeoffs.begin("plan-1", override=ONE_PATH)
    vehicle.held = False
    wait(lambda: reason() == "holds this plan's mission")
    assert takeoffs.begin("plan-1", override=ONE_PATH) == {"v1": 0.0}
    takeoffs.close()


def test_a_start_whose_check_took_long_is_not_carried_out_but_can_be_given_again(open_links, folder):  # noqa: F811
    apart(folder, 2, 60.0)
    links = open_links(make_swarm(2, home=HOME))
    ready(links, 2)
    upload_all(links, folder)
    takeoffs = Takeoffs(links, PlanFolder(folder), lambda _: None)
    with pytest.raises(OrthoSwarmError, match="no vehicle was started; give it again"):
        takeoffs.begin("plan-1", given_s=links.clock() - 6.0)
    assert takeoffs.begin("plan-1") == {"v1": 0.0, "v2": 60.0}
    takeoffs.close()


def test_a_vehicle_whose_takeoff_waits_takes_no_other_mission(open_links, folder):  # noqa: F811
    apart(folder, 2, 60.0)
    links = open_links(make_swarm(2, home=HOME))
    ready(links, 2)
    upload_all(links, folder)
    takeoffs = Takeoffs(links, PlanFolder(folder), lambda _: None)
    takeoffs.begin("plan-1")
    other = read_mission(folder / "v1.waypoints", links.fleet.vehicles[2].autopilot)
    with pytest.raises(OrthoSwarmError, match=r"waits for its takeoff .* cancel that first"):
        links.upload(2, other)
    assert links.commands("pause", ["v2"])[0]["outcome"] == "done"
    links.upload(2, other)
    takeoffs.close()


def test_what_has_become_red_until_the_takeoff_holds_the_vehicle_and_the_rest(open_links, folder):  # noqa: F811
    apart(folder, 3, 2.0)
    vehicles = make_swarm(3, home=HOME)
    links = open_links(vehicles)
    ready(links, 3)
    upload_all(links, folder)
    said = []
    takeoffs = Takeoffs(links, PlanFolder(folder), said.append)
    takeoffs.begin("plan-1", override=ONE_PATH)
    vehicles[1].ready_s = 1e9  # its filter fails
    wait(lambda: "failed" in takeoffs.waiting.rows().get("v3", {}))
    assert "v2 was not started: gps: no 3D fix" in takeoffs.waiting.rows()["v2"]["failed"]
    assert any("v3 stay on the ground" in text for text in said)
    assert not vehicles[1].flight.armed and not vehicles[2].flight.armed
    takeoffs.close()


def plan_of_two(open_links, folder, seconds, speed=10.0):  # noqa: F811
    """Two vehicles that take off so many seconds after each other, and the plan's start."""
    apart(folder, 2, seconds)
    vehicles = make_swarm(2, home=HOME)
    links = open_links(vehicles, speed=speed)
    ready(links, 2)
    upload_all(links, folder)
    said = []
    takeoffs = Takeoffs(links, PlanFolder(folder), said.append)
    assert set(takeoffs.begin("plan-1", override=ONE_PATH)) == {"v1", "v2"}
    return vehicles, links, takeoffs, said


def test_a_waiting_vehicle_that_somebody_else_returns_stays_on_the_ground(open_links, folder):  # noqa: F811
    vehicles, _, takeoffs, said = plan_of_two(open_links, folder, 3.0)
    wait(lambda: vehicles[0].flight.motion.up > 4.0)
    for vehicle in vehicles:  # by another station: ours hears of it by the vehicles' messages only
        vehicle.flight.set_mode(vehicle.flight.modes.rtl)
    wait(lambda: "failed" in takeoffs.waiting.rows().get("v2", {}))
    assert "was put into RTL since its start was given" in takeoffs.waiting.rows()["v2"]["failed"]
    wait(lambda: not vehicles[0].flight.armed)
    assert not vehicles[1].flight.armed and any("v2 did not take off" in text for text in said)
    takeoffs.close()


def test_nobody_follows_one_that_does_not_leave_the_ground(open_links, folder):  # noqa: F811
    vehicles, _, takeoffs, _ = plan_of_two(open_links, folder, 1.0, speed=4.0)
    first = vehicles[0].flight
    wait(lambda: first.armed and first.mode == first.modes.mission)
    first.set_mode(first.modes.rtl)
    first.motion.still()  # it is still on the ground
    wait(lambda: "failed" in takeoffs.waiting.rows().get("v2", {}))
    assert "because v1 did not take off" in takeoffs.waiting.rows()["v2"]["failed"]
    assert not vehicles[1].flight.armed
    takeoffs.close()


def test_a_mission_that_somebody_replaces_while_a_takeoff_waits_is_not_flown(open_links, folder):  # noqa: F811
    vehicles, _, takeoffs, _ = plan_of_two(open_links, folder, 2.0)
    store = vehicles[1].store
    store.items = [*store.items[:3], *(replace(item, z=item.z + 9.0) for item in store.items[3:])]
    store.generation += 1
    wait(lambda: "failed" in takeoffs.waiting.rows().get("v2", {}))
    assert "mission" in takeoffs.waiting.rows()["v2"]["failed"] and not vehicles[1].flight.armed
    takeoffs.close()
