"""Commands to vehicles over HTTP: each has an id and an outcome, and expires 5 s after it was issued.

The client states the time of issue by a clock of the daemon that nobody sets (`given_clock_s` with `run`), or by its
wall clock (`given_s`); heartbeats of the event stream carry both. Without either the time of issue is when the request
was read, unless the daemon was suspended just before: the age of the request is then unknown, and it is not executed.
Pause, return and land are never refused because a clock runs ahead. A repeated id gets the same outcome; the command is
not sent twice.
"""

import asyncio
import contextlib
import math
import time
from collections import OrderedDict
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from fastapi import HTTPException, Request, Response

from gcs_plugin.config import COMMAND
from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.store.people_rows import Deed, Person
from gcs_plugin.daemon.takeoffs import names_of
from gcs_plugin.daemon.vehicles import VehicleLinks
from gcs_plugin.fleet.commands import URGENT, VERBS, CommandResult, new_id
from gcs_plugin.fleet.separation.returns import VERB as RETURN_VERB
from gcs_plugin.mission.exchange import Verdict
from gcs_plugin.web.answers import JsonAnswer, in_thread, json_body
from gcs_plugin.web.event_stream import RUN, Standstill, clock_with_sleep
from gcs_plugin.web.guard import act_of
from orthoswarm.model.errors import InputError, OrthoSwarmError

Rows = list[dict[str, Any]]

ALL: Final = "all"
_PLAN: Final = "start of a plan"
_UPLOADS: Final = ("upload", "fence")
_ALL_VERBS: Final = ("pause", "resume", "rtl", "return", "land")
_ENDS: Final = URGENT | {RETURN_VERB}
_AHEAD_S: Final = 2.0
_BEATS: Final = {"given_s": "time", "given_clock_s": "clock_s"}
_MOST_ID: Final = 200
_REMEMBERED: Final = 1000  # commands, so that one that is sent twice is carried out once
_THREADS: Final = 128  # commands under way


@dataclass(frozen=True, slots=True)
class Issue:
    """Id and time of issue of a command.

    Attributes:
        id: from the client, or a new one. at: seconds of the daemon's clock that nobody sets.
    """

    id: str
    at: float

    @property
    def age_s(self) -> float:
        """Seconds since then."""
        return clock_with_sleep() - self.at


class CommandRoutes:
    """The routes of commands to vehicles.

    Args:
        daemon: the daemon with the links. standstill: watches the event loop that reads requests.
    """

    def __init__(self, daemon: Daemon, standstill: Standstill) -> None:
        self._daemon, self._standstill = daemon, standstill
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="commands")
        self._known: OrderedDict[str, tuple[tuple[str, str], asyncio.Task[Any]]] = OrderedDict()

    def close(self) -> None:
        """Stop the threads."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def mission(self, vehicle: str, verb: str, request: Request) -> Response:
        """Send a command: `upload` ({"plan": id, "mission": "v1"}), `start`, `pause`, `resume`, `rtl`, `land`.

        `fence` ({"plan": id}) puts the plan's no-fly zones into the vehicle's geofence, in place of its zones to stay
        out of.

        Body: `id`, and `given_clock_s` with `run`, or `given_s` (see above). Answers once the outcome is known, with
        `id`, `vehicle`, `command`, `outcome` (`done`, `refused`, `not_sent`, `unknown`) and `reason`. The vehicle `all`
        stands for all on the links (not for upload and start); its answer has `id` and `results`, a row a vehicle.
        `return` is for all only: those whose ways home come near each other return one after the other (`rtl` sends all
        at once).
        """
        if verb not in (*VERBS, *_UPLOADS) and (vehicle, verb) != (ALL, RETURN_VERB):
            raise HTTPException(404, f"there is no such command; choose {', '.join((*_UPLOADS, *VERBS))}")
        if vehicle == ALL and verb not in _ALL_VERBS:
            raise HTTPException(404, f"all vehicles at once can {', '.join(_ALL_VERBS)}; start a plan, or one vehicle")
        body = await json_body(request)
        self._require_links()
        issue = self._issue(body)
        task, act = self._known_task(issue.id, (vehicle, verb)), act_of(request.scope)
        is_new = task is None
        if task is None:
            carry_out = partial(self._carry_out, vehicle, verb, issue, body, act.person)
            task = asyncio.ensure_future(in_thread(self._threads, carry_out))
            self._remember(issue.id, (vehicle, verb), task)
        rows = await asyncio.shield(task)
        act.deeds = [Deed(r["command"], r["vehicle"], r["outcome"], r["reason"]) for r in rows if is_new]
        return JsonAnswer({"id": issue.id, "results": rows} if vehicle == ALL else rows[0])

    def _remember(self, number: str, what: tuple[str, str], task: "asyncio.Task[Any]") -> None:
        self._known[number] = what, task
        while len(self._known) > _REMEMBERED:
            self._known.popitem(last=False)

    def _known_task(self, number: str, what: tuple[str, str]) -> "asyncio.Task[Any] | None":
        known = self._known.get(number)
        if known is None:
            return None
        if known[0] != what:
            raise HTTPException(409, f"the id {number} was used for another command; give each command its own")
        if known[1].done() and (known[1].cancelled() or known[1].exception() is not None):
            return None  # nothing was sent, for example because the plan was wrong: the id can be used again
        return known[1]

    def _issue(self, body: Mapping[str, Any]) -> Issue:
        number, run = body.get("id"), body.get("run")
        if number is None:
            number = new_id()
        if not isinstance(number, str) or not 0 < len(number) <= _MOST_ID:
            raise InputError(f"id is not a text of 1 to {_MOST_ID} characters; send one, or none for a new one")
        now = clock_with_sleep()
        steady, at = _seconds(body, "given_clock_s"), _seconds(body, "given_s")
        if steady is not None and run == RUN:
            return Issue(number, steady)
        if at is not None:
            return Issue(number, now - (time.time() - at))
        if steady is not None:
            return Issue(number, -math.inf)  # given to a run of the daemon that has ended
        return Issue(number, now - self._standstill.length_s())

    def _carry_out(self, vehicle: str, verb: str, issue: Issue, body: dict[str, Any], pilot: Person) -> Rows:
        """Execute a command and publish its outcome; runs in a thread."""
        links = self._daemon.links
        names = links.heard() if vehicle == ALL else [vehicle]
        late = _late(issue, verb)
        if late is not None:
            rows = [CommandResult(issue.id, name, verb, Verdict.NOT_SENT, late).document() for name in names]
        elif verb == RETURN_VERB:
            rows = links.return_in_turn(command_id=issue.id)
        else:
            override = _override(body, vehicle)
            rows = [] if verb in _ENDS else self._held(pilot, names, verb, issue)
            free = [name for name in names if name not in {row["vehicle"] for row in rows}]
            began = links.clock() - max(0.0, issue.age_s)
            if verb in _UPLOADS:
                rows += [self._upload(name, verb, issue, body) for name in free]
            elif free:
                rows += links.commands(verb, free, given_s=began, command_id=issue.id, override=override)
        return self._told(rows)

    def _held(self, pilot: Person, names: Collection[str], verb: str, issue: Issue) -> Rows:
        """The refusals of vehicles that another pilot has; the others are this pilot's now."""
        known = self._ids(names)
        held = self._daemon.pilots.claim(pilot, known.values())
        return [
            CommandResult(issue.id, name, verb, Verdict.REFUSED, held[vehicle]).document()
            for name, vehicle in known.items() if vehicle in held
        ]  # fmt: skip

    def _ids(self, names: Collection[str]) -> dict[str, str]:
        """The ids of vehicles on the links, by what a request calls them: one has a number, too."""
        fleet, known = self._daemon.links.fleet, {}
        for name in names:
            with contextlib.suppress(OrthoSwarmError):
                known[name] = fleet.names.name_of(fleet.system_of(name))
        return known

    def _told(self, rows: Rows) -> Rows:
        for row in rows:
            self._daemon.events.tell("command", **row)
        return rows

    def _upload(self, vehicle: str, verb: str, issue: Issue, body: dict[str, Any]) -> dict[str, Any]:
        links, plans = self._daemon.links, self._daemon.plans

        def result(outcome: Verdict, reason: str) -> dict[str, Any]:
            return CommandResult(issue.id, vehicle, verb, outcome, reason).document()

        try:
            system = links.fleet.system_of(vehicle)
        except OrthoSwarmError as error:
            return result(Verdict.NOT_SENT, str(error))
        if verb == "fence":
            put = partial(links.upload_fence, system, plans.keep_out(body.get("plan")))
        else:
            put = partial(links.upload, system, plans.mission(body, vehicle, links.fleet.vehicles[system].autopilot))
        try:
            return result(Verdict.DONE, put())
        except OrthoSwarmError as error:
            return result(Verdict.REFUSED, str(error))

    # -- plans ----------------------------------------------------------------------------------------------------

    async def preflight(self, number: str, request: Request) -> Response:
        """Preflight check of a plan's vehicles ({"sortie": 1, "vehicles": {"v1": "alpha"}}).

        Answers `checks`: a row a vehicle with `vehicle`, `state` and `items` (`name`, `state`: `ok`, `warning`, `red`;
        `reason`), and the plan's `start_s`, `height_m` and `time_s`.
        """
        body = await json_body(request)
        self._require_links()
        sortie, names = names_of(body)
        rows = await in_thread(self._threads, self._daemon.takeoffs.preflight, number, sortie, names)
        flights = await in_thread(self._threads, self._daemon.plans.flights, number, sortie)
        about = {names.get(vehicle, vehicle): flight for vehicle, flight in flights.items()}
        checks = [row | about.get(row["vehicle"], {}) for row in rows]
        return JsonAnswer({"plan": number, "sortie": sortie, "checks": checks})

    async def start_plan(self, number: str, request: Request) -> Response:
        """Start all vehicles of a plan at its times ({"sortie": 1}). Answers with the seconds until each takeoff.

        {"vehicles": {"v1": "alpha"}} says which vehicle flies which part where names differ, {"override": {"alpha":
        ["battery"]}} which red preflight items do not stop the start. A `pause`, `rtl` or `land` of a vehicle that
        waits cancels its takeoff, a `start` starts it at once. A repeated id gets the same answer, so that a client to
        which the answer was lost can ask again.
        """
        body = await json_body(request)
        self._require_links()
        issue, what = self._issue(body), (number, _PLAN)
        sortie, names = names_of(body)
        task = self._known_task(issue.id, what)
        if task is None:
            begin = partial(
                self._begin, issue, number, act_of(request.scope).person,
                sortie=sortie, names=names, override=_override(body, ALL),
            )  # fmt: skip
            task = asyncio.ensure_future(in_thread(self._threads, begin))
            self._remember(issue.id, what, task)
        seconds = await asyncio.shield(task)
        return JsonAnswer({"plan": number, "sortie": sortie, "takeoffs_in_s": seconds}, status_code=202)

    async def cancel_start(self, number: str, request: Request) -> Response:
        """Cancel a start by its `id`, also one that is still being checked or has not arrived yet.

        Answers `results`: a row a vehicle as for a `pause`, which all its vehicles get if it had already begun; none
        if no vehicle was started.
        """
        issue = self._issue(await json_body(request))
        self._require_links()
        self._daemon.takeoffs.cancel(issue.id)
        known = self._known.get(issue.id)
        rows: Rows = []
        if known is not None and known[0] == (number, _PLAN):
            try:
                seconds = await asyncio.shield(known[1])
            except OrthoSwarmError:
                seconds = {}
            if seconds:
                pause = Issue(f"{issue.id}-cancelled", clock_with_sleep())
                rows = await in_thread(self._threads, self._pause, list(seconds), pause)
        return JsonAnswer({"plan": number, "results": rows})

    def _begin(
        self, issue: Issue, number: str, pilot: Person, *,
        sortie: int, names: dict[str, str], override: Mapping[str, Collection[str]],
    ) -> dict[str, float]:  # fmt: skip
        late = _late(issue, "start")
        if late is not None:
            raise OrthoSwarmError(f"{late}; no vehicle was started")
        flown = [names.get(vehicle, vehicle) for vehicle in self._daemon.plans.starts(number, sortie)]
        self._daemon.pilots.claim(pilot, self._ids(flown).values(), whole=True)
        began = VehicleLinks.clock() - max(0.0, issue.age_s)
        return self._daemon.takeoffs.begin(number, sortie, names, override, number=issue.id, given_s=began)

    def _pause(self, vehicles: list[str], issue: Issue) -> Rows:
        return self._told(self._daemon.links.commands("pause", vehicles, command_id=issue.id))

    def _require_links(self) -> None:
        if not self._daemon.settings.links:
            raise HTTPException(409, "the daemon has no links; start it with --link")


def _seconds(body: Mapping[str, Any], key: str) -> float | None:
    """A time in a request, None if it has none."""
    at = body.get(key)
    if at is None:
        return None
    if isinstance(at, bool) or not isinstance(at, int | float) or not 0 <= at < 1e11 or not math.isfinite(at):
        raise InputError(f"{key} is not a time; send seconds by the daemon's clock (`{_BEATS[key]}` of a heartbeat)")
    return float(at)


def _late(issue: Issue, verb: str) -> str | None:
    """Why a command has expired or lies in the future, None if it is valid."""
    age = issue.age_s
    if age > COMMAND.fresh_s:
        ago = f"{age:.0f} s ago" if math.isfinite(age) else "before the ground station was started again"
        return f"it was given {ago}, too long to be executed now; look at the vehicle and give it again"
    if age < -_AHEAD_S and verb not in _ENDS:  # the clock was set; what ends a flight counts as given now
        return f"it was given {-age:.0f} s from now; take the time from the daemon's heartbeats and give it again"
    return None


def _override(body: Mapping[str, Any], vehicle: str) -> dict[str, list[str]]:
    """Vehicle -> red items that do not stop its start: {"v1": ["battery"]}, or ["battery"] for one vehicle."""
    override = body.get("override", {})
    if isinstance(override, list) and vehicle != ALL:
        override = {vehicle: override}
    if not isinstance(override, dict) or not all(
        isinstance(items, list) and all(isinstance(item, str) for item in items) for items in override.values()
    ):
        raise InputError('override names no preflight items; send for example {"v1": ["battery"]}, or nothing')
    return override
