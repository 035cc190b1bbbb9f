"""A swarm of simulated vehicles on real sockets, in real time or faster, as a ground station sees many autopilots."""

import heapq
import itertools
import math
import queue
import selectors
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any, Final, Generic, TypeVar

from gcs_plugin.links.mavlink import Autopilot, Message
from gcs_plugin.links.packets import Framer
from gcs_plugin.links.signing import Packer, Signing
from gcs_plugin.links.transports import Link, TcpLink, UdpLink, parse_link
from gcs_plugin.mission.exchange import Address
from gcs_plugin.sim.multirotor import Airframe, Chart
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.config import DEFAULT
from orthoswarm.model.errors import InputError

_TICK_S: Final = 0.02


Cargo = TypeVar("Cargo")

_QUEUE_S: Final = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """Faults of a link, applied to each packet independently.

    Attributes:
        loss: share of packets lost, 0 to 1.
        duplicate: share of packets that arrive twice.
        delay_s: least and greatest delay; packets overtake each other within it.
        silent: intervals (from, to) in seconds in which nothing gets through.
        seed: equal seeds give equal faults.
        bytes_s: capacity, bytes per second; packets queue up, and those that would wait longer than a second are lost.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    delay_s: tuple[float, float] = (0.0, 0.0)
    silent: tuple[tuple[float, float], ...] = ()
    seed: int = 0
    bytes_s: float = math.inf

    @property
    def any(self) -> bool:
        """True if any fault is set."""
        slow = self.bytes_s < math.inf
        return bool(self.loss or self.duplicate or self.delay_s[1] or self.silent or slow)


NO_FAULTS: Final = Faults()


@dataclass(slots=True, kw_only=True)
class Channel(Generic[Cargo]):
    """One direction of a link; `lost` counts its lost packets."""

    faults: Faults
    lost: int = 0
    _random: Random = field(init=False)
    _free_at: float = 0.0
    _queue: list[tuple[float, int, Cargo]] = field(default_factory=list)
    _order: "itertools.count[int]" = field(default_factory=itertools.count)

    def __post_init__(self) -> None:
        """Seed the faults."""
        self._random = Random(self.faults.seed)

    def put(self, cargo: Cargo, now: float, size: int = 0) -> None:
        """Send a packet of so many bytes."""
        faults, random = self.faults, self._random
        if random.random() < faults.loss or any(start <= now < end for start, end in faults.silent):
            self.lost += 1
            return
        begins = max(now, self._free_at)
        if begins - now > _QUEUE_S:
            self.lost += 1
            return
        self._free_at = begins + size / faults.bytes_s
        for _ in range(2 if random.random() < faults.duplicate else 1):
            arrival = self._free_at + random.uniform(*faults.delay_s)
            heapq.heappush(self._queue, (arrival, next(self._order), cargo))

    def take(self, now: float) -> list[Cargo]:
        """The packets that have arrived, in order of arrival."""
        arrived: list[Cargo] = []
        while self._queue and self._queue[0][0] <= now:
            arrived.append(heapq.heappop(self._queue)[2])
        return arrived


@dataclass(slots=True, eq=False, kw_only=True)
class _End:
    """One link of the swarm and the vehicles behind it."""

    link: Link
    vehicles: list[SimVehicle]
    up: Channel[bytes]
    down: Channel[bytes]
    packers: dict[int, Packer]
    signing: Signing | None
    framers: dict[Any, Framer] = field(default_factory=dict)


class SimSwarm:
    """Runs simulated vehicles on their own links, in a thread (`with SimSwarm(...)`) or in the caller's (`run`).

    `speed` is in vehicle seconds in a second.
    """

    def __init__(
        self,
        vehicles: Sequence[SimVehicle],
        address: str,
        *,
        together: bool = False,
        speed: float = 1.0,
        up: Faults = NO_FAULTS,
        down: Faults = NO_FAULTS,
        key: bytes | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open the links.

        Args:
            address: `udpout:HOST:PORT`, each vehicle from a port of its own to a ground station there, or
                `tcpin:HOST:PORT`, the vehicles serving PORT, PORT + 1 and so on (0: any free ones).
            together: True for all on one link, as behind a router or a radio.
            speed: vehicle seconds in a second. clock: real seconds.
            up: faults from the ground to the vehicles, in vehicle time; down: faults back.

        Raises:
            InputError: a link cannot be opened, or is of another kind.
        """
        self.vehicles = {vehicle.system: vehicle for vehicle in vehicles}
        self.speed, self._clock = speed, clock
        self._selector = selectors.DefaultSelector()
        self._work: queue.SimpleQueue[Callable[[float], None]] = queue.SimpleQueue()
        self._muted: dict[int, float] = {}
        self._began = clock()
        self._ends: list[_End] = []
        self._by_link: dict[Link, _End] = {}
        groups = [list(vehicles)] if together else [[vehicle] for vehicle in vehicles]
        for number, group in enumerate(groups):
            link = _open(address, number)
            seeded = [Channel[bytes](faults=replace(faults, seed=faults.seed + 2 * number)) for faults in (up, down)]
            signing = Signing(key) if key else None
            packers = {vehicle.system: Packer(vehicle.system, 1, signing) for vehicle in group}
            end = _End(link=link, vehicles=group, up=seeded[0], down=seeded[1], packers=packers, signing=signing)
            self._ends.append(end)
            self._by_link[link] = end
            link.open(self._selector, self._began)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def addresses(self) -> list[str]:
        """Addresses of vehicles that serve TCP."""
        return [f"tcp:127.0.0.1:{end.link.port}" for end in self._ends if isinstance(end.link, TcpLink)]

    @property
    def now(self) -> float:
        """Seconds since the vehicles' first boot."""
        return (self._clock() - self._began) * self.speed

    def reboot(self, system: int, silence_s: float = 3.0) -> None:
        """Restart a vehicle (any thread)."""
        self._work.put(lambda now: self.vehicles[system].reboot(now, silence_s))

    def silence(self, system: int, seconds: float) -> None:
        """Cut a vehicle's link in both directions for some of its seconds (any thread)."""
        self._work.put(lambda now: self._muted.__setitem__(system, now + seconds))

    def __enter__(self) -> "SimSwarm":
        self._thread = threading.Thread(target=self.run, args=(self._stop,), daemon=True, name="simulated swarm")
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop, and close the links."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        for end in self._ends:
            end.link.close()
        self._selector.close()

    def run(self, stop: threading.Event, until_s: float = float("inf")) -> None:
        """Fly until stopped, or for a number of vehicle seconds."""
        while not stop.is_set() and self.now < until_s:
            started = self._clock()
            self.step()
            spare = _TICK_S / max(1.0, self.speed) - (self._clock() - started)
            self._selector.select(max(0.0, spare))

    def step(self) -> None:
        """Receive, advance time, and send."""
        now = self.now
        while not self._work.empty():
            self._work.get()(now)
        for key, events in self._selector.select(0.0):
            end = self._by_link[key.data]
            for peer, data in end.link.receive(key.fileobj, events, self._clock()):
                end.up.put(data, now, len(data)) if end.up.faults.any else self._take(end, peer, data, now)
        for end in self._ends:
            for data in end.up.take(now):
                self._take(end, None, data, now)
            for vehicle in end.vehicles:
                self._say(end, vehicle, vehicle.advance(now), now)
            for raw in end.down.take(now):
                self._put(end, raw)
            end.link.tick(self._clock())

    def _take(self, end: _End, peer: Any, data: bytes, now: float) -> None:
        framer = end.framers.setdefault(peer, Framer())
        for packet in framer.feed(data):
            if end.signing is not None and not end.signing.accept(packet, time.time()):
                continue
            for vehicle in end.vehicles:
                if self._muted.get(vehicle.system, 0.0) <= now:
                    answers = vehicle.handle(packet.message, Address(packet.system, packet.component), now)
                    self._say(end, vehicle, answers, now)

    def _say(self, end: _End, vehicle: SimVehicle, messages: Sequence[Message], now: float) -> None:
        if not messages:
            return
        muted = self._muted.get(vehicle.system, 0.0) > now
        for message in messages:
            raw = end.packers[vehicle.system].pack(message, time.time())
            if muted:
                continue
            if end.down.faults.any:
                end.down.put(raw, now, len(raw))
            else:
                self._put(end, raw)

    def _put(self, end: _End, raw: bytes) -> None:
        for peer in end.link.greet():
            end.link.send(peer, raw)


def _open(address: str, number: int) -> Link:
    """The link of the vehicle with this number."""
    kind, _, rest = address.partition(":")
    if kind == "tcpin" and number:
        host, _, port = rest.rpartition(":")
        address = f"{kind}:{host}:{int(port) + number if int(port) else 0}"
    link = parse_link(address)
    serves = isinstance(link, TcpLink) and kind == "tcpin"
    if not serves and not (isinstance(link, UdpLink) and kind == "udpout"):
        link.close()
        raise InputError(
            f"simulated vehicles speak on udpout:HOST:PORT or serve on tcpin:HOST:PORT, not on '{address}'"
        )
    return link


def make_swarm(
    count: int,
    *,
    autopilots: Sequence[Autopilot] = (Autopilot.ARDUPILOT,),
    home: tuple[float, float, float] = (47.397742, 8.545594, 488.0),
    spacing_m: float = 5.0,
    airframe: Airframe | None = None,
    as_flown: bool = False,
    seed: int = 0,
    boot_utc_s: float | None = None,
    **options: Any,
) -> list[SimVehicle]:
    """Vehicles 1 to count, standing in rows of ten beside home.

    Args:
        autopilots: dialects, taken in turn.
        home: latitude, longitude (degrees), altitude (metres) of the first; spacing_m: between neighbours.
        airframe: what they can do. as_flown: they take the times of real autopilots.
        seed: varies their receivers' errors and, a little, their headings.
        boot_utc_s: UTC of their boot; now unless said.
        options: more of SimVehicle.
    """
    if not 1 <= count <= 250:
        raise InputError(f"{count} simulated vehicles are not possible; choose 1 to 250")
    chart, random = Chart(*home), Random(seed)
    utc = time.time() if boot_utc_s is None else boot_utc_s
    swarm = []
    for number in range(count):
        lat, lon = chart.to_degrees(spacing_m * (number // 10), spacing_m * (number % 10))
        autopilot, frame = autopilots[number % len(autopilots)], airframe or Airframe()
        vehicle = SimVehicle(
            system=number + 1,
            autopilot=autopilot,
            home=(lat, lon, home[2]),
            airframe=frame.as_flown(DEFAULT.times(autopilot.value)) if as_flown else frame,
            boot_utc_s=utc,
            seed=seed,
            **options,
        )
        vehicle.flight.motion.yaw = random.uniform(-0.3, 0.3)
        swarm.append(vehicle)
    return swarm
