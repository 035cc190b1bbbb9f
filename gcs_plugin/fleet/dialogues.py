"""Runs the active dialogues with vehicles and records their results; and what a vehicle goes on with after a pause.

A return stays a return, a landing a landing; a mission that was left is another command.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final

from gcs_plugin.fleet.flight_state import Word, flight_state
from gcs_plugin.fleet.link_hub import Hub
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Message
from gcs_plugin.mission.download import MissionDownload
from gcs_plugin.mission.exchange import MISSION, NEVER, Exchange, Verdict
from gcs_plugin.mission.flight_modes import HOLDS, LANDS, RETURNS
from gcs_plugin.mission.flown_items import off_leg_m
from gcs_plugin.mission.items import Mission, difference
from gcs_plugin.mission.start_dialogue import BreakOff, Start
from gcs_plugin.mission.upload import MissionUpload
from orthoswarm.model.errors import OrthoSwarmError

_ON_THE_WAY_S = 1.0
_ON_WAY_M: Final = 15.0  # one that holds no farther from the way to its item was held on it: vehicles brake in less


class Dialogues:
    """All dialogues of a fleet that are under way (`jobs`); `signed`: whether this station has a key."""

    def __init__(self, vehicles: Mapping[int, Vehicle], hub: Hub, clock: Callable[[], float], *, signed: bool) -> None:
        self._vehicles, self._hub, self._clock, self._signed = vehicles, hub, clock, signed
        self.jobs: list[Exchange] = []

    @property
    def deadline(self) -> float:
        """The earliest deadline of all dialogues."""
        return min((job.deadline for job in self.jobs), default=NEVER)

    def begin(self, job: Exchange) -> None:
        """Start one."""
        self.jobs.append(job)
        vehicle = self._vehicles.get(job.vehicle.system)
        job.pace = vehicle.pace if vehicle is not None else 1.0
        self._drive(job, job.start(self._clock()))
        self._reap()

    def busy(self, system: int) -> bool:
        """True while a dialogue with this vehicle is active that somebody waits for."""
        return any(not _in_background(job) for job in self._with(system))

    def talks(self, system: int) -> bool:
        """True while any dialogue with this vehicle is active."""
        return bool(self._with(system))

    def reads(self, system: int) -> bool:
        """True while this vehicle's mission is being read."""
        return any(isinstance(job, MissionDownload) and job.list_type == MISSION for job in self._with(system))

    def starting(self, system: int) -> bool:
        """True while a start of this vehicle is under way, or is being broken off."""
        return any(isinstance(job, (Start, BreakOff)) for job in self._with(system))

    def _with(self, system: int) -> list[Exchange]:
        return [job for job in self.jobs if job.vehicle.system == system]

    def end_background(self, system: int) -> None:
        """End what nobody waits for, in favour of what somebody asks for."""
        for job in self._with(system):
            if _in_background(job):
                job.cancel("another request came in between")
        self._reap()

    def make_way(self, system: int) -> None:
        """End an active command for a newer one (an upload may continue, unless it still changes the mode)."""
        for job in self._with(system):
            if not isinstance(job, (MissionUpload, MissionDownload)) or job.leaves_mode:
                job.cancel("another command came in between")
        self._reap()

    def tick(self, now: float) -> None:
        """Process the passing of time."""
        for job in list(self.jobs):
            if now >= job.deadline:
                self._drive(job, job.tick(now))
        self._reap()

    def feed(self, vehicle: Vehicle, message: Message, now: float) -> None:
        """Pass a message of a vehicle's autopilot to its dialogues."""
        if not self.jobs:
            return
        for job in list(self.jobs):
            if job.vehicle == vehicle.address and job.outcome is None:
                self._drive(job, job.feed(message, now))
        self._reap()

    def rebooted(self, vehicle: Vehicle, now: float) -> None:
        """A vehicle has rebooted."""
        for job in list(self.jobs):
            if job.vehicle == vehicle.address and job.outcome is None:
                self._drive(job, job.rebooted(now))

    def send(
        self, system: int, messages: Sequence[Message], *, everywhere: bool = False, expires: float = NEVER
    ) -> bool:
        """Send to a vehicle; returns whether a link accepted it.

        `everywhere`: on every route on which it was heard recently, not only on the best. A message that still waits at
        `expires` is dropped.
        """
        vehicle = self._vehicles.get(system)
        if vehicle is None or not messages:
            return False
        accepted = False
        for route in vehicle.routes.towards(self._clock(), everywhere=everywhere):
            for message in messages:
                accepted |= self._hub.send(route.side, route.peer, message, expires)
        return accepted

    def _drive(self, job: Exchange, messages: Sequence[Message]) -> None:
        """Send a dialogue's messages, and report to it which ones a link accepted.

        Repeated commands, and commands to a vehicle that is lost or has several claimants, are sent on every route.
        """
        for message in messages:
            vehicle = self._vehicles[job.vehicle.system]
            again = bool(getattr(message, "confirmation", 0))
            everywhere = again or vehicle.lost or bool(vehicle.claimants)
            expires = max(job.message_expires, self._clock() + _ON_THE_WAY_S)
            if self.send(vehicle.system, [message], everywhere=everywhere, expires=expires):
                job.took()

    def _reap(self) -> None:
        """Remove finished dialogues and record their results."""
        for job in self.jobs:
            self._note_mission(job)
            self._explain(job)
        if any(job.outcome is not None for job in self.jobs):
            self.jobs = [job for job in self.jobs if job.outcome is None]

    def _explain(self, job: Exchange) -> None:
        """Explain a silence: a signing vehicle ignores a station without its key."""
        outcome, vehicle = job.outcome, self._vehicles.get(job.vehicle.system)
        if outcome is None or outcome.verdict is not Verdict.UNKNOWN or vehicle is None:
            return
        if vehicle.signs and not self._signed:
            why = f"vehicle {vehicle.system} signs its messages and does not listen to a station without its key"
            job.outcome = replace(outcome, text=f"{why}; give it with --signing-key")

    def _note_mission(self, job: Exchange) -> None:
        vehicle = self._vehicles.get(job.vehicle.system)
        if vehicle is None or job.mission_type != MISSION:
            return
        if isinstance(job, MissionUpload) and job.announced:  # from then on its old mission is no longer whole
            vehicle.unbegun = True
        if isinstance(job, MissionUpload) and job.outcome is not None and job.outcome.ok:
            vehicle.mission, vehicle.mission_seq = job.mission, 0
            vehicle.mission_was_read(self._clock())
            vehicle.detector.uploaded(job.mission)
            return
        mission = None
        if job.outcome is not None and not job.outcome.ok and _in_background(job):
            vehicle.read_at = min(vehicle.read_at, self._clock() + _ON_THE_WAY_S)  # something else came in between
        if isinstance(job, MissionDownload) and job.items is not None:
            mission = Mission(vehicle.autopilot, tuple(job.items))
        elif isinstance(job, Start):
            mission = job.arm.mission
        if mission is None:
            return
        if job.outcome is not None and isinstance(job, MissionDownload):
            vehicle.mission_was_read(self._clock())
        other = vehicle.mission is None or difference(vehicle.mission, mission.items)
        if other or not vehicle.detector.knows:
            vehicle.mission = mission
            vehicle.detector.knows_mission(mission)


def _in_background(job: Exchange) -> bool:
    return isinstance(job, MissionDownload) and job.background


def resumed(vehicle: Vehicle) -> Exchange:
    """The dialogue that lets a vehicle go on with what was paused.

    Raises:
        OrthoSwarmError: nothing was paused, or it is not known what.
    """
    name, way, modes, pilot = f"vehicle {vehicle.system}", vehicle.way, vehicle.modes, vehicle.pilot
    if vehicle.unbegun:  # its autopilot would go on at the item at which it left the mission before
        raise OrthoSwarmError(f"{name} has not begun the mission that it was given; start it")
    in_mission = vehicle.custom_mode == modes.mission
    holds = vehicle.flying and vehicle.mode in HOLDS
    if holds and way is not None and way != modes.mission:
        if modes.name(way) in RETURNS:
            return pilot.rtl()
        if modes.name(way) in LANDS:
            return pilot.land()
        raise OrthoSwarmError(f"{name} was flown in {modes.name(way)} before, which nothing here resumes")
    # A pause shows some seconds after it was acknowledged: on a mission there is nothing to pull it out of.
    state = flight_state(vehicle)
    if not (holds or (in_mission and state.word in (Word.PAUSED, Word.ON_MISSION, Word.TAKING_OFF))):
        raise OrthoSwarmError(f"{name} is {state.text}, so there is no pause to end")
    if not in_mission and way is None and not _on_its_way(vehicle):
        text = f"{name} holds, but not on the way to its mission's present item, so it may have been returning"
        raise OrthoSwarmError(f"{text}: send it home (rtl), or give 'continue' to go on with its mission")
    return pilot.go_on(vehicle.custom_mode)


def continued(vehicle: Vehicle) -> Exchange:
    """The dialogue that lets a vehicle go on with its mission, whatever it left it for; the caller has checked that.

    Raises:
        OrthoSwarmError: it does not fly, or has not begun its mission.
    """
    if not vehicle.flying or vehicle.unbegun:
        why = "has not begun the mission that it was given" if vehicle.unbegun else "does not fly"
        raise OrthoSwarmError(f"vehicle {vehicle.system} {why}; start it")
    return vehicle.pilot.go_on(vehicle.custom_mode)


def _on_its_way(vehicle: Vehicle) -> bool:
    """Whether one that was only seen holding stands on the way to its mission's present item."""
    if vehicle.had_failsafe or vehicle.mission is None or vehicle.place is None:
        return False
    away_m = off_leg_m(vehicle.mission, vehicle.mission_seq, vehicle.place)
    return away_m is not None and away_m < _ON_WAY_M
