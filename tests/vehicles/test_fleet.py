"""The fleet over simulated vehicles: found and lost, streams, routing, faults, commands, nothing sent unasked."""

import json
import math
import threading
import time
from random import Random

import pytest

from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.flight_state import summary
from gcs_plugin.fleet.routes import BootClock, Routes
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.links.packets import Framer, checksum
from gcs_plugin.links.transports import UdpLink
from gcs_plugin.mission.completion import CompletionDetector
from gcs_plugin.mission.exchange import Address
from gcs_plugin.mission.items import RTL, MissionItem
from gcs_plugin.sim.simulated_swarm import Faults, SimSwarm, make_swarm
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.model.errors import InputError, OrthoSwarmError
from tests.kit.vehicles.telemetry_log import read_tlog
from tests.vehicles.test_sim import mission

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])
END = MissionItem.do(RTL)


def sent_by(world):
    """Everything that the fleet has put on the link from now on, decoded."""
    messages, put = [], world.link.send

    def send(peer, data, expires=math.inf):
        messages.extend(packet.message for packet in Framer().feed(data))
        return put(peer, data, expires)

    world.link.send = send
    return messages


def kinds(events):
    return [event.kind for event in events if event.kind != "text"]


def test_streams_run_at_the_rates_asked_for_on_both_autopilots(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP), SimVehicle(system=2, autopilot=PX4))
    world.meet()
    counts = {}
    world.fleet.subscribe(
        lambda v, m, utc: counts.__setitem__((v.system, m.get_type()), counts.get((v.system, m.get_type()), 0) + 1)
    )
    world.wait(10.0)
    for system in (1, 2):
        assert counts[system, "GLOBAL_POSITION_INT"] == pytest.approx(100, abs=2)
        assert counts[system, "ATTITUDE"] == pytest.approx(100, abs=2)
        assert counts[system, "MISSION_CURRENT"] == pytest.approx(20, abs=1)
    assert world.fleet.vehicles[1].streams.refused == {132, 285}  # rangefinder, gimbal; PX4's filter is not asked of it
    assert sum(vehicle.missed for vehicle in world.fleet.vehicles.values()) == 0


def test_streams_that_stop_are_asked_for_again(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    world.vehicles[1]._stream(33, 0.0)  # another ground station switched it off
    world.wait(3.5)
    before = world.fleet.vehicles[1].time_boot_s
    world.wait(6.0)
    assert world.fleet.vehicles[1].time_boot_s > before + 2.0


def test_streams_are_asked_for_through_heavy_loss(make_world):
    for seed in range(4):
        world = make_world(
            SimVehicle(system=1, autopilot=AP), up=Faults(loss=0.5, seed=seed), down=Faults(loss=0.5, seed=seed + 9)
        )
        world.wait(30.0)
        vehicle = world.fleet.vehicles[1]
        received = vehicle.received
        world.wait(10.0)
        assert (vehicle.received - received) / 10.0 > 10.0
        assert vehicle.missed > 0


def test_a_silent_vehicle_is_lost_and_found_again(make_world):
    world = make_world(
        SimVehicle(system=1, autopilot=AP), down=Faults(silent=((10.0, 20.0),)), up=Faults(silent=((10.0, 20.0),))
    )
    world.wait(8.0)
    assert kinds(world.events) == ["found"]
    world.wait(9.0)
    assert kinds(world.events) == ["found", "lost"]
    assert summary(world.fleet.vehicles[1], world.clock.now)["state"] == "lost"
    with pytest.raises(OrthoSwarmError, match="lost"):
        world.fleet.start(1)
    world.wait(6.0)
    assert kinds(world.events) == ["found", "lost", "regained"]


@BOTH
def test_a_restart_is_noticed_and_streams_run_again(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    world.wait(20.0)
    world.vehicles[1].reboot(world.clock.now, 2.0)
    world.wait(6.0)
    assert "rebooted" in kinds(world.events)
    before = world.fleet.vehicles[1].received
    world.wait(5.0)
    assert world.fleet.vehicles[1].received - before > 80


@BOTH
def test_an_upload_survives_a_restart_in_its_middle(make_world, autopilot):
    delay = Faults(delay_s=(0.05, 0.06))
    world = make_world(SimVehicle(system=1, autopilot=autopilot), up=delay, down=delay)
    world.meet()
    world.wait(20.0)
    loaded = mission(autopilot, END)
    upload = world.fleet.upload(1, loaded)
    world.until(lambda: upload._served >= 0.3 * len(loaded) - 1)
    world.vehicles[1].reboot(world.clock.now, 2.0)
    assert world.finish(upload)[0].ok
    assert len(world.vehicles[1].store.items) == len(loaded)


@BOTH
def test_a_whole_flight_over_a_link_that_loses_thirty_percent(make_world, autopilot):
    for seed in range(3):
        bad = [Faults(loss=0.3, duplicate=0.1, delay_s=(0.0, 0.2), seed=seed + k) for k in (0, 50)]
        world = make_world(SimVehicle(system=1, autopilot=autopilot), up=bad[0], down=bad[1])
        world.until(lambda w=world: 1 in w.fleet.vehicles, 30.0)
        world.wait(5.0)
        assert world.finish(world.fleet.upload(1, mission(autopilot, END)))[0].ok
        tries = (world.finish(world.fleet.start(1))[0] for _ in range(3))  # what cannot be read in time is not started
        assert any(outcome.ok for outcome in tries)
        world.until(lambda w=world: "complete" in w.kinds(1), 300.0)
        world.wait(90.0)
        assert world.kinds(1).count("complete") == 1
        assert world.kinds(1).count("aborted") == 0


def test_nothing_that_moves_a_vehicle_is_sent_unasked(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP), SimVehicle(system=2, autopilot=PX4))
    sent = sent_by(world)
    world.meet()
    world.wait(30.0)
    world.vehicles[1].reboot(world.clock.now)
    world.wait(20.0)
    assert {m.get_type() for m in sent} == {"HEARTBEAT", "COMMAND_LONG"}
    assert {m.command for m in sent if m.get_type() == "COMMAND_LONG"} == {dialect.MAV_CMD_SET_MESSAGE_INTERVAL}
    # an upload adds the mission protocol, and still no command
    sent.clear()
    world.finish(*[world.fleet.upload(s, mission(a, END)) for s, a in ((1, AP), (2, PX4))])
    world.wait(10.0)
    assert {m.get_type() for m in sent} - {"HEARTBEAT"} <= {
        "MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_REQUEST_LIST", "MISSION_REQUEST_INT", "MISSION_ACK",
    }  # fmt: skip


def test_commands_go_to_one_vehicle_only(make_world):
    world = make_world(*[SimVehicle(system=system, autopilot=AP) for system in (1, 2, 3)])
    world.meet()
    sent = sent_by(world)
    world.finish(world.fleet.rtl(2))
    commands = [m for m in sent if m.get_type() == "COMMAND_LONG"]
    assert commands and all(m.target_system == 2 for m in commands)
    assert [sim.flight.mode for sim in world.vehicles.values()] == [0, 6, 0]


def test_what_cannot_be_done_is_said(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    fleet = world.fleet
    with pytest.raises(OrthoSwarmError, match="not on the links \\(heard: 1\\)"):
        fleet.start(9)
    with pytest.raises(OrthoSwarmError, match="built for px4"):
        fleet.upload(1, mission(PX4, END))
    (outcome,) = world.finish(fleet.start(1))
    assert not outcome.ok and "has no mission" in outcome.text
    upload = fleet.upload(1, mission(AP, END))
    with pytest.raises(OrthoSwarmError, match="busy"):
        fleet.upload(1, mission(AP, END))
    assert world.finish(upload)[0].ok
    assert world.finish(fleet.start(1))[0].ok
    world.wait(3.0)
    for forbidden in (lambda: fleet.start(1), lambda: fleet.upload(1, mission(AP, END))):
        with pytest.raises(OrthoSwarmError, match="flying its mission"):
            forbidden()


def test_rtl_goes_before_a_start_under_way(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP, ready_s=1e9))
    world.meet()
    world.finish(world.fleet.upload(1, mission(AP, END)))
    start = world.fleet.start(1)
    world.wait(2.0)
    rtl = world.fleet.rtl(1)
    assert not start.outcome.ok and "another command" in start.outcome.text
    assert world.finish(rtl)[0].ok
    world.wait(90.0)
    assert not world.vehicles[1].flight.armed


def test_the_swarm_flies_and_each_vehicle_completes_once(make_world):
    autopilots = [AP, PX4] * 4
    world = make_world(
        *[SimVehicle(system=number + 1, autopilot=autopilot) for number, autopilot in enumerate(autopilots)]
    )
    world.meet()
    fleet = world.fleet
    uploads = [fleet.upload(s, mission(v.autopilot, END, legs=1)) for s, v in fleet.vehicles.items()]
    assert all(outcome.ok for outcome in world.finish(*uploads))
    assert all(outcome.ok for outcome in world.finish(*[fleet.start(s) for s in fleet.vehicles]))
    world.until(lambda: all("complete" in world.kinds(s) for s in fleet.vehicles), 300.0)
    world.wait(60.0)
    assert all(world.kinds(s) == ["started", "complete"] for s in fleet.vehicles)
    assert all(vehicle.photos == 6 for vehicle in fleet.vehicles.values())


def test_two_vehicles_with_one_system_id_are_named_and_not_started(make_world):
    late = SimVehicle(system=1, autopilot=AP)
    world = make_world(SimVehicle(system=1, autopilot=AP), late)
    world.wait(20.0)
    late.reboot(world.clock.now, 1.0)  # now their clocks differ, as those of two vehicles do
    world.wait(10.0)
    assert "conflict" in kinds(world.events)
    with pytest.raises(
        OrthoSwarmError, match="several vehicles use system id 1 \\(simulation number 0, simulation number 1"
    ):
        world.fleet.start(1)


def test_a_boot_clock_tells_restarts_from_late_copies():
    clock = BootClock()
    assert [clock.feed(t / 10, t / 10) for t in range(100)] == [""] * 100
    assert [clock.feed(2.0, 10.0), clock.feed(10.0, 10.1), clock.feed(3.0, 10.2), clock.feed(10.3, 10.3)] == [""] * 4
    assert [clock.feed(t / 10, 20 + t / 10) for t in range(4)].count("rebooted") == 1
    mixed = [clock.feed(t / 10 + (100 if t % 2 else 0), 30 + t / 10) for t in range(100)]
    assert "mixed" in mixed and "rebooted" not in mixed


def test_a_restart_that_comes_back_on_another_connection_is_noticed():
    side, routes = object(), Routes()
    first, _ = routes.heard(side, 1, 0.0)
    for k in range(100):
        first.clock.feed(300.0 + k / 10, k / 10)
    routes.heard(side, 1, 10.0)
    second, _ = routes.heard(side, 2, 10.5)  # another link, whose messages come late
    assert [second.clock.feed(305.0 + k / 10, 10.5 + k / 10) for k in range(9)] == [""] * 9
    assert routes.best is first
    third, changed = routes.heard(side, 3, 30.0)
    assert changed
    assert [third.clock.feed(2.0 + k / 10, 30.0 + k / 10) for k in range(9)].count("rebooted") == 1


def test_an_unsigned_world_is_not_believed(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP), key=bytes(32))
    world.wait(10.0)
    assert not world.fleet.vehicles and world.fleet.hub.rejected >= 9


@pytest.mark.parametrize("gone_s", [5.0, 120.0])
@BOTH
def test_a_restarted_station_misses_and_doubles_no_completion(make_world, autopilot, gone_s):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    world.finish(world.fleet.upload(1, mission(autopilot, END)))
    world.finish(world.fleet.start(1))
    world.wait(20.0)
    state = json.loads(json.dumps(world.fleet.vehicles[1].detector.state()))
    events = list(world.events)
    world.fleet.close()
    end = world.clock.now + gone_s
    while world.clock.now < end:  # nobody listens
        world.clock.now += 0.05
        for _ in world.link.receive(None, 1, world.clock.now):
            pass
    world.fleet = Fleet([world.link], clock=world.clock, wall=world.clock.utc)

    def heard(event):
        events.append(event)
        if event.kind == "found":  # as the daemon does
            world.fleet.vehicles[1].detector = CompletionDetector.from_state(state)

    world.fleet.on_event(heard)
    world.until(lambda: False, 150.0)
    assert [event.kind for event in events].count("complete") == 1


def test_no_message_of_any_content_breaks_the_fleet(make_world):
    """Links are open to everybody: each message of the dialect with random content, under a vehicle's name."""
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    random = Random(4)
    upload = world.fleet.upload(1, mission(AP, END))
    for number, kind in sorted(dialect.mavlink_map.items()):
        for size in (1, kind.unpacker.size):
            payload = random.randbytes(size)
            head = bytes([253, len(payload), 0, 0, random.randrange(256), 1, 1]) + number.to_bytes(3, "little")
            crc = checksum(head[1:] + payload + bytes([kind.crc_extra]))
            world.link.down.put((0, head + payload + crc.to_bytes(2, "little")), world.clock.now)
        world.wait(0.04)
    assert world.finish(upload)[0] is not None
    world.wait(10.0)
    assert not world.fleet.vehicles[1].lost
    json.dumps(summary(world.fleet.vehicles[1], world.clock.now))


def test_a_ground_station_beside_us_is_no_vehicle(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP), own=Address(250, 190))
    world.meet()
    other = dialect.MAVLink(None, 255, 190)
    raw = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(other)
    world.link.down.put((0, raw), world.clock.now)
    world.wait(1.0)
    assert list(world.fleet.vehicles) == [1]


def test_pictures_are_counted_once_though_reported_twice(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP), down=Faults(duplicate=1.0, seed=1))
    world.meet()
    world.finish(world.fleet.upload(1, mission(AP, END, legs=1)))
    world.finish(world.fleet.start(1))
    world.until(lambda: "complete" in world.kinds(1), 200.0)
    assert world.fleet.vehicles[1].photos == len(world.vehicles[1].exposures) == 6
    assert world.kinds(1) == ["started", "complete"]


def test_a_long_text_is_said_as_one(make_world):
    world = make_world(SimVehicle(system=1, autopilot=PX4))
    world.meet()
    long = "RTL: start return at 575 m (75 m above destination)"
    exact = "x" * 100
    for text in (long, exact, "short"):
        world.vehicles[1].flight.texts.append(text)
        world.wait(0.1)
    said = [event.text for event in world.events if event.kind == "text"]
    assert said == [f"vehicle 1 says: {text}" for text in (long, exact, "short")]


def test_a_long_text_whose_end_is_lost_is_said_as_far_as_it_is_known(make_world):
    world = make_world(SimVehicle(system=1, autopilot=PX4))
    world.meet()
    packer = dialect.MAVLink(None, 1, 1)
    for text, number, part in (("a" * 50, 7, 0), ("next", 0, 0)):
        raw = dialect.MAVLink_statustext_message(6, text.encode(), number, part).pack(packer)
        world.link.down.put((0, raw), world.clock.now)
        world.wait(0.1)
    said = [event.text for event in world.events if event.kind == "text"]
    assert said == [f"vehicle 1 says: {'a' * 50}", "vehicle 1 says: next"]


# --- real sockets ---


def wait_for(done, limit_s=200.0):
    end = time.monotonic() + limit_s
    while not done() and time.monotonic() < end:
        time.sleep(0.01)
    return done()


@pytest.mark.parametrize("together", [False, True])
def test_a_swarm_over_udp_is_flown_from_another_thread(tmp_path, together):
    link = UdpLink("udpin:127.0.0.1:0", "127.0.0.1", 0, listens=True)
    swarm = SimSwarm(
        make_swarm(3, autopilots=(AP, PX4)),
        f"udpout:127.0.0.1:{link.port}",
        together=together,
        speed=20.0,
        key=bytes(32),
    )
    stop, log = threading.Event(), tmp_path / "flight.tlog"
    with Fleet([link], key=bytes(32), tlog=log) as fleet, swarm:
        events = []
        fleet.on_event(events.append)
        thread = threading.Thread(target=fleet.run, args=(stop,))
        thread.start()
        try:
            assert wait_for(lambda: len(fleet.vehicles) == 3)
            for act in (
                lambda s: fleet.upload(s, mission(fleet.vehicles[s].autopilot, END, legs=1)),
                fleet.start,
            ):
                jobs = [fleet.call(lambda s=s, act=act: act(s)).result(120.0) for s in (1, 2, 3)]
                assert wait_for(lambda jobs=jobs: all(job.outcome for job in jobs))
                assert all(job.outcome.ok for job in jobs), [job.outcome for job in jobs]
            assert wait_for(lambda: sum(e.kind == "complete" for e in events) == 3)
            with pytest.raises(OrthoSwarmError, match="not on the links"):
                fleet.call(lambda: fleet.start(77)).result(120.0)
        finally:
            stop.set()
            thread.join()
    systems = {packet.system for _, packet in read_tlog(log)}
    assert systems == {1, 2, 3, 255}


def test_vehicles_that_serve_tcp_are_found():
    with SimSwarm(make_swarm(2, autopilots=(AP, PX4)), "tcpin:127.0.0.1:0") as swarm, Fleet(swarm.addresses) as fleet:
        assert fleet.run_until(lambda: len(fleet.vehicles) == 2, 200.0)
        assert fleet.run_until(lambda: all(v.lat_deg for v in fleet.vehicles.values()), 200.0)


def test_a_simulated_vehicle_can_be_silenced_and_restarted():
    link = UdpLink("udpin:127.0.0.1:0", "127.0.0.1", 0, listens=True)
    with (
        SimSwarm(make_swarm(1, autopilots=(PX4,)), f"udpout:127.0.0.1:{link.port}", speed=10.0) as swarm,
        Fleet([link]) as fleet,
    ):
        events = []
        fleet.on_event(events.append)
        assert fleet.run_until(lambda: bool(fleet.vehicles) and fleet.vehicles[1].time_boot_s > 14.0, 200.0)
        swarm.reboot(1, 1.0)
        assert fleet.run_until(lambda: "rebooted" in kinds(events), 200.0)
        swarm.silence(1, 5.0)
        received = fleet.vehicles[1].received
        fleet.run_until(lambda: False, 0.2)
        assert fleet.run_until(lambda: fleet.vehicles[1].received > received + 20, 200.0)


def test_simulated_vehicles_need_a_sensible_address_and_number():
    with pytest.raises(InputError, match="udpout"):
        SimSwarm(make_swarm(1), "udpin:127.0.0.1:0")
    with pytest.raises(InputError, match="1 to 250"):
        make_swarm(0)
