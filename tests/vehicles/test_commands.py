"""Commands: one outcome each, never late, never held back where they end a flight; links merged, claimants named."""

import math
import socket
import threading
import time

import pytest

from gcs_plugin.fleet.commands import Order
from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.flight_state import flight_state, summary
from gcs_plugin.fleet.link_hub import Hub
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.links.transports import TcpLink
from gcs_plugin.mission.exchange import GROUND_STATION, Verdict
from gcs_plugin.mission.items import TAKEOFF, MissionItem
from gcs_plugin.sim.mission_flight import MissionFlight
from gcs_plugin.sim.simulated_swarm import Faults
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.model.errors import OrthoSwarmError
from tests.kit.vehicles.memory_link import SimLink, VirtualClock
from tests.vehicles.test_fleet import END, kinds, sent_by
from tests.vehicles.test_sim import mission

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])


def give(world, verb, system, given_s=None):
    return world.fleet.order(Order(verb=verb, system=system, given_s=world.clock.now if given_s is None else given_s))


def end_of(world, order, limit_s=30.0):
    world.until(lambda: order.outcome is not None, limit_s)
    return order.result()


def flying(make_world, autopilot, **faults):
    world = make_world(SimVehicle(system=1, autopilot=autopilot), **faults)
    world.meet()
    assert world.finish(world.fleet.upload(1, mission(autopilot, END)))[0].ok
    assert end_of(world, give(world, "start", 1)).outcome is Verdict.DONE
    world.wait(15.0)
    return world


# -- outcomes -----------------------------------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("verb", ["pause", "rtl", "land"])
def test_an_acknowledged_command_is_done(make_world, autopilot, verb):
    world = flying(make_world, autopilot)
    result = end_of(world, give(world, verb, 1))
    assert result.outcome is Verdict.DONE
    assert result.document().keys() == {"id", "vehicle", "command", "outcome", "reason"}
    assert result.document() | {"id": "", "reason": ""} == {
        "id": "", "vehicle": "v1", "command": verb, "outcome": "done", "reason": "",
    }  # fmt: skip
    if verb != "pause":
        world.until(lambda: not world.vehicles[1].flight.armed, 120.0)
        assert not world.vehicles[1].flight.armed


@BOTH
def test_a_start_that_is_refused_after_arming_leaves_no_motor_running(make_world, autopilot, monkeypatch):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    assert world.finish(world.fleet.upload(1, mission(autopilot, END)))[0].ok
    monkeypatch.setattr(MissionFlight, "start_mission", lambda _: "Auto: Missing Takeoff Cmd")
    result = end_of(world, give(world, "start", 1))
    assert result.outcome is Verdict.REFUSED and result.reason.endswith("it was disarmed again")
    assert "akeoff" in result.reason and not world.vehicles[1].flight.armed


@BOTH
def test_a_mission_without_a_takeoff_is_refused_before_arming(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    good = mission(autopilot, END)
    no_takeoff = type(good)(autopilot, tuple(item for item in good.items if item.command != TAKEOFF))
    assert world.finish(world.fleet.upload(1, no_takeoff))[0].ok
    sent = sent_by(world)
    result = end_of(world, give(world, "start", 1))
    assert result.outcome is Verdict.REFUSED and "instead of a takeoff" in result.reason
    assert dialect.MAV_CMD_COMPONENT_ARM_DISARM not in [getattr(m, "command", 0) for m in sent]


@BOTH
def test_a_pause_on_the_ground_is_refused(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    sent = sent_by(world)
    result = end_of(world, give(world, "pause", 1))
    assert result.outcome is Verdict.REFUSED and "not armed" in result.reason
    assert "COMMAND_LONG" not in [m.get_type() for m in sent]


def test_a_command_that_the_vehicle_does_not_answer_is_unknown_and_is_not_sent_late(make_world):
    world = flying(make_world, AP, down=Faults(silent=((30.0, 1e9),)), up=Faults(silent=((30.0, 60.0),)))
    world.wait(30.1 - world.clock.now)
    sent, given = sent_by(world), world.clock.now
    order = give(world, "rtl", 1)
    result = end_of(world, order)
    assert result.outcome is Verdict.UNKNOWN and "did not answer" in result.reason and "radio control" in result.reason
    assert world.clock.now - given <= 6.5
    count = sum(m.get_type() == "COMMAND_LONG" and m.command in (20, 176) for m in sent)
    assert count >= 5
    world.wait(40.0)  # the link is back
    assert sum(m.get_type() == "COMMAND_LONG" and m.command in (20, 176) for m in sent) == count


def test_a_command_that_was_held_up_is_not_sent(make_world):
    world = flying(make_world, AP)
    sent = sent_by(world)
    result = end_of(world, give(world, "rtl", 1, world.clock.now - 5.5))
    assert result.outcome is Verdict.NOT_SENT and "6 s ago" in result.reason
    assert "COMMAND_LONG" not in [m.get_type() for m in sent]


def test_a_command_to_a_vehicle_that_was_never_heard_is_not_sent(make_world):
    world = flying(make_world, AP)
    result = end_of(world, give(world, "rtl", 9))
    assert result.outcome is Verdict.NOT_SENT and "heard: 1" in result.reason


@pytest.mark.parametrize("verb", ["pause", "rtl", "land"])
def test_a_lost_vehicle_is_commanded_all_the_same(make_world, verb):
    """Its transmitter may be dead while its receiver hears."""
    world = flying(make_world, AP, down=Faults(silent=((30.0, 1e9),)))
    world.wait(38.0 - world.clock.now)
    assert world.fleet.vehicles[1].lost
    result = end_of(world, give(world, verb, 1))
    assert result.outcome is Verdict.UNKNOWN
    flight = world.vehicles[1].flight
    assert flight.mode == getattr(flight.modes, {"pause": "hold"}.get(verb, verb))


def test_rtl_gets_through_a_third_of_all_packets_lost(make_world):
    for seed in range(8):
        faults = {"up": Faults(loss=0.33, seed=seed), "down": Faults(loss=0.33, seed=seed + 50)}
        world = make_world(SimVehicle(system=1, autopilot=AP), **faults)
        world.meet()
        world.vehicles[1].flight.armed = True
        assert end_of(world, give(world, "rtl", 1)).outcome is Verdict.DONE


def test_a_start_that_is_under_way_is_carried_through(make_world):
    """Once armed a vehicle is not left standing with its motors on because five seconds are over."""
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    world.finish(world.fleet.upload(1, mission(AP, END)))
    order = give(world, "start", 1, world.clock.now - 4.0)
    assert end_of(world, order).outcome is Verdict.DONE


# -- two links, two claimants -------------------------------------------------------------------------------------


OPEN = []


@pytest.fixture(autouse=True)
def close_fleets():
    yield
    while OPEN:
        OPEN.pop().close()


class TwoLinks:
    """One vehicle, or several with one system id, on several links in memory."""

    def __init__(self, vehicles, downs):
        self.clock = VirtualClock()
        self.links = [SimLink([v], self.clock, Faults(), down) for v, down in zip(vehicles, downs, strict=True)]
        for number, link in enumerate(self.links):
            link.name = f"link{number}"
        self.fleet = Fleet(self.links, clock=self.clock, wall=self.clock.utc)
        self.events = []
        self.fleet.on_event(self.events.append)
        OPEN.append(self.fleet)

    def wait(self, seconds):
        end = self.clock.now + seconds
        while self.clock.now < end:
            self.clock.now += 0.02
            self.fleet.poll(0.0)

    def give(self, verb, system=1):
        order = self.fleet.order(Order(verb=verb, system=system, given_s=self.clock.now))
        self.wait(8.0)
        return order.result()


class Mirror(SimVehicle):
    """The second radio of a vehicle: the same clock and state, a link of its own."""

    def __init__(self, other):
        super().__init__(system=other.system, autopilot=other.autopilot)
        self.flight, self.store = other.flight, other.store

    def advance(self, now):
        stepped, self._stepped = self._stepped, now  # the other one flies it
        del stepped
        return super().advance(now)


def test_one_vehicle_on_two_links_is_one_vehicle_and_either_link_carries_its_commands():
    vehicle = SimVehicle(system=1, autopilot=AP)
    world = TwoLinks(
        [vehicle, Mirror(vehicle)], [Faults(silent=((20.0, 40.0),)), Faults(silent=((0.0, 5.0), (60.0, 1e9)))]
    )
    world.wait(18.0)
    known = world.fleet.vehicles[1]
    assert not known.claimants and len(known.routes.fresh(world.clock.now)) == 2
    assert known.route.address.startswith("link0")
    assert world.give("land").outcome is Verdict.DONE
    world.wait(4.0)
    assert not known.lost and known.route.address.startswith("link1")  # the other one has taken over
    assert world.give("rtl").outcome is Verdict.DONE
    world.wait(65.0 - world.clock.now)
    assert not known.lost and known.route.address.startswith("link0")
    assert world.give("rtl").outcome is Verdict.DONE
    assert "conflict" not in kinds(world.events) and "lost" not in kinds(world.events)
    assert kinds(world.events).count("link") == 2


def test_the_link_that_loses_less_carries_the_commands():
    vehicle = SimVehicle(system=1, autopilot=AP)
    world = TwoLinks([vehicle, Mirror(vehicle)], [Faults(loss=0.5, seed=4), Faults()])
    world.wait(30.0)
    assert world.fleet.vehicles[1].route.address.startswith("link1")


def test_a_text_on_two_links_is_said_once():
    vehicle = SimVehicle(system=1, autopilot=AP)
    world = TwoLinks([vehicle, Mirror(vehicle)], [Faults(), Faults()])
    world.wait(5.0)
    text = dialect.MAVLink_statustext_message(4, b"PreArm: compass")
    for link in world.links:
        link._say(0, [text], world.clock.now)
    world.wait(1.0)
    assert [e.text for e in world.events if "compass" in e.text] == ["vehicle 1 says: PreArm: compass"]


def two_claimants():
    late = SimVehicle(system=1, autopilot=AP)
    world = TwoLinks([SimVehicle(system=1, autopilot=AP), late], [Faults(), Faults()])
    world.wait(20.0)
    late.reboot(world.clock.now, 1.0)
    world.wait(10.0)
    return world


@pytest.mark.parametrize("verb", ["rtl", "land"])
def test_with_two_claimants_the_command_goes_to_both(verb):
    world = two_claimants()
    both = [link.vehicles[0] for link in world.links]
    for vehicle in both:
        vehicle.flight.armed = True
    assert world.fleet.vehicles[1].claimants == ("link0 number 0", "link1 number 0")
    assert world.give(verb).outcome is Verdict.DONE
    assert [v.flight.mode for v in both] == [getattr(v.flight.modes, verb) for v in both]


def test_claimants_are_named_and_the_verdict_expires():
    world = two_claimants()
    with pytest.raises(OrthoSwarmError, match="link0 number 0, link1 number 0"):
        world.fleet.start(1)
    world.links[1].down.faults = Faults(silent=((0.0, 1e9),))
    world.wait(15.0)
    assert world.fleet.vehicles[1].claimants == ()
    assert [k for k in kinds(world.events) if k in ("conflict", "single")] == ["conflict", "single"]


def test_three_restarts_in_nine_seconds_hold_nothing_back(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.wait(60.0)
    for _ in range(3):
        world.vehicles[1].reboot(world.clock.now, 0.5)
        world.wait(3.0)
        world.vehicles[1].flight.armed = True
        assert end_of(world, give(world, "rtl", 1), 3.0).outcome is Verdict.DONE
    world.wait(15.0)
    assert world.fleet.vehicles[1].claimants == ()


# -- what comes in ------------------------------------------------------------------------------------------------


def impossible():
    return [
        dialect.MAVLink_global_position_int_message(1, 1234567890, 85000000, 500000, 0, 0, 0, 0, 0),
        dialect.MAVLink_global_position_int_message(1, 480000000, 2000000000, 500000, 0, 0, 0, 0, 0),
        dialect.MAVLink_global_position_int_message(1, 480000000, 85000000, 2147483647, 0, 0, 0, 0, 0),
        dialect.MAVLink_attitude_message(1, math.nan, 0.0, 0.0, 0.0, 0.0, 0.0),
        dialect.MAVLink_attitude_message(1, 0.0, math.inf, 0.0, 0.0, 0.0, 0.0),
        dialect.MAVLink_gps_raw_int_message(1, 3, -950000000, 0, 0, 0, 0, 0, 0, 9),
        dialect.MAVLink_camera_feedback_message(1, 1, 0, 1, 1800000000, 0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0, 0),
        dialect.MAVLink_camera_feedback_message(1, 1, 0, 1, 1, 1, math.nan, 1.0, 0.0, 0.0, 0.0, 0.0, 0, 0),
    ]


@pytest.mark.parametrize("number", range(len(impossible())))
def test_impossible_values_do_not_leave_the_fleet(make_world, number):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    vehicle, seen = world.fleet.vehicles[1], []
    before = summary(vehicle, world.clock.now)
    message = impossible()[number]
    world.fleet.subscribe(lambda v, m, utc: seen.append(m), message.get_type())
    world.vehicles[1]._rates = {}
    world.wait(2.0)
    seen.clear()
    world.link._say(0, [message], world.clock.now)
    world.wait(0.1)
    assert seen == [] and vehicle.impossible == 1
    after = summary(vehicle, world.clock.now)
    for key in ("lat_deg", "lon_deg", "height_m", "gps_fix", "photos", "heading_deg"):
        assert after[key] == before[key]


# -- bells and lines ----------------------------------------------------------------------------------------------


def test_a_bell_that_nobody_hears_does_not_block():
    hub = Hub([], GROUND_STATION)
    work = threading.Thread(target=lambda: [hub.post(lambda: None) for _ in range(20_000)], daemon=True)
    work.start()
    work.join(120.0)
    assert not work.is_alive()
    done = []
    hub.post(lambda: done.append(True))
    hub.poll(1.0, None)
    assert done == [True]
    hub.close()


def test_a_packet_that_waits_for_a_stalled_line_is_thrown_away_once_it_is_late():
    import selectors

    with socket.create_server(("127.0.0.1", 0)) as server:
        link, selector = TcpLink("tcp", *server.getsockname()), selectors.DefaultSelector()
        link.open(selector, 0.0)
        other, _ = server.accept()
        (stream,) = link._streams.values()
        stream.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        stall = b"s" * 20_000
        for key, events in selector.select(60.0):
            list(link.receive(key.fileobj, events, 0.0))
        while len(stream.pending) <= len(stall):  # nothing more goes out, not even a byte
            assert link.send(stream, stall)
        soon = time.monotonic() + 0.05
        assert link.send(stream, b"RTL!", soon) and link.send(stream, b"later", math.inf)
        time.sleep(0.1)
        other.settimeout(60.0)
        got = b""
        while not got.endswith(b"later"):
            for key, events in selector.select(0.05):
                list(link.receive(key.fileobj, events, 0.0))
            got += other.recv(1 << 20)
        assert b"RTL!" not in got and len(got) % len(stall) == len(b"later")
        link.close()
        other.close()


# -- what a vehicle is doing --------------------------------------------------------------------------------------


@BOTH
def test_a_flight_in_words(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    vehicle = world.fleet.vehicles[1]
    assert flight_state(vehicle).text == "on ground"
    world.finish(world.fleet.upload(1, mission(autopilot, END)))
    end_of(world, give(world, "start", 1))
    words = []

    def follow(done, limit_s):
        def look():
            state = flight_state(vehicle)
            if words[-1:] != [state.word.value]:
                words.append(state.word.value)
            return done()

        assert world.until(look, limit_s), words

    follow(lambda: flight_state(vehicle).word.value == "on mission" and vehicle.mission_seq >= 5, 100.0)
    assert flight_state(vehicle).text == f"on mission {flight_state(vehicle).item}/{flight_state(vehicle).items}"
    assert end_of(world, give(world, "pause", 1)).outcome is Verdict.DONE
    world.wait(6.0)
    assert flight_state(vehicle).word.value == "paused"
    assert end_of(world, give(world, "resume", 1)).outcome is Verdict.DONE
    follow(lambda: not vehicle.armed, 300.0)
    follow(lambda: flight_state(vehicle).word.value == "complete", 10.0)
    assert [w for w in words if w in ("taking off", "returning", "landing")] == ["taking off", "returning", "landing"]
    assert words[-1] == "complete" and words.index("returning") > words.index("on mission")


def test_px4_is_returning_and_not_complete_while_it_flies_home(make_world):
    world = make_world(SimVehicle(system=1, autopilot=PX4))
    world.meet()
    world.finish(world.fleet.upload(1, mission(PX4, END)))
    end_of(world, give(world, "start", 1))
    assert world.until(lambda: "complete" in world.kinds(1), 300.0)  # its refinement may begin
    vehicle = world.fleet.vehicles[1]
    assert vehicle.flying and flight_state(vehicle).word.value == "returning"
    assert summary(vehicle, world.clock.now)["flight"]["state"] == "returning"
    world.until(lambda: not vehicle.armed, 200.0)
    assert flight_state(vehicle).word.value == "complete"


@BOTH
@pytest.mark.parametrize("verb", ["rtl", "land"])
def test_a_vehicle_that_is_sent_home_is_not_paused_until_its_heartbeat_tells_the_new_mode(make_world, autopilot, verb):
    world = flying(make_world, autopilot)
    vehicle = world.fleet.vehicles[1]
    world.until(lambda: flight_state(vehicle).word.value == "on mission", 60.0)
    words = set()

    def look():
        words.add(flight_state(vehicle).word.value)
        return False

    order = give(world, verb, 1)
    world.until(look, 5.0)
    assert order.result().outcome is Verdict.DONE
    assert "paused" not in words and words & {"returning", "landing"}


def test_a_silent_vehicle_is_lost_in_words(make_world):
    world = flying(make_world, AP, down=Faults(silent=((30.0, 1e9),)))
    world.wait(40.0 - world.clock.now)
    assert flight_state(world.fleet.vehicles[1]).text == "lost"


def test_a_wait_that_the_mission_asks_for_is_no_pause(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    hold = MissionItem.do(dialect.MAV_CMD_NAV_DELAY, 30.0)
    world.finish(world.fleet.upload(1, mission(AP, hold, END)))
    end_of(world, give(world, "start", 1))
    vehicle = world.fleet.vehicles[1]
    assert world.until(lambda: vehicle.still_s > 10.0 and vehicle.flying, 200.0)
    assert flight_state(vehicle).word.value == "on mission"


# -- vehicles that do not hover -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "word"), [(dialect.MAV_TYPE_FIXED_WING, "fixed wing"), (dialect.MAV_TYPE_GROUND_ROVER, "ground rover")]
)
def test_a_vehicle_that_does_not_hover_gets_no_mission_and_is_brought_home_all_the_same(make_world, kind, word):
    world = make_world(SimVehicle(system=1, autopilot=AP, kind=int(kind)))
    world.meet()
    with pytest.raises(OrthoSwarmError, match=rf"vehicle 1 is not a multirotor \({word}\)"):
        world.fleet.upload(1, mission(AP, END))
    result = end_of(world, give(world, "start", 1))
    assert result.outcome is Verdict.REFUSED and word in result.reason
    world.vehicles[1].flight.armed = True
    world.wait(2.0)
    assert end_of(world, give(world, "rtl", 1)).outcome is Verdict.DONE


# -- signing ------------------------------------------------------------------------------------------------------


def test_a_station_without_the_key_is_told_that_it_needs_one(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    world.fleet.vehicles[1].signs = True
    world.link.up.faults = Faults(loss=1.0)
    world.vehicles[1].flight.armed = True
    world.wait(2.0)
    result = end_of(world, give(world, "rtl", 1))
    assert result.outcome is Verdict.UNKNOWN and "--signing-key" in result.reason
