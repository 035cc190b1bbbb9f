"""The MAVSDK backend: links and mission transfer by MAVSDK (`mission_raw`), everything else by our own code.

MAVSDK's high-level `mission` plugin does not suit ArduPilot (no home item, RTL refused), and `is_mission_finished` is
never true for a mission that ends with LAND. So missions are transferred by `mission_raw`, downloaded again and
compared; the end of a mission is found by the same detector as in the default backend, from the messages that
`mavlink_direct` delivers as JSON. It delivers no raw packets: no telemetry log, no signing, links not distinguished.
"""

import json
import queue
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Final

from gcs_plugin.backends.backend import Backend, Report
from gcs_plugin.config import HEARING
from gcs_plugin.fleet.commands import URGENT, Order, Verb
from gcs_plugin.fleet.dialogues import continued, resumed
from gcs_plugin.fleet.heard_messages import HEARD, MESSAGE_IDS, rates_of
from gcs_plugin.fleet.message_rates import Streams
from gcs_plugin.fleet.reception import FleetEvent, mission_event
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import AUTOPILOT_COMPONENT, Autopilot, Message, is_vehicle
from gcs_plugin.links.transports import parse_address
from gcs_plugin.mission.completion import CompletionDetector, Phase
from gcs_plugin.mission.exchange import Address, Exchange, Outcome, Verdict
from gcs_plugin.mission.flight_modes import modes_of, why_no_missions
from gcs_plugin.mission.geofence import FenceZone, zones_of
from gcs_plugin.mission.items import Mission, MissionItem, difference
from gcs_plugin.mission.start_dialogue import Expected, start_mission
from orthoswarm.model.errors import InputError, OrthoSwarmError

# What pictures get their poses from: a telemetry log, of which there is none.
_POSES: Final = frozenset(
    MESSAGE_IDS[name] for name in ("ATTITUDE", "SYSTEM_TIME", "GIMBAL_DEVICE_ATTITUDE_STATUS", "DISTANCE_SENSOR")
)
_NAMES: Final = [name for name, kind in MESSAGE_IDS.items() if kind in HEARD.keys() - _POSES]
_MOST_HZ: Final = 2.0
_ATTEMPTS: Final = 4  # uploads until what is stored agrees


class JsonMessage:
    """A message of `mavlink_direct` with the interface of a pymavlink message."""

    def __init__(self, fields: Mapping[str, Any]) -> None:
        self.__dict__.update(fields)
        self._name, self._number = str(fields["message_name"]), int(fields["message_id"])

    def get_type(self) -> str:
        """Its name."""
        return self._name

    def get_msgId(self) -> int:
        """Its number."""
        return self._number


@dataclass(slots=True, eq=False)
class _Craft:
    """A vehicle, and MAVSDK's handles for it."""

    vehicle: Vehicle
    system: Any
    direct: Any
    raw: Any
    jobs: list[Exchange] = field(default_factory=list)


class MavsdkBackend(Backend):
    """Vehicles through MAVSDK."""

    name = "mavsdk"

    def __init__(self, links: Sequence[str], *, own: Address) -> None:
        """Open the links; raises InputError: MAVSDK is missing, or an address is wrong."""
        try:
            from mavsdk import Configuration, ConnectionResult, Mavsdk, log_subscribe
        except ImportError as error:
            raise InputError(f"MAVSDK cannot be loaded ({error}); pip install mavsdk, or --backend pymavlink") from None
        log_subscribe(lambda *_: True)  # otherwise it logs to stdout, which is reserved for results
        self.events: list[FleetEvent] = []
        self._own = own
        self._queue: queue.SimpleQueue[tuple[int, JsonMessage]] = queue.SimpleQueue()
        self._systems: dict[int, tuple[Any, Any]] = {}
        self._crafts: dict[int, _Craft] = {}
        self._mavsdk = Mavsdk(Configuration.create_manual(own.system, own.component, True))
        for link in links:
            result = self._mavsdk.add_any_connection(str(parse_address(link)))
            if result != ConnectionResult.SUCCESS:
                self.close()
                raise InputError(f"MAVSDK cannot open link {link} ({result.name.lower()}); is the port in use?")

    def close(self) -> None:
        """Close the links."""
        self._crafts.clear()
        self._mavsdk.destroy()

    def vehicles(self) -> Mapping[int, Vehicle]:
        """Those whose messages MAVSDK passes on."""
        return {system: craft.vehicle for system, craft in self._crafts.items()}

    def vehicle(self, system: int) -> Vehicle:
        """One of them."""
        return self._craft(system).vehicle

    def is_known(self, vehicle: Vehicle) -> bool:
        """Whether its place and landed state have arrived."""
        return vehicle.lat_deg is not None and bool(vehicle.landed)

    def problems(self) -> list[str]:
        """Empty: MAVSDK does not report problems of links."""
        return []

    def upload(self, missions: Mapping[int, Mission], report: Report) -> dict[int, Outcome]:
        """Uploads in threads, since MAVSDK's calls block."""
        with ThreadPoolExecutor(max_workers=min(16, max(1, len(missions)))) as pool:
            futures = {s: pool.submit(self._upload, s, mission) for s, mission in missions.items()}
            while not all(future.done() for future in futures.values()):
                self.pump(0.1)
                report("upload", sum(future.done() for future in futures.values()), len(futures))
        outcomes = {s: future.result() for s, future in futures.items()}
        for s, outcome in outcomes.items():
            if outcome.ok:
                self._crafts[s].vehicle.mission = missions[s]
                self._crafts[s].vehicle.detector.uploaded(missions[s])
        return outcomes

    def stored(self, systems: Collection[int], report: Report) -> dict[int, Mission | None]:
        """Downloads one after the other, since MAVSDK's calls block."""
        found: dict[int, Mission | None] = {}
        for system in systems:
            craft = self._crafts[system]
            self._send(craft, craft.vehicle.questions.ask(time.monotonic()))
            found[system] = craft.vehicle.mission = self._read(system)
            report("read", len(found), len(systems))
        return found

    def zones(self, systems: Collection[int], report: Report) -> dict[int, tuple[FenceZone, ...]]:
        """Downloads one after the other."""
        found: dict[int, tuple[FenceZone, ...]] = {}
        for count, system in enumerate(systems, 1):
            items = _downloaded(self._crafts[system].raw.download_geofence)
            if items is not None:
                found[system] = tuple(zones_of(items))
            report("read", count, len(systems))
        return found

    def order(self, order: Order) -> Order:
        """Give a command."""
        try:
            order.exchange = self._begin(order)
        except OrthoSwarmError as error:
            return order.end(str(error), Verdict.REFUSED)
        return order

    def send(self, system: int, messages: Sequence[Message]) -> None:
        """Send through MAVSDK."""
        self._send(self._craft(system), messages)

    def watch(self, systems: Collection[int], seconds: float, report: Callable[[FleetEvent], None]) -> bool:
        """Read missions that are not known, whose last items decide how they end, and follow them."""
        for system in systems or list(self._crafts):
            detector = self._craft(system).vehicle.detector
            if not detector.knows and (mission := self._read(system)) is not None:
                detector.knows_mission(mission)
        return super().watch(systems, seconds, report)

    # --- vehicles ---

    def _craft(self, system: int) -> _Craft:
        craft = self._crafts.get(system)
        if craft is None:
            known = ", ".join(str(number) for number in sorted(self._crafts)) or "none"
            raise OrthoSwarmError(f"vehicle {system} is not on the links (heard: {known}); check links and system ids")
        return craft

    def look(self) -> None:
        """Listen to systems that MAVSDK has discovered.

        Each becomes a vehicle by its own HEARTBEAT: at first MAVSDK may take its autopilot for another, and of what
        was not heard nobody can say that it is disarmed.
        """
        from mavsdk.plugins.mavlink_direct import MavlinkDirect

        if self._mavsdk.system_count() == len(self._systems):
            return
        for system in self._mavsdk.get_systems():
            number = int(system.get_system_id())
            if number not in self._systems:
                self._systems[number] = system, MavlinkDirect(system)
                self._systems[number][1].subscribe_message("HEARTBEAT", self._listener(number))

    def _meet(self, number: int, heartbeat: Message) -> _Craft | None:
        """A vehicle that is new by its heartbeat; None if the message is none."""
        from mavsdk.plugins.mission_raw import MissionRaw

        address = Address(number)
        if heartbeat.get_type() != "HEARTBEAT" or not is_vehicle(heartbeat, address.component):
            return None
        (system, direct), autopilot = self._systems[number], Autopilot.of(heartbeat)
        rates = {k: hz for k, hz in rates_of(autopilot, _MOST_HZ).items() if k not in _POSES}
        vehicle = Vehicle(
            address=address,
            autopilot=autopilot,
            modes=modes_of(autopilot, int(heartbeat.type)),
            detector=CompletionDetector(autopilot=autopilot),
            streams=Streams(vehicle=address, own=self._own, rates=rates),
            heard=time.monotonic(),
        )
        craft = self._crafts[number] = _Craft(vehicle, system, direct, MissionRaw(system))
        for name in _NAMES:
            if name != "HEARTBEAT":
                direct.subscribe_message(name, self._listener(number))
        self._event("found", number, f"was found ({autopilot.value})")
        self._send(craft, vehicle.streams.start(time.monotonic()))
        return craft

    def _listener(self, number: int) -> Callable[[Any, Any], None]:
        def take(message: Any, _data: Any) -> None:  # in MAVSDK's thread
            if message.component_id == AUTOPILOT_COMPONENT and message.system_id == number:
                self._queue.put((number, JsonMessage(json.loads(message.fields_json))))

        return take

    def pump(self, seconds: float) -> None:
        """Process received messages, and the time-outs of exchanges in progress."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            try:
                number, message = self._queue.get(timeout=left)
            except queue.Empty:
                break
            craft = self._crafts.get(number) or self._meet(number, message)
            if craft is not None:
                self._take(craft, message, time.monotonic())
        now = time.monotonic()
        for craft in self._crafts.values():
            self._send(craft, [*craft.vehicle.streams.tick(now), *craft.vehicle.questions.tick(now)])
            for job in list(craft.jobs):
                if now >= job.deadline:
                    self._drive(craft, job, job.tick(now))
            craft.jobs = [job for job in craft.jobs if job.outcome is None]
            vehicle = craft.vehicle
            if not vehicle.lost and now - vehicle.heard > HEARING.lost_s:
                vehicle.lost = True
                self._event("lost", vehicle.system, f"has been silent for {HEARING.lost_s:.0f} s")

    def _take(self, craft: _Craft, message: Message, now: float) -> None:
        vehicle = craft.vehicle
        vehicle.heard, vehicle.received = now, vehicle.received + 1
        if vehicle.lost:
            vehicle.lost = False
            self._event("regained", vehicle.system, "is heard again")
        vehicle.update(message)
        vehicle.streams.seen(message.get_msgId(), now)
        if message.get_type() == "COMMAND_ACK":
            self._send(craft, vehicle.streams.acknowledged(message, now))
        for event in vehicle.detector.feed(message):
            kind, text = mission_event(event, craft.vehicle)
            self._event(kind, vehicle.system, text)
        for job in list(craft.jobs):
            if job.outcome is None:
                self._drive(craft, job, job.feed(message, now))

    def _send(self, craft: _Craft, messages: Sequence[Message]) -> None:
        from mavsdk.plugins.mavlink_direct import MavlinkMessage

        for message in messages:
            fields = message.to_dict()
            name = fields.pop("mavpackettype")
            to = craft.vehicle.address
            craft.direct.send_message(
                MavlinkMessage(name, self._own.system, self._own.component, to.system, to.component, json.dumps(fields))
            )

    def _event(self, kind: str, system: int, text: str) -> None:
        self.events.append(FleetEvent(kind=kind, system=system, time_s=time.time(), text=f"vehicle {system} {text}"))

    # --- missions and commands ---

    def _upload(self, system: int, mission: Mission) -> Outcome:
        """Upload and read back; runs in its own thread."""
        craft = self._crafts.get(system)
        if craft is None:
            return Outcome(ok=False, text=f"vehicle {system} is not on the links; check links and system ids")
        if craft.vehicle.detector.phase is Phase.ACTIVE and craft.vehicle.armed:
            return Outcome(ok=False, text=f"vehicle {system} is flying its mission; pause it or let it return first")
        in_auto = craft.vehicle.armed and craft.vehicle.custom_mode == craft.vehicle.modes.mission
        if in_auto and craft.vehicle.autopilot is Autopilot.ARDUPILOT:
            text = f"vehicle {system} is in its mission's mode and would fly items as they come; let it return first"
            return Outcome(ok=False, text=text)
        if why := why_no_missions(craft.vehicle.kind):
            return Outcome(ok=False, text=f"vehicle {system} {why}")
        wrong = ""
        for _ in range(_ATTEMPTS):
            refused = self._write(craft, mission)
            stored = self._read(system)
            if stored is None:
                wrong = f"vehicle {system} could not be read back {refused}; upload again before flying"
                continue
            found = difference(mission, stored.items)
            if not found:
                return Outcome(ok=True, text=f"vehicle {system} holds the mission: {len(mission)} items, read back")
            if refused:
                return Outcome(ok=False, text=f"vehicle {system} refused the mission {refused}; {found}")
            wrong = f"vehicle {system} holds another mission than was sent: {found}; upload again before flying"
        return Outcome(ok=False, text=wrong)

    def _write(self, craft: _Craft, mission: Mission) -> str:
        """Upload; returns the reason of a failure, empty on success."""
        from mavsdk.plugins.mission_raw import MissionItem as RawItem
        from mavsdk.plugins.mission_raw import MissionRawError

        items = [
            RawItem(
                seq=seq, frame=item.frame, command=item.command, current=int(seq == 0),
                autocontinue=int(item.autocontinue), param1=item.params[0], param2=item.params[1],
                param3=item.params[2], param4=item.params[3], x=item.x, y=item.y, z=item.z, mission_type=0,
            )
            for seq, item in enumerate(mission.items)
        ]  # fmt: skip
        try:
            craft.raw.upload_mission(items)
        except MissionRawError as error:
            return f"({error.result.name.lower().replace('_', ' ')})"
        return ""

    def _read(self, system: int) -> Mission | None:
        """The mission stored in a vehicle, None if the download fails."""
        craft = self._crafts[system]
        items = _downloaded(craft.raw.download_mission)
        return None if items is None else Mission(craft.vehicle.autopilot, items)

    def _begin(self, order: Order) -> Exchange:
        craft = self._craft(order.system)
        vehicle = craft.vehicle
        if vehicle.lost and order.verb not in URGENT:
            raise OrthoSwarmError(f"vehicle {order.system} is lost; wait until it is heard again")
        for job in craft.jobs:
            job.cancel("another command came in between")
        job = self._start(vehicle, order) if order.verb == "start" else self._dialogue(vehicle, order.verb)
        job.expires = order.expires_s
        craft.jobs.append(job)
        self._drive(craft, job, job.start(time.monotonic()))
        return job

    def _drive(self, craft: _Craft, job: Exchange, messages: Sequence[Message]) -> None:
        self._send(craft, messages)
        for _ in messages:
            job.took()

    def _dialogue(self, vehicle: Vehicle, verb: Verb) -> Exchange:
        if verb == "pause":
            if not vehicle.armed and not vehicle.lost:
                raise OrthoSwarmError(f"vehicle {vehicle.system} is not armed, so there is nothing to pause")
            return vehicle.pilot.pause(held=vehicle.custom_mode == vehicle.modes.hold)
        if verb in ("resume", "continue"):
            return resumed(vehicle) if verb == "resume" else continued(vehicle)
        return vehicle.pilot.rtl() if verb == "rtl" else vehicle.pilot.land()

    def _start(self, vehicle: Vehicle, order: Order) -> Exchange:
        name = f"vehicle {vehicle.system}"
        if vehicle.detector.phase is Phase.ACTIVE and vehicle.armed:
            raise OrthoSwarmError(f"{name} is flying its mission already")
        if why := why_no_missions(vehicle.kind):
            raise OrthoSwarmError(f"{name} {why}")
        then = order.standing or vehicle.standing
        if why := vehicle.changed_since(then):
            raise OrthoSwarmError(f"{name} {why} since its start was given, so it was not started")
        expected = Expected(autopilot=vehicle.autopilot, in_air=vehicle.flying, mission=order.mission)
        mission = self._read(vehicle.system)
        wrong = "did not send its mission" if mission is None else expected.wrong(mission)
        if mission is None or wrong:
            raise OrthoSwarmError(f"{name} {wrong}")
        vehicle.detector.knows_mission(mission)
        return start_mission(vehicle.pilot, then, expected, reads=False)


def _downloaded(download: Callable[[], Any]) -> tuple[MissionItem, ...] | None:
    """The items of a list that MAVSDK downloads, None if that fails."""
    from mavsdk.plugins.mission_raw import MissionRawError

    try:
        raw = download()
    except MissionRawError:
        return None
    return tuple(
        MissionItem(
            command=i.command, frame=i.frame, params=(i.param1, i.param2, i.param3, i.param4), x=i.x, y=i.y, z=i.z
        )
        for i in raw
    )
