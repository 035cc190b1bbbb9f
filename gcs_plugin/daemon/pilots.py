"""Which pilot has which vehicle: who commands a free one has it, until it is handed over, freed, or its pilot is gone.

Kept in memory: after a restart of the daemon vehicles are free. Whoever is the only pilot has every vehicle.
"""

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.people_rows import People, Person
from orthoswarm.model.errors import InputError, OrthoSwarmError

GONE_S: Final = 20.0
"""A pilot whose page was not heard for so long has nothing any more: page reloads and short losses of the Wi-Fi take
less, and RTL, pause and land are open to everybody meanwhile."""


@dataclass(slots=True)
class _Hold:
    """A vehicle's pilot, and who has asked for it."""

    pilot: Person
    asked: Person | None = None


class Pilots:
    """Who has which vehicle; `people`: knows who is here. `events`: tells pages."""

    def __init__(self, people: People, events: Events) -> None:
        self._people, self._events = people, events
        self._lock = threading.Lock()
        self._holds: dict[str, _Hold] = {}

    def rows(self) -> list[dict[str, Any]]:
        """Vehicles with a pilot who is here, as JSON: `vehicle`, `pilot` and `asked` ({`id`, `name`} or null)."""
        with self._lock:
            held = {vehicle: self._held(vehicle) for vehicle in sorted(self._holds)}
        return [
            {"vehicle": vehicle, "pilot": _row(hold.pilot), "asked": _row(hold.asked)}
            for vehicle, hold in held.items() if hold is not None
        ]  # fmt: skip

    def claim(self, person: Person, vehicles: Iterable[str], *, whole: bool = False) -> dict[str, str]:
        """Let a pilot have the free ones of some vehicles; returns why not, for each that another has.

        Args:
            person: who commands them. vehicles: their ids. whole: take none if another has one.

        Raises:
            OrthoSwarmError: with `whole`, another pilot has one.
        """
        refused: dict[str, str] = {}
        with self._lock:
            before = dict(self._holds)
            for vehicle in vehicles:
                hold = self._held(vehicle)
                if hold is None:
                    self._holds[vehicle] = _Hold(person)
                elif hold.pilot.id != person.id:
                    refused[vehicle] = (
                        f"{hold.pilot.name} has {vehicle}; ask for it; all pilots may pause, return and land it"
                    )
            if refused and whole:
                self._holds = before
                raise OrthoSwarmError("; ".join(refused.values()))
            changed = before != self._holds
        if changed:
            self._tell()
        return refused

    def change(self, person: Person, vehicle: str, act: str) -> bool:
        """`take` a vehicle, or ask its pilot for it; as its pilot `give` it to who asked, `keep` it, or `free` it.

        Returns:
            Whether the person has the vehicle now.

        Raises:
            InputError: there is no such act.
            OrthoSwarmError: it is not this pilot's, or nobody has asked.
        """
        with self._lock:
            hold = self._held(vehicle)
            if act not in ("take", "give", "keep", "free"):
                raise InputError("there is no such act; send take, give, keep or free")
            if act == "take":
                hold = self._holds[vehicle] = hold or _Hold(person)
                hold.asked = hold.asked if hold.pilot.id == person.id else person
            elif hold is None or hold.pilot.id != person.id:
                raise OrthoSwarmError(f"you do not have {vehicle}; take it first")
            elif act == "keep":
                hold.asked = None
            elif act == "free":
                del self._holds[vehicle]
            elif hold.asked is None or self._people.find(hold.asked.id) is None:
                raise OrthoSwarmError(f"nobody asks for {vehicle} now; free it, and anybody can take it")
            else:
                self._holds[vehicle] = _Hold(hold.asked)
            now = self._held(vehicle)
        self._tell()
        return now is not None and now.pilot.id == person.id

    def _held(self, vehicle: str) -> _Hold | None:
        """The hold of a vehicle whose pilot is here and may still command."""
        hold = self._holds.get(vehicle)
        if hold is None or self._people.find(hold.pilot.id) is None:
            return None
        return hold if self._people.is_here(hold.pilot.id, GONE_S) else None

    def _tell(self) -> None:
        self._events.tell("holds", rows=self.rows())


def _row(person: Person | None) -> dict[str, Any] | None:
    return None if person is None else {"id": person.id, "name": person.name}
