"""Simulated cameras on REAL vehicles: the twin is rendered from the pose that an autopilot reports.

The autopilot (ArduCopter or PX4 in simulation, or a real one on the bench) reports position, attitude and, if it has
one, its gimbal's attitude; the camera renders the twin from that pose and sends video, or posts photos. Pictures are
due at even intervals of the VEHICLE's clock. They are rendered LATE_S later, when telemetry from before and after the
exposure has arrived and the pose can be interpolated.
"""

import contextlib
import json
import math
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from gcs_plugin.demo.simulated_camera import DemoSetting, TwinCamera, VideoSender, VideoServer
from gcs_plugin.fleet.link_hub import Hub, Side
from gcs_plugin.links.transports import Link, Peer
from gcs_plugin.mission.exchange import Address
from orthoswarm.export.product_files import iso_time
from orthoswarm.model.arrays import Bytes
from orthoswarm.model.errors import InputError
from orthoswarm.twin.flights import FlightDeviations, FlightPlan, Noise
from orthoswarm.twin.presets import TwinSpec, spec
from orthoswarm.twin.site import Site, with_heading
from telemetry.live.live_poses import LivePoses
from telemetry.samples.sample import Sample

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.fleet.vehicle_state import Vehicle
    from orthoswarm.twin.ray_marching import PreparedScene
    from orthoswarm.twin.site import Site

LATE_S: Final = 0.25
"""Delay between an exposure and its rendering, seconds: two messages at 10 Hz."""
_BEHIND_S: Final = 10.0
"""A camera that is later than this skips the exposures it has missed."""
_THINNED_S: Final = 2.0
"""For every two seconds of delay one more exposure is skipped between two pictures: on a slow machine the pictures are
farther apart, but still evenly spaced."""
_IDLE_S: Final = 0.02
_POST_TIMEOUT_S: Final = 30.0
_WAIT_S: Final = 0.5


class Outlet(Protocol):
    """Destination of a vehicle's pictures; `url`: its address."""

    url: str

    def send(self, image: Bytes, sample: Sample) -> None:
        """Send a picture, uint8 (rows, columns, 3), with its recorded pose."""

    def close(self) -> None:
        """Close the connection."""


class Poster:
    """Posts photos with their poses to a daemon, as a companion computer does.

    Args:
        url: the daemon's address. vehicle: id.
    """

    def __init__(self, url: str, vehicle: str) -> None:
        self.url, self._vehicle = url.rstrip("/"), vehicle
        self.failed = 0
        self._opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))

    def send(self, image: Bytes, sample: Sample) -> None:
        """Post a picture; one that the daemon does not accept is counted in `failed`."""
        import simplejpeg

        data = bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(image), 92, "RGB", "420"))
        time_s = float(sample.time_s or 0.0)
        pose = {
            "vehicle": self._vehicle, "image": f"twin-{time_s:.3f}.jpg", "time": iso_time(time_s),
            "lat_deg": sample.lat_deg, "lon_deg": sample.lon_deg, "height_m": sample.height_m,
            "yaw_deg": sample.yaw_deg, "pitch_deg": sample.pitch_deg, "roll_deg": sample.roll_deg,
        }  # fmt: skip
        kind, body = _multipart(data, json.dumps(pose))
        request = urllib.request.Request(self.url + "/api/frames", data=body, headers={"Content-Type": kind})
        try:
            self._opener.open(request, timeout=_POST_TIMEOUT_S).close()
        except (OSError, urllib.error.HTTPError):
            self.failed += 1

    def close(self) -> None:
        """Nothing to close: each picture has its own connection."""


def _multipart(picture: bytes, pose: str) -> tuple[str, bytes]:
    """Content type and body of a form with `image` and `pose` (RFC 7578)."""
    boundary = "orthoswarm-picture-and-pose"
    body = f'--{boundary}\r\nContent-Disposition: form-data; name="pose"\r\n\r\n{pose}\r\n'.encode()
    head = 'Content-Disposition: form-data; name="image"; filename="picture.jpg"\r\nContent-Type: image/jpeg'
    body += f"--{boundary}\r\n{head}\r\n\r\n".encode() + picture + f"\r\n--{boundary}--\r\n".encode()
    return f"multipart/form-data; boundary={boundary}", body


def open_outlet(url: str, system: int) -> Outlet:
    """Open the destination of a vehicle's pictures; vehicle N uses the given port + N - 1.

    Args:
        url: tcp://HOST:PORT serves video there, udp://HOST:PORT sends it there, http://HOST:PORT posts photos.
        system: the vehicle's MAVLink system id.

    Raises:
        InputError: it is none of these, or the port is in use.
    """
    from urllib.parse import urlsplit

    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if parts.scheme not in ("tcp", "udp", "http") or not host or not port:
        raise InputError(
            f"'{url}' is not an address for pictures; give tcp://HOST:PORT, udp://HOST:PORT or http://HOST:PORT"
        )
    if parts.scheme == "http":
        return Poster(url, f"v{system}")
    if port + system - 1 > 65535:
        raise InputError(f"vehicle {system} would need port {port + system - 1}; give a lower one in --stream")
    if parts.scheme == "udp":
        return VideoSender(host, port + system - 1)
    try:
        return VideoServer(host, port + system - 1, live=True)
    except OSError as error:
        raise InputError(f"port {port + system - 1} cannot be served ({error.strerror}); give another one") from None


@dataclass(slots=True, kw_only=True)
class Shutter:
    """Decides when a vehicle's next picture is due.

    Attributes:
        every_s: seconds of the vehicle's clock between pictures.
        above_m: least height over takeoff.
        on_trigger: True to take pictures only when the autopilot reports an exposure.
        skipped: exposures left out because the camera was busy.
    """

    every_s: float
    above_m: float
    on_trigger: bool = False
    skipped: int = 0
    _next_s: float | None = None
    _events: deque[float] = field(default_factory=deque)

    def exposed(self, time_s: float) -> None:
        """Note an exposure that the autopilot has reported (UTC epoch seconds)."""
        if self.on_trigger:
            self._events.append(time_s)

    def due(self, now_s: float, armed: bool, height_m: float | None) -> float | None:
        """Time of the exposure that is due, UTC epoch seconds; None if there is none.

        Args:
            now_s: the vehicle's UTC of its latest telemetry.
            armed: whether its motors run.
            height_m: over takeoff.
        """
        ready_s = now_s - LATE_S
        if self.on_trigger:
            return self._events.popleft() if self._events and self._events[0] <= ready_s else None
        if not armed or height_m is None or height_m < self.above_m:
            self._next_s = None
            return None
        if self._next_s is None or self._next_s > now_s + _BEHIND_S:  # takeoff, or the vehicle's clock was set back
            self._next_s = ready_s
        late = ready_s - self._next_s
        if late < 0.0:
            return None
        if late > _BEHIND_S:
            lost = int(late // self.every_s)
            self.skipped += lost
            self._next_s += lost * self.every_s
            late -= lost * self.every_s
        moment = self._next_s
        thinned = int(late // _THINNED_S)
        self.skipped += thinned
        self._next_s += (1 + thinned) * self.every_s
        return moment


@dataclass(slots=True, kw_only=True)
class Follower:
    """The simulated camera of one vehicle.

    Attributes:
        vehicle: its state in the fleet. poses: its recent poses.
        shutter: when to take pictures. camera: renders them. outlet: sends them.
        level: True for a gimbal that keeps the camera at nadir and that the autopilot does not report.
        taken: number of pictures so far. problem: the last error, empty without one.
    """

    vehicle: "Vehicle"
    poses: LivePoses
    shutter: Shutter
    camera: TwinCamera
    outlet: Outlet
    level: bool = False
    taken: int = 0
    problem: str = ""

    def feed(self, message: Any, utc: float) -> None:
        """Process a message of the vehicle (in the fleet's thread)."""
        event = self.poses.feed(message, utc)
        if event is not None and event.time_s is not None:
            self.shutter.exposed(event.time_s)

    def work(self) -> bool:
        """Take the picture that is due; False if none is."""
        latest = self.poses.latest
        if latest.time_s is None:
            return False
        moment = self.shutter.due(latest.time_s, self.vehicle.armed, latest.height_m)
        if moment is None:
            return False
        pose = self.pose(moment)
        if pose is not None:
            image, sample = self.camera.shoot(pose, self.taken)
            self.outlet.send(image, sample)
            self.taken += 1
        return True

    def pose(self, moment: float) -> Sample | None:
        """The camera's pose at a time (UTC epoch seconds); None where telemetry has a gap."""
        pose = self.poses.at(moment)
        if self.level and pose.flight_yaw_deg is not None:
            pose = replace(pose, yaw_deg=pose.flight_yaw_deg, pitch_deg=-90.0, roll_deg=0.0)
        known = pose.has_position and pose.height_m is not None and pose.yaw_deg is not None
        # the recorded pose is the camera's; attitude of the airframe and absolute altitude stay out of it
        return replace(pose, flight_pitch_deg=None, flight_roll_deg=None, altitude_m=None) if known else None


class FollowingCameras:
    """The cameras of all vehicles of a fleet, each opened when its vehicle is first heard.

    Args:
        fleet: the vehicles; another thread polls it.
        stage: the city. site: its position.
        stream: address for the pictures (`open_outlet`).
        seed: of the cameras' errors.
        shutter: makes a vehicle's shutter.
        level: see Follower. rays: see TwinCamera.
        opened: called with each new camera.
    """

    def __init__(
        self, fleet: "Fleet", stage: "PreparedScene", site: "Site", stream: str, *, seed: int,
        shutter: Callable[[], Shutter], level: bool, rays: int, opened: Callable[[Follower], None],
    ) -> None:  # fmt: skip
        self._rays = rays
        self._fleet, self._stage, self._site, self._stream = fleet, stage, site, stream
        self._setting, self._shutter, self._level, self._opened = DemoSetting(seed=seed), shutter, level, opened
        self.followers: dict[int, Follower] = {}
        fleet.subscribe(self._message)

    def run(self, stop: threading.Event) -> None:
        """Take pictures until `stop` is set; the fleet must be polled by another thread."""
        while not stop.is_set():
            self._open_cameras()
            taken = sum(_guarded(follower) for follower in list(self.followers.values()))
            if not taken:
                time.sleep(_IDLE_S)

    def close(self) -> None:
        """End the streams."""
        for follower in self.followers.values():
            with contextlib.suppress(OSError):
                follower.outlet.close()

    def _open_cameras(self) -> None:
        """Open a camera for each new vehicle."""
        for system, vehicle in sorted(self._fleet.vehicles.items()):
            if system not in self.followers:
                follower = Follower(
                    vehicle=vehicle, poses=LivePoses(f"v{system}"), shutter=self._shutter(),
                    camera=TwinCamera(self._stage, self._site, self._setting, system, self._rays),
                    outlet=open_outlet(self._stream, system), level=self._level,
                )  # fmt: skip
                self.followers[system] = follower
                self._opened(follower)

    def _message(self, vehicle: "Vehicle", message: Any, utc: float) -> None:
        follower = self.followers.get(vehicle.system)
        if follower is not None:
            follower.feed(message, utc)


def _guarded(follower: Follower) -> bool:
    """Take a picture; an error is stored in `problem`, so that the other cameras go on."""
    try:
        return follower.work()
    except (OSError, ValueError, ArithmeticError) as error:
        follower.problem = f"{type(error).__name__}: {error}"
        return True


def wait_for_place(
    fleet: "Fleet", vehicles: int, seconds: float, stop: threading.Event, say: Callable[[str], None]
) -> tuple[float, float] | None:
    """Poll a fleet until enough vehicles have a position; returns latitude, longitude of the one with the lowest id.

    Stock ArduCopter reports latitude 0, longitude 0 until its receiver and EKF have a position, up to half a minute
    after its start; PX4 reports none.

    Args:
        fleet: the vehicles. vehicles: how many. seconds: longest wait.
        stop: event that ends the wait; then None is returned.
        say: called with a description of what is missing, whenever it changes.

    Raises:
        InputError: they have no position in time.
    """
    said = ""

    def placed() -> list["Vehicle"]:
        return [v for v in fleet.vehicles.values() if v.lat_deg and v.lon_deg and v.gps_fix >= 3]

    def done() -> bool:
        nonlocal said
        if stop.is_set() or len(placed()) >= vehicles:
            return True
        text = _missing(fleet, vehicles, len(placed()))
        if text != said:
            said = text
            say(f"waiting: {text}")
        return False

    found = fleet.run_until(done, seconds)
    if stop.is_set():
        return None
    if not found:
        heard = len(fleet.vehicles)
        raise InputError(
            f"{len(placed())} of {vehicles} vehicles know their position after {seconds:.0f} s ({heard} heard); "
            "check --link, and that the autopilot has a GPS fix"
        )
    first = min(placed(), key=lambda v: v.system)
    return float(first.lat_deg or 0.0), float(first.lon_deg or 0.0)


def _missing(fleet: "Fleet", vehicles: int, placed: int) -> str:
    """What the vehicles still lack, as a text."""
    heard = sorted(fleet.vehicles.items())
    if len(heard) < vehicles:
        return f"{len(heard)} of {vehicles} vehicles heard"
    lacking = [f"v{s} has {'no position yet' if v.gps_fix >= 3 else 'no GPS fix'}" for s, v in heard if not v.lat_deg]
    return "; ".join(lacking) or f"{placed} of {vehicles} vehicles have a position"


# -- the twin's city around a vehicle ----------------------------------------------------------------------------------

_FAR_M = 20_000.0


def set_there(folder: Path) -> bool:
    """Whether a folder holds a set already."""
    return (folder / "truth" / "manifest.json").is_file()


def read_spec(folder: Path) -> TwinSpec:
    """The parameters of a data set made by `orthoswarm twin make` or by this module.

    Raises:
        InputError: the folder holds no set, or one of another version.
    """
    path = folder / "truth" / "manifest.json"
    try:
        values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        values.pop("generator", None)
        parts = {"plan": FlightPlan, "motion": FlightDeviations, "noise": Noise}
        for name, kind in parts.items():
            values[name] = kind(**{key: _tuples(value) for key, value in values[name].items()})
        return TwinSpec(**{key: _tuples(value) for key, value in values.items()})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{folder} contains no readable data set ({error}); make one in an empty folder") from None


def _tuples(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def place_spec(preset: str, seed: int, lat_deg: float, lon_deg: float) -> TwinSpec:
    """A preset's city around a place."""
    return with_heading(spec(preset, seed=seed, lat_deg=lat_deg, lon_deg=lon_deg))


def write_set(world: TwinSpec, folder: Path, report: Callable[[str, int, int], None]) -> Path:
    """Write the map before the disaster, the truth after it and the area to map, but no photos.

    Returns:
        The area, a GeoJSON file with one polygon.

    Raises:
        InputError: the folder holds another set.
    """
    from orthoswarm.twin.dataset_files import write_atomic
    from orthoswarm.twin.make import make_twin

    make_twin(world, folder, only=0, progress=report)
    path = folder / "area.geojson"
    write_atomic(path, json.dumps(area_of(world)).encode())
    return path


def area_of(world: TwinSpec) -> dict[str, Any]:
    """The area that the set's own flight maps, a GeoJSON polygon; all footprints over it are inside the city."""
    site = Site.of(world)
    places = site.grid.to_geographic(world.plan.to_grid(world.plan.outline(), site.center))
    return {"type": "Polygon", "coordinates": [[[float(lon), float(lat)] for lat, lon in places]]}


def away_m(world: TwinSpec, lat_deg: float, lon_deg: float) -> float:
    """Distance of a position from the part of the city that a camera may fly over, metres; 0 inside."""
    site = Site.of(world)
    east, north = np.asarray(site.grid.to_grid(lat_deg, lon_deg)) - site.center
    if not (math.isfinite(east) and math.isfinite(north)):
        return _FAR_M
    reach = 0.5 * max(world.plan.extent_m) + world.margin_m
    return float(max(0.0, math.hypot(east, north) - reach))


if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.links.packets import Packet


class Relay:
    """A MAVLink router: shares the autopilot's single link between the simulated camera and a ground station.

    It works like mavlink-router on a companion computer: packets of the vehicles are forwarded to the ground unchanged,
    signatures included; packets of the ground go to the vehicle that is their target, or to all.

    Args:
        fleet: the vehicles; another thread polls it.
        ground: the ground station's link, for example tcpin:127.0.0.1:5790.
        own: the address that greets the ground station.

    Attributes:
        down: number of packets forwarded to the ground; up: to vehicles.
    """

    def __init__(self, fleet: "Fleet", ground: Link | str, own: Address) -> None:
        self._fleet = fleet
        self._hub = Hub([ground], own)
        self.down = self.up = 0
        fleet.tap(self._from_vehicle)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)

    def start(self) -> None:
        """Start forwarding."""
        self._thread.start()

    def close(self) -> None:
        """Stop; the fleet stays open."""
        self._stop.set()
        if self._thread.ident is not None:
            self._hub.post(lambda: None)
            self._thread.join(5.0)
        self._hub.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._hub.poll(_WAIT_S, self._from_ground)

    # -- in the fleet's thread ------------------------------------------------------------------------------------

    def _from_vehicle(self, packet: "Packet", utc: float) -> None:
        del utc
        if packet.system not in self._fleet.vehicles or self._stop.is_set():
            return  # sent by another ground station on the vehicle's link
        raw = packet.raw

        def send() -> None:
            side = self._hub.sides[0]
            for peer in {*side.link.greet(), *side.peers}:
                side.link.send(peer, raw)
            self.down += 1

        self._hub.post(send)

    def _to_vehicles(self, packet: "Packet") -> None:
        wanted = int(getattr(packet.message, "target_system", 0))
        for system, vehicle in self._fleet.vehicles.items():
            if wanted in (0, system) and vehicle.route is not None:
                vehicle.route.side.link.send(vehicle.route.peer, packet.raw)
        self.up += 1

    # -- in the relay's thread ------------------------------------------------------------------------------------

    def _from_ground(self, side: Side, peer: Peer, packet: "Packet", now: float, utc: float) -> None:
        del side, peer, now, utc
        self._fleet.hub.post(lambda: self._to_vehicles(packet))
