"""Excerpts of real flights (ArduCopter 4.7, PX4; software in the loop, real time), fed through the fleet again.

Each holds one flight: every change of mode, mission item, landed state, each text and acknowledgement, and a position
every one and a half seconds; those of failsafes were numbered anew, so that what was left out is no loss.
"""

from pathlib import Path

import pytest

from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.flight_state import flight_state
from gcs_plugin.fleet.preflight import Level, Wanted, preflight
from gcs_plugin.links.tlog_writer import read_tlog
from gcs_plugin.links.transports import Link
from gcs_plugin.mission.completion import MissionEvent
from gcs_plugin.sim.memory_link import VirtualClock
from orthoswarm.model.earth import distance_m

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
