"""A MAVLink router: shares the autopilot's single link between the simulated camera and a ground station.

It works like mavlink-router on a companion computer: packets of the vehicles are forwarded to the ground unchanged,
signatures included; packets of the ground go to the vehicle that is their target, or to all.
"""

import threading
from typing import TYPE_CHECKING, Final

from gcs_plugin.fleet.link_hub import Hub, Side
from gcs_plugin.links.transports import Link, Peer
from gcs_plugin.mission.exchange import Address

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.links.packets import Packet

_WAIT_S: Final = 0.5


class Relay:
    """Forwards packets between a fleet's vehicles and a ground station.

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
