"""Excerpts of real flights (ArduCopter 4.7, PX4; software in the loop, real time), fed through the fleet again.

Each holds one flight: every change of mode, mission item, landed state, each text and acknowledgement, and a position
every one and a half seconds; those of failsafes were numbered anew, so that what was left out is no loss.
"""

from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.flight_state import flight_state
from gcs_plugin.fleet.preflight import Level, Wanted, preflight
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.links.transports import Link
from gcs_plugin.mission.completion import MissionEvent
from gcs_plugin.mission.items import CHANGE_SPEED, RTL, TAKEOFF, WAYPOINT, Mission, MissionItem
from gcs_plugin.mission.track import STEP_S, track_of
from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.config import DEFAULT
from orthoswarm.model.earth import distance_m
from tests.kit.vehicles.memory_link import VirtualClock, World
from tests.kit.vehicles.telemetry_log import read_tlog

FLIGHTS = Path(__file__).parents[1] / "data" / "flights"


class Replay(Link):
    """A link on which a log is heard once more, at the times of its packets."""

    def __init__(self, path, clock):
        super().__init__(path.name)
        self.clock = clock
        self.packets = list(read_tlog(path))
        self.begun = self.packets[0][0]

    def open(self, selector, now):
        pass

    def close(self):
        pass

    @property
    def polled(self):
        return self

    def send(self, peer, data, expires=0.0):
        return True

    def receive(self, source, events, now):
        while self.packets and self.packets[0][0] - self.begun <= now:
            yield "log", self.packets.pop(0)[1].raw


def replay_all(name, look):
    """Feed a log through a fleet, calling `look(fleet, seconds)` ten times a second; gives vehicles and events."""
    clock = VirtualClock()
    link = Replay(FLIGHTS / f"{name}.tlog", clock)
    with Fleet([link], clock=clock, wall=clock.utc) as fleet:
        events = []
        fleet.on_event(events.append)
        while link.packets:
            clock.now += 0.1
            fleet.poll(0.0)
            look(fleet, clock.now)
        return list(fleet.vehicles.values()), events


def replay(name, look):
    """The same with the log of one vehicle: `look(vehicle)`; gives it and the mission events."""
    (vehicle,), events = replay_all(name, lambda fleet, _: [look(vehicle) for vehicle in fleet.vehicles.values()])
    missions = {event.value for event in MissionEvent}
    return vehicle, [event.kind for event in events if event.kind in missions]


FLOWN = ["taking off", "on mission"]
RETURNS = ["returning", "landing"]


# The missions themselves are not in the logs, as for a station that joins late: ArduCopter's RTL inside a mission is
# then seen only as its landing.
@pytest.mark.parametrize(
    ("name", "events", "words"),
    [
        ("arducopter_rtl", ["started", "complete"], [*FLOWN, "landing", "complete"]),
        ("arducopter_land", ["started", "complete"], [*FLOWN, "landing", "complete"]),
        ("arducopter_waypoint", ["started", "complete"], [*FLOWN, "holding", *RETURNS, "complete"]),
        ("arducopter_operator_rtl", ["started", "suspended", "aborted"], [*FLOWN, *RETURNS, "on ground"]),
        (
            "arducopter_pause",
            ["started", "suspended", "resumed", "complete"],
            [*FLOWN, "paused", "on mission", "complete"],
        ),
        (
            "px4_pause",
            ["started", "suspended", "resumed", "complete"],
            [*FLOWN, "paused", "on mission", *RETURNS, "complete"],
        ),
        ("px4_rtl", ["started", "complete"], [*FLOWN, *RETURNS, "complete"]),
        ("px4_land", ["started", "complete"], [*FLOWN, "landing", "complete"]),
        ("px4_waypoint", ["started", "complete"], [*FLOWN, "holding", *RETURNS, "complete"]),
    ],
)
def test_a_real_flight_in_words_and_events(name, events, words):
    seen = []

    def look(vehicle):
        word = flight_state(vehicle).word.value
        if seen[-1:] != [word]:
            seen.append(word)

    _, kinds = replay(name, look)
    assert kinds == events
    rest = iter(seen)
    assert all(word in rest for word in words), seen  # in this order
    assert "lost" not in seen and "flying" not in seen, seen
    if name not in ("arducopter_pause", "px4_pause", "arducopter_operator_rtl"):  # the latter waits in LOITER_UNLIM
        assert "paused" not in seen, seen


@pytest.mark.parametrize(
    ("name", "words", "text"),
    [
        ("arducopter_geofence", [*FLOWN, *RETURNS, "on ground"], "Circle fence breached"),
        ("arducopter_battery", [*FLOWN, *RETURNS, "on ground"], "Battery Failsafe"),
        ("arducopter_gps_loss", [*FLOWN, "landing", "on ground"], "EKF Failsafe: changed to LAND Mode"),
        ("px4_geofence", [*FLOWN, *RETURNS, "on ground"], "Geofence: exceeding maximum distance to Home"),
        ("px4_battery", [*FLOWN, *RETURNS, "on ground"], "Critical battery"),
        ("px4_gps_loss", [*FLOWN, "landing", "on ground"], "Failsafe activated"),
    ],
)
def test_a_failsafe_ends_the_mission_once_without_completing_it(name, words, text):
    """PX4 calls the mission active again between its landing and its disarming: nothing was resumed."""
    seen = []
    vehicle, kinds = replay(name, lambda v: seen.append(flight_state(v).word.value))
    assert kinds == ["started", "suspended", "aborted"]
    rest = iter(seen)
    assert all(word in rest for word in words), dict.fromkeys(seen)
    assert "complete" not in seen and "lost" not in seen
    assert any(text in said for said in vehicle.texts)


def test_px4_says_complete_when_it_begins_to_return():
    states = []
    replay("px4_rtl", lambda v: states.append((v.detector.phase.value, flight_state(v).word.value)))
    assert ("complete", "returning") in states and ("complete", "landing") in states
    assert states[-1] == ("complete", "complete")


def test_px4_paused_before_it_took_off_has_flown_nothing():
    """Armed, mission started and paused at once: ten seconds later it disarms by itself."""
    vehicle, kinds = replay("px4_never_took_off", lambda v: None)
    assert "complete" not in kinds and not vehicle.armed
    assert flight_state(vehicle).word.value == "on ground"
    assert any("auto preflight disarming" in text for text in vehicle.texts)


def test_arducopter_is_not_ready_for_most_of_a_minute_after_its_start():
    """Position after 10 s, its own checks pass after 25 s, and only after 42 s has its filter an absolute position."""
    states, reasons = [], set()

    def look(vehicle):
        now = vehicle.heard
        items = {item.name: item for item in preflight(vehicle, Wanted(), now).items}
        reasons.add(items["pre-arm"].reason)
        state = tuple(items[name].level is Level.RED for name in ("gps", "ekf", "pre-arm"))
        if states[-1:] != [state]:
            states.append(state)

    vehicle, kinds = replay("arducopter_boot", look)
    assert states[-1] == (False, False, False) and kinds == []
    assert (True, True, True) in states and (False, True, False) in states
    assert any("PreArm:" in reason for reason in reasons)
    assert vehicle.home is not None


def test_vehicles_that_are_about_to_meet_are_named_while_a_pause_still_helps():
    """A PX4 24 s behind its plan and an ArduCopter 9 s behind cross each other's way, 4 m apart at one height."""
    apart, alarms = [], []

    def look(fleet, now):
        if len(fleet.vehicles) == 2:
            one, other = fleet.vehicles.values()
            if one.lat_deg and other.lat_deg:
                apart.append((distance_m(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg), now))
        alarms.extend((now, near) for near in fleet.separation.alarms.values() if not alarms)

    _, events = replay_all("arducopter_px4_meeting", look)
    nearest_m, nearest_s = min(apart)
    (said_s, near) = alarms[0]
    assert nearest_m < 6.0 and nearest_s - said_s > 2.5
    assert near.pair == (2, 3) and near.metres < 10.0 and near.height_m < 1.0
    assert [event.kind for event in events if event.kind in ("near", "apart")] == ["near", "apart"]


# What they flew: autopilot, height and speed, and latitude and longitude of their start and points; what may be between
# them and their plans, metres.
AROUND_A_START = {
    "arducopter_start": (
        Autopilot.ARDUPILOT, 40.0, 8.0,
        [(48.137, 11.605134), (48.13716011, 11.6090813), (48.13689791, 11.60834633), (48.137, 11.605134)], 5.0,
    ),
    "px4_start": (
        Autopilot.PX4, 40.0, 8.0,
        [(48.137, 11.605), (48.13832149, 11.60539392), (48.13823949, 11.60900608), (48.13847974, 11.60900608),
         (48.13856164, 11.60539806), (48.137, 11.605)], 10.0,
    ),
}  # fmt: skip


def around(seconds, lat_deg, lon_deg, heights):
    """Rows of seconds, distance from the start and height: from leaving the ground to 40 m away; and from there home.

    The second ones count seconds from 40 m away on, since turns and winds have come between.
    """
    up = int(np.argmax(heights > 0.3))
    away = np.array([distance_m(lat_deg[up], lon_deg[up], *place) for place in zip(lat_deg, lon_deg, strict=True)])
    left, back = up + int(np.argmax(away[up:] > 40.0)), len(away) - int(np.argmax(away[::-1] > 40.0))
    rows = np.column_stack([seconds, away, heights])
    return [rows[a:b] - [rows[a, 0], 0.0, 0.0] for a, b in ((up, left), (back, len(rows)))]


def between(flown, other):
    """The greatest distance along the way and in height between two that were recorded at other moments, metres."""
    seconds = other[other[:, 0] <= flown[-1, 0], 0]
    return [np.abs(np.interp(seconds, flown[:, 0], flown[:, k]) - other[: len(seconds), k]).max() for k in (1, 2)]


@pytest.mark.parametrize("name", AROUND_A_START)
def test_plans_and_simulated_vehicles_are_where_a_real_one_was_around_its_start(name):
    """It stands still above it before it sets off, gathers speed, and waits above it before it comes down."""
    autopilot, height, speed, places, allowed_m = AROUND_A_START[name]
    items = [MissionItem.at(WAYPOINT, *places[0], 0.0)] if autopilot is Autopilot.ARDUPILOT else []
    items += [MissionItem.at(TAKEOFF, *places[0], height), MissionItem.do(CHANGE_SPEED, 1, speed)]
    items += [MissionItem.at(WAYPOINT, *place, height) for place in places[1:]]
    mission = Mission(autopilot, (*items, MissionItem.do(RTL)))

    seen = []
    here = attrgetter("time_boot_s", "lat_deg", "lon_deg", "height_m")
    replay(name, lambda v: v.lat_deg and seen.append(here(v)))
    flown = around(*np.unique(seen, axis=0).T)

    track = track_of(mission, places[0]).places
    away = np.hypot(*track[:, :2].T)
    left, back = int(np.argmax(away > 40.0)), len(away) - int(np.argmax(away[::-1] > 40.0))
    rows = np.column_stack([STEP_S * np.arange(len(track)), away, track[:, 2]])
    begins = int(np.argmax(track[:, 2] > 0.3))
    planned = [rows[a:b] - [rows[a, 0], 0.0, 0.0] for a, b in ((begins, left), (back, len(rows)))]

    frame = Airframe().as_flown(DEFAULT.times(autopilot.value))
    with World([SimVehicle(system=1, autopilot=autopilot, home=(*places[0], 500.0), airframe=frame)]) as world:
        world.meet()
        assert world.finish(world.fleet.upload(1, mission))[0].ok
        assert world.finish(world.fleet.start(1))[0].ok
        vehicle, sim = world.fleet.vehicles[1], []
        world.until(lambda: sim.append(here(vehicle)), 250.0)
    simulated = around(*np.unique(sim, axis=0).T)

    for other in (planned, simulated):
        for real, rows in zip(flown, other, strict=True):
            assert max(between(real, rows)) < allowed_m
