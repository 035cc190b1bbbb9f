"""A vehicle's CAN bus beside its MAVLink link: pictures are placed by whichever states the lower sigma."""

import math
import threading
import time

import numpy as np
import pytest

from gcs_plugin.daemon.intake import can_reader
from gcs_plugin.daemon.intake.can_reader import CanReader
from gcs_plugin.daemon.settings import Settings, VehicleSettings
from gcs_plugin.daemon.store.daemon_events import Events, Told
from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.errors import InputError
from telemetry.live.live_poses import LivePoses
from tests.daemon.flight.test_daemon_flight import fly
from tests.kit.daemon_kit import GRID, Shot, camera_at, jpeg, pose_of, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.vehicles.sim_cameras import square

can = pytest.importorskip("can")
pytest.importorskip("dronecan")
pytest.importorskip("msgpack")

from tests.kit.can_node import GROUP, CanNode, attitude, camera_down, fix2  # noqa: E402

SPEED = 3.0
BY_BUS = ("position", "angles")
TURN_DEG = 15.0  # of the camera in its gimbal, which MAVLink does not tell
HOME = tuple(float(v) for v in GRID.to_geographic([EAST, NORTH]))


def messages(vehicle, time_s):
    """What the nodes on a vehicle's bus say at a time since its boot."""
    pose = vehicle.pose_at(time_s)
    yaw, pitch, roll = (math.degrees(a) for a in (pose.yaw_rad, pose.pitch_rad, pose.roll_rad))
    return [
        fix2(pose.lat_deg, pose.lon_deg, pose.alt_m, vehicle.utc_s(time_s)),
        attitude(yaw, pitch, roll),
        camera_down(TURN_DEG, 0.5),
    ]


class BusClock:
    """Runs as time.monotonic does, up to a limit that follows what the daemon has read from the bus.

    The vehicle flies by this clock, so that a machine under load slows the flight down instead of losing frames of it.
    """

    def __init__(self):
        self._now, self._last, self._lock = 0.0, time.monotonic(), threading.Lock()
        self.limit = 0.0

    def __call__(self):
        with self._lock:
            now = time.monotonic()
            self._now += max(0.0, min(now - self._last, self.limit - self._now))
            self._last = now
            return self._now


class Camera:
    """Takes pictures at the vehicle's triggers, turned in the gimbal, and posts them with no tag but the time."""

    def __init__(self):
        self.served, self.truth, self.waiting = None, {}, []

    def expose(self, vehicle, exposure):
        self.waiting.append((vehicle, exposure))

    def post_until(self, time_s):
        """Post the pictures taken before a time."""
        while self.waiting and self.waiting[0][1].time_s < time_s:
            self.post(*self.waiting.pop(0))

    def post(self, vehicle, exposure):
        pose, time_s = exposure.pose, vehicle.utc_s(exposure.time_s)
        east, north = GRID.to_grid(pose.lat_deg, pose.lon_deg)
        turn = float(GRID.convergence_rad(pose.lat_deg, pose.lon_deg))
        yaw_deg = math.degrees(pose.yaw_rad) + TURN_DEG
        camera = camera_at(east - EAST, north - NORTH, pose.height_m, yaw_deg - math.degrees(turn))
        name = f"{exposure.index}.jpg"
        whole = pose_of(camera, name, "v1", time_s)
        bare = {k: whole[k] for k in ("vehicle", "image", "time")} | {"lat_deg": 0.0, "lon_deg": 0.0, "gps_fix": 0}
        self.truth[name] = (pose.lat_deg, pose.lon_deg, yaw_deg)
        assert self.served.send(Shot(bare, jpeg(camera))).status_code == 201


def transfers_read(served):
    """Messages of node 42 that the daemon has read or counts as lost."""
    rows = served.get("/api/vehicles").json()
    node = rows[0].get("can", {}).get("nodes", {}).get("42") if rows else None
    return None if node is None else node["received"] + node["lost"]


def talk(vehicle, clock, camera, stop, loss, babble):
    """A node with receiver, attitude and gimbal at 10 Hz, one with a poor receiver, and one that babbles.

    Each tick waits until the daemon has read the one before, then posts the pictures taken before that.
    """
    bus = can.Bus(interface="udp_multicast", channel=GROUP, hop_limit=0)  # packets stay on this machine
    node, poor, rng = CanNode(42), CanNode(43), np.random.default_rng(0)
    tick, sent, unheard = 0.0, 0, None
    while not stop.is_set():
        tick += 0.1
        clock.limit = tick + 0.1
        while clock() < tick and not stop.wait(0.01):
            pass
        time_s = SPEED * tick - 0.1
        far = fix2(HOME[0] + 0.01, HOME[1], 500.0, vehicle.utc_s(time_s), 5.0)
        said = messages(vehicle, time_s)
        sent += len(said)
        for frame in [f for m in said for f in node.messages(m)] + poor.messages(far):
            if rng.random() >= loss:
                bus.send(frame)
        for _ in range(babble):
            data = bytes(rng.integers(0, 256, 8, dtype=np.uint8))
            kind = int(rng.choice([1063, 1044, 20000]))
            bus.send(can.Message(arbitration_id=kind << 8 | 99, data=data, is_extended_id=True))
        read = transfers_read(camera.served)
        if unheard is None:  # sent before the daemon listened
            unheard = None if read is None else sent - read
            continue
        slack = 2 * len(said)  # the newest messages may be lost, which is counted at the next ones
        while read is not None and sent - read - unheard > slack and not stop.wait(0.05):
            read = transfers_read(camera.served)
        camera.post_until(time_s - 2.0)
    bus.shutdown()


def placed(tmp_path, vehicle, camera, *sources, clock, loss, babble):
    """Fly a small square; gives the vehicle's row in flight, and the frames once all pictures are drawn."""
    stop = threading.Event()
    with (
        SimSwarm([vehicle], "tcpin:127.0.0.1:0", speed=SPEED, clock=clock) as swarm,
        serving(tmp_path / "w", "--link", swarm.addresses[0], *sources) as served,
    ):
        camera.served = served
        thread = threading.Thread(target=talk, args=(vehicle, clock, camera, stop, loss, babble))
        thread.start()
        try:
            served.until(
                "/api/vehicles",
                lambda rows: rows and rows[0].get("can", {}).get("nodes") and rows[0].get("lat_deg") is not None,
            )
            plan = served.command(
                "/api/plans",
                {"area": square(60), "vehicles": 1, "altitude_m": 40, "fov_min_deg": 65, "end": "hover",
                 "speed_m_s": 8},
            ).json()["id"]  # fmt: skip
            fly(served, "v1", plan)
            served.until("/api/frames", lambda rows: len(rows) >= 6)
            # At a moment whose fix was lost the link's values stand in for it.
            [row] = served.until(
                "/api/vehicles",
                lambda rows: (
                    rows[0]["can"]["state"] == "receiving"
                    and {rows[0]["poses"].get(k) for k in BY_BUS} == {"DroneCAN node 42"}
                ),
            )
            frames = served.until(
                "/api/frames", lambda rows: all(r["on_map"] or r["reason"] for r in rows) and len(rows) >= 6
            )
        finally:
            stop.set()
            thread.join()
        return row, frames


def errors(camera, frames):
    """Metres and degrees that frames are off the true poses."""
    metres, degrees = [], []
    for row in frames:
        if row["image"] in camera.truth:
            lat, lon, yaw = camera.truth[row["image"]]
            north, east = (
                (row["lat_deg"] - lat) * 111_000,
                (row["lon_deg"] - lon) * 111_000 * math.cos(math.radians(lat)),
            )
            metres.append(math.hypot(north, east))
            degrees.append(abs(float(wrap_deg(row["yaw_deg"] - yaw))))
    return np.array(metres), np.array(degrees)


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "babble"), [(0.0, 0), (0.03, 100)], ids=["quiet", "loss and a babbling node"])
def test_pictures_lie_where_the_receiver_on_the_bus_says(tmp_path, loss, babble):
    clock, camera = BusClock(), Camera()
    [vehicle] = make_swarm(1, home=(*HOME, 500.0), airframe=Airframe(climb_m_s=8.0), on_exposure=camera.expose)
    try:
        can.Bus(interface="udp_multicast", channel=GROUP, hop_limit=0).shutdown()
    except (OSError, can.CanError) as error:
        pytest.skip(f"no multicast here: {error}")
    source = f"v1=can:udp_multicast:{GROUP}"
    row, frames = placed(tmp_path, vehicle, camera, "--source", source, clock=clock, loss=loss, babble=babble)
    assert {"42", "43"} <= set(row["can"]["nodes"]) <= {"42", "43", "99"}
    assert row["can"]["nodes"]["42"]["lost"] > 0 or not loss
    assert row["poses"]["height"] == "MAVLink"
    by_bus = [frame for frame in frames if frame["origin"]["position"] == "DroneCAN node 42"]
    assert len(by_bus) > 0.8 * len(frames)
    assert all(frame["on_map"] for frame in by_bus)
    metres, degrees = errors(camera, by_bus)
    assert np.median(metres) < 0.3
    assert np.median(degrees) < 1.0
    assert all(frame["position_sigma_m"] == pytest.approx(0.02, rel=0.1) for frame in by_bus)


class Forwarder(SimVehicle):
    """A vehicle that forwards its bus for as long as it is asked to."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.asked, self.node = (), CanNode(42)

    def handle(self, message, sender, now):
        if message.get_type() == "CAN_FILTER_MODIFY":
            self.asked = tuple(message.ids[: message.num_ids])
            return []
        if message.get_type() != "COMMAND_LONG" or message.command != dialect.MAV_CMD_CAN_FORWARD:
            return super().handle(message, sender, now)
        answers = [dialect.MAVLink_command_ack_message(message.command, 0)]
        if message.param1 == 1:
            frames = [f for m in messages(self, now) for f in self.node.frames(m)]
            answers += [
                dialect.MAVLink_can_frame_message(
                    0, 0, 0, len(data), identifier | 0x80000000, [*data, *[0] * (8 - len(data))]
                )
                for identifier, data in frames
            ]
        return answers


def test_a_vehicles_own_bus_comes_through_its_link(tmp_path):
    vehicle = Forwarder(system=1, autopilot=Autopilot.ARDUPILOT, home=(*HOME, 500.0), boot_utc_s=time.time())
    with (
        SimSwarm([vehicle], "tcpin:127.0.0.1:0") as swarm,
        serving(tmp_path / "w", "--link", swarm.addresses[0], "--source", "v1=can:mavlink") as served,
    ):
        rows = served.until(
            "/api/vehicles", lambda rows: rows and "DroneCAN" in rows[0].get("poses", {}).get("position", "")
        )
    assert vehicle.asked == (1000, 1044, 1060, 1063)
    assert rows[0]["can"]["bus"] == "mavlink"
    assert rows[0]["poses"]["position"] == "DroneCAN node 42"


def test_a_bus_that_is_not_there_is_said_once_and_tried_again(monkeypatch):
    monkeypatch.setattr(can_reader, "_AGAIN_S", 0.1)
    said, events, fleet = [], Events(), Fleet([])
    events.on(Told, said.append)
    reader = CanReader("v1", "socketcan:nothing0", poses=LivePoses("v1"), events=events, fleet=fleet, system=None)
    reader.start()
    end = time.monotonic() + 120.0
    while not said:
        assert time.monotonic() < end
        time.sleep(0.05)
    time.sleep(0.5)  # more than two further attempts
    state = reader.document()
    reader.close()
    fleet.close()
    assert len(said) == 1
    assert "cannot be opened" in state["state"]


def test_a_wrong_name_of_a_bus_is_refused(tmp_path):
    for bus in ("nothing:can0", "socketcan", "mavlink:7"):
        with pytest.raises(InputError, match="names no CAN bus"):
            Settings(workspace=tmp_path, vehicles=(VehicleSettings("v1", can=bus),)).check()
