"""A vehicle's CAN bus, read into its poses: over an adapter, or through the vehicle's own MAVLink link.

Through the link the vehicle forwards its bus as CAN_FRAME and CANFD_FRAME messages as long as this is requested
(MAV_CMD_CAN_FORWARD), limited to the few messages that are read (CAN_FILTER_MODIFY).
"""

import logging
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.daemon.stoppable_thread import Background
from gcs_plugin.daemon.store.daemon_events import Events
from orthoswarm.model.errors import InputError, OrthoSwarmError
from telemetry.live.live_poses import LivePoses

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.fleet.vehicle_state import Vehicle
    from gcs_plugin.links.mavlink import Message
    from telemetry.live.dronecan_bus import CanSource

CAN: Final = "can:"
"""What a source on a CAN bus begins with: can:socketcan:can0, can:slcan:/dev/ttyACM0, can:mavlink."""

_TUNNEL: Final = "mavlink"
_AGAIN_S: Final = 2.0
_ASK_S: Final = 1.0  # ArduPilot stops 5 s after the last request
_SILENT_S: Final = 5.0
_log = logging.getLogger(__name__)


def check_bus(bus: str) -> None:
    """Check the name of a bus without opening it; raises InputError: there is no such kind of bus."""
    import can

    kind, _, channel = bus.partition(":")
    if kind == _TUNNEL and channel in ("", "1", "2", "3"):
        return
    if kind not in can.VALID_INTERFACES or not channel:
        raise InputError(
            f"'{CAN}{bus}' names no CAN bus; for example can:socketcan:can0, can:slcan:/dev/ttyACM0@1000000, "
            "can:udp_multicast:239.74.163.2, can:mavlink (the vehicle's first bus) or can:mavlink:2"
        )


class CanReader(Background):
    """Reads one vehicle's bus in its own thread."""

    def __init__(
        self, vehicle: str, bus: str, *, poses: LivePoses, events: Events, fleet: "Fleet", system: int | None
    ) -> None:
        """Make ready to read.

        Args:
            vehicle: id. bus: for example "socketcan:can0", or "mavlink" for the one behind the vehicle's link.
            poses: of the vehicle; receives the bus's poses.
            events: told when the bus cannot be read.
            fleet: the vehicles on links. system: the vehicle's MAVLink system id, None without.

        Raises:
            InputError: the bus is behind a link, and there is none.
        """
        from telemetry.live.dronecan_bus import CanSource

        super().__init__(f"CAN bus of {vehicle}")
        self.vehicle = vehicle
        self._bus, self._events, self._state, self._said = bus, events, "waiting", ""
        self._source = CanSource(poses)
        self._heard, self._count = float("-inf"), 0
        self._tunnel: _Tunnel | None = None
        if bus.partition(":")[0] == _TUNNEL:
            if not fleet.hub.sides or system is None:
                raise InputError(
                    f"the CAN bus of {vehicle} is behind its MAVLink link, and there is none; give --link, and the "
                    f"vehicle's system id in the workspace's orthoswarm.toml where its name is not v1 to v255"
                )
            self._tunnel = _Tunnel(fleet, system, int(bus.partition(":")[2] or 1), self._source)

    def document(self) -> dict[str, Any]:
        """Its state as JSON values: `bus`, `state` and, by node id, messages `received` and `lost`."""
        now, count = time.monotonic(), self._source.received
        if count != self._count:
            self._heard, self._count = now, count
        state = "receiving" if now - self._heard < _SILENT_S else self._state
        return {"bus": self._bus, "state": state, "nodes": self._source.nodes()}

    def _run(self) -> None:
        import can

        if self._tunnel is not None:
            self._tunnel.run(self._stop)
            return
        while not self._stop.is_set():
            try:
                self._state = "waiting"
                self._source.run(self._bus, self._stop)
                return
            except (OrthoSwarmError, OSError, can.CanError) as error:
                self._fail(str(error))
            self._stop.wait(_AGAIN_S)

    def _fail(self, reason: str) -> None:
        """Report a problem once; the connection is retried all the time."""
        if reason != self._said:
            self._events.say(f"the CAN bus of {self.vehicle}: {reason}")
        self._state = self._said = reason


class _Tunnel:
    """Requests the frames of one of a vehicle's buses, and receives them from its link."""

    def __init__(self, fleet: "Fleet", system: int, bus: int, source: "CanSource") -> None:
        self._fleet, self._system, self._bus, self._source = fleet, system, bus, source
        fleet.subscribe(self._message, "CAN_FRAME", "CANFD_FRAME")

    def run(self, stop: threading.Event) -> None:
        """Repeat the request until stopped, then end the forwarding."""
        while not stop.is_set():
            self._fleet.call(self._ask)
            stop.wait(_ASK_S)
        self._fleet.call(partial(self._send, [self._forward(0)]))

    def _message(self, vehicle: "Vehicle", message: "Message", utc_s: float) -> None:
        if vehicle.system == self._system and message.bus in (self._bus - 1, self._bus):
            self._source.feed(message)

    def _ask(self) -> None:
        from gcs_plugin.links.mavlink import dialect
        from telemetry.formats.log.dronecan_poses import MESSAGES

        kinds = [*MESSAGES, *([0] * (16 - len(MESSAGES)))]
        only = dialect.MAVLink_can_filter_modify_message(
            self._system, 1, self._bus - 1, dialect.CAN_FILTER_REPLACE, len(MESSAGES), kinds
        )
        self._send([self._forward(self._bus), only])

    def _forward(self, bus: int) -> "Message":
        from gcs_plugin.links.mavlink import dialect

        command = dialect.MAV_CMD_CAN_FORWARD
        return dialect.MAVLink_command_long_message(self._system, 1, command, 0, bus, 0, 0, 0, 0, 0, 0)

    def _send(self, messages: "list[Message]") -> None:
        """In the fleet's thread; nothing while the vehicle is not heard."""
        vehicle = self._fleet.vehicles.get(self._system)
        if vehicle is None or vehicle.lost:
            return
        for route in vehicle.routes.towards(time.monotonic(), everywhere=False):
            for message in messages:
                self._fleet.hub.send(route.side, route.peer, message)
