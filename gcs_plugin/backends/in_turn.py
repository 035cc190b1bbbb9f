"""Vehicles of a backend that return in turn, driven by the thread that reads their messages."""

import queue
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Final, TypeVar

from gcs_plugin.backends.backend import Backend, Say
from gcs_plugin.fleet.commands import CommandResult, Order, Verb, new_id
from gcs_plugin.fleet.separation.returns import Returns
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Message
from gcs_plugin.mission.exchange import Outcome, Verdict

Result = TypeVar("Result")

_STEP_S: Final = 0.05
_WAITS_S: Final = 5.0  # whom they wait for changes from look to look: said no more often than this
_name: Final = "vehicle {}".format


class InTurn:
    """A return in turn (`fleet.separation.returns`) that says what happens, a line at a time.

    Attributes:
        orders: the last command to each vehicle.
    """

    def __init__(self, backend: Backend, say: Say) -> None:
        self._backend, self._say = backend, say
        self._work: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._returns = Returns(self, self._command, lambda row: self._do(lambda: self._heard(row)), _name)
        self._systems: dict[str, int] = {}
        self._ended: dict[int, Outcome] = {}
        self._holding: set[int] = set()
        self._waits: dict[str, list[str]] = {}
        self._said_s, self._lost = 0.0, set[int]()
        self.orders: dict[int, Order] = {}

    def run(self, systems: Collection[int], seconds: float) -> None:
        """Send vehicles home in turn, until nobody waits any more; for at most so many seconds.

        Those that wait when this ends, also by an exception, are left holding. All that the backend hears are kept
        apart from.
        """
        end = time.monotonic() + seconds
        self._read_last_items()
        self._systems = {_name(system): system for system in systems}
        with ThreadPoolExecutor(1) as begins:
            try:
                begun = begins.submit(self._returns.begin, self._systems, new_id())
                while not begun.done():
                    self._step()
                for row in begun.result():
                    self._heard(row, begins=True)
                self._waits, self._said_s = self._returns.waits(), time.monotonic()
                while self._returns.running and time.monotonic() < end:
                    self._step()
                    self._say_waits()
            finally:
                self._returns.close()
                self._do_work()
                with self._lock:
                    self._stop.set()
                self._do_work()
                for system in self._systems.values():
                    if self._holds(system) or system not in self._ended:
                        self._say(self._outcome(system).text)

    def outcomes(self) -> dict[int, Outcome]:
        """How it ended, or stands, for each vehicle."""
        return {system: self._outcome(system) for system in self._systems.values()}

    # -- what returns ask of the vehicles -----------------------------------------------------------------------------

    @property
    def vehicles(self) -> Mapping[int, Vehicle]:
        """The backend's."""
        return self._backend.vehicles()

    def call(self, work: Callable[[], Result]) -> "Future[Result]":
        """Run a function between two messages; it is cancelled if this has ended by then."""
        future: Future[Result] = Future()

        def do() -> None:
            if self._stop.is_set():
                future.cancel()
                return
            try:
                future.set_result(work())
            except Exception as error:  # passed to the caller
                future.set_exception(error)

        with self._lock:
            if self._stop.is_set():
                future.cancel()
            else:
                self._do(do)
        return future

    def send(self, system: int, messages: Sequence[Message]) -> None:
        """Send messages to a vehicle."""
        self._backend.send(system, messages)

    def _command(self, verb: Verb, names: Collection[str]) -> list[dict[str, Any]]:
        """Give a command to vehicles and wait for the outcomes; in a thread of the returns."""
        given, orders = time.monotonic(), dict[str, Order]()
        begun = {
            name: self.call(lambda s=self._systems[name]: self._order(verb, s, given))  # type: ignore[misc]
            for name in names
        }
        for name, future in begun.items():
            while not future.done() and not self._stop.wait(_STEP_S):  # Ctrl-C may cut off who does it
                pass
            if future.done() and not future.cancelled():
                orders[name] = future.result()
        while any(order.outcome is None for order in orders.values()) and not self._stop.wait(_STEP_S):
            pass
        ended = [orders[name].result(name) if name in orders else None for name in names]
        unknown = (CommandResult(new_id(), name, verb, Verdict.UNKNOWN, f"{name} has not answered") for name in names)
        return [(one or other).document() for one, other in zip(ended, unknown, strict=True)]

    # -- in the thread that reads messages ----------------------------------------------------------------------------

    def _do(self, work: Callable[[], None]) -> None:
        self._work.put(work)

    def _step(self) -> None:
        self._backend.look()
        self._backend.pump(_STEP_S)
        self._do_work()

    def _do_work(self) -> None:
        while True:
            try:
                work = self._work.get_nowait()
            except queue.Empty:
                return
            work()

    def _read_last_items(self) -> None:
        """Read the missions of those at their last item, which may bring them home already."""
        unknown = [
            system
            for system, v in self.vehicles.items()
            if v.flying
            and v.mission is None
            and v.custom_mode == v.modes.mission
            and v.mission_seq + 1 >= v.mission_total
        ]
        if unknown:
            self._backend.stored(unknown, lambda *_: None)

    def _order(self, verb: Verb, system: int, given: float) -> Order:
        self._ended.pop(system, None)
        self._holding.discard(system)
        order = self.orders[system] = Order(verb=verb, system=system, given_s=given)  # known before it is sent
        return self._backend.order(order)

    def _heard(self, row: Mapping[str, Any], *, begins: bool = False) -> None:
        """How a vehicle's command ended, or why it waits no longer. At the end the orders say how it stands."""
        if self._stop.is_set():
            return
        system, verdict = self._systems[row["vehicle"]], Verdict(row["outcome"])
        self._ended[system] = Outcome(ok=verdict is Verdict.DONE, text=row["reason"], failure=verdict)
        order = self.orders.get(system)
        if begins and verdict is Verdict.DONE and order is not None and order.verb == "pause":
            self._holding.add(system)
        else:
            self._holding.discard(system)
        self._say(row["reason"])

    def _say_waits(self) -> None:
        """Who waits for whom, where that has changed; and if only lost ones keep this from ending."""
        waits, now = self._returns.waits(), time.monotonic()
        fewer = waits.keys() != self._waits.keys()
        if waits and waits != self._waits and (fewer or now - self._said_s >= _WAITS_S):
            each = (f"{name} for {', '.join(others) or 'others'}" for name, others in sorted(waits.items()))
            self._say(f"waiting: {'; '.join(each)}".replace(_name(""), "v"))
            self._waits, self._said_s = waits, now
        answered = {s for s, outcome in self._ended.items() if outcome.ok}
        lost = {s for s in self.orders.keys() - answered if self.vehicles[s].lost} if not waits else set()
        if lost - self._lost:
            who = ", ".join(map(_name, sorted(lost)))
            self._say(f"{who} is lost, and is told again if it is heard and does not return; Ctrl-C ends this")
        self._lost |= lost

    def _holds(self, system: int) -> bool:
        order = self.orders.get(system)
        held = order is not None and order.verb == "pause" and order.outcome is not None and order.outcome.ok
        return system in self._holding or (held and system not in self._ended)

    def _outcome(self, system: int) -> Outcome:
        name, order = _name(system), self.orders.get(system)
        if self._holds(system):
            return Outcome(ok=False, text=f"{name} holds where it is and was not sent home", failure=Verdict.NOT_SENT)
        if system in self._ended:
            return self._ended[system]
        if order is None:
            return Outcome(ok=False, text=f"{name} was told nothing", failure=Verdict.NOT_SENT)
        text = f"{name} was told to {'hold' if order.verb == 'pause' else 'return'} and has not answered yet"
        return order.outcome or Outcome(ok=False, text=f"{text}; watch whether it obeys", failure=Verdict.UNKNOWN)
