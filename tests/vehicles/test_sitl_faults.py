"""What goes wrong in flight, on real autopilots in simulation (`-m sitl`, see test_fleet_scenarios).

The vehicle's own failsafes act; the station has to show what happens, say once that the mission has ended without
completing, and never call it complete. Each test prints its figures (`-rP`).
"""

import math
import struct
import time

import pytest

from gcs_plugin.fleet.flight_state import flight_state
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.items import RTL
from gcs_plugin.mission.mission_files import MissionItem
from gcs_plugin.sim.lossy_radio import Faults
from tests.vehicles.test_fleet_scenarios import REAL, Real, Site

pytestmark = pytest.mark.sitl
AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4


class Parameters:
    """Sets parameters of a vehicle, and puts them back."""

    def __init__(self, site):
        self.site, self.heard, self.before = site, {}, {}
        site.fleet.subscribe(self.listen, "PARAM_VALUE")

    def listen(self, vehicle, message, utc):
        whole = message.param_type != dialect.MAV_PARAM_TYPE_REAL32 and vehicle.autopilot is PX4
        value = struct.unpack("<i", struct.pack("<f", message.param_value))[0] if whole else message.param_value
        self.heard[message.param_id.rstrip("\x00")] = value, message.param_type

    def ask(self, name, message):
        self.heard.pop(name, None)
        for _ in range(10):
            self.site.fleet._dialogues.send(self.site.system, [message])
            if self.site.place.until(lambda: name in self.heard, 2.0):
                return self.heard[name]
        raise AssertionError(f"no parameter {name}")

    def set(self, **values):
        for name, value in values.items():
            to, at = self.site.vehicle.address, name.encode()
            read = dialect.MAVLink_param_request_read_message(to.system, to.component, at, -1)
            before, kind = self.ask(name, read)
            self.before.setdefault(name, before)
            whole = kind != dialect.MAV_PARAM_TYPE_REAL32 and self.site.vehicle.autopilot is PX4
            sent = struct.unpack("<f", struct.pack("<i", int(value)))[0] if whole else float(value)
            given = dialect.MAVLink_param_set_message(to.system, to.component, at, sent, kind)
            assert self.ask(name, given)[0] == pytest.approx(value), name

    def restore(self):
        if self.before:
            self.set(**self.before)
        if self.site.vehicle.autopilot is AP:  # a battery failsafe lasts until the battery was changed
            to, command = self.site.vehicle.address, dialect.MAV_CMD_BATTERY_RESET
            reset = dialect.MAVLink_command_long_message(to.system, to.component, command, 0, 255, 100, 0, 0, 0, 0, 0)
            self.site.fleet._dialogues.send(self.site.system, [reset])


@pytest.fixture(params=REAL)
def site(request):
    place = Real(request.param)
    try:
        yield Site(place)
    finally:
        place.close()


@pytest.fixture
def parameters(site):
    made = Parameters(site)
    yield made
    site.place.until(lambda: not site.vehicle.armed, 240.0)
    made.restore()


def per_autopilot(site, **kinds):
    return kinds["ap" if site.vehicle.autopilot is AP else "px4"]


def on_mission(site):
    site.fly(MissionItem(RTL))
    return site.follow(lambda: flight_state(site.vehicle).word.value == "on mission", 120.0)


def ended_by_itself(site, began):
    """Follow to the ground after something went wrong; the mission has ended, once, and is not complete."""
    words = site.follow(lambda: not site.vehicle.armed, 300.0)
    assert site.place.until(lambda: "aborted" in site.kinds(), 20.0), (site.kinds(), words)
    site.place.until(lambda: False, 5.0)
    assert "complete" not in site.kinds() and site.kinds().count("aborted") == 1
    assert words[-1] in ("landing", "on ground", "returning")
    said = [event.text for event in site.place.events[site.begun :] if event.kind == "text"]
    print(f"on the ground {time.monotonic() - began:.0f} s later: {words}; {site.kinds()}; {said[-8:]}")
    return words


def test_a_geofence_breach_ends_the_mission_without_completing_it(site, parameters):
    fence = per_autopilot(
        site,
        ap={"FENCE_TYPE": 2, "FENCE_RADIUS": 30, "FENCE_ACTION": 1, "FENCE_ENABLE": 1},
        px4={"GF_MAX_HOR_DIST": 30, "GF_ACTION": 3},
    )
    on_mission(site)  # before it is told of the fence: PX4 starts no mission that leaves it
    began = time.monotonic()
    parameters.set(**fence)
    words = ended_by_itself(site, began)
    assert "returning" in words


def test_a_battery_failsafe_ends_the_mission_without_completing_it(site, parameters):
    ready = per_autopilot(
        site,
        ap={"BATT_LOW_VOLT": 11.0, "BATT_LOW_TIMER": 3, "BATT_FS_LOW_ACT": 2},
        px4={"COM_LOW_BAT_ACT": 3},
    )
    parameters.set(**ready)
    on_mission(site)
    began = time.monotonic()
    parameters.set(**per_autopilot(site, ap={"SIM_BATT_VOLTAGE": 10.5}, px4={"SIM_BAT_MIN_PCT": 6, "SIM_BAT_DRAIN": 1}))
    words = ended_by_itself(site, began)
    assert {"returning", "landing"} & set(words)


def test_the_loss_of_gps_ends_the_mission_without_completing_it(site, parameters):
    on_mission(site)
    began = time.monotonic()
    parameters.set(**per_autopilot(site, ap={"SIM_GPS1_ENABLE": 0}, px4={"SIM_GPS_USED": 0}))
    words = ended_by_itself(site, began)
    assert "landing" in words
    parameters.restore()
    assert site.place.until(site.ready, 240.0)


def test_a_mission_is_flown_in_wind_of_twelve_metres_a_second(site, parameters):
    if site.vehicle.autopilot is PX4:
        pytest.skip("the simulation inside PX4 has no wind")
    parameters.set(SIM_WIND_SPD=12, SIM_WIND_DIR=270)
    site.fly(MissionItem(RTL))
    began, leans, words = time.monotonic(), [], []

    def done():
        words.append(flight_state(site.vehicle).word.value)
        leans.append(max(abs(site.vehicle.roll_rad or 0.0), abs(site.vehicle.pitch_rad or 0.0)))
        return "complete" in site.kinds()

    assert site.place.until(done, 300.0), site.kinds()
    assert site.kinds() == ["started", "complete"] and "paused" not in words
    print(f"complete after {time.monotonic() - began:.0f} s, leaning up to {math.degrees(max(leans)):.0f} degrees")


@pytest.mark.parametrize("address", REAL)
def test_a_mission_is_flown_over_a_radio_of_57600_baud_with_five_percent_loss(address):
    place = Real(address, [Faults(loss=0.05, delay_s=(0.02, 0.08), bytes_s=5760.0, seed=seed) for seed in (1, 2)])
    try:
        site = Site(place)
        began = time.monotonic()
        upload = site.finish(site.fleet.upload(site.system, site.mission(MissionItem(RTL))))
        assert upload.ok, upload
        uploaded = time.monotonic() - began
        assert site.finish(site.fleet.start(site.system)).ok
        assert place.until(lambda: "complete" in site.kinds() and not site.vehicle.armed, 300.0)
        assert site.kinds() == ["started", "complete"]
        lost = [event.kind for event in place.events if event.kind == "lost"]
        share = site.vehicle.missed / (site.vehicle.missed + site.vehicle.received)
        print(f"upload {uploaded:.1f} s, {100 * share:.0f} % of packets missed, lost {len(lost)} times")
        assert not lost
    finally:
        place.close()
