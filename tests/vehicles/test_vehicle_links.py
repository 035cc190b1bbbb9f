"""The daemon's vehicles: commands to all at once, the check, signing, and takeoffs that hold each other."""

import json
import re
import threading
import time

import pytest

from gcs_plugin.daemon.airspace import Traffic
from gcs_plugin.daemon.settings import Settings, VehicleSettings
from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.frame_rows import exposures_added
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.takeoffs import Takeoffs
from gcs_plugin.daemon.vehicles import VehicleLinks
from gcs_plugin.fleet.separation.separation_watch import Near, SeparationWatch
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.mission_builder import read_mission
from gcs_plugin.mission.plan_folder import plan_needs
from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import NO_FAULTS, Faults, SimSwarm, make_swarm
from orthoswarm.model.errors import InputError, OrthoSwarmError
from telemetry.live.live_poses import LinkPoses
from tests.vehicles.test_fleet_cli import HOME, folder  # noqa: F401

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
CLIMBS_FAST = Airframe(climb_m_s=8.0)


class PlanFolder:
    """The plans of a workspace, with the one plan of a folder."""

    def __init__(self, path):
        self.path = path

    def starts(self, name, sortie=1):
        document = json.loads((self.path / "plan.json").read_text())
        return {v["id"]: v["flights"][0]["start_s"] for v in document["vehicles"]}

    def needs(self, name):
        return plan_needs(self.path)

    def mission(self, body, vehicle, autopilot):
        return read_mission(self.path / f"{body['mission']}.waypoints", autopilot)


@pytest.fixture
def open_links(tmp_path, in_vehicle_time):
    opened = []

    def make(vehicles, *, key=None, speed=10.0, named=(), delay_s=0.0):
        slow = Faults(delay_s=(delay_s, delay_s)) if delay_s else NO_FAULTS
        swarm = SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=speed, key=key, up=slow, down=slow)
        swarm.__enter__()
        opened.append(swarm)
        settings = Settings(workspace=tmp_path, links=tuple(swarm.addresses), vehicles=named)
        journal = Journal(tmp_path / "journal.sqlite")
        links = VehicleLinks(settings, journal, Events(), LinkPoses())
        links.start()
        opened.extend([journal, links])
        return links

    yield make
    for thing in reversed(opened):
        thing.close()


def wait(done, limit_s=120.0):
    end = time.monotonic() + limit_s
    while not done() and time.monotonic() < end:
        time.sleep(0.05)
    assert done()


def doing(links, vehicle):
    """The flight state of a vehicle, in a word."""
    return next(row["flight"]["state"] for row in links.rows() if row["id"] == vehicle)


def ready(links, count):
    def known():
        rows = links.rows()
        return len(rows) == count and all(r["lat_deg"] and r["battery"] for r in rows)

    wait(known)
    wait(lambda: all(v.ekf_ok and v.prearm_ok and v.gps_fix >= 3 for v in links.fleet.vehicles.values()))


def upload_all(links, folder):  # noqa: F811
    for system, vehicle in links.fleet.vehicles.items():
        loaded = read_mission(folder / f"v{system}.waypoints", vehicle.autopilot)
        links.upload(system, loaded)


def test_all_are_commanded_at_once_with_an_outcome_each(open_links, folder):  # noqa: F811
    links = open_links(make_swarm(3, autopilots=(AP, PX4), home=HOME, airframe=CLIMBS_FAST))
    ready(links, 3)
    rows = links.commands("pause")
    assert [(r["vehicle"], r["command"], r["outcome"]) for r in rows] == [
        (f"v{n}", "pause", "refused") for n in (1, 2, 3)
    ]
    assert len({r["id"] for r in rows}) == 1 and "not armed" in rows[0]["reason"]
    upload_all(links, folder)
    refused = links.commands("start")
    assert all(r["outcome"] == "refused" and "separation" in r["reason"] for r in refused)  # all on one path
    override = {name: ["separation"] for name in ("v1", "v2", "v3")}
    assert [r["outcome"] for r in links.commands("start", override=override)] == ["done"] * 3
    wait(lambda: all(doing(links, f"v{n}") == "on mission" for n in (1, 2, 3)))
    assert [r["outcome"] for r in links.commands("rtl")] == ["done"] * 3
    home = {"returning", "landing", "on ground"}  # at ten times the speed a busy machine may see only the last
    wait(lambda: {doing(links, name) for name in ("v1", "v2", "v3")} <= home)
    assert [r["outcome"] for r in links.commands("land", ["v2"])] == ["done"]
    late = links.commands("rtl", ["v1"], given_s=links.clock() - 6.0)
    assert late[0]["outcome"] == "not_sent" and re.search(r"was given \d+ s ago and was not sent", late[0]["reason"])
    assert links.commands("rtl", ["v9"])[0]["outcome"] == "not_sent"
    with pytest.raises(InputError, match="there is no command 'explode'"):
        links.commands("explode")


def test_the_check_comes_as_json(open_links, folder):  # noqa: F811
    links = open_links(make_swarm(2, home=HOME))
    ready(links, 2)
    rows = links.preflight()
    assert [row["vehicle"] for row in rows] == ["v1", "v2"] and json.dumps(rows)
    items = {item["name"]: item for item in rows[0]["items"]}
    assert items["mission"]["state"] == "red" and items["gps"]["state"] == "ok" and rows[0]["state"] == "red"
    assert "was not started: mission" in links.commands("start", ["v1"])[0]["reason"]


def test_with_a_key_unsigned_vehicles_are_not_believed(open_links, monkeypatch):
    monkeypatch.setenv("ORTHOSWARM_SIGNING_KEY", "a passphrase that only the swarm knows")
    links = open_links(make_swarm(1, home=HOME))
    wait(lambda: links.fleet.hub.rejected > 5)
    assert links.rows() == []


@pytest.mark.slow
def test_one_that_cannot_take_off_holds_the_others_and_it_is_said(open_links, folder):  # noqa: F811
    document = json.loads((folder / "plan.json").read_text())
    for number, vehicle in enumerate(document["vehicles"]):
        vehicle["flights"][0]["start_s"] = 4.0 * number
    (folder / "plan.json").write_text(json.dumps(document))
    vehicles = make_swarm(3, home=HOME)
    links = open_links(vehicles)
    ready(links, 3)
    said = []
    takeoffs = Takeoffs(links, PlanFolder(folder), said.append)
    with pytest.raises(OrthoSwarmError, match="no vehicle was started"):
        takeoffs.begin("plan-1")
    upload_all(links, folder)
    one_path = {name: ["separation"] for name in ("v1", "v2", "v3")}
    red = [i["name"] for row in takeoffs.preflight("plan-1") for i in row["items"] if i["state"] == "red"]
    assert red == ["separation"] * 3
    vehicles[1].arms = False
    assert takeoffs.begin("plan-1", override=one_path) == {"v1": 0.0, "v2": 4.0, "v3": 8.0}
    wait(lambda: "failed" in takeoffs.waiting.rows().get("v3", {}))
    assert takeoffs.waiting.rows()["v3"]["failed"] == "held on the ground, because v2 did not take off"
    assert "Check frame class" in takeoffs.waiting.rows()["v2"]["failed"]
    assert any("v2 did not take off" in text and "v3 stay on the ground" in text for text in said)
    assert not vehicles[2].flight.armed
    takeoffs.close()


def test_a_takeoff_that_waits_is_cancelled_by_rtl(open_links, folder):  # noqa: F811
    document = json.loads((folder / "plan.json").read_text())
    document["vehicles"] = document["vehicles"][:2]
    document["vehicles"][1]["flights"][0]["start_s"] = 60.0
    (folder / "plan.json").write_text(json.dumps(document))
    links = open_links(make_swarm(2, home=HOME))
    ready(links, 2)
    upload_all(links, folder)
    takeoffs = Takeoffs(links, PlanFolder(folder), lambda _: None)
    takeoffs.begin("plan-1")
    (row,) = links.commands("rtl", ["v2"])
    assert row["outcome"] == "done" and "is cancelled" in row["reason"]
    assert "v2" not in takeoffs.waiting.rows()
    takeoffs.close()


def test_an_alarm_names_two_vehicles_whatever_the_operator_called_them(open_links):
    """The one with system id 1 is called v2: the one with system id 2 needs another name."""
    links = open_links(make_swarm(2, home=HOME), named=(VehicleSettings("v2", 1),))
    assert tuple(map(links.names.name_of, (1, 2, 3))) == ("v2", "system-2", "v3")
    watch = SeparationWatch(alarms={(1, 2): Near(2, 1, 4.0, 1.0)}, names=links.names)
    for system in (1, 2):
        assert watch.text(system).startswith("system-2 and v2 are 4.0 m apart and 1.0 m in height")


def adsb(number, lat_deg, *, flags=0xFF, tslc=0, callsign=b"SWR12"):
    lat, lon, climb, squawk = int(lat_deg * 1e7), 85_000_000, 0, 7000
    return dialect.MAVLink_adsb_vehicle_message(
        number, lat, lon, 0, 900_000, 9000, 12_000, climb, callsign, 3, tslc, flags, squawk
    )


def test_aircraft_are_known_until_nobody_hears_them():
    now = [100.0]
    traffic = Traffic(lambda: now[0])
    traffic.heard(None, adsb(1, 47.0), 0.0)
    traffic.heard(None, adsb(2, 47.1, flags=int(dialect.ADSB_FLAGS_VALID_COORDS)), 0.0)
    traffic.heard(None, adsb(3, 47.1, flags=0), 0.0)  # does not say where it is
    traffic.heard(None, adsb(4, 147.0), 0.0)
    one, two = traffic.rows()
    assert one == {"id": "000001", "name": "SWR12", "lat_deg": 47.0, "lon_deg": 8.5, "alt_m": 900.0,
                   "heading_deg": 90.0, "speed_m_s": 120.0}  # fmt: skip
    assert (two["alt_m"], two["name"], two["heading_deg"]) == (None, "", None)
    assert traffic.changed() and not traffic.changed()
    now[0] += 20.0
    traffic.heard(None, adsb(2, 47.2, tslc=5), 0.0)
    now[0] += 20.0
    assert [row["id"] for row in traffic.rows()] == ["000002"]
    assert traffic.changed()


def test_a_row_has_the_autopilots_words_and_home(open_links):
    vehicles = make_swarm(1, home=HOME)
    links = open_links(vehicles)
    ready(links, 1)
    vehicles[0].flight.texts.append("EKF3 IMU0 is using GPS")
    wait(lambda: any(said["text"] == "EKF3 IMU0 is using GPS" for said in links.rows()[0]["texts"]))
    wait(lambda: links.rows()[0]["home"])
    row = links.rows()[0]
    assert row["home"] == pytest.approx([HOME[0], HOME[1]], abs=1e-5)
    assert row["alt_m"] == pytest.approx(HOME[2], abs=5.0)  # above sea level, as aircraft say theirs


def test_a_vehicle_that_acknowledged_a_pause_takes_another_mission_at_once(open_links, folder):  # noqa: F811
    links = open_links(make_swarm(1, home=HOME, airframe=CLIMBS_FAST), speed=5.0)  # its mission takes long enough then
    ready(links, 1)
    upload_all(links, folder)
    assert [row["outcome"] for row in links.commands("start")] == ["done"]
    wait(lambda: links.rows()[0]["flight"]["state"] == "on mission")
    with pytest.raises(OrthoSwarmError, match="flying its mission"):
        upload_all(links, folder)
    assert [row["outcome"] for row in links.commands("pause")] == ["done"]
    upload_all(links, folder)


@pytest.mark.slow
def test_vehicles_of_one_start_return_in_turn_and_one_given_another_command_does_not(open_links, folder):  # noqa: F811
    links = open_links(make_swarm(3, home=HOME, spacing_m=4.0), speed=5.0)
    ready(links, 3)
    upload_all(links, folder)
    override = {name: ["separation"] for name in ("v1", "v2", "v3")}
    assert [r["outcome"] for r in links.commands("start", override=override)] == ["done"] * 3
    wait(lambda: all(doing(links, f"v{n}") == "on mission" for n in (1, 2, 3)))
    rows = links.return_in_turn("turn-1")
    assert [(r["id"], r["vehicle"], r["command"], r["outcome"]) for r in rows] == [
        ("turn-1", f"v{n}", "return", "done") for n in (1, 2, 3)
    ]
    said = {row["vehicle"]: row["reason"] for row in rows}
    waiting = {name: said[name].partition(" holds, and returns after ")[2].split(", ") for name in said}
    waiting = {name: others for name, others in waiting.items() if others != [""]}
    assert len(waiting) == 2  # all three fly one above the other's start
    second = max(waiting, key=lambda name: len(waiting[name]))  # it waits for both others: its turn comes last
    row = next(row for row in links.rows() if row["id"] == second)
    assert row["returns_after"] is not None
    assert [r["outcome"] for r in links.commands("land", [second])] == ["done"]
    assert next(row for row in links.rows() if row["id"] == second)["returns_after"] is None
    down = {"on ground", "complete"}
    wait(lambda: all(doing(links, n) in down for n in ("v1", "v2", "v3")), 240.0)
    landed = links.fleet.vehicles[links.fleet.system_of(second)]
    assert landed.mode == "LAND"  # not sent home after it was told to land


def test_a_fault_in_a_listener_cuts_no_vehicle_off_from_commands(open_links, caplog):
    links = open_links(make_swarm(1, home=HOME))
    ready(links, 1)
    faults = []

    def broken(vehicle, message, utc):
        faults.append(vehicle.system)
        raise KeyError("a fault of the program")

    links.fleet.subscribe(broken, "HEARTBEAT")
    wait(lambda: len(faults) > 2)
    assert links.commands("rtl")[0]["outcome"] in ("done", "refused")
    assert links.rows()[0]["silent_s"] < 5.0
    assert any("a fault while reading the links" in record.message for record in caplog.records)


def test_nobody_waits_for_links_that_have_ended(open_links, caplog):
    links = open_links(make_swarm(1, home=HOME))
    ready(links, 1)
    looking, collect = threading.Event(), links.rows

    def rows():
        looking.set()
        time.sleep(0.5)  # the links end meanwhile, if they do not wait for who asks them
        return collect()

    links.rows = rows
    assert looking.wait(30.0)
    links.close()
    assert not {"watch", "links"} & {thread.name for thread in threading.enumerate()}
    assert "watching vehicles" not in caplog.text


def test_pictures_that_were_reported_before_a_restart_are_counted_on(open_links, tmp_path):
    journal = Journal(tmp_path / "journal.sqlite")
    journal.write(exposures_added([("v1", number, 1.78e9 + number, None, None) for number in range(1, 54)]))
    journal.close()
    links = open_links(make_swarm(2, home=HOME))
    ready(links, 2)
    assert [row["photos"] for row in links.rows()] == [53, 0]
    links.fleet.vehicles[1].photos = 6  # in this run
    assert [row["photos"] for row in links.rows()] == [59, 0]
