"""The simulated vehicles: they fly straight, lean as they accelerate, and end missions as real autopilots do."""

import math

import numpy as np
import pytest

from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.command_dialogues import Command
from gcs_plugin.mission.exchange import GROUND_STATION, Address
from gcs_plugin.mission.items import (
    CHANGE_SPEED,
    JUMP,
    LAND,
    LOITER_UNLIM,
    RTL,
    TAKEOFF,
    TRIGGER_DISTANCE,
    WAYPOINT,
    Mission,
    MissionItem,
)
from gcs_plugin.mission.track import flight_seconds, track_of
from gcs_plugin.sim.multirotor import Airframe, Chart
from gcs_plugin.sim.simulated_swarm import Channel, Faults
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.config import DEFAULT
from tests.kit.vehicles.memory_link import World

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])
ACK = int(dialect.MAVLINK_MSG_ID_COMMAND_ACK)
OPEN = []


def make_world(vehicles, *faults):
    OPEN.append(World(vehicles, *faults))
    return OPEN[-1]


@pytest.fixture(autouse=True)
def close_worlds():
    yield
    while OPEN:
        OPEN.pop().fleet.close()


def completed(world):
    return world.until(lambda: "complete" in world.kinds(1), 400.0)


CHART = Chart(47.397742, 8.545594, 488.0)


def listen(world, name):
    heard = []
    world.fleet.subscribe(lambda vehicle, message, utc: heard.append(message), name)
    return heard


def at(command, north, east, height=20.0, autopilot=AP):
    yaw = 0.0 if autopilot is AP else math.nan
    return MissionItem.at(command, *CHART.to_degrees(north, east), height, params=(0.0, 0.0, 0.0, yaw))


def mission(autopilot, *last, legs=2, length=60.0):
    items = [at(WAYPOINT, 0, 0)] if autopilot is AP else []
    items += [at(TAKEOFF, 0, 0, autopilot=autopilot), MissionItem.do(CHANGE_SPEED, 1, 8)]
    for leg in range(legs):
        ends = (0.0, length) if leg % 2 == 0 else (length, 0.0)
        items += [at(WAYPOINT, ends[0], 15.0 * leg, autopilot=autopilot), MissionItem.do(TRIGGER_DISTANCE, 10, 0, 1)]
        items += [at(WAYPOINT, ends[1], 15.0 * leg, autopilot=autopilot), MissionItem.do(TRIGGER_DISTANCE, 0)]
    return Mission(autopilot, (*items, *last))


def airborne(autopilot, *last, **options):
    """A world in which one vehicle has taken off with a mission."""
    world = make_world([SimVehicle(system=1, autopilot=autopilot)])
    world.meet()
    loaded = mission(autopilot, *last, **options)
    assert world.finish(world.fleet.upload(1, loaded))[0].ok
    outcome = world.finish(world.fleet.start(1))[0]
    assert outcome.ok, outcome
    return world


ENDINGS = {
    "rtl": (MissionItem.do(RTL),),
    "land": (at(LAND, 5, 5, 0.0),),
    "waypoint": (at(WAYPOINT, 5, 5),),
    "do": (at(WAYPOINT, 5, 5), MissionItem.do(TRIGGER_DISTANCE, 0)),
    "loiter": (at(LOITER_UNLIM, 5, 5),),
}


@pytest.mark.parametrize("ending", ["rtl", "land", "waypoint", "do"])
@BOTH
def test_a_flown_mission_completes_exactly_once(autopilot, ending):
    world = airborne(autopilot, *ENDINGS[ending])
    completed(world)
    world.wait(60.0)
    assert world.kinds(1) == ["started", "complete"]
    vehicle = world.fleet.vehicles[1]
    assert vehicle.armed == (ending in ("waypoint", "do"))


@BOTH
def test_loiter_unlimited_never_completes(autopilot):
    world = airborne(autopilot, *ENDINGS["loiter"])
    world.wait(200.0)
    assert world.kinds(1) == ["started"]
    assert world.finish(world.fleet.rtl(1))[0].ok
    world.wait(90.0)
    assert world.kinds(1) == ["started", "suspended", "aborted"]


@BOTH
def test_an_operators_rtl_is_no_completion(autopilot):
    world = airborne(autopilot, *ENDINGS["rtl"])
    world.wait(15.0)
    assert world.finish(world.fleet.rtl(1))[0].ok
    world.wait(90.0)
    assert world.kinds(1) == ["started", "suspended", "aborted"]
    assert not world.fleet.vehicles[1].armed


@BOTH
def test_the_stale_state_after_clear_and_upload_is_no_completion(autopilot):
    world = airborne(autopilot, *ENDINGS["rtl"], legs=1)
    completed(world)
    world.until(lambda: not world.fleet.vehicles[1].armed)
    world.fleet._dialogues.send(1, [dialect.MAVLink_mission_clear_all_message(1, 1, 0)])
    world.wait(2.0)
    assert world.finish(world.fleet.upload(1, mission(autopilot, *ENDINGS["rtl"])))[0].ok
    world.wait(5.0)
    assert world.fleet.vehicles[1].mission_state == 5  # stale, as measured
    assert world.kinds(1) == ["started", "complete"]
    assert world.finish(world.fleet.start(1))[0].ok
    world.wait(120.0)
    assert world.kinds(1) == ["started", "complete"] * 2


@BOTH
def test_pause_stops_and_resume_goes_on(autopilot):
    world = airborne(autopilot, *ENDINGS["rtl"], legs=1)
    sim = world.vehicles[1]
    world.until(lambda: len(sim.exposures) > 1)
    assert world.finish(world.fleet.pause(1))[0].ok
    world.wait(12.0)
    where, photos = sim.flight.motion.north, len(sim.exposures)
    world.wait(20.0)
    assert abs(sim.flight.motion.north - where) < 0.1 and len(sim.exposures) == photos
    assert world.finish(world.fleet.resume(1))[0].ok
    completed(world)
    assert world.kinds(1).count("complete") == 1
    assert len(sim.exposures) > photos


def test_arducopter_pauses_by_braking_where_it_cannot_pause():
    world = airborne(AP, *ENDINGS["rtl"])
    world.until(lambda: "started" in world.kinds(1), 5.0)
    assert world.finish(world.fleet.pause(1))[0].ok  # taking off: only BRAKE
    assert world.fleet.vehicles[1].mode == "BRAKE" or world.until(lambda: world.fleet.vehicles[1].mode == "BRAKE", 3.0)
    world.wait(2.0)
    assert world.finish(world.fleet.resume(1))[0].ok
    completed(world)
    assert world.kinds(1) == ["started", "suspended", "resumed", "complete"]


def test_a_list_without_home_loses_arducopters_takeoff():
    """Acknowledged, but MISSION_START would fail: `start` says so before it arms."""
    world = make_world([SimVehicle(system=1, autopilot=AP)])
    world.meet()
    px4_style = Mission(AP, mission(PX4, *ENDINGS["rtl"]).items)
    nan_free = tuple(
        MissionItem(command=i.command, frame=i.frame, params=(0, 0, 0, 0), x=i.x, y=i.y, z=i.z) for i in px4_style.items
    )
    assert world.finish(world.fleet.upload(1, Mission(AP, nan_free)))[0].ok
    world.fleet.vehicles[1].mission = None  # another program uploaded it
    (outcome,) = world.finish(world.fleet.start(1))
    assert not outcome.ok and "instead of a takeoff" in outcome.text
    assert not world.vehicles[1].flight.armed


def test_a_home_first_list_is_refused_by_px4_at_the_start():
    world = make_world([SimVehicle(system=1, autopilot=PX4)])
    world.meet()
    assert world.finish(world.fleet.upload(1, Mission(PX4, mission(AP, *ENDINGS["rtl"]).items)))[0].ok
    (outcome,) = world.finish(world.fleet.start(1))
    assert not outcome.ok and "instead of a takeoff" in outcome.text
    assert world.vehicles[1].flight.start_mission() == "Takeoff waypoint required"  # what PX4 itself says


def test_a_vehicle_that_is_not_ready_refuses_to_arm_and_says_why():
    world = make_world([SimVehicle(system=1, autopilot=AP, ready_s=20.0)])
    world.meet()
    world.finish(world.fleet.upload(1, mission(AP, *ENDINGS["rtl"])))
    (outcome,) = world.finish(world.fleet.start(1))
    assert not outcome.ok and "Arm: Need Position Estimate" in outcome.text
    world.wait(20.0)
    assert world.finish(world.fleet.start(1))[0].ok
    never = make_world([SimVehicle(system=1, autopilot=PX4, ready_s=1e9)])
    never.meet()
    never.finish(never.fleet.upload(1, mission(PX4, *ENDINGS["rtl"])))
    (outcome,) = never.finish(never.fleet.start(1))
    assert not outcome.ok and "refuses to arm" in outcome.text and "Waiting for estimator" in outcome.text


def test_a_jump_is_flown_as_often_as_it_says():
    jump = (MissionItem.do(JUMP, 5, 2), MissionItem.do(RTL))
    world = airborne(AP, *jump, legs=1)
    reached = listen(world, "MISSION_ITEM_REACHED")
    completed(world)
    assert [message.seq for message in reached].count(5) == 3
    assert world.kinds(1) == ["started", "complete"]


def test_arducopter_is_silent_until_asked_and_px4_is_not():
    said = {}
    for autopilot in (AP, PX4):
        vehicle = SimVehicle(system=1, autopilot=autopilot)
        vehicle.handle(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), GROUND_STATION, 0.0)
        said[autopilot] = [m.get_type() for t in range(100) for m in vehicle.advance(0.02 * t)]
    assert set(said[AP]) == {"HEARTBEAT"}
    assert said[PX4].count("GLOBAL_POSITION_INT") > 80


def test_legs_are_straight_and_pictures_evenly_spaced():
    world = airborne(PX4, *ENDINGS["rtl"], length=200.0, legs=2)
    sim = world.vehicles[1]
    completed(world)
    metres = np.array([CHART.to_metres(e.pose.lat_deg, e.pose.lon_deg) for e in sim.exposures])
    legs = [metres[metres[:, 1] < 7.5], metres[metres[:, 1] >= 7.5]]
    for line, leg in zip((0.0, 15.0), legs):
        assert len(leg) >= 20
        # the turn into the leg settles within the first pictures
        assert np.abs(leg[4:, 1] - line).max() < 0.4
        spacing = np.abs(np.diff(leg[:, 0]))
        assert np.all(spacing < 10.6) and np.median(spacing) > 9.9
    middle = [e.pose for e in sim.exposures[5:15]]
    assert all(abs(pose.yaw_rad) < math.radians(3) for pose in middle)  # nose along the leg, north
    assert all(math.radians(-12) < pose.pitch_rad < math.radians(-2) for pose in middle)  # leaning into the wind
    assert all(abs(pose.roll_rad) < math.radians(2) for pose in middle)
    assert all(abs(pose.height_m - 20.0) < 1.0 for pose in middle)


def test_it_leans_forward_to_accelerate_and_backward_to_brake():
    world = airborne(AP, *ENDINGS["rtl"], legs=1, length=150.0)
    sim = world.vehicles[1]
    completed(world)
    pitch = np.array([sim.pose_at(t).pitch_rad for t in np.arange(1.0, 60.0, 0.05)])
    assert pitch.min() < math.radians(-10)
    assert pitch.max() > math.radians(3)
    north = np.array([sim.flight.motion.chart.to_metres(*_place(sim, t))[0] for t in np.arange(1.0, 60.0, 0.1)])
    assert np.abs(np.diff(north) / 0.1).max() < 8.6  # never much faster than asked


def _place(sim, time_s):
    pose = sim.pose_at(time_s)
    return pose.lat_deg, pose.lon_deg


def test_a_wandering_receiver_moves_the_aircraft_not_the_record():
    sim = SimVehicle(system=1, autopilot=PX4, airframe=Airframe(gps_sigma_m=1.5, gps_tau_s=30.0), seed=3)
    world = make_world([sim])
    world.meet()
    world.finish(world.fleet.upload(1, mission(PX4, *ENDINGS["rtl"], legs=2, length=200.0)))
    world.finish(world.fleet.start(1))
    completed(world)
    leg = [e for e in sim.exposures if CHART.to_metres(e.lat_deg, e.lon_deg)[1] < 7.5][5:]
    record = np.array([CHART.to_metres(e.lat_deg, e.lon_deg)[1] for e in leg])
    truth = np.array([CHART.to_metres(e.pose.lat_deg, e.pose.lon_deg)[1] for e in leg])
    assert np.abs(record).max() < 0.8
    assert np.abs(truth).max() > 0.8


def test_the_same_seed_gives_the_same_flight():
    flights = []
    for _ in range(2):
        sim = SimVehicle(system=1, autopilot=AP, airframe=Airframe(gps_sigma_m=1.0), seed=5)
        world = make_world([sim], Faults(loss=0.2, seed=1), Faults(loss=0.2, seed=2))
        world.meet()
        world.finish(world.fleet.upload(1, mission(AP, *ENDINGS["rtl"], legs=1)))
        world.finish(world.fleet.start(1))
        completed(world)
        flights.append([(e.time_s, e.pose) for e in sim.exposures])
    assert flights[0] and flights[0] == flights[1]


def test_pictures_are_reported_by_each_dialect_in_its_way():
    for autopilot, name in ((AP, "CAMERA_FEEDBACK"), (PX4, "CAMERA_IMAGE_CAPTURED")):
        world = airborne(autopilot, *ENDINGS["rtl"], legs=1)
        heard = listen(world, name)
        completed(world)
        sim = world.vehicles[1]
        assert len(heard) == len(sim.exposures) == world.fleet.vehicles[1].photos > 5
        first, pose = heard[0], sim.exposures[0].pose
        lat = first.lat / 1e7
        assert lat == pytest.approx(pose.lat_deg, abs=1e-6)
        if autopilot is AP:
            assert first.time_usec / 1e6 == pytest.approx(sim.utc_s(sim.exposures[0].time_s), abs=1e-3)
            assert first.pitch == pytest.approx(math.degrees(pose.pitch_rad), abs=1e-3)
        else:
            w, x, y, z = first.q
            pitch = math.asin(2 * (w * y - z * x))
            assert pitch == pytest.approx(pose.pitch_rad, abs=1e-6)


def test_a_second_station_is_denied_while_one_uploads():
    vehicle = SimVehicle(system=1, autopilot=AP)
    count = dialect.MAVLink_mission_count_message(1, 1, 5, 0)
    assert vehicle.handle(count, GROUND_STATION, 0.0)[0].get_type() == "MISSION_REQUEST"
    assert vehicle.handle(count, Address(254, 190), 0.1)[0].type == dialect.MAV_MISSION_DENIED


# -- what real autopilots did, and simulated ones had not learned -----------------------------------------------------


def test_arducopter_stands_in_brake_when_disarmed_and_does_not_arm_there():
    world = make_world([SimVehicle(system=1, autopilot=AP)])
    world.meet()
    texts = listen(world, "STATUSTEXT")
    pilot = world.fleet.vehicles[1].pilot
    assert world.finish(world.fleet.begin(pilot.set_mode(pilot.modes.hold)))[0].ok
    arm = Command(pilot.vehicle, pilot.own, command=dialect.MAV_CMD_COMPONENT_ARM_DISARM, params=(1.0,), verb="arm")
    refused = world.finish(world.fleet.begin(arm))[0]
    assert not refused.ok and "Arm: Brake mode not armable" in refused.text and texts
    assert world.finish(world.fleet.upload(1, mission(AP, MissionItem.do(RTL))))[0].ok
    assert world.finish(world.fleet.start(1))[0].ok  # a start leaves BRAKE for GUIDED before it arms
    assert world.vehicles[1].flight.armed


@pytest.mark.parametrize("wipes", [True, False])
def test_a_mission_may_be_lost_with_a_reboot(wipes):
    world = make_world([SimVehicle(system=1, autopilot=AP, wipes=wipes)])
    world.meet()
    assert world.finish(world.fleet.upload(1, mission(AP, MissionItem.do(RTL))))[0].ok
    world.wait(20.0)
    world.vehicles[1].reboot(world.clock.now)
    assert world.until(lambda: any(event.kind == "rebooted" for event in world.events), 30.0)
    outcome = world.finish(world.fleet.start(1))[0]
    assert outcome.ok is not wipes
    assert not wipes or "has no mission; upload one first" in outcome.text


def test_px4_refuses_a_start_right_after_an_upload_and_is_asked_again():
    world = make_world([SimVehicle(system=1, autopilot=PX4)])
    world.meet()
    acks = listen(world, "COMMAND_ACK")
    assert world.finish(world.fleet.upload(1, mission(PX4, MissionItem.do(RTL))))[0].ok
    outcome = world.finish(world.fleet.start(1))[0]
    assert outcome.ok, outcome
    results = [ack.result for ack in acks if ack.command == dialect.MAV_CMD_MISSION_START]
    assert dialect.MAV_RESULT_DENIED in results and results[-1] == dialect.MAV_RESULT_ACCEPTED


@BOTH
def test_streams_that_starve_cost_no_heartbeat_and_no_completion(autopilot):
    world = make_world([SimVehicle(system=1, autopilot=autopilot, tx_bytes_s=250.0)])
    world.meet()
    positions, beats = listen(world, "GLOBAL_POSITION_INT"), listen(world, "HEARTBEAT")
    asked = []
    world.fleet.tap(lambda packet, utc: asked.append(packet) if packet.kind == ACK else None)
    assert world.finish(world.fleet.upload(1, mission(autopilot, MissionItem.do(RTL), length=200.0)))[0].ok
    assert world.finish(world.fleet.start(1))[0].ok
    began, had, answers = world.clock.now, (len(positions), len(beats)), len(asked)
    assert completed(world)
    seconds = world.clock.now - began
    assert (len(positions) - had[0]) / seconds < 5.0  # of ten
    assert (len(beats) - had[1]) / seconds > 0.9
    assert not any(event.kind == "lost" for event in world.events)
    assert (len(asked) - answers) / seconds < 0.7  # all seven are asked for again, ever more seldom


@BOTH
def test_a_mission_is_flown_over_a_radio_of_57600_baud_with_five_percent_loss(autopilot):
    faults = [Faults(loss=0.05, delay_s=(0.02, 0.08), bytes_s=5760.0, seed=seed) for seed in (1, 2)]
    world = make_world([SimVehicle(system=1, autopilot=autopilot)], *faults)
    world.meet()
    positions = listen(world, "GLOBAL_POSITION_INT")
    assert world.finish(world.fleet.upload(1, mission(autopilot, MissionItem.do(RTL))))[0].ok
    assert world.finish(world.fleet.start(1))[0].ok
    began, had = world.clock.now, len(positions)
    assert completed(world)
    assert (len(positions) - had) / (world.clock.now - began) == pytest.approx(9.5, abs=1.0)
    assert world.kinds(1) == ["started", "complete"]
    assert not any(event.kind == "lost" for event in world.events)


def test_a_radio_carries_no_more_than_its_rate():
    radio = Channel(faults=Faults(bytes_s=1000.0))
    for _ in range(30):
        radio.put("packet", 0.0, 100)  # three seconds' worth at once: what would wait longer than one is lost
    assert len(radio.take(0.55)) == 5 and radio.lost == 19
    assert len(radio.take(2.0)) == 6


@BOTH
def test_a_vehicle_as_flown_is_where_its_plan_has_it_around_its_start(autopilot):
    """It stands still above its start before it sets off and before it comes down, as real ones do."""
    items = [at(WAYPOINT, 0, 0)] if autopilot is AP else []
    items += [at(TAKEOFF, 0, 0, 40.0, autopilot), MissionItem.do(CHANGE_SPEED, 1, 10)]
    items += [at(WAYPOINT, *corner, 40.0, autopilot) for corner in ((0, 150), (40, 150), (40, 0), (0, 0))]
    mission = Mission(autopilot, (*items, MissionItem.do(RTL)))
    sim = SimVehicle(system=1, autopilot=autopilot, airframe=Airframe().as_flown(DEFAULT.times(autopilot.value)))
    world = make_world([sim])
    world.meet()
    assert world.finish(world.fleet.upload(1, mission))[0].ok
    world.fleet.start(1)
    assert world.until(lambda: sim.flight.motion.up > 0.3, 30.0)
    begun, flown = world.clock.now, []

    def note():
        motion = sim.flight.motion
        flown.append((world.clock.now - begun, math.hypot(motion.north, motion.east), motion.up))
        return not sim.flight.armed

    assert world.until(note, 600.0)
    places = track_of(mission, sim.home[:2]).places
    planned_s, home = 0.5 * np.arange(len(places)), np.hypot(*places[:, :2].T)
    rows = np.array(flown)
    left = int(np.argmax(rows[:, 1] > 15.0))
    assert np.abs(np.interp(rows[:left, 0], planned_s, home) - rows[:left, 1]).max() < 5.0
    assert np.abs(np.interp(rows[:left, 0], planned_s, places[:, 2]) - rows[:left, 2]).max() < 2.5
    # Home again: by its own time of arrival, since turns took it another time.
    back, planned_back = (len(d) - int(np.argmax(d[::-1] > 15.0)) for d in (rows[:, 1], home))
    late_s = rows[back, 0] - planned_s[planned_back]
    assert abs(late_s) < 5.0
    assert np.abs(np.interp(rows[back:, 0] - late_s, planned_s, places[:, 2]) - rows[back:, 2]).max() < 4.0


@pytest.mark.parametrize("end", [RTL, LAND])
@BOTH
def test_a_vehicle_as_flown_takes_the_times_of_its_autopilot(autopilot, end):
    items = [at(WAYPOINT, 0, 0)] if autopilot is AP else []
    items += [at(TAKEOFF, 0, 0, 40.0, autopilot), MissionItem.do(CHANGE_SPEED, 1, 10)]
    corners = [(60, 20), (60, 200), (90, 200), (90, 20), (0, 0)]
    items += [at(WAYPOINT, *corner, 40.0, autopilot) for corner in corners]
    mission = Mission(autopilot, (*items, MissionItem.do(RTL) if end == RTL else at(LAND, 0, 0, 0.0, autopilot)))

    def flown_s(airframe):
        sim = SimVehicle(system=1, autopilot=autopilot, airframe=airframe)
        world = make_world([sim])
        world.meet()
        assert world.finish(world.fleet.upload(1, mission))[0].ok
        assert world.finish(world.fleet.start(1))[0].ok
        assert world.until(lambda: sim.flight.motion.up > 0.3, 30.0)
        begun = world.clock.now
        assert world.until(lambda: not sim.flight.armed, 600.0)
        return world.clock.now - begun

    times = DEFAULT.times(autopilot.value)
    planned = flight_seconds(mission)
    assert flown_s(Airframe().as_flown(times)) == pytest.approx(planned, abs=0.5 * times.schedule_slack_s)
    assert flown_s(Airframe()) < planned - times.schedule_slack_s
