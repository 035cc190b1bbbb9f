"""What goes wrong in flight, on real autopilots in simulation (`-m sitl`, see test_fleet_scenarios).

The vehicle's own failsafes act; the station has to show what happens, say once that the mission has ended without
completing, and never call it complete. Each test prints its figures (`-rP`).
"""

import math
import struct
import threading
import time

import numpy as np
import pytest

from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.flight_state import flight_state
from gcs_plugin.fleet.preflight import Level
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.exchange import Address
from gcs_plugin.mission.geofence import FenceZone, zones_of
from gcs_plugin.mission.items import RTL
from gcs_plugin.mission.mission_files import FileItem
from gcs_plugin.sim.simulated_swarm import Faults
from tests.kit.daemon_kit import start, stop
from tests.vehicles.autopilots.test_fleet_scenarios import ADDRESSES, REAL, Real, Site, further_link
from tests.vehicles.autopilots.test_twin_camera import small_area

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
        self.site.charge()  # a battery failsafe lasts until the battery was changed


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
    landed = site.place.until(lambda: not site.vehicle.armed, 300.0)
    made.restore()
    assert landed, "it is still in the air, which the next test would find"


def per_autopilot(site, **kinds):
    return kinds["ap" if site.vehicle.autopilot is AP else "px4"]


def on_mission(site):
    site.fly(FileItem(command=RTL))
    return site.follow(lambda: flight_state(site.vehicle).word.value == "on mission", 120.0)


def ended_by_itself(site, began):
    """Follow to the ground after something went wrong; the mission has ended, once, and is not complete."""
    words = site.follow(lambda: not site.vehicle.armed, 300.0)
    assert site.place.until(lambda: "aborted" in site.kinds(), 120.0), (site.kinds(), words)
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


def test_a_mission_beyond_the_geofence_is_red_before_it_is_flown(site, parameters):
    def found():
        site.finish(site.fleet.download(site.system))  # asks for the parameters, too
        assert site.place.until(lambda: site.vehicle.ready_to_check, 60.0)
        return next(item for item in site.check().items if item.name == "fence")

    assert site.finish(site.fleet.upload(site.system, site.mission(FileItem(command=RTL)))).ok
    assert found().level is Level.OK
    fences = per_autopilot(
        site,
        ap=[{"FENCE_TYPE": 2, "FENCE_RADIUS": 30, "FENCE_ENABLE": 1}, {"FENCE_TYPE": 1, "FENCE_ALT_MAX": 10}],
        px4=[{"GF_MAX_HOR_DIST": 30}, {"GF_MAX_HOR_DIST": 0, "GF_MAX_VER_DIST": 10}],
    )
    for fence, words in zip(fences, ("m from home", "goes up to 15 m"), strict=True):
        parameters.set(**fence)
        item = found()
        assert item.level is Level.RED and words in item.reason, item
        print(item.reason)


def test_zones_are_put_into_the_geofence_and_read_back(site):
    """Polygons and a circle, in place of what was held; PX4 and ArduPilot read back the same."""
    home = site.vehicle.home

    def away(north_m, east_m):
        return home[1] + east_m / 111_320.0 / math.cos(math.radians(home[0])), home[0] + north_m / 111_320.0

    square = FenceZone("exclusion", tuple(away(*corner) for corner in ((300, 300), (300, 400), (400, 400), (400, 300))))
    round_ = FenceZone("exclusion", (away(-300.0, 0.0),), 25.0)
    corners = ((-900, -900), (-900, 900), (900, 900), (900, -900))
    inside = FenceZone("inclusion", tuple(away(*corner) for corner in corners))
    for zones in ([square, round_, inside], [round_], []):
        assert site.finish(site.fleet.upload_fence(site.system, zones)).ok
        read = site.fleet.read_fence(site.system)
        assert site.place.until(lambda read=read: read.outcome is not None, 30.0)
        found = zones_of(read.items)
        print(site.vehicle.autopilot.value, [zone.document() for zone in found])
        assert [(zone.kind, len(zone.points), zone.radius_m) for zone in found] == [
            (zone.kind, len(zone.points), zone.radius_m) for zone in zones
        ]
        for one, other in zip(found, zones, strict=True):
            assert np.allclose(one.points, other.points, atol=2e-7)


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


@pytest.mark.parametrize(
    ("fault", "parameters_of_it"),
    [
        ("remote control lost", {"FS_THR_ENABLE": 1, "SIM_RC_FAIL": 1}),
        ("receiver jumps by 110 m", {"SIM_GPS1_GLTCH_X": 0.001}),
    ],
)
def test_what_fails_on_the_way_is_told_and_is_no_completion(site, parameters, fault, parameters_of_it):
    if site.vehicle.autopilot is PX4:
        pytest.skip("the simulation inside PX4 has neither")
    on_mission(site)
    began, dangers = time.monotonic(), []
    parameters.set(**parameters_of_it)
    assert site.place.until(lambda: bool(site.vehicle.danger), 60.0)
    dangers.append(site.vehicle.danger)
    site.place.until(lambda: False, 3.0)
    parameters.restore()
    words = site.follow(lambda: not site.vehicle.armed, 300.0)
    print(f"{fault}: {dangers}, {words}, {site.kinds()} after {time.monotonic() - began:.0f} s")
    assert site.kinds().count("complete") + site.kinds().count("aborted") == 1


@pytest.mark.parametrize("address", REAL)
def test_a_flight_is_started_paused_and_completed_through_twenty_percent_loss(address):
    place = Real(address, [Faults(loss=0.2, seed=seed) for seed in (1, 2)])
    try:
        site = Site(place)
        assert site.finish(site.fleet.upload(site.system, site.mission(FileItem(command=RTL), legs=4))).ok
        began, tries = time.monotonic(), []
        while not tries or not (tries[-1].ok or len(tries) > 3):
            tries.append(site.finish(site.fleet.start(site.system)))
        assert tries[-1].ok, tries
        print(f"climbed {time.monotonic() - began:.1f} s after the command, {len(tries)} tries")
        site.follow(lambda: flight_state(site.vehicle).word.value == "on mission", 60.0)
        assert site.finish(site.fleet.pause(site.system)).ok
        site.follow(lambda: flight_state(site.vehicle).word.value == "paused", 30.0)
        assert site.finish(site.fleet.resume(site.system)).ok
        assert place.until(lambda: "complete" in site.kinds() and not site.vehicle.armed, 300.0), site.kinds()
        assert site.kinds().count("complete") == 1 and "aborted" not in site.kinds()
    finally:
        place.close()


def test_a_mission_is_flown_in_wind_of_twelve_metres_a_second(site, parameters):
    if site.vehicle.autopilot is PX4:
        pytest.skip("the simulation inside PX4 has no wind")
    parameters.set(SIM_WIND_SPD=12, SIM_WIND_DIR=270)
    site.fly(FileItem(command=RTL))
    began, leans, words = time.monotonic(), [], []

    def done():
        words.append(flight_state(site.vehicle).word.value)
        leans.append(max(abs(site.vehicle.roll_rad or 0.0), abs(site.vehicle.pitch_rad or 0.0)))
        return "complete" in site.kinds()

    assert site.place.until(done, 300.0), site.kinds()
    assert site.kinds() == ["started", "complete"] and "paused" not in words
    print(f"complete after {time.monotonic() - began:.0f} s, leaning up to {math.degrees(max(leans)):.0f} degrees")


def radio(address):
    """The address of a link that the autopilot feeds as it feeds a radio of 57,600 baud.

    PX4 sends 18 kB/s on the links of its simulation. Its shell opens one on which it sends 57,600 / 20 bytes a second,
    and which stays open: after `mavlink stop` PX4 stored no more missions ("dataman_client timeout"). ArduPilot sends
    what it is asked for.
    """
    if not address.startswith("udp"):
        return address
    port = int(address.rsplit(":", 1)[1]) + 100
    place = Real(address)
    try:
        Site(place)
        shell(place, f"mavlink start -u {port} -o {port + 100} -b 57600")
    finally:
        place.close()
    return f"udpin:127.0.0.1:{port + 100}"


def shell(place, line):
    """Type a line into the shell of a PX4 (SERIAL_CONTROL)."""
    data, said = line.encode() + b"\n", []
    assert len(data) <= 70
    place.fleet.subscribe(
        lambda vehicle, message, utc: said.append(bytes(message.data[: message.count])), "SERIAL_CONTROL"
    )
    flags = dialect.SERIAL_CONTROL_FLAG_RESPOND | dialect.SERIAL_CONTROL_FLAG_EXCLUSIVE
    typed = dialect.MAVLink_serial_control_message(
        dialect.SERIAL_CONTROL_DEV_SHELL, flags, 0, 0, len(data), list(data.ljust(70, b"\0"))
    )
    place.fleet._dialogues.send(min(place.fleet.vehicles), [typed])
    assert place.until(lambda: b"mavlink]" in b"".join(said), 20.0), said


@pytest.mark.parametrize("address", REAL)
def test_a_mission_is_flown_over_a_radio_of_57600_baud_with_five_percent_loss(address):
    place = Real(
        radio(address), [Faults(loss=0.05, delay_s=(0.02, 0.08), bytes_s=5760.0, seed=seed) for seed in (1, 2)]
    )
    try:
        site = Site(place)
        began = time.monotonic()
        upload = site.finish(site.fleet.upload(site.system, site.mission(FileItem(command=RTL))))
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


@pytest.mark.parametrize("address", REAL)
def test_a_daemon_that_is_killed_in_flight_follows_the_mission_to_its_end_when_it_is_back(address, tmp_path):
    if not ADDRESSES:
        pytest.skip("ORTHOSWARM_SITL names no autopilot")
    served = start(tmp_path / "w", "--link", address)
    try:
        name = begin(served)
        served.until("/api/vehicles", lambda rows: row_of(rows, name)["mission"]["item"] >= 4)
        served.kill()
        killed = time.monotonic()
        served = start(tmp_path / "w", "--link", address)
        back = time.monotonic() - killed
        served.until("/api/vehicles", lambda rows: row_of(rows, name)["mission"]["phase"] == "active")
        known = time.monotonic() - killed
        served.until("/api/completions", lambda rows: len(rows) == 1, 600.0)
        served.until("/api/vehicles", lambda rows: row_of(rows, name)["mission"]["phase"] == "complete")
        served.until("/api/vehicles", lambda rows: not row_of(rows, name)["armed"], 300.0)
        assert len(served.get("/api/completions").json()) == 1
        print(f"answers {back:.1f} s after the kill, shows the mission after {known:.1f} s, one completion")
    finally:
        stop(served)


def row_of(rows, name):
    nothing = {"mission": {"item": 0, "phase": ""}, "armed": True}
    return next((row for row in rows if row["id"] == name and "mission" in row), nothing)


def begin(served):
    """Plan, upload and start a mission of a minute; gives the vehicle."""
    rows = served.until("/api/vehicles", lambda rows: [r for r in rows if r.get("lat_deg") and r["gps_fix"] >= 3])
    row = next(r for r in rows if r.get("lat_deg") and r["gps_fix"] >= 3)
    here = row["lat_deg"], row["lon_deg"]
    body = {
        "area": small_area(*here), "vehicles": 1, "altitude_m": 40, "fov_min_deg": 75, "speed_m_s": 8,
        "autopilot": row["autopilot"], "starts": [here],
    }  # fmt: skip
    plan = served.command("/api/plans", body).json()
    upload = {"plan": plan["id"], "mission": plan["vehicles"][0]["id"]}
    assert served.command(f"/api/missions/{row['id']}/upload", upload).status_code == 200
    served.take_off(row["id"])
    return row["id"]


@pytest.mark.parametrize("address", REAL)
def test_a_second_station_that_asks_for_everything_disturbs_nothing(address):
    place = Real(address)
    site = Site(place)  # ArduPilot opens its further links after the first
    stop_second = threading.Event()
    second = Fleet([further_link(address)], own=Address(252, 190))
    thread = threading.Thread(target=second.run, args=(stop_second,))
    thread.start()
    try:
        assert place.until(lambda: site.system in second.vehicles, 120.0)
        to = site.vehicle.address
        asked = [
            dialect.MAVLink_param_request_list_message(to.system, to.component),
            dialect.MAVLink_request_data_stream_message(to.system, to.component, 0, 4, 1),
        ]
        heard = []
        second.subscribe(lambda vehicle, message, utc: heard.append(message), "PARAM_VALUE")
        reading = second.call(lambda: (second._dialogues.send(to.system, asked), second.download(to.system))[1])
        upload = site.finish(site.fleet.upload(site.system, site.mission(FileItem(command=RTL))))
        assert upload.ok, upload
        assert site.finish(site.fleet.start(site.system)).ok
        assert place.until(lambda: "complete" in site.kinds() and not site.vehicle.armed, 300.0)
        assert site.kinds() == ["started", "complete"]
        assert reading.result(30.0).outcome is not None
        print(f"the second station has heard {len(heard)} parameters; {upload.text}")
    finally:
        stop_second.set()
        thread.join()
        second.close()
        place.close()
