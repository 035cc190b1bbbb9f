"""Uploads over bad links, against busy, restarting and refusing vehicles: the fault matrix, in a time of its own."""

import math
from dataclasses import replace

import pytest

from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.links.packets import Framer
from gcs_plugin.mission.download import MissionDownload
from gcs_plugin.mission.exchange import GROUND_STATION, Address, Verdict
from gcs_plugin.mission.geofence import FenceZone, fence_mission, zones_of
from gcs_plugin.mission.items import (
    CHANGE_SPEED,
    FRAME_RELATIVE,
    FRAME_TERRAIN,
    JUMP,
    LAND,
    RTL,
    TAKEOFF,
    TRIGGER_DISTANCE,
    WAYPOINT,
    Mission,
    MissionItem,
    difference,
)
from gcs_plugin.mission.upload import MissionUpload
from gcs_plugin.sim.mission_store import MissionStore
from gcs_plugin.sim.simulated_swarm import Channel, Faults

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])
VEHICLE = Address(7)
HOME = MissionItem.at(WAYPOINT, 47.3977, 8.5456, 488.0, frame=0)


def make_mission(autopilot, legs=3, height=60.0):
    nan = math.nan
    yaw = 0.0 if autopilot is AP else nan
    items = [HOME] if autopilot is AP else []
    items += [
        MissionItem.at(TAKEOFF, 47.3977, 8.5456, height, params=(0.0, 0.0, 0.0, yaw)),
        MissionItem.do(CHANGE_SPEED, 1, 8),
    ]
    for leg in range(legs):
        lon = 8.5456 + 1e-4 * leg
        items.append(MissionItem.at(WAYPOINT, 47.398, lon, height, params=(0.0, 0.0, 0.0, yaw)))
        items.append(MissionItem.do(TRIGGER_DISTANCE, 12.5, 0, 1))
        items.append(MissionItem.at(WAYPOINT, 47.399, lon, height, params=(0.0, 0.0, 0.0, yaw)))
        items.append(MissionItem.do(TRIGGER_DISTANCE, 0.0))
    return Mission(autopilot, (*items, MissionItem.do(RTL)))


class Rig:
    """A vehicle's store and any number of ground stations, joined by bad links, stepped in virtual time."""

    def __init__(self, autopilot, up=None, down=None, pace=1.0):
        self.pace = pace  # seconds of the vehicle's clock in one of the station's
        self.store = MissionStore(autopilot=autopilot, home=HOME, items=[HOME] if autopilot is AP else [])
        self.up, self.down = Channel(faults=up or Faults()), Channel(faults=down or Faults())
        self.now = 100.0
        self.stations = {}
        self.reboots = []
        self.off_until = 0.0
        self._vehicle = dialect.MAVLink(None, VEHICLE.system, VEHICLE.component)
        self.acks = []

    def join(self, exchange):
        self.stations[exchange.own] = (exchange, dialect.MAVLink(None, exchange.own.system, exchange.own.component))
        self.send(exchange, exchange.start(self.now))
        return exchange

    def send(self, exchange, messages):
        for message in messages:
            self.up.put(message.pack(self.stations[exchange.own][1]), self.now)

    def answer(self, messages):
        for message in messages:
            if message.get_type() == "MISSION_ACK":
                self.acks.append(int(message.type))
            self.down.put(message.pack(self._vehicle), self.now)

    def step(self):
        self.now += 0.01
        if self.reboots and self.now >= self.reboots[0]:
            self.reboots.pop(0)
            self.store.rebooted()
            self.off_until = self.now + 3.0
        for raw in self.up.take(self.now):
            for packet in Framer().feed(raw):
                if self.now >= self.off_until:
                    sender = Address(packet.system, packet.component)
                    self.answer(self.store.feed(packet.message, sender, self.pace * self.now))
        if self.now >= self.off_until:
            self.answer(self.store.tick(self.pace * self.now))
        for raw in self.down.take(self.now):
            for packet in Framer().feed(raw):
                for exchange, _ in self.stations.values():
                    self.send(exchange, exchange.feed(packet.message, self.now))
        for exchange, _ in self.stations.values():
            if self.now >= exchange.deadline:
                self.send(exchange, exchange.tick(self.now))

    def run(self, *exchanges, limit_s=600.0):
        end = self.now + limit_s
        while self.now < end and any(exchange.outcome is None for exchange in exchanges):
            self.step()
        return [exchange.outcome for exchange in exchanges]


def upload(rig, mission, own=GROUND_STATION, **options):
    return rig.join(MissionUpload(VEHICLE, own, mission=mission, **options))


def holds(rig, mission):
    return not difference(mission, rig.store.items)


@BOTH
def test_a_good_link_takes_one_attempt(autopilot):
    rig, mission = Rig(autopilot), make_mission(autopilot)
    started = rig.now
    (outcome,) = rig.run(upload(rig, mission))
    assert outcome.ok and holds(rig, mission)
    assert rig.now - started < 2.0
    assert rig.acks == [0]


FAULTS = {
    "loss both ways": (Faults(loss=0.3, seed=1), Faults(loss=0.3, seed=2)),
    "duplicates": (Faults(duplicate=0.5, seed=3), Faults(duplicate=0.5, seed=4)),
    "late and overtaking": (Faults(delay_s=(0.0, 0.8), seed=5), Faults(delay_s=(0.0, 0.8), seed=6)),
    "late copies": (
        Faults(duplicate=0.5, delay_s=(0.0, 0.4), seed=7),
        Faults(duplicate=0.5, delay_s=(0.0, 0.4), seed=8),
    ),
    "everything": (
        Faults(loss=0.3, duplicate=0.3, delay_s=(0.0, 0.3), seed=9),
        Faults(loss=0.3, duplicate=0.3, delay_s=(0.0, 0.3), seed=10),
    ),
    "silence": (Faults(silent=((100.1, 109.0),)), Faults(silent=((100.1, 109.0),))),
    "deaf": (Faults(silent=((100.05, 112.0),)), Faults()),
    "mute": (Faults(), Faults(silent=((100.05, 112.0),))),
}


@pytest.mark.parametrize("faults", FAULTS)
@BOTH
def test_an_upload_survives(autopilot, faults):
    up, down = FAULTS[faults]
    for seed in range(6):
        rig = Rig(autopilot, replace(up, seed=up.seed + 100 * seed), replace(down, seed=down.seed + 100 * seed))
        mission = make_mission(autopilot)
        (outcome,) = rig.run(upload(rig, mission))
        assert outcome.ok, (seed, outcome)
        assert holds(rig, mission)


@pytest.mark.parametrize("at_s", [0.005, 0.06, 0.15, 0.3])
@BOTH
def test_a_reboot_in_the_middle(autopilot, at_s):
    """The machine is told, or it finds out by the silence."""
    for told in (True, False):
        rig, mission = Rig(autopilot, up=Faults(delay_s=(0.005, 0.006))), make_mission(autopilot)
        rig.reboots = [rig.now + at_s]
        uploading = upload(rig, mission)
        while rig.now < rig.off_until or rig.reboots:
            rig.step()
        if told:
            rig.send(uploading, uploading.rebooted(rig.now))
        (outcome,) = rig.run(uploading)
        assert outcome.ok and holds(rig, mission)


@BOTH
def test_a_second_ground_station_is_denied_and_gets_its_turn(autopilot):
    """Two stations upload at once: one waits for the other, and what each says at its end is true at that moment."""
    rig = Rig(autopilot, up=Faults(delay_s=(0.05, 0.06)))
    first = upload(rig, make_mission(autopilot, legs=8))
    rig.step()
    second = upload(rig, make_mission(autopilot, legs=2, height=40.0), Address(254, 190))
    while first.outcome is None and second.outcome is None:
        rig.step()
    winner, other = (first, second) if first.outcome else (second, first)
    assert winner.outcome.ok
    if winner is first:
        assert 14 in rig.acks
    (outcome,) = rig.run(other)
    assert outcome.ok and holds(rig, other.mission)


def test_a_ground_station_that_never_ends_is_named():
    rig = Rig(AP)
    stranger = Address(254, 190)
    rig.store.feed(dialect.MAVLink_mission_count_message(7, 1, 50, 0), stranger, rig.now)
    uploading = upload(rig, make_mission(AP), patience_s=20.0)
    end = rig.now + 60.0
    while uploading.outcome is None and rig.now < end:
        rig.step()
        rig.store.feed(
            dialect.MAVLink_mission_count_message(7, 1, 50, 0), stranger, rig.now
        )  # it begins again and again
    assert not uploading.outcome.ok
    assert "another ground station" in uploading.outcome.text
    assert uploading.refusal.code == 14


def broken(autopilot, change):
    mission = make_mission(autopilot)
    seq = mission.first_seq + 3 if change is not bad_jump else len(mission) - 2
    items = list(mission.items)
    items[seq if items[seq].has_place or change is bad_jump else seq - 1] = change(items[mission.first_seq + 2])
    return Mission(autopilot, tuple(items))


def bad_jump(item):
    return MissionItem.do(JUMP, 500, 2)


REFUSALS = {
    3: (lambda item: MissionItem.do(214, 1.0), "command", "DO_SET_CAM_TRIGG_INTERVAL"),
    2: (lambda item: replace(item, frame=1), "frame", "MAV_FRAME_LOCAL_NED"),
    6: (lambda item: replace(item, params=(math.nan, 0.0, 0.0, 0.0)), "param1", "nan"),
    10: (lambda item: replace(item, x=950_000_000), "latitude", "95.0"),
    11: (lambda item: replace(item, y=1_850_000_000), "longitude", "185.0"),
    12: (lambda item: replace(item, z=math.nan), "altitude", "nan"),
    1: (bad_jump, "", "jump"),
}


@pytest.mark.parametrize("code", REFUSALS)
@BOTH
def test_a_refusal_names_item_field_and_reason(autopilot, code):
    change, field, word = REFUSALS[code]
    mission = broken(autopilot, change)
    wrong = next(seq for seq, item in enumerate(mission.items) if item not in make_mission(autopilot).items)
    for faults in (Faults(), Faults(loss=0.2, seed=5)):
        rig = Rig(autopilot, down=faults)
        uploading = upload(rig, mission)
        (outcome,) = rig.run(uploading)
        assert not outcome.ok
        assert (uploading.refusal.code, uploading.refusal.item, uploading.refusal.field) == (code, wrong, field)
        assert f"item {wrong}" in outcome.text and word in outcome.text
        assert (outcome.code, outcome.item, outcome.field) == (code, wrong, field)
        assert ("mixture" in outcome.text) == (autopilot is AP)


@BOTH
def test_too_many_items_are_refused_as_a_whole(autopilot):
    rig = Rig(autopilot)
    uploading = upload(rig, make_mission(autopilot, legs=170 if autopilot is AP else 480))
    (outcome,) = rig.run(uploading)
    assert not outcome.ok
    assert (uploading.refusal.code, uploading.refusal.item) == (4, None)
    assert "does not hold" in outcome.text


def test_an_answer_to_an_earlier_upload_refuses_nothing():
    """A late refusal, acknowledgement or request of an upload before is not about this one."""
    rig, mission = Rig(AP), make_mission(AP)
    uploading = upload(rig, mission)
    for code in (12, 0, 15, 3):
        rig.answer([dialect.MAVLink_mission_ack_message(255, 190, code, 0)])
    rig.answer([dialect.MAVLink_mission_request_message(255, 190, len(mission) - 1, 0)])
    (outcome,) = rig.run(uploading)
    assert outcome.ok and holds(rig, mission)


def test_a_late_refusal_in_the_middle_costs_one_attempt():
    rig, mission = Rig(AP, up=Faults(delay_s=(0.02, 0.03))), make_mission(AP)
    uploading = upload(rig, mission)
    for _ in range(20):
        rig.step()
    rig.answer([dialect.MAVLink_mission_ack_message(255, 190, 12, 0)])
    (outcome,) = rig.run(uploading)
    assert outcome.ok and holds(rig, mission)


def test_answers_to_others_are_not_ours():
    rig, mission = Rig(AP), make_mission(AP)
    uploading = upload(rig, mission)
    for _ in range(3):
        rig.answer(
            [dialect.MAVLink_mission_ack_message(254, 190, 12, 0), dialect.MAVLink_mission_count_message(1, 1, 3, 0)]
        )
        rig.step()
    (outcome,) = rig.run(uploading)
    assert outcome.ok


def test_a_mixed_store_is_never_a_success():
    """The vehicle says yes and holds something else: it is uploaded again, and in the end reported."""

    class Forgetful(MissionStore):
        def _write(self, seq, item):
            if seq != 5:
                MissionStore._write(self, seq, item)

    rig, old, new = Rig(AP), make_mission(AP, height=30.0), make_mission(AP, height=60.0)
    (outcome,) = rig.run(upload(rig, old))
    assert outcome.ok
    rig.store = Forgetful(autopilot=AP, home=HOME, items=list(rig.store.items))
    (outcome,) = rig.run(upload(rig, new))
    assert not outcome.ok
    assert rig.acks.count(0) > 1
    assert "item 5 (NAV_WAYPOINT): its height is 30 m instead of 60 m" in outcome.text
    assert "upload again" in outcome.text


def test_an_acknowledged_upload_that_cannot_be_read_back_is_no_success():
    rig, mission = Rig(PX4), make_mission(PX4)
    uploading = upload(rig, mission, patience_s=5.0)
    while not rig.acks:
        rig.step()
    rig.down = Channel(faults=Faults(loss=1.0))
    (outcome,) = rig.run(uploading)
    assert not outcome.ok
    assert outcome.verdict is Verdict.UNKNOWN
    assert "was told to clear it" in outcome.text and "what it holds is not known" in outcome.text
    assert rig.store.items == []


@pytest.mark.parametrize("autopilot", [AP, PX4])
def test_a_mission_that_cannot_be_read_back_is_cleared(autopilot):
    rig, mission = Rig(autopilot), make_mission(autopilot)
    uploading = upload(rig, mission, patience_s=5.0)
    while not rig.acks:
        rig.step()
    rig.down = Channel(faults=Faults(silent=((0.0, rig.now + 8.0),)))
    (outcome,) = rig.run(uploading)
    assert outcome.verdict is Verdict.UNKNOWN and "was cleared" in outcome.text
    assert len(rig.store.items) == mission.first_seq


@BOTH
def test_a_geofence_that_cannot_be_read_back_is_left_to_protect(autopilot):
    zone = FenceZone("exclusion", ((8.5456, 47.3977),), radius_m=50.0)
    rig = Rig(autopilot)
    uploading = upload(rig, fence_mission([zone], autopilot), patience_s=5.0)
    while not rig.acks:
        rig.step()
    rig.down = Channel(faults=Faults(silent=((0.0, rig.now + 8.0),)))
    (outcome,) = rig.run(uploading)
    assert outcome.verdict is Verdict.UNKNOWN and "clear" not in outcome.text and "upload again" in outcome.text
    assert zones_of(rig.store.fence) == [zone]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("autopilot", [AP, PX4])
def test_time_outs_are_the_vehicles_own_at_three_times_its_speed(autopilot, seed):
    faults = Faults(loss=0.3, duplicate=0.1, seed=seed)
    rig, mission = Rig(autopilot, faults, Faults(loss=0.3, seed=seed + 30), pace=3.0), make_mission(autopilot, legs=8)
    uploading = MissionUpload(VEHICLE, GROUND_STATION, mission=mission)
    uploading.pace = 3.0
    (outcome,) = rig.run(rig.join(uploading))
    assert outcome.ok, outcome
    assert holds(rig, mission)


def test_a_silent_vehicle_is_given_up():
    rig = Rig(PX4, down=Faults(loss=1.0))
    (outcome,) = rig.run(upload(rig, make_mission(PX4), patience_s=10.0))
    assert not outcome.ok and "did not answer" in outcome.text
    assert rig.now < 115.0


def test_the_last_item_sent_twice_is_an_error_and_yet_a_success():
    """ArduPilot answers a copy of the last item after the end with ERROR although the mission is stored."""
    rig, mission = Rig(AP), make_mission(AP)
    uploading = upload(rig, mission)
    while not rig.acks:
        rig.step()
    rig.down = Channel(faults=Faults())  # the acknowledgement is lost
    rig.answer([dialect.MAVLink_mission_ack_message(255, 190, 1, 0)])
    (outcome,) = rig.run(uploading)
    assert outcome.ok and holds(rig, mission)


@BOTH
def test_a_download_over_a_bad_link_is_complete(autopilot):
    for seed in range(5):
        rig = Rig(
            autopilot, Faults(loss=0.3, duplicate=0.2, delay_s=(0.0, 0.2), seed=seed), Faults(loss=0.3, seed=seed + 50)
        )
        mission = make_mission(autopilot)
        rig.store.items = list(mission.items)
        reading = rig.join(MissionDownload(VEHICLE))
        (outcome,) = rig.run(reading)
        assert outcome.ok
        assert not difference(mission, reading.items)


def test_px4_that_has_forgotten_a_transfer_is_asked_for_the_list_again():
    """Its refusal is lost, and afterwards it ignores requests for items silently."""
    rig, mission = Rig(PX4), make_mission(PX4)
    rig.store.items = list(mission.items)
    reading = rig.join(MissionDownload(VEHICLE))
    while len(reading._got) < 0.5 * len(mission):
        rig.step()
    rig.store.rebooted()
    (outcome,) = rig.run(reading)
    assert outcome.ok and not difference(mission, reading.items)


def test_an_empty_vehicle_has_no_items():
    rig = Rig(PX4)
    reading = rig.join(MissionDownload(VEHICLE))
    assert rig.run(reading)[0].ok and reading.items == []


def test_thirty_percent_loss_takes_seconds_not_minutes():
    """Ten items, the case that was measured: 5 s with item loss only."""
    rig = Rig(PX4, Faults(loss=0.3, seed=21), Faults(loss=0.3, seed=22))
    started = rig.now
    rig.run(upload(rig, make_mission(PX4, legs=2)))
    assert rig.now - started < 30.0


DIFFERENCES = {
    "height": lambda item: replace(item, z=item.z + 0.05),
    "lies at": lambda item: replace(item, x=item.x + 30),
    "frame": lambda item: replace(item, frame=0),
    "instead": lambda item: replace(item, command=LAND),
}


@pytest.mark.parametrize("word", DIFFERENCES)
def test_a_difference_that_matters_in_flight_is_found(word):
    mission = make_mission(PX4)
    stored = list(mission.items)
    stored[2] = DIFFERENCES[word](stored[2])
    found = difference(mission, stored)
    assert found.startswith("item 2 (") and word in found


def above_ground(autopilot):
    """The usual mission with waypoints at 80 m above the ground."""
    mission = make_mission(autopilot)
    items = [replace(i, frame=FRAME_TERRAIN, z=80.0) if i.command == WAYPOINT and i.z else i for i in mission.items]
    return replace(mission, items=tuple(items))


def test_heights_above_the_ground_are_stored_by_ardupilot_and_verified():
    rig, mission = Rig(AP), above_ground(AP)
    (outcome,) = rig.run(upload(rig, mission))
    assert outcome.ok and sum(i.frame == FRAME_TERRAIN for i in rig.store.items) >= 2
    home = [replace(i, frame=FRAME_RELATIVE) if i.frame == FRAME_TERRAIN else i for i in rig.store.items]
    assert "frame" in difference(mission, home)  # a vehicle that took them for heights over home is found out


def test_heights_above_the_ground_are_refused_by_px4_in_words():
    rig = Rig(PX4)
    (outcome,) = rig.run(upload(rig, above_ground(PX4)))
    assert not outcome.ok and "use heights over home" in outcome.text


def test_rounding_by_the_autopilot_is_no_difference():
    mission = make_mission(PX4)
    stored = [
        replace(item, x=item.x + 1, z=item.z - 0.004, frame=0 if item.frame == 2 else 3) for item in mission.items
    ]
    assert not difference(mission, stored)
    assert "items are stored" in difference(mission, stored[:-1])
