"""The same scenarios on simulated vehicles, and with `-m sitl` on real autopilots named in ORTHOSWARM_SITL.

ORTHOSWARM_SITL is a comma-separated list of links, for example tcp:127.0.0.1:5760,udpin:127.0.0.1:14540. Each vehicle
takes off, flies two legs of 40 m near where it stands, and ends as the scenario says.
"""

import math
import os
import time
from pathlib import Path

import pytest

from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.flight_state import flight_state
from gcs_plugin.fleet.preflight import Level, Wanted, preflight
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.links.transports import Link, parse_link
from gcs_plugin.mission.items import CHANGE_SPEED, LAND, LOITER_UNLIM, RTL, TAKEOFF, TRIGGER_DISTANCE, WAYPOINT
from gcs_plugin.mission.mission_builder import build_mission
from gcs_plugin.mission.mission_files import FileItem
from gcs_plugin.sim.multirotor import Chart
from gcs_plugin.sim.simulated_swarm import Channel, Faults
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from tests.kit.vehicles.memory_link import World

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
ADDRESSES = [a.strip() for a in os.environ.get("ORTHOSWARM_SITL", "").split(",") if a.strip()]
REAL = ADDRESSES or ["no address in ORTHOSWARM_SITL"]


class LossyLink(Link):
    """A link that loses, doubles and delays what passes it, both ways."""

    def __init__(self, link, up, down):
        super().__init__(link.name)
        self.link, self.up, self.down = link, Channel(faults=up), Channel(faults=down)

    def open(self, selector, now):
        self.link.open(_Renamed(selector, self), now)

    def close(self):
        self.link.close()

    def tick(self, now):
        self.link.tick(now)
        self._pass_on(now)

    def greet(self):
        return self.link.greet()

    @property
    def polled(self):
        return self  # late packets are due without new ones coming

    def send(self, peer, data, expires=math.inf):
        now = time.monotonic()
        self.up.put((peer, data), now, len(data))
        self._pass_on(now)
        return True

    def receive(self, source, events, now):
        if source is not self:
            for cargo in self.link.receive(source, events, now):
                self.down.put(cargo, now, len(cargo[1]))
        self._pass_on(now)
        yield from self.down.take(now)

    def _pass_on(self, now):
        for cargo in self.up.take(now):
            self.link.send(*cargo)


class _Renamed:
    """A selector under which a link registers its wrapper."""

    def __init__(self, selector, link):
        self._selector, self._link = selector, link

    def register(self, file, events, data):
        return self._selector.register(file, events, self._link)

    def modify(self, file, events, data):
        return self._selector.modify(file, events, self._link)

    def unregister(self, file):
        return self._selector.unregister(file)


class Simulated:
    """One simulated vehicle in virtual time."""

    def __init__(self, autopilot, faults=None):
        up, down = faults or (Faults(), Faults())
        self.world = World([SimVehicle(system=1, autopilot=autopilot, ready_s=5.0)], up, down)
        self.fleet, self.events = self.world.fleet, self.world.events
        self.close = self.world.fleet.close

    def until(self, done, limit_s):
        return self.world.until(done, limit_s)


class Real:
    """One real autopilot on a link."""

    def __init__(self, address, faults=None):
        if not ADDRESSES:
            pytest.skip("ORTHOSWARM_SITL names no autopilot")
        link = parse_link(address)
        log = os.environ.get("ORTHOSWARM_SITL_TLOG")  # a file that keeps what the autopilots said
        self.fleet = Fleet([LossyLink(link, *faults) if faults else link], tlog=Path(log) if log else None)
        self.events = []
        self.fleet.on_event(self.events.append)
        self.close = self.fleet.close

    def until(self, done, limit_s):
        return self.fleet.run_until(done, limit_s)


def further_link(address):
    """Another link of the same autopilot: ArduPilot's SERIAL1, PX4's for ground stations."""
    kind, host, port = address.split(":")
    return f"tcp:{host}:{int(port) + 2}" if kind == "tcp" else f"{kind}:{host}:14550"


def charge(address):
    """Fill the battery of an ArduPilot, which does not fill by itself in simulation, for a test that needs it full."""
    place = Real(address)
    try:
        site = Site(place)
        site.charge()
        full = site.vehicle.autopilot is not AP or place.until(lambda: (site.vehicle.battery or 0.0) > 0.95, 120.0)
        assert full, site.vehicle.battery
    finally:
        place.close()


class Site:
    """A vehicle that has been found, and what the scenarios ask of it."""

    def __init__(self, place):
        self.place, self.fleet = place, place.fleet
        assert place.until(lambda: bool(self.fleet.vehicles), 60.0), "no vehicle was heard"
        self.system = min(self.fleet.vehicles)
        self.vehicle = self.fleet.vehicles[self.system]
        assert place.until(lambda: self.vehicle.lat_deg and self.vehicle.landed and self.vehicle.gps_fix >= 3, 120.0)
        assert place.until(self.ready, 240.0), [item for item in self.check().items if item.level is Level.RED]
        self.home()
        self.chart = Chart(self.vehicle.lat_deg, self.vehicle.lon_deg)
        self.begun = len(place.events)

    def check(self):
        return preflight(self.vehicle, Wanted(), self.fleet._clock())

    def ready(self):
        """The autopilot itself has nothing against arming."""
        return self.vehicle.armed or not {item.name for item in self.check().red()} & {"gps", "ekf", "pre-arm", "link"}

    def follow(self, done, limit_s):
        """Wait, and note what the vehicle was seen to do meanwhile."""
        words = []

        def look():
            word = flight_state(self.vehicle).word.value
            if words[-1:] != [word]:
                words.append(word)
            return done()

        assert self.place.until(look, limit_s), words
        return words

    def home(self):
        """On the ground, disarmed; what an earlier scenario left in the air is brought home."""
        if self.vehicle.armed:
            self.finish(self.fleet.rtl(self.system))
            assert self.place.until(lambda: not self.vehicle.armed, 300.0)

    def charge(self):
        if self.vehicle.autopilot is AP:
            to, command = self.vehicle.address, dialect.MAV_CMD_BATTERY_RESET
            reset = dialect.MAVLink_command_long_message(to.system, to.component, command, 0, 255, 100, 0, 0, 0, 0, 0)
            self.fleet._dialogues.send(self.system, [reset])

    def finish(self, dialogue, limit_s=180.0):
        self.place.until(lambda: dialogue.outcome is not None, limit_s)
        return dialogue.outcome

    def kinds(self):
        missions = ("started", "suspended", "resumed", "complete", "aborted")
        return [e.kind for e in self.place.events[self.begun :] if e.system == self.system and e.kind in missions]

    def mission(self, *last, height=15.0, legs=2):
        items = [self.at(TAKEOFF, 0, 0, height), FileItem(command=CHANGE_SPEED, params=(1.0, 8.0, -1.0, 0.0))]
        for leg in range(legs):
            ends = (5.0, 45.0) if leg % 2 == 0 else (45.0, 5.0)
            items += [
                self.at(WAYPOINT, ends[0], 15.0 * leg, height),
                trigger(8.0),
                self.at(WAYPOINT, ends[1], 15.0 * leg, height),
            ]
            items.append(trigger(0.0))
        return build_mission(self.vehicle.autopilot, [*items, *last])

    def at(self, command, north, east, height):
        lat, lon = self.chart.to_degrees(north, east)
        yaw_free = (0.0, 0.0, 0.0, math.nan)
        return FileItem(command=command, frame=3, params=yaw_free, lat_deg=lat, lon_deg=lon, alt_m=height)

    def fly(self, *last):
        upload = self.finish(self.fleet.upload(self.system, self.mission(*last)))
        assert upload.ok, upload
        start = self.finish(self.fleet.start(self.system))
        assert start.ok, start


def trigger(distance):
    return FileItem(command=TRIGGER_DISTANCE, params=(distance, 0.0, 1.0 if distance else 0.0, 0.0))


PLACES = [
    pytest.param((Simulated, AP), id="simulated-ardupilot"),
    pytest.param((Simulated, PX4), id="simulated-px4"),
    *[
        pytest.param((Real, address), id=f"sitl-{number}", marks=pytest.mark.sitl)
        for number, address in enumerate(REAL)
    ],
]


@pytest.fixture(params=PLACES)
def make_site(request):
    opened = []
    kind, what = request.param

    def make(faults=None):
        place = kind(what, faults)
        opened.append(place)
        return Site(place)

    yield make
    for place in opened:
        place.close()


def last_items(site, ending):
    return {
        "rtl": [FileItem(command=RTL)],
        "land": [site.at(LAND, 3, 3, 0.0)],
        "waypoint": [site.at(WAYPOINT, 3, 3, 15.0)],
        "do": [site.at(WAYPOINT, 3, 3, 15.0), trigger(0.0)],
        "loiter": [site.at(LOITER_UNLIM, 3, 3, 15.0)],
    }[ending]


@pytest.mark.parametrize("ending", ["rtl", "land", "waypoint", "do"])
def test_a_flown_mission_completes_exactly_once(make_site, ending):
    site = make_site()
    site.fly(*last_items(site, ending))
    words = site.follow(lambda: "complete" in site.kinds(), 300.0)
    if ending in ("waypoint", "do"):
        words += site.follow(lambda: site.vehicle.still_s > 3.0, 60.0)
        assert words[-1] == "holding"
        site.home()
    words += site.follow(lambda: not site.vehicle.armed, 300.0)
    words += site.follow(lambda: site.vehicle.landed == "on ground", 60.0)
    site.place.until(lambda: False, 5.0)
    assert flight_state(site.vehicle).word.value == "complete"
    assert "taking off" in words and words.index("taking off") < words.index("on mission"), words
    expected = {"rtl": ["returning", "landing"], "land": ["landing"]}.get(ending, [])
    assert [word for word in dict.fromkeys(words) if word in ("returning", "landing")][: len(expected)] == expected, (
        words
    )
    assert "paused" not in words and "lost" not in words, words
    assert site.kinds().count("complete") == 1
    assert "aborted" not in site.kinds()
    assert site.kinds()[0] == "started"


def test_loiter_unlimited_and_the_operators_rtl_are_no_completion(make_site):
    site = make_site()
    site.fly(*last_items(site, "loiter"))
    assert site.place.until(lambda: site.vehicle.mission_seq >= site.vehicle.detector.final_seq, 300.0)
    site.place.until(lambda: False, 20.0)
    assert site.kinds() == ["started"]
    site.home()
    assert site.place.until(lambda: "aborted" in site.kinds(), 120.0)
    assert "complete" not in site.kinds() and site.kinds()[-1] == "aborted"


def test_a_new_upload_after_a_flight_is_not_complete(make_site):
    site = make_site()
    site.fly(FileItem(command=RTL))
    assert site.place.until(lambda: "complete" in site.kinds() and not site.vehicle.armed, 300.0)
    assert site.finish(site.fleet.upload(site.system, site.mission(FileItem(command=RTL), height=18.0))).ok
    site.place.until(lambda: False, 5.0)
    assert site.kinds() == ["started", "complete"]


def test_pause_and_resume(make_site):
    site = make_site()
    site.fly(FileItem(command=RTL))
    site.follow(lambda: flight_state(site.vehicle).word.value == "on mission", 100.0)
    assert site.place.until(lambda: site.vehicle.mission_seq >= site.vehicle.detector.final_seq - 4, 200.0)
    assert site.finish(site.fleet.pause(site.system)).ok
    site.place.until(lambda: False, 12.0)  # long enough for a pause that does not last to end
    words = site.follow(
        lambda: flight_state(site.vehicle).word.value == "paused" and math.hypot(*site.vehicle.velocity_m_s[:2]) < 0.5,
        60.0,
    )
    assert words == ["paused"]
    assert site.finish(site.fleet.resume(site.system)).ok
    assert site.place.until(lambda: "complete" in site.kinds(), 300.0)
    assert site.kinds().count("complete") == 1


def test_streams_come_at_the_rates_asked_for(make_site):
    site = make_site()
    counts = {"GLOBAL_POSITION_INT": 0, "ATTITUDE": 0}
    site.fleet.subscribe(lambda v, m, utc: counts.__setitem__(m.get_type(), counts[m.get_type()] + 1), *counts)
    rates = []
    for _ in range(12):  # they are asked for anew where they come at another rate
        before, clock = dict(counts), site.vehicle.time_boot_s
        site.place.until(lambda: False, 10.0)
        seconds = site.vehicle.time_boot_s - clock  # the vehicle's, which may run fast
        rates.append({name: (counts[name] - before[name]) / seconds for name in counts})
        if all(rate == pytest.approx(10.0, rel=0.15) for rate in rates[-1].values()):
            return
    pytest.fail(f"{rates}")


def test_an_upload_through_thirty_percent_loss_both_ways(make_site):
    faults = (Faults(loss=0.3, duplicate=0.1, seed=1), Faults(loss=0.3, duplicate=0.1, seed=2))
    site = make_site(faults)
    for height in (15.0, 16.0):
        mission = site.mission(FileItem(command=RTL), height=height)
        outcome = site.finish(site.fleet.upload(site.system, mission), 180.0)
        assert outcome is not None and outcome.ok, outcome


def test_a_mission_that_is_refused_names_the_item_and_leaves_no_success(make_site):
    site = make_site()
    good = site.mission(FileItem(command=RTL))
    assert site.finish(site.fleet.upload(site.system, good)).ok
    items = list(good.items)
    wrong = good.first_seq + 2
    items[wrong] = type(items[wrong])(command=31999, frame=3, x=items[wrong].x, y=items[wrong].y, z=15.0)
    upload = site.fleet.upload(site.system, type(good)(good.autopilot, tuple(items)))
    outcome = site.finish(upload)
    assert not outcome.ok
    assert upload.refusal.item == wrong and upload.refusal.code == dialect.MAV_MISSION_UNSUPPORTED
    assert site.finish(site.fleet.upload(site.system, good)).ok


def test_a_vehicle_without_a_mission_is_not_armed_by_start(make_site):
    site = make_site()

    def emptied():
        site.fleet._dialogues.send(site.system, [dialect.MAVLink_mission_clear_all_message(site.system, 1, 0)])
        site.place.until(lambda: False, 3.0)
        read = site.fleet.download(site.system)
        site.finish(read)
        return read.items is not None and len(read.items) <= (1 if site.vehicle.autopilot is AP else 0)

    assert any(emptied() for _ in range(10))  # the message may be lost
    site.vehicle.mission = None
    outcome = site.finish(site.fleet.start(site.system))
    assert not outcome.ok and "no mission" in outcome.text
    assert not site.vehicle.armed
    # In the mode of missions ArduPilot is not ready to arm without one: the next test would wait in vain.
    assert site.finish(site.fleet.upload(site.system, site.mission(FileItem(command=RTL)))).ok
