"""Returning vehicles in turn: those whose way home is free at once, the others as soon as theirs is."""

import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.config import RETURN
from gcs_plugin.fleet.commands import CommandResult
from gcs_plugin.fleet.separation.return_order import Aloft, ReturnOrder, aloft_of
from gcs_plugin.mission.exchange import Verdict

if TYPE_CHECKING:
    from gcs_plugin.fleet.commands import Verb
    from gcs_plugin.fleet.fleet import Fleet

VERB: Final = "return"
_ANSWER_S: Final = 5.0
_log = logging.getLogger(__name__)

Rows = list[dict[str, Any]]


class Returns:
    """Vehicles that return in turn.

    Args:
        fleet: the vehicles. command: gives a command (its verb) to vehicles by their ids, and returns a row for each
            as `VehicleLinks.commands` does. publish: called with the row of each that is sent home later.
        name_of: id of a vehicle by its system id.
    """

    def __init__(
        self,
        fleet: "Fleet",
        command: Callable[["Verb", Collection[str]], Rows],
        publish: Callable[[dict[str, Any]], None],
        name_of: Callable[[int], str],
    ) -> None:
        self._fleet, self._command, self._publish, self._name_of = fleet, command, publish, name_of
        self._lock = threading.Lock()
        self._order: ReturnOrder | None = None  # only its thread looks at it
        self._waits: dict[int, tuple[int, ...]] = {}
        self._told_else, self._again = set[int](), set[int]()
        self._stop = threading.Event()

    def begin(self, systems: Mapping[str, int], number: str) -> Rows:
        """Return vehicles in turn; answers once each was told to return or to hold.

        Args:
            systems: system ids by the vehicles' ids. number: of the command.

        Returns:
            A row a vehicle, as for a command. One that does not acknowledge that it is to hold is sent home.
        """
        with self._lock:  # an earlier order ends; what others command from now on comes before this one
            self._order, self._waits = None, {}
            self._told_else.clear()
            self._again.clear()
        self._fleet.call(self._ask).result(_ANSWER_S)
        aloft = self._aloft()
        going = {name for name, system in systems.items() if system in aloft and aloft[system].goes_home}
        order = ReturnOrder([s for name, s in systems.items() if s in aloft and name not in going])
        order.look(aloft)
        held = [name for name, system in systems.items() if system in order.waits]
        home = [name for name in systems if name not in going and name not in held]
        with ThreadPoolExecutor(2) as both:  # a lost vehicle among the one must not keep the others from holding
            sent = [both.submit(self._told, *each, systems) for each in (("pause", held), ("rtl", home))]
        rows = {name: row for told in sent for name, row in told.result().items()}
        loose = [name for name in held if not _done(rows[name])]
        rows |= self._told("rtl", loose, systems)
        for name in loose:
            order.drop(systems[name])
        for name in (*loose, *home):
            if systems[name] in aloft and not aloft[systems[name]].lost and not _done(rows[name]):
                order.again(systems[name])
        for name in going:
            rows[name] = self._row(number, name, f"{name} returns or lands already")
        for name in set(held).difference(loose):
            after = ", ".join(map(self._name_of, order.waits.get(systems[name], ()))) or "others"
            rows[name] = self._row(number, name, f"{name} holds, and returns after {after}")
        with self._lock:
            for system in self._told_else:
                order.drop(system)
            self._order, self._waits = order, dict(order.waits)
        threading.Thread(target=self._run, args=(order,), name="returns", daemon=True).start()
        return [rows[name] | {"id": number, "command": VERB} for name in systems]

    def cancel(self, system: int) -> None:
        """A vehicle is given another command: it waits no longer."""
        with self._lock:
            self._told_else.add(system)
            if self._waits.pop(system, None) is not None:
                _log.info("%s no longer returns in turn: it was given another command", self._name_of(system))

    def waits(self) -> dict[str, list[str]]:
        """Those that hold until their way home is free, and the ids of those that each waits for."""
        with self._lock:
            known = dict(self._waits)
        return {self._name_of(s): [self._name_of(o) for o in others] for s, others in known.items()}

    def close(self) -> None:
        """Send nobody home any more: what waits is left holding."""
        self._stop.set()

    def _run(self, order: ReturnOrder) -> None:
        """Send each home when its way is free; ends with the last, or when another order takes its place."""
        sending: set[int] = set()
        while (not order.over or sending or self._again) and not self._stop.wait(RETURN.look_s):
            try:
                aloft = self._aloft()
            except Exception as error:  # the links do not answer now: they are asked again
                _log.warning("returning in turn: %s", str(error) or type(error).__name__)
                continue
            free = self._free(order, aloft)
            if free is None:
                return
            sending.update(free)
            for system in free:
                threading.Thread(target=self._send_home, args=(system, sending), daemon=True).start()

    def _free(self, order: ReturnOrder, aloft: Mapping[int, Aloft]) -> list[int] | None:
        """Those that may return now; None once another order has taken the place of this one."""
        with self._lock:
            for system in self._again - self._told_else:
                order.again(system)
            self._again.clear()
            for system in self._told_else:
                order.drop(system)
        free = order.look(aloft)
        with self._lock:
            if self._order is not order:
                return None
            for system in self._told_else:  # also those that were given another command during the look
                order.drop(system)
            self._waits = dict(order.waits)
            return [system for system in free if system not in self._told_else]

    def _send_home(self, system: int, sending: set[int]) -> None:
        """Tell one vehicle to return; if it is there and does not acknowledge that, it has its turn again."""
        (row,) = self._command("rtl", [self._name_of(system)])
        self._publish(row | {"by": VERB})
        if not _done(row) and not self._fleet.vehicles[system].lost:
            with self._lock:
                self._again.add(system)
        sending.discard(system)

    def _ask(self) -> None:
        """Ask for the heights at which they return, of those that have not said it: without them they wait longer."""
        for system, vehicle in self._fleet.vehicles.items():
            if vehicle.flying:
                self._fleet.ask_settings(system)

    def _aloft(self) -> dict[int, Aloft]:
        return self._fleet.call(lambda: aloft_of(self._fleet.vehicles, time.monotonic())).result(_ANSWER_S)

    def _told(self, verb: "Verb", names: Collection[str], systems: Mapping[str, int]) -> dict[str, dict[str, Any]]:
        """The rows of vehicles that are given a command, unless somebody has given them another one meanwhile."""
        with self._lock:
            free = [name for name in names if systems[name] not in self._told_else]
        rows = {row["vehicle"]: row for row in self._command(verb, free)} if free else {}
        for name in names:
            if systems[name] in self._told_else:
                rows[name] = self._row("", name, f"{name} was given another command meanwhile")
        return rows

    @staticmethod
    def _row(number: str, name: str, text: str) -> dict[str, Any]:
        return CommandResult(number, name, VERB, Verdict.DONE, text).document()


def _done(row: Mapping[str, Any]) -> bool:
    return bool(row["outcome"] == Verdict.DONE.value)
