"""Whether vehicles that are to start keep apart: from each other, from those in the air, from those that wait.

All are followed on their missions from their takeoffs on by the planner's model, with the times of their autopilots and
the levels of their homes (`Airspace`). What cannot be followed so is said: it was not examined.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final

from gcs_plugin.fleet.flight_state import Word, flight_state
from gcs_plugin.fleet.separation.separation_watch import NUMBERED, VehicleNames
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.mission.items import Mission
from gcs_plugin.mission.plan_folder import NO_NEEDS, PlanNeeds
from gcs_plugin.mission.track import STEP_S, Airspace, home_of, metres, track_of

_PLANNED_SHARE: Final = 0.95
"""Share of the distance that counts between missions of one plan, which was made with other samples."""


@dataclass(frozen=True, slots=True)
class TimedFlight:
    """What a vehicle flies.

    Attributes:
        mission: its mission, None if it is not known. start_s: takeoff, on a clock that all flights share.
        alt_m: altitude of its home above the sea, None if that is not known.
        planned: whether the mission is of the plan that is to be started.
        examined: whether the vehicle is asked about; others are there only to be kept apart from.
    """

    mission: Mission | None
    start_s: float
    alt_m: float | None = None
    planned: bool = False
    examined: bool = True


@dataclass(frozen=True, slots=True)
class SeparationFindings:
    """By system id, in words: whom a vehicle comes too near, and what could not be examined."""

    near: Mapping[int, str] = field(default_factory=dict)
    unexamined: Mapping[int, str] = field(default_factory=dict)


def flights_of(
    vehicles: Mapping[int, Vehicle],
    missions: Mapping[int, Mission],
    stored: Mapping[int, Mission],
    starts: Mapping[int, float],
) -> dict[int, TimedFlight]:
    """The flights of vehicles that are to start; arguments as for `preflight_all`."""
    return {
        s: TimedFlight(missions.get(s) or stored.get(s) or v.mission, starts.get(s, 0.0), v.home_alt_m, s in missions)
        for s, v in vehicles.items()
    }


def others_of(vehicles: Mapping[int, Vehicle], waiting: Mapping[int, float]) -> dict[int, TimedFlight]:
    """The flights of other vehicles: of those in the air, and of those whose takeoff waits for so many seconds."""
    found = {}
    for s, vehicle in vehicles.items():
        if s in waiting:
            found[s] = TimedFlight(vehicle.mission, waiting[s], vehicle.home_alt_m, examined=False)
        elif vehicle.flying:
            mission = vehicle.mission if flight_state(vehicle).word in (Word.ON_MISSION, Word.TAKING_OFF) else None
            elapsed_s = 0.0 if mission is None else _elapsed_s(vehicle, mission)
            found[s] = TimedFlight(mission, -elapsed_s, vehicle.home_alt_m, examined=False)
    return found


def separation_of(
    flights: Mapping[int, TimedFlight], names: VehicleNames = NUMBERED, needs: PlanNeeds = NO_NEEDS
) -> SeparationFindings:
    """Which vehicles come too near each other; takes a second or more for a large swarm.

    `needs`: of the plan, by which it keeps its own vehicles apart; what is usual holds for all others.
    """
    name = names.name_of
    known = {s: flight for s, flight in flights.items() if flight.mission is not None}
    found: dict[int, list[str]] = {}
    for one, other, at, apart_m in _conflicts(tuple(sorted(known.items())), needs):
        for mine, theirs in ((one, other), (other, one)):
            if flights[mine].examined:
                found.setdefault(mine, []).append(f"{apart_m:.0f} m from {name(theirs)} after {max(0.0, at):.0f} s")
    near = {
        s: f"comes within {', '.join(texts[:3])}; start them later, or plan them together" for s, texts in found.items()
    }
    lost = [s for s in sorted(flights) if s not in known and not flights[s].examined]
    aloft = f"{', '.join(map(name, lost))} flies or waits, and its way is not known" if lost else ""
    unexamined = {}
    for s, flight in flights.items():
        why = aloft if flight.mission is not None else "its mission is not known"
        if flight.examined and why:
            unexamined[s] = why
    return SeparationFindings(near, unexamined)


@lru_cache(maxsize=8)
def _conflicts(
    flights: tuple[tuple[int, TimedFlight], ...], needs: PlanNeeds
) -> tuple[tuple[int, int, float, float], ...]:
    """Both vehicles, the time and the distance; the same flights are asked about again and again before a start."""
    about = dict(flights)
    missions = {s: f.mission for s, f in flights if f.mission is not None}
    levels = {s: flight.alt_m for s, flight in flights if flight.alt_m is not None}
    starts = {s: flight.start_s for s, flight in flights}
    in_plan = {s for s, flight in flights if flight.planned}
    found = Airspace.of(missions, levels).conflicts(starts, but_among=in_plan)
    # By what the plan's own autopilots are off schedule and as far apart as it was made for.
    plan = Airspace.of({s: mission for s, mission in missions.items() if s in in_plan}, levels, needs)
    plan = replace(plan, distance_m=_PLANNED_SHARE * plan.distance_m, slack_s=plan.slack_s - STEP_S, _found={})
    found += plan.conflicts({s: start for s, start in starts.items() if s in in_plan})
    return tuple(row for row in found if about[row[0]].examined or about[row[1]].examined)


def _elapsed_s(vehicle: Vehicle, mission: Mission) -> float:
    """For how long a vehicle has been on its mission, from where it is."""
    origin = home_of(mission)
    if origin is None or vehicle.place is None:
        return 0.0
    return track_of(mission, origin).elapsed_s((*metres(*vehicle.place, origin), vehicle.height_m))
