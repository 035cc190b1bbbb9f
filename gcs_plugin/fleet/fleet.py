"""The vehicles on the links: discovery, loss, routing by system id, streams, dialogues, completion of missions.

One thread polls it (`poll`, or `run` until `stop` is set); other threads submit work with `call`. Nothing that a
vehicle could act on is sent without a request: the fleet by itself sends its heartbeat, which announces a
ground station, asks for streams and clocks, and asks a vehicle that would not arm for the reasons.
"""

import itertools
import logging
import math
import threading
import time
from collections.abc import Callable, Container, Iterable, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Final, TypeVar

from gcs_plugin.config import COMMAND
from gcs_plugin.fleet.commands import URGENT, Order, Verb
from gcs_plugin.fleet.dialogues import Dialogues, continued, resumed
from gcs_plugin.fleet.heard_messages import MESSAGE_IDS
from gcs_plugin.fleet.link_hub import Hub
from gcs_plugin.fleet.reception import FleetEvent, Handler, Reception
from gcs_plugin.fleet.separation.separation_watch import NUMBERED, VehicleNames
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Autopilot, Message
from gcs_plugin.links.packets import Packet
from gcs_plugin.links.transports import Link
from gcs_plugin.mission.completion import Phase
from gcs_plugin.mission.download import AT_ONCE, MissionDownload
from gcs_plugin.mission.exchange import GROUND_STATION, MISSION, Address, Exchange, Verdict
from gcs_plugin.mission.flight_modes import why_no_missions
from gcs_plugin.mission.geofence import FENCE, FenceZone, fence_mission
from gcs_plugin.mission.items import Mission
from gcs_plugin.mission.start_dialogue import Expected, break_off, start_mission
from gcs_plugin.mission.upload import MissionUpload
from orthoswarm.model.errors import OrthoSwarmError

Result = TypeVar("Result")
Dialogue = TypeVar("Dialogue", bound=Exchange)

_log = logging.getLogger(__name__)
_TICK_S: Final = 0.25
_BATCH_S: Final = 0.04
_READ_S: Final = 10.0  # silence after which a list that nobody waits for is read later
_READS: Final = 4  # missions that are read at once while nobody waits for them: a radio has other things to carry
_PAUSE_SHOWS_S: Final = 5.0
_SURE_S: Final = 2.5  # an older state of a vehicle does not override a command that ends its flight


class Fleet:
    """All vehicles on all links.

    Attributes:
        vehicles: by system id, lost ones included.
        own: our address.
        hub: the links. signed: whether it has a key.
        separation: watches the distances of vehicles in the air.
        takeoffs: those whose takeoff waits or is being checked; they take no other mission.
        names: what vehicles are called where an event is about two of them.
        stops: number of the last command to pause, return or land, by system id; see `told_to_stop`.
    """

    def __init__(
        self,
        links: Iterable[Link | str],
        *,
        own: Address = GROUND_STATION,
        key: bytes | None = None,
        tlog: Path | None = None,
        takeoffs: Container[int] = (),
        names: VehicleNames = NUMBERED,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        """Open the links.

        Args:
            links: links or their addresses (`links.parse_link`).
            own: our address; different from that of another ground station.
            key: signing key; with it only signed packets are accepted.
            tlog: telemetry log to append to.
            takeoffs, names: see above. clock: monotonic seconds. wall: UTC epoch seconds.

        Raises:
            InputError: a link cannot be opened.
        """
        self.own, self.vehicles, self.signed = own, dict[int, Vehicle](), key is not None
        self.hub = Hub(links, own, key=key, tlog=tlog, clock=clock, wall=wall)
        self._clock = clock
        self._listeners: list[Callable[[FleetEvent], None]] = []
        self._pauses: dict[int, tuple[Exchange, float]] = {}
        self._told_home: dict[int, float] = {}
        self._dialogues = Dialogues(self.vehicles, self.hub, clock, signed=self.signed)
        self._reception = Reception(
            self.vehicles, self.hub, dialogues=self._dialogues, own=own, event=self._publish, wall=wall, names=names
        )
        self.separation = self._reception.separation
        self.takeoffs, self.names = takeoffs, names
        self.stops: dict[int, int] = {}
        self._stop_numbers = itertools.count(1)
        self._tick_at = 0.0
        self._thread: int | None = None

    def close(self) -> None:
        """Close links and log."""
        self.hub.close()

    def __enter__(self) -> "Fleet":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- who listens ---

    def on_event(self, listener: Callable[[FleetEvent], None]) -> None:
        """Call a function with each event, in the polling thread."""
        self._listeners.append(listener)

    def subscribe(self, handler: Handler, *names: str) -> None:
        """Call handler(vehicle, message, UTC seconds of arrival) for messages of these names, in the polling thread.

        Messages of all components of a vehicle count, its camera's and gimbal's, too. No names: every message.
        """
        for number in [MESSAGE_IDS[name] for name in names] or MESSAGE_IDS.values():
            self._reception.handlers.setdefault(number, []).append(handler)

    def tap(self, listener: Callable[[Packet, float], None]) -> None:
        """Call a function with every packet and the UTC seconds of its arrival, undecoded."""
        self._reception.taps.append(listener)

    # --- what is asked for ---

    def begin(self, dialogue: Dialogue) -> Dialogue:
        """Start a dialogue; its outcome is set some time later while the fleet is polled."""
        self._dialogues.begin(dialogue)
        return dialogue

    def order(self, order: Order) -> Order:
        """Give a command to a vehicle; its outcome is set some time later while the fleet is polled.

        A command is sent only while it is fresh (`COMMAND.fresh_s`). Pause, RTL and land are never held
        back for doubts about identity or link: with several claimants of one system id they go to all of them, and
        to a lost vehicle on every route on which it was heard.
        """
        now = self._clock()
        if order.verb in URGENT:
            self.told_to_stop(order.system)
        elif order.stops is not None and order.stops != self.stops.get(order.system, 0):
            text = f"vehicle {order.system} was told to stop after its '{order.verb}' was given, so that was not sent"
            return order.end(text, Verdict.NOT_SENT)
        if now > order.expires_s:
            text = f"vehicle {order.system}: '{order.verb}' was given {now - order.given_s:.0f} s ago and was not sent"
            return order.end(f"{text}; give it again", Verdict.NOT_SENT)
        try:
            exchange = self._start(order) if order.verb == "start" else self._dialogue(order.verb, order.system)
        except OrthoSwarmError as error:
            silent = order.system not in self.vehicles or self.vehicles[order.system].lost
            return order.end(str(error), Verdict.NOT_SENT if silent else Verdict.REFUSED)
        exchange.expires = order.expires_s
        order.exchange = self.begin(exchange)
        return order

    def told_to_stop(self, system: int) -> None:
        """Make a start void that was given to a vehicle before now; from any thread."""
        self.stops[system] = next(self._stop_numbers)

    def send(self, system: int, messages: Sequence[Message]) -> None:
        """Send messages without waiting for answers; in the polling thread. Nothing is sent to an unknown vehicle."""
        self._dialogues.send(system, messages)

    def system_of(self, name: str) -> int:
        """The system id of a vehicle, by what it is called or that number; from any thread.

        Raises:
            OrthoSwarmError: it was not heard on any link.
        """
        called = {system: self.names.name_of(system) for system in list(self.vehicles)}
        for system in called:
            if name in (called[system], str(system)):
                return system
        heard = ", ".join(called[system] for system in sorted(called)) or "none"
        raise OrthoSwarmError(f"{name} is not on the links (heard: {heard}); check links and system ids")

    def vehicle(self, system: int) -> Vehicle:
        """A vehicle that can be commanded.

        Raises:
            OrthoSwarmError: it was never heard, is lost, or shares its system id with another.
        """
        vehicle = self._known(system)
        if vehicle.claimants:
            who = ", ".join(vehicle.claimants)
            raise OrthoSwarmError(f"several vehicles use system id {system} ({who}); give each an id of its own")
        if vehicle.lost:
            raise OrthoSwarmError(f"vehicle {system} is lost; wait until it is heard again")
        return vehicle

    def upload(self, system: int, mission: Mission) -> MissionUpload:
        """Put a mission into a vehicle and read it back.

        Raises:
            OrthoSwarmError: the vehicle is not there, is not a multirotor, is flying its mission, is about to take
                off, or is busy with another upload or start.
        """
        if system in self.takeoffs:
            raise OrthoSwarmError(f"vehicle {system} waits for its takeoff with the mission it has; cancel that first")
        vehicle = self._flies_missions(system)
        if vehicle.detector.phase is Phase.ACTIVE and vehicle.armed and not self._was_just_paused(system):
            raise OrthoSwarmError(f"vehicle {system} is flying its mission; pause it or let it return first")
        if mission.autopilot is not vehicle.autopilot:
            kind = vehicle.autopilot.value
            text = f"vehicle {system} is {kind}, but the mission was built for {mission.autopilot.value}"
            raise OrthoSwarmError(text)
        vehicle.mission = None
        vehicle.detector.uploaded(None)
        # In AUTO, even paused, ArduPilot flies the item that is stored under the current number: a new RTL at once.
        in_auto = vehicle.autopilot is Autopilot.ARDUPILOT and vehicle.custom_mode == vehicle.modes.mission
        leave = vehicle.pilot.set_mode(vehicle.modes.hold) if in_auto and vehicle.armed else None
        if leave is not None:
            leave.expires = self._clock() + COMMAND.fresh_s
        return self.begin(MissionUpload(vehicle.address, self.own, mission=mission, leave=leave))

    def upload_fence(self, system: int, zones: Sequence[FenceZone]) -> MissionUpload:
        """Put a geofence into a vehicle, in place of the one that it holds, and read it back.

        Raises:
            OrthoSwarmError: the vehicle is not there, is in the air, or is busy.
        """
        vehicle = self._free(system)
        if vehicle.flying:
            raise OrthoSwarmError(f"vehicle {system} is in the air: its geofence is changed on the ground only")
        return self.begin(MissionUpload(vehicle.address, self.own, mission=fence_mission(zones, vehicle.autopilot)))

    def download(self, system: int) -> MissionDownload:
        """Read the mission of a vehicle, and ask for the settings that a check compares with it."""
        vehicle = self._free(system)
        self.ask_settings(system)
        return self.begin(MissionDownload(vehicle.address, self.own, window=AT_ONCE[vehicle.autopilot]))

    def ask_settings(self, system: int) -> None:
        """Ask a vehicle for its settings; in the polling thread."""
        self._dialogues.send(system, self.vehicles[system].questions.ask(self._clock()))

    def read_fence(self, system: int) -> MissionDownload:
        """Read the geofence of a vehicle; any other request to it ends this.

        Raises:
            OrthoSwarmError: the vehicle is not there, or busy.
        """
        vehicle = self.vehicle(system)
        if self._dialogues.talks(system):
            raise OrthoSwarmError(f"vehicle {system} is busy with another request; wait until that has ended")
        return self._read(vehicle, FENCE)

    def read_mission(self, system: int) -> None:
        """Read what a vehicle holds, and its settings, if it can be asked now; any other request to it ends this."""
        vehicle = self.vehicles[system]
        self.ask_settings(system)
        if not (vehicle.lost or vehicle.claimants or self._dialogues.talks(system)):
            vehicle.read_at = self._clock() + _READ_S
            self._read(vehicle)

    def reads(self, system: int) -> bool:
        """True while a vehicle's mission is being read."""
        return self._dialogues.reads(system)

    def _read(self, vehicle: Vehicle, list_type: int = MISSION) -> MissionDownload:
        to, window = vehicle.address, AT_ONCE[vehicle.autopilot]
        background = MissionDownload(to, self.own, _READ_S, list_type=list_type, background=True, window=window)
        return self.begin(background)

    def start(self, system: int) -> Exchange:
        """Start a vehicle's mission from the beginning, see `mission.start_dialogue`."""
        return self._now(self._start(Order(verb="start", system=system, given_s=self._clock())))

    def pause(self, system: int) -> Exchange:
        """Make a vehicle hold its position."""
        return self._now(self._dialogue("pause", system))

    def resume(self, system: int) -> Exchange:
        """Make a vehicle continue what was paused: its mission, or its way home."""
        return self._now(self._dialogue("resume", system))

    def rtl(self, system: int) -> Exchange:
        """Make a vehicle fly home and land."""
        return self._now(self._dialogue("rtl", system))

    def land(self, system: int) -> Exchange:
        """Make a vehicle land at its position."""
        return self._now(self._dialogue("land", system))

    def problems(self) -> list[str]:
        """Broken links, rejected packets, vehicles that sign and those that share a system id; from any thread."""
        hub, vehicles, name_of = self.hub, list(self.vehicles.values()), self.names.name_of
        problems = [f"{side.link.name}: {side.link.problem}" for side in hub.sides if side.link.problem]
        if hub.rejected:
            problems.append(f"{hub.rejected} packets had no valid signature; check the signing key")
        signs = "signs its messages and ignores unsigned ones; give its key in ORTHOSWARM_SIGNING_KEY_FILE"
        problems += [f"{name_of(v.system)} {signs}" for v in vehicles if v.signs and not self.signed]
        shared = [(v.system, ", ".join(v.claimants)) for v in vehicles if v.claimants]
        return problems + [f"several vehicles use the system id of {name_of(system)}: {who}" for system, who in shared]

    def behind(self, system: int) -> str:
        """How far a vehicle is behind its plan, in words; empty if it is not."""
        return self._reception.behind(system)

    def behind_ordered(self, system: int) -> bool:
        """Whether a vehicle is behind its plan because it was paused, and for no other reason."""
        return self._reception.behind_ordered(system)

    def busy(self, system: int) -> bool:
        """True while a dialogue with a vehicle is under way."""
        return self._dialogues.busy(system)

    def starting(self, system: int) -> bool:
        """True while a vehicle's start is under way."""
        return self._dialogues.starting(system)

    def _free(self, system: int) -> Vehicle:
        vehicle = self.vehicle(system)
        self._dialogues.end_background(system)
        if self.busy(system):
            raise OrthoSwarmError(f"vehicle {system} is busy with another request; wait until that has ended")
        return vehicle

    def _flies_missions(self, system: int) -> Vehicle:
        vehicle = self._free(system)
        if why := why_no_missions(vehicle.kind):
            raise OrthoSwarmError(f"vehicle {system} {why}")
        return vehicle

    def _now(self, exchange: Exchange) -> Exchange:
        """Begin what is asked for now."""
        exchange.expires = self._clock() + COMMAND.fresh_s
        return self.begin(exchange)

    def _dialogue(self, verb: Verb, system: int) -> Exchange:
        """The dialogue for a command, not started yet; raises OrthoSwarmError where it cannot be given."""
        vehicle = self._known(system) if verb in URGENT else self.vehicle(system)
        sure = not vehicle.claimants and self._clock() - vehicle.heard < _SURE_S
        starting = self._dialogues.starting(system)
        if verb == "pause" and sure and not vehicle.armed and not starting:
            raise OrthoSwarmError(f"vehicle {system} is not armed, so there is nothing to pause")
        goes_on = None if verb not in ("resume", "continue") else self._goes_on(vehicle, verb)
        self._dialogues.make_way(system)
        self._pauses.pop(system, None)
        vehicle.told_to_stay = verb == "pause"
        if verb in ("rtl", "land"):
            self._told_home[system] = self._clock()
        if starting and verb in URGENT and not vehicle.flying:
            return break_off(vehicle.pilot, verb)
        if verb == "pause":
            self._pauses[system] = (vehicle.pilot.pause(held=vehicle.custom_mode == vehicle.modes.hold), self._clock())
            return self._pauses[system][0]
        return goes_on or {"rtl": vehicle.pilot.rtl, "land": vehicle.pilot.land}[verb]()

    def _goes_on(self, vehicle: Vehicle, verb: Verb) -> Exchange:
        """See `going_on`; raises OrthoSwarmError if there is nothing to go on with."""
        told_s = self._clock() - self._told_home.get(vehicle.system, -math.inf)
        if verb == "resume" and told_s < _PAUSE_SHOWS_S:  # its mode may be older
            raise OrthoSwarmError(f"vehicle {vehicle.system} was told to return or land just now; it is not resumed")
        return resumed(vehicle) if verb == "resume" else continued(vehicle)

    def _start(self, order: Order) -> Exchange:
        """The dialogue of a start."""
        vehicle = self._flies_missions(order.system)
        if vehicle.detector.phase is Phase.ACTIVE and vehicle.armed:
            raise OrthoSwarmError(f"vehicle {order.system} is flying its mission already")
        vehicle.told_to_stay = False
        then = order.standing or vehicle.standing
        if why := vehicle.changed_since(then):
            raise OrthoSwarmError(f"vehicle {order.system} {why} since its start was given, so it was not started")
        known = vehicle.mission if vehicle.detector.knows else None
        mission = order.mission or known
        held_id = vehicle.held_id if known is not None and (order.mission is None or order.mission == known) else 0
        expected = Expected(autopilot=vehicle.autopilot, in_air=vehicle.flying, mission=mission, known_id=held_id)
        return start_mission(vehicle.pilot, then, expected)

    def _was_just_paused(self, system: int) -> bool:
        """True between a vehicle's acknowledgement of a pause and the report of its mission's state that shows it."""
        exchange, given = self._pauses.get(system, (None, 0.0))
        done = exchange is not None and exchange.outcome is not None and exchange.outcome.ok
        return done and self._clock() - given < _PAUSE_SHOWS_S

    def _known(self, system: int) -> Vehicle:
        vehicle = self.vehicles.get(system)
        if vehicle is None:
            known = ", ".join(str(number) for number in sorted(self.vehicles)) or "none"
            raise OrthoSwarmError(f"vehicle {system} is not on the links (heard: {known}); check links and system ids")
        return vehicle

    # --- the loop ---

    def poll(self, timeout_s: float = 0.1) -> None:
        """Wait for input until the time-out, process all of it, and do what is due."""
        due = min(self._tick_at, self._dialogues.deadline)
        self.hub.poll(min(timeout_s, due - self._clock()), self._reception.packet)
        now = self._clock()
        self._dialogues.tick(now)
        if now >= self._tick_at:
            self._tick_at = now + _TICK_S
            self._reception.tick(now)
            self._read_missions(now)

    def _read_missions(self, now: float) -> None:
        """Read what vehicles hold where that is not known or may have changed, while nothing else asks them."""
        room = _READS - sum(isinstance(job, MissionDownload) and job.background for job in self._dialogues.jobs)
        for system, vehicle in self.vehicles.items():
            if room <= 0:
                return
            idle = not (vehicle.lost or vehicle.claimants or self._dialogues.talks(system))
            if not idle or not vehicle.mission_total or now < vehicle.read_at:
                continue
            vehicle.read_at, room = now + _READ_S, room - 1
            self._read(vehicle)

    def run(self, stop: threading.Event) -> None:
        """Poll until `stop` is set. Input is read in small batches, which avoids most wake-ups."""
        self._thread = threading.get_ident()
        while not stop.is_set():
            try:
                self.poll(0.5)
            except Exception:  # of a listener, or of one message: no fault may cut the vehicles off from commands
                _log.exception("a fault while reading the links; they are read on")
            if not self._dialogues.jobs:
                time.sleep(_BATCH_S)
        self._thread = None

    def run_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Poll until a condition holds or the time-out; returns whether it holds."""
        end = self._clock() + timeout_s
        while not done():
            left = end - self._clock()
            if left <= 0.0:
                return False
            self.poll(min(left, 0.5))
        return True

    def call(self, work: Callable[[], Result]) -> "Future[Result]":
        """Run a function in the polling thread; from any thread."""
        future: Future[Result] = Future()

        def do() -> None:
            try:
                future.set_result(work())
            except BaseException as error:  # passed to the caller
                future.set_exception(error)

        if self._thread == threading.get_ident():
            do()
        else:
            self.hub.post(do)
        return future

    def _publish(self, event: FleetEvent) -> None:
        for listener in self._listeners:
            listener(event)
