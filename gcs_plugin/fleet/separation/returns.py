"""Returning vehicles in turn: those whose way home is free at once, the others as soon as theirs is."""

import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, Final, Protocol, TypeVar

from gcs_plugin.config import RETURN
from gcs_plugin.fleet.commands import CommandResult, Verb, new_id
from gcs_plugin.fleet.separation.return_order import Aloft, ReturnOrder, aloft_of
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Message
from gcs_plugin.mission.exchange import Verdict

VERB: Final = "return"
_ANSWER_S: Final = 5.0
_AGAIN_S: Final = 0.1
_ASK_S: Final = 0.5
_log = logging.getLogger(__name__)

Result = TypeVar("Result")
Rows = list[dict[str, Any]]


class Station(Protocol):
    """The vehicles as one thread hears them: `fleet.Fleet`, or what stands for it."""

    @property
    def vehicles(self) -> Mapping[int, Vehicle]:
        """By system id."""

    def call(self, work: Callable[[], Result]) -> "Future[Result]":
        """Run a function in that thread; from any thread."""

    def send(self, system: int, messages: Sequence[Message]) -> None:
        """Send messages to a vehicle without waiting for answers; in that thread."""


class Returns:
    """Vehicles that return in turn.

    Args:
        fleet: the vehicles. command: gives a command (its verb) to vehicles by their ids, waits for the outcomes and
            returns a row for each (`CommandResult.document`). publish: called with the row of each that is sent home
            later, or waits no longer for another reason than a command that is given here.
        name_of: id of a vehicle by its system id.
    """

    def __init__(
        self,
        fleet: Station,
        command: Callable[[Verb, Collection[str]], Rows],
        publish: Callable[[dict[str, Any]], None],
        name_of: Callable[[int], str],
    ) -> None:
        self._fleet, self._command, self._publish, self._name_of = fleet, command, publish, name_of
        self._lock = threading.Lock()
        self._order: ReturnOrder | None = None  # only its thread looks at it
        self._waits: dict[int, tuple[int, ...]] = {}
        self._told_else, self._again = set[int](), set[int]()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self, systems: Mapping[str, int], number: str) -> Rows:
        """Return vehicles in turn, by system ids of their ids; answers once each was told to return or to hold.

        Returns:
            A row a vehicle, as for a command (`number`). One that does not acknowledge that it is to hold is sent home.
        """
        with self._lock:  # an earlier order ends; what others command from now on comes before this one
            self._order, self._waits = None, {}
            self._told_else.clear()
            self._again.clear()
        aloft = self._known(systems.values())
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
        for system in order.waits:
            order.holds(system)
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
        self._thread = threading.Thread(target=self._run, args=(order,), name="returns", daemon=True)
        self._thread.start()
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

    @property
    def running(self) -> bool:
        """Whether somebody waits still, or was told to return and has neither answered nor been heard."""
        return self._thread is not None and self._thread.is_alive()

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
                if self._stop.is_set():
                    return
                _log.warning("returning in turn: %s", str(error) or type(error).__name__)
                continue
            free = self._free(order, aloft)
            if free is None:
                return
            sending.update(free)
            for system in order.heard_again:
                args = "pause", [self._name_of(system)]
                threading.Thread(target=self._command, args=args, daemon=True).start()
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
        pending = order.pending
        free = order.look(aloft)
        with self._lock:
            if self._order is not order:
                return None
            for system in self._told_else:  # also those that were given another command during the look
                order.drop(system)
            self._waits = dict(order.waits)
            told_else = set(self._told_else)
        for system in sorted(pending - order.pending - told_else - set(free)):
            self._publish(self._no_longer(system, order, aloft).document() | {"by": VERB})
        return [system for system in free if system not in told_else]

    def _no_longer(self, system: int, order: ReturnOrder, aloft: Mapping[int, Aloft]) -> CommandResult:
        """Why a vehicle waits no longer that was not sent home."""
        name = self._name_of(system)
        if system in order.left:
            text = f"{name} follows another command ({order.left[system]}); it is not sent home in turn any more"
            return CommandResult(new_id(), name, VERB, Verdict.NOT_SENT, text)
        does = "returns or lands" if system in aloft else "is on the ground"
        return CommandResult(new_id(), name, VERB, Verdict.DONE, f"{name} {does} already")

    def _send_home(self, system: int, sending: set[int]) -> None:
        """Tell one vehicle to return; if it is there and does not acknowledge that, it has its turn again."""
        done = False
        try:
            (row,) = self._command("rtl", [self._name_of(system)])
            done = _done(row)
            self._publish(row | {"by": VERB})
        finally:
            if not done and not self._fleet.vehicles[system].lost:
                with self._lock:
                    self._again.add(system)
            sending.discard(system)

    def _ask(self, *, settings: bool) -> None:
        """Ask for homes not known yet, and for how they return (`settings`), without which they wait longer."""
        for system, vehicle in self._fleet.vehicles.items():
            if vehicle.flying:
                home = [] if vehicle.home is not None else [vehicle.home_question()]
                asked = vehicle.questions.ask(time.monotonic()) if settings else []
                self._fleet.send(system, [*home, *asked])

    def _known(self, systems: Collection[int]) -> dict[int, Aloft]:
        """The vehicles in the air, as soon as the ways home of these are known: one that has just been heard says it.

        Whose way is not known then returns at once.
        """
        end, ask_at, first = time.monotonic() + RETURN.known_s, 0.0, True
        while True:
            now = time.monotonic()
            if now >= ask_at:  # a question or its answer may be lost
                self._fleet.call(partial(self._ask, settings=first)).result(_ANSWER_S)
                ask_at, first = now + _ASK_S, False
            aloft = self._aloft()
            unknown = [s for s in systems if self._unknown(s, aloft)]
            if not unknown or now >= end or self._stop.wait(_AGAIN_S):
                return aloft

    def _unknown(self, system: int, aloft: Mapping[int, Aloft]) -> bool:
        """Whether it is still to be heard whether a vehicle is in the air, or where its home is."""
        vehicle = self._fleet.vehicles[system]
        if system in aloft:
            return aloft[system].way is None and not vehicle.lost
        return vehicle.armed and not vehicle.lost and not (vehicle.reported and vehicle.landed)

    def _aloft(self) -> dict[int, Aloft]:
        return self._fleet.call(lambda: aloft_of(self._fleet.vehicles, time.monotonic())).result(_ANSWER_S)

    def _told(self, verb: Verb, names: Collection[str], systems: Mapping[str, int]) -> dict[str, dict[str, Any]]:
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
