"""What a vehicle holds, does and was told is read from it before anything moves: on simulated and on real autopilots.

A second station, a remote control and failsafes act beside ours; with `-m sitl` on a further link of the autopilot.
"""

import math
import time
from dataclasses import replace

import pytest

from gcs_plugin.fleet.commands import Order
from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.flight_state import Word, danger_of, flight_state
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.command_dialogues import Command
from gcs_plugin.mission.completion import Phase
from gcs_plugin.mission.exchange import Address, Verdict
from gcs_plugin.mission.flight_modes import mode_params
from gcs_plugin.mission.flown_items import off_leg_m
from gcs_plugin.mission.items import RTL, WAYPOINT
from gcs_plugin.mission.mission_files import FileItem
from orthoswarm.model.errors import OrthoSwarmError
from tests.vehicles.autopilots.test_fleet_scenarios import PLACES, Real, Simulated, Site, further_link

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
OTHER = Address(254, 190)
HOME = FileItem(command=RTL)


class Beside:
    """A second station to a simulated vehicle: what it sends arrives at once."""

    def __init__(self, site):
        self.site, self.sim = site, site.place.world.vehicles[site.system]

    def send(self, command, *params):
        to, values = self.site.vehicle.address, (*params, *(0.0,) * 7)[:7]
        message = dialect.MAVLink_command_long_message(to.system, to.component, command, 0, *values)
        (ack, *_) = [
            m for m in self.sim.handle(message, OTHER, self.site.place.world.clock.now) if m.get_type() == "COMMAND_ACK"
        ]
        return ack.result == dialect.MAV_RESULT_ACCEPTED

    def jump(self, seq):
        to = self.site.vehicle.address
        message = dialect.MAVLink_mission_set_current_message(to.system, to.component, seq)
        self.sim.handle(message, OTHER, self.site.place.world.clock.now)

    def store(self, mission):
        self.sim.store.items, self.sim.store.generation = list(mission.items), self.sim.store.generation + 1

    def moves(self):
        """Fly away in GUIDED, or HOLD."""
        assert self.mode("ready")
        motion = self.sim.flight.motion
        motion.go((motion.north + 400.0, motion.east, motion.up))

    def sinks(self):
        """A remote control in LOITER with its throttle at the bottom."""
        flight = self.sim.flight
        self.send(dialect.MAV_CMD_DO_SET_MODE, *mode_params(self.site.vehicle.autopilot, self.manual))
        north, east = flight.motion.seen
        flight.motion.go((north, east, 2.0))

    @property
    def manual(self):
        return 5 if self.site.vehicle.autopilot is AP else 3 << 16

    def mode(self, name):
        number = getattr(self.site.vehicle.modes, name)
        return self.send(dialect.MAV_CMD_DO_SET_MODE, *mode_params(self.site.vehicle.autopilot, number))

    def failsafe(self):
        self.sim.flight.fail_safe("Battery 1 low voltage failsafe")

    def end(self):
        pass


class Apart(Beside):
    """A second station to a real autopilot, on a link of its own."""

    def __init__(self, site, address):
        self.site = site
        self.fleet = Fleet([address], own=OTHER)
        site.place.others = [self.fleet]
        assert site.place.until(lambda: site.system in self.fleet.vehicles, 30.0), "the second station hears nothing"

    def send(self, command, *params):
        to = self.fleet.vehicles[self.site.system].address
        job = self.fleet.begin(Command(to, OTHER, command=command, params=params, verb="it"))
        self.site.place.until(lambda: job.outcome is not None, 15.0)
        return job.outcome is not None and job.outcome.ok

    def jump(self, seq):
        to = self.site.vehicle.address
        self.fleet.send(self.site.system, [dialect.MAVLink_mission_set_current_message(to.system, to.component, seq)])

    def store(self, mission):
        vehicle = self.fleet.vehicles[self.site.system]
        self.site.place.until(lambda: vehicle.detector.phase is not Phase.ACTIVE, 10.0)  # it hears of a pause later
        job = self.fleet.upload(self.site.system, mission)
        assert self.site.place.until(lambda: job.outcome is not None, 60.0) and job.outcome.ok, job.outcome

    def moves(self):
        assert self.mode("ready")
        self._reposition(*self.site.chart.to_degrees(400.0, 0.0), 0.0)

    def _reposition(self, lat, lon, lower_m):
        copter, vehicle = self.site.vehicle.autopilot is AP, self.site.vehicle
        to, up = vehicle.address, vehicle.height_m - lower_m if copter else vehicle.alt_m - lower_m
        go = dialect.MAVLink_command_int_message(
            to.system, to.component, 6 if copter else 5, dialect.MAV_CMD_DO_REPOSITION, 0, 0, -1, 1, 0, math.nan,
            round(lat * 1e7), round(lon * 1e7), up,
        )  # fmt: skip
        self.fleet.send(self.site.system, [go])

    def sinks(self):
        """A joystick in place of a remote control, throttle at the bottom; PX4 flies by none here and is sent down."""
        if self.site.vehicle.autopilot is PX4:
            self._reposition(self.site.vehicle.lat_deg, self.site.vehicle.lon_deg, 30.0)
            return
        self._sticks()
        self.site.place.during = self._sticks
        assert self.send(dialect.MAV_CMD_DO_SET_MODE, *mode_params(AP, self.manual))

    def _sticks(self):
        to, values = self.site.vehicle.address, (1500, 1500, 1200, 1500, 0, 0, 0, 0)
        sticks = dialect.MAVLink_rc_channels_override_message(to.system, to.component, *values)
        self.fleet.send(self.site.system, [sticks])

    def failsafe(self):
        from tests.vehicles.autopilots.test_sitl_faults import Parameters

        self.parameters = Parameters(self.site)
        if self.site.vehicle.autopilot is AP:
            self.parameters.set(BATT_FS_LOW_ACT=2, BATT_LOW_VOLT=11.0, SIM_BATT_VOLTAGE=10.5)
        else:
            self.parameters.set(COM_LOW_BAT_ACT=3)
            self.parameters.set(SIM_BAT_MIN_PCT=6, SIM_BAT_DRAIN=1)

    def end(self):
        self.site.place.during = lambda: None
        if hasattr(self, "parameters"):
            self.site.home()
            self.parameters.restore()
        self.site.place.others = []
        self.fleet.close()


class RealPair(Real):
    """A real autopilot, with what is polled besides our station."""

    others, during = (), staticmethod(lambda: None)

    def until(self, done, limit_s):
        end, at = time.monotonic() + limit_s, 0.0
        while not done():
            now = time.monotonic()
            if now >= end:
                return False
            if now >= at:
                at = now + 0.1
                self.during()
            self.fleet.poll(0.02)
            for fleet in self.others:
                fleet.poll(0.0)
        return True


def calm(place):
    """On the ground out of the mode that an earlier test left it in: in RTL PX4 is not ready to arm."""
    assert place.until(lambda: bool(place.fleet.vehicles), 60.0)
    (vehicle,) = place.fleet.vehicles.values()
    place.until(lambda: bool(vehicle.landed), 20.0)
    if not vehicle.armed and vehicle.custom_mode != vehicle.modes.ready:
        job = place.fleet.begin(vehicle.pilot.set_mode(vehicle.modes.ready))
        place.until(lambda: job.outcome is not None, 15.0)


@pytest.fixture(params=PLACES)
def pair(request):
    kind, what = request.param
    if kind is Simulated:
        site = Site(Simulated(what))
        other = Beside(site)
    else:
        place = RealPair(what)
        try:
            calm(place)
            site = Site(place)
            site.charge()
            other = Apart(site, further_link(what))
        except BaseException:
            place.close()
            raise
    try:
        yield site, other
        other.end()
        site.home()
    finally:
        site.place.close()


def loaded(site, **options):
    mission = site.mission(HOME, **options)
    outcome = site.finish(site.fleet.upload(site.system, mission))
    assert outcome.ok, outcome
    site.place.until(lambda: False, 1.5)  # PX4 looks at a new mission first
    return mission


def waiting(site, mission):
    """A planned start, as it is given; it is sent later."""
    then = site.vehicle.standing

    def due():
        order = Order(verb="start", system=site.system, given_s=site.fleet._clock(), standing=then, mission=mission)
        site.fleet.order(order)
        site.place.until(lambda: order.outcome is not None, 120.0)
        return order.outcome

    return due


def word(site):
    return flight_state(site.vehicle).word


def stays_down(site, outcome, *words):
    assert not outcome.ok and outcome.verdict in (Verdict.REFUSED, Verdict.NOT_SENT), outcome
    assert any(w in outcome.text for w in words), outcome.text
    stands_m = site.vehicle.height_m  # a barometer drifts by a metre within an hour
    site.place.until(lambda: False, 5.0)
    assert not site.vehicle.armed and abs(site.vehicle.height_m - stands_m) < 1.0
    print(outcome.text)


def flying(site, **options):
    mission = loaded(site, **options)
    outcome = waiting(site, mission)()
    assert outcome.ok, outcome
    site.follow(lambda: word(site) is Word.ON_MISSION, 120.0)
    return mission


def test_a_return_given_elsewhere_ends_a_waiting_takeoff(pair):
    site, other = pair
    assert other.mode("ready")
    mission = loaded(site)
    due = waiting(site, mission)
    assert other.send(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    site.place.until(lambda: False, 4.0)
    stays_down(site, due(), "was put into RTL", "was commanded")


def test_a_mode_that_was_changed_and_changed_back_ends_a_waiting_takeoff(pair):
    site, other = pair
    assert other.mode("ready")
    mission = loaded(site)
    before, due = site.vehicle.custom_mode, waiting(site, mission)
    assert other.mode("rtl")
    site.place.until(lambda: False, 2.5)
    assert other.send(dialect.MAV_CMD_DO_SET_MODE, *mode_params(site.vehicle.autopilot, before))
    site.place.until(lambda: False, 2.5)
    stays_down(site, due(), "was commanded by someone else", "was put into")


def test_a_mission_replaced_while_a_takeoff_waits_is_not_flown(pair):
    site, other = pair
    checked = loaded(site)
    due = waiting(site, checked)
    moved = [replace(i, x=i.x + 30_000) if i.command == WAYPOINT and k else i for k, i in enumerate(checked.items)]
    other.store(type(checked)(checked.autopilot, tuple(moved)))  # as many items, 333 m north
    site.place.until(lambda: False, 2.0)
    stays_down(site, due(), "no longer holds the mission that was checked")


def test_a_vehicle_that_is_returned_before_it_left_the_ground_has_not_taken_off(pair):
    site, other = pair
    mission = loaded(site)
    order = Order(
        verb="start", system=site.system, given_s=site.fleet._clock(), standing=site.vehicle.standing, mission=mission
    )
    site.fleet.order(order)
    assert site.place.until(lambda: order.begun_s is not None or order.outcome is not None, 60.0)
    assert order.outcome is None, order.outcome
    assert other.send(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    assert site.place.until(lambda: order.outcome is not None, 60.0)
    assert not order.outcome.ok and "did not take off" in order.outcome.text
    print(order.outcome.text)
    assert site.place.until(lambda: not site.vehicle.armed, 120.0)


@pytest.mark.parametrize("who", ["operator", "failsafe"])
def test_a_paused_return_is_resumed_as_a_return(pair, who):
    site, other = pair
    flying(site, legs=8)
    assert site.place.until(lambda: site.vehicle.mission_seq >= 6, 60.0)
    if who == "operator":
        assert other.send(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    else:
        other.failsafe()
    assert site.place.until(lambda: word(site) is Word.RETURNING, 60.0)
    site.place.until(lambda: False, 2.0)
    assert site.finish(site.fleet.pause(site.system)).ok
    assert site.place.until(lambda: word(site) is Word.PAUSED, 20.0), flight_state(site.vehicle)
    assert "RTL" in flight_state(site.vehicle).text
    if who == "failsafe":
        assert "ailsafe" in danger_of(site.vehicle) and site.vehicle.had_failsafe, danger_of(site.vehicle)
        print(danger_of(site.vehicle))
    site.place.until(lambda: False, 3.0)
    assert site.finish(site.fleet.resume(site.system)).ok
    words = site.follow(lambda: not site.vehicle.armed, 200.0)
    assert "returning" in words and "on mission" not in words, words


def test_going_on_with_a_mission_after_a_return_is_a_command_of_its_own(pair):
    site, other = pair
    flying(site, legs=8)
    assert site.place.until(lambda: site.vehicle.mission_seq >= 6, 60.0)
    assert other.send(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    assert site.place.until(lambda: word(site) is Word.RETURNING, 30.0)
    assert site.finish(site.fleet.pause(site.system)).ok
    assert site.place.until(lambda: word(site) is Word.PAUSED, 20.0)
    order = site.fleet.order(Order(verb="continue", system=site.system, given_s=site.fleet._clock()))
    assert site.place.until(lambda: order.outcome is not None, 20.0) and order.outcome.ok, order.outcome
    words = site.follow(lambda: "complete" in site.kinds(), 300.0)
    assert words[-1] in ("on mission", "returning", "landing", "complete", "on ground"), words


def test_a_word_comes_from_motion(pair):
    site, other = pair
    flying(site, height=40.0)
    assert site.finish(site.fleet.pause(site.system)).ok
    assert site.place.until(lambda: word(site) is Word.PAUSED, 30.0)
    other.moves()
    words = site.follow(lambda: math.hypot(*site.vehicle.velocity_m_s[:2]) > 3.0, 30.0)
    words += site.follow(lambda: word(site) is Word.FLYING, 6.0)
    assert "GUIDED" in flight_state(site.vehicle).text or "HOLD" in flight_state(site.vehicle).text
    print(words, flight_state(site.vehicle).text)
    assert site.finish(site.fleet.pause(site.system)).ok  # PX4 is in HOLD already, and flies on in it
    site.follow(lambda: word(site) is Word.PAUSED and math.hypot(*site.vehicle.velocity_m_s[:2]) < 0.5, 30.0)
    other.sinks()
    words = site.follow(lambda: word(site) is Word.DESCENDING, 30.0)
    assert "nobody ordered it" in danger_of(site.vehicle)
    assert site.place.until(lambda: any(e.kind == "danger" for e in site.place.events[site.begun :]), 5.0)
    print(words, danger_of(site.vehicle))


def test_a_station_that_comes_later_reads_what_is_flown(pair):
    site, other = pair
    mission = flying(site)
    if isinstance(other, Apart):
        later, clock = other.fleet, None
    else:
        site.fleet.vehicles[site.system].mission, clock = None, site.fleet._clock()
        site.vehicle.detector._commands, site.vehicle.read_at, later = None, 0.0, site.fleet
    vehicle = later.vehicles[site.system]
    assert site.place.until(lambda: vehicle.mission is not None, 15.0), clock
    assert len(vehicle.mission) == len(mission)
    words = []

    def look():
        now = flight_state(vehicle)
        if words[-1:] != [now.word.value]:
            words.append(now.word.value)
        return not vehicle.armed

    assert site.place.until(look, 300.0)
    assert "paused" not in words and "returning" in words and "landing" in words, words
    print(words)


def test_a_last_item_that_another_station_makes_current_completes_nothing(pair):
    site, other = pair
    flying(site, legs=4)
    final = site.vehicle.detector.final_seq
    other.jump(final)
    site.follow(lambda: not site.vehicle.armed, 200.0)
    assert site.place.until(lambda: "aborted" in site.kinds(), 20.0), site.kinds()
    assert "complete" not in site.kinds()
    (ended,) = [e.text for e in site.place.events[site.begun :] if e.kind == "aborted"]
    assert "of 4 lines flown" in ended
    print(ended)


def test_another_mission_flown_during_a_pause_completes_nothing_of_the_plan(pair):
    site, other = pair
    checked = flying(site, legs=4)
    assert site.finish(site.fleet.pause(site.system)).ok
    assert site.place.until(lambda: word(site) is Word.PAUSED, 30.0)
    moved = [replace(i, x=i.x + 900) if i.command == WAYPOINT and k else i for k, i in enumerate(checked.items)]
    other.store(type(checked)(checked.autopilot, tuple(moved)))
    assert other.mode("mission")
    site.follow(lambda: not site.vehicle.armed, 400.0)
    site.place.until(lambda: False, 5.0)
    assert "aborted" in site.kinds(), site.kinds()
    ended = [e.text for e in site.place.events[site.begun :] if e.kind == "aborted"]
    assert "of 4 lines flown" in ended[0], ended
    print(site.kinds(), ended)


def test_resume_is_refused_where_nobody_knows_what_was_paused(pair):
    site, other = pair
    flying(site, legs=4)
    last = site.vehicle.detector.final_seq
    assert site.place.until(lambda: site.vehicle.mission_seq >= last - 4, 200.0)
    assert other.send(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    assert site.place.until(lambda: word(site) is Word.RETURNING, 30.0)

    def away():
        at = site.vehicle.lat_deg, site.vehicle.lon_deg
        return off_leg_m(site.vehicle.mission, site.vehicle.mission_seq, at) > 18.0

    assert site.place.until(away, 30.0)
    assert other.mode("hold")
    assert site.place.until(lambda: word(site) is Word.PAUSED, 20.0)
    site.vehicle.way = None  # as of a station that comes now
    with pytest.raises(OrthoSwarmError, match="may have been returning"):
        site.fleet.resume(site.system)


def test_a_pilot_takes_over_and_gives_it_back(pair):
    """LOITER and back to AUTO in the air, by a remote control or another station: nothing has ended."""
    site, other = pair
    flying(site, legs=3)
    assert site.finish(site.fleet.pause(site.system)).ok
    assert site.place.until(lambda: word(site) is Word.PAUSED, 30.0)
    assert other.mode("hold")
    site.place.until(lambda: False, 4.0)
    assert word(site) is Word.PAUSED
    assert other.mode("mission")
    words = site.follow(lambda: "complete" in site.kinds(), 300.0)
    assert "aborted" not in site.kinds() and "on mission" in words, (site.kinds(), words)
